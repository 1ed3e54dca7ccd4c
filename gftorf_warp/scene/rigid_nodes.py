"""Motion by nodes that rotate and translate.

A node at p has a rotation vector w and a translation t at every key. A Gaussian at x follows the
weighted means of p, w and t over the nearest nodes of its layer, which reproduces any rigid motion
that they share:

    x' = R(w) (x - p) + p + t,   covariance' = R(w) covariance R(w)^T

Between keys displacements and quaternions are interpolated. Harmonics of reflectivity and colour
are not rotated.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .gaussians import GaussianField
from .motion import KeyMotion, Nodes, rows_of


class RigidNodes(Nodes):
    """Nodes with a rotation and a translation per key; gradients w.r.t. means pass through R."""

    kind = "rigid_nodes"
    follows_means = True

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        position: Float[Tensor, "M 3"],
        layer: Int[Tensor, "M"],
        offset: Float[Tensor, "T M 3"] | None = None,
        *,
        neighbours: int = 4,
    ):
        """Create the nodes, without rotation; the arguments are those of :class:`Nodes`."""
        super().__init__(key_times, position, layer, offset, neighbours=neighbours)
        self.rotation = torch.nn.Parameter(torch.zeros_like(self.offset))
        """Rotation vector [T, M, 3] of every node at every key [rad]."""

    def bind(self, field: GaussianField) -> Float[Tensor, "N columns"]:
        """Weights of the nodes, and the means."""
        return torch.cat([super().bind(field), field.mean], dim=1)

    def at_keys(
        self, binding: Float[Tensor, "N columns"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Displacements, and rotations of the covariances."""
        weight, mean = binding.split([len(self.node), 3], dim=1)
        turn = quaternion_of(weight @ rows_of(self.rotation, keys))
        arm = (mean - weight @ self.node).expand(len(turn), -1, -1)
        half = torch.linalg.cross(turn[..., 1:], arm)
        # R(w) arm - arm
        rotated = 2.0 * (turn[..., :1] * half + torch.linalg.cross(turn[..., 1:], half))
        return KeyMotion(rotated + weight @ rows_of(self.offset, keys), turn)


def quaternion_of(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 4"]:
    """Unit quaternions wxyz of rotation vectors [rad], differentiable at zero."""
    angle = vector.norm(dim=-1, keepdim=True)
    half = 0.5 * torch.sinc(angle / (2.0 * torch.pi)) * vector
    return torch.cat([(0.5 * angle).cos(), half], dim=-1)
