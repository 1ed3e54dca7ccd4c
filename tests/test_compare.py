"""Comparing a run whose errors are known beforehand: every number of metrics.json worked out by
hand.
"""

import json
import math
from dataclasses import replace

import analytic_run
import numpy as np
import pytest
import torch
from analytic_run import (
    BOX,
    PHASE_SLOPE,
    WALL,
    AnalyticRun,
    as_phasors,
    box_at,
    quad,
    true_distance,
    with_colour,
)
from sequences import changed

from gftorf_warp import Truth, __version__
from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.data.texts import read_rows
from gftorf_warp.data.write import write
from gftorf_warp.errors import DivergedError, InputError, UsageError
from gftorf_warp.evaluate.compare import (
    compare,
    comparison_of,
    sequence_title,
    summary,
    truth_statement,
)
from gftorf_warp.evaluate.metrics import scored_frames
from gftorf_warp.evaluate.views import gather
from gftorf_warp.recon import raw_frames

PIXELS, BOX_PIXELS = 12 * 20, 6 * 4
# seven columns see the box within a quartet, one of them all the time
MOVING, MOVING_BOX = 6 * 6, 6 * 3
KEYS = {
    "frames",
    "protocol",
    "against",
    "closed_form_mse_x100",
    "temporal_mean_mse_x100",
    "temporal_median_mse_x100",
    "temporal_mse_x100",
    "d_mse_x100",
    "d_normalised_mse_x100",
    "d_median_mse_x100",
    "d_tof_mse_x100",
    "moving",
    "static",
    "static_throughout",
    "classes",
    "unambiguous_range_m",
    "ambiguous_share",
    "d_fit_mse_x100",
    "source",
    "explained",
    "caveats",
    "quad_psnr_db",
    "colour_psnr_db",
    "gaussians",
    "diagnostics",
    "method",
    "seconds_reconstruct",
    "images_optimised",
    "device",
    "seed",
    "preset",
    "ablation",
    "input",
    "flow_source",
    "unfilled_share",
    "init",
    "motion",
    "checkpoint_sha256",
    "version",
}


def mixed(box, wall, boxes, pixels):
    """Mean of a squared error over pixels, some of which see the box."""
    return (boxes * box**2 + (pixels - boxes) * wall**2) / pixels


def closed_form(quartet):
    """[H, W] distance decoded from four quads of four instants, with complex numbers."""
    q = [quad(true_distance(4 * quartet + k), CANONICAL_SHIFTS[k]) for k in range(4)]
    return np.angle((q[0] - q[1]) + 1j * (q[2] - q[3])) % (2 * np.pi) / PHASE_SLOPE


@pytest.fixture
def run(tmp_path):
    """A run with a truth."""
    return AnalyticRun(tmp_path)


def test_every_number_by_hand(run):
    """Errors of d, d / opacity, d_ToF and the closed form on all, moving and static pixels,
    and what was copied.
    """
    got = compare(run, report=False)
    assert set(got) == KEYS
    assert got["unambiguous_range_m"] == pytest.approx(7.5)
    assert got["ambiguous_share"] is None, "one frequency chooses nothing"
    assert (got["frames"], got["protocol"], got["version"]) == (12, "all", __version__)
    assert got["moving"]["share"] == pytest.approx(MOVING / PIXELS)
    assert got["static"]["share"] == pytest.approx(1 - MOVING / PIXELS)
    groups = {
        "moving": (got["moving"], MOVING_BOX, MOVING),
        "static": (got["static"], BOX_PIXELS - MOVING_BOX, PIXELS - MOVING),
        "all": (got, BOX_PIXELS, PIXELS),
    }
    box, wall = 0.98 * (BOX - 0.1) - BOX, 0.98 * (WALL + 0.02) - WALL
    for row, boxes, pixels in groups.values():
        assert row["d_mse_x100"] == pytest.approx(100 * mixed(box, wall, boxes, pixels), rel=1e-4)
        assert row["d_normalised_mse_x100"] == pytest.approx(
            100 * mixed(-0.1, 0.02, boxes, pixels), rel=1e-4
        )
        assert row["d_median_mse_x100"] == pytest.approx(100 * 0.04**2, rel=1e-4)
        assert row["d_tof_mse_x100"] == pytest.approx(100 * 0.03**2, rel=1e-4)
    assert got["static"]["closed_form_mse_x100"] == pytest.approx(0.0, abs=1e-8)
    squared = [(closed_form(n // 4) - true_distance(n)) ** 2 for n in range(12)]
    assert got["closed_form_mse_x100"] == pytest.approx(100 * np.mean(squared), rel=1e-4)
    assert got["moving"]["closed_form_mse_x100"] == pytest.approx(
        100 * np.mean(squared) * PIXELS / MOVING, rel=1e-4
    )
    assert got["moving"]["closed_form_mse_x100"] > 10.0, "an exact closed form would test nothing"
    for name, value in {
        "gaussians": 1234,
        "images_optimised": 2988,
        "seconds_reconstruct": 41.25,
        "seed": 7,
    }.items():
        assert got[name] == value
    copied = {
        "device": "cpu",
        "preset": "demo",
        "flow_source": "computed",
        "init": "phase",
        "motion": "nodes",
    }
    assert {name: got[name] for name in copied} == copied
    assert got["method"] == "gaussians"
    assert got["input"] is got["ablation"] is got["diagnostics"] is got["colour_psnr_db"] is None


def test_quad_psnr_pools_the_measured_slots(run):
    """The peak over the root of the mean squared difference, in dB;
    slots that were not measured do not count.
    """
    shifts = [CANONICAL_SHIFTS[n % 4] for n in range(14)]
    measured = [quad(true_distance(n), shifts[n]) for n in range(14)]
    rendered = [quad(true_distance(n) + 0.03, shifts[n], true_distance(n)) for n in range(12)]
    mse = np.mean([(r - m) ** 2 for r, m in zip(rendered, measured, strict=False)])
    want = 10 * math.log10(np.abs(measured).max() ** 2 / mse)
    assert compare(run, report=False)["quad_psnr_db"] == pytest.approx(want, abs=1e-3)


def test_what_is_returned_is_what_is_written(run):
    """metrics.json is plain JSON without NaN; the page is written beside it unless it is not
    wanted.
    """
    got = compare(run, report=False)

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    assert json.loads((run.path / "metrics.json").read_text(), parse_constant=refuse) == got
    assert not (run.path / "report.html").exists()
    compare(run)
    assert (run.path / "report.html").read_text().startswith("<!doctype html>")


def test_published_protocol(run):
    """Of three quartets only the start of the middle one is left."""
    got = compare(run, frames="ftorf13", report=False)
    assert (got["frames"], got["protocol"]) == (1, "ftorf13")
    error = (closed_form(1) - true_distance(4)) ** 2
    assert got["closed_form_mse_x100"] == pytest.approx(100 * error.mean(), rel=1e-4)


@pytest.mark.parametrize("fits", [True, False], ids=["once", "again"])
def test_every_frame_is_rendered_at_its_own_pose(fits, tmp_path, monkeypatch):
    """A camera that moves on by a centimetre each raw frame: rendered once for errors and residuals
    if the images of all raw frames fit into memory.
    """
    if not fits:
        monkeypatch.setattr(raw_frames, "RENDERINGS_KEPT_MAX", 0)
    steps = []
    run = AnalyticRun(tmp_path)
    poses = np.tile(np.eye(4), (14, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(14)
    original = run.sequence
    run.sequence = lambda: replace(original(), camera_from_world=poses)
    compare(run, report=False, progress=lambda *step: steps.append(step))
    taken = [camera.camera_from_world[0, 3] for camera in run.cameras]
    np.testing.assert_allclose(taken, [*poses[:12, 0, 3]] * (1 if fits else 2))
    assert steps == [(4, 24), (8, 24), (12, 24), *((n, 24) for n in range(13, 25))]


def test_without_truth_errors_are_null(tmp_path):
    """The quads can still be compared, and the page is still written."""
    run = AnalyticRun(tmp_path, with_truth=False)
    got = compare(run)
    assert got["d_mse_x100"] is None
    assert got["closed_form_mse_x100"] is None
    assert set(got["moving"].values()) == set(got["static"].values()) == {None}
    assert got["quad_psnr_db"] > 10.0
    assert (run.path / "report.html").exists()


def test_truth_of_another_folder(tmp_path):
    """The errors are those of the sequence's own truth, and of no other."""
    run = AnalyticRun(tmp_path, with_truth=False)
    truth = analytic_run.truth()
    shifted = Truth(distance=truth.distance + np.float32(0.5), known=truth.known)
    write("ftorf", tmp_path / "other", analytic_run.sequence(), shifted)
    got = compare(run, truth=tmp_path / "other", report=False)
    assert got["d_tof_mse_x100"] == pytest.approx(100 * (0.5 - 0.03) ** 2, rel=1e-4)


def test_either_distance_can_be_the_true_one(tmp_path):
    """Against the static-phasor distance all errors are those to it;
    pixels that move are those of geometry.
    """
    run = AnalyticRun(tmp_path)
    truth = analytic_run.truth()
    both = Truth(
        distance=truth.distance, known=truth.known, phasor_distance=truth.distance + np.float32(0.5)
    )
    write("ftorf", tmp_path / "both", analytic_run.sequence(), both)
    geometry, static = (
        compare(run, truth=tmp_path / "both", against=a) for a in ("geometry", "static-phasor")
    )
    assert (geometry["against"], static["against"]) == ("geometry", "static-phasor")
    assert geometry["d_tof_mse_x100"] == compare(run, report=False)["d_tof_mse_x100"]
    assert static["d_tof_mse_x100"] == pytest.approx(100 * (0.5 - 0.03) ** 2, rel=1e-4)
    assert static["moving"]["share"] == geometry["moving"]["share"] > 0
    assert "static-phasor" in (run.path / "report.html").read_text()
    with pytest.raises(InputError, match="no static-phasor distance"):
        compare(run, against="static-phasor")
    with pytest.raises(UsageError, match="unknown truth 'phase'"):
        compare(run, against="phase")


def test_unknown_truth_is_not_scored(tmp_path):
    """One frame known in its first row only, another not at all:
    each known frame weighs alike in the mean.
    """
    run = AnalyticRun(tmp_path, with_truth=False)
    truth = analytic_run.truth()
    truth.distance[2, 1:] = np.nan  # all that is left is wall
    truth.known[5] = False
    write("ftorf", tmp_path / "partly", analytic_run.sequence(), truth)
    got = compare(run, truth=tmp_path / "partly")
    box, wall = 100 * 0.1**2, 100 * 0.02**2
    whole = (BOX_PIXELS * box + (PIXELS - BOX_PIXELS) * wall) / PIXELS
    assert got["frames"] == 12
    assert got["d_normalised_mse_x100"] == pytest.approx((wall + 10 * whole) / 11, rel=1e-4)
    assert got["moving"]["share"] + got["static"]["share"] == pytest.approx(1.0)


def test_a_still_scene_has_no_moving_pixels(tmp_path):
    """Null where no pixel is, with a share of zero, and the page says it for all pixels."""
    run = AnalyticRun(tmp_path)
    still = np.tile(true_distance(0), (14, 1, 1)).astype(np.float32)
    write(
        "ftorf",
        tmp_path / "still",
        analytic_run.sequence(),
        Truth(distance=still, known=np.ones(14, dtype=bool)),
    )
    got = compare(run, truth=tmp_path / "still")
    assert got["moving"] == {
        **dict.fromkeys(k for k in KEYS if k.endswith("_mse_x100")),
        "share": 0.0,
    }
    assert got["static"]["d_mse_x100"] == pytest.approx(got["d_mse_x100"])
    assert "Over all pixels" in (run.path / "report.html").read_text()


def test_a_truth_that_does_not_fit_is_named(tmp_path):
    """Another number of frames, or no truth at all, where one was asked for."""
    run = AnalyticRun(tmp_path)
    write("ftorf", tmp_path / "short", analytic_run.sequence(8), analytic_run.truth(8))
    with pytest.raises(
        InputError,
        match=r"expected frames x rows x columns 14x12x20, found "
        r"8x12x20",
    ) as error:
        compare(run, truth=tmp_path / "short")
    assert error.value.where == str(tmp_path / "short")
    write("ftorf", tmp_path / "blind", analytic_run.sequence())
    with pytest.raises(InputError, match="no ground truth"):
        compare(run, truth=tmp_path / "blind")
    with pytest.raises(UsageError, match="unknown protocol"):
        compare(run, frames="some")
    assert not (run.path / "metrics.json").exists()


def test_a_rendering_that_is_not_finite_ends_the_comparison(run):
    """NaN would otherwise vanish in a mean, or stand in metrics.json."""
    render = run.render

    def broken(time, camera=None):
        rendering = render(time, camera)
        rendering.distance[2, 3] = torch.nan
        return rendering

    run.render = broken
    with pytest.raises(DivergedError, match="1 of 240"):
        compare(run)
    assert not (run.path / "metrics.json").exists()


def test_box_and_mask_of_the_analytic_run():
    """Seven columns of a quartet see the box at some time, and one always: six move."""
    seen = np.stack([box_at(n) for n in range(4)])
    assert (seen.any(0) & ~seen.all(0)).sum() == MOVING
    assert seen[0].sum() == BOX_PIXELS


def test_rows_stop_before_a_torn_line(tmp_path):
    """A killed run may leave half a line."""
    path = tmp_path / "metrics.jsonl"
    assert read_rows(path) == []
    path.write_text('{"images": 4, "loss": 1.0}\n{"images": 8, "lo')
    assert read_rows(path) == [{"images": 4, "loss": 1.0}]


def test_a_sequence_is_called_by_its_heading(tmp_path):
    """The heading of its data card, or its folder."""
    assert sequence_title(None) is None
    assert sequence_title(tmp_path) == tmp_path.name
    (tmp_path / "README.md").write_text("# a box: simulated\n\nText.\n")
    assert sequence_title(tmp_path) == "a box: simulated"


def test_truth_statement_is_the_paragraph_of_the_data_card(tmp_path):
    """The paragraph about ground truth, on one line; nothing without a data card."""
    assert truth_statement(None) is None
    assert truth_statement(tmp_path) is None
    (tmp_path / "README.md").write_text(
        "# box\n\nGround truth is the analytic hit,\nnot a rendering.\n\nMore.\n"
    )
    assert truth_statement(tmp_path) == "Ground truth is the analytic hit, not a rendering."


def test_settings_fill_in_what_the_config_does_not_say(run):
    """The input is resolved in the config, the row of the ablation stands in its settings."""
    run.config |= {
        "input": "quads",
        "settings": {"method": "gaussians", "input": "auto", "ablation": "h1"},
    }
    got = compare(run, report=False)
    assert (got["input"], got["ablation"], got["method"]) == ("quads", "h1", "gaussians")


def test_phasors_are_scored_once(run):
    """Four raw frames of one instant are one image; what moves is what changes to the next
    phasor.
    """
    phasors = as_phasors(run.sequence())
    run.sequence = lambda: phasors
    known = analytic_run.truth().distance
    still = Truth(distance=np.repeat(known[[0, 4, 8]], 4, axis=0), known=np.ones(12, dtype=bool))
    found = comparison_of(phasors, gather(run, phasors, scored_frames(phasors)), still)
    assert found.views.frames == [0, 4, 8]
    got = summary(run, found, protocol="all")
    assert got["frames"] == 3
    assert got["closed_form_mse_x100"] == pytest.approx(0.0, abs=1e-8)
    assert got["d_tof_mse_x100"] == pytest.approx(100 * 0.03**2, rel=1e-4)
    box, wall = 0.98 * (BOX - 0.1) - BOX, 0.98 * (WALL + 0.02) - WALL
    assert got["moving"]["d_mse_x100"] == pytest.approx(100 * (box**2 + wall**2) / 2, rel=1e-4)
    assert got["moving"]["share"] == pytest.approx(2 * BOX_PIXELS / PIXELS), (
        "four columns appear, four disappear"
    )


def test_colour_is_compared_from_the_colour_camera(tmp_path):
    """At the frames that have an image, from the pose of the colour camera, at its size;
    the peak is the largest.
    """
    run = AnalyticRun(tmp_path, colour=True)
    sequence = with_colour(run.sequence())
    run.sequence = lambda: sequence
    got = compare(run, report=False)
    assert got["colour_psnr_db"] == pytest.approx(20 * math.log10(1.8 / 0.05), abs=1e-3)
    taken = [camera for camera in run.cameras if camera.camera_from_world[0, 3] == -0.1]
    assert len(taken) == 3
    unknown = changed(sequence, colour_intrinsics=None)
    run.sequence = lambda: unknown
    assert compare(run, report=False)["colour_psnr_db"] is None
    grey = AnalyticRun(tmp_path / "grey")
    grey.sequence = lambda: sequence
    assert compare(grey, report=False)["colour_psnr_db"] is None


def test_diagnostics_in_a_few_numbers(run):
    """The best moment by truth, and by the criterion that needs none; a torn line is no row."""
    run.watched((10, 9.0, 0.4), (20, 3.0, 0.2), (30, 5.0, 0.1))
    with (run.path / "diagnostics.jsonl").open("a") as file:
        file.write('{"images": 40, "d_mse_x100": 0.')
    assert compare(run, report=False)["diagnostics"] == {
        "rows": 3,
        "d_mse_x100_least": 3.0,
        "images_at_least": 20,
        "criterion_m_least": 0.1,
        "images_at_criterion": 30,
        "d_mse_x100_at_criterion": 5.0,
    }
    run.watched((10, None, None), (20, None, 0.2))
    found = compare(run, report=False)["diagnostics"]
    assert found == {
        **dict.fromkeys(found),
        "rows": 2,
        "criterion_m_least": 0.2,
        "images_at_criterion": 20,
    }
