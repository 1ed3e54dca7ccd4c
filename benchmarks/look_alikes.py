"""Errors of the closed form on the look-alikes, beside what their recipes should give.

    python benchmarks/look_alikes.py [--group synthetic|recorded|carried|all] [--rays 2] [--json
    FILE]
    python benchmarks/look_alikes.py --reconstruct OUT [options of gftorf sweep]

Ideal quads from analytic first hits: one centre ray per pixel (or --rays x --rays), instantaneous
exposure, no noise, direct light. Protocol ftorf13: first raw frame of every quartet but the first
and the last of 60 raw frames, all pixels, mean over pixels and frames of the squared difference
from the truth [m^2 x 100]; no cyclic distance, so that a wrapped pixel costs up to 56 m^2. Longer
recordings are scored on the same 13 quartets, carried cameras on every third quartet from the third
on. Truth is that of the first raw frame of the quartet, or, "mid", half a quartet (1.5 raw frames)
later. Columns differ in the sensor too: one tap (dc 1) or two (dc 0), and the shifts in time order.

With --reconstruct the presets of look_alikes.toml are fitted, `gftorf sweep` prints the table.

Ours, then the recipe; accepted within 3 % or 0.002 (0.005 for carried cameras). Ends with 1 if a
value is not.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.evaluate.metrics import ERROR_UNIT, mean_over_frames, squared_error
from gftorf_warp.sim.ideal_sensor import ideal_recording, light_of
from gftorf_warp.sim.record import frame_times
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.sensors import PALINDROMIC, SEQUENTIAL

RELATIVE, ABSOLUTE = 0.03, 0.002
PLAN = Path(__file__).with_suffix(".toml")  # of the fits
TORF_ABSOLUTE = 0.005
PAIRED, IN_TURN, REAL = CANONICAL_SHIFTS, SEQUENTIAL, PALINDROMIC


@dataclass(frozen=True, kw_only=True)
class Column:
    """How a scene is read, and what is true."""

    dc: float
    """DC offset of the sensor [1]; 1: one tap."""
    shifts: tuple[float, ...]
    """In time order [rad]."""
    delay: float = 0.0
    """From the first raw frame of a quartet to its truth [raw frames]."""
    cyclic: bool = False
    """Whether whole unambiguous ranges are forgiven."""


@dataclass(frozen=True, kw_only=True)
class Group:
    """Scenes that are read alike."""

    columns: dict[str, Column]
    """By title."""
    frames: tuple[int, ...]
    """Raw frames that are scored."""
    targets: dict[str, tuple[float, ...]]
    """What the recipes should give, by scene, one for each column."""
    absolute: float = ABSOLUTE
    """Difference that is always accepted [m^2 x 100]."""


SYNTHETIC = Group(
    columns={
        "dc 1 0/180/90/270": Column(dc=1.0, shifts=PAIRED),  # what the scenes were tuned for
        "dc 1 0/90/180/270": Column(dc=1.0, shifts=IN_TURN),
        "dc 0 0/180/90/270": Column(dc=0.0, shifts=PAIRED),
        "dc 0 0/90/180/270": Column(dc=0.0, shifts=IN_TURN),
        "dc 1 0/180.. mid": Column(dc=1.0, shifts=PAIRED, delay=1.5),
    },
    frames=tuple(range(4, 56, 4)),
    targets={
        "sliding_cube": (0.105, 0.111, 0.035, 0.025, 0.105),
        "occlusion": (0.142, 0.157, 0.043, 0.025, 0.145),
        "z_motion_speed_test": (2.047, 0.996, 2.174, 1.489, 1.157),
        "speed_test_texture": (3.148, 2.070, 2.477, 1.512, 1.497),
        "speed_test_chair": (0.690, 0.747, 0.282, 0.227, 0.587),
        "arcing_cube": (37.50, 18.96, 40.06, 25.71, 14.93),
        "acute_z_speed_test": (43.78, 29.98, 50.22, 41.87, 20.08),
    },
)
MIXED = replace(
    SYNTHETIC,
    columns={"dc 1 0/180/90/270": Column(dc=1.0, shifts=PAIRED)},
    targets=dict(
        zip(
            SYNTHETIC.targets,
            ((x,) for x in (0.063, 0.080, 1.66, 3.03, 0.591, 36.7, 44.7)),
            strict=True,
        )
    ),
)
RECORDED = Group(
    columns={
        "dc 0 180/90/0/270": Column(dc=0.0, shifts=REAL),
        "dc 0 0/180/90/270": Column(dc=0.0, shifts=PAIRED),
        "dc 0 180.. cyclic": Column(dc=0.0, shifts=REAL, cyclic=True),
    },
    frames=tuple(range(4, 56, 4)),
    targets={
        "pillow": (2.108, 2.873, 2.108),
        "baseball": (1.492, 1.940, 1.455),
        "jacks": (2.970, 4.445, 2.970),
        "target": (1925.6, 1924.7, 1.667),
        "fan": (10.31, 10.47, 10.31),
    },
)
CARRIED = Group(
    columns={
        "dc 0 180/90/0/270": Column(dc=0.0, shifts=REAL),
        "dc 0 180.. mid": Column(dc=0.0, shifts=REAL, delay=1.5),
        "dc 0 0/180.. mid": Column(dc=0.0, shifts=PAIRED, delay=1.5),
        "180.. mid, cyclic": Column(dc=0.0, shifts=REAL, delay=1.5, cyclic=True),
    },
    frames=tuple(range(8, 120, 12)),
    targets={
        "photocopier": (0.123, 0.052, 0.160, 0.052),
        "cupboard": (0.395, 0.138, 0.225, 0.138),
        "deskbox": (0.188, 0.106, 0.142, 0.106),
        "phonebooth": (1.555, 0.845, 0.720, 0.808),
        "phonebooth_far": (1297.9, 1297.6, 1297.4, 0.681),
        "studybook": (0.213, 0.117, 0.141, 0.117),
    },
    absolute=TORF_ABSOLUTE,
)
GROUPS = {"synthetic": SYNTHETIC, "recorded": RECORDED, "carried": CARRIED}


def errors(scene: Scene, group: Group, *, rays: int = 1) -> list[float]:
    """Mean squared error of the closed form [m^2 x 100] for every column."""
    times = frame_times(scene.sensor, scene.frames, sync=False)
    wanted = [n + k for n in group.frames for k in range(FRAMES_PER_QUARTET)]
    lights = {n: light_of(scene, float(times[n]), rays=rays) for n in wanted}
    truths = {0.0: np.stack([lights[n].distance for n in group.frames])}
    found = []
    for column in group.columns.values():
        sensor = replace(
            scene.sensor, dc_offset=column.dc, unipolar=column.dc >= 1, shifts=column.shifts
        )
        if column.delay not in truths:
            later = [
                light_of(scene, float(times[n]) + column.delay * sensor.frame_period_s)
                for n in group.frames
            ]
            truths[column.delay] = np.stack([light.distance for light in later])
        true = truths[column.delay]
        sequence, _ = ideal_recording(scene, lights, sensor)
        decoded = np.stack(
            [closed_form_distance(sequence, n // FRAMES_PER_QUARTET) for n in group.frames]
        )
        if column.cyclic:
            decoded = decoded - sensor.unambiguous_range * np.round(
                (decoded - true) / sensor.unambiguous_range
            )
        error = squared_error(decoded, true)
        found.append(
            ERROR_UNIT * (mean_over_frames(error, np.ones(error.shape, dtype=bool)) or 0.0)
        )
    return found


def half_size(scene: Scene) -> Scene:
    """The scene with half as many rows and columns, for tests; its errors differ from those at full
    size by up to a half.
    """
    return replace(scene, width=scene.width // 2, height=scene.height // 2)


def accepted(ours: float, target: float, group: Group) -> bool:
    """Whether a value is what the recipe should give."""
    return abs(ours - target) <= max(RELATIVE * target, group.absolute)


def main() -> int:
    """Print the table, write the JSON."""
    if "--reconstruct" in sys.argv[1:]:
        from gftorf_warp.cli import main as gftorf

        at = sys.argv.index("--reconstruct") + 1
        return gftorf(["sweep", str(PLAN), "--out", *sys.argv[at:]])
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--group", choices=(*GROUPS, "all"), default="synthetic", help="which scenes (synthetic)"
    )
    parser.add_argument(
        "--rays",
        type=int,
        default=1,
        choices=(1, 2),
        help="rays per pixel and axis, of synthetic (1)",
    )
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    groups = GROUPS if a.group == "all" else {a.group: GROUPS[a.group]}
    if a.rays > 1:
        groups = {"synthetic, 2x2 rays": MIXED}
    rows, good = {}, True
    for title, group in groups.items():
        print(f"{title + ': ours / recipe':26}" + "".join(f"{name:>22}" for name in group.columns))
        for name, targets in group.targets.items():
            ours = errors(SCENES[name], group, rays=a.rays)
            marks = [
                "" if accepted(x, t, group) else " !" for x, t in zip(ours, targets, strict=True)
            ]
            good &= not any(marks)
            cells = [
                f"{x:.3f} / {t:.3f}{mark:2}"
                for x, t, mark in zip(ours, targets, marks, strict=True)
            ]
            print(f"{name:26}" + "".join(f"{cell:>22}" for cell in cells), flush=True)
            rows[name] = {
                "ours": dict(zip(group.columns, ours, strict=True)),
                "recipe": dict(zip(group.columns, targets, strict=True)),
                "half size": errors(half_size(SCENES[name]), group, rays=a.rays),
            }
        print(f"accepted within {100 * RELATIVE:g} % or {group.absolute:g}\n")
    print("all accepted" if good else "not accepted: those marked !")
    if a.json:
        about = {"rays": a.rays, "unit": "m^2 x 100", "relative": RELATIVE, "absolute": ABSOLUTE}
        a.json.write_text(json.dumps(about | {"scenes": rows}, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
