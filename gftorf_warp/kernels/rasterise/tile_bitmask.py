"""The list of each tile from a bit mask with one bit per tile and splat, in depth order.

Bit r % 32 of word r / 32 of a tile is set if the tile lists the splat of depth rank r, so that
nothing is left to sort. ``mark_pairs`` of tiles.py writes the matrix.
"""

import warp as wp

from .simd import of_lane, sum_of_lanes, warp_any

# tiles whose equal words share a sector of 32 bytes: a splat reaches neighbouring tiles, and the
# warps of one block read them
GROUP = wp.constant(8)


@wp.func
def index_of_word(tile: int, word: int, words: int) -> int:
    """Index of a word of a tile in the matrix."""
    return (tile // GROUP * words + word) * GROUP + tile % GROUP


@wp.func
def part_of_tile(warp: int, parts: int) -> wp.vec2i:
    """(tile, part) of a warp: GROUP warps in a row read the same part of a group of tiles."""
    row = warp // GROUP
    return wp.vec2i(row // parts * GROUP + warp % GROUP, row % parts)


@wp.func_native(
    f"return (wp::uint64)bits.data[index] | (wp::uint64)bits.data[index + {GROUP}] << 32;"
)
def two_words(bits: wp.array[wp.uint32], index: int) -> wp.uint64:
    """The word of a tile at an index of the matrix, and the next one of this tile."""


STEP = wp.constant(2048)  # bits that a warp of CUDA reads at once, 64 a lane
WARPS = 8  # of a block


# plain pointers: Warp's indexing, with strides and negative indices, takes twice the instructions
@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned short of_warps[{WARPS}][{STEP}];
    unsigned short* const ranks = of_warps[threadIdx.x >> 5];
    for (int k = start - begin; set_bits; set_bits &= set_bits - 1)
        ranks[k++] = (unsigned short)(rank - lowest + __ffsll((long long)set_bits) - 1);
    __syncwarp();
    for (int k = begin + (int)(threadIdx.x & 31); k < end; k += 32) ids.data[k] =
        order.data[lowest + ranks[k - begin]];
    __syncwarp();
#else
    for (int k = start; set_bits && k < end; set_bits &= set_bits - 1)
        ids.data[k++] = order.data[rank + __builtin_ctzll(set_bits)];
#endif
""")
def write_ids(
    set_bits: wp.uint64,
    order: wp.array[wp.int32],
    rank: int,
    lowest: int,
    ids: wp.array[wp.int32],
    start: int,
    begin: int,
    end: int,
):
    """List the splats whose bits are set, the lowest of depth rank ``rank``, in a warp ``lowest``.

    Those of this lane are written from ``start`` on, those of the warp to ``begin`` .. ``end`` - 1.
    """


@wp.kernel(enable_backward=False, grid_stride=False)
def count_bits(
    # In:
    bits: wp.array[wp.uint32],  # [groups * words * GROUP] which splats each tile lists
    words: int,  # of a tile, an even number [1]
    tiles: int,  # of the image [1]
    parts: int,  # of a tile: a warp reads one [1]
    length: int,  # words of a part, a multiple of 64 [1]
    lanes: int,  # threads per part: 32 on CUDA, a warp, 1 on the CPU [1]
    # Out:
    counts: wp.array[int],  # [tiles * parts] splats in each part
):
    """One warp per part of a tile, one lane per two words."""
    warp, lane = wp.tid()
    mine = part_of_tile(warp, parts)
    if mine[0] < tiles:
        count = int(0)
        word = mine[1] * length + 2 * lane
        end = wp.min(words, (mine[1] + 1) * length)
        while word < end:
            count += wp.bit_count(two_words(bits, index_of_word(mine[0], word, words)))
            word += 2 * lanes
        sums = sum_of_lanes(count)
        if lane == lanes - 1:
            counts[mine[0] * parts + mine[1]] = sums


@wp.kernel(enable_backward=False, grid_stride=False)
def list_bits(
    # In:
    bits: wp.array[wp.uint32],  # [groups * words * GROUP] which splats each tile lists
    words: int,  # of a tile, an even number [1]
    tiles: int,  # of the image [1]
    parts: int,  # of a tile: a warp reads one [1]
    length: int,  # words of a part, a multiple of 64 [1]
    lanes: int,  # threads per part: 32 on CUDA, a warp, 1 on the CPU [1]
    order: wp.array[wp.int32],  # [>= N] splats near to far
    ends: wp.array[int],  # [tiles * parts] sums of counts: where the splats of each part end
    capacity: int,  # pairs that fit [1]
    # Out:
    ids: wp.array[wp.int32],  # [>= capacity] splat of each pair
    first: wp.array[int],  # [tiles + 1] where the list of each tile begins, and the end
    total: wp.array[int],  # [1] pairs there would be, whether they fit or not
):
    """One warp per part of a tile; pairs that do not fit are dropped, last tiles first."""
    warp, lane = wp.tid()
    if warp == 0 and lane == 0:
        total[0] = ends[tiles * parts - 1]
        first[tiles] = wp.min(ends[tiles * parts - 1], capacity)
    mine = part_of_tile(warp, parts)
    if mine[0] < tiles:
        number = mine[0] * parts + mine[1]
        at = int(0)  # list position of the first splat of the next words
        if number > 0:
            at = ends[number - 1]
        if mine[1] == 0 and lane == 0:
            first[mine[0]] = wp.min(at, capacity)
        end = wp.min(ends[number], capacity)
        word = mine[1] * length
        while at < end:  # like all control flow here, the same in all lanes of a warp
            lane_word = word + 2 * lane
            set_bits = wp.uint64(0)
            if lane_word < words:
                set_bits = two_words(bits, index_of_word(mine[0], lane_word, words))
            if warp_any(set_bits != wp.uint64(0)):
                count = wp.bit_count(set_bits)
                sums = sum_of_lanes(count)
                until = at + of_lane(sums, lanes - 1)
                start = at + sums - count
                stop = wp.min(until, capacity)
                write_ids(set_bits, order, 32 * lane_word, 32 * word, ids, start, at, stop)
                at = until
            word += 2 * lanes
