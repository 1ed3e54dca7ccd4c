"""A tile's list in segments of equal length, one warp for each in the backward pass.

The order enters by two numbers of a pixel, T and E (composite_backward.py). The forward pass stores
T where a segment ends, and what each later segment has added to the pixel: E behind a segment is
the gradient of the outputs times the sum over all later ones, light twice, as its weight is T^2.
Later segments are added from the back: differences of sums would be noise behind a surface.
"""

import warp as wp

from .shared_batches import ROUND

# entries of a segment at least: the state of a pixel is read and written for each
SHORTEST = wp.constant(64)
# of each end but the last: T, and the next segment's share of RE, IM, AMPLITUDE and DISTANCE
PLANES = 5


@wp.func
def segment_length(count: int, segments: int) -> int:
    """Entries per segment of a list of ``count``: whole rounds; the last ones may have fewer."""
    rounds = (count + segments * ROUND - 1) // (segments * ROUND)
    return wp.max(rounds * ROUND, SHORTEST)
