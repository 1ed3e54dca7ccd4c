"""States on disk: written all at once, checked by SHA-256, read without running code,
the last two kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from ..data.files import atomic_path, atomic_write, sweep, temporary_name, write_through
from ..data.untrusted import SMALL_FILE_BYTES, read_bytes
from ..errors import GftorfError, InputError
from .state import FORMAT

LOG = logging.getLogger("gftorf_warp")
KEPT = 2  # checkpoints in a run: the last one, and one before in case it is damaged later


def folder(run: Path) -> Path:
    """Where the checkpoints of a run are."""
    return run / "ckpt"


def save(run: Path, stored: dict) -> Path:
    """Write a state as ``RUN/ckpt/<images>.pt`` with its SHA-256 in a sidecar, and drop all but the
    last two.

    The file is read back and compared before another one is dropped. Checkpoints of more images are
    dropped too: the run has gone back behind them.

    Raises:
        ResourceError: If the disk is full.
        InputError: If what came back from the disk is not what was written.
    """
    checkpoints = folder(run)
    checkpoints.mkdir(exist_ok=True)
    buffer = io.BytesIO()
    torch.save(stored, buffer)
    data = buffer.getvalue()
    path = checkpoints / f"{_name(int(stored['images']))}.pt"
    _write(path, data)
    _read(path)
    behind = [other for other in _paths(run) if other <= path]
    for old in {*_paths(run)} - {*behind[-KEPT:]}:
        _drop(old)
    return path


def digest(run: Path, images: int) -> str | None:
    """SHA-256 of the checkpoint after so many images; None: there is no such checkpoint.

    Raises:
        InputError: If it cannot be read, or the sum beside it is another.
    """
    path = folder(run) / f"{_name(images)}.pt"
    return hashlib.sha256(_read(path)).hexdigest() if path.exists() else None


def load(path: Path, device: torch.device | str = "cpu") -> dict:
    """Read one checkpoint.

    Raises:
        InputError: If it is damaged, of a newer format, or holds anything but tensors and plain
            values.
    """
    data = _read(path)
    try:
        _check_archive(data)
        stored = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
        _check_tensors(stored, len(data))
    except (MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # damaged bytes raise nearly any
        raise InputError(
            "unsafe or unreadable checkpoint",
            where=path,
            why=f"expected tensors and plain values only, found {_foreign(error)}",
            fix="use a checkpoint of this run, or start over with --fresh",
        ) from error
    version = stored.get("format") if isinstance(stored, dict) else None
    if (
        not isinstance(version, int)
        or version > FORMAT
        or not isinstance(stored.get("images"), int)
    ):
        raise InputError(
            "checkpoint of another format",
            where=path,
            why=f"this version reads formats up to {FORMAT}, found {version}",
            fix="update gftorf_warp, or start over with --fresh",
        )
    return stored


def last(run: Path, device: torch.device | str = "cpu") -> dict | None:
    """The newest readable checkpoint of a run; None if it has none at all.

    Newer ones that cannot be read are named in the log.

    Raises:
        InputError: If there are checkpoints and none can be read, or none but the start, in which
            nothing is optimised yet.
    """
    _sweep_interrupted(run)
    error: InputError | None = None
    for path in reversed(_stated_paths(run)):
        try:
            stored = load(path, device)
        except InputError as failure:
            LOG.warning("%s: %s: %s", failure.where, failure.what, failure.why)
            error = error or failure
            continue
        if error is not None:
            _go_back(stored, error)
        return stored
    if error is not None:
        raise error
    return None


@contextlib.contextmanager
def rebuilding(run: Path) -> Iterator[None]:
    """Context in which the content of a checkpoint is made into tensors and models.

    Raises:
        InputError: If its parts do not fit together.
    """
    try:
        yield
    except (GftorfError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # of names, shapes and types that are not those of a state
        raise InputError(
            "not the state of a run",
            where=folder(run),
            why=f"the parts of the checkpoint do not fit: {type(error).__name__}, {error}"[:300],
            fix="use a checkpoint of this run, or start over with --fresh",
        ) from error


def after(run: Path, images: int) -> list[Path]:
    """Checkpoints of more than so many optimised images, oldest first."""
    return [path for path in _stated_paths(run) if path.stem > _name(images)]


def _go_back(stored: dict, error: InputError) -> None:
    """Log that an earlier state replaces the checkpoint that ``error`` is about.

    Raises:
        InputError: If nothing was optimised in that state.
    """
    if not stored["images"]:
        raise InputError(
            error.what,
            where=error.where,
            why=f"{error.why}; before it there is only the start, in which nothing is optimised",
            fix="restore the file from a copy, or start over with `gftorf reconstruct` and --fresh",
        ) from error
    LOG.warning("the checkpoint before it is used, of image %d", stored["images"])


def _check_archive(data: bytes) -> None:
    """Raise a ValueError unless nothing is compressed, as torch writes it: sizes are then true."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
    packed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
    if packed or sum(member.file_size for member in members) > len(data):
        raise ValueError("compressed content")


def _check_tensors(stored: Any, size: int) -> None:
    """Raise a ValueError if a tensor has more elements than a file of so many bytes can hold."""
    if isinstance(stored, torch.Tensor) and stored.numel() * stored.element_size() > size:
        raise ValueError(f"a tensor of shape {tuple(stored.shape)}")
    parts = stored.values() if isinstance(stored, dict) else stored
    for part in parts if isinstance(stored, dict | list | tuple) else ():
        _check_tensors(part, size)


def _write(path: Path, data: bytes) -> None:
    """Write a checkpoint so that, whenever the process is killed, a file of its name has its sum.

    The sidecar comes before the file gets its name, and still has the sum of a file of that name
    from before. As long as there is a temporary file, a sidecar without a checkpoint means that.
    """
    sums = [hashlib.sha256(data).hexdigest(), *_stated(path)[:1]]
    lines = "".join(f"{one}  {path.name}\n" for one in sums)
    try:
        with atomic_path(path) as temporary:
            write_through(temporary, data)
            atomic_write(_sidecar(path), lines.encode())
    finally:
        if not path.exists():
            _sidecar(path).unlink(missing_ok=True)


def _drop(path: Path) -> None:
    """Remove a checkpoint and its sidecar, as safely as they are written."""
    temporary = temporary_name(path)
    path.rename(temporary)
    _sidecar(path).unlink(missing_ok=True)
    temporary.unlink()


def _sweep_interrupted(run: Path) -> None:
    """Remove what killed processes left while they wrote or dropped a checkpoint."""
    for stray in folder(run).glob(".*.tmp-*"):
        path = _target(stray)
        sweep(path)
        if path.suffix == ".pt" and not (stray.exists() or path.exists()):
            _sidecar(path).unlink(missing_ok=True)


def _target(temporary: Path) -> Path:
    """The file that a temporary one was to become, or was."""
    return temporary.with_name(temporary.name[1:].rpartition(".tmp-")[0])


def _foreign(error: Exception) -> str:
    """What a checkpoint contains besides tensors and plain values, by the error of torch."""
    named = re.search(r"GLOBAL (\S+)", str(error))
    return f"{named[1]}, which could run code" if named else "other content"


def _paths(run: Path) -> list[Path]:
    """All checkpoints, oldest first."""
    return sorted(folder(run).glob("*.pt")) if folder(run).is_dir() else []


def _stated_paths(run: Path) -> list[Path]:
    """All checkpoints, and those that are gone while their SHA-256 is still there, unless they are
    being written or dropped.
    """
    named = {path.with_suffix("") for path in folder(run).glob("*.pt.sha256")}
    return sorted({*_paths(run), *(named - {*map(_target, folder(run).glob(".*.tmp-*"))})})


def _name(images: int) -> str:
    return f"{images:010d}"


def _sidecar(path: Path) -> Path:
    return path.with_suffix(".pt.sha256")


def _read(path: Path) -> bytes:
    """Content of a checkpoint whose SHA-256 is right."""
    fix = "restore it from a copy; without it the one before is used; or start over with --fresh"
    sidecar = _sidecar(path)
    try:
        data, stated = read_bytes(path), _stated(path)
    except InputError as error:
        raise InputError("damaged checkpoint", where=path, why=error.why, fix=fix) from error
    actual = hashlib.sha256(data).hexdigest()
    if not stated:
        why = f"{sidecar.name} beside it, which holds its SHA-256, is missing or empty"
        raise InputError("damaged checkpoint", where=path, why=why, fix=fix)
    if actual not in stated:
        why = f"its SHA-256 is {actual[:12]}..., {sidecar.name} beside it says {stated[0][:12]}..."
        raise InputError("damaged checkpoint", where=path, why=why, fix=fix)
    return data


def _stated(path: Path) -> list[str]:
    """The sums in the sidecar of a checkpoint; none without one."""
    sidecar = _sidecar(path)
    if not sidecar.exists():
        return []
    text = read_bytes(sidecar, SMALL_FILE_BYTES).decode(errors="replace")
    return [line.split()[0] for line in text.splitlines() if line.strip()]
