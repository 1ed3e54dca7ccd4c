"""How many (tile, splat) pairs a captured step has room for: known before it runs, unlike their number."""

from __future__ import annotations

import math

PAIRS = 1 << 16  # in such numbers
FULL = 0.8  # share of a reserve at which a larger one is made
PATIENCE = 5  # looks that must find it nearly empty in a row: a reset of the opacities empties it for a while


class Reserve:
    """Room for the pairs of one image, as large as the last images needed, and some more.

    Where pairs are sorted, every place of the reserve is, so room is scarce. Elsewhere it costs 4 bytes a pair, and
    another reserve costs new graphs.
    """

    def __init__(self, *, scarce: bool = True) -> None:
        self._room = 1.5 if scarce else 3.0  # pairs that are reserved, over the most that were seen
        self._nearly_empty = 0.4 if scarce else 0.05  # share below which a smaller one is made
        self.capacity: int | None = None
        """Pairs that fit; None: nothing is known yet, and pairs are counted first."""
        self._empty = 0  # looks in a row that found it nearly empty

    def is_nearly_full(self, pairs: int) -> bool:
        """Whether so many pairs of an image ask for more room before another step."""
        return self.capacity is not None and pairs > FULL * self.capacity

    def learn(self, pairs: int) -> bool:
        """Look at the most pairs of an image since the last look; 0: there was none.

        Returns:
            Whether the room is another one now, so that graphs which know the old one must go.
        """
        if not pairs:
            return False
        if self.capacity is not None:
            self._empty = self._empty + 1 if pairs < self._nearly_empty * self.capacity else 0
            if not self.is_nearly_full(pairs) and self._empty <= PATIENCE:
                return False
        self.capacity, self._empty = math.ceil(self._room * pairs / PAIRS) * PAIRS, 0
        return True
