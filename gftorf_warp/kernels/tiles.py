"""Which splats each tile has to look at: exact ellipse-tile tests, counts, keys, and where each tile's list begins.

A tile lists a splat if the ellipse alpha >= 1/255 reaches the rectangle of its pixel centres. Splats are emitted near
to far and sorted by tile with a stable sort, so that every list is in depth order.
"""

import warp as wp

from .splat import Splat


@wp.func
def tile_range(box: wp.vec4i, tile_width: int, tile_height: int) -> wp.vec4i:
    """Tiles [x0, y0, x1, y1) that the pixels [x0, y0, x1, y1) of ``box`` lie in."""
    return wp.vec4i(
        box[0] // tile_width,
        box[1] // tile_height,
        (box[2] + tile_width - 1) // tile_width,
        (box[3] + tile_height - 1) // tile_height,
    )


@wp.func
def touches(q: Splat, x: float, y: float, w: float, h: float) -> bool:
    """Whether the power reaches its lower bound anywhere on the rectangle [x, x + w] x [y, y + h] [px]."""
    dx = wp.clamp(q[0], x, x + w) - q[0]
    dy = wp.clamp(q[1], y, y + h) - q[1]
    most = float(0.0)
    if dx != 0.0 or dy != 0.0:  # centre outside: the maximum lies on an edge that faces it
        most = float(-1.0e30)
        if dx != 0.0:
            v = wp.clamp(-0.5 * q[3] * dx / q[4], y - q[1], y + h - q[1])
            most = (q[2] * dx + q[3] * v) * dx + q[4] * v * v
        if dy != 0.0:
            u = wp.clamp(-0.5 * q[3] * dy / q[2], x - q[0], x + w - q[0])
            most = wp.max(most, (q[2] * u + q[3] * dy) * u + q[4] * dy * dy)
    return most >= q[6] * 1.00001 - 5.0e-5


@wp.kernel(enable_backward=False)
def count_pairs(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    splats: wp.array[Splat],  # [N] records
    box_px: wp.array[wp.vec4i],  # [N] pixels a splat may touch [px]
    tile_width: int,  # columns of a tile [px]
    tile_height: int,  # rows of a tile [px]
    # Out:
    counts: wp.array[int],  # [N] tiles each splat touches, in depth order
):
    """One thread per splat."""
    rank = wp.tid()
    i = order[rank]
    touched = int(0)
    if box_px[i][2] > 0:
        q = splats[i]
        b = tile_range(box_px[i], tile_width, tile_height)
        w = float(tile_width)
        h = float(tile_height)
        for y in range(b[1], b[3]):
            for x in range(b[0], b[2]):
                if touches(q, float(x) * w + 0.5, float(y) * h + 0.5, w - 1.0, h - 1.0):
                    touched += 1
    counts[rank] = touched


@wp.kernel(enable_backward=False)
def emit_pairs(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    splats: wp.array[Splat],  # [N] records
    box_px: wp.array[wp.vec4i],  # [N] pixels a splat may touch [px]
    tile_width: int,  # columns of a tile [px]
    tile_height: int,  # rows of a tile [px]
    tiles_x: int,  # tiles per row [1]
    counts: wp.array[int],  # [N] tiles each splat touches, in depth order
    offsets: wp.array[int],  # [N] exclusive sums of ``counts``
    capacity: int,  # pairs that fit [1]
    # Out:
    keys: wp.array[wp.int32],  # [>= capacity] tile of each pair
    ids: wp.array[wp.int32],  # [>= capacity] splat of each pair
    total: wp.array[int],  # [1] pairs there would be, whether they fit or not
):
    """One thread per splat; one that does not fit is dropped and shows in ``total``."""
    rank = wp.tid()
    i = order[rank]
    touched = counts[rank]
    k = offsets[rank]
    if rank == counts.shape[0] - 1:
        total[0] = k + touched
    if touched > 0 and k + touched <= capacity:
        q = splats[i]
        b = tile_range(box_px[i], tile_width, tile_height)
        w = float(tile_width)
        h = float(tile_height)
        for y in range(b[1], b[3]):
            for x in range(b[0], b[2]):
                if touches(q, float(x) * w + 0.5, float(y) * h + 0.5, w - 1.0, h - 1.0):
                    keys[k] = y * tiles_x + x
                    ids[k] = i
                    k += 1


@wp.kernel(enable_backward=False)
def tile_starts(
    # In:
    keys: wp.array[wp.int32],  # [>= count] tile of each pair, ascending
    count: int,  # pairs [1]
    # Out:
    first: wp.array[int],  # [tiles + 1] where the list of each tile begins; the last entry ends the last list
):
    """One thread per tile: binary search (``wp.lower_bound`` never returns ``count`` itself)."""
    tile = wp.tid()
    low = int(0)
    high = int(count)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < tile:
            low = middle + 1
        else:
            high = middle
    first[tile] = low
