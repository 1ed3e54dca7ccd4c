"""The optimiser as a whole finds a moving scene from raw quads, and from nothing else."""

import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_box import recording
from small_runs import demo, rows, same, small, stored

from gftorf_warp.data import ftorf
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.sequence import Sequence
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.recon import presets, train
from gftorf_warp.recon.observations import observe, reduced, with_flow
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import FlowSource, plain
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.initialise import Init, InitSettings
from gftorf_warp.scene.motion import MotionKind, MotionSettings
from gftorf_warp.scene.sensor import distance_from_phasor, phasor_from_quads

SAMPLE = Path(__file__).parent / "data" / "ftorf_sample_box"


@pytest.fixture(scope="module")
def folder_of_a_sequence(tmp_path_factory):
    """The small recording on disk, with its truth."""
    path = tmp_path_factory.mktemp("sequence") / "box"
    ftorf.write(path, small(), recording(frames=12)[1])
    return path


def errors(run, sequence, truth):
    """MSE x100 [m^2] of rendered distance, of d_ToF and of the closed form, on moving and on static pixels."""
    frames = range(sequence.frames // 4 * 4)
    renderings = [run.render(float(sequence.times[n])) for n in frames]
    rendered = np.stack([r.distance.numpy() for r in renderings])
    d_tof = np.stack(
        [distance_from_phasor(*phasor_from_quads(r.quads, run.sensor.shifts), run.sensor).numpy() for r in renderings]
    )
    closed = np.stack([closed_form_distance(sequence, n // 4) for n in frames])
    moving = np.concatenate(
        [
            np.repeat(np.ptp(truth[4 * i : 4 * i + 4], axis=0)[None] > 0.05, 4, axis=0)
            for i in sequence.complete_quartets
        ]
    )
    result = {}
    for name, distance in (("d", rendered), ("d_tof", d_tof), ("closed", closed)):
        squared = 100.0 * (distance - truth[: len(frames)]) ** 2
        result[name] = {"moving": squared[moving].mean(), "static": squared[~moving].mean()}
    return result


@functools.cache
def sample():
    """The ray-traced sample at half its resolution, so that a few hundred steps take seconds."""
    sequence = Sequence.open(SAMPLE)
    return sequence, sequence.truth().distance


@pytest.fixture(scope="module")
def sample_run(tmp_path_factory):
    """Its reconstruction."""
    settings = demo(images=1200, width_max=80)
    return reconstruct(sample()[0], tmp_path_factory.mktemp("sample") / "run", settings)


def test_moving_pixels_are_much_better_than_the_closed_form(sample_run):
    """Optimised at half resolution with a fraction of the preset's images, compared at full resolution."""
    found = errors(sample_run, *sample())
    assert found["closed"]["moving"] == pytest.approx(96.9, abs=0.1)
    assert found["d"]["moving"] < 0.2 * found["closed"]["moving"]
    assert found["d_tof"]["moving"] < 0.2 * found["closed"]["moving"]
    assert found["d"]["static"] < 0.8


def test_without_motion_it_is_much_worse(sample_run, tmp_path):
    """The control: the rest of the machinery alone does not explain the result."""
    settings = demo(images=1200, width_max=80, motion=MotionSettings(kind=MotionKind.STILL))
    still = reconstruct(sample()[0], tmp_path / "run", settings)
    found, control = (errors(run, *sample()) for run in (sample_run, still))
    assert control["d"]["moving"] > 2.5 * found["d"]["moving"]
    assert control["d"]["moving"] > 0.4 * control["closed"]["moving"]
    assert still.config["motion"] == "still"


def test_without_flow_the_keys_start_at_rest_and_with_computed_flow_they_do_not(sample_run):
    """Against the motion of the sample."""
    sequence = replace(sample()[0], forward_flow={}, backward_flow={})
    computed, source = with_flow(reduced(sequence, 80), FlowSource.AUTO)
    assert source == "computed"
    offsets = {}
    for name, given in (("computed", computed), ("none", reduced(sequence, 80))):
        settings = demo(flow=FlowSource.FILE)
        offsets[name] = begin(observe(given, settings, "cpu"), settings, seed=0, device="cpu").motion.offset
    along = offsets["computed"].median(dim=1).values
    want = torch.tensor([1.10, 0.60, -0.80]) * (28 / 31)  # the box from key 0 to key 7
    assert (along[7] - along[0] - want).norm() < 0.1
    assert offsets["none"][..., :2].abs().max() < 0.05
    assert sample_run.config["flow_source"] == "file"


def test_truth_is_never_read(tmp_path, folder_of_a_sequence):
    """Without truth and masks: the same bytes."""
    bare = tmp_path / "box"
    shutil.copytree(folder_of_a_sequence, bare)
    removed = [p for p in bare.iterdir() if p.name.startswith(("synthetic", "union", "dynamic", "occ"))]
    assert removed
    for path in removed:
        shutil.rmtree(path)
    settings = demo(images=24, log_every=8)
    runs = [
        reconstruct(path, tmp_path / name, settings).path for name, path in (("a", folder_of_a_sequence), ("b", bare))
    ]
    assert same(*map(stored, runs))
    assert rows(runs[0]) == rows(runs[1])


def test_the_number_of_threads_changes_no_bit(monkeypatch, tmp_path):
    """Images of a batch are summed in their order, whoever finishes first."""
    results = []
    for workers in (1, 3):
        monkeypatch.setattr(train, "available_threads", lambda workers=workers: workers)
        results.append(stored(reconstruct(small(), tmp_path / str(workers), demo(images=24)).path))
    assert same(*results)


def test_config_and_metrics_say_what_happened(tmp_path):
    """Settings, sources and rates as they were in force."""
    run = reconstruct(small(), tmp_path / "run", demo(images=24, log_every=8), seed=5)
    config = run.config
    assert (config["images"], config["images_optimised"], config["seed"], config["preset"]) == (24, 24, 5, "demo")
    assert (config["init"], config["motion"], config["flow_source"]) == ("phase", "nodes", "file")
    assert config["seconds_reconstruct"] > 0
    assert config["frame_rate_hz"] == pytest.approx(120.0)
    largest = max(
        np.hypot(*(small().quads[4 * i + j] - small().quads[4 * i + j + 1] for j in (0, 2))).max() for i in range(3)
    )
    assert config["quad_scale"] == pytest.approx(1 / largest, rel=1e-5)
    assert "inferred" in config["quad_scale_source"]
    decay = config["settings"]["schedule"]["decay"]
    assert config["schedule"]["rates_last"]["mean"] == pytest.approx(decay * config["settings"]["rates"]["mean"])
    found = rows(run.path)
    assert [row["images"] for row in found] == [8, 16, 24]
    assert all(row["loss"] == pytest.approx(row["quads"] + row["distortion"], rel=1e-4) for row in found)
    assert found[-1]["gaussians"] == run.gaussians
    assert 10 < found[-1]["quad_psnr_db"] < 80
    assert "is finished" in (run.path / "run.log").read_text()


def test_a_run_is_found_again_and_renders_in_the_units_of_the_file(tmp_path, folder_of_a_sequence):
    """At any time, from any camera."""
    run = reconstruct(folder_of_a_sequence, tmp_path / "run", demo(images=160))
    again = Run.open(run.path)
    assert again.sequence().path == folder_of_a_sequence
    sequence = small()
    a, b = (r.render(0.043) for r in (run, again))
    torch.testing.assert_close(a.quads, b.quads, rtol=0, atol=1e-7)
    assert a.quads.shape == (4, 36, 48)
    rendered = run.render(float(sequence.times[5])).quads[1].numpy()
    assert np.abs(rendered - sequence.quads[5]).mean() < 0.25 * np.abs(sequence.quads[5]).mean()
    first = run.render(0.0)
    torch.testing.assert_close(first.phasor[0], first.quads[0] - first.quads[1], rtol=1e-4, atol=1e-5)
    assert run.render(0.0, run.camera.resized(24, 18)).distance.shape == (18, 24)
    far, end = run.render(1e3), run.render(12 / 120)
    torch.testing.assert_close(far.distance, end.distance)
    assert run.render(0.0, extra=torch.ones(run.gaussians, 2)).extra.shape == (2, 36, 48)
    with pytest.raises(InputError, match="not a run"):
        Run.open(tmp_path)


def test_random_start_and_still_motion_run_too(tmp_path):
    """The controls, and a sequence without any flow: a few steps reduce the loss."""
    sequence = replace(small(), forward_flow={}, backward_flow={})
    settings = demo(images=160, log_every=16, init=InitSettings(kind=Init.RANDOM, count=300, opacity=0.3))
    settings = replace(settings, flow=FlowSource.NONE)
    run = reconstruct(sequence, tmp_path / "run", settings)
    found = rows(run.path)
    assert found[-1]["quads"] < 0.8 * found[0]["quads"]
    assert (run.config["init"], run.config["flow_source"]) == ("random", "none")
    with pytest.raises(InputError, match="in memory"):
        run.sequence()


def test_presets_have_names():
    """Those of later versions say so."""
    assert presets.preset("demo") == presets.demo()
    for name in ("paper", "released", "dmeo"):
        with pytest.raises(UsageError, match="demo") as caught:
            presets.preset(name)
        assert ("not available in this version" in str(caught.value)) == (name != "dmeo")
    assert json.loads(json.dumps(plain(presets.demo())))["schedule"]["images"] == presets.demo().schedule.images
