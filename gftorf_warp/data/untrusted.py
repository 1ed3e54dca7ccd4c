"""Content of files that others wrote, and the error for one that is not what its name says."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError

TEXT_MAX = 1 << 28  # 256 MB: a million lines of a pose, or raw frames of a capture
PACKED_MAX = 1100  # bytes from one byte of a file: deflate packs at most 1032


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The content of a file of at most so many bytes.

    Raises:
        InputError: If it is no file, too large, or cannot be read.
    """
    if not path.is_file():  # opening a pipe would block
        found = "a folder" if path.is_dir() else "a pipe or a device" if path.exists() else "none"
        raise unreadable(path, f"expected a file, found {found}")
    try:
        size = path.stat().st_size
        if most is not None and size > most:
            raise unreadable(path, f"expected at most {most} bytes, found {size}")
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error.strerror or str(error)) from error


def read_text(path: Path, most: int = TEXT_MAX) -> str:
    """The text of a file of at most so many bytes, UTF-8 or plain ASCII.

    Raises:
        InputError: As :func:`read_bytes`, or if it is no text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(path, f"expected text, found {error}") from error


def unreadable(path: Path, why: str) -> InputError:
    """The error for a file that is not what its name says."""
    return InputError("unreadable", where=path, why=why, fix="copy or export the file again")
