"""The oracle of features in hash grids: plain torch, any precision, differentiated by autograd."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .hash_grid import Levels

PRIMES = 1, 2654435761, 805459861, 3674653429  # of x, y, z and the time; kernels/volume


def interpolated(
    points: Float[Tensor, "T P 3"],
    times: Int[Tensor, "T"],
    table: Float[Tensor, "E 2"],
    levels: Levels,
) -> Float[Tensor, "T P f"]:
    """Oracle of :func:`gftorf_warp.render.hash_grid.interpolated`."""
    by_level = []
    for cells, start, rows in zip(*(each.tolist() for each in levels[:3]), strict=True):
        along = points.clamp(0.0, 1.0) * cells
        first = along.detach().floor().clamp_max(cells - 1)
        share = along - first
        total = table.new_zeros(())
        for corner in itertools.product((0, 1), repeat=3):
            far = torch.tensor(corner, device=points.device)
            weight = torch.where(far == 1, share, 1.0 - share).prod(dim=-1)
            vertex = torch.cat([first.long() + far, _beside(times, points)], dim=-1)
            row = start + _rows(vertex, cells, rows, levels.times)
            total = total + weight[..., None] * table[row]
        by_level.append(total)
    return torch.cat(by_level, dim=-1)


def _beside(times: Int[Tensor, "T"], points: Float[Tensor, "T P 3"]) -> Int[Tensor, "T P 1"]:
    """The time of every point."""
    return times.long()[:, None, None].expand(*points.shape[:2], 1)


def _rows(vertex: Int[Tensor, "T P 4"], cells: int, rows: int, times: int) -> Int[Tensor, "T P"]:
    """Rows of vertices x, y, z, time in their level."""
    side = cells + 1
    if side**3 * times <= rows:
        return (vertex * vertex.new_tensor([1, side, side**2, side**3])).sum(dim=-1)
    parts = [vertex[..., k] * prime & 0xFFFFFFFF for k, prime in enumerate(PRIMES)]
    return (parts[0] ^ parts[1] ^ parts[2] ^ parts[3]) % rows
