"""Writing that leaves either the old content or the new one, never half of it.

A file is written under a temporary name in its own folder, flushed to the disk, and renamed; a folder of many files is
filled under a temporary name beside its target and renamed as a whole. Temporary names are ``.NAME.tmp-PID-COUNT``, so
that what a killed process left can be told from what a living one is writing, and swept.
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

import numpy as np

from ..errors import GftorfError, ResourceError, UsageError

_COUNT = itertools.count()
_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def atomic_write(path: str | Path, data: bytes | memoryview) -> None:
    """Replace the content of a file, all at once.

    Args:
        path: The file; its folder must exist.
        data: The whole new content.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the place cannot be written to.
    """
    path = Path(path)
    sweep(path)
    write_one_of_many(path, data)
    with as_errors(path):
        flush_folder(path.parent)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Let a library write a file that replaces ``path`` only when it is complete.

    Yields a temporary name in the same folder. At a normal end that file is flushed and renamed to ``path``; at an
    exception it is removed and the old content stays.

    Args:
        path: The file; its folder must exist.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the place cannot be written to.
    """
    path = Path(path)
    sweep(path)
    with one_of_many(path) as temporary:
        yield temporary
    with as_errors(path):
        flush_folder(path.parent)


@contextlib.contextmanager
def many_files(folder: str | Path) -> Iterator[None]:
    """Let :func:`one_of_many` and :func:`write_one_of_many` fill a folder.

    What lies in it is looked at once, and its names are flushed once.

    Doing both for every file makes each cost as much as there are files before it, and keeps threads waiting for
    Python's lock meanwhile: listing a folder gives it back and asks for it again with every name.

    Args:
        folder: It must exist.

    Raises:
        ResourceError, UsageError: If it cannot be flushed.
    """
    folder = Path(folder)
    _sweep(folder, ".")
    try:
        yield
    except BaseException:
        _sweep(folder, ".")  # one who wrote here may have been killed
        raise
    finally:
        with as_errors(folder):
            flush_folder(folder)


@contextlib.contextmanager
def one_of_many(path: Path) -> Iterator[Path]:
    """A temporary name for a writer that wants one, in a folder that :func:`many_files` looks after.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the place cannot be written to.
    """
    with as_errors(path), _renamed_to(path) as temporary:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())


def write_one_of_many(path: Path, data: bytes | memoryview) -> None:
    """Replace the content of a file, all at once, in a folder that :func:`many_files` looks after.

    The content is on the disk before it has the name, as in :func:`atomic_write`; the name is on the disk later. So a
    power failure costs names, never a part of a content.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the place cannot be written to.
    """
    with as_errors(path), _renamed_to(path) as temporary:
        write_through(temporary, data)


def write_json(path: str | Path, content: object) -> None:
    """Write an object as JSON, atomically.

    Args:
        path: The file; its folder must exist.
        content: What ``json`` can hold; numpy numbers and arrays and paths are converted.

    Raises:
        ValueError: If it holds NaN or infinity, which JSON cannot express: use None.
    """
    atomic_write(path, (json.dumps(content, indent=2, allow_nan=False, default=_plain) + "\n").encode())


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Fill a folder that appears under its name only when it is complete.

    Yields a temporary folder beside the target, in which the caller writes. At a normal end everything in it is flushed
    and the folder is renamed to ``path``; at an exception it is removed and nothing remains.

    Args:
        path: The folder to create; missing parents are created, an existing one must be empty.

    Raises:
        UsageError: If the target exists and is not an empty folder, or the place cannot be written to.
        ResourceError: If the disk is full.
    """
    path = Path(path)
    with as_errors(path):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise UsageError(
                "not a folder",
                where=path,
                why="expected a new or empty folder to write to, found something else",
                fix="choose another path",
            )
        if path.is_dir() and any(path.iterdir()):
            raise UsageError(
                "folder is not empty",
                where=path,
                why=f"expected a new or empty folder to write to, found {len(list(path.iterdir()))} entries",
                fix="choose another path, or remove the folder first",
            )
        made = [parent for parent in reversed(path.absolute().parents) if not parent.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path)
        temporary = path.absolute().parent / _temporary(path).name
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


def write_through(path: Path, data: bytes | memoryview) -> None:
    """Create a file, flush it to the disk and check its size.

    Raises:
        OSError: If it exists, or could not be written in full.
    """
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
    """Remove what killed processes left of earlier attempts to write ``path``; living ones keep theirs."""
    path = Path(path)
    _sweep(path.absolute().parent, f".{path.name}.tmp-")


def _sweep(folder: Path, start: str) -> None:
    """The same for all temporary names that start so."""
    with contextlib.suppress(OSError):  # another process may sweep at the same time
        for name in [name for name in os.listdir(folder) if name.startswith(start)]:  # few of perhaps many
            match, entry = re.fullmatch(r"\..+\.tmp-(\d+)-\d+", name), folder / name
            if match and not _alive(int(match[1])):
                if entry.is_dir():
                    shutil.rmtree(entry, ignore_errors=True)
                else:
                    entry.unlink(missing_ok=True)


@contextlib.contextmanager
def _renamed_to(path: Path) -> Iterator[Path]:
    """A temporary name: at a normal end it becomes ``path``, at an exception what has it is removed."""
    temporary = _temporary(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.name}.tmp-{os.getpid()}-{next(_COUNT)}"


def _alive(pid: int) -> bool:
    """Whether a process runs; where the system cannot say, yes."""
    if os.name == "nt" or pid <= 0:
        return True  # on Windows os.kill would end the process instead of asking
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


@contextlib.contextmanager
def as_errors(path: Path) -> Iterator[None]:
    """Turn what the system says about writing to ``path`` into errors a user can act on.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If the place cannot be written to.
    """
    try:
        yield
    except GftorfError:
        raise
    except OSError as error:
        if error.errno in _NO_SPACE:
            raise ResourceError(
                "no space left", where=path, why=str(error), fix="free disk space, or write to another disk"
            ) from error
        raise UsageError("cannot write", where=path, why=str(error), fix="choose a place you may write to") from error


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"JSON cannot hold {type(value).__name__}: {value!r}")
