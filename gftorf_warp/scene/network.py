"""Motion as a network of position and time: one multi-layer perceptron gives the offset of every Gaussian at every key.

    delta(x, t) = head(layers([gamma(x), gamma(t)])),   gamma(v) = [v, sin 2^0 v, cos 2^0 v, .., sin 2^9 v, cos 2^9 v]

Layers end in a ReLU (method, section 4). Positions are divided by a length and enter without gradient; t runs from 0 at
the first raw frame to 1 at the last. The encoded input is joined to the output of the fifth layer again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .encoding import encoded, encoded_size, powers_of_two
from .gaussians import GaussianField
from .motion import KeyMotion, Motion, MotionSettings, MotionStart, Products, rows_of

HEAD_DEVIATION = 1e-5  # of the weights of the last layer: motion starts at rest, to a hundredth of a millimetre


class Backend(Protocol):
    """Computes a network in another way; ``render.network`` has those for half precision."""

    def encode(self, network: Network, mean: Float[Tensor, "N 3"]) -> Float[Tensor, "N p"]:
        """gamma(x) of positions [m], without gradient."""
        ...

    def offsets(
        self, network: Network, binding: Float[Tensor, "N p"], moment: Float[Tensor, "k t"]
    ) -> Float[Tensor, "k N 3"]:
        """Displacements [m] at times given as gamma(t), differentiable in the parameters."""
        ...


class Network(Motion):
    """Key offsets from a perceptron that knows nothing of single Gaussians: whoever is at a place moves with it."""

    kind = "network"
    follows_means = True
    moments: Tensor  # [T, t] float64, gamma(t) of every key; of the key times, so it is not stored
    rounded: Tensor  # [T, t] the same for parameters in float32, so that a step converts nothing; not stored either
    powers: Tensor  # [F] 2^0, 2^1, .. of the positions; not stored either

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        settings: MotionSettings,
        *,
        duration: float,
        length: float,
        generator: torch.Generator | None = None,
    ):
        """Draw the weights.

        Args:
            key_times: Start of every quartet and the time one quartet after the last start [s].
            settings: Layers, width and frequencies.
            duration: Time from the first raw frame to the last [s]; key times divided by it enter the network.
            length: Positions divided by this enter the network [m].
            generator: For the weights, on the CPU.

        Raises:
            ValueError: If duration or length is not above 0.
        """
        super().__init__(key_times)
        if not (duration > 0 and length > 0):
            raise ValueError(f"duration and length must be above 0, got {duration} s and {length} m")
        self.settings, self.duration, self.length = settings, float(duration), float(length)
        times = encoded(self.key_times[:, None] / self.duration, settings.time_frequencies)
        self.register_buffer("moments", times, persistent=False)
        self.register_buffer("rounded", times.float(), persistent=False)
        self.register_buffer("powers", powers_of_two(settings.position_frequencies), persistent=False)
        self._inputs = (encoded_size(3, settings.position_frequencies), encoded_size(1, settings.time_frequencies))
        self.backend: Backend | None = None
        """Computes the network in half precision; None: torch, in the precision of the parameters."""
        joined, width = sum(self._inputs), settings.width
        sizes = [joined] + [width] * (settings.layers - 1)
        again = settings.skip_after if settings.skip_after < settings.layers else None
        if again is not None:
            sizes[again] += joined
        self._layers = [torch.nn.Linear(size, width) for size in sizes]
        self.layers = torch.nn.ModuleList(self._layers)
        self.head = torch.nn.Linear(width, 3)
        self.draw(generator)

    @classmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Network:
        """With random weights."""
        duration = initial.duration or 1.0  # a single instant: any duration serves
        length = settings.input_scale * initial.unambiguous_range
        return cls(initial.key_times, settings, duration=duration, length=length, generator=initial.generator)

    @torch.no_grad()
    def draw(self, generator: torch.Generator | None) -> None:
        """Begin anew, in place: other weights, everything at rest."""
        for layer in [*self._layers, self.head]:
            drawn = torch.empty(layer.weight.shape)  # on the CPU, where the generator is
            if layer is self.head:
                drawn.normal_(0.0, HEAD_DEVIATION, generator=generator)
            else:
                torch.nn.init.xavier_normal_(drawn, generator=generator)
            layer.weight.copy_(drawn)
            layer.bias.zero_()

    def bind(self, field: GaussianField) -> Float[Tensor, "N p"]:
        """gamma(x) of the positions, without gradient [1]."""
        mean = field.mean.detach()
        if self.backend is not None:
            return self.backend.encode(self, mean)
        return encoded(mean / self.length, self.powers)

    def at_keys(self, binding: Float[Tensor, "N p"], keys: Sequence[int] | Int[Tensor, "K"]) -> KeyMotion:
        """Displacements, without rotation."""
        moments = self.rounded if self.head.weight.dtype == self.rounded.dtype == torch.float32 else self.moments
        return KeyMotion(self.offsets(binding, rows_of(moments, keys)), None)

    def to_dict(self) -> dict[str, Any]:
        """With its shape, its duration and its length."""
        shape = asdict(self.settings) | {"kind": self.kind, "products": str(self.settings.products)}
        return super().to_dict() | {"shape": shape, "duration": self.duration, "length": self.length}

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Network:
        """From its shape and its tensors."""
        products = Products(stored["shape"].get("products", Products.FLOAT32))  # oldest checkpoints have none
        settings = MotionSettings(**stored["shape"] | {"products": products})
        tensors = stored["tensors"]
        made = cls(tensors["key_times"], settings, duration=stored["duration"], length=stored["length"])
        made.load_state_dict(tensors)
        return made

    def offsets(self, binding: Float[Tensor, "N p"], moment: Float[Tensor, "k t"]) -> Float[Tensor, "k N 3"]:
        """Displacements [m] at several times, given as gamma(t): rows of ``moments``, chosen on the host or the device.

        A layer is linear, so what it makes of positions is computed once for all times, and what it makes of a time is
        one vector, added like a bias.
        """
        moment = moment.to(self.head.weight)
        if self.backend is not None:
            return self.backend.offsets(self, binding, moment)
        hidden = self._joined(self._layers[0], None, binding, moment)
        for number, layer in enumerate(self._layers[1:], start=1):
            hidden = torch.relu(hidden)
            skip = number == self.settings.skip_after
            if skip:
                hidden = self._joined(layer, hidden, binding, moment)
            else:
                hidden = hidden @ layer.weight.T + layer.bias
        return torch.relu(hidden) @ self.head.weight.T + self.head.bias

    def _joined(
        self, layer: torch.nn.Linear, hidden: Tensor | None, place: Float[Tensor, "N p"], moment: Float[Tensor, "k t"]
    ) -> Float[Tensor, "k N width"]:
        """A layer of [hidden, gamma(x), gamma(t)] without building that."""
        weight, first = layer.weight, 0 if hidden is None else self.settings.width
        at_place, at_moment = weight[:, first:].split(self._inputs, dim=1)
        own = moment @ at_moment.T + layer.bias
        out = place @ at_place.T + own[:, None]
        return out if hidden is None else out + hidden @ weight[:, :first].T
