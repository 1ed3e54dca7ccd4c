"""How many (tile, splat) pairs a captured step has room for: known before it runs, unlike their number."""

from __future__ import annotations

import math

ROOM = 1.5  # pairs that are reserved, over the most that were seen
PAIRS = 1 << 16  # in such numbers
FULL, EMPTY = 0.8, 0.4  # shares of a reserve at which another one is made; a smaller one only if it lasts for
PATIENCE = 5  # looks: a reset of the opacities empties it for a while


class Reserve:
    """Room for the pairs of one image, as large as the last images needed, and some more."""

    def __init__(self) -> None:
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
            self._empty = self._empty + 1 if pairs < EMPTY * self.capacity else 0
            if not self.is_nearly_full(pairs) and self._empty <= PATIENCE:
                return False
        self.capacity, self._empty = math.ceil(ROOM * pairs / PAIRS) * PAIRS, 0
        return True
