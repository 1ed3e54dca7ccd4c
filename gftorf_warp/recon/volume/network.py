"""The network of a volume (neural_volumes.md, section 1), and what it gets of the time.

    trunk      layers of ReLU; the encoded position and the time code are joined again after one
    density    linear in the trunk
    light      bottleneck, linear in the trunk; with the encoded direction, one layer of ReLU;
               colour and reflectivity, linear in it
    blend      linear in the trunk: how much of a point is what moves
    flow       tanh of a linear one: where a point goes and comes from within a cycle

The product with a joined input is the sum of the products with its parts, so that a time code,
which all points of a time share, is multiplied once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from ...scene.encoding import encoded, encoded_size, powers_of_two
from .product import linear, precision_of
from .settings import NetworkSettings, TimeCode

FLOW_DEVIATION = 1e-5  # of the initial weights of the flow: nothing moves
CODE_DEVIATION = 0.01 / 16  # of learnt time codes at the start, as published
ALIGNED = 8  # [columns] rows of half-precision products are multiples of it


class Light(NamedTuple):
    """What a point sends to the camera."""

    reflectivity: Float[Tensor, "*n"]
    """Of the light source [m^2 in optimised units, over the falloff]."""
    colour: Float[Tensor, "*n 3"]
    """Linear RGB [1]."""


class VolumeNetwork(torch.nn.Module):
    """Density, light, blend and flow of points at T times."""

    position_powers: Float[Tensor, "f"]
    direction_powers: Float[Tensor, "f"]

    def __init__(self, settings: NetworkSettings, code_size: int, generator: torch.Generator):
        """Create the network with random weights.

        Args:
            settings: Its shape.
            code_size: Values of a time code, 0 for a network without time.
            generator: For the weights, on the CPU.
        """
        super().__init__()
        self.settings = settings
        self._columns = -(-encoded_size(3, settings.position_octaves) // ALIGNED) * ALIGNED
        directions = encoded_size(3, settings.direction_octaves)
        width, half = settings.width, settings.width // 2
        joined = [k for k in (0, settings.skip_after) if k < settings.layers]
        self.hidden = torch.nn.ModuleDict(
            {str(k): torch.nn.Linear(width, width) for k in range(1, settings.layers)}
        )
        self.entry = torch.nn.ModuleDict(
            {str(k): torch.nn.Linear(self._columns, width, bias=k == 0) for k in joined}
        )
        self.time = torch.nn.ModuleDict(
            {str(k): torch.nn.Linear(code_size, width, bias=False) for k in joined if code_size}
        )
        self.density_head = torch.nn.Linear(width, 1)
        self.bottleneck = torch.nn.Linear(width, width)
        self.seen = torch.nn.Linear(width, half)
        self.seen_from = torch.nn.Linear(directions, half, bias=False)
        self.light_head = torch.nn.Linear(half, 4)
        self.blend_head = torch.nn.Linear(width, 1)
        self.flow_head = torch.nn.Linear(width, 6)
        # an upload in every step would make a GPU wait
        octaves = settings.position_octaves, settings.direction_octaves
        for name, count in zip(("position_powers", "direction_powers"), octaves, strict=True):
            self.register_buffer(name, powers_of_two(count), persistent=False)
        self._reset(generator)

    @torch.no_grad()
    def _reset(self, generator: torch.Generator) -> None:
        """Glorot's uniform weights, Keras' default; layers whose outputs are added are one."""
        added: list[list[torch.nn.Module]] = [[self.seen, self.seen_from]]
        for k in range(self.settings.layers):
            groups = (self.entry, self.time, self.hidden)
            added.append([group[str(k)] for group in groups if str(k) in group])
        added += [[head] for head in (self.density_head, self.bottleneck, self.light_head)]
        added += [[self.blend_head], [self.flow_head]]
        for parts in added:
            layers = [part for part in parts if isinstance(part, torch.nn.Linear)]
            inputs = sum(layer.in_features for layer in layers)
            for layer in layers:
                reset(layer, inputs, generator, still=layer is self.flow_head)

    def trunk(
        self, points: Float[Tensor, "T P 3"], codes: Float[Tensor, "T C"] | None
    ) -> Float[Tensor, "T P w"]:
        """Values of points, in the units of the network, each at the time of its row."""
        dtype = precision_of(points)
        known = encoded(points, self.position_powers, columns=self._columns, dtype=dtype)
        values = self._joined("0", known, codes, relu=True)
        for name, layer in self.hidden.items():
            assert isinstance(layer, torch.nn.Linear)
            joined = None
            if name in self.entry:
                joined = self._joined(name, known, codes, layer.bias)
            values = linear(layer, values, joined, relu=True)
        return values

    def _joined(
        self,
        name: str,
        known: Float[Tensor, "T P e"],
        codes: Float[Tensor, "T C"] | None,
        bias: Float[Tensor, "w"] | None = None,
        *,
        relu: bool = False,
    ) -> Float[Tensor, "T P w"]:
        """The product of a layer with encoded positions and time codes, plus a bias: its own, or
        that of what it is added to.
        """
        entry = self.entry[name]
        assert isinstance(entry, torch.nn.Linear)
        bias = entry.bias if bias is None else bias
        biases = bias if codes is None else self.time[name](codes) + bias
        return linear(entry, known, biases, relu=relu)

    def density(self, trunk: Float[Tensor, "*n w"]) -> Float[Tensor, "*n"]:
        """Density before its ReLU [1/m]."""
        return self.density_head(trunk)[..., 0].float()

    def light(self, trunk: Float[Tensor, "*b R S w"], direction: Float[Tensor, "R 3"]) -> Light:
        """Light of samples of rays in directions of length 1."""
        seen_from = self.seen_from(encoded(direction, self.direction_powers))
        seen = linear(self.seen, linear(self.bottleneck, trunk)) + seen_from[:, None]
        light = self.light_head(functional.relu(seen)).float()
        return Light(light[..., 0].abs(), torch.sigmoid(light[..., 1:]))

    def blend(self, trunk: Float[Tensor, "*n w"]) -> Float[Tensor, "*n"]:
        """Share of what moves [1]."""
        return torch.sigmoid(self.blend_head(trunk)[..., 0].float())

    def flow(self, trunk: Float[Tensor, "*n w"], reach: float) -> Float[Tensor, "*n 2 3"]:
        """Displacement to the next quartet and to the one before [m], at most ``reach`` each."""
        flow = reach * torch.tanh(self.flow_head(trunk).float())
        return flow.unflatten(-1, (2, 3))


@torch.no_grad()
def reset(
    layer: torch.nn.Linear, inputs: int, generator: torch.Generator, *, still: bool = False
) -> None:
    """Glorot's uniform weights and no bias.

    Args:
        layer: Is changed in place.
        inputs: Of it and of the layers whose outputs are added to its own.
        generator: Of random numbers, on the CPU.
        still: Nearly zero weights instead, of a flow where nothing moves.
    """
    bound = math.sqrt(6.0 / (inputs + layer.out_features))
    drawn = torch.empty(layer.weight.shape)  # on the CPU, like the generator
    if still:
        drawn.normal_(0.0, FLOW_DEVIATION, generator=generator)
    else:
        drawn.uniform_(-bound, bound, generator=generator)
    layer.weight.copy_(drawn)
    if layer.bias is not None:
        layer.bias.zero_()


class TimeCodes(torch.nn.Module):
    """What a network gets of the time of a quartet."""

    def __init__(
        self,
        settings: NetworkSettings,
        frames: int,
        cycle: int,
        generator: torch.Generator,
    ):
        """Create the codes.

        Args:
            settings: Kind and size.
            frames: Number F of raw frames.
            cycle: Number K of them in a quartet.
            generator: For learnt codes, on the CPU.
        """
        super().__init__()
        self.learnt = settings.time_code == TimeCode.LEARNT
        if self.learnt:
            drawn = torch.randn(-(-frames // cycle), settings.time_values, generator=generator)
            self.values = torch.nn.Parameter(CODE_DEVIATION * drawn)
        else:
            times = (torch.arange(0, frames, cycle) + 1.0) / frames
            self.register_buffer("values", encoded(times[:, None], settings.time_octaves))

    @property
    def size(self) -> int:
        """Values C of a code."""
        return self.values.shape[1]

    def forward(self, quartets: Int[Tensor, "T"]) -> Float[Tensor, "T C"]:
        """Codes of some quartets."""
        codes = self.values.index_select(0, quartets)
        return functional.normalize(codes, dim=-1) if self.learnt else codes
