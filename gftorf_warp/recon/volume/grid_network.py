"""The network of method ``volume``: hash grids, and small layers behind them.

features   of a grid without time and of a grid of the quartet, joined
trunk      one layer of ReLU and a linear one: density, and what light follows from
density    exp of the first value of the trunk
light      one layer of ReLU of trunk and encoded direction; colour and reflectivity, linear in it
flow       of a coarser grid of the quartet: one layer of ReLU, tanh of a linear one
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from ...render.hash_grid import Levels, interpolated, levels_of
from ...scene.encoding import encoded, encoded_size, powers_of_two
from .network import ALIGNED, Light, reset
from .settings import GridSettings

FEATURE = 1e-4  # [1] features at the start are uniform up to this, as by Mueller et al.
LARGEST = 11.0  # [log 1/m] of densities: 60,000 / m


class HashGrid(torch.nn.Module):
    """A table of features, and the levels that it belongs to."""

    cells: Int[Tensor, "L"]
    starts: Int[Tensor, "L"]
    rows: Int[Tensor, "L"]

    def __init__(self, cells: list[int], times: int, rows_log2: int, generator: torch.Generator):
        """Create random features.

        Args:
            cells: Cells along an axis of each level.
            times: Number of times, each with features of its own.
            rows_log2: Rows of a level at most, as a power of two.
            generator: For the features, on the CPU.
        """
        super().__init__()
        levels, rows = levels_of(cells, times, 2**rows_log2)
        self.times = times
        for name in ("cells", "starts", "rows"):
            self.register_buffer(name, getattr(levels, name), persistent=False)
        drawn = torch.rand(rows, 2, generator=generator)
        self.table = torch.nn.Parameter(FEATURE * (2.0 * drawn - 1.0))

    @property
    def features(self) -> int:
        """Features of a point."""
        return 2 * len(self.cells)

    def forward(
        self, points: Float[Tensor, "T P 3"], times: Int[Tensor, "T"]
    ) -> Float[Tensor, "T P f"]:
        """Features of points in the unit cube, each row at a time."""
        levels = Levels(self.cells, self.starts, self.rows, self.times)
        return interpolated(points, times, self.table, levels)


class GridNetwork(torch.nn.Module):
    """Density, light and flow of points in the unit cube, at the quartets of a recording."""

    direction_powers: Float[Tensor, "f"]
    never: Int[Tensor, "1"]
    """The one time of the grid without time."""

    def __init__(
        self,
        settings: GridSettings,
        quartets: int,
        octaves: int,
        generator: torch.Generator,
    ):
        """Create the network with random weights.

        Args:
            settings: Its shape.
            quartets: Number of quartets.
            octaves: Frequencies in the encoding of directions.
            generator: For the weights, on the CPU.
        """
        super().__init__()
        self.flow_rate = settings.flow_rate

        def grid(levels: int, coarsest: int, growth: float, times: int) -> HashGrid:
            cells = [int(coarsest * growth**k) for k in range(levels)]
            return HashGrid(cells, times, settings.rows_log2, generator)

        coarsest, growth, width = settings.coarsest, settings.growth, settings.width
        self.resting = grid(settings.levels, coarsest, growth, 1)
        self.moving = grid(settings.moving_levels, coarsest, growth, quartets)
        flowing = max(1, coarsest // 2), settings.flow_growth
        self.flowing = grid(settings.flow_levels, *flowing, quartets)
        joined = self.resting.features + self.moving.features
        self.columns = -(-encoded_size(3, octaves) // ALIGNED) * ALIGNED
        self.hidden = torch.nn.Linear(joined, width)
        self.trunk_head = torch.nn.Linear(width, settings.values)
        self.seen = torch.nn.Linear(settings.values, width)
        self.seen_from = torch.nn.Linear(self.columns, width, bias=False)
        self.light_head = torch.nn.Linear(width, 4)
        self.flow_hidden = torch.nn.Linear(self.flowing.features, width)
        self.flow_head = torch.nn.Linear(width, 6)
        # an upload in every step would make a GPU wait
        self.register_buffer("direction_powers", powers_of_two(octaves), persistent=False)
        self.register_buffer("never", torch.zeros(1, dtype=torch.int32), persistent=False)
        self._reset(settings, generator)

    @torch.no_grad()
    def _reset(self, settings: GridSettings, generator: torch.Generator) -> None:
        """Glorot's uniform weights; the same density everywhere, and nothing moves."""
        for layer in self.modules():
            if isinstance(layer, torch.nn.Linear):
                reset(layer, layer.in_features, generator, still=layer is self.flow_head)
        self.trunk_head.bias[0] = math.log(settings.density)

    def trunk(
        self, points: Float[Tensor, "T P 3"], times: Int[Tensor, "T"]
    ) -> Float[Tensor, "T P v"]:
        """Values of points, each row at the quartet of that number."""
        resting = self.resting(points.flatten(0, 1)[None], self.never).unflatten(
            1, points.shape[:2]
        )[0]
        features = torch.cat([resting, self.moving(points, times)], dim=-1)
        return self.trunk_head(functional.relu(self.hidden(features)))

    def density(self, trunk: Float[Tensor, "*n v"]) -> Float[Tensor, "*n"]:
        """Density [1/m]."""
        return torch.exp(trunk[..., 0].float().clamp_max(LARGEST))

    def light(self, trunk: Float[Tensor, "*b R S v"], direction: Float[Tensor, "R 3"]) -> Light:
        """Light of samples of rays in directions of length 1."""
        known = encoded(direction, self.direction_powers, columns=self.columns)
        seen = functional.relu(self.seen(trunk) + self.seen_from(known)[:, None])
        light = self.light_head(seen).float()
        return Light(functional.softplus(light[..., 0]), torch.sigmoid(light[..., 1:]))

    def flow(
        self, points: Float[Tensor, "T P 3"], times: Int[Tensor, "T"], reach: float
    ) -> Float[Tensor, "T P 2 3"]:
        """Displacement to the next quartet and to the one before [m], at most ``reach`` each."""
        hidden = functional.relu(self.flow_hidden(self.flowing(points, times)))
        flow = reach * torch.tanh(self.flow_rate * self.flow_head(hidden).float())
        return flow.unflatten(-1, (2, 3))
