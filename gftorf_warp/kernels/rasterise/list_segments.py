"""A tile's list in segments of equal length, so that several warps traverse it at once in the
backward pass.

One warp takes the entries of a list one after the other, however much of a GPU is idle. In the
backward pass, the order enters by two numbers of a pixel only, T and E (composite_backward.py). So
the forward pass stores, where a segment ends, T and what each later segment has added to the pixel:
E behind a segment is the gradient of the outputs times the sum over all later segments, light
twice, since it is weighed by T^2. Sums of later segments are added from the back: differences of
sums over the whole list would be noise behind a surface.
"""

import warp as wp

from .shared_batches import ROUND

# entries of a segment at least: the state of a pixel is read and written for each
SHORTEST = wp.constant(64)
# of each end but the last: T there, and what the next segment adds to RE, IM, AMPLITUDE and
# DISTANCE
PLANES = 5


@wp.func
def segment_length(count: int, segments: int) -> int:
    """Entries per segment of a list of ``count``: whole rounds; the last ones may have fewer."""
    rounds = (count + segments * ROUND - 1) // (segments * ROUND)
    return wp.max(rounds * ROUND, SHORTEST)
