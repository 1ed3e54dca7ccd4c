"""Number of (tile, splat) pairs for which a rendering reserves memory without reading it back."""

from __future__ import annotations

import math

ROUNDED_TO = 1 << 16  # capacities are multiples of it
# steps: pairs that grow by half in 30 take 16 from ``FULL`` to the end, and the host may be 8 ahead
READ_EVERY = 8
FULL = 0.8  # fraction of the capacity above which it grows
PATIENCE = 5  # readbacks in a row before it shrinks: opacity resets empty it for a while
# capacity over the largest number of pairs; fraction below which it shrinks
SORTED, LISTED = (1.5, 0.4), (3.0, 0.05)


class PairCapacity:
    """Pairs that fit into one rendering, from the numbers of the last renderings.

    A sort takes time for every reserved pair; for lists from a bit mask one costs 4 bytes only.
    """

    def __init__(self) -> None:
        self.pairs: int | None = None
        """Pairs that fit; None: unknown yet, so they are counted first, which synchronises with the
        device."""
        self._empty = 0  # readbacks in a row below the smallest fraction

    def fits(self, pairs: int) -> bool:
        """Whether no pair of a rendering with so many was dropped."""
        return self.pairs is None or pairs <= self.pairs

    def is_nearly_full(self, pairs: int) -> bool:
        """Whether the capacity should grow before it is exceeded."""
        return self.pairs is not None and pairs > FULL * self.pairs

    def learn(self, pairs: int, *, is_sorted: bool = False) -> bool:
        """Adapt to the largest number of pairs of a rendering since the last call.

        Args:
            pairs: That number; nothing is learnt from a rendering without pairs.
            is_sorted: Whether lists are made by a sort, see ``Frame.marks``.

        Returns:
            Whether the capacity changed, so that CUDA graphs with the old one must be released.
        """
        if not pairs:
            return False
        factor, nearly_empty = SORTED if is_sorted else LISTED
        if self.pairs is not None:
            self._empty = self._empty + 1 if pairs < nearly_empty * self.pairs else 0
            if not self.is_nearly_full(pairs) and self._empty <= PATIENCE:
                return False
        self.pairs, self._empty = math.ceil(factor * pairs / ROUNDED_TO) * ROUNDED_TO, 0
        return True
