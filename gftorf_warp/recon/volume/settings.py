"""How a neural volume is sampled, parametrised and optimised.

Lengths of a run count training steps, which ``schedule.images`` counts too: one batch of rays.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Any

from ...scene.motion import Products

PUBLISHED_STEPS = 400_000  # of ftorf; torf's release has five times as many


class TimeCode(enum.StrEnum):
    """What a network gets of the time."""

    POSITIONAL = "positional"
    """The encoded number of the raw frame, divided by their count."""
    LEARNT = "learnt"
    """Values of every quartet that are optimised, of length 1."""


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """The networks of a volume, of one shape."""

    layers: int = 8
    """Layers with ReLU before the density."""
    width: int = 256
    """Values of each; the layer that sees the direction has half as many."""
    skip_after: int = 5
    """The input is joined again after so many layers; not if there are no more."""
    position_octaves: int = 10
    """Frequencies in the encoding of positions."""
    direction_octaves: int = 4
    """Frequencies in the encoding of directions."""
    time_code: TimeCode = TimeCode.POSITIONAL
    """What the network of what moves gets of the time."""
    time_octaves: int = 6
    """Frequencies in the encoding of times, if positional."""
    time_values: int = 256
    """Values per quartet, if learnt."""
    static: bool = False
    """Whether a second network, which knows no time, is blended in."""

    def __post_init__(self):
        for name in ("layers", "width"):
            if getattr(self, name) < 2:
                raise ValueError(f"{name} must be at least 2, got {getattr(self, name)}")
        if self.skip_after < 1:
            raise ValueError(f"skip_after must be at least 1, got {self.skip_after}")


@dataclass(frozen=True, kw_only=True)
class SceneFlowSettings:
    """The 3D flow between quartets of method ``ftorf``, and its regularisers."""

    simultaneous_share: float = 0.0625
    """Share of the run in which the raw frames of a quartet count as simultaneous, and nothing
    flows [1]."""
    size: float = 1e-3
    """Weight of the mean absolute flow [1/m]."""
    kinetic: float = 1e-3
    """Weight of half the squared sum of forward and backward flow [1/m^2]: a path that is straight
    has none."""
    kinetic_share: float = 0.9
    """Share of the samples of a ray, from the camera on, to which ``kinetic`` applies [1]."""
    round_trip: float = 1e-4
    """Weight of the gap after a flow and the flow back [1/m]."""
    vanishes_at: int = 10_000_000
    """The weight of the optical flow falls linearly to 0 at this step."""


@dataclass(frozen=True, kw_only=True)
class OccupancySettings:
    """Which of its space method ``volume`` samples."""

    cells: int = 128
    """Cells along an axis of the grid that says where there is something."""
    least: float = 3e-3
    """Largest weight alpha T of late samples in a cell from which it counts as occupied [1]."""
    kept: float = 0.8
    """Share of that weight which is left at each update of the grid [1]."""
    update_every: int = 32
    """Steps between two updates."""
    warm_up: int = 256
    """Steps in which all of space is sampled alike."""
    anywhere: float = 0.1
    """Share of the samples of a ray that are placed without regard to it while training [1]."""

    def __post_init__(self):
        if self.cells < 2 or self.update_every < 1:
            raise ValueError("occupancy.cells must be at least 2, occupancy.update_every 1")
        if not (0 <= self.anywhere < 1 and 0 < self.kept < 1):
            raise ValueError("occupancy.anywhere must be in [0, 1), occupancy.kept in (0, 1)")


@dataclass(frozen=True, kw_only=True)
class GridSettings:
    """The hash grids of method ``volume``. Level k of a grid has
    ``coarsest * growth^k`` cells along every axis, rounded down.
    """

    levels: int = 12
    """Levels of the grid that knows no time."""
    moving_levels: int = 8
    """Levels of the grid that every quartet has; its finest is that many levels up."""
    flow_levels: int = 8
    """Levels of the grid of the scene flow, which every quartet has."""
    coarsest: int = 16
    """Cells along an axis of the coarsest level; half of it for the scene flow."""
    growth: float = 1.45
    """Cells along an axis from one level to the next [1]."""
    flow_growth: float = 1.3
    """The same for the scene flow."""
    flow_rate: float = 0.01
    """Factor in front of the last layer of the scene flow, by which it learns more slowly [1]."""
    rows_log2: int = 19
    """Rows of a level at most, as a power of two; more vertices share them."""
    width: int = 64
    """Values of the layers of the networks."""
    values: int = 16
    """Values of a point from which its density and light follow."""
    at_rest: float = 1e-2
    """Weight of the mean squared feature of the grid that every quartet has: what rests is left to
    the grid that knows no time."""
    density: float = 0.3
    """Density at the start [1/m]."""
    occupancy: OccupancySettings = field(default_factory=OccupancySettings)
    """Where samples are."""
    beside: int | None = 1
    """Raw frames before the start of a quartet, and as many after it, that a step compares, at
    random; None: all."""

    def __post_init__(self):
        for name in ("levels", "moving_levels", "flow_levels", "width"):
            if getattr(self, name) < 1:
                raise ValueError(f"grid.{name} must be at least 1, got {getattr(self, name)}")
        if self.coarsest < 2 or self.values < 2:
            raise ValueError("grid.coarsest and grid.values must be at least 2")
        if not (self.growth > 1 and self.flow_growth > 1 and self.density > 0):
            raise ValueError("grid.growth and grid.flow_growth must exceed 1, grid.density 0")
        if not 4 <= self.rows_log2 <= 24:
            raise ValueError(f"grid.rows_log2 must be from 4 to 24, got {self.rows_log2}")
        if self.beside is not None and self.beside < 1:
            raise ValueError(f"grid.beside must be at least 1, got {self.beside}")


@dataclass(frozen=True, kw_only=True)
class VolumeSettings:
    """A neural volume."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    """Its networks."""
    scene_flow: SceneFlowSettings = field(default_factory=SceneFlowSettings)
    """How samples move between raw frames."""
    grid: GridSettings | None = None
    """Hash grids, of method ``volume``, which has only the direction of ``network``; None: of no
    other."""
    rays: int = 256
    """Rays of a step, of random pixels of one raw frame."""
    accumulated: int = 4
    """Steps whose gradients are averaged for one update."""
    samples: int = 128
    """Samples of a ray, uniform in z-depth."""
    bounds: tuple[float, float] | None = None
    """z-depths of the first and the last sample [m]; None: 0.9 of the smallest and 1.1 of the
    largest decoded one."""
    falloff: float = 4.0
    """Length of the phasor of reflectivity 1 at 1 m [optimised units m^2]."""
    density_noise: float = 1.0
    """Standard deviation of the noise on densities before their ReLU, while training [1/m]."""
    rate: float = 2e-4
    """Learning rate of Adam at the start."""
    rate_tenth_after: int = 1_000_000
    """Steps after which it is a tenth; the logarithm is linear."""
    gradient_max: float | None = 1.0
    """Each derivative is clipped to this; None: any."""
    epsilon: float = 1e-7
    """Of Adam, Keras' default: added to the root of the mean squared derivative."""
    quads_fall_at: int | None = None
    """From this step on the weight of quads or phasors is a tenth; None: never."""
    products: Products = Products.FLOAT32
    """Precision of matrix products; ``half`` is for GPUs."""

    def __post_init__(self):
        for name in ("rays", "accumulated"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.samples < 2:
            raise ValueError(f"samples must be at least 2, got {self.samples}")
        if self.bounds is not None and not 0 < self.bounds[0] < self.bounds[1]:
            raise ValueError(f"bounds must be 0 < near < far, got {self.bounds}")


def settings_of(stored: dict[str, Any]) -> VolumeSettings:
    """Settings as config.json holds them.

    Raises:
        KeyError: If one is missing.
        TypeError: If one is unknown.
        ValueError: If one has a value that is none.
    """
    network = stored["network"] | {"time_code": TimeCode(stored["network"]["time_code"])}
    bounds = stored.get("bounds")
    return VolumeSettings(
        **stored
        | {
            "bounds": None if bounds is None else tuple(bounds),
            "network": NetworkSettings(**network),
            "scene_flow": SceneFlowSettings(**stored["scene_flow"]),
            "grid": _grid_of(stored.get("grid")),
            "products": Products(stored["products"]),
        }
    )


def _grid_of(stored: dict[str, Any] | None) -> GridSettings | None:
    if stored is None:
        return None
    stored = {"flow_rate": 1.0} | stored  # of runs that do not state it
    if (rate := stored.pop("moving_rate", 1.0)) != 1.0:
        raise ValueError(f"grid.moving_rate was removed and is 1 now, found {rate}")
    return GridSettings(**stored | {"occupancy": OccupancySettings(**stored["occupancy"])})
