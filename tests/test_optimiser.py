"""Rates, Adam's first step, clipping, and groups that rest."""

import dataclasses
from dataclasses import replace

import pytest
import torch
from small_runs import KEYS, field, random

from gftorf_warp.recon import presets
from gftorf_warp.recon.optimiser import BETAS, Optimiser, betas_of, rates_at
from gftorf_warp.recon.presets import Recorded
from gftorf_warp.recon.settings import Batch, BatchRule, Input, Rates, ReconSettings, Schedule
from gftorf_warp.scene.motion import Nodes, Still

RATES = Rates(mean=1e-2, log_scale=2e-2, quaternion=3e-2, opacity_logit=4e-2, reflectivity_sh=5e-2, motion=6e-2)
SETTINGS = ReconSettings(
    preset="test", rates=RATES, rates_last=RATES.times(0.01), schedule=Schedule(images=1000, warm_up=100)
)


def optimiser():
    """Five Gaussians on three nodes."""
    layer = torch.ones(5, dtype=torch.long)
    motion = Nodes(KEYS, random(3, 3), torch.ones(3, dtype=torch.long))
    return Optimiser(field(random(5, 3), layer), motion), motion


def test_rates_decay_log_linearly_over_the_run():
    """First, half way, last, and beyond."""
    first, half, last, beyond = (rates_at(SETTINGS, images) for images in (100, 500, 1000, 2000))
    for name, rate in dataclasses.asdict(RATES).items():
        assert half[name] == pytest.approx(0.1 * rate)
        assert last[name] == pytest.approx(0.01 * rate)
        assert first[name] == pytest.approx(rate * 0.01**0.1)
    assert beyond == last
    assert rates_at(SETTINGS, 500, factor=0.5)["mean"] == pytest.approx(0.5 * half["mean"])


def test_motion_rests_during_the_warm_up():
    """It neither moves nor gathers moments."""
    assert rates_at(SETTINGS, 99)["motion"] == 0
    assert rates_at(SETTINGS, 100)["motion"] > 0
    assert rates_at(SETTINGS, 99)["mean"] > 0
    adam, motion = optimiser()
    rates = rates_at(SETTINGS, 0)
    gradients = [torch.ones_like(leaf) for leaf in adam.leaves]
    before = motion.offset.detach().clone()
    adam.step(gradients, rates, None)
    torch.testing.assert_close(motion.offset.detach(), before, rtol=0, atol=0)
    assert motion.offset not in adam.adam.state, "a resting group must not gather moments"


def test_the_rate_of_the_motion_rises_from_none():
    """Over its first images, after the warm-up or after it was drawn anew; other rates know nothing of it."""
    settings = replace(SETTINGS, schedule=replace(SETTINGS.schedule, motion_ramp=50))
    plain, ramped = ({n: rates_at(s, n) for n in range(90, 160)} for s in (SETTINGS, settings))
    for images, share in ((99, 0.0), (100, 1 / 50), (124, 0.5), (149, 1.0), (159, 1.0)):
        assert ramped[images]["motion"] == pytest.approx(share * plain[images]["motion"])
        assert ramped[images]["mean"] == plain[images]["mean"]
    assert rates_at(settings, 310, revived_at=300)["motion"] == pytest.approx(
        11 / 50 * rates_at(SETTINGS, 310)["motion"]
    )
    quartets = replace(settings.schedule, batch=Batch.QUARTET, batch_rule=BatchRule.LINEAR)
    fours = replace(settings, schedule=quartets)
    settled = replace(fours, schedule=replace(quartets, motion_ramp=0))
    assert rates_at(fours, 120)["motion"] == pytest.approx(24 / 50 * rates_at(settled, 120)["motion"])


def test_the_first_step_is_the_rate_of_the_group_whatever_the_gradient():
    """Adam's first step is the rate times the sign."""
    adam, motion = optimiser()
    before = {name: value.detach().clone() for name, value in adam.tensors.items()}
    generator = torch.Generator().manual_seed(4)
    gradients = [torch.randn(leaf.shape, generator=generator) * 1e-7 for leaf in adam.leaves]
    adam.step(gradients, rates_at(SETTINGS, 100), None)
    rates = rates_at(SETTINGS, 100)
    for (name, value), gradient in zip(adam.tensors.items(), gradients, strict=False):
        torch.testing.assert_close(value.detach() - before[name], -rates[name] * gradient.sign(), rtol=1e-3, atol=1e-7)
    torch.testing.assert_close(motion.offset.detach(), -rates["motion"] * gradients[-1].sign(), rtol=1e-3, atol=1e-7)


def test_a_tensor_without_gradient_stays():
    """None is no gradient."""
    adam, _ = optimiser()
    before = adam.tensors["mean"].detach().clone()
    gradients = [None, *(torch.ones_like(leaf) for leaf in adam.leaves[1:])]
    adam.step(gradients, rates_at(SETTINGS, 200), 1.0)
    torch.testing.assert_close(adam.tensors["mean"].detach(), before, rtol=0, atol=0)


def test_long_gradients_of_the_motion_are_shortened():
    """Adam forgets the size of a first gradient, so look at its moments."""
    adam, motion = optimiser()
    gradients = [torch.zeros_like(leaf) for leaf in adam.leaves]
    gradients[-1] = 10.0 * torch.ones_like(motion.offset)
    gradients[0] = 10.0 * torch.ones_like(adam.tensors["mean"])
    adam.step(gradients, rates_at(SETTINGS, 200), 1.0)
    assert adam.adam.state[motion.offset]["exp_avg"].norm() == pytest.approx(0.1, rel=1e-4)
    assert adam.adam.state[adam.tensors["mean"]]["exp_avg"].norm() == pytest.approx(15**0.5, rel=1e-4)


def test_a_field_without_motion_has_no_motion_group():
    """Still motion has no parameters."""
    adam = Optimiser(field(random(5, 3), None), Still(KEYS))
    assert [*adam.adam.groups] == [*adam.tensors]
    adam.step([torch.ones_like(leaf) for leaf in adam.leaves], rates_at(SETTINGS, 200), 1.0)
    assert adam.field.mean.isfinite().all()


def test_quartets_may_have_rates_and_moments_of_their_own():
    """Rates times two, or four, decays to the power of four; only where a step compares four images."""
    released = presets.released()
    quartet = replace(released, schedule=replace(released.schedule, batch=Batch.QUARTET))
    assert betas_of(quartet) == pytest.approx((0.6561, 0.996006), rel=1e-6)
    assert betas_of(released) == BETAS
    for name, rate in rates_at(released, 5000).items():
        assert rates_at(quartet, 5000)[name] == pytest.approx(4 * rate)
    root = replace(quartet, schedule=replace(quartet.schedule, batch_rule=BatchRule.ROOT))
    assert betas_of(root) == betas_of(quartet)
    assert rates_at(root, 5000)["mean"] == pytest.approx(2 * rates_at(released, 5000)["mean"])
    without = replace(quartet, schedule=replace(quartet.schedule, batch_rule=BatchRule.NONE))
    phasors = presets.released(Recorded(input=Input.PHASOR))
    phasors = replace(phasors, schedule=replace(phasors.schedule, batch=Batch.QUARTET))
    for same, single in ((without, released), (phasors, presets.released(Recorded(input=Input.PHASOR)))):
        assert betas_of(same) == BETAS
        assert rates_at(same, 5000) == rates_at(single, 5000)
    for settings in (presets.paper(), presets.demo()):
        assert settings.schedule.batch_rule == BatchRule.NONE


def test_decays_of_an_optimiser_are_stored_with_it():
    """And are those of its steps: four gradients are remembered as one of quartets is."""
    adam, motion = optimiser()
    own = Optimiser(adam.field, motion, betas=(0.6561, 0.996))
    gradients = [torch.ones_like(leaf) for leaf in own.leaves]
    own.step(gradients, rates_at(SETTINGS, 200), None)
    first = own.adam.state[own.tensors["mean"]]["exp_avg"]
    torch.testing.assert_close(first, torch.full_like(first, 1 - 0.6561), rtol=1e-5, atol=0)
    assert Optimiser(own.field, motion, own.adam.state_dict()).betas == (0.6561, 0.996)
