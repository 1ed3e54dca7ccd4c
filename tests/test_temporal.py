"""Noise estimated from a recording, and what averaging over time makes of the closed form."""

import json
from dataclasses import replace

import numpy as np
import pytest
from analytic_run import as_phasors, sequence, truth
from moving_box import recording
from sequences import changed

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.noise import quad_noise
from gftorf_warp.data.temporal import agreement, averaged, over_time
from gftorf_warp.data.truth import static_throughout
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.runs.closed_form import Temporal
from gftorf_warp.recon.train import reconstruct

NOISE = 2e-3


def noisy(frames=48, more=np.zeros_like, cycle=4, height=60, width=80, seed=0):
    """A tilted, textured wall at rest, with noise that may depend on the amplitude [H, W]."""
    y, x = np.mgrid[0:height, 0:width]
    distance = 2.0 + 0.02 * x
    amplitude = (0.6 + 0.3 * np.sin(0.7 * x) * np.cos(0.9 * y)) / distance**2
    shifts = 2.0 * np.pi * np.arange(frames) / cycle
    clean = amplitude * np.cos(4 * np.pi / 15 * distance - shifts[:, None, None])
    draws = np.random.default_rng(seed).standard_normal(clean.shape)
    base = recording(frames=4)[0]
    return changed(
        base,
        quads=(clean + (NOISE + more(amplitude)) * draws).astype(np.float32),
        measured=np.ones(frames, dtype=bool),
        shifts=shifts % (2 * np.pi),
        times=np.arange(frames) / 120.0,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
        cycle_length=cycle,
        forward_flow={},
        backward_flow={},
    ), (distance, amplitude)


@pytest.mark.parametrize("cycle", [3, 4, 5])
def test_noise_of_any_cycle_is_found_within_three_percent(cycle):
    """Texture and slope do not count; every slot has its own line."""
    found = quad_noise(noisy(cycle=cycle, frames=12 * cycle)[0])
    sigma = found.sigma(np.full((cycle, 1, 1), 0.1))
    np.testing.assert_allclose(sigma, NOISE, rtol=0.04)


def test_shot_noise_grows_with_the_amplitude():
    """Variance 1e-6 + 4e-5 a: within 6 % from the dimmest to the brightest pixel."""
    measured, (_, amplitude) = noisy(more=lambda a: np.sqrt(1e-6 + 4e-5 * a) - NOISE)
    found = quad_noise(measured)
    for light in np.quantile(amplitude, [0.02, 0.5, 0.98]):
        want = np.sqrt(1e-6 + 4e-5 * light)
        np.testing.assert_allclose(found.sigma(np.full((4, 1, 1), light)), want, rtol=0.06)


def test_slots_have_noise_of_their_own():
    """The second raw frame of a cycle is exposed worse than the others."""
    measured, _ = noisy()
    rough = np.random.default_rng(1).standard_normal(measured.quads.shape).astype(np.float32)
    rough *= 3 * NOISE * (np.arange(48) % 4 == 1)[:, None, None]
    found = quad_noise(replace(measured, quads=measured.quads + rough))
    want = NOISE * np.array([1.0, np.sqrt(10.0), 1.0, 1.0])
    np.testing.assert_allclose(found.sigma(np.full((4, 1, 1), 0.1))[:, 0, 0], want, rtol=0.04)


def test_a_moving_box_and_a_moving_camera_hardly_disturb_it():
    """The box covers a quarter of the image; then every frame is shifted by a third of a pixel."""
    assert quad_noise(recording()[0]).sigma(np.full((4, 1, 1), 0.05)) == pytest.approx(
        4e-4, rel=0.12
    )
    y, x = np.mgrid[0:60, 0:80]
    n = np.arange(48)[:, None, None]
    smooth = 0.1 * np.cos(0.05 * (x + n / 3) + 0.04 * y - np.pi / 2 * n)
    measured, _ = noisy()
    draws = np.random.default_rng(2).standard_normal(smooth.shape)
    moved = replace(measured, quads=(smooth + NOISE * draws).astype(np.float32))
    assert quad_noise(moved).sigma(np.full((4, 1, 1), 0.1)) == pytest.approx(NOISE, rel=0.03)


def test_a_recording_without_noise_or_without_a_quartet():
    """A thousandth of the amplitude, and nothing to estimate from."""
    found = quad_noise(sequence())
    assert not found.floor.any()
    assert found.sigma(np.full((4, 1, 1), 0.1)) == pytest.approx(1e-4)
    assert quad_noise(sequence(frames=3)) is None


def test_where_nothing_moves_the_noise_falls_by_the_root_of_the_number_of_quartets():
    """Twelve quartets: 3.46 times less than one, for the mean; the median is a quarter worse."""
    measured, (distance, _) = noisy()
    one = np.std(closed_form_distance(measured, 3) - distance)
    mean, median = (over_time(measured, reduce) - distance for reduce in (np.mean, np.median))
    assert np.std(mean) == pytest.approx(one / np.sqrt(12), rel=0.05)
    assert np.std(median) == pytest.approx(1.25 * np.std(mean), rel=0.15)
    hybrid = np.std(closed_form_distance(averaged(measured), 3) - distance)
    assert hybrid == pytest.approx(np.std(mean), rel=0.05)


def test_what_moves_keeps_its_own_quartet_and_the_rest_is_averaged():
    """Where the box passes, quartets before and after it are averaged without it."""
    measured, known = recording(frames=32)
    steady = averaged(measured)
    agreeing = agreement(measured)
    assert not agreeing.all()
    quads, mixed = measured.quads.reshape(8, 4, 36, 48), steady.quads.reshape(8, 4, 36, 48)
    changed_there = (quads != mixed).all(axis=1)
    np.testing.assert_array_equal(changed_there & ~agreeing, False)
    assert (changed_there[agreeing]).mean() > 0.99
    passing = ~agreeing.all(axis=0) & agreeing[7]
    assert passing.sum() > 20, "else the box leaves nothing behind"
    error = np.abs(closed_form_distance(steady, 7) - known.distance[28])[passing]
    assert np.median(error) < 0.02
    assert np.median(np.abs(over_time(measured, np.mean) - known.distance[28])[passing]) > 0.1


def test_a_moving_camera_is_not_averaged():
    """The sequence comes back as it is, and the preset says why it cannot."""
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[8:, 0, 3] = 0.01
    moving = replace(recording()[0], camera_from_world=poses)
    assert averaged(moving) is moving


def test_the_preset_refuses_a_moving_camera(tmp_path):
    """By name, with what to use instead."""
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[8:, 0, 3] = 0.01
    with pytest.raises(InputError, match="camera moves") as error:
        reconstruct(replace(recording()[0], camera_from_world=poses), tmp_path / "run", "temporal")
    assert "--preset ctof" in error.value.fix
    assert not (tmp_path / "run" / "config.json").exists()


def test_the_preset_is_the_row(tmp_path):
    """A run without Gaussians whose d has the errors of the row ``temporal`` of any comparison."""
    measured, known = recording(frames=32)
    write("ftorf", tmp_path / "box", measured, known)
    run = reconstruct(tmp_path / "box", tmp_path / "run", "temporal")
    assert isinstance(run, Temporal)
    assert isinstance(Run.open(run.path), Temporal)
    got = compare(run)
    assert (got["method"], got["gaussians"], got["images_optimised"]) == ("temporal", 0, 0)
    rows = (got, got["moving"], got["static"], got["static_throughout"])
    for row in (*rows, *got["classes"]["static"].values()):
        if row["d_mse_x100"] is not None:
            assert row["d_mse_x100"] == pytest.approx(row["temporal_mse_x100"], rel=1e-4)
    interior = got["classes"]["static"]["interior"]
    assert interior["temporal_mse_x100"] < 0.75 * interior["closed_form_mse_x100"]
    best = got["static_throughout"]["temporal_mean_mse_x100"]
    assert best < 0.2 * got["static_throughout"]["closed_form_mse_x100"]
    page = (run.path / "report.html").read_text()
    assert "averaged over time where nothing moves" in page
    assert "Edges and slopes" in page
    assert json.loads((run.path / "config.json").read_text())["settings"]["method"] == "temporal"


def test_phasors_are_averaged_too():
    """The four raw frames of a phasor keep their signs."""
    phasors = as_phasors(sequence())
    steady = averaged(phasors)
    np.testing.assert_allclose(steady.quads[0], -steady.quads[1], rtol=1e-6)
    np.testing.assert_allclose(steady.quads[2], -steady.quads[3], rtol=1e-6)


def test_static_throughout_is_stricter_than_static_within_a_quartet():
    """Every pixel that the box ever covers or uncovers changes; unknown frames do not count."""
    distance = truth().distance.copy()
    still = static_throughout(distance)
    assert still.sum() == 12 * 20 - 6 * 17
    distance[3] = np.nan
    distance[5, 0, 0] = 99.0
    assert static_throughout(distance).sum() == still.sum() - 1
