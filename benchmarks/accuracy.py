"""Accuracy of presets on many scenes with several seeds, against the closed form.

    python benchmarks/accuracy.py --out DIR --row ROW [--row ROW ...]
        [--scenes 0-15] [--validation] [--shared FOLDER [--finer FOLDER]] [--seeds 0,1,2]
        [--size 320x240] [--frames 60] [--images N] [--device cpu] [--workers K]
        [--limit SECONDS] [--again] [--keep]
    python benchmarks/accuracy.py --out DIR --row fast --row plane=fast,weights.ssim=0.1
    python benchmarks/accuracy.py --out DIR --rows benchmarks/best_rows.txt --flow

A row is NAME=PRESET[,SETTING=VALUE...], or a preset alone; --rows names a file with one in each
line. Rows that differ in ``fallback`` and ``outlines`` alone share their fits. Scenes are `gftorf
simulate random-N --engine mesh`: numbers 0 to 15 are for tuning. Those of --validation, 100 to 115,
are looked at for closing tables only; no setting is chosen with them. --flow computes the optical
flow of a scene once instead of in every fit: the same, for presets that keep its size. --shared
adds the sequences in a folder that other programs made, in the F-ToeRF layout; --finer names the
same ones at a multiple of their size, whose truth gives their edge floor. --images shortens every
preset to that many images, and all its intervals alike.

Results are lines in DIR/results.jsonl, one per scene and per fit. What is there with the same
settings and data is not repeated, so the same command continues after an interruption or --limit,
and --again repeats fits of other versions of the package, which tables otherwise mix and name. Fits
run in K processes: four on CUDA, shared among all GPUs, on a CPU one per core; seconds are those of
K fits at once. A fit that fails is a row with its error. Prints two tables per set of scenes, also
written to DIR/table.md, and writes DIR/worst.png: truth, closed form, d and its error of the worst
fits.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import accuracy_table as table
import cv2
import numpy as np
import torch
from accuracy_jobs import Job, Result, Row, Setup, Task, Work, failure, picture_of

import gftorf_warp
from gftorf_warp.sweep.command import read_results
from gftorf_warp.sweep.workers import Lost, Workers, places

TUNING, VALIDATION = range(16), range(100, 116)
SEEDS = (0, 1, 2)
WORKERS_CUDA = 4
WORST = 8  # fits in the picture
MARK = "cams/depth_range.npy"  # in every F-ToeRF folder


def main(arguments: list[str] | None = None) -> int:
    """Do what is missing, print, store. Returns 1 if a job failed."""
    options = _options(arguments)
    begun = time.monotonic()
    setup = Setup(
        out=options.out.resolve(),
        size=options.size,
        frames=options.frames,
        images=options.images,
        device=options.device,
        keep=options.keep,
        finer=options.finer and options.finer.resolve(),
        flow=options.flow,
    )
    setup.out.mkdir(parents=True, exist_ok=True)
    sets = _sets(options)
    store = setup.out / "results.jsonl"
    stored, source = read_results(store), source_of_the_package()
    known = {
        id: result["key"]
        for id, result in stored.items()
        if "error" not in result and (not options.again or result["source"] == source)
    }
    scenes = [Job(scene=scene) for names in sets.values() for scene in names]
    fits = [
        Job(scene=job.scene, row=row, seed=seed)
        for seed in options.seeds
        for job in scenes
        for row in options.rows
    ]
    left = 0
    gpus = [f"cuda:{k}" for k in range(torch.cuda.device_count())]
    devices = gpus if options.device == "cuda" else [options.device]
    with Workers(places(devices, options.workers), Work(setup)) as workers:
        for jobs in (scenes, fits):
            done = 0
            tasks = _tasks((job, known.get(job.id(setup))) for job in jobs)
            for task, outcome in workers.outcomes(tasks, tries=1, deadline=begun + options.limit):
                done += len(task)
                lost = isinstance(outcome, Lost)
                results = [failure(job, setup, outcome.why) for job, _ in task] if lost else outcome
                for result in filter(None, results):
                    result["source"] = source
                    stored[result["id"]] = result
                    with store.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(result) + "\n")
                    _report(done, len(jobs), result, begun)
            left += len(jobs) - done
    text = "\n".join(_tables(title, names, options, setup, stored) for title, names in sets.items())
    if left:
        text += f"\n{left} jobs are left: the same command continues.\n"
    print(text)
    (setup.out / "table.md").write_text(text, encoding="utf-8")
    found = [stored[job.id(setup)] for job in fits if job.id(setup) in stored]
    _write_worst(setup, [result for result in found if "error" not in result])
    return int(any("error" in result for result in found))


def _tasks(jobs: Iterable[tuple[Job, str | None]]) -> list[Task]:
    """Jobs with the keys of their known results, those of one fit together."""
    found: dict[object, list[tuple[Job, str | None]]] = {}
    for job, known in jobs:
        fit = job.scene, job.row and job.row.fit, job.seed
        found.setdefault(fit, []).append((job, known))
    return [tuple(each) for each in found.values()]


def rows_of(path: str) -> list[Row]:
    """The rows in a file, one in each line; what follows # is a comment."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    texts = (line.partition("#")[0].strip() for line in lines)
    return [Row.of(text) for text in texts if text]


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--row", dest="rows", type=Row.of, action="append", default=[])
    parser.add_argument("--rows", dest="listed", type=rows_of, default=[], metavar="FILE")
    parser.add_argument("--flow", action="store_true", help="compute flow with the scenes")
    parser.add_argument("--scenes", type=numbers, help="tuning scenes, like 0-3,7 or none (0-15)")
    parser.add_argument("--validation", action="store_true", help="scenes 100 to 115 instead")
    parser.add_argument("--shared", type=Path, help="folder of further sequences")
    parser.add_argument("--finer", type=Path, help="the same ones at a multiple of the size")
    parser.add_argument("--seeds", type=numbers, default=list(SEEDS))
    parser.add_argument("--size", type=size, default=(320, 240), metavar="WxH")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--images", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int)
    parser.add_argument(
        "--limit", type=float, default=math.inf, help="no job begins after [s], 40 s later all end"
    )
    parser.add_argument("--again", action="store_true", help="also what other versions did")
    parser.add_argument("--keep", action="store_true", help="keep the folders of runs")
    options = parser.parse_args(arguments)
    if options.scenes is not None and options.validation:
        parser.error("--scenes names tuning scenes; --validation takes all of its own")
    if not set(options.scenes or []) <= set(TUNING):
        parser.error(f"--scenes: tuning scenes are 0 to {TUNING[-1]}")
    options.rows = [*options.rows, *options.listed]
    if not options.rows:
        parser.error("there is no row: use --row or --rows")
    names = [row.name for row in options.rows]
    if len(set(names)) < len(names):
        parser.error(f"--row: each row needs a name of its own, got {', '.join(names)}")
    if options.workers is None:
        cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        options.workers = cpus or 1 if options.device == "cpu" else WORKERS_CUDA
    return options


def numbers(text: str) -> list[int]:
    """Numbers and ranges, ``0-3,7``; ``none``: no number."""
    parts = [] if text == "none" else [part.partition("-") for part in text.split(",")]
    return [n for first, _, last in parts for n in range(int(first), int(last or first) + 1)]


def size(text: str) -> tuple[int, int]:
    """``320x240`` as (width, height) [px]."""
    width, _, height = text.partition("x")
    return int(width), int(height)


def _sets(options: argparse.Namespace) -> dict[str, list[str]]:
    """Scenes by the title of their tables."""
    chosen = TUNING if options.scenes is None else options.scenes
    title = "validation" if options.validation else "tuning"
    sets = {title: [f"random-{n}" for n in (VALIDATION if options.validation else chosen)]}
    if options.shared is not None:
        folders = sorted(options.shared.resolve().iterdir(), key=_natural)
        sets["shared"] = [str(folder) for folder in folders if (folder / MARK).is_file()]
        if not sets["shared"]:
            raise SystemExit(f"{options.shared}: no folder in it holds {MARK}")
    return {title: names for title, names in sets.items() if names}


def _natural(path: Path) -> tuple[str, int]:
    name, _, number = path.name.partition("-")
    return name, int(number) if number.isdigit() else -1


def source_of_the_package() -> str:
    """A hash of all Python files of the package: its version, committed or not."""
    digest = hashlib.sha256()
    for path in sorted(Path(gftorf_warp.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _report(done: int, total: int, result: Result, begun: float) -> None:
    text = result.get("error", "")
    if "scores" in result:
        ratios = (table.ratio(result, part) for part in table.PARTS)
        text = "d / closed form " + " / ".join("-" if r is None else f"{r:.3f}" for r in ratios)
        text += f"  {result['seconds']:.1f} s"
    elapsed = f"{time.monotonic() - begun:6.0f} s"
    print(f"{elapsed} {done}/{total} {result['id']}  {text}", file=sys.stderr, flush=True)


def _tables(
    title: str,
    names: list[str],
    options: argparse.Namespace,
    setup: Setup,
    stored: dict[str, Result],
) -> str:
    """Both tables of a set of scenes, with what was asked for."""
    jobs = [Job(scene=name) for name in names]
    fits = [
        Job(scene=name, row=row, seed=seed).id(setup)
        for name in names
        for row in options.rows
        for seed in options.seeds
    ]
    results = [stored[id] for id in fits if id in stored]
    scenes = [stored.get(job.id(setup), {"scene": job.title}) for job in jobs]
    rows = [row.name for row in options.rows]
    sources = sorted({result["source"] for result in results})
    width, height = setup.size
    head = f"## {title}: {len(names)} scenes, seeds {', '.join(map(str, options.seeds))}\n\n"
    what = "as given" if title == "shared" else f"{width}x{height}, {setup.frames} raw frames"
    head += f"{what}, images {setup.images or 'of the preset'}, {setup.device}, {options.workers} "
    head += f"fits at once; package {', '.join(sources)}. Errors are MSE x 100 [m^2], all / moving "
    head += "/ static.\n\n"
    defined = "".join(
        f"* {row.name}: {', '.join((row.preset, *row.changes))}\n" for row in options.rows
    )
    parts = [head, defined, "\n", table.summary(rows, scenes, results), "\n"]
    parts += [table.details(rows, scenes, results), "\n", table.failures([*scenes, *results])]
    return "".join(parts)


def _write_worst(setup: Setup, fits: list[Result]) -> None:
    """The pictures of the worst fits, one below the other; one per row and scene."""
    shown: dict[tuple[str, str], Path] = {}
    for fit in table.worst_first(fits):
        path = picture_of(fit["id"], setup.out)
        if path.is_file():
            shown.setdefault((fit["row"], fit["scene"]), path)
    strips = [cv2.imread(str(path)) for path in list(shown.values())[:WORST]]
    if strips:
        width = max(strip.shape[1] for strip in strips)
        border = [(0, 0, 0, width - strip.shape[1], cv2.BORDER_CONSTANT) for strip in strips]
        white = (255,) * 3
        padded = [
            cv2.copyMakeBorder(strip, *sides, value=white)
            for strip, sides in zip(strips, border, strict=True)
        ]
        cv2.imwrite(str(setup.out / "worst.png"), np.concatenate(padded))


if __name__ == "__main__":
    sys.exit(main())
