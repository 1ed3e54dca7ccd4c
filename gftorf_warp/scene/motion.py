"""Where Gaussians have moved to at a time: one offset per key time, linear in between (method, section 4).

Keys lie at the start of every quartet, one more after the last frame. Inside quartet i, at quartet time j in [i, i+1],

    x(j) = (i + 1 - j) x(i) + (j - i) x(i + 1)

so a trajectory is continuous, and this file is the only place that interpolates. Before the first key and after the
last a Gaussian stays where the nearest key has put it. Only positions move: shape, opacity and reflectivity stay.

A third final class beside :class:`Still` and :class:`Nodes` is in network.py.
"""

from __future__ import annotations

import abc
import bisect
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .gaussians import GaussianField


class Products(StrEnum):
    """How a network multiplies matrices."""

    FLOAT32 = "float32"
    """As everywhere else: the reference."""
    TF32 = "tf32"
    """On CUDA factors rounded to 11 bits, sums in float32: a fraction of the time; offsets differ by a thousandth."""
    HALF = "half"
    """Factors and activations in float16 on any device, sums and parameters in float32: the fastest on CUDA."""


class MotionKind(StrEnum):
    """The motion models that exist."""

    STILL = "still"
    """Nothing moves: the control."""
    NODES = "nodes"
    """Key offsets on nodes."""
    NETWORK = "network"
    """Key offsets from a network of position and time, as published."""


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """Which motion model, and how fine."""

    kind: MotionKind = MotionKind.NODES
    """The model."""
    nodes: int = 64
    """Nodes at most, spread over the moving layer."""
    neighbours: int = 4
    """Nodes that a Gaussian follows at most."""
    from_tracks: bool = True
    """Nodes: whether keys start where optical flow and decoded distance lead; otherwise at rest."""
    layers: int = 8
    """Network: layers before the head."""
    width: int = 256
    """Network: width of every layer."""
    skip_after: int = 5
    """Network: the input is joined to the output of this layer."""
    position_frequencies: int = 10
    """Network: frequencies of the encoded position."""
    time_frequencies: int = 10
    """Network: frequencies of the encoded time."""
    input_scale: float = 1.0
    """Network: positions are divided by this many unambiguous ranges [1]."""
    products: Products = Products.FLOAT32
    """Network: precision of its matrix products."""

    def __post_init__(self):
        for name in ("layers", "width", "skip_after"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.input_scale > 0:
            raise ValueError(f"input_scale must be above 0, got {self.input_scale}")


class Motion(torch.nn.Module, abc.ABC):
    """Displacements of Gaussians over time. Final classes: :class:`Still`, :class:`Nodes`, network.Network."""

    key_times: Tensor  # [T] float64 [s]
    follows_means = False
    """Whether ``attach`` depends on where Gaussians are now, so that it has to be asked again after every step."""

    def __init__(self, key_times: Float[Tensor, "T"]):
        super().__init__()
        times = [float(t) for t in key_times]
        if len(times) < 2 or any(end <= start for start, end in pairwise(times)):
            raise ValueError(f"key_times must be at least two increasing times [s], got {times}")
        self.register_buffer("key_times", torch.tensor(times, dtype=torch.float64))
        self._times = times

    @abc.abstractmethod
    def attach(self, field: GaussianField) -> Float[Tensor, "N M"]:
        """What the motion needs to know of each Gaussian; computed anew whenever Gaussians come or go, else kept."""

    @abc.abstractmethod
    def key_offsets(
        self, attachment: Float[Tensor, "N M"], keys: list[int] | Int[Tensor, "k"]
    ) -> Float[Tensor, "k N 3"]:
        """Displacements [m] of every Gaussian at the key times of these numbers; a tensor is read on its device."""

    def key_offset(self, attachment: Float[Tensor, "N M"], key: int) -> Float[Tensor, "N 3"]:
        """Displacement [m] of every Gaussian at key time number ``key``."""
        return self.key_offsets(attachment, [key])[0]

    def displacement(self, attachment: Float[Tensor, "N M"], time: float) -> Float[Tensor, "N 3"]:
        """Displacement [m] of every Gaussian at ``time`` [s], any number; held constant outside the keys."""
        return self.displacements(attachment, [time])[0]

    def displacements(self, attachment: Float[Tensor, "N M"], times: list[float]) -> list[Float[Tensor, "N 3"]]:
        """:meth:`displacement` at several times; all their keys are asked for at once."""
        places = [self.position(time) for time in times]
        keys = sorted({key + more for key, share in places for more in range(1 if share == 0.0 else 2)})
        offsets = dict(zip(keys, self.key_offsets(attachment, keys), strict=True))
        return [
            offsets[key] if share == 0.0 else (1.0 - share) * offsets[key] + share * offsets[key + 1]
            for key, share in places
        ]

    def position(self, time: float) -> tuple[int, float]:
        """The key i at or before ``time`` [s] and the share j - i of the way to the next one, in [0, 1)."""
        if time >= self._times[-1]:
            return len(self._times) - 1, 0.0
        key = max(bisect.bisect_right(self._times, time) - 1, 0)
        start, end = self._times[key], self._times[key + 1]
        return key, max((time - start) / (end - start), 0.0)


class Still(Motion):
    """Nothing moves."""

    def attach(self, field: GaussianField) -> Float[Tensor, "N 0"]:
        """Nothing is needed."""
        return field.mean.new_zeros(len(field), 0)

    def key_offsets(
        self, attachment: Float[Tensor, "N 0"], keys: list[int] | Int[Tensor, "k"]
    ) -> Float[Tensor, "k N 3"]:
        """Zero."""
        return attachment.new_zeros(len(keys), len(attachment), 3)


class Nodes(Motion):
    """M nodes in the moving layers with one offset per key; a Gaussian follows the nearest nodes of its own layer.

    A Gaussian of the static layer 0 follows no node: it is pinned, whatever moves past it.
    """

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        position: Float[Tensor, "M 3"],
        layer: Int[Tensor, "M"],
        offset: Float[Tensor, "T M 3"] | None = None,
        *,
        neighbours: int = 4,
    ):
        """Place the nodes.

        Args:
            key_times: Start of every quartet and the time one quartet after the last start [s].
            position: Nodes in the world, where the field is described [m].
            layer: The motion layer each node moves, 1 or more.
            offset: Displacements to start from [m]; None is rest.
            neighbours: How many nodes a Gaussian follows at most.

        Raises:
            ValueError: If shapes disagree or a node belongs to the static layer.
        """
        super().__init__(key_times)
        start = position.new_zeros(len(key_times), len(position), 3) if offset is None else offset
        if tuple(start.shape) != (len(key_times), len(position), 3) or len(layer) != len(position):
            raise ValueError(
                f"offset {tuple(start.shape)} and layer {tuple(layer.shape)} must be "
                f"({len(key_times)}, {len(position)}, 3) and ({len(position)},): keys, nodes, xyz"
            )
        if len(layer) and int(layer.min()) < 1:
            raise ValueError(f"a node of layer {int(layer.min())}: nodes belong to layers 1 and above, 0 is static")
        if neighbours < 1:
            raise ValueError(f"neighbours must be at least 1, got {neighbours}")
        self.neighbours = neighbours
        self.node: Tensor
        self.layer: Tensor
        self.register_buffer("node", position.detach().clone())
        self.register_buffer("layer", layer.detach().clone())
        self.offset = torch.nn.Parameter(start.detach().clone())
        """Displacement [T, M, 3] of every node at every key [m]."""

    def attach(self, field: GaussianField) -> Float[Tensor, "N M"]:
        """Weight of every node for every Gaussian: rows add up to 1, those of the static layer are zero.

        The nearest nodes count like exp(-(distance / distance of the farthest of them)^2 * 2), so that the weights are
        smooth in the position and need no length scale.
        """
        weight = field.mean.new_zeros(len(field), len(self.node))
        if field.layer is None:
            return weight
        for layer in self.layer.unique().tolist():
            rows = (field.layer == layer).nonzero()[:, 0]
            columns = (self.layer == layer).nonzero()[:, 0]
            apart = torch.cdist(field.mean.detach()[rows], self.node[columns])
            near, index = apart.topk(min(self.neighbours, len(columns)), dim=1, largest=False)
            share = torch.softmax(-2.0 * (near / near[:, -1:].clamp_min(1e-9)).square(), dim=1)
            weight[rows[:, None], columns[index]] = share
        return weight

    def key_offsets(
        self, attachment: Float[Tensor, "N M"], keys: list[int] | Int[Tensor, "k"]
    ) -> Float[Tensor, "k N 3"]:
        """Weighted means of the node offsets."""
        return torch.stack([attachment @ offset for offset in rows_of(self.offset, keys)])


def rows_of(table: Float[Tensor, "T *n"], keys: list[int] | Int[Tensor, "k"]) -> Float[Tensor, "k *n"]:
    """Rows of a table by their numbers. The host neither reads a tensor of numbers nor uploads a list of them."""
    return table.index_select(0, keys) if isinstance(keys, Tensor) else torch.stack([table[key] for key in keys])


def farthest_points(points: Float[Tensor, "N 3"], count: int) -> Int[Tensor, "M"]:
    """Indices of ``count`` points, each the farthest from those before it; all points if there are fewer.

    The first is the one nearest to the centroid, so that the choice depends on nothing but the points.
    """
    count = min(count, len(points))
    if count == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    first = int((points - points.mean(dim=0)).norm(dim=1).argmin())
    chosen = [first]
    apart = (points - points[first]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, (points - points[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen, device=points.device)
