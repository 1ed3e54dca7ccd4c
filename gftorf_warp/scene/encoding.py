"""Positional encoding of positions and times: gamma(v) = [v, sin 2^0 v, cos 2^0 v, sin 2^1 v,
cos 2^1 v, ..].
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def powers_of_two(count: int) -> Float[Tensor, "f"]:
    """2^0, 2^1, .., exact in any precision."""
    return 2.0 ** torch.arange(count, dtype=torch.float32)


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Number of elements of gamma(v)."""
    return dimensions * (1 + 2 * frequencies)


def encoded(
    value: Float[Tensor, "*n d"],
    frequencies: int | Float[Tensor, "f"],
    *,
    columns: int | None = None,
    dtype: torch.dtype | None = None,
) -> Float[Tensor, "*n e"]:
    """gamma(v): the values, then sine and cosine of 2^0 v, 2^1 v, .., without a factor pi.

    Args:
        value: Differentiable, once.
        frequencies: Their number, or their ``powers_of_two``, which saves an upload.
        columns: Length of a row, padded with zeros; None: no padding.
        dtype: Of the result, rounded at the end; None: that of the values.
    """
    powers = (powers_of_two(frequencies) if isinstance(frequencies, int) else frequencies).to(value)
    size = encoded_size(value.shape[-1], len(powers))
    return _Encoded.apply(value, powers, columns or size, dtype or value.dtype)


class _Encoded(torch.autograd.Function):
    """Waves written where they belong; computed again for the gradient, which costs less than to
    keep them.
    """

    @staticmethod
    def forward(
        ctx: Any, value: Tensor, powers: Tensor, columns: int, dtype: torch.dtype
    ) -> Tensor:
        """The encoding."""
        ctx.save_for_backward(value, powers)
        size = encoded_size(value.shape[-1], len(powers))
        allocate = torch.empty if columns == size else torch.zeros
        rows = allocate(*value.shape[:-1], columns, dtype=dtype, device=value.device)
        known, waves = _parts(rows, value, powers)
        known.copy_(value)
        angles = value[..., None, :] * powers[:, None]
        torch.sin(angles, out=waves[..., 0, :])
        torch.cos(angles, out=waves[..., 1, :])
        return rows

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """By the value; accumulated in its precision."""
        value, powers = ctx.saved_tensors
        known, waves = _parts(gradient, value, powers)
        angles = value[..., None, :] * powers[:, None]
        slopes = waves[..., 0, :] * torch.cos(angles) - waves[..., 1, :] * torch.sin(angles)
        return known + (powers[:, None] * slopes).sum(dim=-2), None, None, None


def _parts(rows: Tensor, value: Tensor, powers: Tensor) -> tuple[Tensor, Tensor]:
    """The columns [*n, d] of the values and those [*n, f, 2, d] of sine and cosine."""
    dimensions = value.shape[-1]
    waves = rows[..., dimensions : encoded_size(dimensions, len(powers))]
    return rows[..., :dimensions], waves.unflatten(-1, (len(powers), 2, dimensions))
