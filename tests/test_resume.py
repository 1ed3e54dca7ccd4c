"""Long runs: interrupted, killed, started twice, in the wrong folder, without numbers."""

import copy
import fcntl
import functools
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from moving_box import recording, with_colour
from small_runs import advance, demo, rows, same, small, stored

from gftorf_warp.data.read import read
from gftorf_warp.data.write import write
from gftorf_warp.errors import BusyError, DivergedError, InputError, Terminated, UsageError
from gftorf_warp.recon import checkpoint, folder, loop, presets, residuals
from gftorf_warp.recon.observations import data_hash, former_hash, observe
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch, DensifySettings, Weights, plain
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.recon.terms import TERMS
from gftorf_warp.recon.train import reconstruct

KILLED = """
import os, signal
from small_runs import demo, small
from gftorf_warp.recon.train import reconstruct
settings = demo(images=40, log_every=8)
from dataclasses import replace
settings = replace(settings, schedule=replace(settings.schedule, checkpoint_every_s=0.0))
kill = lambda n, *_, **__: os.kill(os.getpid(), signal.SIGKILL) if n == 24 else None
reconstruct(small(), RUN, settings, progress=kill)
"""


def test_an_interrupted_run_goes_on_to_the_same_bytes(tmp_path):
    """Stopped by SIGTERM in the middle of an epoch; densification,
    random splits and its statistics included.
    """
    options = DensifySettings(
        every=8, start=4, stop_share=0.9, gradient_min=1e-6, clone_scale_max=0.04, reset_every=24
    )
    settings = demo(
        images=40,
        log_every=4,
        densify=options,
        weights=Weights(distortion=1e-3, ssim=0.1, flow=1e-4),
    )
    whole = reconstruct(small(), tmp_path / "whole", settings, seed=3)

    def stop(images, _, **__):
        if images == 20:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Terminated):
        reconstruct(small(), tmp_path / "parts", settings, seed=3, progress=stop)
    assert stored(tmp_path / "parts")["images"] == 20
    seen = []
    parts = reconstruct(
        small(),
        tmp_path / "parts",
        settings,
        seed=3,
        progress=lambda images, _, **__: seen.append(images),
    )
    assert seen[0] == 24
    assert same(stored(whole.path), stored(parts.path))
    assert rows(whole.path) == rows(parts.path)
    assert whole.gaussians > len(
        begin(observe(small(), settings, "cpu"), settings, seed=3, device="cpu").optimiser.field
    )
    other = reconstruct(small(), tmp_path / "other", settings, seed=4)
    assert not same(stored(whole.path), stored(other.path))


def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path):
    """SIGKILL leaves no time to store anything: the last checkpoint counts,
    and later rows are dropped.
    """
    run = tmp_path / "killed"
    script = KILLED.replace("RUN", repr(str(run)))
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(__file__).parent, capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    assert checkpoint.last(run)["images"] == 20
    assert rows(run)[-1]["images"] == 24
    settings = demo(images=40, log_every=8)
    reconstruct(small(), run, settings)
    whole = reconstruct(small(), tmp_path / "whole", settings).path
    assert same(stored(run), stored(whole))
    assert rows(run) == rows(whole)


def test_a_run_that_was_killed_at_its_start_has_every_row_once(tmp_path, monkeypatch):
    """Its first checkpoint and its first diagnostics are there, and the first config in part."""
    (tmp_path / "run").mkdir()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / "run" / f".config.json.tmp-{gone.pid}-0").write_text('{"vers')

    class Killed(Stepper):
        def step(self):
            raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(loop, "Stepper", Killed)
        with pytest.raises(SystemExit):
            reconstruct(small(), tmp_path / "run", demo(images=8))
    reconstruct(small(), tmp_path / "run", demo(images=8))
    reconstruct(small(), tmp_path / "whole", demo(images=8))
    again, whole = (
        [
            json.loads(line)["images"]
            for line in (run / "diagnostics.jsonl").read_text().splitlines()
        ]
        for run in (tmp_path / "run", tmp_path / "whole")
    )
    assert again == whole
    assert not [*(tmp_path / "run").glob(".*.tmp-*")]


def test_a_run_that_was_killed_after_its_last_image_is_completed(tmp_path, monkeypatch):
    """Its config says in the end what that of an undisturbed one says."""
    settings = demo(images=8)
    whole = reconstruct(small(), tmp_path / "whole", settings).config

    def killed(*_):
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(residuals, "residuals", killed)
        with pytest.raises(SystemExit):
            reconstruct(small(), tmp_path / "run", settings)
    done = reconstruct(small(), tmp_path / "run", settings).config
    assert done["explained"]["reduced_chi_square"] > 0
    clocks = {name: done[name] for name in ("seconds_reconstruct",)}
    assert done == whole | clocks


def test_a_folder_resumes_or_says_why_not(tmp_path):
    """Other settings, seed or data, or fewer images, are another run."""
    settings = demo(images=8)
    run = reconstruct(small(), tmp_path / "run", settings, seed=1)
    first = stored(run.path)
    assert same(stored(reconstruct(small(), run.path, settings, seed=1).path), first), (
        "a finished run is left alone"
    )
    for changed in ({"seed": 2}, {"settings": demo(images=8, background=0.5)}, {"images": 4}):
        arguments = {"settings": settings, "seed": 1} | changed
        with pytest.raises(UsageError, match="--fresh") as caught:
            reconstruct(small(), run.path, **arguments)
        assert caught.value.exit_code == 2
    with pytest.raises(UsageError, match="data_sha256"):
        reconstruct(recording(frames=12, noise=0.001)[0], run.path, settings, seed=1)
    assert same(stored(run.path), first)
    longer = reconstruct(small(), run.path, settings, images=12, seed=1)
    assert longer.config["images_optimised"] == 12
    fresh = reconstruct(small(), run.path, demo(images=4), seed=2, fresh=True)
    assert fresh.config["images_optimised"] == 4
    assert json.loads((run.path / "old-1" / "config.json").read_text())["seed"] == 1
    reconstruct(small(), run.path, demo(images=4), seed=3, fresh=True)
    assert sorted(p.name for p in run.path.glob("old-*")) == ["old-1", "old-2"]


def test_a_run_with_the_former_hash_of_its_data_is_read_and_goes_on(tmp_path):
    """It left out the lens of the colour camera; that of other data is refused."""
    sequence = write("capture", tmp_path / "seq", with_colour(recording(frames=4)[0], size=(12, 9)))
    run = reconstruct(sequence, tmp_path / "run", "ctof").path
    config = folder.read_config(run)
    assert config["data_sha256"] == data_hash(read(sequence))
    folder.write_config(run, config | {"data_sha256": former_hash(read(sequence))})
    assert Run.open(run).sequence().frames == 4
    reconstruct(sequence, run, "ctof")
    folder.write_config(run, config | {"data_sha256": former_hash(with_colour(small()))})
    with pytest.raises(InputError, match="not the sequence of the run"):
        Run.open(run).sequence()
    with pytest.raises(UsageError, match="data_sha256"):
        reconstruct(sequence, run, "ctof")


def test_a_folder_of_something_else_is_not_touched(tmp_path):
    """Not even with --fresh."""
    (tmp_path / "precious.txt").write_text("keep")
    for fresh in (False, True):
        with pytest.raises(UsageError, match="not a run"):
            reconstruct(small(), tmp_path, demo(images=4), fresh=fresh)
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_a_refused_run_leaves_nothing(tmp_path):
    """No lock, no log, no folder; a run that was begun keeps all of it."""
    one_frame = recording(frames=1)[0]
    with pytest.raises(InputError, match="no complete quartet"):
        reconstruct(one_frame, tmp_path / "a" / "b", demo(images=4))
    assert not any(tmp_path.iterdir())
    reconstruct(small(), tmp_path / "run", demo(images=4))
    with pytest.raises(UsageError, match="other settings"):
        reconstruct(small(), tmp_path / "run", demo(images=4, background=0.5))
    assert {".lock", "run.log", "config.json"} <= {p.name for p in (tmp_path / "run").iterdir()}


def test_a_lock_that_lost_its_name_is_no_lock(tmp_path, monkeypatch):
    """A holder removed the file just before it was locked: somebody else may lock a new one."""
    (tmp_path / "config.json").write_text("{}")

    def removed_first(descriptor, how, flock=fcntl.flock):
        (tmp_path / ".lock").unlink()
        return flock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", removed_first)
    with pytest.raises(BusyError), folder.locked(tmp_path):
        raise AssertionError("it was taken for a lock")


def test_two_calls_do_not_share_a_folder(tmp_path):
    """The second is told who works there."""
    with (
        folder.locked(tmp_path / "run"),
        pytest.raises(BusyError, match=str(os.getpid())) as caught,
    ):
        reconstruct(small(), tmp_path / "run", demo(images=4))
    assert caught.value.exit_code == 6
    assert reconstruct(small(), tmp_path / "run", demo(images=4)).config["images_optimised"] == 4


def broken_at(monkeypatch, is_broken):
    """Make the loss NaN in steps chosen by the number of calls so far."""
    calls, (first, *others) = [0], TERMS

    def loss(image, out):
        calls[0] += 1
        value = first.loss(image, out)
        return value * float("nan") if is_broken(calls[0]) else value

    terms = replace(first, loss=loss), *others
    monkeypatch.setattr(loop, "Stepper", functools.partial(Stepper, terms=terms))


def test_a_step_without_numbers_is_skipped_and_counted(monkeypatch, tmp_path):
    """The rest of the run does not notice."""
    settings = demo(images=16, batch=Batch.FRAME, log_every=4)
    broken_at(monkeypatch, lambda call: call in (3, 4, 9))
    run = reconstruct(small(), tmp_path / "run", settings)
    assert run.config["skipped"] == 3
    assert all(value.isfinite().all() for value in run.field.parameters().values())
    assert all(np.isfinite(value) for row in rows(run.path) for value in row.values())


def test_many_in_a_row_go_back_with_halved_rates(monkeypatch, tmp_path):
    """Five failures, then the checkpoint before them."""
    settings = demo(images=16, batch=Batch.FRAME)
    broken_at(monkeypatch, lambda call: 4 <= call < 9)
    run = reconstruct(small(), tmp_path / "run", settings)
    final = stored(run.path)
    assert (final["images"], final["rollbacks"], final["rate_factor"], final["skipped"]) == (
        16,
        1,
        0.5,
        5,
    )


def test_a_run_that_stays_without_numbers_ends_as_diverged(monkeypatch, tmp_path):
    """The message names the image; the last good state is kept."""
    settings = demo(images=400, batch=Batch.FRAME)
    broken_at(monkeypatch, lambda call: call > 3)
    with pytest.raises(DivergedError, match=r"(?s)image \d.*5 steps in a row.*Gaussians") as caught:
        reconstruct(small(), tmp_path / "run", settings)
    assert caught.value.exit_code == 4
    assert all(
        value.isfinite().all() for value in Run.open(tmp_path / "run").field.parameters().values()
    )


def test_a_state_survives_being_stored(tmp_path):
    """The next step is the same to the bit."""
    settings = demo(images=40)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    advance(state, observations, settings, 3)
    path = checkpoint.save(tmp_path, to_dict(state))
    again = from_dict(checkpoint.load(path), "cpu")
    assert same(to_dict(again), to_dict(state))
    advance(state, observations, settings)
    advance(again, observations, settings)
    assert same(to_dict(again), to_dict(state))


def test_an_old_run_goes_on_under_settings_that_it_is_too_old_to_know():
    """As if it had said their defaults; with any other value it is another run."""
    new = {"seed": 1, "data_sha256": "x", "settings": plain(presets.released())}
    old = copy.deepcopy(new)
    del old["settings"]["densify"]["unseen_from"], old["settings"]["schedule"]["motion_ramp"]
    assert folder.differences(old, new) == []
    new["settings"] = plain(
        replace(presets.released(), densify=replace(presets.released().densify, unseen_from=300))
    )
    assert folder.differences(old, new) == ["densify.unseen_from was None, now 300"]


def test_a_volume_goes_on_without_settings_that_it_never_read():
    """They are refused now; those of Gaussians were read."""
    for preset, refused in ((presets.volume(), []), (demo(), ["failures_max was 2, now 5"])):
        old = {"settings": plain(replace(preset, failures_max=2))}
        assert folder.differences(old, {"settings": plain(preset)}) == refused
