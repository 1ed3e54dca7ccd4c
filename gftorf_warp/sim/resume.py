"""Where a sequence is written, and what an interrupted recording has finished: the folder OUT.partial beside OUT.

Each image of a recording is a file of its own there, renamed into place when it is complete, so that after any
interruption the same command makes the missing ones only and ends with the same bytes. The folder says in
``unfinished.md`` what is being recorded; nothing reads it as a sequence, and it is gone when OUT is there.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..data.files import as_errors
from ..data.folder import UNFINISHED
from ..data.lock import locked
from ..errors import UsageError
from .record import Cached, Images

CARD = "README.md"
LOCK = ".lock"
MARKS = (("cams/depth_range.npy", "tofType0"), ("cams/depth_range.npy", "tof"), ("capture.json", "tof"))
"""What every folder that we write holds, by layout."""
OTHER = "continue with the same settings, choose another --out, or start over with --fresh"


def needs_recording(out: Path, card: str, *, fresh: bool) -> bool:
    """Whether there is anything to do: False if ``out`` holds what these settings give.

    Args:
        out: Folder of the sequence.
        card: Settings of the recording, as its README.md begins.
        fresh: Whether another sequence there may be moved aside.

    Raises:
        UsageError: If ``out`` holds anything else that may not be moved aside, or OUT.partial something else.
    """
    _refuse_other_partial(partial_of(out), card, fresh=fresh)
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return True
    sequence = any(all((out / mark).exists() for mark in marks) for marks in MARKS)
    text = (out / CARD).read_text(errors="replace") if sequence and (out / CARD).is_file() else ""
    if not fresh and text.startswith(card):
        shutil.rmtree(partial_of(out), ignore_errors=True)  # of a process that was killed on its last metre
        return False
    if fresh and sequence:
        return True
    raise UsageError(
        "the folder is not empty" if out.is_dir() else "not a folder",
        where=out,
        why="it holds a sequence made with other settings" if sequence else "it holds something that is no sequence",
        fix="choose another --out" + (", or move this one aside with --fresh" if sequence else ""),
    )


def set_aside(out: Path) -> None:
    """Rename a folder with content to the first free ``OUT-old-N``."""
    if out.exists() and any(out.iterdir()):
        number = 1
        while out.with_name(f"{out.name}-old-{number}").exists():
            number += 1
        out.rename(out.with_name(f"{out.name}-old-{number}"))


def partial_of(out: Path) -> Path:
    """The folder of what is unfinished."""
    out = out.absolute()
    return out.with_name(f"{out.name}.partial")


@contextlib.contextmanager
def cached_images(out: Path, card: str, *, fresh: bool) -> Iterator[Cached]:
    """Hold OUT.partial while a recording goes on; at a normal end it is removed.

    After an exception or a killed process it stays, unless not one image was finished.

    Args:
        out: Folder of the sequence, see :func:`needs_recording`.
        card: Settings of the recording.
        fresh: Whether to begin again.

    Raises:
        BusyError: If another process records the same.
        UsageError: If the place cannot be written to.
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
            with as_errors(folder):
                (folder / UNFINISHED).write_text(card, encoding="utf-8")
            yield lambda name, make: _cached(folder / f"{name}.npz", make)
        shutil.rmtree(folder)
    except BaseException:
        if not _images(folder) and not _is_held(folder):
            shutil.rmtree(folder, ignore_errors=True)
            for parent in made:
                with contextlib.suppress(OSError):
                    parent.rmdir()
        raise


def _refuse_other_partial(folder: Path, card: str, *, fresh: bool) -> None:
    if not folder.exists() or (folder.is_dir() and not any(path.name != LOCK for path in folder.iterdir())):
        return
    begun = folder / UNFINISHED
    if not begun.is_file():
        why = "it holds something that no recording left there"
        raise UsageError("in the way of what is unfinished", where=folder, why=why, fix="choose another --out")
    if not fresh and begun.read_text(encoding="utf-8", errors="replace") != card:
        why = "an interrupted recording with other settings left it there"
        raise UsageError("another recording was begun", where=folder, why=why, fix=OTHER)


def _cached(path: Path, make: Callable[[], Images]) -> tuple[Images, bool]:
    """The images of a file, or those that ``make`` makes, which are then in the file."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return dict(stored), False
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # not there, or cut off when power failed
        images = make()
    temporary = path.with_suffix(".tmp")
    with as_errors(path):
        with temporary.open("wb") as target:
            np.savez(target, allow_pickle=False, **images)
        os.replace(temporary, path)
    return images, True


def _images(folder: Path) -> list[Path]:
    return list(folder.glob("*.npz"))


def _is_held(folder: Path) -> bool:
    """Whether a process names itself in the lock: then the folder is not ours to remove."""
    return (folder / LOCK).is_file() and (folder / LOCK).stat().st_size > 0
