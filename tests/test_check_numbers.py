"""Rules of ``gftorf check`` that decode nothing: units, conventions, times and their borders."""

import dataclasses
import math

import numpy as np
import pytest
from ftorf_folder import scene
from sequences import changed

from gftorf_warp.data import timing, units
from gftorf_warp.data.report import Report


def recording(frames=16, noise=1e-3, **changes):
    """A wall with noise, so that no raw frame repeats."""
    sequence = scene(frames, 12, 16)[0]
    draw = np.random.default_rng(0).normal(0.0, noise, sequence.quads.shape)
    sequence = dataclasses.replace(sequence, quads=(sequence.quads + draw).astype(np.float32))
    return changed(sequence, **changes)


def said(rule, sequence):
    """Findings of one rule, as (name, text)."""
    report = Report(path=None, form="capture")
    rule(sequence, report)
    return [(finding.name, finding.text) for finding in report.findings]


def moving(step):
    """Poses of a camera that moves by a step [m] per raw frame."""
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 0, 3] = step * np.arange(16)
    return poses


@pytest.mark.parametrize(
    ("rule", "right", "wrong", "words"),
    [
        (units.frequency, {"f_mod_hz": 1e6}, {"f_mod_hz": 2e4}, "millimetres"),
        (units.frequency, {"f_mod_hz": 3e8}, {"f_mod_hz": 1e9}, "kilohertz"),
        (units.offset_unit, {"phase_offset": -6.2}, {"phase_offset": 90.0}, "1.5708"),
        (units.focal_length, {"fx": 12.0}, {"fx": 3.0}, "view of 138.9 degrees"),
        (units.focal_length, {"fy": 60.0}, {"fy": 70.0}, "fy 70"),
        (units.principal_point, {"cx": 10.0}, {"cx": 16.0, "cy": 12.0}, "2 times as wide"),
        (units.principal_point, {"cy": 5.0}, {"cy": -1.0}, "outside the image"),
        (units.half_pixel, {"cx": 7.5, "cy": 6.1}, {"cx": 7.5, "cy": 5.5}, "add +0.5"),
        (units.half_pixel, {"cx": 8.0, "cy": 6.0}, {"cx": 8.5, "cy": 6.5}, "add -0.5"),
        (
            units.pose_unit,
            {"camera_from_world": moving(0.1)},
            {"camera_from_world": moving(1.0)},
            "millimetres",
        ),
        (timing.time_unit, {"times": np.arange(16) / 3}, {"times": np.arange(16.0)}, "by 0.001"),
        (
            timing.time_unit,
            {"times": np.arange(16) / 1e4},
            {"times": np.arange(16) * 8333.0},
            "by 1e-06",
        ),
        (
            timing.time_unit,
            {"times": np.arange(16) / 1e4},
            {"times": np.arange(16) * 8.333e6},
            "in nanoseconds? then multiply them by 1e-09",
        ),
        (
            timing.time_unit,
            {"times": np.zeros(16)},
            {"times": np.arange(16) * 8e-6},
            "multiply them by 1000",
        ),
        (
            timing.exposure,
            {"exposures": np.full(16, 8e-3)},
            {"exposures": np.full(16, 2.34)},
            "milliseconds",
        ),
    ],
)
def test_a_number_is_accepted_up_to_its_border(rule, right, wrong, words):
    """A value that exists, and one that is another unit or convention, with what to do."""
    assert said(rule, recording(**right)) == []
    ((_, text),) = said(rule, recording(**wrong))
    assert words in text


def test_times_of_one_instant_have_no_gaps():
    """Quads that are taken at once, and phasors: the interval is that of cycles."""
    at_once = np.repeat(np.arange(4) / 30.0, 4)
    assert said(timing.gaps, recording(times=at_once)) == []
    assert said(timing.exposure, recording(times=at_once, exposures=np.full(16, 2e-3))) == []
    late = at_once + 0.1 * (np.arange(16) >= 8)
    assert [name for name, _ in said(timing.gaps, recording(times=late))] == ["frame drops"]


def test_intervals_may_depend_on_the_slot():
    """A pause after every cycle is no gap; one more raw frame of pause is."""
    times = (np.arange(16) + np.arange(16) // 4) / 120.0
    assert said(timing.gaps, recording(times=times)) == []
    times[8:] += 1 / 120.0
    ((name, text),) = said(timing.gaps, recording(times=times))
    assert (name, "after raw frame 7" in text) == ("frame drops", True)


def test_raw_frames_of_a_frequency_may_share_their_time():
    """As those of a Kinect: three at one time, three times a cycle; two cycles show it."""
    cycle = np.repeat([0.0, 0.3, 0.6], 3) / 30.0
    changes = {"shifts": np.resize([0.0, 2.0, 4.0], 18), "cycle_length": 9}
    times = np.concatenate([cycle, cycle + 1 / 30.0])
    assert said(timing.gaps, recording(frames=18, times=times, **changes)) == []
    late = np.concatenate([times, cycle + 4 / 30.0])
    changes["shifts"] = np.resize(changes["shifts"], 27)
    found = said(timing.gaps, recording(frames=27, times=late, **changes))
    assert [name for name, _ in found] == ["frame drops"]
    late[18:] -= 2 / 30.0
    late[9:18] += 0.001
    found = said(timing.gaps, recording(frames=27, times=late, **changes))
    assert [name for name, _ in found] == ["trigger jitter"]


def test_repeats_need_noise():
    """One equal raw frame among noisy ones is named; a scene at rest without noise is none."""
    sequence = recording()
    sequence.quads[9] = sequence.quads[8]
    ((_, text),) = said(timing.repeats, sequence)
    assert "9 = 8" in text
    assert said(timing.repeats, recording(noise=0.0)) == []
    dark = recording()
    dark.quads[[4, 8]] = 0.0  # not light that repeats
    assert said(timing.repeats, dark) == []


def test_a_slip_is_sudden():
    """Shifts that slip change every pixel at once; light that is switched down slowly does not."""
    sequence = recording(32)
    slipped = dataclasses.replace(sequence, quads=np.roll(sequence.quads, -1, axis=0))
    quads = np.concatenate([sequence.quads[:16], slipped.quads[16:]])
    ((_, text),) = said(timing.slip, dataclasses.replace(sequence, quads=quads))
    assert "from raw frame 12 to 16" in text
    fading = np.linspace(1.0, 0.3, 32)[:, None, None].astype(np.float32)
    assert said(timing.slip, dataclasses.replace(sequence, quads=sequence.quads * fading)) == []


def test_a_turn_is_no_unit():
    """Offsets up to a turn of either sign are radians."""
    assert said(units.offset_unit, recording(phase_offset=-2 * math.pi)) == []
