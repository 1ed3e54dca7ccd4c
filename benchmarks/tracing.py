"""Direct light by engine mesh: seconds for 60 raw frames of 320x240, by rays per pixel, instants and bodies.

    python benchmarks/tracing.py [--device cpu|cuda:0] [--frames N] [--json FILE]

Poses are computed and images fetched for every raw frame, as `simulate` does; read-out and files are left out. 'cpu' is
the processor time of all threads, which a busy machine changes less than 'seconds'.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import warp as wp

from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.traced import Traced

SIZE = (320, 240)
CASES = [  # scene, rays per pixel and axis, instants, place of the emitter [m]
    ("demo", 1, 1, (0.0, 0.0, 0.0)),
    ("demo", 2, 1, (0.0, 0.0, 0.0)),
    ("demo", 4, 1, (0.0, 0.0, 0.0)),
    ("demo", 2, 4, (0.0, 0.0, 0.0)),
    ("demo", 2, 1, (0.04, 0.0, 0.0)),
    ("axial", 2, 1, (0.0, 0.0, 0.0)),
    ("tour", 2, 1, (0.0, 0.0, 0.0)),
]


def measure(name: str, side: int, instants: int, emitter: tuple, device: str, frames: int) -> dict:
    """Seconds of ``frames`` raw frames, scaled to 60."""
    scene = replace(SCENES[name], subsamples=side, emitter=emitter)
    traced = Traced(scene, lambda time: scene.camera(SIZE, time), device=device)
    traced.light([0.0] * instants, 2e7)  # compiles, and allocates what the rest uses
    begun, processor = time.perf_counter(), time.process_time()
    for n in range(frames):
        traced.light([n / 120 + t * 1e-4 for t in range(instants)], 2e7)
    share = 60 / frames
    row = {"scene": name, "rays": side * side, "instants": instants, "beside": any(emitter)}
    seconds, processor = time.perf_counter() - begun, time.process_time() - processor
    return row | {"seconds": share * seconds, "cpu": share * processor}


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    rows = []
    for case in CASES:
        rows.append(measure(*case, a.device, a.frames))
        text = "{scene:<8}{rays:3d} rays {instants:2d} instants  shadows {beside!s:<6}{seconds:7.2f} s {cpu:7.2f} s cpu"
        print(text.format(**rows[-1]))
    if a.json:
        a.json.write_text(json.dumps({"device": a.device, "frames": a.frames, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
