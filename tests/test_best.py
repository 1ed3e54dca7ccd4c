"""Preset best end to end on a small recording: better than the closed form where something moves,
not worse elsewhere; and what may be combined with it.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import as_phasors, recording, seen, turned, with_colour
from small_runs import rows, same, stored
from test_per_quartet import recorded

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.write import write
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.windows import Windows


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A run of 120 images of the sliding box, its sequence and truth."""
    folder = tmp_path_factory.mktemp("best")
    sequence, truth = recording()
    write("capture", folder / "sequence", sequence, truth)
    run = reconstruct(folder / "sequence", folder / "run", images=120, device="cpu")
    return run, sequence, truth


def test_a_short_fit_is_better_than_the_closed_form(fit):
    """Squared errors of the distance: of pixels that see the box at any time by a quarter, of
    others by a quarter too, since their quartets are averaged.
    """
    run, sequence, truth = fit
    render = run.renderer(("distance", "opacity"))
    images = [render(float(t), run.camera).distance.numpy().copy() for t in sequence.times]
    errors = np.square(np.stack(images) - truth.distance)
    closed = np.stack([closed_form_distance(sequence, n // 4) for n in range(sequence.frames)])
    closed = np.square(closed - truth.distance)
    moving = np.stack([seen(n)[2] for n in range(sequence.frames)]).any(axis=0)
    assert errors[:, moving].mean() < 0.75 * closed[:, moving].mean()
    assert errors[:, ~moving].mean() < 0.75 * closed[:, ~moving].mean()


def test_all_parameters_of_the_windows_are_optimised(fit):
    """The loss falls; velocities and positions of every window change; static ones never move."""
    run, sequence, _ = fit
    found = [row["quads"] for row in rows(run.path) if "quads" in row]
    assert found[-1] < 0.8 * found[0]
    first = begin(observe(sequence, presets.best(), "cpu"), presets.best(), seed=0, device="cpu")
    assert isinstance(run.motion, Windows)
    assert torch.equal(run.motion.label, first.motion.label)
    assert torch.equal(run.field.layer, first.optimiser.layer)
    trained = (run.motion.velocity - first.motion.velocity).abs().amax(dim=1)
    moved = (run.field.mean - first.optimiser.field.mean).abs().amax(dim=1)
    for quartet in range(4):
        assert trained[run.motion.label == 1 + quartet].max() > 1e-4
        assert moved[run.field.layer == 1 + quartet].max() > 1e-4
    offset = run.motion.at(run.binding, 0.05).offset
    assert offset[run.field.layer == 0].abs().max() == 0.0


def test_the_folder_gives_the_run_back(fit):
    """Motion, binding and images, before the fallback and with it."""
    run, _, _ = fit
    again = Run.open(run.path)
    assert stored(run.path)["motion"]["kind"] == "windows"
    assert same(again.motion.state_dict(), run.motion.state_dict())
    assert torch.equal(again.binding, run.binding)
    assert again.render_settings.low_pass == 0.1
    for time in (0.0, 0.05, 0.2):
        one, other = again.render(time), run.render(time)
        assert torch.equal(one.quads, other.quads)
        torch.testing.assert_close(one.distance, other.distance)


def test_gaussians_that_are_added_while_training_keep_their_window(tmp_path):
    """Cloned, split and pruned along a run: every one is bound to nodes of its own label."""
    densify = ("every=16", "start=8", "gradient_min=1e-9", "clone_scale_max=0.03")
    changes = [f"densify.{change}" for change in densify]
    sequence = recording(frames=12)[0]
    run = reconstruct(sequence, tmp_path / "run", images=48, changes=changes, device="cpu")
    first = begin(observe(sequence, presets.best(), "cpu"), presets.best(), seed=0, device="cpu")
    assert run.gaussians > 1.2 * len(first.optimiser.field)
    assert torch.equal(run.binding[:, 0].long(), run.field.layer)
    near, weight = run.binding[:, 1:].chunk(2, dim=1)
    strangers = run.motion.label[near.long()] != run.field.layer[:, None]
    assert weight[strangers].abs().max() == 0.0
    assert weight.sum(dim=1)[run.field.layer > 0].min() > 0.999
    counts = [int((run.field.layer == 1 + quartet).sum()) for quartet in range(3)]
    before = [int((first.optimiser.layer == 1 + quartet).sum()) for quartet in range(3)]
    assert all(after > count > 0 for after, count in zip(counts, before, strict=True))


COMBINATIONS = {
    "nodes": ["init.kind=phase", "motion.kind=nodes"],
    "wide filter": ["render.low_pass=0.3"],
    "constant distances": ["render.splat_distance=centre"],
    "one node per window": ["motion.nodes=1", "motion.neighbours=1"],
    "single raw frames": ["schedule.batch=frame"],
    "warm-up": ["schedule.warm_up=8"],
    "coarse": ["init.moving_spacing=3", "init.edge_spacing=2", "init.static_spacing=4"],
}


@pytest.mark.parametrize("name", COMBINATIONS)
def test_settings_of_best_can_be_changed_one_by_one(name, tmp_path):
    """A few steps each: finite everywhere, with light in the image."""
    changes = COMBINATIONS[name]
    run = reconstruct(
        recording(frames=12)[0], tmp_path / "run", images=16, changes=changes, device="cpu"
    )
    _check(run)
    assert isinstance(run.motion, Windows) == (name != "nodes")


RECORDINGS = {
    "moving camera": lambda sequence: replace(
        sequence, camera_from_world=np.stack([turned(0.1 * n) for n in range(12)])
    ),
    "phasors and colour": lambda sequence: with_colour(as_phasors(sequence)),
    "one quartet": lambda _: recording(frames=4, with_flow=False)[0],
    "truncated": lambda _: recording(frames=10)[0],
    "at rest": lambda _: recorded(frames=12, speed=0.0),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_best_takes_every_recording(name, tmp_path):
    """Nodes where the camera moves; windows elsewhere, also if nothing moves at all."""
    sequence = RECORDINGS[name](recording(frames=12)[0])
    run = reconstruct(sequence, tmp_path / "run", images=16, device="cpu")
    _check(run)
    assert isinstance(run.motion, Windows) == (name != "moving camera")
    moving = int((run.field.layer > 0).sum())
    assert (moving == 0) == (name in ("one quartet", "at rest"))


def _check(run):
    """Finite parameters; opaque nearly everywhere, at any time."""
    assert all(value.isfinite().all() for value in run.field.parameters().values())
    for time in (-1.0, 0.0, 0.05, 1.0):
        image = run.render(time)
        assert image.quads.isfinite().all()
        assert image.opacity.median() > 0.8
