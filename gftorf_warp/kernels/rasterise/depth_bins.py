"""Depth order of few splats without a sort: depth keys are counted into bins, compared within one.

A bin is the highest bits of a key. Its first rank is a sum over the bins before it; within it
every splat counts those in front: with a smaller key, or an equal one and a smaller index, one
comparison in 64 bits. Culled splats have one more bin, which is not ordered.
"""

import warp as wp

# of splats that are not culled; a wall that faces the camera fills few of them, which takes longest
BINS = 1 << 16
COUNTS = BINS + 2  # one more for culled splats, and the end


@wp.func
def bin_of(key: int, culled: int, shift: int) -> int:
    """The bin of a key; culled splats are in the last one."""
    number = key >> shift
    if key == culled:
        number = BINS
    return number


@wp.kernel(enable_backward=False)
def count_bins(
    # In:
    keys: wp.array[wp.int32],  # [>= N] of each splat
    culled: int,  # key of culled splats [1]
    shift: int,  # lowest bits of a key, which its bin ignores [1]
    # Out:
    counts: wp.array[int],  # [COUNTS] splats of the bin before, added to
    offsets: wp.array[wp.int32],  # [N] of each splat in its bin, in any order
):
    """A thread per splat."""
    n = wp.tid()
    offsets[n] = wp.atomic_add(counts, bin_of(keys[n], culled, shift) + 1, 1)


@wp.kernel(enable_backward=False)
def fill_bins(
    # In:
    keys: wp.array[wp.int32],  # [>= N] of each splat
    culled: int,  # key of culled splats [1]
    shift: int,  # lowest bits of a key, which its bin ignores [1]
    first: wp.array[int],  # [COUNTS] first rank of each bin
    offsets: wp.array[wp.int32],  # [N] of each splat in its bin
    # Out:
    members: wp.array[wp.int64],  # [N] (key << 32 | index) of every splat, bin by bin
):
    """A thread per splat."""
    n = wp.tid()
    at = first[bin_of(keys[n], culled, shift)] + offsets[n]
    members[at] = (wp.int64(keys[n]) << wp.int64(32)) | wp.int64(n)


@wp.kernel(enable_backward=False)
def order_within_bins(
    # In:
    members: wp.array[wp.int64],  # [N] key and index of every splat, bin by bin
    culled: int,  # key of culled splats [1]
    shift: int,  # lowest bits of a key, which its bin ignores [1]
    first: wp.array[int],  # [COUNTS] first rank of each bin
    # Out:
    order: wp.array[wp.int32],  # [>= N] splats near to far
):
    """A thread per splat, neighbours in one bin."""
    at = wp.tid()
    member = members[at]
    key = int(member >> wp.int64(32))
    rank = at
    if key != culled:
        number = bin_of(key, culled, shift)
        rank = first[number]
        for other in range(first[number], first[number + 1]):
            rank += int(members[other] < member)
    order[rank] = int(member & wp.int64(0xFFFFFFFF))
