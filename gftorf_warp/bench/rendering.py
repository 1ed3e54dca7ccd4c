"""Images per second of a finished run, quads and distance, motion included: in every way in which they are asked for.

``render`` is a Python loop over ``Run.render``, ``renderer`` one over ``Run.renderer``, which keeps arrays and on CUDA
replays a graph; ``unchecked`` is the same without looking after every image whether all pairs fitted, ``launched``
without graphs, pairs counted on the host. ``arrays`` is what ``gftorf render`` does before it writes, so its images are
NumPy arrays on the host; ``files`` is that command, EXR and PNG included. Compilation, capture and the displacements at
the first two keys are over when the clock starts, those at all later keys are part of the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..evaluate import views
from ..recon.run import Run
from ..render.replay import Replay
from ..scene.camera import Camera
from .timing import LOG, Report, Timing, lines_of, watch_of

IMAGES = 600
QUICK_IMAGES = 12
FILES = 60  # images at most that are written
ROUNDS = 5  # over which a spread is taken
WARM_UP = 4  # images of every way before the clock starts
WHAT = ("distance", "quads")
Render = Callable[[float, Camera], Any]


def _renderer(run: Run) -> Render:
    return run.renderer(("quads", "distance", "opacity"))


def _unchecked(run: Run) -> Render | None:
    replay = _renderer(run)
    return partial(replay, checked=False) if isinstance(replay, Replay) else None


def _launched(run: Run) -> Render | None:
    replay = _renderer(run)
    if not (isinstance(replay, Replay) and replay.graphs):
        return None
    replay.graphs = False
    return replay


def _arrays(run: Run) -> Render:
    return views.images_of(_renderer(run), run.sensor, WHAT)


WAYS: dict[str, Callable[[Run], Render | None]] = {  # None: there is no such way for this run on this device
    "render": lambda run: run.render,
    "renderer": _renderer,
    "unchecked": _unchecked,
    "launched": _launched,
    "arrays": _arrays,
}


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

    rows: list[dict[str, Any]] = []
    about: dict[str, Any] = {"N": run.gaussians, "width": run.camera.width, "height": run.camera.height}
    shared = _renderer(run)
    if isinstance(shared, Replay):
        shared(seconds[total // 2], cameras[total // 2])
        about["pairs"] = shared.largest  # in the middle
    for done, (name, way) in enumerate(WAYS.items(), start=1):
        render = way(run)
        if render is None:
            continue
        for k in range(min(total, WARM_UP)):
            render(seconds[k], cameras[k])
        times, start = [], time.perf_counter()
        for first, last in pairwise(np.linspace(0, total, min(ROUNDS, total) + 1).astype(int).tolist()):
            watch.synchronise()
            begun = time.perf_counter()
            for k in range(first, last):
                render(seconds[k], cameras[k])
            watch.synchronise()
            times.append(1e3 * (time.perf_counter() - begun) / (last - first))
        rate = total / (time.perf_counter() - start)
        fits = not isinstance(render, partial) or render.func.fits()  # type: ignore[attr-defined]
        if not fits:
            LOG.warning("%s: some images needed more pairs than were reserved, and lack far splats", name)
        row = about | {"way": name, "images": total, "images_per_s": rate, "ms": Timing.of(times).plain(), "fits": fits}
        rows.append(row)
        report(done, len(WAYS) + 1, images_per_s=rate)
    count = min(total, FILES)
    begun = time.perf_counter()
    views.render_to_folder(run, out, WHAT, seconds[:count])
    spent = time.perf_counter() - begun
    rows.append(about | {"way": "files", "images": count, "images_per_s": count / spent, "ms": None})
    report(len(WAYS) + 1, len(WAYS) + 1, images_per_s=count / spent)
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
