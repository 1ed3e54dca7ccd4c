"""Mistakes planted in simulated recordings, and how many of them `gftorf check` finds.

    python benchmarks/planted_mistakes.py [--scenes 400-411] [--size 48x36] [--frames 32]

Random scenes are `gftorf simulate random-N --engine mesh`, with noise; the six with a carried
camera are added for mistakes in poses. Each recording is simulated once; mistakes are planted in
memory, without ground truth. A mistake is found if one of the findings that the table names is
among those of the check. Recordings that are right, as simulated and with values that are stated
rightly, must have no finding at all. Thresholds were set on random-0 to 15 and the carried cameras.

Mistakes of UNDETECTABLE leave all that a camera records as it was, or change it less than the scene
does; docs/check.md says why. They are counted apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from accuracy import numbers

from gftorf_warp.data.check import examine
from gftorf_warp.data.decode import quartet_phasors
from gftorf_warp.data.report import Report
from gftorf_warp.data.sequence import Intrinsics, Sequence
from gftorf_warp.data.temporal import camera_rests
from gftorf_warp.sim.random_scene import random_scene
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.settings import SimSettings

CARRIED = ("tour", "photocopier", "cupboard", "deskbox", "phonebooth", "studybook")
CARRIED_FRAMES = 96  # of a second: a camera must move to be tested
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Plant = Callable[[Sequence, np.random.Generator], Sequence]


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """A way to spoil a recording."""

    plant: Plant
    """The spoiled recording."""
    found_by: tuple[str, ...]
    """Names of findings that count as having found it."""
    moving: bool | None = None
    """Whether the camera must move (True) or rest (False); None: either."""


def calibrated(sequence: Sequence, **values: float) -> Sequence:
    """With other constants of the sensor."""
    return replace(sequence, calibration=replace(sequence.calibration, **values))


def pinhole(sequence: Sequence, change: Callable[[Intrinsics], Intrinsics]) -> Sequence:
    """With other intrinsics."""
    return replace(sequence, intrinsics=change(sequence.intrinsics))


def amplitude(sequence: Sequence) -> float:
    """Mean amplitude of the first quartet [quad units]."""
    return float(np.hypot(*_phasor(sequence, sequence.complete_quartets[0])).mean()) / 2.0


def _phasor(sequence: Sequence, i: int) -> np.ndarray:
    return quartet_phasors(sequence, i)[0][1]


def reordered(sequence: Sequence, order: list[int]) -> Sequence:
    """Shifts stated in another order within every cycle."""
    frames = np.arange(sequence.frames)
    slot = frames % sequence.cycle
    of = np.minimum(frames - slot + np.array(order)[slot], sequence.frames - 1)
    return replace(sequence, shifts=sequence.shifts[of])


def wrong_order(sequence: Sequence, draw: np.random.Generator) -> Sequence:
    """Any of the 23 wrong orders, a quarter turn among them."""
    while True:
        order = draw.permutation(sequence.cycle).tolist()
        if order != sorted(order):
            return reordered(sequence, order)


def repeated(sequence: Sequence, draw: np.random.Generator) -> Sequence:
    """A raw frame that was delivered twice, instead of the next one or a cycle later."""
    step = int(draw.choice([1, sequence.cycle]))
    n = int(draw.integers(step, sequence.frames))
    quads = sequence.quads.copy()
    quads[n] = quads[n - step]
    return replace(sequence, quads=quads)


def without_frame(sequence: Sequence, n: int, *, seen_in_times: bool) -> Sequence:
    """A raw frame is lost, and the shifts of the later ones slip."""
    quads = np.delete(sequence.quads, n, axis=0)
    times = np.delete(sequence.times, n) if seen_in_times else sequence.times[:-1]
    exposures = None if sequence.exposures is None else sequence.exposures[:-1]
    return replace(
        sequence,
        quads=quads,
        times=times,
        exposures=exposures,
        measured=sequence.measured[:-1],
        shifts=sequence.shifts[:-1],
        camera_from_world=np.delete(sequence.camera_from_world, n, axis=0),
    )


def lost(seen_in_times: bool) -> Plant:
    """A raw frame in the middle third is lost."""

    def plant(sequence: Sequence, draw: np.random.Generator) -> Sequence:
        n = int(draw.integers(sequence.frames // 3, 2 * sequence.frames // 3))
        return without_frame(sequence, n, seen_in_times=seen_in_times)

    return plant


def with_harmonic(sequence: Sequence, harmonic: int, ratio: float) -> Sequence:
    """Quads with a harmonic of the modulation."""
    quads = sequence.quads.astype(np.float64)
    for i in sequence.complete_quartets:
        re, im = _phasor(sequence, i)
        for n in range(sequence.frames)[sequence.quartet_frames(i)]:
            phase = np.arctan2(im, re) - sequence.shifts[n]
            quads[n] += 0.5 * ratio * np.hypot(re, im) * np.cos(harmonic * phase)
    return replace(sequence, quads=quads.astype(np.float32))


def clipped(sequence: Sequence, draw: np.random.Generator) -> Sequence:
    """The largest one to five per cent of the quads are cut off."""
    limit = float(np.quantile(np.abs(sequence.quads), 1.0 - draw.uniform(0.01, 0.05)))
    return replace(sequence, quads=np.clip(sequence.quads, -limit, limit))


def jittered(sequence: Sequence, draw: np.random.Generator) -> Sequence:
    """Times of a computer's clock, 10 % of an interval beside those of the camera."""
    spread = 0.1 * float(np.median(np.diff(sequence.times)))
    times = sequence.times + draw.normal(0.0, spread, sequence.frames)
    return replace(sequence, times=np.sort(times) - times.min())


def at_double_frequency(sequence: Sequence) -> Sequence:
    """The same scene at twice the frequency, and half the range."""
    quads = sequence.quads.astype(np.float64)
    for i in sequence.complete_quartets:
        re, im = _phasor(sequence, i)
        length, phase = np.hypot(re, im), 2.0 * np.arctan2(im, re)
        for n in range(sequence.frames)[sequence.quartet_frames(i)]:
            old = 0.5 * length * np.cos(phase / 2.0 - sequence.shifts[n])
            quads[n] += 0.5 * length * np.cos(phase - sequence.shifts[n]) - old
    calibration = replace(
        sequence.calibration,
        f_mod_hz=2.0 * sequence.calibration.f_mod_hz,
        phase_offset=2.0 * sequence.calibration.phase_offset,
    )
    return replace(sequence, quads=quads.astype(np.float32), calibration=calibration)


def wrapping(sequence: Sequence, _: np.random.Generator) -> Sequence:
    """Rooms reach over a half to all of the range; at four times the frequency they wrap."""
    return at_double_frequency(at_double_frequency(sequence))


def too_long(sequence: Sequence, _: np.random.Generator) -> Sequence:
    """Distances a third too long."""
    return calibrated(sequence, f_mod_hz=0.75 * sequence.calibration.f_mod_hz)


def scaled_poses(sequence: Sequence, factor: float) -> Sequence:
    """Translations in another unit."""
    poses = sequence.camera_from_world.copy()
    poses[:, :3, 3] *= factor
    return replace(sequence, camera_from_world=poses)


def with_constant(sequence: Sequence, zero: float, share: float) -> Sequence:
    """Quads with an additive zero, in mean amplitudes, and a share of their amplitude."""
    quads = sequence.quads + np.float32(zero * amplitude(sequence))
    for i in sequence.complete_quartets:
        quads[sequence.quartet_frames(i)] += np.float32(0.5 * share) * np.hypot(
            *_phasor(sequence, i)
        ).astype(np.float32)
    return replace(sequence, quads=quads)


MISTAKES: Mapping[str, Mistake] = {
    "shifts of the other sign": Mistake(
        plant=lambda s, _: replace(s, shifts=-s.shifts), found_by=("order",)
    ),
    "wrong order of shifts": Mistake(plant=wrong_order, found_by=("order",)),
    "depth_range in mm (15000)": Mistake(
        plant=lambda s, _: calibrated(s, f_mod_hz=s.calibration.f_mod_hz / 1e3),
        found_by=("frequency",),
    ),
    "phase offset 90, in degrees": Mistake(
        plant=lambda s, _: calibrated(s, phase_offset=90.0), found_by=("offset unit",)
    ),
    "phase offset unknown, a third of a turn": Mistake(
        plant=lambda s, _: calibrated(s, phase_offset=s.calibration.phase_offset + 2.0),
        found_by=("offset", "wrap", "order"),
    ),
    "times in ms": Mistake(
        plant=lambda s, _: replace(s, times=1e3 * s.times), found_by=("time unit",)
    ),
    "times in us": Mistake(
        plant=lambda s, _: replace(s, times=1e6 * s.times), found_by=("time unit",)
    ),
    "exposures in ms": Mistake(
        plant=lambda s, _: replace(s, exposures=1e3 * s.exposures), found_by=("exposure",)
    ),
    "a raw frame repeated": Mistake(plant=repeated, found_by=("repeated frame",)),
    "a raw frame lost, seen in times": Mistake(plant=lost(True), found_by=("frame drops",)),
    "a raw frame lost, times by number": Mistake(plant=lost(False), found_by=("slip", "order")),
    "times of a computer's clock": Mistake(plant=jittered, found_by=("trigger jitter",)),
    "a zero of 14 amplitudes": Mistake(
        plant=lambda s, _: with_constant(s, 14.083, 0.0), found_by=("constant part",)
    ),
    "that zero stated as dc_offset": Mistake(
        plant=lambda s, _: calibrated(with_constant(s, 14.083, 0.0), dc_offset=14.083),
        found_by=("constant part",),
    ),
    "one tap, dc_offset not stated": Mistake(
        plant=lambda s, _: calibrated(with_constant(s, 0.0, 1.0), dc_offset=0.0),
        found_by=("constant part",),
    ),
    "saturation": Mistake(plant=clipped, found_by=("saturation",)),
    "second harmonic of 15 %": Mistake(
        plant=lambda s, _: with_harmonic(s, 2, 0.15), found_by=("wiggling",)
    ),
    "surfaces beyond the range": Mistake(plant=wrapping, found_by=("wrap", "offset")),
    "focal length in mm (4)": Mistake(
        plant=lambda s, _: pinhole(s, lambda k: replace(k, fx=4.0, fy=4.0)),
        found_by=("focal length",),
    ),
    "intrinsics of twice the size": Mistake(
        plant=lambda s, _: pinhole(s, lambda k: k.scaled(2.0, 2.0)), found_by=("principal point",)
    ),
    "half a pixel": Mistake(
        plant=lambda s, _: pinhole(s, lambda k: replace(k, cx=k.cx - 0.5, cy=k.cy - 0.5)),
        found_by=("half pixel",),
    ),
    "poses the wrong way round": Mistake(
        plant=lambda s, _: replace(s, camera_from_world=np.linalg.inv(s.camera_from_world)),
        found_by=("pose convention",),
        moving=True,
    ),
    "poses of OpenGL": Mistake(
        plant=lambda s, _: replace(s, camera_from_world=FLIP @ s.camera_from_world),
        found_by=("pose convention",),
        moving=True,
    ),
    "depth_range 20 for 15, camera moves": Mistake(
        plant=too_long, found_by=("scale",), moving=True
    ),
    "poses in mm": Mistake(
        plant=lambda s, _: scaled_poses(s, 1e3), found_by=("pose unit",), moving=True
    ),
}
UNDETECTABLE: Mapping[str, Mistake] = {
    "depth_range 20 for 15, camera at rest": Mistake(
        plant=too_long, found_by=("scale", "frequency"), moving=False
    ),
    "focal length 20 % too long": Mistake(
        plant=lambda s, _: pinhole(s, lambda k: replace(k, fx=1.2 * k.fx, fy=1.2 * k.fy)),
        found_by=("focal length",),
    ),
    "third harmonic of 11 %": Mistake(
        plant=lambda s, _: with_harmonic(s, 3, 1.0 / 9.0), found_by=("wiggling",)
    ),
}
RIGHT: Mapping[str, Plant] = {
    "as recorded": lambda s, _: s,
    "zero and DC offset stated": lambda s, _: calibrated(
        with_constant(s, 0.0, 1.0), dc_offset=s.calibration.dc_offset + 1.0
    ),
    "phase offset stated": lambda s, _: calibrated(
        replace(s, shifts=s.shifts - 1.0), phase_offset=s.calibration.phase_offset - 1.0
    ),
    "a raw frame not measured": lambda s, _: replace(s, measured=np.arange(s.frames) != 9),
}


def findings(sequence: Sequence) -> list[str]:
    """Names of the findings in a sequence in memory."""
    report = Report(path=None, form="capture")
    examine(sequence, report)
    return [finding.name for finding in report.findings]


def bases(
    scenes: list[int], size: tuple[int, int], frames: int, carried: tuple[str, ...] = CARRIED
) -> dict[str, Sequence]:
    """Recordings by name: random scenes, and scenes with a carried camera."""
    made = {f"random-{n}": (random_scene(n), frames) for n in scenes}
    made |= {name: (SCENES[name], CARRIED_FRAMES) for name in carried}
    settings = SimSettings(size=size, engine="mesh", format="capture")
    return {
        name: record(replace(scene, colour=None), replace(settings, frames=count)).sequence
        for name, (scene, count) in made.items()
    }


def planted(recordings: dict[str, Sequence], mistakes: Mapping[str, Mistake]) -> Iterator[str]:
    """Rows of a table, the last with the sums; what was missed is named."""
    hits = total = 0
    for number, (name, mistake) in enumerate(mistakes.items()):
        missed, used = [], 0
        for scene, sequence in recordings.items():
            if mistake.moving is not None and mistake.moving == camera_rests(sequence):
                continue
            draw = np.random.default_rng((number, used))
            used += 1
            if not set(findings(mistake.plant(sequence, draw))) & set(mistake.found_by):
                missed.append(scene)
        hits, total = hits + used - len(missed), total + used
        yield f"| {name} | {used - len(missed)} of {used} | {', '.join(missed)} |"
    yield f"| **all** | **{hits} of {total}, {hits / total:.1%}** | |"


def false_alarms(recordings: dict[str, Sequence]) -> Iterator[str]:
    """Rows of a table about recordings that are right."""
    for name, change in RIGHT.items():
        alarms = {}
        for scene, sequence in recordings.items():
            found = findings(change(sequence, np.random.default_rng(0)))
            if found:
                alarms[scene] = found
        listed = "; ".join(f"{scene}: {', '.join(found)}" for scene, found in alarms.items())
        yield f"| {name} | {len(alarms)} of {len(recordings)} | {listed} |"


def main(arguments: list[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=numbers, default=list(range(400, 412)))
    parser.add_argument("--size", default="48x36", metavar="WxH")
    parser.add_argument("--frames", type=int, default=32)
    options = parser.parse_args(arguments)
    width, _, height = options.size.partition("x")
    recordings = bases(options.scenes, (int(width), int(height)), options.frames)
    for head, rows in (
        (("mistake", "found", "missed in"), planted(recordings, MISTAKES)),
        (("cannot be found", "found", "missed in"), planted(recordings, UNDETECTABLE)),
        (("right recording", "false alarms", "which"), false_alarms(recordings)),
    ):
        print(f"\n| {' | '.join(head)} |\n|---|---|---|")
        for row in rows:
            print(row, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
