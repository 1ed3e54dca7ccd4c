"""A motion network that died is noticed and drawn anew; one that lives, and motion of other kinds, are left alone."""

from dataclasses import replace

import pytest
import torch
from moving_box import recording
from test_published_runs import small

from gftorf_warp.recon import dead, train
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.presets import demo
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.step import Singles
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.motion import Products


def settings():
    """The published network, made small, with a row of metrics every 12 images; it learns from the 31st on."""
    wanted = small("released", 120)
    return replace(wanted, schedule=replace(wanted.schedule, log_every=12))


def learnt(wanted):
    """A state in the middle of the run."""
    observations = observe(recording(frames=12)[0], wanted, "cpu")
    state = begin(observations, wanted, seed=0, device="cpu")
    steps = Singles(state, observations, wanted)
    while state.images < 48:
        steps.step()
    return state


def kill(motion):
    """No unit of the second layer lets anything through."""
    with torch.no_grad():
        motion.layers[1].bias.fill_(-1e3)
        motion.layers[-1].bias.fill_(-1e3)


@pytest.mark.parametrize("products", [Products.FLOAT32, Products.HALF])
def test_dead_or_alive(products):
    """Whatever the precision; before it may learn a network is not judged."""
    wanted = settings()
    wanted = replace(wanted, motion=replace(wanted.motion, products=products))
    state = learnt(wanted)
    assert not dead.is_dead(state, wanted)
    kill(state.motion)
    assert dead.is_dead(state, wanted)
    state.images = wanted.schedule.warm_up
    assert not dead.is_dead(state, wanted)


def test_nodes_do_not_die():
    """They may all be at rest."""
    wanted = demo()
    state = begin(observe(recording(frames=8)[0], wanted, "cpu"), wanted, seed=0, device="cpu")
    state.images = 100
    assert not dead.is_dead(state, wanted)


def test_a_revived_network_is_at_rest_and_learns():
    """Its weights are others, its moments those of the start, everything else stays; a stored state knows of it."""
    wanted = settings()
    state = learnt(wanted)
    first = state.motion.head.weight.detach().clone()
    mean = state.optimiser.field.mean.detach().clone()
    addresses = [leaf.data_ptr() for leaf in state.optimiser.motion]
    kill(state.motion)
    dead.revive(state, wanted)
    assert not dead.is_dead(state, wanted)
    assert [leaf.data_ptr() for leaf in state.optimiser.motion] == addresses, "graphs know them"
    assert not torch.equal(state.motion.head.weight, first)
    assert state.motion.at(state.binding, float(state.motion.key_times[1])).offset.abs().max() < 1e-3
    for leaf in state.optimiser.motion:
        assert all(value.abs().max() == 0 for value in state.optimiser.moments_of(leaf))
    torch.testing.assert_close(state.optimiser.field.mean.detach(), mean, rtol=0, atol=0)
    again = from_dict(to_dict(state), "cpu")
    assert (again.revivals, again.revived_at) == (1, 48)


@pytest.mark.parametrize("deaths", [1, 5])
def test_a_run_goes_on_with_another_network(tmp_path, monkeypatch, deaths):
    """As often as the settings allow; the log says so."""
    wanted, seen = settings(), []
    judge = dead.is_dead

    def judged(state, settings):
        if state.images > settings.schedule.warm_up and len(seen) < deaths:
            seen.append(state.images)
            kill(state.motion)
        return judge(state, settings)

    monkeypatch.setattr(train.dead, "is_dead", judged)
    run = reconstruct(recording(frames=12)[0], tmp_path / "run", wanted)
    log = (run.path / "run.log").read_text()
    assert log.count("begins again at rest") == min(deaths, wanted.restarts_max)
    assert ("stays so" in log) == (deaths > wanted.restarts_max)
    assert run.config["revivals"] == min(deaths, wanted.restarts_max)
