"""A long recording reconstructed in windows: peak memory beside that of a short one, error at the
seams beside that inside.

    python benchmarks/long_recording.py --out DIR [--scene fan] [--frames 7200] [--short 600]
        [--size 160 120] [--window 5] [--preset best] [--images N] [--only PART] [--device cuda]

Simulates the scene, reconstructs its first ``--short`` raw frames as one run, then all of them in
windows of ``--window`` seconds, each in a process of its own, and scores some raw frames. Whatever
is finished is a line of DIR/results.jsonl, and is not done again by the same command; one that is
cut off therefore goes on. ``--only simulate`` and so on do one part.

Peak memory is the largest resident memory of a process and the most that torch held of its GPU.
*At a seam* are the raw frames where two windows are blended and a quartet on either side; *inside*
is as long a part of every window, further to its end from window to window. Neither has the first
and last two quartets of the recording. Errors are MSE x 100 [m^2] of the rendered distance over all
pixels whose distance is known. The exit code is 1 if memory grows by more than 1.2 or the error at
seams by more than 1.1.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gftorf_warp.data.read import read, read_truth, read_without_images
from gftorf_warp.recon.joined import Window
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.recon.windowed import plan, reconstruct_in_windows
from gftorf_warp.render.cuda import peak_memory
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.terminal import start_warp

ENDS = 2  # quartets at each end of a recording that are not scored
MEMORY, SEAMS = 1.2, 1.1  # goals, see above
Row = dict[str, Any]


class Results:
    """Lines of results.jsonl, each a part of the work that is finished, with its settings."""

    def __init__(self, options: argparse.Namespace):
        """Read what is there of the same settings."""
        self.path = options.out / "results.jsonl"
        self.settings = [str(v) for k, v in sorted(vars(options).items()) if k not in FREE]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lines = self.path.read_text().splitlines() if self.path.exists() else []
        rows = [json.loads(line) for line in lines if line.endswith("}")]
        self.rows = {row["part"]: row for row in rows if row["settings"] == self.settings}

    def add(self, part: str, row: Row) -> None:
        """Keep and print a row."""
        self.rows[part] = {"part": part, "settings": self.settings} | row
        with self.path.open("a") as file:
            file.write(json.dumps(self.rows[part]) + "\n")
        print(f"{part}: {row}", flush=True)


FREE = ("out", "only")  # options that change no result


def main() -> int:
    """Simulate, reconstruct twice, score; what is there already is not repeated."""
    options = _options()
    sequence, results = options.out / "sequence", Results(options)
    for name, work in PARTS.items():
        if name not in results.rows and options.only in (None, name):
            begun = time.monotonic()
            row = _apart(work, options, sequence)
            results.add(name, row | {"seconds": round(time.monotonic() - begun, 1)})
    return _verdict(Results(options).rows)


def _verdict(rows: dict[str, Row]) -> int:
    """Print what is known of memory and errors; 1 if it is more than it may be."""
    failed = False
    if {"short", "long"} <= rows.keys():
        short, long = rows["short"], rows["long"]
        growth = {key: long[key] / short[key] for key in ("resident_mib", "gpu_mib") if short[key]}
        print(f"memory, long / short: {growth}")
        failed |= max(growth.values()) > MEMORY
    blocks = [row for part, row in rows.items() if part.startswith(("seam ", "inside "))]
    at = {kind: [r for r in blocks if r["part"].startswith(kind)] for kind in ("seam", "inside")}
    if all(at.values()):
        frames = {kind: sum(r["frames"] for r in found) for kind, found in at.items()}
        sums = {kind: sum(r["error"] * r["frames"] for r in found) for kind, found in at.items()}
        mean = {kind: sums[kind] / frames[kind] for kind in at}
        ratio = mean["seam"] / mean["inside"]
        print(f"errors {mean}, raw frames {frames}; at seams / inside: {ratio:.3f}")
        failed |= ratio > SEAMS
    return int(failed)


def _apart(work: Any, *given: Any) -> Row:
    """The result of a function in a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *given).result()


def _simulated(options: argparse.Namespace, sequence: Path) -> Row:
    start_warp()
    chosen = {"size": tuple(options.size), "frames": options.frames, "engine": "mesh"}
    simulate(options.scene, sequence, device=options.device, **chosen)
    return {}


def _short(options: argparse.Namespace, sequence: Path) -> Row:
    start_warp()
    part = read(sequence, frames=range(options.short))
    out = options.out / "short"
    reconstruct(part, out, options.preset, images=options.images, device=options.device)
    return _memory(options)


def _long(options: argparse.Namespace, sequence: Path) -> Row:
    """All windows, with a line whenever one has begun."""
    start_warp()
    begun, results = time.monotonic(), Results(options)

    def note(*_: object, window: int, **__: object) -> None:
        if (part := f"window {window} began") not in results.rows:
            after = round(time.monotonic() - begun, 1)
            results.add(part, {"after_s": after} | _memory(options))

    reconstruct_in_windows(
        sequence,
        options.out / "long",
        options.preset,
        window_s=options.window,
        images=options.images,
        device=options.device,
        progress=note,
    )
    began = [row for part, row in results.rows.items() if part.startswith("window ")]
    return _most([*began, _memory(options)])


def _memory(options: argparse.Namespace) -> Row:
    """Peaks of this process [MiB]; Linux counts in KiB."""
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    gpu = peak_memory(options.device)
    return {"resident_mib": round(resident), "gpu_mib": gpu and round(gpu / 2**20)}


def _most(rows: list[Row]) -> Row:
    """Largest memory of several rows: of all calls, if one was cut off."""
    return {key: max(row[key] or 0 for row in rows) for key in ("resident_mib", "gpu_mib")}


def _errors(options: argparse.Namespace, sequence: Path) -> Row:
    """Errors of parts of the recording, in the order of time, so that windows are opened once."""
    start_warp()
    timing, results = read_without_images(sequence), Results(options)
    run = Run.open(options.out / "long", options.device)
    draw = run.renderer(["distance"])
    blocks = _blocks(plan(timing, options.window), timing.frames, timing.cycle)
    if len({name.split()[0] for name in blocks}) < 2:
        raise SystemExit("no raw frame at a seam, or none inside: more --frames, or other windows")
    for name, frames in sorted(blocks.items(), key=lambda block: block[1].start):
        if name in results.rows:
            continue
        part = read(sequence, frames=frames)
        truth = read_truth(part)
        assert truth is not None, "simulated sequences have a truth"
        errors = []
        for n, distance in enumerate(truth.distance):
            with torch.no_grad():
                at, camera = float(timing.times[frames[n]]), camera_of(part, n)
                shown = draw(at, camera).distance.cpu().numpy()
            errors.append(100.0 * float(np.nanmean((shown - distance) ** 2)))
        row = {"error": float(np.mean(errors)), "frames": len(errors), "first": frames[0]}
        results.add(name, row | {"worst": max(errors)})
    return {}


def _blocks(windows: list[Window], frames: int, cycle: int) -> dict[str, range]:
    """Raw frames that are scored: every seam, and as many of every window that are at none."""
    first, last = ENDS * cycle, frames - ENDS * cycle
    found, seams = {}, []
    for number, (earlier, later) in enumerate(itertools.pairwise(windows)):
        begin, end = later.frames[0] - cycle, earlier.frames[-1] + 1 + cycle
        seams.append((begin, end))
        found[f"seam {number}"] = range(max(begin, first), min(end, last))
    ends = [begin for begin, _ in seams] + [last]
    begins = [first] + [end for _, end in seams]
    for number, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        length = min(len(found["seam 0"]), end - begin) if seams else 0
        share = (number + 0.5) / len(windows)
        at = begin + round(share * (end - begin - length) / cycle) * cycle
        if length > 0:
            found[f"inside {number}"] = range(at, at + length)
    return found


PARTS = {"simulate": _simulated, "short": _short, "long": _long, "errors": _errors}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="fan")
    parser.add_argument("--frames", type=int, default=7200)
    parser.add_argument("--short", type=int, default=600)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120))
    parser.add_argument("--window", type=float, default=5.0, help="[s]")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--images", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--only", choices=PARTS, help="one part of the work")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
