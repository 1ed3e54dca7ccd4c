"""Images per second of a finished run, quads and distance, for each way of rendering.

``render``: a Python loop over ``Run.render``. ``renderer``: over ``Run.renderer``, which keeps
buffers and on CUDA replays a graph. ``unchecked``: the same without the check of the pair capacity
after every image. ``launched``: without graphs, pairs counted on the host. ``series``: images stay
on the device, capacity is checked a few images later. ``host``: the same with asynchronous readback
to NumPy arrays, ``Run.images``. ``files``: ``gftorf render``, EXR and PNG included. ``stored``: the
same with ``--arrays``, until everything is flushed to the disk; in brackets the rate before the
flush. Compilation, capture and the displacements at the first two keys precede the measurement,
those at later keys are part of it; the two commands include everything.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..evaluate import views
from ..recon.run import Run
from ..render.replay import Replay
from ..render.series import Series, View
from ..scene.camera import Camera
from .timing import LOG, Report, Timing, lines_of, watch_of

IMAGES = 600
QUICK_IMAGES = 12
STORED = 3000  # images that are written as arrays: 5 GB
ROUNDS = 5  # over which a spread is taken
WARM_UP = 4  # images of every way before the clock starts
WHAT = ("distance", "quads")
NEEDED = ("quads", "distance", "opacity")
Render = Callable[[float, Camera], Any]
Way = Callable[[Iterable[View]], Iterator[Any]]


def _single(render: Render) -> Way:
    return lambda taken: (render(*view) for view in taken)


def _launched(_: Run, render: Render) -> Way | None:
    if not (isinstance(render, Replay) and render.graphs):
        return None
    render.graphs = False
    return _single(render)


# of a run and a new renderer of it; None: not available
WAYS: dict[str, Callable[[Run, Render], Way | None]] = {
    "render": lambda run, _: _single(run.render),
    "renderer": lambda _, render: _single(render),
    "unchecked": lambda _, render: (
        _single(partial(render, checked=False)) if isinstance(render, Replay) else None
    ),
    "launched": _launched,
    "series": lambda _, render: (
        (lambda taken: Series(render, taken).on_device()) if isinstance(render, Replay) else None
    ),
    "host": lambda run, render: lambda taken: views.series_of(render, taken, run.sensor, WHAT),
}
COMMANDS = {"files": False, "stored": True}  # whether they write arrays


def measure(
    path: Path, out: Path, device: str, *, quick: bool, images: int | None, report: Report
) -> list[dict[str, Any]]:
    """Images per second, one row for each of ``WAYS`` and ``COMMANDS``; ``out`` is a new folder."""
    run, watch = Run.open(path, device), watch_of(device)
    sequence = run.sequence()
    total = images or (QUICK_IMAGES if quick else IMAGES)
    seconds = [float(t) for t in np.linspace(sequence.times[0], sequence.times[-1], total)]
    taken = [(t, views.camera_at(run, sequence, t)) for t in seconds]

    rows: list[dict[str, Any]] = []
    about = {"N": run.gaussians, "width": run.camera.width, "height": run.camera.height}
    shared = run.renderer(NEEDED)
    if isinstance(shared, Replay):
        shared(*taken[total // 2])
        about["pairs"] = shared.largest  # in the middle
    steps = len(WAYS) + len(COMMANDS)
    for done, (name, make) in enumerate(WAYS.items(), start=1):
        render = run.renderer(NEEDED)
        way = make(run, render)
        if way is None:
            continue
        _exhaust(way(taken[:WARM_UP]))
        images_left = way(taken)
        times, start = [], time.perf_counter()
        ends = np.linspace(0, total, min(ROUNDS, total) + 1).astype(int).tolist()
        for first, last in pairwise(ends):
            watch.synchronise()
            begun = time.perf_counter()
            _exhaust(islice(images_left, last - first))
            watch.synchronise()
            times.append(1e3 * (time.perf_counter() - begun) / (last - first))
        rate = total / (time.perf_counter() - start)
        fits = not isinstance(render, Replay) or render.fits()
        if not fits:
            text = "%s: some images needed more than the pair capacity and lack far splats"
            LOG.warning(text, name)
        row = {"way": name, "images": total, "images_per_s": rate}
        rows.append(about | row | {"ms": Timing.of(times).plain(), "fits": fits})
        report(done, steps, images_per_s=rate)
    for done, (name, arrays) in enumerate(COMMANDS.items(), start=len(WAYS) + 1):
        many = STORED if arrays and not (quick or images) else total
        seconds = [float(t) for t in np.linspace(sequence.times[0], sequence.times[-1], many)]
        row = _commanded(run, out / name, seconds, arrays)
        rows.append(about | {"way": name} | row)
        report(done, steps, images_per_s=row["images_per_s"])
    return rows


def _commanded(run: Run, out: Path, seconds: list[float], arrays: bool) -> dict[str, Any]:
    """Rates of ``gftorf render``: overall, and from the first to the last progress but one."""
    times: list[tuple[int, float]] = []

    def note(done: int, _: int) -> None:
        times.append((done, time.perf_counter()))

    begun = time.perf_counter()
    views.render_to_folder(run, out, WHAT, seconds, arrays=arrays, plain=True, progress=note)
    spent = time.perf_counter() - begun
    (first, early), (last, late) = times[0], times[max(0, len(times) - 2)]
    going = (last - first) / (late - early) if last > first else None
    rates = {"images_per_s": len(seconds) / spent, "going_images_per_s": going}
    return {"images": len(seconds), **rates, "ms": None}


def _exhaust(images: Iterator[Any]) -> None:
    """Iterate without keeping references."""
    deque(images, maxlen=0)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line per way."""
    size = f"{rows[0]['width']}x{rows[0]['height']}, N = {rows[0]['N']:,}"
    cells = [
        [
            row["way"],
            str(row["images"]),
            f"{row['images_per_s']:.1f}"
            + (f" ({going:.0f})" if (going := row.get("going_images_per_s")) else ""),
            "-" if row["ms"] is None else f"{row['ms']['median']:.3f}",
        ]
        for row in rows
    ]
    heads = ["way", "images", "images/s", "ms per image"]
    return lines_of(f"render rate, quads and distance, {size}", heads, cells)
