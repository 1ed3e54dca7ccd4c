"""Engine mesh: seconds for 60 raw frames of 320x240, by rays, instants, raw frames, bounces, paths;
whole simulations.

    python benchmarks/tracing.py [--device cpu|cuda:0] [--frames N] [--json FILE]

Poses are computed and images fetched for every raw frame, as `simulate` does; only rows 'with
files' include truth, read-out and writing. 'cpu' is the processor time of all threads, which a busy
machine changes less than 'seconds'. All times are scaled to 60 raw frames, but for the rows that
vary it. On a CPU, rows with bounces take N / 20 frames.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import warp as wp

from gftorf_warp.render.trace import Bounces
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate

SIZE = (320, 240)
HERE, BESIDE = (0.0, 0.0, 0.0), (0.04, 0.0, 0.0)  # [m]
DIRECT = [  # scene, rays per pixel and axis, instants, place of the emitter
    ("demo", 1, 1, HERE),
    ("demo", 2, 1, HERE),
    ("demo", 4, 1, HERE),
    ("demo", 2, 4, HERE),
    ("demo", 2, 1, BESIDE),
    ("axial", 2, 1, HERE),
    ("tour", 2, 1, HERE),
    ("cupboard", 2, 1, HERE),  # twenty bodies
    ("cupboard", 2, 1, BESIDE),
]
INDIRECT = [(1, 64), (2, 16), (2, 64)]  # bounces, paths per pixel
WHOLE = ["demo", "cupboard"]  # the second with a colour camera of 640x480
# [s] for demo, 4 rays
NEEDED = {"cpu": {"direct": 6.0, "files": 12.0}, "cuda": {"direct": 1.0, "bounces": 10.0}}


def row(
    kind: str,
    scene: str,
    side: int,
    instants: int,
    emitter: tuple,
    device: str,
    frames: int,
    bounces=(0, 0),
) -> dict:
    """Seconds of ``frames`` raw frames."""
    world = replace(SCENES[scene], subsamples=side, emitter=emitter)
    more = Bounces(count=bounces[0], paths=max(bounces[1], 1))
    traced = MeshEngine(world, lambda time: world.camera(SIZE, time), device=device, bounces=more)
    traced.light([0.0] * instants, 2e7)  # compiles, and allocates what the rest uses
    begun, processor = time.perf_counter(), time.process_time()
    for n in range(frames):
        traced.light([n / 120 + t * 1e-4 for t in range(instants)], 2e7, n)
    seconds, processor = time.perf_counter() - begun, time.process_time() - processor
    made = {
        "kind": kind,
        "scene": scene,
        "rays": side * side,
        "instants": instants,
        "beside": any(emitter),
    }
    made |= {"bounces": bounces[0], "paths": bounces[1], "frames": frames}
    return made | {"seconds": seconds, "cpu": processor}


def whole(scene: str, device: str, frames: int) -> dict:
    """Seconds of a simulation from its name to its folder, 4 rays per pixel."""
    begun, processor = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        settings = {"overrides": ["subsamples=2"], "engine": "mesh", "device": device}
        simulate(scene, Path(folder) / "out", frames=frames, size=SIZE, **settings)
    seconds, processor = time.perf_counter() - begun, time.process_time() - processor
    made = {
        "kind": "files",
        "scene": scene,
        "rays": 4,
        "instants": 1,
        "beside": False,
        "bounces": 0,
        "paths": 0,
    }
    return made | {"frames": frames, "seconds": seconds, "cpu": processor}


def scaled(made: dict) -> dict:
    """As if 60 raw frames had been taken."""
    share = 60 / made["frames"]
    return made | {"seconds": share * made["seconds"], "cpu": share * made["cpu"]}


def say(made: dict) -> None:
    """One line."""
    text = (
        "{kind:<9}{scene:<9}{rays:3d} rays {instants:2d} instants  shadows "
        "{beside!s:<6}{bounces:2d} bounces"
    )
    text += " {paths:3d} paths {frames:4d} frames {seconds:8.2f} s {cpu:8.2f} s cpu"
    print(text.format(**made), flush=True)


def linearity(rows: list[dict]) -> dict:
    """Time for each ray, raw frame and path at the largest number over that at the next smaller
    one; 1: linear.
    """
    found = {}
    pick = {
        "rays": [
            r
            for r in rows
            if r["kind"] == "direct"
            and r["scene"] == "demo"
            and r["instants"] == 1
            and not r["beside"]
        ],
        "frames": [r for r in rows if r["kind"] == "frames"],
        "paths": [r for r in rows if r["kind"] == "bounces" and r["bounces"] == 2],
    }
    for name, some in pick.items():
        less, most = sorted(some, key=lambda r: r[name])[-2:]
        found[name] = {
            key: most[key] / most[name] / (less[key] / less[name]) for key in ("seconds", "cpu")
        }
    return found


def main() -> None:
    """Measure, print, judge, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    kind = a.device.partition(":")[0]
    few = a.frames if kind == "cuda" else max(1, a.frames // 20)
    rows: list[dict] = []

    def add(made: dict) -> None:
        rows.append(made)
        say(made)

    for case in DIRECT:
        add(scaled(row("direct", *case, a.device, a.frames)))
    for frames in (a.frames // 4, a.frames):
        add(row("frames", "demo", 2, 1, HERE, a.device, max(1, frames)))
    for bounces in INDIRECT:
        add(scaled(row("bounces", "demo", 2, 1, HERE, a.device, few, bounces)))
    for scene in WHOLE:
        add(scaled(whole(scene, a.device, a.frames)))
    ratios = linearity(rows)
    for name, ratio in ratios.items():
        print(
            f"linear in {name}: {ratio['seconds']:.2f} (seconds), {ratio['cpu']:.2f} "
            f"(processor seconds)"
        )
    judged = {"direct": (2, 0), "bounces": (2, 64), "files": (2, 0)}
    for name, limit in NEEDED.get(kind, {}).items():
        for r in rows:
            wanted = (
                r["scene"] == "demo"
                and r["rays"] == 4
                and r["instants"] == 1
                and r["paths"] == judged[name][1]
            )
            if r["kind"] == name and wanted and (name != "bounces" or r["bounces"] == 2):
                print(
                    f"{name}, shadows {r['beside']}: {r['seconds']:.2f} s, wanted at most {limit} s"
                )
    if a.json:
        found = {"device": a.device, "frames": a.frames, "rows": rows, "linear": ratios}
        a.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
