"""Positional encoding of positions and times: gamma(v) = [v, sin 2^0 v, cos 2^0 v, sin 2^1 v,
cos 2^1 v, ..].
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


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
        value: Differentiable, at the cost of more memory if it requires a gradient.
        frequencies: Their number, or their ``powers_of_two``, which saves an upload.
        columns: Length of a row, padded with zeros; None: no padding.
        dtype: Of the result, rounded at the end; None: that of the values.
    """
    powers = (powers_of_two(frequencies) if isinstance(frequencies, int) else frequencies).to(value)
    count, dimensions = len(powers), value.shape[-1]
    size = encoded_size(dimensions, count)
    angles = value[..., None, :] * powers[:, None]
    if value.requires_grad and torch.is_grad_enabled():
        waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=-2).flatten(-3)
        padding = value.new_zeros(*value.shape[:-1], (columns or size) - size)
        return torch.cat([value, waves, padding], dim=-1).to(dtype or value.dtype)
    allocate = torch.empty if columns in (None, size) else torch.zeros
    rows = allocate(
        *value.shape[:-1], columns or size, dtype=dtype or value.dtype, device=value.device
    )
    rows[..., :dimensions] = value
    waves = rows[..., dimensions:size].unflatten(-1, (count, 2, dimensions))
    torch.sin(angles, out=waves[..., 0, :])
    torch.cos(angles, out=waves[..., 1, :])
    return rows
