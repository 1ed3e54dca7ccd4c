"""What a reader of foreign recordings returns."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..data.sequence import Sequence, Truth


@dataclass(frozen=True, kw_only=True, eq=False)
class Imported:
    """A foreign recording as a sequence, and every decision that made it one."""

    sequence: Sequence
    """The recording."""
    understood: tuple[str, ...]
    """What was read and how it was taken, a line each, with the source of every value."""
    uncertain: tuple[str, ...] = ()
    """What a layout does not say and was assumed, or seems wrong; a sentence each, a warning."""
    truth: Truth | None = None
    """Ground truth, if the source has it."""


@dataclass
class Notes:
    """Collects what a reader understood and what it is not sure of; lines for :class:`Imported`."""

    understood: list[str] = field(default_factory=list)
    """What was read and how it was taken."""
    uncertain: list[str] = field(default_factory=list)
    """What was assumed, or seems wrong."""
