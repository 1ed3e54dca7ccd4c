"""A long recording reconstructed in windows: peak memory beside that of a short one, error at the
seams beside that inside.

    python benchmarks/long_recording.py --out DIR [--scene fan] [--frames 7200] [--short 600]
        [--size 160 120] [--window 5] [--preset best] [--images N] [--device cuda] [--json FILE]

Simulates the scene (what is in DIR is kept), reconstructs its first ``--short`` raw frames as one
run, then all of them in windows of ``--window`` seconds, each in a process of its own. Peak memory
is the largest resident memory of that process and the most that torch held of its GPU. *At a seam*
are the raw frames where two windows are blended and a quartet on either side; *inside* are the
others without the first and last two quartets of the recording. Errors are MSE x 100 [m^2] of the
rendered distance over all pixels whose distance is known. The exit code is 1 if memory grows by
more than 1.2 or the error at seams by more than 1.1.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gftorf_warp.data.read import read, read_truth, read_without_images
from gftorf_warp.data.sequence import Sequence
from gftorf_warp.recon.joined import Window
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.recon.windowed import plan, reconstruct_in_windows
from gftorf_warp.render.cuda import peak_memory
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.terminal import start_warp

ENDS = 2  # quartets at each end of a recording that are not scored
CHUNK = 240  # raw frames whose truth is in memory at a time
MEMORY, SEAMS = 1.2, 1.1  # goals, see above
Row = dict[str, Any]


def main() -> int:
    """Simulate, reconstruct twice, score."""
    options = _options()
    sequence = options.out / "sequence"
    if not (sequence / "capture.json").exists():
        _timed("simulated", _apart, _simulated, options, sequence)
    rows = {
        name: _timed(name, _apart, work, options, sequence)
        for name, work in (("short", _short), ("long", _long), ("error", _error))
    }
    short, long, error = rows["short"], rows["long"], rows["error"]
    growth = {key: long[key] / short[key] for key in short if short[key]}
    ratio = error["seam"] / error["inside"]
    print(f"memory, long / short: {growth}; error at seams / inside: {ratio:.3f}")
    if options.json:
        settings = {key: str(value) for key, value in vars(options).items()}
        options.json.write_text(json.dumps({"options": settings, **rows}, indent=1))
    return int(max(growth.values()) > MEMORY or ratio > SEAMS)


def _apart(work: Any, *given: Any) -> Row | None:
    """The result of a function in a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *given).result()


def _timed(name: str, work: Any, *given: Any) -> Any:
    begun = time.monotonic()
    row = work(*given)
    print(f"{name}: {row or ''} in {time.monotonic() - begun:.1f} s", flush=True)
    return row


def _simulated(options: argparse.Namespace, sequence: Path) -> None:
    start_warp()
    chosen = {"size": tuple(options.size), "frames": options.frames, "engine": "mesh"}
    simulate(options.scene, sequence, device=options.device, **chosen)


def _short(options: argparse.Namespace, sequence: Path) -> Row:
    start_warp()
    part = read(sequence, frames=range(options.short))
    out = options.out / "short"
    reconstruct(part, out, options.preset, images=options.images, device=options.device)
    return _memory(options)


def _long(options: argparse.Namespace, sequence: Path) -> Row:
    start_warp()
    reconstruct_in_windows(
        sequence,
        options.out / "long",
        options.preset,
        window_s=options.window,
        images=options.images,
        device=options.device,
    )
    return _memory(options)


def _memory(options: argparse.Namespace) -> Row:
    """Peaks of this process [MiB]; Linux counts in KiB."""
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    gpu = peak_memory(options.device)
    return {"resident_mib": round(resident), "gpu_mib": gpu and round(gpu / 2**20)}


def _error(options: argparse.Namespace, sequence: Path) -> Row:
    """Errors at seams and inside, and how many raw frames each has."""
    start_warp()
    timing = read_without_images(sequence)
    errors = _errors(options, sequence, timing)
    at_seam = _at_seams(plan(timing, options.window), timing.frames, timing.cycle)
    ends = ENDS * timing.cycle
    scored = np.zeros(timing.frames, bool)
    scored[ends : timing.frames - ends] = True
    seam, inside = errors[scored & at_seam], errors[scored & ~at_seam]
    if not len(seam) or not len(inside):
        raise SystemExit("no raw frame at a seam, or none inside: more --frames, or other windows")
    return {
        "seam": 100.0 * float(np.nanmean(seam)),
        "inside": 100.0 * float(np.nanmean(inside)),
        "frames_seam": len(seam),
        "frames_inside": len(inside),
    }


def _at_seams(windows: list[Window], frames: int, cycle: int) -> np.ndarray:
    """Whether a raw frame is at a seam, ``(F,)``."""
    at = np.zeros(frames, bool)
    for earlier, later in itertools.pairwise(windows):
        at[max(later.frames[0] - cycle, 0) : earlier.frames[-1] + 1 + cycle] = True
    return at


def _errors(options: argparse.Namespace, sequence: Path, timing: Sequence) -> np.ndarray:
    """Mean squared error of the distance of every raw frame ``(F,)`` [m^2]."""
    run = Run.open(options.out / "long", options.device)
    draw = run.renderer(["distance"])
    errors = np.full(timing.frames, np.nan)
    for first in range(0, timing.frames, CHUNK):
        part = read(sequence, frames=range(first, min(first + CHUNK, timing.frames)))
        truth = read_truth(part)
        assert truth is not None, "simulated sequences have a truth"
        for n, distance in enumerate(truth.distance):
            with torch.no_grad():
                at, camera = float(timing.times[first + n]), camera_of(part, n)
                shown = draw(at, camera).distance.cpu().numpy()
            errors[first + n] = np.nanmean((shown - distance) ** 2)
    return errors


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
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
