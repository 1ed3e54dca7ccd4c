"""How many (tile, splat) pairs a captured step has room for: known before it runs, unlike their number."""

from __future__ import annotations

import math

PAIRS = 1 << 16  # in such numbers
SCARCE, PLENTY = (1.5, 0.4), (3.0, 0.05)  # room over the most that was seen; share below which less is made
FULL = 0.8  # share of a reserve at which a larger one is made
ASK_EVERY = 8  # steps: pairs that grow by half in 30 take 16 from FULL to the end, and the host may be 8 ahead
PATIENCE = 5  # looks that must find it nearly empty in a row: a reset of the opacities empties it for a while


class Reserve:
    """Room for the pairs of one image, as large as the last images needed, and some more.

    Where pairs are sorted, every place of the reserve is, so room is scarce. Elsewhere it costs 4 bytes a pair, and
    another reserve costs new graphs.
    """

    def __init__(self) -> None:
        self.capacity: int | None = None
        """Pairs that fit; None: nothing is known yet, and pairs are counted first."""
        self._empty = 0  # looks in a row that found it nearly empty

    def is_nearly_full(self, pairs: int) -> bool:
        """Whether so many pairs of an image ask for more room before another step."""
        return self.capacity is not None and pairs > FULL * self.capacity

    def learn(self, pairs: int, *, scarce: bool) -> bool:
        """Look at the most pairs of an image since the last look.

        Args:
            pairs: How many; 0: there was no image.
            scarce: Whether they are sorted.

        Returns:
            Whether the room is another one now, so that graphs which know the old one must go.
        """
        if not pairs:
            return False
        room, nearly_empty = SCARCE if scarce else PLENTY
        if self.capacity is not None:
            self._empty = self._empty + 1 if pairs < nearly_empty * self.capacity else 0
            if not self.is_nearly_full(pairs) and self._empty <= PATIENCE:
                return False
        self.capacity, self._empty = math.ceil(room * pairs / PAIRS) * PAIRS, 0
        return True
