"""Files without a self-description, read whole, never larger than what is on the disk."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ..data.resources import Need, require
from ..data.untrusted import check_links, unreadable
from ..errors import InputError


def files_of(source: Path) -> list[Path]:
    """The file itself, or the files of a folder in natural order, ``2.bin`` before ``10.bin``;
    hidden files are ignored.

    Raises:
        InputError: If the folder has no files, a link out of it, or cannot be listed.
    """
    if not source.is_dir():
        return [source]
    try:
        check_links(source)
        files = [path for path in source.iterdir() if path.is_file() and path.name[0] != "."]
    except OSError as error:
        raise unreadable(source, error.strerror or str(error)) from error
    if not files:
        why, fix = "expected the files of a recording, found none", "check the path"
        raise InputError("an empty folder", where=source, why=why, fix=fix)
    return sorted(files, key=lambda path: natural(path.name))


def check_resources(need: Need, where: Path) -> None:
    """Check that memory and disk can hold a recording.

    Raises:
        ResourceError: If not.
    """
    fix = "import a part of the recording: give fewer files, of kind arrays by source.files"
    require(need, where, fix)


def natural(name: str) -> list[tuple[int, str]]:
    """Key that sorts names with numbers by these numbers."""
    parts = re.split(r"(\d{1,18})", name)
    return [(int(part), "") if n % 2 else (0, part) for n, part in enumerate(parts)]


def size_of(path: Path) -> int:
    """Bytes of a file.

    Raises:
        InputError: If it is no file.
    """
    if not path.is_file():  # reading a pipe would block
        raise unreadable(path, f"expected a file, found {'a folder' if path.is_dir() else 'none'}")
    return path.stat().st_size


def buffers_of(
    files: list[Path], step: int, what: str, hint: Callable[[int], str] = lambda _: ""
) -> list[tuple[Path, int]]:
    """File and first byte of each buffer of ``step`` bytes in files that have nothing else.

    Args:
        files: The files, in order.
        step: Bytes of a buffer.
        what: What a buffer is, for the error.
        hint: From the size of a file that does not fit, a text that explains it.

    Raises:
        InputError: If a file is empty or has a part of a buffer.
    """
    buffers = []
    for path in files:
        size = size_of(path)
        if size == 0 or size % step:
            why = f"expected buffers of {step} bytes ({what}), found {size} bytes{hint(size)}"
            raise InputError("not whole buffers", where=path, why=why, fix="correct the keys")
        buffers += [(path, first) for first in range(0, size, step)]
    return buffers


def raw_bytes(path: Path, first: int = 0, count: int | None = None) -> UInt8[np.ndarray, "n"]:
    """``count`` bytes of a file from byte ``first`` on; None: up to its end.

    Raises:
        InputError: If it has fewer, or cannot be read.
    """
    size = size_of(path)
    count = size - first if count is None else count
    if not 0 <= first <= first + count <= size:
        why = f"expected {count} bytes from byte {first} on, found {max(size - first, 0)}"
        raise InputError("truncated", where=path, why=why, fix="copy or record the file again")
    try:
        return np.fromfile(path, np.uint8, count, offset=first)
    except OSError as error:
        raise unreadable(path, error.strerror or str(error)) from error
