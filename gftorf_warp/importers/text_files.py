"""Lines of numbers in text files: times, trajectories, cameras."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence as Items
from pathlib import Path

from ..errors import InputError

BYTES_MAX = 1 << 28  # 256 MB: a million lines of a pose
SEPARATORS = re.compile(r"[,;\s]+")


def read_text(path: Path, bytes_max: int = BYTES_MAX) -> str:
    """The text of a file, of UTF-8 or plain ASCII.

    Raises:
        InputError: If it cannot be read, is no text, or is too large.
    """
    try:
        if not path.is_file():  # opening a pipe would block
            found = "a folder" if path.is_dir() else "nothing that can be read"
            raise unreadable(path, f"expected a text file, found {found}")
        if path.stat().st_size > bytes_max:
            found = f"{path.stat().st_size}"
            raise unreadable(path, f"expected at most {bytes_max} bytes, found {found}")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise unreadable(path, error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise unreadable(path, f"expected text, found {error}") from error


def unreadable(path: Path, why: str) -> InputError:
    """The error for a file that is not what its name says."""
    return InputError("cannot be read", where=path, why=why, fix="export the file again")


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
        found = [float(word) for word in words]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        why = f"expected finite numbers in line {number}, found {' '.join(words)[:80]!r}"
        raise unreadable(path, why)
    return found
