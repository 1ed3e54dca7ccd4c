"""Fixes for names that do not exist: which known name is similar."""

import difflib
from collections.abc import Iterable

SIMILAR = 0.5  # [1] of the letters of two names; `batch` and `schedule.batch` share 0.53


def similar(name: str, known: Iterable[str]) -> str | None:
    """The most similar of the ``known`` names; None if none is similar."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=SIMILAR)
    return close[0] if close else None


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """A fix for an unknown name: a question after the most similar of the ``known`` ones, or
    ``otherwise`` if none is similar.
    """
    close = similar(name, known)
    return otherwise if close is None else f"did you mean {close}?"
