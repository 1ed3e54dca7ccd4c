"""Errors of presets on the seven look-alikes, beside the published ones of other data.

    python benchmarks/look_alikes.py --reconstruct OUT [--row ROW ...] [--seeds 0,1,2]
        [--size 320x240] [--images N] [--device cpu] [--workers K] [--limit SECONDS]

Sequences are `gftorf simulate NAME --engine mesh`, 60 raw frames, with the sensor and the noise of
the scene; protocol ftorf13. A row is NAME=PRESET[,SETTING=VALUE...], or a preset alone; NAME@0 has
the first seed only. Results are lines in OUT/results.jsonl: the same command goes on where it was
interrupted. Prints mean squared errors of d and of d_ToF [m^2 x 100], means over seeds, and writes
them to OUT/table.md; ratios to the closed form are geometric means over scenes. The published
numbers are of other data, and only for the order of magnitude.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path

from accuracy import SEEDS, WORKERS_CUDA, numbers, read_results, size, source_of_the_package
from accuracy_jobs import Job, Result, Row, Setup, Workers
from accuracy_table import geometric_mean

from gftorf_warp import simulate

PUBLISHED = {  # (C-ToF, d, d_ToF) of the paper's table, m^2 x 100
    "sliding_cube": (0.096, 0.037, 0.005),
    "occlusion": (0.130, 0.369, 0.062),
    "z_motion_speed_test": (2.068, 0.525, 0.123),
    "speed_test_texture": (3.131, 0.641, 0.281),
    "speed_test_chair": (0.787, 1.023, 0.639),
    "arcing_cube": (36.768, 1.023, 1.060),
    "acute_z_speed_test": (41.931, 22.772, 14.933),
}
FRAMES = 60
DISTANCES = ("d", "d_tof")


def main(words: list[str] | None = None) -> int:
    """Simulate, fit what is missing, print. Returns 1 if a fit failed or is left."""
    options = _options(words)
    begun = time.monotonic()
    setup = Setup(
        out=options.out.resolve(),
        size=options.size,
        frames=FRAMES,
        images=options.images,
        device=options.device,
        protocol="ftorf13",
    )
    folders = {name: setup.out / "scenes" / name for name in PUBLISHED}
    for name, folder in folders.items():
        folder.parent.mkdir(parents=True, exist_ok=True)
        how = {"size": setup.size, "frames": FRAMES, "engine": "mesh"}
        simulate(name, folder, device=setup.device, **how)
        print(f"{time.monotonic() - begun:6.0f} s {name} simulated", file=sys.stderr, flush=True)
    jobs = [
        Job(scene=str(folder), row=row, seed=seed)
        for row, seeds in options.rows
        for seed in (seeds or options.seeds)
        for folder in folders.values()
    ]
    store = setup.out / "results.jsonl"
    stored, source = read_results(store), source_of_the_package()
    known = {id: got["key"] for id, got in stored.items() if "error" not in got}
    workers = Workers(options.workers, setup)
    for job, result in workers.results(jobs, known, begun + options.limit):
        if result is None:
            continue
        stored[result["id"]] = result | {"source": source}
        with store.open("a", encoding="utf-8") as file:
            file.write(json.dumps(stored[result["id"]]) + "\n")
        about = result.get("error") or f"{result['seconds']:.1f} s"
        text = f"{time.monotonic() - begun:6.0f} s {job.id(setup)} {about}"
        print(text, file=sys.stderr, flush=True)
    workers.close()
    found = [stored[job.id(setup)] for job in jobs if job.id(setup) in stored]
    good = [result for result in found if "error" not in result]
    text = table([row.name for row, _ in options.rows], good)
    print(text)
    (setup.out / "table.md").write_text(text, encoding="utf-8")
    return int(len(good) < len(jobs))


def table(rows: list[str], results: list[Result]) -> str:
    """Markdown: a line per scene, d and d_ToF per row, published numbers, ratios."""
    titles = [f"{row} {name}" for row in rows for name in ("d", "d_ToF")]
    published = ["paper: C-ToF", "d", "d_ToF"]
    lines = [_line(["scene", "closed form", *titles, *published])]
    lines.append(_line(["---"] * (2 + len(titles) + len(published))))
    closed = {name: _mean(results, None, name, "closed_form") for name in PUBLISHED}
    errors = {
        (row, distance): {name: _mean(results, row, name, distance) for name in PUBLISHED}
        for row in rows
        for distance in DISTANCES
    }
    for name, paper in PUBLISHED.items():
        ours = [closed[name], *(each[name] for each in errors.values())]
        lines.append(_line([name, *map(_text, ours), *map(_text, paper)]))
    ratios = [
        geometric_mean(
            e / c
            for e, c in zip(each.values(), closed.values(), strict=True)
            if not math.isnan(e) and not math.isnan(c)
        )
        for each in errors.values()
    ]
    paper = [geometric_mean(p[k] / p[0] for p in PUBLISHED.values()) for k in (1, 2)]
    cells = [*map(_text, [*ratios]), "1", *map(_text, paper)]
    lines.append(_line(["over the closed form", "1", *cells]))
    seconds = [[r["seconds"] for r in results if r["row"] == row] for row in rows]
    spread = [f"{sum(each) / len(each):.1f} s" if each else "-" for each in seconds]
    lines.append(_line(["seconds", "", *(x for one in spread for x in (one, "")), "", "", ""]))
    return "\n".join(lines) + "\n"


def _mean(results: list[Result], row: str | None, name: str, distance: str) -> float:
    """Mean over seeds of an error; NaN without fits."""
    found = [
        result["scores"][f"{distance}_mse_x100"]
        for result in results
        if result["scene"] == f"shared/{name}" and row in (None, result["row"])
    ]
    return sum(found) / len(found) if found else math.nan


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _text(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3g}"


def _options(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="look_alikes.py --reconstruct",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--row", dest="rows", type=_row, action="append")
    parser.add_argument("--seeds", type=numbers, default=list(SEEDS))
    parser.add_argument("--size", type=size, default=(320, 240), metavar="WxH")
    parser.add_argument("--images", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--limit", type=float, default=math.inf)
    options = parser.parse_args(words)
    options.rows = options.rows or [_row(name) for name in ("released@0", "fast", "best")]
    if options.workers is None:
        on_cpu = options.device == "cpu"
        options.workers = (os.cpu_count() or 1) if on_cpu else WORKERS_CUDA
    return options


def _row(text: str) -> tuple[Row, list[int] | None]:
    """A row, and its seeds if it has its own."""
    named, _, seeds = text.partition("@")
    return Row.of(named), numbers(seeds) if seeds else None


if __name__ == "__main__":
    sys.exit(main())
