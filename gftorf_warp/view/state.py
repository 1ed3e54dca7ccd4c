"""Which state of a run is the newest, so that a viewer follows an unfinished run."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from ..recon import checkpoint


class State(NamedTuple):
    """A checkpoint."""

    name: str
    """Name of its file; empty: there is none."""
    written_ns: int
    """Time of its file [ns]."""


def newest(run: Path) -> State:
    """The newest checkpoint of a run that is complete, so has its SHA-256 beside it."""
    files = sorted(checkpoint.folder(run).glob("*.pt"), reverse=True)
    for path in files:
        try:
            if path.with_suffix(".pt.sha256").stat().st_size:
                return State(path.name, path.stat().st_mtime_ns)
        except FileNotFoundError:  # dropped in between, or about to be written
            continue
    return State("", 0)
