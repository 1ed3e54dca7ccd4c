"""A neural volume: networks in a box of space, and the samples that they put on rays."""

from __future__ import annotations

import abc
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...scene.motion import Products
from ..settings import Method, ReconSettings
from . import composite
from .choice import Choice, Given
from .composite import Samples
from .network import Light, TimeCodes, VolumeNetwork
from .rays import Depths, Rays, evenly
from .settings import VolumeSettings
from .targets import Draw, Targets

NOTED = ("quad_mse", "opacity")
"""What a step notes besides the terms of its loss: the unweighted error, and the mean opacity."""
SCALED = (2.0, 2.0, 1.0)  # [1] x, y and z over the depth of the box, as published


@dataclass(frozen=True, kw_only=True)
class Box:
    """Where and when a volume is."""

    bounds: tuple[float, float]
    """z-depths of the first and the last sample of a ray [m]."""
    volume_from_world: list[list[float]]
    """Pose of its axes, 4x4."""
    quartet_times: list[float]
    """Time of the first raw frame of every quartet [s]."""
    quartets: list[int]
    """Quartets whose raw frames were all measured."""
    period: float
    """Duration of a quartet [s]."""
    frames: int
    """Number F of raw frames."""
    cycle: int
    """Number K of raw frames in a quartet."""
    reach: float
    """Largest displacement within a quartet [m]: the unambiguous range."""
    colour: bool
    """Whether it has colour."""
    spread: tuple[float, float] = (0.0, 0.0)
    """Largest |x / z| and |y / z| in it [1], of a volume with grids."""
    simultaneous: bool = False
    """Whether the raw frames of a quartet are of one instant: the camera delivered phasors."""


class Field(Protocol):
    """A network, as far as its samples are concerned."""

    def density(self, trunk: Float[Tensor, "*n w"]) -> Float[Tensor, "*n"]:
        """Density before its ReLU [1/m]."""

    def light(self, trunk: Float[Tensor, "*b R S w"], direction: Float[Tensor, "R 3"]) -> Light:
        """Light of samples of rays in directions of length 1."""


class Volume(torch.nn.Module, abc.ABC):
    """Networks in a box. Final classes: Torf, Ftorf, GridVolume."""

    method: ClassVar[Method]
    faithful: ClassVar[tuple[str, ...]]
    """What is as published, in sentences."""
    assumed: ClassVar[tuple[str, ...]]
    """What was not published, or is done in another way, in sentences."""
    axis_scale: Float[Tensor, "3"]
    """``SCALED`` on the device."""
    numbers: Int[Tensor, "Q"]
    """Numbers of the quartets on the device, int32."""

    def __init__(self, settings: VolumeSettings, box: Box, generator: torch.Generator):
        """Create random networks.

        Args:
            settings: How the volume is sampled.
            box: Where it is.
            generator: For the weights, on the CPU.

        Raises:
            ValueError: If ``network.static`` does not fit the method.
        """
        super().__init__()
        if settings.network.static != (self.method == Method.TORF):
            raise ValueError(
                f"network.static is {settings.network.static}, but torf has a network without "
                f"time and ftorf has none"
            )
        self.settings, self.box = settings, box
        # an upload in every step would make a GPU wait
        self.register_buffer("axis_scale", torch.tensor(SCALED), persistent=False)
        numbers = torch.arange(len(box.quartet_times), dtype=torch.int32)
        self.register_buffer("numbers", numbers, persistent=False)
        self.build(generator)

    def build(self, generator: torch.Generator) -> None:
        """Create its networks with random weights."""
        network, box = self.settings.network, self.box
        self.codes = TimeCodes(network, box.frames, box.cycle, generator)
        self.moving = VolumeNetwork(network, self.codes.size, generator)
        self.resting = VolumeNetwork(network, 0, generator) if network.static else None

    @abc.abstractmethod
    def choice(self, targets: Targets, step: int, settings: ReconSettings, draw: Draw) -> Choice:
        """What one step works on, decided on the host."""

    @abc.abstractmethod
    def terms(
        self, targets: Targets, key: Any, given: Given, settings: ReconSettings, draw: Draw
    ) -> dict[str, Tensor]:
        """Weighted terms of the loss of one step; of light that was compared, what ``NOTED`` names.

        Captured as a CUDA graph: the key decides about operations, whatever else differs between
        steps is on the device.

        Args:
            targets: What is compared.
            key: Of a :meth:`choice`.
            given: Its numbers.
            settings: Of the run.
            draw: Random numbers, of which only those on the device may be drawn here.
        """

    def after(self, step: int) -> None:
        """What is due after a step besides gradients: nothing."""

    def quartet(self, number: int) -> Int[Tensor, "1"]:
        """The number of a quartet on the device."""
        return self.numbers[number : number + 1]

    @abc.abstractmethod
    def samples_at(self, time: float, rays: Rays, depths: Depths) -> Samples:
        """Samples of rays at any time [s]."""

    @property
    def device(self) -> torch.device:
        """Where its parameters are."""
        return self.axis_scale.device

    def precision(self) -> torch.autocast:
        """Context of all products of the networks."""
        half = self.settings.products == Products.HALF
        return torch.autocast(self.device.type, dtype=torch.float16, enabled=half)

    def unit(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Points [m] in the units of the networks."""
        near, far = self.box.bounds
        return 2.0 * (points * (self.axis_scale / (far - near)) - 0.5)

    def depths(self, rays: Rays, draw: Draw | None = None) -> Depths:
        """Where the samples of rays are; at random within their cells if numbers are drawn."""
        random, count = None if draw is None else draw.device, self.settings.samples
        return evenly(self.box.bounds, len(rays.origin), count, rays.origin.device, random)

    def trunk(
        self, points: Float[Tensor, "T R S 3"], quartets: Int[Tensor, "T"]
    ) -> Float[Tensor, "T R S w"]:
        """Values of the moving network at points [m], each row at the time of its quartet."""
        flat = self.unit(points).flatten(1, 2)
        return self.moving.trunk(flat, self.codes(quartets)).unflatten(1, points.shape[1:3])

    def samples(
        self,
        trunk: Float[Tensor, "*b R S w"],
        rays: Rays,
        depths: Depths,
        *,
        draw: Draw | None = None,
        colour: bool = False,
        network: Field | None = None,
    ) -> Samples:
        """What a network puts on rays.

        Args:
            trunk: Its values at the points of the samples, perhaps several for each.
            rays: The rays.
            depths: Where the samples are.
            draw: Adds noise to densities; None: none.
            colour: Whether colour is wanted.
            network: Whose values these are; None: of the one that moves.
        """
        network = self.moving if network is None else network
        length = rays.length
        distance = depths.z * length[:, None]
        raw = network.density(trunk)
        if draw is not None and self.settings.density_noise > 0:
            raw = raw + draw.noise(raw, self.settings.density_noise)
        alpha = composite.opacities(raw, depths.interval, length)
        light = network.light(trunk, rays.direction / length[:, None])
        strength = alpha * light.reflectivity * self.settings.falloff / distance.square()
        return Samples(
            distance=distance,
            alpha=alpha,
            strength=strength,
            colour=alpha[..., None] * light.colour if colour else None,
        )

    @torch.no_grad()
    def noted(self, mse: Tensor, samples: Samples) -> dict[str, Tensor]:
        """What ``NOTED`` names, without gradients."""
        opacity = composite.opacity(samples, samples.transmittance).mean()
        return dict(zip(NOTED, (mse.detach(), opacity), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Plain values and tensors, for a checkpoint."""
        weights = {name: value.detach() for name, value in self.state_dict().items()}
        return {"box": asdict(self.box), "weights": weights}


def box_of(targets: Targets, settings: VolumeSettings) -> Box:
    """Where the volume of a recording is."""
    sequence, times = targets.observations.sequence, targets.quartet_times
    period = times[1] - times[0] if len(times) > 1 else float(np.ptp(sequence.times)) or 1.0
    bounds = settings.bounds or targets.bounds()
    views = [targets.views] + ([] if targets.colour_views is None else [targets.colour_views])
    spreads = [(0.0, 0.0)] if settings.grid is None else [each.spread(bounds) for each in views]
    return Box(
        bounds=bounds,
        spread=(max(x for x, _ in spreads), max(y for _, y in spreads)),
        volume_from_world=targets.volume_from_world.tolist(),
        quartet_times=times,
        quartets=sequence.complete_quartets,
        period=period,
        frames=sequence.frames,
        cycle=targets.cycle,
        reach=targets.observations.sensor.unambiguous_range,
        colour=targets.colour is not None,
        simultaneous=sequence.from_phasors,
    )
