"""The motion network in half precision: what an implementation of its layers computes.

With a = [gamma(x), gamma(t)] the layers are

    z_n = W_n h_(n-1) + b_n,   h_n = max(z_n, 0),   h_-1 = a

and before layer ``joined`` h becomes [h, a].

gamma(t) contributes one vector per key, a part of the bias: W a + b = W_x gamma(x) + (W_t gamma(t)
+ b). Backward, d_n being the gradient at z_n: dW_n = d_n^T h_(n-1), db_n = sum of d_n, d_(n-1) =
d_n W_n where h_(n-1) > 0.

Factors are halves; sums, weights, biases with a time in them, weight gradients and results are
float32. A factor beyond 65504 is infinite and makes the gradient of a weight non-finite, so that
the update is skipped. Positions have no gradient. Nothing synchronises with the device.
design/network.md has the reasons.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene.encoding import encoded, encoded_size
from ..scene.network import Network

# halves in 16 bytes: products whose rows begin at multiples of it are several times faster
ALIGNED = 8
# scaled gradient of an offset: 10 bits below the largest half, 20 above the smallest normal one
LARGEST = 64.0
SMALLEST = 1e-30  # below any gradient; avoids 0 / 0 where all are 0


@dataclass(frozen=True, kw_only=True)
class Form:
    """Sizes of a network, and the precision of its products."""

    position: int
    """Elements of gamma(x)."""
    time: int
    """Elements of gamma(t)."""
    width: int
    """Outputs of a layer."""
    joined: int | None
    """Number of the layer whose input is concatenated with gamma(x) and gamma(t); None: there is
    none."""
    dtype: torch.dtype
    """Of the factors: float16, or that of the parameters, for which the same code is exact."""

    @classmethod
    def of(cls, network: Network, dtype: torch.dtype = torch.float16) -> Form:
        """Sizes of a network."""
        settings = network.settings
        return cls(
            position=encoded_size(3, settings.position_frequencies),
            time=encoded_size(1, settings.time_frequencies),
            width=settings.width,
            joined=settings.skip_after if settings.skip_after < settings.layers else None,
            dtype=dtype,
        )

    @property
    def columns(self) -> int:
        """Length of the rows that hold gamma(x): the next aligned one, if a weight is as wide."""
        return min(-(-self.position // ALIGNED) * ALIGNED, self.position + self.time)

    @property
    def entries(self) -> list[int]:
        """Numbers of the layers that have gamma(x) and gamma(t) as inputs."""
        return [0] if self.joined is None else [0, self.joined]


class LayerGradients(NamedTuple):
    """Gradients at the layers, as factors, divided by ``unit`` unless stated otherwise."""

    unit: Float[Tensor, ""]
    """Largest magnitude of a gradient of an offset over ``LARGEST``."""
    head: Float[Tensor, "rows h"]
    """At the output of the head, padded with zeros."""
    layers: Float[Tensor, "layers rows width"]
    """Before the ReLU of every layer; of the listed rows where there is a list."""
    sums: Float[Tensor, "layers k width"]
    """These, summed over the rows of each key; valid once the side stream has joined."""
    head_sum: Float[Tensor, "3"]
    """Gradients of the offsets, summed over all rows; not divided."""
    listed: Int[Tensor, "capacity"] | None = None
    """Row of each of ``layers``, or ``NO_ROW``; None: all rows in their order."""
    begins: Int[Tensor, "ends"] | None = None
    """First listed row of each key, and the end of the last one: nothing is written behind it."""
    partials: Float[Tensor, "layers k parts width"] | None = None
    """Partial sums that the side stream adds up: kept alive until it has joined."""


class Layers(abc.ABC):
    """Computes the layers for all rows, forward and backward."""

    def encode(
        self,
        mean: Float[Tensor, "N 3"],
        length: float,
        powers: Float[Tensor, "f"],
        *,
        columns: int,
        dtype: torch.dtype,
    ) -> Float[Tensor, "N columns"]:
        """gamma(x) of positions [m] over a length [m], rounded, zero-padded; without gradient."""
        return encoded(mean.detach() / length, powers, columns=columns, dtype=dtype)

    @abc.abstractmethod
    def forward(
        self,
        form: Form,
        position: Float[Tensor, "N columns"],
        time: Float[Tensor, "k t"],
        weights: tuple[Tensor, ...],
        biases: tuple[Tensor, ...],
    ) -> tuple[Float[Tensor, "layers rows width"], Float[Tensor, "h width"], tuple[Tensor, ...]]:
        """Outputs of all layers, the weight of the head as a factor, and tensors for ``backward``.

        Args:
            form: Sizes and precision.
            position: gamma(x) in the precision of the factors, padded with zeros.
            time: gamma(t) of every key, in the precision of the parameters.
            weights: Of every layer and the head.
            biases: The same.
        """

    @abc.abstractmethod
    def backward(
        self,
        form: Form,
        keys: int,
        gradient: Float[Tensor, "rows 3"],
        outputs: Float[Tensor, "layers rows width"],
        saved: tuple[Tensor, ...],
    ) -> LayerGradients:
        """Gradients at all layers.

        Args:
            form: Sizes and precision.
            keys: Number k of keys.
            gradient: Of the offsets, in the precision of the parameters.
            outputs: Of ``forward``.
            saved: By ``forward``.
        """

    @abc.abstractmethod
    def parameter_gradients(
        self,
        form: Form,
        position: Float[Tensor, "N columns"],
        time: Float[Tensor, "k t"],
        gradients: LayerGradients,
        outputs: Float[Tensor, "layers rows width"],
    ) -> list[Tensor]:
        """Unscaled gradients of weight and bias of every layer, then of the head."""
