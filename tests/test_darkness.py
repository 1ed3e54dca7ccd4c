"""A random start that turned black is noticed and begins again; whoever sees anything is left alone."""

from dataclasses import replace

import pytest
import torch
from gftorf_warp.recon.objective import image_loss
from moving_box import recording
from small_runs import rows
from test_published_runs import small

from gftorf_warp.recon import darkness, train
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.presets import demo
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.train import reconstruct

BLACK = -3.0  # constant harmonic: reflectivity is clamped at zero from -1.77 on, without a gradient


def settings(**more):
    """Judged after 48 of 120 images; a row of metrics is the mean over all 12."""
    wanted = small("released", 120)
    return replace(wanted, schedule=replace(wanted.schedule, log_every=12), **more)


def blinded(monkeypatch, starts):
    """Let the first ``starts`` beginnings be black and opaque, and note the seed of each."""
    seeds = []

    def beginning(observations, wanted, *, seed, device):
        state = begin(observations, wanted, seed=seed, device=device)
        seeds.append(seed)
        if len(seeds) <= starts:
            state.optimiser.tensors["reflectivity_sh"].data[:, 0] = BLACK
            state.optimiser.tensors["opacity_logit"].data[:] = 4.0
            state.optimiser.tensors["log_scale"].data[:] = 0.0  # a metre each: they cover everything
        return state

    monkeypatch.setattr(train, "begin", beginning)
    return seeds


def test_when_it_is_judged():
    """After the warm-up and a share of the run, at a row of metrics; not where Gaussians start from phase."""
    wanted = settings()
    assert darkness.judged_at(wanted) == 48  # one and a half warm-ups of 30
    longer = replace(wanted, schedule=replace(wanted.schedule, images=20_000, warm_up=2000, log_every=100))
    assert darkness.judged_at(longer) == 3000
    assert darkness.judged_at(replace(wanted, schedule=replace(wanted.schedule, warm_up=50))) is None, "too late"
    assert darkness.judged_at(demo()) is None


def test_the_loss_of_black_images():
    """That of the objective, over all images where there are few."""
    observations = observe(recording(frames=8)[0], settings(), "cpu")
    quads = observations.quads
    each = [float(image_loss(torch.zeros_like(q)[None], q[None], settings().weights.ssim)[0]) for q in quads]
    want = settings().weights.quads * sum(each) / len(each)
    assert darkness.loss_of_black(observations, settings()) == pytest.approx(want, rel=1e-6)
    assert want > 0.01
    dark = [share * want for share in (1.9, 1.1, 1.0, 1.01, 0.99, 1.07)]  # a reset at the end
    assert darkness.is_dark(dark, observations, settings())
    assert not darkness.is_dark([*dark, 0.95 * want], observations, settings()), "seen something once"
    assert not darkness.is_dark([1.3 * want, 1.2 * want, 1.1 * want, want], observations, settings()), "passing by"
    assert not darkness.is_dark([], observations, settings())


def test_a_dark_start_begins_again(tmp_path, monkeypatch):
    """With another seed, from image 0, as often as it takes; the run that is left is one that sees."""
    seeds = blinded(monkeypatch, 2)
    run = reconstruct(recording(frames=12)[0], tmp_path / "run", settings(), seed=5)
    assert seeds == [5, 5 + train.OTHER_SEED, 5 + 2 * train.OTHER_SEED]
    assert run.config["restarts"] == 2
    assert (run.path / "run.log").read_text().count("begins again with another seed") == 2
    found = rows(run.path)
    assert [row["images"] for row in found] == sorted({row["images"] for row in found}), "rows of dark starts are gone"
    monkeypatch.undo()
    undisturbed = reconstruct(recording(frames=12)[0], tmp_path / "other", settings(), seed=seeds[-1])
    for one, other in zip(run.field.tensors().values(), undisturbed.field.tensors().values(), strict=True):
        assert torch.equal(one, other), "a start that follows a dark one is like any other"
    assert undisturbed.config["restarts"] == 0


def test_it_does_not_begin_for_ever(tmp_path, monkeypatch):
    """After so many starts it says so, and goes on."""
    seeds = blinded(monkeypatch, 9)
    run = reconstruct(recording(frames=12)[0], tmp_path / "run", settings(restarts_max=1))
    assert len(seeds) == 2
    assert "goes on all the same" in (run.path / "run.log").read_text()
    assert run.config["images_optimised"] == 120


def test_an_interrupted_run_remembers_its_starts(tmp_path, monkeypatch):
    """Stopped after it began again, it goes on with the start that it has."""
    blinded(monkeypatch, 1)
    seen = []

    def stop(images, *_, **__):
        seen.append(images)
        if len(seen) > 1 and images < seen[-2]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(recording(frames=12)[0], tmp_path / "run", settings(), progress=stop)
    run = reconstruct(recording(frames=12)[0], tmp_path / "run", settings())
    assert run.config["restarts"] == 1
    assert run.config["images_optimised"] == 120
