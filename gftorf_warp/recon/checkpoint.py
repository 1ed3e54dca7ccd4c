"""States on disk: written all at once, checked by SHA-256, read without running code,
the last two kept.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from pathlib import Path

import torch

from ..data.files import atomic_write, sweep
from ..errors import InputError
from .state import FORMAT

KEPT = 2  # checkpoints in a run: the last one, and one before in case it is damaged later


def folder(run: Path) -> Path:
    """Where the checkpoints of a run are."""
    return run / "ckpt"


def save(run: Path, stored: dict) -> Path:
    """Write a state as ``RUN/ckpt/<images>.pt`` with its SHA-256 beside it, and drop all but the
    last two.

    The file is read back and compared before another one is dropped. Checkpoints of more images are
    dropped too: the run has gone back behind them.

    Raises:
        ResourceError: If the disk is full.
        InputError: If what came back from the disk is not what was written.
    """
    place = folder(run)
    place.mkdir(exist_ok=True)
    buffer = io.BytesIO()
    torch.save(stored, buffer)
    data = buffer.getvalue()
    path = place / f"{int(stored['images']):010d}.pt"
    atomic_write(path, data)
    atomic_write(_sidecar(path), f"{hashlib.sha256(data).hexdigest()}  {path.name}\n".encode())
    _read(path)
    behind = [other for other in _paths(run) if other <= path]
    for old in {*_paths(run)} - {*behind[-KEPT:]}:
        old.unlink(missing_ok=True)
        _sidecar(old).unlink(missing_ok=True)
    return path


def load(path: Path, device: torch.device | str = "cpu") -> dict:
    """Read one checkpoint.

    Raises:
        InputError: If it is damaged, of a newer format, or holds anything but tensors and plain
            values.
    """
    data = _read(path)
    try:
        stored = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            "unsafe or unreadable checkpoint",
            where=path,
            why=f"expected tensors and plain values only: {str(error).splitlines()[0]}",
            fix="use a checkpoint of this run, or start over with --fresh",
        ) from error
    found = stored.get("format") if isinstance(stored, dict) else None
    if not isinstance(found, int) or found > FORMAT:
        raise InputError(
            "checkpoint of another format",
            where=path,
            why=f"this version reads formats up to {FORMAT}, found {found}",
            fix="update gftorf_warp, or start over with --fresh",
        )
    return stored


def last(run: Path, device: torch.device | str = "cpu") -> dict | None:
    """The newest readable checkpoint of a run; None if it has none at all.

    Raises:
        InputError: If there are checkpoints and none can be read.
    """
    paths = _paths(run)
    for stray in folder(run).glob(".*.tmp-*"):
        sweep(stray.with_name(stray.name[1:].rpartition(".tmp-")[0]))
    error: InputError | None = None
    for path in reversed(paths):
        try:
            return load(path, device)
        except InputError as found:
            error = error or found
    if error is not None:
        raise error
    return None


def _paths(run: Path) -> list[Path]:
    """All checkpoints, oldest first."""
    return sorted(folder(run).glob("*.pt")) if folder(run).is_dir() else []


def _sidecar(path: Path) -> Path:
    return path.with_suffix(".pt.sha256")


def _read(path: Path) -> bytes:
    """Content of a checkpoint whose SHA-256 is right."""
    data = path.read_bytes()
    sidecar = _sidecar(path)
    wanted = (
        sidecar.read_text().split()[0]
        if sidecar.is_file() and sidecar.stat().st_size
        else "no sidecar"
    )
    found = hashlib.sha256(data).hexdigest()
    if found != wanted:
        raise InputError(
            "damaged checkpoint",
            where=path,
            why=f"its SHA-256 is {found[:12]}..., its sidecar says {wanted[:12]}...",
            fix="remove it: the one before is used; or start over with --fresh",
        )
    return data
