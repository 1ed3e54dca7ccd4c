"""How well the quads are explained: renderings with known errors against noisy recordings."""

import json
import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from analytic_run import AnalyticRun
from moving_box import recording
from small_runs import demo

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ
from gftorf_warp.data.truth import nearest
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon import residuals as checked
from gftorf_warp.recon.observations import reduced
from gftorf_warp.recon.residuals import residuals
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.scene.motion import MotionSettings
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads

TRUE = recording(frames=32)[1].distance


def explained(measured, clean, width=48, shown=TRUE, **config):
    """Residuals of a run that renders these quads and distances [F, H, W], fitted at a width."""
    small_ = reduced(replace(measured, quads=clean.astype(np.float32)), width)

    def render(time, camera):
        assert (camera.width, camera.height) == (small_.width, small_.height)
        n = round(time * FRAME_RATE_HZ)
        quads = torch.as_tensor(np.stack([small_.quads[n]] * 4))
        phasor = torch.stack([*phasor_from_quads(quads, CANONICAL_SHIFTS), quads[0]])
        distance = torch.as_tensor(nearest(shown[n : n + 1], small_.height, small_.width)[0])
        return SimpleNamespace(quads=quads, phasor=phasor, distance=distance)

    run = SimpleNamespace(
        config={"size_optimised": [small_.width, small_.height], **config},
        camera=camera_of(measured, 0),
        sensor=Sensor(f_mod_hz=measured.calibration.f_mod_hz),
        renderer=lambda images, f_mod_hz, corrected: render,  # noqa: ARG005
    )
    return residuals(run, measured)


@pytest.fixture(scope="module")
def box():
    """The moving box with noise, and without."""
    return recording(frames=32)[0], recording(frames=32, noise=0.0)[0].quads


@pytest.mark.parametrize("width", [48, 24])
def test_what_is_explained_has_a_chi_square_of_one(box, width):
    """At the size of the recording, and where it was fitted to averages of four pixels."""
    found = explained(*box, width=width)
    # the edges of the box are a large part of a small image: noise is overestimated by a tenth
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.1 if width == 48 else 0.25)
    assert found.unexplained_share < 1e-3
    assert found.chi_square.shape == (8, width * 3 // 4, width)


@pytest.mark.parametrize("width", [48, 24])
def test_a_wrong_region_is_named_in_pixels_and_frames_of_the_recording(box, width):
    """Columns 10 to 29, rows 8 to 19, from raw frame 12 to 23: wrong by half of the amplitude."""
    measured, clean = box
    wrong = clean.copy()
    wrong[12:24, 8:20, 10:30] += 0.03
    found = explained(measured, wrong, width=width)
    share = 3 / 8 * 12 * 20 / (36 * 48)
    assert found.unexplained_share == pytest.approx(share, rel=0.05)
    assert found.reduced_chi_square > 10
    ranges = found.ranges()
    assert ranges["frames"] == [12, 23]
    np.testing.assert_allclose(ranges["columns"], [10, 29], atol=2)
    np.testing.assert_allclose(ranges["rows"], [8, 19], atol=2)


def test_a_few_per_cent_of_the_amplitude_are_no_failure(box):
    """They raise chi-square and nothing else: no splat is an exact surface."""
    measured, clean = box
    found = explained(measured, 1.04 * clean)
    assert found.reduced_chi_square > 1.5
    assert found.unexplained_share < 0.005
    assert explained(measured, 1.5 * clean).unexplained_share > 0.5


def test_what_is_not_finite_is_not_explained(box):
    """NaN never passes for a good fit."""
    measured, clean = box
    broken = clean.copy()
    broken[0, 3, 5] = np.nan
    found = explained(measured, broken)
    assert found.unexplained[0, 3, 5]


def test_without_noise_there_is_no_chi_square(box):
    """The share remains."""
    measured, clean = box
    exact = replace(measured, quads=clean)
    found = explained(exact, clean)
    assert found.reduced_chi_square is None
    assert found.unexplained_share == 0.0
    assert found.as_json()["columns"] is None
    assert explained(exact, np.zeros_like(clean)).unexplained_share > 0.95


def test_what_was_not_fitted_to_quads_has_no_residuals(box):
    """Closed forms repeat what was measured, and colour says nothing of quads."""
    for settings in ({"method": "ctof"}, {"method": "temporal"}, {"weights": {"quads": 0.0}}):
        assert explained(*box, settings=settings) is None
    assert explained(recording(frames=3)[0], recording(frames=3)[0].quads) is None


def test_ambient_light_is_no_failure_of_phasors(box):
    """It is in single taps, differs from pixel to pixel, and a phasor does not contain it."""
    measured, clean = box
    ambient = np.linspace(0.5, 2.0, 48, dtype=np.float32)
    lit = replace(measured, quads=measured.quads + ambient)
    assert explained(lit, clean).unexplained_share > 0.9
    found = explained(lit, clean, input="phasor")
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.15)
    assert found.unexplained_share < 1e-3


def test_a_moving_camera_and_a_missing_frame(box):
    """Quartets that are not complete are left out; every raw frame has its own pose."""
    measured, clean = box
    poses = np.tile(np.eye(4), (32, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(32)
    there = np.ones(32, dtype=bool)
    there[5] = False
    found = explained(replace(measured, camera_from_world=poses, measured=there), clean)
    assert found.quartets == [0, *range(2, 8)]
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.1)


def test_false_distances_of_what_rests_contradict_the_measurement(box):
    """Layers that give the right quads: only the mean over time sees them; whole turns do not
    count, and neither does what moves.
    """
    measured, clean = box
    right = explained(measured, clean)
    assert right.contradicted_share < 0.005
    wrong = TRUE.copy()
    wrong[:, :12] += 0.4
    found = explained(measured, clean, shown=wrong)
    assert found.unexplained_share < 1e-3
    assert found.contradicted[:, :8].mean() > 0.99
    assert found.contradicted_share > 0.25
    assert "contradicts the measured one" in checked.problems(found.as_json())[0]
    assert explained(measured, clean, shown=TRUE + 7.5).contradicted_share < 0.005
    moved = np.where(TRUE < 3.0, TRUE + 0.4, TRUE)
    assert explained(measured, clean, shown=moved).contradicted_share < 0.05


def test_motion_that_was_not_found_shows_where_pixels_change(box):
    """The first instant for ever; a black image is worse, and a good fit has nothing to say."""
    measured, clean = box
    frozen = clean[np.arange(32) % 4]
    found = explained(measured, frozen)
    assert found.changing_unexplained_share > 0.5
    assert any("motion is missing or wrong" in text for text in checked.problems(found.as_json()))
    assert len(checked.problems(explained(measured, np.zeros_like(clean)).as_json())) == 2
    assert checked.problems(explained(measured, clean).as_json()) == []
    assert checked.problems(None) == []


def test_without_motion_nothing_is_said_of_motion():
    """Noise alone makes two pixels in ten thousand change."""
    still = np.tile(recording(frames=4, noise=0.0)[0].quads, (8, 1, 1))
    noise = 4e-4 * np.random.default_rng(0).standard_normal(still.shape)
    measured = replace(recording(frames=32)[0], quads=(still + noise).astype(np.float32))
    found = explained(measured, still, shown=np.tile(TRUE[:1], (32, 1, 1)))
    assert found.changing_unexplained_share is None
    assert found.contradicted_share < 0.05


def test_a_run_that_finds_no_motion_says_so(tmp_path, caplog):
    """The control without motion cannot explain the box, and log and config.json say it."""
    settings = demo(images=120, motion=MotionSettings(kind="still"))
    with caplog.at_level(logging.WARNING):
        run = reconstruct(recording(frames=12)[0], tmp_path / "run", settings)
    assert "does not explain" in caplog.text
    stored = json.loads((run.path / "config.json").read_text())["explained"]
    assert stored["unexplained_share"] > checked.UNEXPLAINED_MAX
    assert Run.open(run.path).config["explained"] == stored
    assert checked.problems(stored)[0].startswith("the fit does not explain")


def test_flow_of_the_wrong_sign_shows_as_wrong_motion(tmp_path):
    """The nodes start where flow leads, so they start the wrong way; the right flow is fine."""
    measured = recording(frames=16)[0]
    turned = replace(
        measured.flow,
        forward={n: -flow for n, flow in measured.flow.forward.items()},
        backward={n: -flow for n, flow in measured.flow.backward.items()},
    )
    for flow, wrong in ((measured.flow, False), (turned, True)):
        run = reconstruct(replace(measured, flow=flow), tmp_path / str(wrong), demo(images=240))
        found = checked.problems(run.config["explained"])
        assert any("motion is missing or wrong" in text for text in found) == wrong


def test_without_truth_compare_still_says_how_well(tmp_path):
    """The number in metrics.json and the pictures of the page need no truth."""
    run = AnalyticRun(tmp_path, with_truth=False)
    got = compare(run)
    assert got["d_mse_x100"] is None
    assert got["explained"]["unexplained_share"] < 0.01
    page = (run.path / "report.html").read_text()
    assert "How well the quads are explained" in page
    assert "share of quartets that are not explained" in page
