"""Deterministic gradients: one gradient record per (tile, splat) pair, summed in a fixed order.

With a record per pair there is a single writer; the records of a splat are then summed in the order
of its pairs, which depends on the splats alone.
"""

import warp as wp

from .splat import Splat


@wp.kernel(enable_backward=False)
def number_pairs(
    # In:
    total: wp.array[int],  # [1] number of pairs, also of those that do not fit
    capacity: int,  # pairs that fit [1]
    # Out:
    ids: wp.array[wp.int32],  # [>= capacity] splat of each pair, replaced by the pair's number
    owners: wp.array[wp.int32],  # [capacity] splat of each pair; 0 where there is none
):
    """One thread per pair that fits."""
    k = wp.tid()
    owner = int(0)
    if k < wp.min(total[0], capacity):
        owner = ids[k]
    owners[k] = owner
    ids[k] = k


@wp.kernel(enable_backward=False)
def spread_records(
    # In:
    splats: wp.array[Splat],  # [N] records
    owners: wp.array[wp.int32],  # [capacity] splat of each pair
    # Out:
    copies: wp.array[Splat],  # [capacity] the record of each pair
):
    """One thread per pair that fits."""
    k = wp.tid()
    copies[k] = splats[owners[k]]


@wp.kernel(enable_backward=False)
def sum_copies(
    # In:
    order: wp.array[wp.int32],  # [>= N] splats near to far
    ends: wp.array[int],  # [N] sums of counts: where the pairs of each splat end, in depth order
    copies: wp.array[Splat],  # [capacity] gradient record of each pair
    capacity: int,  # pairs that fit [1]
    # Out:
    records: wp.array[Splat],  # [N] added to
):
    """One thread per splat: its pairs in the order in which they were written."""
    rank = wp.tid()
    begin = int(0)
    if rank > 0:
        begin = ends[rank - 1]
    record = records[order[rank]]
    for k in range(begin, wp.min(ends[rank], capacity)):
        record = record + copies[k]
    records[order[rank]] = record
