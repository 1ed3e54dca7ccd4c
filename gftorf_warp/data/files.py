"""Atomic writing: after a crash there is the old content or the new one, never a part of it.

A file is written under a temporary name in its folder, flushed to the disk, and renamed; a folder
is filled under a temporary name next to its target and renamed as a whole. Temporary names are
``.NAME.tmp-PID-COUNT``, so that files of processes that no longer run are recognised and removed.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import GftorfError, ResourceError, UsageError

_COUNT = itertools.count()
_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def atomic_write(path: str | Path, data: bytes | memoryview) -> None:
    """Replace the content of a file in an existing folder atomically.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the file cannot be written.
    """
    sweep(path)
    write_one_of_many(Path(path), data)
    with as_errors(Path(path)):
        flush_folder(Path(path).parent)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Temporary file name for a library to write to; the file replaces ``path`` at a normal end.

    After an exception it is removed and the old content stays. Raises as :func:`atomic_write`.
    """
    path = Path(path)
    sweep(path)
    with one_of_many(path) as temporary:
        yield temporary
    with as_errors(path):
        flush_folder(path.parent)


@contextlib.contextmanager
def many_files(folder: str | Path) -> Iterator[None]:
    """Fill an existing folder by :func:`one_of_many` and :func:`write_one_of_many`: it is listed
    and flushed once, since listing it for every file takes quadratic time and holds up threads.

    Raises:
        ResourceError, UsageError: If it cannot be flushed.
    """
    folder = Path(folder)
    _sweep(folder, ".")
    try:
        yield
    except BaseException:
        _sweep(folder, ".")  # a process that wrote here may have been killed
        raise
    finally:
        with as_errors(folder):
            flush_folder(folder)


@contextlib.contextmanager
def one_of_many(path: Path) -> Iterator[Path]:
    """:func:`atomic_path` for one of the files of a folder inside :func:`many_files`."""
    with as_errors(path), _renamed_to(path) as temporary:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())


def write_one_of_many(path: Path, data: bytes | memoryview) -> None:
    """:func:`atomic_write` for one of the files of a folder inside :func:`many_files`.

    The content is on the disk before the name is, so a power failure may lose a file, but leaves
    none incomplete.
    """
    with as_errors(path), _renamed_to(path) as temporary:
        write_through(temporary, data)


def write_json(path: str | Path, content: object) -> None:
    """Write an object as JSON atomically; numpy numbers and arrays and paths are converted.

    Raises:
        ValueError: If it contains NaN or infinity, which JSON cannot express: use None.
    """
    atomic_write(path, f"{json_text(content, indent=2)}\n".encode())


def json_text(content: object, **layout: Any) -> str:
    """An object as JSON, as :func:`write_json` writes it, in a layout of ``json.dumps``."""
    return json.dumps(content, allow_nan=False, default=_plain, **layout)


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Temporary folder to fill, which is flushed and renamed to ``path`` at a normal end.

    After an exception it is removed. Missing parents of ``path`` are created.

    Raises:
        UsageError: If the target exists and is not an empty folder, or cannot be written.
        ResourceError: If the disk is full.
    """
    path = Path(path)
    with as_errors(path):
        refuse_target(path)
        made = [parent for parent in reversed(path.absolute().parents) if not parent.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path)
        temporary = path.absolute().parent / temporary_name(path).name
        try:
            temporary.mkdir()
            yield temporary
            for folder, _, _ in os.walk(temporary, topdown=False):
                flush_folder(folder)
            if path.exists():
                path.rmdir()  # it is empty; Windows cannot rename over it
            os.rename(temporary, path)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            for parent in reversed(made):
                with contextlib.suppress(OSError):
                    parent.rmdir()
            raise
        flush_folder(path.parent)


def refuse_target(path: Path) -> None:
    """Check that a folder may be written there: the path is new or an empty folder.

    Raises:
        UsageError: If not.
    """
    why = "expected a new or empty folder to write to, found"
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        why, fix = f"{why} something else", "choose another path"
        raise UsageError("not a folder", where=path, why=why, fix=fix)
    if path.is_dir() and any(path.iterdir()):
        why = f"{why} {len(list(path.iterdir()))} entries"
        fix = "choose another path, or remove the folder first"
        raise UsageError("folder is not empty", where=path, why=why, fix=fix)


def write_through(path: Path, data: bytes | memoryview) -> None:
    """Create a file, flush it to the disk and check its size; OSError if it exists or differs."""
    with open(path, "xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        size = os.fstat(file.fileno()).st_size
    if size != len(data):
        raise OSError(errno.ENOSPC, f"{size} of {len(data)} bytes were written", str(path))


def flush_folder(path: str | Path) -> None:
    """Flush the names in a folder to the disk, where the system can."""
    if os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sweep(path: str | Path) -> None:
    """Remove temporary files of ``path`` that belong to processes which no longer run."""
    path = Path(path)
    _sweep(path.absolute().parent, f".{path.name}.tmp-")


def _sweep(folder: Path, start: str) -> None:
    """:func:`sweep` for all temporary names with this start."""
    with contextlib.suppress(OSError):  # another process may sweep at the same time
        # few of perhaps many
        for name in [name for name in os.listdir(folder) if name.startswith(start)]:
            match, entry = re.fullmatch(r"\..+\.tmp-(\d+)-\d+", name), folder / name
            if match and not _alive(int(match[1])):
                if entry.is_dir():
                    shutil.rmtree(entry, ignore_errors=True)
                else:
                    entry.unlink(missing_ok=True)


@contextlib.contextmanager
def _renamed_to(path: Path) -> Iterator[Path]:
    """Temporary file name, renamed to ``path`` at a normal end, removed after an exception."""
    temporary = temporary_name(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def temporary_name(path: Path) -> Path:
    """A name beside a path that no other file has, swept when this process no longer runs."""
    return path.parent / f".{path.name}.tmp-{os.getpid()}-{next(_COUNT)}"


def _alive(pid: int) -> bool:
    """Whether a process runs; true where the system cannot tell."""
    if os.name == "nt" or pid <= 0:
        return True  # on Windows os.kill would end the process
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


@contextlib.contextmanager
def as_errors(path: Path) -> Iterator[None]:
    """Convert an OSError while writing ``path`` to ResourceError (full disk) or UsageError."""
    try:
        yield
    except GftorfError:
        raise
    except OSError as error:
        why, fix = str(error), "choose a writable folder"
        if error.errno in _NO_SPACE:
            fix = "free disk space, or write to another disk"
            raise ResourceError("no space left", where=path, why=why, fix=fix) from error
        raise UsageError("cannot write", where=path, why=why, fix=fix) from error


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"JSON cannot hold {type(value).__name__}: {value!r}")
