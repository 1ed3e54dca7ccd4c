"""Closed-form distance: the sample's published numbers, and the physics of the phase."""

import math

import numpy as np
import pytest
from ftorf_folder import REAL_ORDER, SAMPLE, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp import Sequence
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data import decode
from gftorf_warp.errors import InputError

UNAMBIGUOUS = 7.5  # [m] of the sample and of the scenes here


@pytest.fixture(scope="module")
def sample():
    """The sample, its truth, and the decoded distance of its eight quartets."""
    sequence = Sequence.open(SAMPLE)
    return (
        sequence,
        sequence.truth(),
        np.stack([decode.closed_form_distance(sequence, i) for i in range(8)]),
    )


def test_quartet_starts_of_the_sample_score_as_published(sample):
    """Its README lists the error of every quartet against the truth of its first frame."""
    _, truth, decoded = sample
    errors = 100 * ((decoded - truth.distance[::4]) ** 2).mean(axis=(1, 2))
    np.testing.assert_allclose(
        errors, [2.674, 3.234, 4.559, 5.491, 6.503, 9.042, 11.785, 16.370], atol=6e-4
    )
    assert round(errors.mean(), 3) == 7.457


def test_every_frame_of_the_sample_scores_as_published(sample):
    """One image per quartet against the truth of each of its four frames;
    moving pixels are few and bad.
    """
    _, truth, decoded = sample
    squared = (np.repeat(decoded, 4, axis=0) - truth.distance) ** 2
    assert round(100 * squared.mean(), 3) == 3.791
    quartets = truth.distance.reshape(8, 4, 120, 160)
    moving = np.repeat(np.ptp(quartets, axis=1) > 0.05, 4, axis=0)
    assert round(moving.mean(), 3) == 0.037
    assert round(100 * squared[moving].mean(), 1) == 96.9


def test_the_sample_has_no_factor_of_its_own(sample):
    """So the quads are divided by the largest length of a phasor, which noise hardly changes."""
    sequence, _, _ = sample
    factor, source = decode.quad_scale(sequence)
    assert factor == 1.0 / decode.largest_amplitude(sequence)
    assert source.startswith("inferred")
    lengths = [
        np.hypot(*(sequence.quads[a] - sequence.quads[a + 1] for a in (4 * i, 4 * i + 2)))
        for i in range(8)
    ]
    assert decode.largest_amplitude(sequence) == pytest.approx(np.max(lengths), rel=1e-6)


def test_the_file_s_own_factor_comes_first():
    """And is not applied to the quads."""
    sequence, _ = scene(quad_scale=3.0)
    assert decode.quad_scale(sequence) == (3.0, "setting of the sequence")


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    permutation=st.permutations(range(4)),
    distance=st.floats(0.1, 30.0),
    offset=st.floats(-20.0, 20.0),
    constant=st.floats(-2.0, 2.0),
)
def test_a_wall_is_decoded_up_to_its_wraps(permutation, distance, offset, constant):
    """Any order, offset and constant part; the result is the distance modulo c/2f,
    never c/2f itself.
    """
    sequence, _ = scene(4, 2, 2, permutation, offset, constant, distance=distance)
    decoded = decode.closed_form_distance(sequence, 0)
    assert ((decoded >= 0) & (decoded < UNAMBIGUOUS)).all()
    turn = 2 * math.pi / UNAMBIGUOUS
    np.testing.assert_allclose(np.exp(1j * turn * decoded), np.exp(1j * turn * distance), atol=1e-5)


@pytest.mark.parametrize("shifts", [[0.0, 2.0, 4.0, 5.5], [0.3, 1.3, 1.3, 4.0]])
def test_any_three_distinct_shifts_determine_the_phase(shifts):
    """Least squares does not need the canonical four."""
    distance = np.array([[1.0, 3.0]])
    sequence, _ = scene(4, 1, 2, distance=distance)
    phase = 2 * math.pi * distance / UNAMBIGUOUS + sequence.calibration.phase_offset
    quads = 0.7 * (np.cos(phase - np.array(shifts)[:, None, None]) + 0.4)
    sequence, _ = scene(
        4, 1, 2, distance=distance, shifts=np.array(shifts), quads=quads.astype(np.float32)
    )
    np.testing.assert_allclose(decode.closed_form_distance(sequence, 0), distance, atol=1e-5)
    np.testing.assert_allclose(np.hypot(*decode.quartet_phasor(sequence, 0)), 1.4, rtol=1e-5)


def test_the_phasor_is_the_difference_of_opposite_quads():
    """In the real order -cos, +sin, +cos, -sin, and twice as long as a quad's amplitude."""
    sequence, truth = scene(8, permutation=REAL_ORDER, dc_offset=0.5)
    minus_cos, plus_sin, plus_cos, minus_sin = sequence.quads[4:].astype(np.float64)
    re, im = decode.quartet_phasor(sequence, 1)
    np.testing.assert_allclose(re, plus_cos - minus_cos, atol=1e-12)
    np.testing.assert_allclose(im, plus_sin - minus_sin, atol=1e-12)
    constant = sequence.quads[4:].mean(axis=0) / sequence.calibration.dc_offset
    np.testing.assert_allclose(np.hypot(re, im), 2 * constant, rtol=1e-5)
    assert truth.known.all()


def test_a_phase_that_rounds_up_to_a_turn_is_zero():
    """The modulo of a tiny negative number is 2 pi, which lies outside [0, 2 pi)."""
    sequence, _ = scene(phase_offset=0.0)
    np.testing.assert_array_equal(
        decode.distance_from_phase(np.array([-1e-18, 0.0]), sequence), [0.0, 0.0]
    )
    assert decode.distance_from_phase(np.array(math.pi), sequence) == pytest.approx(
        SPEED_OF_LIGHT / (4 * sequence.calibration.f_mod_hz)
    )


def test_shifts_that_determine_no_phase_are_an_input_error():
    """Two distinct shifts are not enough, and the message shows them."""
    sequence, _ = scene(4, shifts=np.array([0.0, math.pi, 0.0, math.pi]))
    with pytest.raises(InputError, match="180") as caught:
        decode.closed_form_distance(sequence, 0)
    assert caught.value.exit_code == 3


def test_an_incomplete_quartet_is_a_programming_mistake():
    """Missing and truncated quartets are not decoded."""
    measured = np.ones(10, dtype=bool)
    measured[5] = False
    sequence, _ = scene(10, measured=measured)
    for i in (1, 2, -1):
        with pytest.raises(ValueError, match=r"\[0\]"):
            decode.closed_form_distance(sequence, i)


@pytest.mark.parametrize("changes", [{"frames": 3}, {"quads": np.zeros((8, 6, 8), np.float32)}])
def test_without_light_there_is_no_scale(changes):
    """Neither a recording shorter than a quartet nor a dark one can be normalised."""
    with pytest.raises(InputError) as caught:
        decode.quad_scale(scene(**changes)[0])
    assert caught.value.exit_code == 3
