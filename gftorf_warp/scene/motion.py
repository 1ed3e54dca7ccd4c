"""Motion models: displacement and, for some models, rotation of every Gaussian at any time (method,
section 4).

A model has keys at the start of every quartet and one after the last. It computes displacements at
keys, and ``keys_at`` gives the keys that a time depends on with their interpolation weights w:

    x(t) = x + sum_k w_k(t) o_k(x),   q(t) = normalise(sum_k w_k(t) r_k(x)) q

Linear between two keys unless a model overrides ``keys_at``, constant before the first key and
after the last. Training and rendering evaluate these sums with the same kernel
(kernels/displace.py), ``Motion.at`` in torch.

scene/models.py lists all models.
"""

from __future__ import annotations

import abc
import bisect
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from .changes import require
from .gaussians import GaussianField

LOG = logging.getLogger("gftorf_warp")
NODE_NEIGHBOURS = (
    8  # nearest points whose median displacement is the initial displacement of a node
)


class Products(StrEnum):
    """Precision of the matrix products of a network."""

    FLOAT32 = "float32"
    """The reference."""
    HALF = "half"
    """Factors and activations in float16, sums and parameters in float32: fastest on CUDA."""

    @classmethod
    def _missing_(cls, value: object) -> Products | None:
        """TF32, which earlier versions had, is read as float32."""
        if value != "tf32":
            return None
        LOG.warning(
            "products = tf32 is no longer supported: the motion network is computed in float32"
        )
        return cls.FLOAT32


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """Which motion model, and its size."""

    kind: str = "nodes"
    """Name of the model, see scene/models.py."""
    nodes: int = 64
    """Nodes: largest number, spread over the moving layer."""
    neighbours: int = 4
    """Nodes: largest number that a Gaussian follows."""
    from_tracks: bool = True
    """Nodes: whether initial displacements follow optical flow and decoded distance; else zero."""
    layers: int = 8
    """Network: layers before the head."""
    width: int = 256
    """Network: width of every layer."""
    skip_after: int = 5
    """Network: the input is concatenated to the output of this layer."""
    position_frequencies: int = 10
    """Network: frequencies of the encoded position."""
    time_frequencies: int = 10
    """Network: frequencies of the encoded time."""
    input_scale: float = 1.0
    """Network: positions are divided by this many unambiguous ranges [1]."""
    products: Products = Products.FLOAT32
    """Network: precision of its matrix products."""

    def __post_init__(self):
        require(self, "nodes", "neighbours", "layers", "width", "skip_after", at_least=1)
        require(self, "position_frequencies", "time_frequencies", at_least=0)
        require(self, "input_scale", above=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionStart:
    """What a motion model may be initialised from."""

    key_times: Float[Tensor, "T"]
    """Start of every quartet, and one quartet after the last start [s]."""
    field: GaussianField
    """The initial Gaussians."""
    tracks: Float[Tensor, "T P 3"] | None
    """Displacements of the P Gaussians of the moving layer at every key [m]; None: not tracked."""
    duration: float
    """Time from the first raw frame to the last [s]."""
    unambiguous_range: float
    """Of the sensor [m]."""
    generator: torch.Generator
    """For random weights, on the CPU."""
    velocity: Float[Tensor, "P 3"] | None = None
    """Displacements of the P moving Gaussians during their quartet [m]; None: unknown."""


@dataclass(frozen=True)
class Keys:
    """The keys that a time depends on."""

    index: tuple[int, ...]
    """Their numbers."""
    weight: tuple[float, ...]
    """Their interpolation weights [1]."""


class KeyMotion(NamedTuple):
    """Motion of N Gaussians at K keys."""

    offset: Float[Tensor, "K N 3"]
    """Displacements [m]."""
    rotation: Float[Tensor, "K N 4"] | None
    """Quaternions wxyz that rotate the covariances; None: no rotation."""


class Displacement(NamedTuple):
    """Motion of N Gaussians at one time."""

    offset: Float[Tensor, "N 3"]
    """Displacements [m]."""
    rotation: Float[Tensor, "N 4"] | None
    """Quaternions wxyz, not normalised, that rotate the covariances; None: no rotation."""


class Motion(torch.nn.Module, abc.ABC):
    """A motion model: ``bind`` binds Gaussians to it, ``at_keys`` displaces them."""

    kind: ClassVar[str]
    """Name in settings and checkpoints."""
    support: ClassVar[int] = 2
    """Largest number of keys that a time depends on."""
    follows_means: ClassVar[bool] = False
    """Whether ``bind`` depends on the present means, so that it is evaluated in every step; it must
    then be capturable in a CUDA graph."""
    key_times: Tensor  # [T] float64 [s]

    def __init__(self, key_times: Float[Tensor, "T"]):
        super().__init__()
        times = [float(t) for t in key_times]
        if len(times) < 2 or any(end <= start for start, end in pairwise(times)):
            raise ValueError(f"key_times must be at least two increasing times [s], got {times}")
        self.register_buffer("key_times", torch.tensor(times, dtype=torch.float64))
        self.times = times
        """Key times on the host [s]."""

    @property
    def key_count(self) -> int:
        """Number of keys."""
        return len(self.times)

    @classmethod
    @abc.abstractmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Motion:
        """The model at the beginning of a run."""

    @abc.abstractmethod
    def bind(self, field: GaussianField) -> Float[Tensor, "N M"]:
        """What the model needs of each Gaussian; evaluated when Gaussians are added or removed.

        Means on which displacements depend differentiably are returned with their gradient.
        """

    @abc.abstractmethod
    def at_keys(
        self, binding: Float[Tensor, "N M"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Motion at keys given by their indices; a tensor of indices is read on its device only."""

    def present(
        self,
        binding: Float[Tensor, "N M"],  # noqa: ARG002
        keys: Int[Tensor, "K"],  # noqa: ARG002
    ) -> Bool[Tensor, "N"] | None:
        """Which Gaussians exist at any of these keys; None: all, at all keys."""
        return None

    def keys_at(self, time: float) -> Keys:
        """Keys and interpolation weights of ``time`` [s], any number."""
        key, fraction = self.interval(time)
        if fraction == 0.0:
            return Keys((key,), (1.0,))
        return Keys((key, key + 1), (1.0 - fraction, fraction))

    def interval(self, time: float) -> tuple[int, float]:
        """Index i of the key at or before ``time`` [s], and its share of the interval in [0, 1)."""
        if time >= self.times[-1]:
            return len(self.times) - 1, 0.0
        key = max(bisect.bisect_right(self.times, time) - 1, 0)
        start, end = self.times[key], self.times[key + 1]
        return key, max((time - start) / (end - start), 0.0)

    def at(self, binding: Float[Tensor, "N M"], time: float) -> Displacement:
        """Motion at ``time`` [s], any number."""
        return self.at_times(binding, [time])[0]

    def at_times(self, binding: Float[Tensor, "N M"], times: Sequence[float]) -> list[Displacement]:
        """:meth:`at` for several times, whose keys are evaluated together."""
        needed = [self.keys_at(time) for time in times]
        keys = sorted({key for one in needed for key in one.index})
        motion = self.at_keys(binding, keys)
        row = {key: n for n, key in enumerate(keys)}
        return [interpolated(motion, [row[key] for key in one.index], one.weight) for one in needed]

    def to_dict(self) -> dict[str, Any]:
        """Tensors, numbers and strings only, for checkpoints."""
        return {"kind": self.kind, "tensors": self.state_dict()}

    @classmethod
    @abc.abstractmethod
    def from_dict(cls, stored: dict[str, Any]) -> Motion:
        """The inverse of :meth:`to_dict`."""


class Still(Motion):
    """No motion."""

    kind = "still"

    @classmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Still:  # noqa: ARG003
        """No parameters."""
        return cls(initial.key_times)

    def bind(self, field: GaussianField) -> Float[Tensor, "N 0"]:
        """No columns."""
        return field.mean.new_zeros(len(field), 0)

    def at_keys(
        self, binding: Float[Tensor, "N 0"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Zero."""
        return KeyMotion(binding.new_zeros(len(keys), len(binding), 3), None)

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Still:
        """From its key times."""
        return cls(stored["tensors"]["key_times"])


class Nodes(Motion):
    """M nodes with one displacement per key; a Gaussian follows the nearest nodes of its layer.

    Nodes belong to moving layers, so Gaussians of the static layer 0 do not move.
    """

    kind = "nodes"

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        position: Float[Tensor, "M 3"],
        layer: Int[Tensor, "M"],
        offset: Float[Tensor, "T M 3"] | None = None,
        *,
        neighbours: int = 4,
    ):
        """Create the nodes.

        Args:
            key_times: Start of every quartet and the time one quartet after the last start [s].
            position: Of the nodes in the world, in the undeformed field [m].
            layer: The motion layer of each node, 1 or more.
            offset: Initial displacements [m]; None: zero.
            neighbours: Largest number of nodes that a Gaussian follows.

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
            given = f"a node of layer {int(layer.min())}"
            raise ValueError(f"{given}: nodes belong to layers 1 and above, 0 is static")
        if neighbours < 1:
            raise ValueError(f"neighbours must be at least 1, got {neighbours}")
        self.neighbours = neighbours
        self.node: Tensor
        self.layer: Tensor
        self.register_buffer("node", position.detach().clone())
        self.register_buffer("layer", layer.detach().clone())
        self.offset = torch.nn.Parameter(start.detach().clone())
        """Displacement [T, M, 3] of every node at every key [m]."""

    @classmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Nodes:
        """Nodes spread over the moving layers; displacements are medians of tracks near each node,
        or zero.
        """
        field = initial.field
        if field.layer is None:
            raise ValueError("nodes need a field with layers")
        moving = field.mean[field.layer > 0]
        nodes = farthest_points(moving, settings.nodes)
        offset = None
        if settings.from_tracks and initial.tracks is not None and len(nodes):
            apart, fellows = torch.cdist(moving[nodes], moving), min(NODE_NEIGHBOURS, len(moving))
            near = apart.topk(fellows, dim=1, largest=False).indices
            offset = initial.tracks[:, near].median(dim=2).values
        layer = field.layer[field.layer > 0][nodes]
        return cls(initial.key_times, moving[nodes], layer, offset, neighbours=settings.neighbours)

    def bind(self, field: GaussianField) -> Float[Tensor, "N M"]:
        """Weight of every node for every Gaussian: rows sum to 1, or 0 in the static layer.

        The nearest nodes are weighted by exp(-2 (distance / distance of the farthest of them)^2):
        smooth in the position and without a length scale. No gradient.
        """
        count = min(self.neighbours, len(self.node))
        weight = field.mean.new_zeros(len(field), len(self.node))
        if field.layer is None or count == 0:
            return weight
        apart = torch.cdist(field.mean.detach(), self.node)
        apart = apart.masked_fill(field.layer[:, None] != self.layer, torch.inf)
        return weight.scatter(1, *node_weights(apart, count))

    def at_keys(
        self, binding: Float[Tensor, "N M"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Weighted means of the displacements of nodes."""
        offsets = [binding @ offset for offset in rows_of(self.offset, keys)]
        return KeyMotion(torch.stack(offsets), None)

    def to_dict(self) -> dict[str, Any]:
        """With the number of neighbours."""
        return super().to_dict() | {"neighbours": self.neighbours}

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Nodes:
        """From its tensors and the number of neighbours."""
        tensors = stored["tensors"]
        start = (tensors[name] for name in ("key_times", "node", "layer"))
        made = cls(*start, neighbours=stored["neighbours"])
        made.load_state_dict(tensors)
        return made


def node_weights(
    apart: Float[Tensor, "N M"], count: int
) -> tuple[Int[Tensor, "N k"], Float[Tensor, "N k"]]:
    """Nearest nodes and their weights from the distances to M nodes [m]; infinite: not this one."""
    near, index = apart.topk(min(count, apart.shape[1]), dim=1, largest=False)
    farthest = near.masked_fill(near.isinf(), 0.0).amax(dim=1, keepdim=True)
    weight = torch.softmax(-2.0 * (near / farthest.clamp_min(1e-9)).square(), dim=1)
    return index, weight.masked_fill(near.isinf(), 0.0)


def interpolated(motion: KeyMotion, rows: Sequence[int], weights: Sequence[float]) -> Displacement:
    """Weighted sum of some rows of a motion at keys."""
    offset, rotation = (
        None
        if values is None
        else torch.stack([w * values[row] for row, w in zip(rows, weights, strict=True)]).sum(0)
        for values in motion
    )
    assert offset is not None
    return Displacement(offset, rotation)


def rows_of(
    table: Shaped[Tensor, "T *n"], keys: Sequence[int] | Int[Tensor, "K"]
) -> Shaped[Tensor, "K *n"]:
    """Rows of a table by their indices, without a synchronisation or upload."""
    if isinstance(keys, Tensor):
        return table.index_select(0, keys)
    return torch.stack([table[key] for key in keys])


def farthest_points(points: Float[Tensor, "N 3"], count: int) -> Int[Tensor, "M"]:
    """Indices of at most ``count`` points, each the farthest from those before it.

    The first is the one nearest to the centroid, so that the choice depends on the points only.
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
