"""Images per second of a finished run, quads and distance, motion included: in every way in which they are asked for.

``render`` is a Python loop over ``Run.render``; ``arrays`` is what ``gftorf render`` does before it writes, so its
images are NumPy arrays on the host; ``files`` is that command, EXR and PNG included.
"""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..evaluate import renders, views
from ..recon.run import Run
from .timing import Report, Timing, lines_of, watch_of

IMAGES = 600
QUICK_IMAGES = 12
FILES = 60  # images at most that are written
ROUNDS = 5  # over which a spread is taken
WHAT = ("distance", "quads")


def measure(
    path: Path, out: Path, device: str, *, quick: bool, images: int | None, report: Report
) -> list[dict[str, Any]]:
    """Rows of the ways: images per second.

    Args:
        path: Folder of the run.
        out: New folder for images.
        device: Where.
        quick: A few images only.
        images: How many; None: 600.
        report: Called with (ways done, ways in all).
    """
    run, watch = Run.open(path, device), watch_of(device)
    sequence = run.sequence()
    total = images or (QUICK_IMAGES if quick else IMAGES)
    seconds = [float(t) for t in np.linspace(sequence.times[0], sequence.times[-1], total)]
    cameras = [views.camera_at(run, sequence, t) for t in seconds]

    def by_render(start: int, stop: int) -> None:
        for k in range(start, stop):
            run.render(seconds[k], cameras[k])

    def by_arrays(start: int, stop: int) -> None:
        for k in range(start, stop):
            rendering = run.render(seconds[k], cameras[k])
            for name in WHAT:
                renders.channels(name, rendering, run.sensor)

    ways = {"render": by_render, "arrays": by_arrays}
    rows, about = [], {"N": run.gaussians, "width": run.camera.width, "height": run.camera.height}
    for done, (name, function) in enumerate(ways.items(), start=1):
        function(0, min(total, 3))
        edges = np.linspace(0, total, ROUNDS + 1).astype(int)
        rates, begun = [], time.perf_counter()
        for start, stop in pairwise(edges):
            watch.synchronise()
            first = time.perf_counter()
            function(int(start), int(stop))
            watch.synchronise()
            rates.append(1e3 * (time.perf_counter() - first) / (stop - start))
        rate = total / (time.perf_counter() - begun)
        rows.append(about | {"way": name, "images": total, "images_per_s": rate, "ms": Timing.of(rates).plain()})
        report(done, len(ways) + 1, images_per_s=rate)
    count = min(total, FILES)
    begun = time.perf_counter()
    views.render_to_folder(run, out, WHAT, seconds[:count])
    spent = time.perf_counter() - begun
    rows.append(about | {"way": "files", "images": count, "images_per_s": count / spent, "ms": None})
    report(len(ways) + 1, len(ways) + 1, images_per_s=count / spent)
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line per way."""
    size = f"{rows[0]['width']}x{rows[0]['height']}, N = {rows[0]['N']:,}"
    cells = [
        [
            row["way"],
            str(row["images"]),
            f"{row['images_per_s']:.1f}",
            "-" if row["ms"] is None else f"{row['ms']['median']:.3f}",
        ]
        for row in rows
    ]
    return lines_of(f"render rate, quads and distance, {size}", ["way", "images", "images/s", "ms per image"], cells)
