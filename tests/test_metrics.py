"""Which frames and pixels are scored, and errors of small arrays,
against numbers worked out by hand.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_run import sequence
from sequences import sequence_of

from gftorf_warp import Truth
from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.data.truth import known_distance, moving_and_static
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.evaluate import metrics
from gftorf_warp.scene.sensor import Sensor

NAN = float("nan")


def quartets(frames, missing=()):
    """A sequence of one pixel, of which some raw frames were not measured."""
    measured = np.ones(frames, dtype=bool)
    measured[list(missing)] = False
    return sequence_of(
        quads=np.ones((frames, 1, 1), dtype=np.float32),
        measured=measured,
        shifts=np.resize(CANONICAL_SHIFTS, frames),
        times=np.arange(frames) / 120.0,
        f_mod_hz=20e6,
        fx=1.0,
        fy=1.0,
        cx=0.5,
        cy=0.5,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
    )


def test_all_takes_every_frame_of_complete_quartets():
    """Frame 5 is missing and frames 12, 13 end truncated: their quartets are left out."""
    assert metrics.scored_frames(quartets(14, missing=[5])) == [0, 1, 2, 3, 8, 9, 10, 11]


def test_a_phasor_is_scored_once():
    """Its four raw frames are one image; the published protocol is the same as ever."""
    phasors = replace(quartets(16), from_phasors=True)
    assert metrics.scored_frames(phasors) == [0, 4, 8, 12]
    assert metrics.scored_frames(phasors, "ftorf13") == [4, 8]


def test_between_phasors_is_where_things_move():
    """From one phasor to the next, and from the one before at the end;
    within one there is nothing to see.
    """
    distance = np.repeat([[2.0, 2.0, 2.0], [2.0, 2.1, 2.0], [2.0, 2.1, NAN]], 4, axis=0)[:, None]
    assert not moving_and_static(distance, [0, 4])[0].any()
    moving, static = moving_and_static(distance, [0, 4, 8], from_phasors=True)
    assert moving[:, 0].tolist() == [
        [False, True, False],
        [False, False, False],
        [False, False, False],
    ]
    assert static[:, 0].tolist() == [[True, False, True], [True, True, False], [True, True, False]]
    assert moving_and_static(distance[:4], [0], from_phasors=True)[1].all()


def test_ftorf13_takes_thirteen_of_sixty_frames():
    """The published protocol: quartet starts without the first and the last."""
    assert metrics.scored_frames(quartets(60), "ftorf13") == list(range(4, 53, 4))


@pytest.mark.parametrize(
    ("given", "protocol", "error", "text"),
    [
        (quartets(8), "middle", UsageError, "middle"),
        (quartets(8), "ftorf13", UsageError, "--frames all"),
        (quartets(8, missing=[1, 6]), "all", InputError, "complete quartet"),
    ],
)
def test_nothing_to_score_is_an_error(given, protocol, error, text):
    """An unknown protocol, one that leaves nothing, or no complete quartet."""
    with pytest.raises(error, match=text):
        metrics.scored_frames(given, protocol)


def test_moving_is_a_change_of_more_than_five_centimetres_within_the_quartet():
    """Four pixels over two quartets; the jump between quartets is no motion,
    and the unknown is neither.
    """
    distance = np.full((8, 1, 4), 3.0)
    distance[:4, 0, 0] += [0.0, 0.02, 0.051, 0.04]  # 5.1 cm: moves
    distance[:4, 0, 1] += [0.0, 0.049, 0.04, 0.04]  # 4.9 cm: rests
    distance[4:, 0, 1] += 1.0  # between two quartets
    distance[2, 0, 2] = NAN  # unknown, so it may have moved
    distance[:3, 0, 3] = [3.0, NAN, 3.5]  # unknown for a while, but it certainly moved
    moving, static = moving_and_static(distance, [1, 2, 4])
    assert moving[:, 0].tolist() == [[True, False, False, True]] * 2 + [[False] * 4]
    assert static[:, 0].tolist() == [[False, True, False, False]] * 2 + [[True] * 4]
    assert metrics.share(moving, static) == 4 / 10
    assert metrics.share(np.zeros_like(moving), np.zeros_like(static)) is None


def test_frames_weigh_alike_in_one_mean_and_pixels_in_the_other():
    """Frame 0 knows four pixels, frame 1 one: mean (1 + 9) / 2, pooled (4 * 1 + 9) / 5."""
    truth = np.array([[[2.0, 2.0], [2.0, 2.0]], [[2.0, NAN], [NAN, NAN]]])
    distance = np.array([np.full((2, 2), 3.0), np.full((2, 2), 5.0)])
    error = metrics.squared_error(distance, truth)
    everywhere = np.ones(error.shape, dtype=bool)
    assert metrics.mean_over_frames(error, everywhere) == 5.0
    assert metrics.pooled(error, everywhere) == pytest.approx(13 / 5)
    assert metrics.per_frame_mean(error, everywhere & (np.arange(2) == 1)[:, None, None]) == [
        None,
        9.0,
    ]
    assert metrics.pooled(error, ~everywhere) is None
    assert metrics.mean_over_frames(error, ~everywhere) is None


def test_unknown_truth_hides_a_pixel_but_never_a_broken_distance():
    """NaN in a rendered distance is an error unless nobody knows the truth there."""
    truth = np.array([[[2.0, NAN]]])
    assert (
        metrics.pooled(
            metrics.squared_error(np.array([[[2.5, NAN]]]), truth), np.ones((1, 1, 2), bool)
        )
        == 0.25
    )
    with pytest.raises(ValueError, match="not finite"):
        metrics.squared_error(np.array([[[NAN, 1.0]]]), truth)
    with pytest.raises(ValueError, match=r"\(1, 1, 3\)"):
        metrics.squared_error(np.zeros((1, 1, 3)), truth)


def test_a_frame_without_truth_is_unknown_everywhere():
    """What stands in the array of an unknown frame does not count."""
    truth = Truth(distance=np.ones((2, 1, 1), dtype=np.float32), known=np.array([True, False]))
    assert np.isnan(known_distance(truth)).ravel().tolist() == [False, True]


def test_distance_from_quads_wraps_and_removes_the_phase_offset():
    """Nine metres, at 15 m per turn and back, are 9 - 7.5 m."""
    sensor = Sensor(f_mod_hz=299_792_458.0 / 15.0, phase_offset=0.4, dc_offset=0.7)
    distance = torch.tensor([[1.0, 7.4, 9.0]], dtype=torch.float64)
    psi = 4.0 * math.pi / 15.0 * distance + 0.4
    quads = torch.stack([(torch.cos(psi - shift) + 0.7) / distance**2 for shift in sensor.shifts])
    want = torch.tensor([[1.0, 7.4, 1.5]], dtype=torch.float64)
    torch.testing.assert_close(metrics.distance_from_quads(quads, sensor), want, rtol=0, atol=1e-9)


def test_normalised_is_zero_where_nothing_was_hit():
    """0.9 opaque at 2 m renders 1.8 m."""
    got = metrics.normalised(np.array([1.8, 0.0]), np.array([0.9, 0.0]))
    np.testing.assert_allclose(got, [2.0, 0.0])


def test_quad_psnr():
    """An error of 0.1 everywhere under a peak of 2 is 10 log10(4 / 0.01) dB;
    no error or no light is no number.
    """
    measured = np.full((2, 3, 4), 0.5)
    assert metrics.psnr_db(measured + 0.1, measured, peak=2.0) == pytest.approx(
        10 * math.log10(400)
    )
    assert metrics.psnr_db(measured, measured, peak=2.0) is None
    assert metrics.psnr_db(measured + 0.1, measured, peak=0.0) is None


def test_errors_are_printed_times_100_or_as_unknown():
    """One row of the table, and the same row where no pixel counts."""
    errors = {
        name: np.full((1, 1, 2), value)
        for name, value in {"closed_form": 4, "temporal": 3, "d": 2, "d_tof": 1}.items()
    }
    row = metrics.distance_errors(errors, np.ones((1, 1, 2), dtype=bool))
    assert row == {
        "closed_form_mse_x100": 400.0,
        "temporal_mean_mse_x100": None,
        "temporal_median_mse_x100": None,
        "temporal_mse_x100": 300.0,
        "d_mse_x100": 200.0,
        "d_fit_mse_x100": None,
        "d_normalised_mse_x100": None,
        "d_median_mse_x100": None,
        "d_tof_mse_x100": 100.0,
    }
    assert set(metrics.distance_errors(errors, np.zeros((1, 1, 2), dtype=bool)).values()) == {None}


def test_the_analytic_sequence_has_a_truncated_quartet():
    """The other tests of this room count on it."""
    assert sequence().complete_quartets == [0, 1, 2]
    assert sequence().frames == 14
