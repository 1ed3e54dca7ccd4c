"""Cycles of any number of shifts at one or more frequencies: found, decoded, unwrapped, stored;
noise as predicted.
"""

import math

import numpy as np
import pytest
import torch
from closed_forms import unwrap_failure
from hypothesis import given, settings
from hypothesis import strategies as st
from sequences import changed, sequence_of

from gftorf_warp import Sequence
from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data.check import check
from gftorf_warp.data.cycles import find_cycle, phase_noise
from gftorf_warp.data.decode import (
    closed_form_distance,
    decode_quartet,
    quad_scale,
    quartet_phasors,
    unambiguous_range,
)
from gftorf_warp.data.sequence import Calibration
from gftorf_warp.data.unwrap import CONFIDENT, choose, common_range, multiples
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.scene.measured import distance_noise, key_times, sensor_of
from gftorf_warp.scene.sensor import phasor_from_quads
from gftorf_warp.scene.unwrap import unwrap

TURN = 2 * math.pi
REAL = (math.pi, math.pi / 2, 0.0, 1.5 * math.pi)
UNEVEN = (3.0, 0.2, 5.5, 1.7, 4.0)


def evenly(count):
    """Equally spaced shifts [rad]."""
    return tuple(TURN * k / count for k in range(count))


def still(
    distance, shifts, frequencies=(20e6,), cycles=1, offset=0.4, constant=0.3, noise=0.0, **changes
):
    """A wall at rest: all shifts at the first frequency, then at the next, and so on."""
    rng = np.random.default_rng(len(shifts) + 10 * len(frequencies))
    f = np.tile(np.repeat(frequencies, len(shifts)), cycles)
    theta = np.tile(shifts, len(frequencies) * cycles)
    phase = 4 * np.pi / SPEED_OF_LIGHT * f[:, None, None] * distance + offset
    quads = 0.7 * (np.cos(phase - theta[:, None, None]) + constant)
    quads += noise * rng.normal(size=quads.shape)
    height, width = distance.shape
    fields = {
        "quads": quads.astype(np.float32),
        "measured": np.ones(len(f), dtype=bool),
        "shifts": theta,
        "times": np.arange(len(f)) / 120.0,
        "f_mod_hz": float(frequencies[0]),
        "frequencies_hz": f if len(frequencies) > 1 else None,
        "phase_offset": offset,
        "dc_offset": constant,
        "fx": 20.0,
        "fy": 20.0,
        "cx": width / 2,
        "cy": height / 2,
        "camera_from_world": np.tile(np.eye(4), (len(f), 1, 1)),
    }
    return sequence_of(**fields | changes)


@pytest.mark.parametrize(
    "shifts", [evenly(3), evenly(4), (math.pi, math.pi / 2, 0.0, 1.5 * math.pi), evenly(8), UNEVEN]
)
@pytest.mark.parametrize("frequencies", [(20e6,), (60e6, 40e6), (50e6, 40e6, 30e6)])
def test_a_recording_says_how_long_its_cycle_is(shifts, frequencies):
    """The period of shifts and frequencies, also if the recording ends within a cycle,
    or states it.
    """
    sequence = still(np.full((1, 2), 3.0), shifts, frequencies, cycles=3)
    length = len(shifts) * len(frequencies)
    assert (sequence.cycle, sequence.frequencies) == (length, frequencies)
    assert sequence.complete_quartets == [0, 1, 2]
    assert find_cycle(sequence.shifts[:-1], sequence.frame_frequencies[:-1]) == length
    np.testing.assert_allclose(np.diff(key_times(sequence).numpy()), length / 120.0)
    for frames in (length, length + 1):  # one cycle, and hardly more
        assert find_cycle(sequence.shifts[:frames], sequence.frame_frequencies[:frames]) == length
    assert changed(sequence, cycle_length=3 * length).complete_quartets == [0]


def test_without_a_period_four_raw_frames_are_a_quartet():
    """Orders that change, a recording of one quartet or less, and shifts that say nothing."""
    rng = np.random.default_rng(4)
    shuffled = np.concatenate([rng.permutation(CANONICAL_SHIFTS) for _ in range(5)])
    for shifts in (
        shuffled,
        np.array(CANONICAL_SHIFTS),
        np.array(CANONICAL_SHIFTS[:2]),
        np.zeros(9),
    ):
        assert find_cycle(shifts, np.full(len(shifts), 2e7)) == 4


@settings(max_examples=80, deadline=None, derandomize=True, database=None)
@given(
    shifts=st.lists(st.integers(0, 35), min_size=3, max_size=9, unique=True),
    distance=st.floats(0.05, 14.8),
    offset=st.floats(-8.0, 8.0),
    constant=st.floats(-2.0, 2.0),
)
def test_any_shifts_of_two_frequencies_give_the_distance(shifts, distance, offset, constant):
    """Tenths of a turn in any order, at 30 and 20 MHz: 15 m together, 5 and 7.5 m alone;
    float32 quads.
    """
    angles = tuple(math.radians(10 * k) for k in shifts)
    if phase_noise(angles) > 4.0:
        return  # three neighbours magnify the rounding of float32 beyond the tolerance
    sequence = still(
        np.full((1, 2), distance), angles, (30e6, 20e6), offset=offset, constant=constant
    )
    decoded = decode_quartet(sequence, 0)
    assert unambiguous_range(sequence) == pytest.approx(SPEED_OF_LIGHT / 2e7)
    np.testing.assert_allclose(decoded.distance, distance, atol=1e-4)
    assert decoded.confidence.min() > 0.99
    for single, f in zip(decoded.single, (30e6, 20e6), strict=True):
        reach = SPEED_OF_LIGHT / (2 * f)
        apart = np.mod(single - distance + reach / 2, reach) - reach / 2
        np.testing.assert_allclose(apart, 0.0, atol=1e-4)
        assert ((single >= 0) & (single < reach)).all()


def test_four_shifts_are_the_published_formula():
    """Differences of opposite quads, and the same least squares as in torch for the others."""
    distance = np.linspace(0.3, 7.0, 60).reshape(6, 10)
    sequence = still(distance, CANONICAL_SHIFTS)
    ((frames, (re, im)),) = quartet_phasors(sequence, 0)
    quads = sequence.quads.astype(np.float64)
    assert frames == [0, 1, 2, 3]
    np.testing.assert_allclose(re, quads[0] - quads[1], atol=1e-12)
    np.testing.assert_allclose(im, quads[2] - quads[3], atol=1e-12)
    phase = np.mod(np.arctan2(im, re) - 0.4, TURN)
    np.testing.assert_allclose(
        closed_form_distance(sequence, 0), phase * SPEED_OF_LIGHT / (4 * np.pi * 20e6), rtol=1e-12
    )
    for shifts in (evenly(3), evenly(5), UNEVEN):
        other = still(distance, shifts)
        want = phasor_from_quads(torch.from_numpy(other.quads).double(), shifts)
        np.testing.assert_allclose(quartet_phasors(other, 0)[0][1], torch.stack(want), atol=1e-9)


@pytest.mark.parametrize(
    ("shifts", "theory"), [(evenly(n), math.sqrt(2 / n)) for n in (3, 4, 5, 8)] + [(UNEVEN, None)]
)
def test_noise_of_a_phase_is_as_predicted(shifts, theory):
    """sqrt(2 / K) of noise over amplitude, for uneven shifts the root mean square over all phases;
    3 sigma.
    """
    distance = np.linspace(0, SPEED_OF_LIGHT / 40e6, 60_001)[:-1].reshape(200, 300)
    noise, amplitude = 0.01, 0.7
    sequence = still(distance, shifts, noise=noise)
    error = closed_form_distance(sequence, 0) - distance
    reach = unambiguous_range(sequence)
    error = np.mod(error + reach / 2, reach) - reach / 2
    predicted = phase_noise(shifts) * noise / amplitude
    if theory is not None:
        assert phase_noise(shifts) == pytest.approx(theory)
    kappa = 4 * np.pi * 20e6 / SPEED_OF_LIGHT
    assert kappa * error.std() == pytest.approx(predicted, rel=3 / math.sqrt(2 * error.size) + 2e-3)
    said = distance_noise(torch.tensor(amplitude, dtype=torch.float64), noise, sequence)
    assert float(said) == pytest.approx(predicted / kappa, rel=1e-6)


def test_wrong_turns_are_as_frequent_as_predicted_and_flagged():
    """110 and 100 MHz, noisy: sensor notes, T28; most of the wrong ones are flagged,
    as many as should be.
    """
    distance = np.random.default_rng(3).uniform(0, 14.9, (300, 400))
    sigma = 0.1
    noise = 0.7 * sigma / phase_noise(evenly(8))
    sequence = still(distance, evenly(8), (110e6, 100e6), noise=noise, constant=0.0)
    decoded = decode_quartet(sequence, 0)
    reach = unambiguous_range(sequence)
    apart = np.mod(decoded.distance - distance + reach / 2, reach) - reach / 2
    wrong = np.abs(apart) > 0.5 * SPEED_OF_LIGHT / (2 * 110e6)
    predicted = unwrap_failure(sigma, 11, 10)
    assert wrong.mean() == pytest.approx(
        predicted, abs=0.05 * predicted + 4 * math.sqrt(predicted / wrong.size)
    )
    # noise below four thirds of what it takes
    flagged = 1.0 - unwrap_failure(0.75 * sigma, 11, 10) / predicted
    assert decoded.ambiguous[wrong].mean() == pytest.approx(flagged, abs=0.04)
    assert decoded.ambiguous.mean() < 0.3
    assert (decoded.ambiguous == (decoded.confidence < CONFIDENT)).all()


def test_three_frequencies_reach_farther_and_choose_as_one():
    """All of them have a say: with 50, 40 and 30 MHz the range is 15 m,
    and torch takes the same candidates.
    """
    ms, base = multiples((50e6, 40e6, 30e6))
    assert (ms, base) == ((5, 4, 3), pytest.approx(10e6))
    assert common_range((50e6, 40e6, 30e6)) == pytest.approx(SPEED_OF_LIGHT / 2e7)
    distance = np.linspace(0.01, 14.9, 600).reshape(20, 30)
    sequence = still(distance, evenly(3), (50e6, 40e6, 30e6), noise=0.02)
    np.testing.assert_allclose(decode_quartet(sequence, 0).distance, distance, atol=0.1)
    phases = np.stack(
        [np.mod(m * np.linspace(0, TURN, 500)[:-1] + 0.05 * k, TURN) for k, m in enumerate(ms)]
    )
    turns = choose(phases, ms).turns
    together = unwrap([torch.from_numpy(phase) for phase in phases], ms)
    np.testing.assert_allclose(together, (phases[0] + TURN * turns) / ms[0], atol=1e-12)


def test_two_that_agree_outvote_none_and_a_tie_has_no_confidence():
    """Half way between two candidates nothing can be chosen;
    without light there is no confidence either.
    """
    # of the second phase at m = 3, 2: candidates are pi / 3 apart
    turn = np.array([0.0, math.pi / 6, math.pi / 3])
    confidence = choose(np.stack([np.zeros(3), 2 * turn]), (3, 2)).confidence
    np.testing.assert_allclose(confidence, [1.0, 0.0, 1.0], atol=1e-6)
    dark = still(np.full((1, 2), 3.0), evenly(3), (60e6, 40e6))
    dark.quads[:, 0, 0] = 0.0
    assert decode_quartet(dark, 0).ambiguous.tolist() == [[True, False]]


def test_what_determines_nothing_is_an_error():
    """Two shifts at one frequency, frequencies without a common range, an incomplete cycle."""
    distance = np.full((1, 2), 3.0)
    two = still(distance, (0.0, math.pi, 0.0), (20e6,), cycle_length=3)
    with pytest.raises(InputError, match="three distinct shifts"):
        closed_form_distance(two, 0)
    odd = still(distance, evenly(3), (60e6, 60e6 / math.sqrt(2)))
    for reads in (lambda: closed_form_distance(odd, 0), lambda: sensor_of(odd)):
        with pytest.raises(InputError, match="without a common range"):
            reads()
    measured = np.ones(6, dtype=bool)
    measured[4] = False
    with pytest.raises(ValueError, match="complete"):
        closed_form_distance(still(distance, evenly(3), (60e6, 40e6), measured=measured), 0)
    with pytest.raises(ValueError, match="three different"):
        phase_noise((0.0, math.pi, 0.0))


def test_a_capture_keeps_the_cycle_and_says_what_is_wrong(tmp_path):
    """Stated or found; other layouts have no place for it; impossible ones are named."""
    distance = np.linspace(2.0, 7.0, 20 * 16).reshape(16, 20)
    sequence = still(distance, evenly(3), (60e6, 40e6), cycles=2, cycle_length=6)
    read = Sequence.open(write("capture", tmp_path / "stated", sequence))
    assert (read.cycle, read.calibration.cycle_length, read.frequencies) == (6, 6, (60e6, 40e6))
    np.testing.assert_allclose(closed_form_distance(read, 1), distance, atol=1e-4)
    found = Sequence.open(
        write("capture", tmp_path / "found", changed(sequence, cycle_length=None))
    )
    assert (found.cycle, found.calibration.cycle_length) == (6, None)
    text = str(check(tmp_path / "found"))
    for line in (
        "cycle           6 raw frames; inferred",
        "7.495 m together",
        "no warnings",
        "dc_offset 0.3000 100%",
    ):
        assert line in text
    assert quad_scale(read)[0] == pytest.approx(1 / 1.4, rel=1e-3)
    with pytest.raises(UsageError, match="shifts: the ftorf format"):
        write("ftorf", tmp_path / "other", still(distance, evenly(8), cycles=2))
    path = tmp_path / "stated" / "capture.json"
    (tmp_path / "stated" / "MANIFEST.sha256").unlink()
    path.write_text(path.read_text().replace('"cycle_frames": 6', '"cycle_frames": 5'))
    with pytest.raises(InputError, match=r"sensor\.cycle_frames: implausible"):
        Sequence.open(tmp_path / "stated")


def test_check_names_frequencies_that_nothing_unwraps(tmp_path):
    """A warning instead of a decoded distance; frequencies that contradict each other are a
    warning, too.
    """
    distance = np.linspace(2.0, 7.0, 20 * 16).reshape(16, 20)
    write(
        "capture",
        tmp_path / "odd",
        still(distance, evenly(3), (60e6, 60e6 / math.sqrt(2)), cycles=2),
    )
    assert "warning: frequencies without a common range" in str(check(tmp_path / "odd"))
    wrong = still(distance, evenly(3), (60e6, 40e6), cycles=2)
    # the phase of the second frequency runs backwards
    wrong.quads[[4, 5, 10, 11]] = wrong.quads[[5, 4, 11, 10]]
    write("capture", tmp_path / "wrong", wrong)
    assert "frequencies disagree" in str(check(tmp_path / "wrong"))


@pytest.mark.parametrize("wrong", [20, 0.0, -2e7, 1e13, float("inf")])
def test_a_frequency_in_another_unit_is_refused(wrong):
    """20 is meant in MHz, and every distance would be a million times too long."""
    with pytest.raises(ValueError, match="20e6 for 20 MHz"):
        Calibration(f_mod_hz=wrong)
