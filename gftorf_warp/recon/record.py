"""What a run leaves to read: metrics.jsonl, one JSON object per logged interval, and run.log."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..data.files import atomic_write

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
            kept = [
                line
                for line in self.path.read_text().splitlines(keepends=True)
                if line.endswith("\n")
            ]
            kept = [line for line in kept if json.loads(line)["images"] <= images]
            atomic_write(self.path, "".join(kept).encode())

    def rows(self) -> list[dict[str, float | int | None]]:
        """All rows so far."""
        return (
            [json.loads(line) for line in self.path.read_text().splitlines()]
            if self.path.exists()
            else []
        )

    def add(self, row: dict[str, float | int | None]) -> None:
        """Append one row."""
        with self.path.open("a") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append the package's log to a file, with times, while a run is going on."""
    handler = logging.FileHandler(path, encoding="utf-8")
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
