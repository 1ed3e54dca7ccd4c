"""Errors of the closed form on the look-alikes, beside those of their published recipe.

    python benchmarks/look_alikes.py [SCENE ...] [--rays 2] [--json FILE]

Ideal quads from analytic first hits: one centre ray per pixel (or --rays x --rays), instantaneous exposure, no noise,
direct light. Protocol ftorf13: first raw frame of every quartet but the first and the last, all pixels, mean over
pixels and frames of the squared difference from the truth [m^2 x 100]; no cyclic distance, so a wrapped pixel costs up
to 56 m^2. Truth is that of the first raw frame of the quartet, in the last column half a quartet (1.5 raw frames)
later. Columns differ in the sensor: one tap (dc 1) or two (dc 0), and the shifts in time order.

Ours, then what the recipe should give; accepted within 3 % or 0.002. Ends with 1 if a value is not.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.evaluate.metrics import ERROR_UNIT, mean_over_frames, scored_frames, squared_error
from gftorf_warp.sim.ideal import ideal_recording, light_of
from gftorf_warp.sim.record import frame_times
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.scenes import SCENES

RELATIVE, ABSOLUTE = 0.03, 0.002
PAIRED, IN_TURN = CANONICAL_SHIFTS, (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)
REAL = (math.pi, math.pi / 2, 0.0, 3 * math.pi / 2)
SYNTHETIC = {  # column: (dc offset, shifts in time order, raw frames from the first of a quartet to its truth)
    "dc 1 0/180/90/270": (1.0, PAIRED, 0.0),
    "dc 1 0/90/180/270": (1.0, IN_TURN, 0.0),
    "dc 0 0/180/90/270": (0.0, PAIRED, 0.0),
    "dc 0 0/90/180/270": (0.0, IN_TURN, 0.0),
    "dc 1 mid": (1.0, PAIRED, 1.5),
}
TARGETS: dict[str, tuple[float, ...]] = {  # as tabulated for the recipes; the first is what a scene was tuned for
    "sliding_cube": (0.105, 0.111, 0.035, 0.025, 0.105),
    "occlusion": (0.142, 0.157, 0.043, 0.025, 0.145),
    "z_motion_speed_test": (2.047, 0.996, 2.174, 1.489, 1.157),
    "speed_test_texture": (3.148, 2.070, 2.477, 1.512, 1.497),
    "speed_test_chair": (0.690, 0.747, 0.282, 0.227, 0.587),
    "arcing_cube": (37.50, 18.96, 40.06, 25.71, 14.93),
    "acute_z_speed_test": (43.78, 29.98, 50.22, 41.87, 20.08),
}
MIXED = (0.063, 0.080, 1.66, 3.03, 0.591, 36.7, 44.7)  # the first column with 2x2 rays, same order
PUBLISHED = (0.096, 0.130, 2.068, 3.131, 0.787, 36.768, 41.931)  # of the published scenes, same order


def errors(scene: Scene, columns: dict[str, tuple], *, rays: int = 1) -> list[float]:
    """Mean squared error of the closed form [m^2 x 100] for every column."""
    times = frame_times(scene.sensor, scene.frames, sync=False)
    empty, _ = ideal_recording(scene, {})
    complete = replace(empty, measured=np.ones(scene.frames, dtype=bool))
    frames = scored_frames(complete, "ftorf13")
    wanted = [n + k for n in frames for k in range(FRAMES_PER_QUARTET)]
    lights = {n: light_of(scene, float(times[n]), rays=rays) for n in wanted}
    found = []
    for dc_offset, shifts, delay in columns.values():
        sensor = replace(scene.sensor, dc_offset=dc_offset, unipolar=dc_offset >= 1, shifts=shifts)
        sequence, truth = ideal_recording(scene, lights, sensor)
        true = truth.distance[frames]
        if delay:
            later = [float(times[n]) + delay * sensor.frame_period_s for n in frames]
            true = np.stack([light_of(scene, time).distance for time in later])
        decoded = np.stack([closed_form_distance(sequence, n // FRAMES_PER_QUARTET) for n in frames])
        error = squared_error(decoded, true)
        found.append(ERROR_UNIT * (mean_over_frames(error, np.ones(error.shape, dtype=bool)) or 0.0))
    return found


def accepted(ours: float, target: float) -> bool:
    """Whether a value is what the recipe should give."""
    return abs(ours - target) <= max(RELATIVE * target, ABSOLUTE)


def main() -> int:
    """Print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", metavar="SCENE", nargs="*", help=f"one of {', '.join(TARGETS)}; all of them")
    parser.add_argument("--rays", type=int, default=1, choices=(1, 2), help="rays per pixel and axis (1)")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    if unknown := set(a.scenes) - set(TARGETS):
        parser.error(f"unknown scene {', '.join(sorted(unknown))}")
    columns = SYNTHETIC if a.rays == 1 else dict(list(SYNTHETIC.items())[:1])
    print(f"{'ours / target [m^2 x 100]':26}{'published':>10}" + "".join(f"{name:>22}" for name in columns))
    rows, good = {}, True
    for index, (name, targets) in enumerate(TARGETS.items()):
        if a.scenes and name not in a.scenes:
            continue
        wanted = targets if a.rays == 1 else (MIXED[index],)
        ours = errors(SCENES[name], columns, rays=a.rays)
        marks = ["" if accepted(x, t) else " !" for x, t in zip(ours, wanted, strict=True)]
        good &= not any(marks)
        cells = [f"{x:.3f} / {t:.3f}{mark:2}" for x, t, mark in zip(ours, wanted, marks, strict=True)]
        print(f"{name:26}{PUBLISHED[index]:10.3f}" + "".join(f"{cell:>22}" for cell in cells), flush=True)
        rows[name] = {"ours": dict(zip(columns, ours, strict=True)), "target": dict(zip(columns, wanted, strict=True))}
    print(f"accepted within {100 * RELATIVE:g} % or {ABSOLUTE:g}: {'all' if good else 'not those marked !'}")
    if a.json:
        about = {"protocol": "ftorf13", "rays": a.rays, "relative": RELATIVE, "absolute": ABSOLUTE}
        a.json.write_text(json.dumps(about | {"scenes": rows}, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
