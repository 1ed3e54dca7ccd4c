"""The logs of a run: metrics.jsonl, one JSON object per logged interval, and run.log."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..data.files import atomic_write
from ..data.texts import read_rows
from ..errors import InputError

LOG = logging.getLogger("gftorf_warp")


class Metrics:
    """Rows of ``RUN/metrics.jsonl``, in the order of optimised images."""

    def __init__(self, path: Path):
        self.path = path

    def rewind(self, images: int) -> None:
        """Drop rows beyond ``images``, and a line cut off by a crash:
        the run goes on from there.
        """
        if self.path.exists():
            kept = [row for row in self.rows() if (row.get("images") or 0) <= images]
            atomic_write(self.path, "".join(map(_line, kept)).encode())

    def rows(self) -> list[dict[str, float | int | None]]:
        """All rows so far."""
        return read_rows(self.path)

    def add(self, row: dict[str, float | int | None]) -> None:
        """Append one row."""
        with self.path.open("a") as file:
            file.write(_line(row))


def _line(row: dict[str, float | int | None]) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append the package's log to a file, with times, while a run is going on.

    Raises:
        InputError: If something else is in its place: opening a pipe would block.
    """
    if path.exists() and not path.is_file():
        why, fix = "expected a file to append to", "move it elsewhere"
        raise InputError("not a file", where=path, why=why, fix=fix)
    handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    handler.setLevel(logging.INFO)
    before = LOG.level
    LOG.addHandler(handler)
    if not LOG.isEnabledFor(logging.INFO):
        LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(before)
        handler.close()
