"""The linear layers of a volume, which have 256 columns and 100,000s of rows.

In half precision on a GPU they are bound by memory, so passes over the rows count: a sum of the
gradient over the rows takes twice as long as the product of the layer, and adding a bias that is
the same for many rows but not for all takes as long as one, as does a ReLU. So the product itself
adds what is added, and applies the ReLU where cuBLAS can.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def linear(
    layer: torch.nn.Linear,
    rows: Float[Tensor, "*n i"],
    added: Float[Tensor, "..."] | None = None,
    *,
    relu: bool = False,
) -> Float[Tensor, "*n o"]:
    """The product of a layer, in the precision of autocast.

    Args:
        layer: With a bias, unless ``added`` is given.
        rows: What it is applied to; [T, P, i] if there are T biases.
        added: What is added instead of the layer's bias: biases of each of the T [T, o], or
            another product [*n, o].
        relu: Whether negative values become 0.
    """
    added = layer.bias if added is None else added
    dtype = precision_of(rows)
    return _Product.apply(rows.to(dtype), layer.weight.to(dtype), added.to(dtype), relu)


def precision_of(values: Tensor) -> torch.dtype:
    """The precision of autocast; without it, that of the values."""
    kind = values.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else values.dtype


class _Product(torch.autograd.Function):
    """rows weight^T + added, and its ReLU."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, added: Tensor, relu: bool) -> Tensor:
        """One product, or one for each of several biases."""
        out = rows.new_empty(*rows.shape[:-1], len(weight))
        several = added.ndim == 2 < out.ndim
        for given in zip(rows, added, out, strict=True) if several else [(rows, added, out)]:
            part, one, result = (tensor.reshape(-1, tensor.shape[-1]) for tensor in given)
            if relu and len(one) == 1:
                torch._addmm_activation(one[0], part, weight.T, out=result)
            else:
                torch.addmm(one, part, weight.T, out=result)
                if relu:
                    result.relu_()
        ctx.save_for_backward(rows, weight, out if relu else None)
        ctx.added = added.shape
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Products again, a bias's with ones."""
        rows, weight, out = ctx.saved_tensors
        if out is not None:
            gradient = torch.ops.aten.threshold_backward(gradient, out, 0)
        flat = gradient.flatten(0, -2)
        return (
            gradient @ weight if ctx.needs_input_grad[0] else None,
            flat.T @ rows.flatten(0, -2),
            gradient if ctx.added == gradient.shape else _sums(flat, ctx.added),
            None,
        )


def _sums(gradient: Float[Tensor, "n o"], shape: torch.Size) -> Tensor:
    """Sums over all rows, or over those of each of several parts."""
    each = gradient if len(shape) == 1 else gradient.unflatten(0, (shape[0], -1))
    return (each.new_ones(*each.shape[:-2], 1, each.shape[-2]) @ each).squeeze(-2)
