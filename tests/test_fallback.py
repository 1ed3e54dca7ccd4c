"""Where the measurement replaces the distance of a fit: renderings with known errors."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from moving_box import as_phasors, recording, seen
from small_runs import demo

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, SOURCES, SPEED_OF_LIGHT
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.exr import read_exr
from gftorf_warp.data.temporal import agreement, averaged_locally
from gftorf_warp.data.write import write
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.views import render_to_folder
from gftorf_warp.recon import fallback
from gftorf_warp.recon.fallback import Fallback
from gftorf_warp.recon.residuals import residuals
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.api import Rendering
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads

FRAMES = 32
FIT, TEMPORAL, CLOSED_FORM = range(3)


@pytest.fixture(scope="module")
def box():
    """The moving box with noise, its quads without noise, and its true distance."""
    measured, truth = recording(frames=FRAMES)
    return measured, recording(frames=FRAMES, noise=0.0)[0].quads, truth.distance


def fallback_of(measured, quads):
    """The fallback of a run that renders these quads [F, H, W]."""

    def render(time, camera):  # noqa: ARG001
        n = round(time * FRAME_RATE_HZ)
        same = torch.as_tensor(np.stack([quads[n]] * 4), dtype=torch.float32)
        phasor = torch.stack([*phasor_from_quads(same, CANONICAL_SHIFTS), same[0]])
        return SimpleNamespace(quads=same, phasor=phasor, distance=torch.as_tensor(seen(n)[0]))

    run = SimpleNamespace(
        config={},
        camera=camera_of(measured, 0),
        sensor=Sensor(f_mod_hz=measured.calibration.f_mod_hz),
        renderer=lambda images, f_mod_hz, corrected: render,  # noqa: ARG005
    )
    return Fallback.of(residuals(run, measured), measured, run.camera, torch.device("cpu"))


def rendering(distance):
    """A rendering of a distance [H, W] that is nine tenths opaque."""
    distance = torch.as_tensor(distance, dtype=torch.float32)
    none, flat = torch.zeros(0, *distance.shape), torch.zeros(0, distance.shape[1])
    parts = {"quads": none, "phasor": none, "colour": None, "distortion": flat, "extra": None}
    parts |= {"distance_median": flat, "opacity": torch.full_like(distance, 0.9)}
    return Rendering(**parts, distance=distance, screen=None)


def applied(found, distance, n):
    """Distance, source and opacity at raw frame n, as arrays."""
    given = found.applied(rendering(distance), n / FRAME_RATE_HZ, found.camera)
    return tuple(image.numpy() for image in (given.distance, given.source, given.opacity))


def test_a_right_fit_stays(box):
    """More than nine tenths of the pixels within two standard deviations; errors hardly change."""
    measured, quads, truth = box
    found = fallback_of(measured, quads)
    distance, source, opacity = applied(found, truth[13], 13)
    assert (source == FIT).mean() > 0.9
    assert np.abs(distance - truth[13]).max() < 0.1
    np.testing.assert_array_equal(distance[source == FIT], truth[13][source == FIT])
    np.testing.assert_array_equal(opacity, np.where(source == FIT, np.float32(0.9), 1))


def test_a_wrong_distance_of_what_rests_is_replaced_although_the_quads_are_right(box):
    """The quads cannot tell two layers from one surface; the wall of the upper rows never moves."""
    measured, quads, truth = box
    wrong = truth[13].copy()
    wrong[:5] += 0.5
    wrong[0, 0] = np.nan
    distance, source, _ = applied(fallback_of(measured, quads), wrong, 13)
    assert (source[:5] == TEMPORAL).all()
    assert np.abs(distance[:5] - truth[13][:5]).max() < 0.05


@pytest.mark.parametrize("steep", [True, False], ids=["slope", "mixture"])
def test_a_fit_between_its_neighbours_stays_at_a_step_but_not_on_a_slope(box, steep):
    """The temporal mean of a slope is right; a mixture of two surfaces has no distance."""
    measured, *_ = box
    column = np.broadcast_to(np.arange(48.0), (36, 48))
    distance = 1.0 + 0.12 * column if steep else np.where(column < 24, 2.0, 3.0)
    phasor = 0.5 / distance**2 * np.exp(1j * 4.0 * np.pi / 15.0 * distance)
    if not steep:
        phasor[:, 24] = 0.3 * phasor[:, 23] + 0.7 * phasor[:, 25]
    quads = np.real(phasor * np.exp(-1j * measured.shifts[:, None, None]))
    noise = measured.quads - box[1]
    found = fallback_of(replace(measured, quads=(quads + noise).astype(np.float32)), quads)
    wrong = np.where(column == 24, distance - 0.1, distance)
    given, source, _ = applied(found, wrong, 13)
    assert (source[:, 24] == (TEMPORAL if steep else FIT)).mean() > 0.9
    if steep:
        assert np.abs(given - distance)[:, 24].max() < 0.05


def test_a_turn_that_the_fit_knows_is_kept(box):
    """One unambiguous range more decodes to the same phase."""
    measured, quads, truth = box
    distance, source, _ = applied(fallback_of(measured, quads), truth[13] + 7.5 + 0.08, 13)
    averaged = source == TEMPORAL
    assert averaged[:5].mean() > 0.9
    assert np.abs(distance - truth[13] - 7.5)[averaged].max() < 0.08


def test_where_the_fit_fails_the_quartet_itself_is_taken(box):
    """A dark fit: where the box has just arrived and is seen by all four frames, the closed form;
    what moves within the quartet fits no phasor and keeps the fit, unless that is black.
    """
    measured, quads, truth = box
    found = fallback_of(measured, 0.2 * quads)
    distance, source, _ = applied(found, np.full((36, 48), 9.0), 13)
    inside = np.logical_and.reduce([seen(n)[2] for n in range(12, 16)])
    moved = (source == CLOSED_FORM) & inside
    assert moved.sum() > 0.3 * inside.sum()
    assert np.median(np.abs(distance - truth[13])[moved]) < 0.1
    assert (source == FIT).any()
    black = fallback_of(measured, np.zeros_like(quads))
    assert not (applied(black, np.full((36, 48), 9.0), 13)[1] == FIT).any()
    assert SOURCES[CLOSED_FORM] == "closed_form"


def test_another_surface_beside_what_moves_stays_if_the_fit_explains_the_quads(box, monkeypatch):
    """Up to five pixels from what changes, not elsewhere; its phasor is not the mean then. The
    limit of the chi-square is one that noise does not reach: 10 has a chance of 1e-8.
    """
    measured, quads, truth = box
    monkeypatch.setattr(fallback, "BESIDE", 0.1)
    monkeypatch.setattr(fallback, "AS_GOOD", 10.0)
    there = np.stack([seen(n)[2] for n in range(12, 16)])
    covered = (there.any(axis=0) & ~there.all(axis=0)).astype(np.uint8)  # for a part of the quartet
    changes = (~agreement(measured)[3]).astype(np.uint8)
    beside = (cv2.dilate(covered, np.ones((11, 11), np.uint8)) > 0) & (changes == 0)
    beside &= cv2.dilate(changes, np.ones((5, 5), np.uint8)) == 0
    nearer = np.where(beside | (np.arange(36)[:, None] < 2), truth[13] - 0.5, truth[13])
    good, time = fallback_of(measured, quads), 13 / FRAME_RATE_HZ
    distance, source, _ = applied(good, nearer, 13)
    assert beside.sum() > 100
    assert (source[beside] == FIT).mean() > 0.97
    assert (source[:2][~beside[:2]] == TEMPORAL).all()
    assert (distance[:2][~beside[:2]] > truth[13][:2][~beside[:2]] - 0.05).all()
    rests = good.rests_at(rendering(nearer), time, good.camera).numpy()
    assert not rests[beside & (source == FIT)].any()
    assert good.rests_at(rendering(truth[13]), time, good.camera).numpy()[beside].mean() > 0.95
    dark = fallback_of(measured, 0.8 * quads)
    assert (applied(dark, nearer, 13)[1][beside] == TEMPORAL).mean() > 0.95
    assert good.rests_at(rendering(nearer), 99.0, good.camera) is None


@pytest.mark.parametrize("noise", [0.0, 4e-4])
def test_where_one_phasor_is_exact_a_fit_that_nearly_explains_the_quads_is_replaced(noise):
    """A wall that is darker during the last quartet. Seven per cent of the amplitude are within
    what a fit may miss, but not within a noise that is far smaller than that.
    """
    factors = np.repeat([1.0] * 7 + [0.4], 4)[:, None, None]
    clean = np.tile(recording(frames=4, noise=0.0)[0].quads, (8, 1, 1)) * factors
    quads = clean + noise * np.random.default_rng(1).standard_normal(clean.shape)
    measured, truth = recording(frames=FRAMES)
    fitted = np.where(factors < 1.0, 0.93, 1.0) * clean
    found = fallback_of(replace(measured, quads=quads.astype(np.float32)), fitted)
    one_time = closed_form_distance(found.sequence, 7)
    still = np.abs(one_time - truth.distance[0]) < 0.02
    assert still.mean() > 0.5
    assert found.explained[7].float().mean() > 0.95
    distance, source, _ = applied(found, one_time + 0.06, 29)
    assert ((source == CLOSED_FORM)[still].mean() > 0.95) == (noise == 0.0)
    assert ((source == FIT)[still].mean() > 0.95) == (noise > 0.0)
    if noise == 0.0:
        taken = source == CLOSED_FORM
        np.testing.assert_allclose(distance[taken], one_time[taken], atol=1e-5)


def test_other_times_and_views_keep_the_fit(box):
    """Beyond the recording, from elsewhere, at another size, and in a quartet with a hole."""
    measured, quads, truth = box
    there = np.ones(FRAMES, dtype=bool)
    there[14] = False
    found = fallback_of(replace(measured, measured=there), quads)
    aside = np.eye(4)
    aside[0, 3] = 0.1
    inside, wrong = 5 / FRAME_RATE_HZ, rendering(truth[13] + 0.5)
    assert found.applied(wrong, inside, found.camera).source.any()
    for time, camera in (
        (99.0, found.camera),
        (13 / FRAME_RATE_HZ, found.camera),
        (inside, found.camera.at(aside)),
        (inside, replace(found.camera, distortion=Distortion(k1=-0.2))),
    ):
        given = found.applied(wrong, time, camera)
        assert not given.source.any()
        assert (given.distance == wrong.distance).all()
    smaller = rendering(truth[13][::2, ::2])
    assert not found.applied(smaller, inside, found.camera.resized(24, 18)).source.any()


@pytest.fixture
def carried(box):
    """The moving box, with poses of a camera that moves by 0.1 mm per raw frame."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 1e-4 * np.arange(FRAMES)
    return replace(box[0], camera_from_world=poses)


@pytest.mark.parametrize("factor", [1.0, 0.2])
def test_one_phasor_is_enough_where_the_camera_moves(box, carried, factor):
    """Nothing is averaged. The closed form is taken wherever nothing changes within the quartet,
    however well the fit explains it; a fit stays where it alone explains what changes.
    """
    _, quads, truth = box
    found = fallback_of(carried, factor * quads)
    assert found.averages == (factor == 1.0), (
        "a fit is averaged with the closed form if it is sound"
    )
    assert not fallback_of(box[0], factor * quads).averages, "and if the camera moves"
    camera = found.camera.at(carried.camera_from_world[13])
    given = found.applied(rendering(truth[13] + 1.0), 13 / FRAME_RATE_HZ, camera)
    source = given.source.numpy()
    assert (source[:5] == CLOSED_FORM).mean() > 0.98
    closed = torch.tensor(closed_form_distance(carried, 3), dtype=torch.float32)
    assert torch.equal(given.distance[:5][source[:5] > 0], closed[:5][source[:5] > 0])
    bodies = np.stack([seen(n)[2] for n in range(12, 16)])
    changes = bodies.any(axis=0) & ~bodies.all(axis=0)
    assert changes.sum() > 20
    assert ((source == FIT)[changes].mean() > 0.8) == (factor == 1.0)
    assert (source == FIT).mean() < 0.2


def test_each_frequency_has_a_phasor_of_its_own(carried):
    """Two frequencies leave half of eight quads to contradict their phasors: what one phasor of all
    would just explain is not explained, and a fit that explains it stays.
    """
    wall, amplitude = seen(0)[0], 0.2  # [m], [quad units]
    frequencies = np.repeat([60e6, 40e6], 4)[np.arange(FRAMES) % 8]
    slopes = 4.0 * np.pi * frequencies / SPEED_OF_LIGHT
    angles = slopes[:, None, None] * wall - carried.shifts[:, None, None]
    tolerated = 1e-3 * amplitude  # of recordings without noise
    quads = (amplitude * np.cos(angles) + math.sqrt(3.7) * tolerated).astype(np.float32)
    stated = replace(carried.calibration, f_mod_hz=60e6, cycle_length=8)
    changes = {"quads": quads, "frequencies_hz": frequencies, "calibration": stated}
    several = replace(carried, **changes)
    assert several.cycle == 8
    assert not fallback_of(several, quads).moved.any()
    assert fallback_of(several, 0.9 * quads).moved.all()


def test_phasors_of_a_moving_camera_are_the_closed_form(box, carried):
    """Nothing says where a fit is better than what the camera computed from them, so it never
    replaces it; of a camera at rest a fit that explains them stays, where nothing is averaged.
    """
    sequence, _, truth = box
    quads = as_phasors(sequence).quads
    at_rest = fallback_of(replace(sequence, quads=quads, from_phasors=True), quads)
    assert not at_rest.moved.any()
    found = fallback_of(replace(carried, quads=quads, from_phasors=True), quads)
    camera = found.camera.at(carried.camera_from_world[13])
    given = found.applied(rendering(truth[13] + 1.0), 13 / FRAME_RATE_HZ, camera)
    assert torch.equal(given.distance, found.closed_form[3])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One short fit with and without the setting."""
    folder = tmp_path_factory.mktemp("runs")
    write("ftorf", folder / "box", *recording(frames=16))
    names = {"with": True, "without": False}
    return {
        name: reconstruct(folder / "box", folder / name, demo(images=80, fallback=given))
        for name, given in names.items()
    }


def test_a_run_with_the_setting_says_where_its_distance_is_from(runs, tmp_path):
    """Run.render, its renderer and the EXR files; without the setting there is no source."""
    run, plain = runs["with"], runs["without"]
    given, bare = run.render(9 / FRAME_RATE_HZ), plain.render(9 / FRAME_RATE_HZ)
    assert bare.source is None
    assert set(given.source.unique().tolist()) <= {0, 1, 2}
    assert (given.source > 0).any()
    same = given.source == FIT
    torch.testing.assert_close(given.distance[same], bare.distance[same])
    fast = run.renderer(("distance", "opacity", "source"))(9 / FRAME_RATE_HZ, run.camera)
    torch.testing.assert_close(fast.distance, given.distance)
    alone = run.renderer(("opacity",))(9 / FRAME_RATE_HZ, run.camera)
    torch.testing.assert_close(alone.opacity, given.opacity)
    render_to_folder(run, tmp_path / "out", ["distance"], [9 / FRAME_RATE_HZ])
    stored = read_exr(tmp_path / "out" / "distance" / "000000.exr")
    np.testing.assert_array_equal(stored["source"], given.source.numpy())
    render_to_folder(plain, tmp_path / "plain", ["distance"], [9 / FRAME_RATE_HZ])
    assert "source" not in read_exr(tmp_path / "plain" / "distance" / "000000.exr")


def test_quads_and_phasor_are_those_of_the_measurement_where_it_may_replace_the_fit(runs):
    """From all ways to render them; elsewhere, without a closed form, they stay between frames."""
    run, plain, between = runs["with"], runs["without"], 9.4 / FRAME_RATE_HZ
    given, bare = run.render(between), plain.render(between)
    may = run.fallback.rests[2] | (given.source == CLOSED_FORM)
    changed = (given.phasor[:2] != bare.phasor[:2]).any(dim=0)
    assert float(changed[may].float().mean()) > 0.9
    torch.testing.assert_close(given.phasor[:2, ~may], bare.phasor[:2, ~may])
    torch.testing.assert_close(given.quads[:, ~may], bare.quads[:, ~may])
    quads = run.renderer(("quads",))(between, run.camera).quads
    torch.testing.assert_close(quads, given.quads)
    never = torch.zeros_like(run.fallback.rests)
    fit = Run.open(run.path)
    fit.__dict__["fallback"] = replace(run.fallback, rests=never, moved=never)
    torch.testing.assert_close(fit.render(between).phasor[:2], bare.phasor[:2])


def test_compare_scores_the_result_and_the_fit_alone(runs):
    """Shares of the sources, and the errors that the run would have without the measurement."""
    got, bare = (compare(runs[name]) for name in ("with", "without"))
    assert bare["source"] is bare["d_fit_mse_x100"] is None
    assert got["d_fit_mse_x100"] == pytest.approx(bare["d_mse_x100"], rel=1e-4)
    assert sum(got["source"].values()) == pytest.approx(1.0)
    assert set(got["source"]) == set(SOURCES)
    static = got["static"]
    assert static["d_mse_x100"] < 0.7 * static["d_fit_mse_x100"]
    assert static["d_tof_mse_x100"] < 0.7 * bare["static"]["d_tof_mse_x100"]
    assert got["quad_psnr_db"] == pytest.approx(bare["quad_psnr_db"])
    assert static["d_mse_x100"] < 1.2 * static["temporal_mse_x100"]
    assert got["d_mse_x100"] < got["closed_form_mse_x100"]
    page = (runs["with"].path / "report.html").read_text()
    assert "Where our distance is from" in page
    assert json.loads((runs["with"].path / "metrics.json").read_text()) == got


def test_a_sequence_that_is_gone_leaves_the_fit(runs, caplog):
    """With a warning, once."""
    config = runs["with"].config | {"sequence": "/nowhere"}
    run = replace(Run.open(runs["with"].path), config=config)
    assert run.render(0.0).source is None
    assert run.render(0.1).source is None
    assert caplog.text.count("no fallback to the measurement") == 1


def test_what_rests_for_two_quartets_only_is_averaged_over_them():
    """A wall that jumps away after half of the quartets, and one quartet later again: the minority
    is averaged with its neighbour in time, a single quartet with none.
    """
    measured, _ = recording(frames=FRAMES)
    slots = recording(frames=4, noise=0.0)[0].quads
    factors = np.repeat([1, 1, 1, 1, 1, 0.7, 0.7, 0.4], 4)[:, None, None]
    clean = np.tile(slots, (8, 1, 1)) * factors
    noise = 4e-4 * np.random.default_rng(1).standard_normal(clean.shape)
    measured = replace(measured, quads=(clean + noise).astype(np.float32))
    assert [agreement(measured)[i].mean() > 0.9 for i in range(8)] == [True] * 5 + [False] * 3
    local, count = averaged_locally(measured)
    assert [int(np.median(count[i])) for i in range(8)] == [2, 3, 3, 3, 2, 2, 2, 1]
    ratio = np.std(local.quads[24:28] - clean[24:28]) / np.std(noise[24:28])
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.1)
    np.testing.assert_array_equal(local.quads[28:], measured.quads[28:])
    wrong = recording(frames=FRAMES)[1].distance[0] + 0.5
    source = applied(fallback_of(measured, clean), wrong, 25)[1]
    assert (source == TEMPORAL).mean() > 0.9
