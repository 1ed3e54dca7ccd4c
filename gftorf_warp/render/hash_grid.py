"""Features of points in hash grids: one kernel forward, one backward (kernels/volume)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.volume import hash_grid as kernels
from . import runtime
from .bridge import array_over
from .cuda import stream_of


class Levels(NamedTuple):
    """L levels of a grid, on the device, and the number of its times."""

    cells: Int[Tensor, "L"]
    """Cells R along an axis of each."""
    starts: Int[Tensor, "L"]
    """First row of each in the table."""
    rows: Int[Tensor, "L"]
    """Rows of each, a power of two unless all its vertices have one."""
    times: int
    """Number M of times."""


def levels_of(cells: list[int], times: int, rows_max: int) -> tuple[Levels, int]:
    """Levels with these numbers of cells, on the CPU, and the rows E of their table.

    Args:
        cells: Cells along an axis of each level.
        times: Number of times.
        rows_max: A power of two; levels with more vertices have so many rows, which they share.

    Raises:
        ValueError: If ``rows_max`` is no power of two.
    """
    if rows_max < 1 or rows_max & (rows_max - 1):
        raise ValueError(f"rows_max must be a power of two, got {rows_max}")
    rows = [min((n + 1) ** 3 * times, rows_max) for n in cells]
    starts = [sum(rows[:k]) for k in range(len(rows))]
    r, n, s = (torch.tensor(each, dtype=torch.int32) for each in (cells, rows, starts))
    return Levels(cells=r, starts=s, rows=n, times=times), sum(rows)


def interpolated(
    points: Float[Tensor, "T P 3"],
    times: Int[Tensor, "T"],
    table: Float[Tensor, "E 2"],
    levels: Levels,
) -> Float[Tensor, "T P f"]:
    """Features of points, two of every level: f = 2 L. Differentiable once, in points and table.

    Args:
        points: Positions in the unit cube, to which they are clamped [1].
        times: Time of every row of points, 0 .. M - 1, int32.
        table: Features of the vertices of all levels.
        levels: Where in the table they are.

    Raises:
        ValueError: If something has another type than float32 and int32.
    """
    kinds = [points.dtype, table.dtype, times.dtype]
    if kinds != [torch.float32, torch.float32, torch.int32]:
        raise ValueError(f"points and table must be float32 and times int32, got {kinds}")
    return _Interpolated.apply(points.contiguous(), times, table, levels)


class _Interpolated(torch.autograd.Function):
    """One launch forward, one backward."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        times: Tensor,
        table: Tensor,
        levels: Levels,
    ) -> Tensor:
        values = table.new_empty(*points.shape[:2], 2 * len(levels.cells))
        ctx.save_for_backward(points, times, table)
        ctx.levels = levels
        _launch(kernels.interpolate, points, times, table, levels, [], [_pairs(values)])
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_features: Tensor) -> tuple[Tensor | None, ...]:
        points, times, table = ctx.saved_tensors
        grad_points = torch.zeros_like(points) if ctx.needs_input_grad[0] else None
        grad_table = torch.zeros_like(table)
        outputs = [array_over(grad_table, wp.vec2), array_over(grad_points, wp.vec3)]
        given = [_pairs(by_features.contiguous())]
        kernel = kernels.interpolate_backward
        _launch(kernel, points, times, table, ctx.levels, given, outputs)
        return grad_points, None, grad_table, None


def _pairs(features: Float[Tensor, "T P f"]) -> wp.array:
    """Features as [T, P, L] pairs."""
    return array_over(features.unflatten(-1, (-1, 2)), wp.vec2)


def _launch(
    kernel: wp.Kernel,
    points: Tensor,
    times: Tensor,
    table: Tensor,
    levels: Levels,
    more: list,
    outputs: list,
) -> None:
    """One thread per level, time and point, on torch's stream."""
    size = (len(levels.cells), *points.shape[:2])
    inputs = [array_over(points, wp.vec3), array_over(times, wp.int32), array_over(table, wp.vec2)]
    inputs += [array_over(each, wp.int32) for each in levels[:3]]
    with stream_of(table):
        device = wp.device_from_torch(table.device)
        runtime.launch(kernel, size, [*inputs, levels.times, *more], outputs, device=device)
