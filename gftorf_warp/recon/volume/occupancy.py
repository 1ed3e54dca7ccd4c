"""Where in a volume there is something, and samples placed there.

A grid of cells in the unit cube keeps the largest weight alpha T that samples in a cell had lately,
in whatever raw frame. A cell counts as occupied if it or a neighbour of it has enough. On a ray
with B equal intervals of z-depth, samples are at the quantiles (k + u) / S of

    p = (1 - e) m / sum(m) + e / B,   m = 1 in occupied intervals and 0 elsewhere

and each stands for an interval of depth (far - near) / (B S p). So empty space costs no samples,
and a wrong guess stays visible to the share e of them. A ray without an occupied interval has m =
1.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from .rays import CLOSED, Depths
from .settings import OccupancySettings


class Occupancy(torch.nn.Module):
    """A grid of what was seen."""

    seen: Float[Tensor, "c c c"]
    """Largest weight of late samples [1], by z, y, x."""
    occupied: Float[Tensor, "c c c"]
    """1 where samples are placed, else 0."""

    def __init__(self, settings: OccupancySettings):
        """Begin with all cells occupied."""
        super().__init__()
        self.settings = settings
        shape = [settings.cells] * 3
        self.register_buffer("seen", torch.ones(shape))
        self.register_buffer("occupied", torch.ones(shape))

    @torch.no_grad()
    def note(self, points: Float[Tensor, "R S 3"], weight: Float[Tensor, "B R S"]) -> None:
        """Note weights alpha T [1] of samples at points in the unit cube, of several raw frames."""
        cells = self._cells(points).flatten()
        largest = weight.amax(dim=0).flatten()
        self.seen.view(-1).scatter_reduce_(0, cells, largest, "amax")

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Decide anew what is occupied, if that is due after a step, and forget a little."""
        if (step + 1) % self.settings.update_every == 0:
            if step >= self.settings.warm_up:
                spread = functional.max_pool3d(self.seen[None], 3, stride=1, padding=1)[0]
                self.occupied.copy_(spread > self.settings.least)
            self.seen.mul_(self.settings.kept)

    @torch.no_grad()
    def depths(
        self,
        intervals: Float[Tensor, "R B 3"],
        bounds: tuple[float, float],
        samples: int,
        generator: torch.Generator | None = None,
    ) -> Depths:
        """Samples of rays.

        Args:
            intervals: Middles of B equal intervals of z-depth on every ray, in the unit cube.
            bounds: Where the first begins and the last ends [m].
            samples: Number S of samples of a ray.
            generator: Of u, uniform in [0, 1); None: one half, and e = 0.
        """
        rays, count = intervals.shape[:2]
        mass = self.occupied.view(-1)[self._cells(intervals)]
        total = mass.sum(dim=-1, keepdim=True)
        nothing = total == 0
        share = mass.masked_fill(nothing, 1.0) / total.masked_fill(nothing, float(count))
        if generator is not None:
            share = (1.0 - self.settings.anywhere) * share + self.settings.anywhere / count
        edges = functional.pad(torch.cumsum(share, dim=-1), (1, 0))
        offset = (
            0.5
            if generator is None
            else torch.rand(rays, samples, device=mass.device, generator=generator)
        )
        wanted = torch.linspace(0.0, samples - 1.0, samples, device=mass.device) + offset
        last = edges[:, -1:]  # 1 but for rounding
        wanted = (wanted / samples * last).expand(rays, samples).contiguous()
        cell = torch.searchsorted(edges, wanted, right=True).sub_(1).clamp_(0, count - 1)
        here = share.gather(1, cell).clamp_min(1e-12)
        step = (bounds[1] - bounds[0]) / count
        within = ((wanted - edges.gather(1, cell)) / here).clamp(0.0, 1.0)
        interval = step / (samples * here)
        interval[:, -1].fill_(CLOSED)
        return Depths(z=bounds[0] + step * (cell + within), interval=interval)

    def _cells(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Numbers of the cells of points in the unit cube."""
        count = self.settings.cells
        x, y, z = (points * count).long().clamp_(0, count - 1).unbind(-1)
        return (z * count + y) * count + x
