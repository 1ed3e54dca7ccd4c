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
class VolumeSettings:
    """A neural volume."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    """Its networks."""
    scene_flow: SceneFlowSettings = field(default_factory=SceneFlowSettings)
    """How samples move between raw frames."""
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
            "products": Products(stored["products"]),
        }
    )
