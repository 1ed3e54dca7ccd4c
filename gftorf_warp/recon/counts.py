"""Counts of training steps on the device: skipped updates, and the pairs that the pair capacity
follows.
"""

from __future__ import annotations

import logging

from jaxtyping import Int
from torch import Tensor

from ..render.cuda import DeviceReadback
from ..render.pair_capacity import READ_EVERY, PairCapacity
from .state import State

LOG = logging.getLogger("gftorf_warp")


class StepCounts:
    """Reads the counts of the steps of one run."""

    def __init__(self, counts: Int[Tensor, "4"], *, limited: bool, waits: bool):
        """Nothing is known yet.

        Args:
            counts: Of ``StepResults``.
            limited: Whether renderings have a pair capacity, as on CUDA.
            waits: Whether every readback is waited for: when it arrives depends on the machine.
        """
        self._counts, self._limited, self._waits = counts, limited, waits
        self._readback, self._replays = DeviceReadback(counts), 0
        self._capacity = PairCapacity()

    @property
    def capacity(self) -> int | None:
        """(tile, splat) pairs with memory in a rendering; None: as many as it has."""
        return self._capacity.pairs if self._limited else None

    @property
    def has_capacity(self) -> bool:
        """Whether pairs were counted since :meth:`forget`."""
        return self._capacity.pairs is not None

    def forget(self) -> None:
        """Other renderings follow: their pairs are counted first."""
        self._capacity = PairCapacity()

    def read(self, state: State, *, is_sorted: bool) -> tuple[int, bool]:
        """Read how many steps were skipped, and adapt the pair capacity; waits for the device.

        Args:
            state: Counts skipped steps.
            is_sorted: Whether (tile, splat) pairs are sorted.

        Returns:
            Number of skipped steps in a row; whether the capacity changed, so that graphs with the
            old one must be released.
        """
        skipped, in_a_row, pairs, overflowed = self._counts.tolist()
        state.skipped += skipped
        if skipped:
            text = (
                "%d steps before image %d skipped: %d with too many (tile, splat) pairs, the "
                "others not finite"
            )
            LOG.warning(text, skipped, state.images, overflowed)
        self._counts[0] = 0
        self._counts[2:] = 0
        changed = self._limited and self._capacity.learn(pairs, is_sorted=is_sorted)
        return 0 if overflowed else in_a_row, changed

    def is_nearly_full(self) -> bool:
        """Whether the capacity should grow before it is exceeded, by counts of a few replays ago;
        called once per replay, without waiting.
        """
        if not self._limited:
            return False
        self._replays += 1
        if self._replays % READ_EVERY == 0:
            self._readback.request()
        counts = self._readback.latest(wait=self._waits)
        return counts is not None and self._capacity.is_nearly_full(counts[2])
