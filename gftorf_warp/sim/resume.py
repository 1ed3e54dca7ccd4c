"""Resume interrupted recordings: finished images are kept in the folder OUT.partial beside OUT.

Each image of a recording is a file there, renamed into place when it is complete, so that after any
interruption the same command computes only the missing ones and ends with the same bytes.
``unfinished.md`` in the folder holds the settings; no reader takes it for a sequence, and it is
removed when OUT is complete.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..data.files import as_errors, atomic_write
from ..data.folder import UNFINISHED
from ..data.lock import locked
from ..errors import UsageError
from .record import Cached, Images

CARD = "README.md"
LOCK = ".lock"
MARKS = (
    ("cams/depth_range.npy", "tofType0"),
    ("cams/depth_range.npy", "tof"),
    ("capture.json", "tof"),
)
"""What every folder that we write holds, by layout."""
OTHER = "continue with the same settings, choose another --out, or start over with --fresh"


def needs_recording(out: Path, card: str, *, fresh: bool) -> bool:
    """Whether ``out`` has to be recorded: False if it is a sequence with these settings.

    The ``card`` of settings is the beginning of its README.md; ``fresh``: another may be renamed.

    Raises:
        UsageError: If ``out`` holds anything else that may not be renamed, or OUT.partial another
            recording.
    """
    _refuse_other_partial(partial_of(out), card, fresh=fresh)
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return True
    sequence = any(all((out / mark).exists() for mark in marks) for marks in MARKS)
    text = (out / CARD).read_text(errors="replace") if sequence and (out / CARD).is_file() else ""
    if not fresh and text.startswith(card):
        # of a process that was killed just before it removed it
        _remove(partial_of(out))
        return False
    if fresh and sequence:
        return True
    what = "the folder is not empty" if out.is_dir() else "not a folder"
    why, fix = "it holds something that is no sequence", "choose another --out"
    if sequence:
        why = "it holds a sequence made with other settings"
        fix += ", or move this one aside with --fresh"
    raise UsageError(what, where=out, why=why, fix=fix)


def set_aside(out: Path) -> None:
    """Rename a folder with content to the first free ``OUT-old-N``."""
    if out.exists() and any(out.iterdir()):
        number = 1
        while out.with_name(f"{out.name}-old-{number}").exists():
            number += 1
        out.rename(out.with_name(f"{out.name}-old-{number}"))


def partial_of(out: Path) -> Path:
    """The folder of finished images of an interrupted recording."""
    out = out.absolute()
    return out.with_name(f"{out.name}.partial")


@contextlib.contextmanager
def cached_images(out: Path, card: str, *, fresh: bool) -> Iterator[Cached]:
    """A cache of finished images in OUT.partial, locked meanwhile, removed at a normal end.

    After an exception or a killed process it stays, unless no image was finished. Arguments as for
    :func:`needs_recording`; ``fresh`` discards finished images.

    Raises:
        BusyError: If another process records the same.
        UsageError: If the folder cannot be written to.
        ResourceError: If the disk is full.
    """
    folder = partial_of(out)
    made = [parent for parent in folder.parents if not parent.exists()]
    with as_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder, LOCK, "sequence"):
            _refuse_other_partial(folder, card, fresh=fresh)
            if fresh:
                for path in _images(folder):
                    path.unlink()
            atomic_write(folder / UNFINISHED, card.encode())
            yield lambda name, make: _cached(folder / f"{name}.npz", make)
        _remove(folder)
    except BaseException:
        if not _images(folder) and not _is_held(folder):
            _remove(folder)
            for parent in made:
                with contextlib.suppress(OSError):
                    parent.rmdir()
        raise


def _refuse_other_partial(folder: Path, card: str, *, fresh: bool) -> None:
    # the lock, and what a process left that was killed while it wrote the settings
    empty = folder.is_dir() and all(path.name.startswith(".") for path in folder.iterdir())
    if empty or not folder.exists():
        return
    begun = folder / UNFINISHED
    if not begun.is_file():
        what = "the folder of finished images is in use"
        why = "it holds something that is no recording"
        raise UsageError(what, where=folder, why=why, fix="choose another --out")
    if not fresh and begun.read_text(encoding="utf-8", errors="replace") != card:
        why = "an interrupted recording with other settings left it there"
        raise UsageError("another recording was begun", where=folder, why=why, fix=OTHER)


def _cached(path: Path, make: Callable[[], Images]) -> tuple[Images, bool]:
    """The images of a file, or those that ``make`` returns, which are then stored in it."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return dict(stored), False
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # missing or truncated
        images = make()
    temporary = path.with_suffix(".tmp")
    with as_errors(path):
        with temporary.open("wb") as target:
            np.savez(target, allow_pickle=False, **images)
        os.replace(temporary, path)
    return images, True


def _remove(folder: Path) -> None:
    """Remove the folder, its settings last: after a kill it is still that of this recording."""
    for path in (*_images(folder), *folder.glob("*.tmp")):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def _images(folder: Path) -> list[Path]:
    return list(folder.glob("*.npz"))


def _is_held(folder: Path) -> bool:
    """Whether a process holds the lock: then the folder must not be removed here."""
    return (folder / LOCK).is_file() and (folder / LOCK).stat().st_size > 0
