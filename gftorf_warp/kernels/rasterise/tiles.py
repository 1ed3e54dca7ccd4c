"""Which splats each tile composites: spans of tiles in a row, counts, keys, and lists.

A tile lists a splat if the ellipse alpha >= 1/255 reaches the rectangle of its pixel centres; in a
row of tiles these are a span. Either each (tile, splat) pair is marked in a bit matrix, which
tile_bitmask.py reads; or pairs are written in depth order and sorted by tile with a stable sort.
Both give the same lists, in depth order.
"""

import warp as wp

from .simd import lane_beyond, lanes_with, of_lane, sum_of_lanes
from .splat import Splat, load_splat
from .tile_bitmask import index_of_word

# kernels must agree on every span to the last bit; contraction differs from kernel to kernel
wp.set_module_options({"fuse_fp": False})

# of the largest terms of the power [1]: what float32 loses in it at a far pixel
_MARGIN = wp.constant(1.0e-6)
# smallest determinant over 4 P R [1]: below it is rounding
_FLATTEST = wp.constant(wp.float64(1.0e-7))


@wp.func
def tile_range(box: wp.vec4i, tile_width: int, tile_height: int) -> wp.vec4i:
    """Tiles [x0, y0, x1, y1) that the pixels [x0, y0, x1, y1) of ``box`` lie in."""
    x1 = (box[2] + tile_width - 1) // tile_width
    y1 = (box[3] + tile_height - 1) // tile_height
    return wp.vec4i(box[0] // tile_width, box[1] // tile_height, x1, y1)


@wp.func
def outline_of(q: Splat, box: wp.vec4i) -> wp.vec4:
    """Outline (slope, width, narrowing, turn) of the ellipse power >= low, from its centre [px].

    At height v its edges are at slope v -+ sqrt(width - narrowing v^2); the right one is farthest
    out at v = turn, the left one at -turn. Widened by the rounding of the power at the pixels of
    ``box``; the determinant of the conic is a difference, so it is taken in float64.
    """
    x = wp.max(wp.abs(float(box[0]) + 0.5 - q[0]), wp.abs(float(box[2]) - 0.5 - q[0]))
    y = wp.max(wp.abs(float(box[1]) + 0.5 - q[1]), wp.abs(float(box[3]) - 0.5 - q[1]))
    terms = wp.abs(q[2]) * x * x + wp.abs(q[3]) * x * y + wp.abs(q[4]) * y * y
    level = -1.00001 * q[6] + 5.0e-5 + _MARGIN * terms
    product = wp.float64(4.0) * wp.float64(q[2]) * wp.float64(q[4])
    determinant = wp.max(product - wp.float64(q[3]) * wp.float64(q[3]), _FLATTEST * product)
    slope = -0.5 * q[3] / q[2]
    width = -level / q[2]
    narrowing = float(determinant / (wp.float64(4.0) * wp.float64(q[2]) * wp.float64(q[2])))
    turn = slope * wp.sqrt(width / (narrowing * (narrowing + slope * slope)))
    return wp.vec4(slope, width, narrowing, turn)


@wp.func
def span_of(
    outline: wp.vec4, q: Splat, row: int, tiles: wp.vec4i, tile_width: int, tile_height: int
) -> wp.vec2i:
    """Tiles [x0, x1) of a row, within ``tiles``, whose pixel centres the ellipse reaches."""
    # first and last pixel centres of the row, from the centre [px]
    low = float(row * tile_height) + 0.5 - q[1]
    high = low + float(tile_height - 1)
    nearest = wp.clamp(0.0, low, high)
    if outline[2] * nearest * nearest > outline[1]:
        return wp.vec2i(0, 0)
    right = wp.clamp(outline[3], low, high)
    left = wp.clamp(-outline[3], low, high)
    reach_right = wp.sqrt(wp.max(outline[1] - outline[2] * right * right, 0.0))
    reach_left = wp.sqrt(wp.max(outline[1] - outline[2] * left * left, 0.0))
    w = float(tile_width)
    first = wp.ceil((q[0] + (outline[0] * left - reach_left) + 0.5) / w) - 1.0
    last = wp.floor((q[0] + (outline[0] * right + reach_right) - 0.5) / w)
    # clamped as floats, as a float that does not fit has no defined integer; again, for NaN
    x0 = wp.clamp(int(wp.clamp(first, float(tiles[0]), float(tiles[2]))), tiles[0], tiles[2])
    x1 = wp.clamp(int(wp.clamp(last, -1.0, float(tiles[2]))) + 1, x0, tiles[2])
    return wp.vec2i(x0, x1)


@wp.func
def rows_from(
    outline: wp.vec4,
    q: Splat,
    top: int,
    lane: int,
    tiles: wp.vec4i,
    tile_width: int,
    tile_height: int,
) -> wp.vec2i:
    """Spans of rows of tiles from ``top`` on, one per lane: (sum of pairs, column offset)."""
    span = wp.vec2i(0, 0)
    if top + lane < tiles[3]:
        span = span_of(outline, q, top + lane, tiles, tile_width, tile_height)
    sums = sum_of_lanes(span[1] - span[0])
    return wp.vec2i(sums, span[1] - sums)


@wp.func
def tile_of(rows: wp.vec2i, pair: int, top: int, tiles_x: int) -> int:
    """Tile of a pair by its number in the rows of :func:`rows_from`; all lanes must call it."""
    row = lane_beyond(rows[0], pair)
    return (top + row) * tiles_x + of_lane(rows[1], row) + pair


@wp.kernel(enable_backward=False, grid_stride=False)
def mark_pairs(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    splats: wp.array[Splat],  # [N] records
    box_px: wp.array[wp.vec4i],  # [N] pixels a splat may touch [px]
    tile_width: int,  # columns of a tile [px]
    tile_height: int,  # rows of a tile [px]
    lanes: int,  # threads per splat: 32 on CUDA, a warp, 1 on the CPU [1]
    tiles_x: int,  # tiles per row [1]
    words: int,  # of a tile, a bit per splat [1]
    # Out:
    bits: wp.array[wp.uint32],  # [groups * words * GROUP] zeroed; which splats each tile lists
):
    """One warp per splat, as in :func:`emit_pairs`, but a pair is a bit of the matrix."""
    rank, lane = wp.tid()
    i = order[rank]
    if box_px[i][2] > 0:
        q = load_splat(splats, i)
        outline = outline_of(q, box_px[i])
        tiles = tile_range(box_px[i], tile_width, tile_height)
        bit = wp.uint32(1) << wp.uint32(rank % 32)
        top = tiles[1]
        while top < tiles[3]:  # as all control here the same for all lanes of a warp
            rows = rows_from(outline, q, top, lane, tiles, tile_width, tile_height)
            count = of_lane(rows[0], lanes - 1)
            begin = int(0)
            while begin < count:
                pair = begin + lane
                tile = tile_of(rows, pair, top, tiles_x)
                if pair < count:
                    wp.atomic_or(bits, index_of_word(tile, rank // 32, words), bit)
                begin += lanes
            top += lanes


@wp.kernel(enable_backward=False, grid_stride=False)
def count_pairs(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    splats: wp.array[Splat],  # [N] records
    box_px: wp.array[wp.vec4i],  # [N] pixels a splat may touch [px]
    tile_width: int,  # columns of a tile [px]
    tile_height: int,  # rows of a tile [px]
    lanes: int,  # threads per splat: 32 on CUDA, a warp, 1 on the CPU [1]
    # Out:
    counts: wp.array[int],  # [N] tiles each splat touches, in depth order
):
    """One warp per splat, one lane per row of tiles."""
    rank, lane = wp.tid()
    i = order[rank]
    touched = int(0)
    if box_px[i][2] > 0:
        q = load_splat(splats, i)
        outline = outline_of(q, box_px[i])
        tiles = tile_range(box_px[i], tile_width, tile_height)
        row = tiles[1] + lane
        while row < tiles[3]:
            span = span_of(outline, q, row, tiles, tile_width, tile_height)
            touched += span[1] - span[0]
            row += lanes
    sums = sum_of_lanes(touched)
    if lane == lanes - 1:
        counts[rank] = sums


@wp.kernel(enable_backward=False, grid_stride=False)
def emit_pairs(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    splats: wp.array[Splat],  # [N] records
    box_px: wp.array[wp.vec4i],  # [N] pixels a splat may touch [px]
    tile_width: int,  # columns of a tile [px]
    tile_height: int,  # rows of a tile [px]
    lanes: int,  # threads per splat: 32 on CUDA, a warp, 1 on the CPU [1]
    tiles_x: int,  # tiles per row [1]
    tile_count: int,  # tiles of the image: the key of an unused entry [1]
    ends: wp.array[int],  # [N] sums of counts: where the pairs of each splat end, in depth order
    capacity: int,  # pairs that fit [1]
    # Out:
    keys: wp.array[wp.int32],  # [>= capacity] tile of each pair
    ids: wp.array[wp.int32],  # [>= capacity] splat of each pair
    total: wp.array[int],  # [1] pairs there would be, whether they fit or not
):
    """One warp per splat; pairs that do not fit are dropped, farthest first."""
    rank, lane = wp.tid()
    known = ends[ends.shape[0] - 1]
    if rank == 0 and lane == 0:
        total[0] = known
    free = known + rank * lanes + lane
    while free < capacity:
        keys[free] = tile_count
        free += ends.shape[0] * lanes
    i = order[rank]
    at = int(0)  # index of the first pair of these rows
    if rank > 0:
        at = ends[rank - 1]
    if box_px[i][2] > 0:
        q = load_splat(splats, i)
        outline = outline_of(q, box_px[i])
        tiles = tile_range(box_px[i], tile_width, tile_height)
        top = tiles[1]
        # as all control here the same for all lanes of a warp
        while top < tiles[3] and at < capacity:
            rows = rows_from(outline, q, top, lane, tiles, tile_width, tile_height)
            count = of_lane(rows[0], lanes - 1)
            begin = int(0)
            while begin < count:
                pair = begin + lane
                tile = tile_of(rows, pair, top, tiles_x)
                if pair < count and at + pair < capacity:
                    keys[at + pair] = tile
                    ids[at + pair] = i
                begin += lanes
            at += count
            top += lanes


@wp.kernel(enable_backward=False, grid_stride=False)
def tile_starts(
    # In:
    keys: wp.array[wp.int32],  # [>= count] tile of each pair, ascending
    count: int,  # pairs [1]
    lanes: int,  # threads per tile: 32 on CUDA, a warp, 1 on the CPU [1]
    # Out:
    first: wp.array[int],  # [tiles + 1] where the list of each tile begins, and the end
):
    """One warp per tile, a 33-ary search: five dependent reads instead of 21."""
    tile, lane = wp.tid()
    low = int(0)
    high = int(count)
    while low < high:  # the same for all lanes of a warp
        step = (high - low + lanes + 1) // (lanes + 1)  # so that lanes + 1 steps go beyond the end
        entry = low + (lane + 1) * step - 1
        before = bool(False)
        if entry < high:
            before = keys[entry] < tile
        steps = lanes_with(before)
        high = wp.min(high, low + (steps + 1) * step - 1)
        low += steps * step
    if lane == 0:
        first[tile] = low
