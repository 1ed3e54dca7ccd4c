"""Motion by a network of position and time: an MLP gives the displacement of every Gaussian at
every key.

    delta(x, t) = head(layers([gamma(x), gamma(t)]))
    gamma(v) = [v, sin 2^0 v, cos 2^0 v, .., sin 2^9 v, cos 2^9 v]

Layers end in a ReLU (method, section 4). Positions are divided by a length and have no gradient; t
is 0 at the first raw frame and 1 at the last. The encoded input is concatenated to the output of
the fifth layer.
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

# of the initial weights of the head: displacements of a hundredth of a millimetre
HEAD_DEVIATION = 1e-5


class Backend(Protocol):
    """Another implementation of a network; ``render.network`` has those for half precision."""

    def encode(self, network: Network, mean: Float[Tensor, "N 3"]) -> Float[Tensor, "N p"]:
        """gamma(x) of positions [m], without gradient."""
        ...

    def offsets(
        self, network: Network, binding: Float[Tensor, "N p"], time: Float[Tensor, "k t"]
    ) -> Float[Tensor, "k N 3"]:
        """Displacements [m] at times given as gamma(t), differentiable in the parameters."""
        ...


class Network(Motion):
    """Displacements by an MLP of position and time."""

    kind = "network"
    follows_means = True
    time_encodings: Tensor  # [T, t] float64, gamma(t) of every key; not stored, as all three
    time_encodings_f32: Tensor  # [T, t] the same in float32, so that a step converts nothing
    powers: Tensor  # [F] 2^0, 2^1, .. of the positions

    def __init__(
        self,
        key_times: Float[Tensor, "T"],
        settings: MotionSettings,
        *,
        duration: float,
        length: float,
        generator: torch.Generator | None = None,
    ):
        """Create the network with random weights.

        Args:
            key_times: Start of every quartet and the time one quartet after the last start [s].
            settings: Layers, width and frequencies.
            duration: Time from the first raw frame to the last [s], by which times are divided.
            length: Positions are divided by it [m].
            generator: For the weights, on the CPU.

        Raises:
            ValueError: If duration or length is not above 0.
        """
        super().__init__(key_times)
        if not (duration > 0 and length > 0):
            given = f"{duration} s and {length} m"
            raise ValueError(f"duration and length must be above 0, got {given}")
        self.settings, self.duration, self.length = settings, float(duration), float(length)
        times = encoded(self.key_times[:, None] / self.duration, settings.time_frequencies)
        self.register_buffer("time_encodings", times, persistent=False)
        self.register_buffer("time_encodings_f32", times.float(), persistent=False)
        powers = powers_of_two(settings.position_frequencies)
        self.register_buffer("powers", powers, persistent=False)
        frequencies = (3, settings.position_frequencies), (1, settings.time_frequencies)
        # of gamma(x) and gamma(t)
        self._sizes = [encoded_size(*numbers) for numbers in frequencies]
        self.backend: Backend | None = None
        """Computes the network in half precision; None: torch, in that of the parameters."""
        size, width = sum(self._sizes), settings.width
        inputs = [size] + [width] * (settings.layers - 1)
        if settings.skip_after < settings.layers:
            inputs[settings.skip_after] += size
        self._layers = [torch.nn.Linear(count, width) for count in inputs]
        self.layers = torch.nn.ModuleList(self._layers)
        self.head = torch.nn.Linear(width, 3)
        self.reset_parameters(generator)

    @classmethod
    def start(cls, settings: MotionSettings, initial: MotionStart) -> Network:
        """With random weights."""
        duration = initial.duration or 1.0  # a single instant: any duration serves
        length = settings.input_scale * initial.unambiguous_range
        return cls(
            initial.key_times,
            settings,
            duration=duration,
            length=length,
            generator=initial.generator,
        )

    @torch.no_grad()
    def reset_parameters(self, generator: torch.Generator | None) -> None:
        """New random weights, in place, with hardly any displacement."""
        for layer in [*self._layers, self.head]:
            drawn = torch.empty(layer.weight.shape)  # on the CPU, like the generator
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

    def at_keys(
        self, binding: Float[Tensor, "N p"], keys: Sequence[int] | Int[Tensor, "K"]
    ) -> KeyMotion:
        """Displacements, without rotation."""
        single = self.head.weight.dtype == self.time_encodings_f32.dtype == torch.float32
        times = self.time_encodings_f32 if single else self.time_encodings
        return KeyMotion(self.offsets(binding, rows_of(times, keys)), None)

    def to_dict(self) -> dict[str, Any]:
        """With its shape, its duration and its length."""
        shape = asdict(self.settings) | {"kind": self.kind, "products": str(self.settings.products)}
        numbers = {"shape": shape, "duration": self.duration, "length": self.length}
        return super().to_dict() | numbers

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Network:
        """From its shape and its tensors."""
        # oldest checkpoints have none
        products = Products(stored["shape"].get("products", Products.FLOAT32))
        settings = MotionSettings(**stored["shape"] | {"products": products})
        tensors = stored["tensors"]
        times, numbers = tensors["key_times"], {n: stored[n] for n in ("duration", "length")}
        made = cls(times, settings, **numbers)
        made.load_state_dict(tensors)
        return made

    def offsets(
        self, binding: Float[Tensor, "N p"], time: Float[Tensor, "k t"]
    ) -> Float[Tensor, "k N 3"]:
        """Displacements [m] at times given as gamma(t).

        Layers are linear in their input: the contribution of positions is computed once for all
        times, that of a time is one vector, added like a bias.
        """
        time = time.to(self.head.weight)
        if self.backend is not None:
            return self.backend.offsets(self, binding, time)
        hidden = self._with_input(self._layers[0], None, binding, time)
        for number, layer in enumerate(self._layers[1:], start=1):
            hidden = torch.relu(hidden)
            if number == self.settings.skip_after:
                hidden = self._with_input(layer, hidden, binding, time)
            else:
                hidden = hidden @ layer.weight.T + layer.bias
        return torch.relu(hidden) @ self.head.weight.T + self.head.bias

    def _with_input(
        self,
        layer: torch.nn.Linear,
        hidden: Tensor | None,
        position: Float[Tensor, "N p"],
        time: Float[Tensor, "k t"],
    ) -> Float[Tensor, "k N width"]:
        """A layer of [hidden, gamma(x), gamma(t)], without concatenating them."""
        weight, first = layer.weight, 0 if hidden is None else self.settings.width
        by_position, by_time = weight[:, first:].split(self._sizes, dim=1)
        out = position @ by_position.T + (time @ by_time.T + layer.bias)[:, None]
        return out if hidden is None else out + hidden @ weight[:, :first].T
