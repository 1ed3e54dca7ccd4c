"""Lines of numbers in text files: times, trajectories, cameras."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence as Items
from pathlib import Path

from ..data.untrusted import read_text, unreadable

SEPARATORS = re.compile(r"[,;\s]+")


def read_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Number and words of each line; # begins a comment, empty lines count but are left out.

    Words are separated by blanks, commas or semicolons.

    Raises:
        InputError: If the file cannot be read or has no line.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = [word for word in SEPARATORS.split(line.partition("#")[0]) if word]
        if words:
            rows.append((number, words))
    if not rows:
        raise unreadable(path, "expected lines of numbers, found none")
    return rows


def numbers(path: Path, number: int, words: Items[str]) -> list[float]:
    """The words of a line as finite numbers.

    Raises:
        InputError: If one is none; names the line.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        why = f"expected finite numbers in line {number}, found {' '.join(words)[:80]!r}"
        raise unreadable(path, why)
    return values
