"""The 3D flow of samples between quartets, and the terms of the loss that it alone has
(neural_volumes.md, section 3).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ...scene.camera import Camera
from .rays import Depths, Rays
from .settings import SceneFlowSettings

FORWARD, BACKWARD = 0, 1  # rows of a flow


class Neighbours(NamedTuple):
    """Where samples go and come from; each is [R, S, 3] in metres."""

    forward: Tensor
    """From quartet i to the next."""
    backward: Tensor
    """From quartet i to the one before."""
    from_before: Tensor
    """From quartet i - 1 to quartet i, at the same points; ``forward`` without i - 1."""
    from_after: Tensor
    """From quartet i + 1 back to quartet i, at the same points; ``backward`` without i + 1."""


def neighbours(flow: Float[Tensor, "T R S 2 3"], *, earlier: bool, later: bool) -> Neighbours:
    """The flows of a quartet and those beside it.

    Args:
        flow: Of the quartet, of the one before it and of the one after it [m].
        earlier: Whether there is one before.
        later: Whether there is one after.
    """
    forward, backward = flow[0, ..., FORWARD, :], flow[0, ..., BACKWARD, :]
    return Neighbours(
        forward=forward,
        backward=backward,
        from_before=flow[1, ..., FORWARD, :] if earlier else forward,
        from_after=flow[-1, ..., BACKWARD, :] if later else backward,
    )


def regularisers(flows: Neighbours, gap: Tensor, options: SceneFlowSettings) -> dict[str, Tensor]:
    """Weighted terms of the flows of a quartet; ``gap`` is what is left after a flow and the flow
    back [m].
    """
    kept = max(1, round(options.kinetic_share * flows.forward.shape[1]))
    both = (flows.forward + flows.backward)[:, :kept]
    return {
        "size": options.size * 0.5 * (flows.forward.abs() + flows.backward.abs()).mean(),
        "kinetic": options.kinetic * 0.5 * both.square().sum(dim=-1).mean(),
        "round_trip": options.round_trip * gap,
    }


def projected(
    camera: Camera,
    measured: Float[Tensor, "2 2 R"],
    weight: Float[Tensor, "R S"],
    rays: Rays,
    depths: Depths,
    flows: Neighbours,
    near: float,
) -> Tensor:
    """Mean absolute difference to the optical flow of a quartet start [px], where known.

    Args:
        camera: At rest, in the axes of the volume.
        measured: Optical flow [px], forward and backward; NaN: unknown.
        weight: alpha T of the samples [1].
        rays: Their rays.
        depths: Where on them they are.
        flows: Where they go.
        near: z-depth of the first samples [m]; what flows nearer than half of it counts as there.
    """
    seen = rays.at((weight * depths.z).sum(dim=-1))
    start, known = _image(camera, seen, 0.5 * near), measured.isfinite()
    gaps = []
    for direction, flow in ((FORWARD, flows.forward), (BACKWARD, flows.backward)):
        moved = seen + (weight[..., None] * flow).sum(dim=1)
        apart = (_image(camera, moved, 0.5 * near) - start).T - measured[direction]
        gaps.append(torch.where(known[direction], apart, torch.zeros_like(apart)).abs().sum())
    return torch.stack(gaps).sum() / known.sum().clamp_min(1)


def _image(camera: Camera, points: Float[Tensor, "R 3"], nearest: float) -> Float[Tensor, "R 2"]:
    """Positions of points in the image [px], at least so far away [m]."""
    depth = points[:, 2:].clamp_min(nearest)
    return camera.project(torch.cat([points[:, :2], depth], dim=1))
