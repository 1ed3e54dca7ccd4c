"""The linear layers of a volume, which have 256 columns and 100,000s of rows.

In half precision on a GPU they are bound by memory, so passes over the rows count: a sum of the
gradient over the rows takes twice as long as the product of the layer, and adding a bias that is
the same for many rows but not for all takes as long as one.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional


def linear(
    layer: torch.nn.Linear, rows: Float[Tensor, "*n i"], biases: Float[Tensor, "T o"] | None = None
) -> Float[Tensor, "*n o"]:
    """The product of a layer, in the precision of autocast.

    Args:
        layer: With a bias, unless ``biases`` are given.
        rows: What it is applied to; [T, P, i] with biases.
        biases: A bias for each of the T, instead of the layer's own.
    """
    bias = layer.bias if biases is None else biases
    dtype = precision_of(rows)
    return _Product.apply(rows.to(dtype), layer.weight.to(dtype), bias.to(dtype))


def precision_of(values: Tensor) -> torch.dtype:
    """The precision of autocast; without it, that of the values."""
    kind = values.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else values.dtype


class _Product(torch.autograd.Function):
    """rows weight^T + bias."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """One product, or one for each of several biases."""
        ctx.save_for_backward(rows, weight)
        if bias.ndim == 1:
            return functional.linear(rows, weight, bias)
        out = rows.new_empty(*rows.shape[:-1], len(weight))
        for part, one, result in zip(rows, bias, out, strict=True):
            torch.addmm(one, part, weight.T, out=result)
        ctx.biases = len(bias)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Products again, the bias's with ones."""
        rows, weight = ctx.saved_tensors
        flat, biases = gradient.flatten(0, -2), getattr(ctx, "biases", None)
        each = flat if biases is None else flat.unflatten(0, (biases, -1))
        sums = (flat.new_ones(*each.shape[:-2], 1, each.shape[-2]) @ each).squeeze(-2)
        return (
            gradient @ weight if ctx.needs_input_grad[0] else None,
            flat.T @ rows.flatten(0, -2),
            sums,
        )
