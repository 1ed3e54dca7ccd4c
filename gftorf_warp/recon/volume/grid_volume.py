"""Method ``volume``: a neural volume of our own, the cheap twin of ``ftorf`` (neural_volumes.md,
section 5).

Losses and scene flow are those of ``ftorf``. Instead of one large network there are hash grids with
small layers behind them, and samples are placed where there is something. Grids are in perspective
coordinates of the mean camera, so that a cell covers as many pixels near as far:

    u = (x / z, y / z) / (2 spread) + 1/2,   (z - near) / (far - near)

A grid without time is joined by one of each quartet, which is pulled towards zero: what rests is
told by all quartets together. A step compares a few raw frames beside the start of a quartet, at
random, where ``ftorf`` compares all. design/volumes.md has the reasons.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..settings import Method, ReconSettings
from . import composite
from .composite import Samples
from .ftorf import Ftorf
from .grid_network import GridNetwork
from .occupancy import Occupancy
from .rays import Depths, Rays
from .settings import GridSettings
from .targets import Around, Draw
from .volume import Field

MARGIN = 1.05  # [1] the grids reach beyond the outermost rays, for what flows out of them


class GridVolume(Ftorf):
    """A volume of hash grids that moves between quartets."""

    method = Method.VOLUME
    faithful: ClassVar[tuple[str, ...]] = ()
    assumed: ClassVar[tuple[str, ...]] = (
        "a neural volume of our own, after no publication; losses and scene flow are those of "
        "ftorf",
        "hash grids and small layers, samples where there is something: not the networks of TöRF "
        "or F-TöRF",
        "a step compares some of the raw frames beside a quartet start, at random",
    )
    scale: Float[Tensor, "2"]
    """Unit cube per x / z and y / z [1]."""

    def build(self, generator: torch.Generator) -> None:
        """Create grids and layers."""
        quartets = len(self.box.quartet_times)
        octaves = self.settings.network.direction_octaves
        self.field = GridNetwork(self.grid, quartets, octaves, generator)
        self.occupancy = Occupancy(self.grid.occupancy)
        # an upload in every step would make a GPU wait
        scale = 0.5 / (MARGIN * torch.tensor(self.box.spread).clamp_min(1e-6))
        self.register_buffer("scale", scale, persistent=False)

    @property
    def grid(self) -> GridSettings:
        """The shape of its grids."""
        assert self.settings.grid is not None, "settings of method volume have it"
        return self.settings.grid

    def unit(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Points [m] in the unit cube, and beyond it."""
        near, far = self.box.bounds
        z = points[..., 2:]
        across = points[..., :2] / z.clamp_min(0.5 * near) * self.scale + 0.5
        return torch.cat([across, (z - near) / (far - near)], dim=-1)

    def depths(self, rays: Rays, draw: Draw | None = None) -> Depths:
        """Samples where there is something."""
        near, far = self.box.bounds
        count = self.grid.occupancy.cells
        half = 0.5 * (far - near) / count
        middles = torch.linspace(near + half, far - half, count, device=rays.origin.device)
        z = middles.expand(len(rays.origin), count)
        random = None if draw is None else draw.device
        intervals = self.unit(rays.at(z))
        return self.occupancy.depths(intervals, self.box.bounds, self.settings.samples, random)

    def compared(self, around: Around, draw: Draw) -> Around:
        """A few raw frames in a row before the start, and after it."""
        return around.some(self.grid.beside, draw)

    def trunk(
        self, points: Float[Tensor, "T R S 3"], quartets: Int[Tensor, "T"]
    ) -> Float[Tensor, "T R S v"]:
        """Values of points [m], each row at its quartet."""
        unit, shape = self.unit(points).flatten(1, 2), points.shape[1:3]
        return self.field.trunk(unit, quartets).unflatten(1, shape)

    def values_and_flow(
        self, points: Float[Tensor, "T R S 3"], quartets: Int[Tensor, "T"], seen: int, flowing: int
    ) -> tuple[Float[Tensor, "t R S v"], Float[Tensor, "u R S 2 3"]]:
        """Values of some rows and scene flow [m] of some, each of grids of their own."""
        unit, shape = self.unit(points).flatten(1, 2), points.shape[1:3]
        values = self.field.trunk(unit[:seen], quartets[:seen])
        flow = self.field.flow(unit[flowing:], quartets[flowing:], self.box.reach)
        return values.unflatten(1, shape), flow.unflatten(1, shape)

    def samples(
        self,
        trunk: Float[Tensor, "*b R S v"],
        rays: Rays,
        depths: Depths,
        *,
        draw: Draw | None = None,
        colour: bool = False,
        network: Field | None = None,
    ) -> Samples:
        """What the grids put on rays."""
        network_used = self.field if network is None else network
        return super().samples(trunk, rays, depths, draw=draw, colour=colour, network=network_used)

    def more_terms(
        self,
        rays: Rays,
        depths: Depths,
        samples: Samples,
        settings: ReconSettings,
    ) -> dict[str, Tensor]:
        """What changes from quartet to quartet, and the distortion of rays; notes what is seen."""
        passed = samples.transmittance
        weight = (samples.alpha * passed).detach()
        self.occupancy.note(self.unit(rays.at(depths.z)), weight)
        terms = {"at_rest": self.grid.at_rest * self.field.moving.table.square().mean()}
        if settings.weights.distortion > 0:
            spread = composite.distortion(samples, passed).mean()
            terms["distortion"] = settings.weights.distortion * spread
        return terms

    def after(self, step: int) -> None:
        """Update where samples are."""
        self.occupancy.update(step)
