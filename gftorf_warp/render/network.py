"""The backend of a motion network in half precision: fused tensor-core kernels on Hopper,
cuBLAS elsewhere.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..scene.motion import Motion, Products
from ..scene.network import Network
from .cublas import CublasLayers, product
from .layers import Form, Layers
from .tensor_cores import FusedLayers, fits


class HalfPrecision:
    """A network in half precision with hand-written gradients, see ``scene.network.Backend``."""

    def __init__(self, layers: Layers, form: Form):
        """Compute ``form`` by ``layers``."""
        self.layers, self.form = layers, form

    def encode(self, network: Network, mean: Tensor) -> Tensor:
        """gamma(x), as the layers read it."""
        columns, dtype = self.form.columns, self.form.dtype
        return self.layers.encode(
            mean, network.length, network.powers, columns=columns, dtype=dtype
        )

    def offsets(self, network: Network, binding: Tensor, time: Tensor) -> Tensor:
        """[k, N, 3] displacements [m]."""
        layers = [*network.layers, network.head]
        parameters = [value for layer in layers for value in (layer.weight, layer.bias)]
        return Offsets.apply(self.form, self.layers, binding, time, *parameters)


def with_backend(motion: Motion) -> Motion:
    """The same motion; a network in half precision gets the backend for its device."""
    if isinstance(motion, Network) and motion.settings.products == Products.HALF:
        form = Form.of(motion)
        fused = fits(form, motion.powers.device)
        motion.backend = HalfPrecision(FusedLayers() if fused else CublasLayers(), form)
    return motion


class Offsets(torch.autograd.Function):
    """Offsets of all Gaussians at all keys, with a gradient for parameters only."""

    @staticmethod
    def forward(
        context,
        form: Form,
        layers: Layers,
        position: Float[Tensor, "N columns"],
        time: Float[Tensor, "k t"],
        *parameters: Tensor,
    ) -> Float[Tensor, "k N 3"]:
        """Offsets [m].

        Args:
            context: For the gradient.
            form: Sizes and precision.
            layers: Their implementation.
            position: gamma(x) in the precision of the factors, padded with zeros.
            time: gamma(t) of every key, in the precision of the parameters.
            parameters: Weight and bias of every layer, then of the head.
        """
        weights, biases = parameters[0::2], parameters[1::2]
        outputs, head, saved = layers.forward(form, position, time, weights, biases)
        context.form, context.layers = form, layers
        context.save_for_backward(position, time, *saved, outputs)
        rows = product(outputs[-1], head.T, time.dtype)[:, : len(biases[-1])] + biases[-1]
        return rows.view(len(time), len(position), len(biases[-1]))

    @staticmethod
    @once_differentiable
    def backward(context, gradient: Float[Tensor, "k N 3"]) -> tuple[Tensor | None, ...]:
        """Gradients of all parameters; loss scaling by the largest gradient of an offset."""
        form, layers = context.form, context.layers
        position, time, *saved, outputs = context.saved_tensors
        rows = gradient.reshape(-1, gradient.shape[-1])
        gradients = layers.backward(form, len(time), rows, outputs, tuple(saved))
        of_parameters = layers.parameter_gradients(form, position, time, gradients, outputs)
        return *(None,) * 4, *of_parameters
