"""Motion in time windows: moving Gaussians that exist during one quartet only and move in a
straight line.

Every quartet has moving Gaussians of its own, with the label 1 + number of the quartet; those of
the static layer 0 exist always. A node has one velocity, and a Gaussian moves by the weighted mean
of the velocities of the nearest nodes of its label:

    x(t) = x + (t - t_middle) sum_n w_n v_n

So a body needs no track through the whole recording, and occlusion, several bodies, turning and
approaching bodies need no model of their own. Nothing is shared between windows but the static
layer.

Outside its window a Gaussian is displaced by ``AWAY`` along all three axes, where no camera sees
it. So a displacement means motion only between two times of one window: the losses of optical flow
(from one quartet to the next) and of the size of displacements are refused with windows.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .gaussians import GaussianField
from .motion import (
    KeyMotion,
    Keys,
    Motion,
    MotionSettings,
    MotionStart,
    farthest_points,
    node_weights,
    rows_of,
)

# displacement per axis of Gaussians outside their window [m]: beyond the far plane or beside the
# image for every camera
AWAY = 1e6
NODE_NEIGHBOURS = 24  # nearest points whose median velocity is the initial velocity of a node


class Windows(Motion):
    """Nodes with one velocity each; key 2 j is the start and key 2 j + 1 the end of window j."""

    kind = "windows"

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        position: Float[Tensor, "M 3"],
        label: Int[Tensor, "M"],
        velocity: Float[Tensor, "M 3"],
        *,
        neighbours: int = 4,
    ):
        """Create the nodes.

        Args:
            key_times: Start of every quartet and the time one quartet after the last start [s].
            position: Of the nodes in the world in the middle of their window [m].
            label: Of each node, 1 + number of its window.
            velocity: Of each node [m per window].
            neighbours: Largest number of nodes that a Gaussian follows.
        """
        super().__init__(key_times)
        self.neighbours = neighbours
        self.node: Tensor
        self.label: Tensor
        self.register_buffer("node", position.detach().clone())
        self.register_buffer("label", label.detach().clone())
        self.velocity = torch.nn.Parameter(velocity.detach().clone())
        """Displacement [M, 3] of every node from the start to the end of its window [m]."""

    @classmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Windows:
        """Nodes spread over the moving Gaussians of every window, with the median velocity of the
        nearest ones, or none.
        """
        field = initial.field
        if field.layer is None:
            raise ValueError("windows need a field with one layer per quartet")
        moving = field.layer > 0
        mean, label, velocity = field.mean[moving], field.layer[moving], initial.velocity
        velocity = torch.zeros_like(mean) if velocity is None else velocity
        nodes, medians = [], []
        for number in label.unique().tolist():
            members = (label == number).nonzero()[:, 0]
            chosen = members[farthest_points(mean[members], settings.nodes)]
            fellows = min(NODE_NEIGHBOURS, len(members))
            near = (
                torch.cdist(mean[chosen], mean[members]).topk(fellows, dim=1, largest=False).indices
            )
            nodes.append(chosen)
            medians.append(velocity[members][near].median(dim=1).values)
        chosen = torch.cat(nodes) if nodes else torch.zeros(0, dtype=torch.long)
        start = torch.cat(medians) if medians else torch.zeros(0, 3)
        parts = mean[chosen], label[chosen], start
        return cls(initial.key_times, *parts, neighbours=settings.neighbours)

    def bind(self, field: GaussianField) -> Float[Tensor, "N columns"]:
        """Label, indices of the nearest nodes of the same label, and their weights."""
        count = min(self.neighbours, len(self.node))
        label = field.layer
        if label is None or count == 0:
            return field.mean.new_zeros(len(field), 1)
        index = field.mean.new_zeros(len(field), count)
        weight = torch.zeros_like(index)
        for number in self.label.unique().tolist():  # all pairs of all windows would take too much
            rows, members = ((each == number).nonzero()[:, 0] for each in (label, self.label))
            apart = torch.cdist(field.mean.detach()[rows], self.node[members])
            nearest, share = node_weights(apart, count)
            index[rows, : share.shape[1]] = members[nearest].to(index)
            weight[rows, : share.shape[1]] = share
        return torch.cat([label[:, None].to(weight), index, weight], dim=1)

    def at_keys(
        self, binding: Float[Tensor, "N columns"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Half a displacement before or after the middle; away outside the window."""
        count = (binding.shape[1] - 1) // 2
        label = binding[:, :1]
        table = torch.arange(self.key_count, device=binding.device)
        key = rows_of(table, keys)[:, None, None]
        inside = label == torch.div(key, 2, rounding_mode="floor") + 1
        offset = torch.where(inside | (label == 0), 0.0, AWAY).expand(-1, -1, 3)
        if count:
            index, weight = binding[:, 1 : 1 + count].long(), binding[:, 1 + count :]
            chosen = self.velocity.index_select(0, index.flatten()).view(*index.shape, 3)
            whole = (chosen * weight[..., None]).sum(dim=1)
            offset = offset + torch.where(inside, (key % 2) - 0.5, 0.0) * whole
        return KeyMotion(offset, None)

    def present(
        self, binding: Float[Tensor, "N columns"], keys: Int[Tensor, "K"]
    ) -> Bool[Tensor, "N"]:
        """Static Gaussians, and those of the windows of these keys."""
        label = binding[:, 0].contiguous()
        exists = label == 0
        for own in torch.div(keys, 2, rounding_mode="floor") + 1:
            exists |= label == own
        return exists

    @property
    def key_count(self) -> int:
        """Two per window."""
        return 2 * len(self.times) - 2

    def keys_at(self, time: float) -> Keys:
        """The keys of the window that holds ``time`` [s]."""
        last = len(self.times) - 2
        window = min(max(bisect.bisect_right(self.times, time) - 1, 0), last)
        start, end = self.times[window], self.times[window + 1]
        share = min(max((time - start) / (end - start), 0.0), 1.0)
        keys = ((2 * window, 1.0 - share), (2 * window + 1, share))
        return Keys(*zip(*((key, weight) for key, weight in keys if weight), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """With the number of neighbours."""
        return super().to_dict() | {"neighbours": self.neighbours}

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Windows:
        """From its tensors and the number of neighbours."""
        tensors = stored["tensors"]
        start = (tensors[name] for name in ("key_times", "node", "label", "velocity"))
        return cls(*start, neighbours=stored["neighbours"])
