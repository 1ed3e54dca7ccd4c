"""What measured quads tell of a rendered phasor that is wrong."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording, seen

from gftorf_warp.constants import FRAME_RATE_HZ
from gftorf_warp.data.temporal import agreement
from gftorf_warp.recon.phasors import MeasuredPhasors, rendered_phasor
from gftorf_warp.render.api import Rendering
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.scene.sensor import Sensor

FRAMES, N = 32, 13
ROWS = 8  # of the wall, which never moves
WRONG = 0.85 * np.exp(0.2j)  # a rendered phasor over the true one


@pytest.fixture(scope="module")
def box():
    """The moving box with noise, what was measured of its phasors, and the true one of raw frame
    N.
    """
    measured, _ = recording(frames=FRAMES)
    found = MeasuredPhasors.of(measured, camera_of(measured, 0), torch.device("cpu"))
    distance, reflectivity, _ = seen(N)
    phase = Sensor(f_mod_hz=measured.calibration.f_mod_hz).phase_slope * distance
    return measured, found, 2.0 * reflectivity / distance**2 * np.exp(1j * phase)


def rendering(phasor):
    """A rendering of a phasor [H, W]."""
    none, flat = torch.zeros(0, *phasor.shape), torch.zeros(0, phasor.shape[1])
    parts = {"quads": none, "colour": None, "distortion": flat, "extra": None, "screen": None}
    parts |= {"distance_median": flat, "opacity": flat, "distance": flat}
    images = np.stack([phasor.real, phasor.imag, abs(phasor)])
    return Rendering(**parts, phasor=torch.as_tensor(images, dtype=torch.float32))


def corrected(box, time=N / FRAME_RATE_HZ, camera=None, f_mod_hz=None):
    """A phasor that is wrong in the upper rows and where something moves: after the correction,
    and before.
    """
    measured, found, true = box
    right = agreement(measured)[N // 4].copy()
    right[:ROWS] = False
    wrong = rendering(np.where(right, true, WRONG * true))
    f = measured.calibration.f_mod_hz if f_mod_hz is None else f_mod_hz
    return found.corrected(wrong, time, camera or found.camera, f), rendered_phasor(wrong)


def test_what_rests_has_the_phasor_of_the_temporal_mean(box):
    """Within five standard deviations, where the rendered phasor is wrong by 25 %."""
    measured, _, true = box
    given, _ = corrected(box)
    there = agreement(measured)[N // 4].copy()
    assert there[:ROWS].mean() > 0.9
    apart = np.abs(given.value.numpy() - true)[there]
    sigma = np.sqrt(given.variance_re.numpy() + given.variance_im.numpy())[there]
    assert (apart < 5.0 * sigma).mean() > 0.99
    assert np.median(apart / abs(true[there])) < 0.03


def test_the_quad_of_a_raw_frame_is_one_component(box):
    """The other one stays rendered, with the larger error."""
    measured, _, _ = box
    given, before = corrected(box)
    moves = ~agreement(measured)[N // 4]
    turn = np.exp(-1j * measured.shifts[N])
    now, then = (phasor.value.numpy() * turn for phasor in (given, before))
    np.testing.assert_allclose(now.real[moves], 2.0 * measured.quads[N][moves], atol=1e-6)
    np.testing.assert_allclose(now.imag[moves], then.imag[moves], atol=1e-6)
    cosine, sine = math.cos(measured.shifts[N]), math.sin(measured.shifts[N])
    re, im, both = (
        image.numpy()[moves] for image in (given.variance_re, given.variance_im, given.covariance)
    )
    along = re * cosine**2 + im * sine**2 + 2.0 * both * cosine * sine
    across = re * sine**2 + im * cosine**2 - 2.0 * both * cosine * sine
    assert (across > along).mean() > 0.5
    assert (np.minimum(along, across) > 0.0).all()


def test_between_raw_frames_only_what_rests_is_known(box):
    """The quad is of another instant."""
    measured, _, _ = box
    given, before = corrected(box, time=(N + 0.4) / FRAME_RATE_HZ)
    rests = agreement(measured)[N // 4].copy()
    torch.testing.assert_close(given.value[~rests], before.value[~rests])
    torch.testing.assert_close(given.variance_re[~rests], before.variance_re[~rests])
    assert not torch.equal(given.value[rests], before.value[rests])


@pytest.mark.parametrize("what", ["camera", "time", "frequency"])
def test_elsewhere_the_rendered_phasor_stays(box, what):
    """From another camera, after the last quartet, and at a frequency that was not measured."""
    measured, found, _ = box
    size: Camera = found.camera
    other = {
        "camera": {"camera": replace(size, fx=1.1 * size.fx)},
        "time": {"time": (FRAMES + 2) / FRAME_RATE_HZ},
        "frequency": {"f_mod_hz": 2.0 * measured.calibration.f_mod_hz},
    }
    given, before = corrected(box, **other[what])
    torch.testing.assert_close(given.value, before.value)
    torch.testing.assert_close(given.variance_re, before.variance_re)
