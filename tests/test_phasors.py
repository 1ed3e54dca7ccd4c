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
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads, quad_from_phasor

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
    """The other one stays rendered, with the larger error; noise is a small share of residuals."""
    measured, _, _ = box
    given, before = corrected(box)
    moves = ~box[1].averaged[N // 4].numpy()
    turn = np.exp(-1j * measured.shifts[N])
    now, then = (phasor.value.numpy() * turn for phasor in (given, before))
    component = 2.0 * measured.quads[N]
    left, residual = (np.abs(each.real - component)[moves] for each in (now, then))
    assert np.median(left) < 0.05 * np.median(residual)
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
    given, before = corrected(box, time=(N + 0.4) / FRAME_RATE_HZ)
    rests = box[1].averaged[N // 4]
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


def test_a_right_rendering_is_not_replaced_by_noise(box):
    """Neither by the temporal mean nor by a quad: less than half of the noise gets in."""
    measured, found, true = box
    sigma = np.sqrt(found.of_quads.numpy()[N % 4])
    given = found.corrected(
        rendering(true), N / FRAME_RATE_HZ, found.camera, measured.calibration.f_mod_hz
    )
    apart = np.abs(given.value.numpy() - true)
    moves = ~found.averaged[N // 4].numpy()
    quad = np.abs(2.0 * measured.quads[N] - (true * np.exp(-1j * measured.shifts[N])).real)
    assert np.median(quad[moves] / sigma[moves]) > 0.5
    assert np.median(apart[moves]) < 0.5 * np.median(quad[moves])


def test_a_quad_of_one_tap_is_no_component(box):
    """It has a constant part, too: where something moves the rendering stays."""
    measured, found, true = box
    one_tap = replace(measured, calibration=replace(measured.calibration, dc_offset=1.0))
    wrong, moves = rendering(WRONG * true), ~found.averaged[N // 4]
    given = replace(found, sequence=one_tap).corrected(
        wrong, N / FRAME_RATE_HZ, found.camera, measured.calibration.f_mod_hz
    )
    torch.testing.assert_close(given.value[moves], rendered_phasor(wrong).value[moves])


def test_where_the_fallback_took_the_closed_form_the_phasor_is_its_own(box):
    """That of the quartet, at any time in it."""
    measured, found, true = box
    taken = ~found.averaged[N // 4]
    wrong = replace(rendering(WRONG * true), source=2 * taken.to(torch.uint8))
    time = (N + 0.4) / FRAME_RATE_HZ
    given = found.corrected(wrong, time, found.camera, measured.calibration.f_mod_hz).value[taken]
    quartet = found.value[N // 4, 0][taken]
    before = rendered_phasor(wrong).value[taken]
    assert float(((given - quartet).abs() / (before - quartet).abs()).median()) < 0.05


def test_quads_decode_to_the_corrected_phasor(box):
    """With a DC offset, too; the rendered amplitude grows as the phasor does."""
    _, _, true = box
    sensor = Sensor(dc_offset=0.7)
    before = rendering(WRONG * true)
    re, im, amplitude = before.phasor
    quads = [quad_from_phasor(re, im, 0.7 * amplitude, shift) for shift in sensor.shifts]
    before = replace(before, quads=torch.stack(quads))
    right = rendered_phasor(rendering(true))
    after = right.within(before, sensor)
    assert after.distance is before.distance
    decoded = torch.complex(*phasor_from_quads(after.quads, sensor.shifts))
    torch.testing.assert_close(decoded, right.value)
    torch.testing.assert_close(after.phasor[2], right.value.abs())
    torch.testing.assert_close(after.quads.mean(dim=0), 0.5 * 0.7 * after.phasor[2])
