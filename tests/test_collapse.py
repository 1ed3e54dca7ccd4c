"""A random start behind an opaque veil restarts, a dead motion network is reinitialised;
other runs are left alone.
"""

from dataclasses import replace

import pytest
import torch
from moving_box import recording
from plain_step import plain_loss
from small_runs import advance, rows
from test_published_runs import small

from gftorf_warp.recon import collapse, loop, train
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.presets import demo
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.motion import Products

BLACK = -3.0  # constant harmonic: reflectivity is clamped at zero from -1.77 on, without a gradient


def settings(**more):
    """Judged after 32 of 80 images; a row of metrics is the mean over all 8."""
    wanted = small("released", 80)
    schedule = replace(wanted.schedule, log_every=8)
    return replace(wanted, schedule=schedule, init=replace(wanted.init, count=200), **more)


def veiled_starts(monkeypatch, starts):
    """Let the first ``starts`` starts be black and opaque; returns the seed of each."""
    seeds = []

    def beginning(observations, wanted, *, seed, device):
        state = begin(observations, wanted, seed=seed, device=device)
        seeds.append(seed)
        if len(seeds) <= starts:
            state.optimiser.tensors["reflectivity_sh"].data[:, 0] = BLACK
            state.optimiser.tensors["opacity_logit"].data[:] = 4.0
            # a metre each: they cover everything
            state.optimiser.tensors["log_scale"].data[:] = 0.0
        return state

    for module in (loop, train):
        monkeypatch.setattr(module, "begin", beginning)
    return seeds


def test_when_a_run_is_checked_for_a_veil():
    """After the warm-up and a share of the run, at a row of metrics;
    not where Gaussians start from phase.
    """
    wanted = settings()
    assert collapse.veil_checked_at(wanted) == 32  # one and a half warm-ups of 20
    longer = replace(
        wanted, schedule=replace(wanted.schedule, images=20_000, warm_up=2000, log_every=100)
    )
    assert collapse.veil_checked_at(longer) == 3000
    assert (
        collapse.veil_checked_at(replace(wanted, schedule=replace(wanted.schedule, warm_up=50)))
        is None
    ), "too late"
    assert collapse.veil_checked_at(demo()) is None


def test_the_loss_of_black_images():
    """That of the objective, over all images where there are few."""
    observations = observe(recording(frames=8)[0], settings(), "cpu")
    quads = observations.quads
    each = [
        float(plain_loss(torch.zeros_like(q)[None], q[None], settings().weights.ssim)[0])
        for q in quads
    ]
    want = settings().weights.quads * sum(each) / len(each)
    assert collapse.loss_of_black(observations, settings()) == pytest.approx(want, rel=1e-6)
    assert want > 0.01
    veiled = [share * want for share in (1.9, 1.1, 1.0, 1.01, 0.99, 1.07)]  # a reset at the end
    assert collapse.is_veiled(veiled, observations, settings())
    assert not collapse.is_veiled([*veiled, 0.95 * want], observations, settings()), (
        "seen something once"
    )
    assert not collapse.is_veiled(
        [1.3 * want, 1.2 * want, 1.1 * want, want], observations, settings()
    ), "passing by"
    assert not collapse.is_veiled([], observations, settings())


def test_a_veiled_start_restarts(tmp_path, monkeypatch):
    """With another seed, from image 0, as often as it takes;
    the run that is left is one that sees.
    """
    seeds = veiled_starts(monkeypatch, 2)
    run = reconstruct(recording(frames=8)[0], tmp_path / "run", settings(), seed=5)
    assert seeds == [5, 5 + loop.SEED_STEP, 5 + 2 * loop.SEED_STEP]
    assert run.config["restarts"] == 2
    assert (run.path / "run.log").read_text().count("restarts with another seed") == 2
    found = rows(run.path)
    assert [row["images"] for row in found] == sorted({row["images"] for row in found}), (
        "rows of veiled ones are gone"
    )
    monkeypatch.undo()
    undisturbed = reconstruct(
        recording(frames=8)[0], tmp_path / "other", settings(), seed=seeds[-1]
    )
    for one, other in zip(
        run.field.tensors().values(), undisturbed.field.tensors().values(), strict=True
    ):
        assert torch.equal(one, other), "a start that follows a veiled one is like any other"
    assert undisturbed.config["restarts"] == 0


def test_it_does_not_restart_for_ever(tmp_path, monkeypatch):
    """After so many starts it says so, and goes on."""
    seeds = veiled_starts(monkeypatch, 9)
    run = reconstruct(recording(frames=8)[0], tmp_path / "run", settings(restarts_max=1))
    assert len(seeds) == 2
    assert "it was restarted too often" in (run.path / "run.log").read_text()
    assert run.config["images_optimised"] == 80


def test_an_interrupted_run_remembers_its_starts(tmp_path, monkeypatch):
    """Stopped after it began again, it goes on with the start that it has."""
    veiled_starts(monkeypatch, 1)
    seen = []

    def stop(images, *_, **__):
        seen.append(images)
        if len(seen) > 1 and images < seen[-2]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(recording(frames=8)[0], tmp_path / "run", settings(), progress=stop)
    run = reconstruct(recording(frames=8)[0], tmp_path / "run", settings())
    assert run.config["restarts"] == 1
    assert run.config["images_optimised"] == 80


def learnt(wanted):
    """A state in the middle of the run."""
    observations = observe(recording(frames=8)[0], wanted, "cpu")
    state = begin(observations, wanted, seed=0, device="cpu")
    advance(state, observations, wanted, 24)
    assert state.images == 24
    return state


def kill(motion):
    """No unit of the second layer lets anything through."""
    with torch.no_grad():
        motion.layers[1].bias.fill_(-1e3)
        motion.layers[-1].bias.fill_(-1e3)


@pytest.mark.parametrize("products", [Products.FLOAT32, Products.HALF])
def test_a_dead_network_is_detected(products):
    """In either precision; not before it is trained."""
    wanted = settings()
    wanted = replace(wanted, motion=replace(wanted.motion, products=products))
    state = learnt(wanted)
    assert not collapse.has_dead_network(state, wanted)
    kill(state.motion)
    assert collapse.has_dead_network(state, wanted)
    state.images = wanted.schedule.warm_up
    assert not collapse.has_dead_network(state, wanted)


def test_nodes_are_never_dead():
    """They may all have no displacement."""
    wanted = demo()
    state = begin(observe(recording(frames=8)[0], wanted, "cpu"), wanted, seed=0, device="cpu")
    state.images = 100
    assert not collapse.has_dead_network(state, wanted)


def test_a_reinitialised_network_displaces_nothing_and_learns():
    """Its weights are others, its moments those of the start, everything else stays;
    a stored state knows of it.
    """
    wanted = settings()
    state = learnt(wanted)
    first = state.motion.head.weight.detach().clone()
    mean = state.optimiser.field.mean.detach().clone()
    addresses = [leaf.data_ptr() for leaf in state.optimiser.motion]
    kill(state.motion)
    collapse.revive(state, wanted)
    assert not collapse.has_dead_network(state, wanted)
    assert [leaf.data_ptr() for leaf in state.optimiser.motion] == addresses, "graphs know them"
    assert not torch.equal(state.motion.head.weight, first)
    assert (
        state.motion.at(state.binding, float(state.motion.key_times[1])).offset.abs().max() < 1e-3
    )
    for leaf in state.optimiser.motion:
        assert all(value.abs().max() == 0 for value in state.optimiser.moments_of(leaf))
    torch.testing.assert_close(state.optimiser.field.mean.detach(), mean, rtol=0, atol=0)
    again = from_dict(to_dict(state), "cpu")
    assert (again.revivals, again.revived_at) == (1, 24)


@pytest.mark.parametrize("deaths", [1, 5])
def test_a_run_continues_with_another_network(tmp_path, monkeypatch, deaths):
    """As often as the settings allow; the log says so."""
    wanted, seen = settings(), []
    judge = collapse.has_dead_network

    def judged(state, settings):
        if state.images > settings.schedule.warm_up and len(seen) < deaths:
            seen.append(state.images)
            kill(state.motion)
        return judge(state, settings)

    monkeypatch.setattr(collapse, "has_dead_network", judged)
    run = reconstruct(recording(frames=8)[0], tmp_path / "run", wanted)
    log = (run.path / "run.log").read_text()
    assert log.count("it is reinitialised") == min(deaths, wanted.restarts_max)
    assert ("reinitialised too often" in log) == (deaths > wanted.restarts_max)
    assert run.config["revivals"] == min(deaths, wanted.restarts_max)
