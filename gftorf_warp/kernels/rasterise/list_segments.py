"""A tile's list in parts of equal length, so that several warps walk it back at once.

One warp walks a list in the time that its entries take one after the other, whatever else a GPU could do meanwhile. On
the way back, front to back order only enters by two numbers of a pixel, T and E (composite_backward.py). So the forward
pass leaves, where a part ends, T and what each later part has added to the pixel: E behind a part is the gradient of
the outputs times the sum of what all later parts have added, light twice, since it is weighed by T^2. Each part keeps a
sum of its own, and later ones are added up from the back: differences of sums over the whole list would be noise
behind a surface.
"""

import warp as wp

from .shared_batches import ROUND

SHORTEST = wp.constant(64)  # entries of a part at least: the state of a pixel is read and written for each
PLANES = 5  # of each end but the last: T there, and what the next part adds to RE, IM, AMPLITUDE and DISTANCE


@wp.func
def part_length(count: int, parts: int) -> int:
    """Entries of a part of a list of ``count``, whole rounds; those at its end may have fewer, or none."""
    rounds = (count + parts * ROUND - 1) // (parts * ROUND)
    return wp.max(rounds * ROUND, SHORTEST)
