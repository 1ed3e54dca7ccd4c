"""Launches over ranges of tiles: one on CUDA, several concurrent ones on a CPU,
each in its own thread.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np

from . import runtime
from .buffers import Buffers


def tile_edges(buffers: Buffers, parts: int) -> list[int]:
    """Edges of at most ``parts`` ranges of tiles with about equally many pairs."""
    if buffers.threads == 1:
        return [0, buffers.tiles]
    first = buffers.first.numpy()  # CPU only: a view, not a copy
    work = first[:-1] + np.arange(buffers.tiles)  # an empty tile costs about as much as a pair
    targets = [(first[-1] + buffers.tiles) * p / parts for p in range(1, parts)]
    return sorted({0, *(int(e) for e in np.searchsorted(work, targets)), buffers.tiles})


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gftorf-tiles")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a fork copies no threads


def over_tiles(buffers: Buffers, kernel, edges: list[int], arguments, warps: int = 1) -> None:
    """Launch over ranges of tiles, each with ``warps`` warps per tile; on the CPU concurrently."""
    side_by_side = len(edges) > 2
    commands = [
        runtime.launch(
            kernel,
            ((stop - start) * warps, buffers.lanes),
            arguments(start, part),
            [],
            device=buffers.device,
            block_dim=32 if buffers.cooperative else 128,
            record_cmd=side_by_side,
        )
        for part, (start, stop) in enumerate(pairwise(edges))
    ]
    if side_by_side:
        run_side_by_side(commands, buffers.threads)


def run_side_by_side(commands: list, threads: int) -> None:
    """Run at most ``threads`` recorded CPU launches concurrently; they release the GIL."""
    # this thread works, too: a pool that has slept would wake on its processor, and both would
    # share it for a while
    others = [_pool(threads - 1).submit(command.launch) for command in commands[1:]]
    commands[0].launch()
    for other in others:
        other.result()
