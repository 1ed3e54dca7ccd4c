"""Learning rates along a run, and what is stored of Adam."""

import dataclasses
import math
from dataclasses import replace
from io import BytesIO

import pytest
import torch
from comparison import DEVICES
from small_runs import KEYS, advance, demo, field, random, same, small

from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.optimiser import BETAS, STORED, Optimiser, betas_of, rates_at
from gftorf_warp.recon.presets import Recorded
from gftorf_warp.recon.settings import Batch, BatchRule, Input, Rates, ReconSettings, Schedule
from gftorf_warp.recon.state import begin
from gftorf_warp.scene.motion import Nodes, Still

RATES = Rates(
    mean=1e-2,
    log_scale=2e-2,
    quaternion=3e-2,
    opacity_logit=4e-2,
    reflectivity_sh=5e-2,
    motion=6e-2,
)
SETTINGS = ReconSettings(
    preset="test",
    rates=RATES,
    rates_last=RATES.times(0.01),
    schedule=Schedule(images=1000, warm_up=100),
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
    """And only the motion."""
    assert rates_at(SETTINGS, 99)["motion"] == 0
    assert rates_at(SETTINGS, 100)["motion"] > 0
    assert rates_at(SETTINGS, 99)["mean"] > 0


def test_the_rate_of_the_motion_rises_from_none():
    """Over its first images, after the warm-up or after it was drawn anew;
    other rates know nothing of it.
    """
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
    assert rates_at(fours, 120)["motion"] == pytest.approx(
        24 / 50 * rates_at(settled, 120)["motion"]
    )


def test_a_field_without_motion_has_no_motion_group():
    """Still motion has no parameters."""
    still = Optimiser(field(random(5, 3), None), Still(KEYS))
    assert still.groups == [*still.tensors]
    assert len(still.leaves) == len(still.groups)
    moving, motion = optimiser()
    assert moving.groups == [*moving.tensors, "motion"]
    assert moving.leaves[-1] is motion.offset


def test_quartets_may_have_rates_and_moments_of_their_own():
    """Rates times two, or four, decays to the power of four;
    only where a step compares four images.
    """
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
    for fours, single in (
        (without, released),
        (phasors, presets.released(Recorded(input=Input.PHASOR))),
    ):
        assert betas_of(fours) == BETAS
        assert rates_at(fours, 5000) == rates_at(single, 5000)
    for settings in (presets.paper(), presets.demo()):
        assert settings.schedule.batch_rule == BatchRule.NONE


def stepped():
    """Torch's Adam with moments over the tensors of an optimiser:
    what was stored until format 2.
    """
    own, _ = optimiser()
    groups = [
        {"name": name, "params": [leaf]} for name, leaf in zip(own.groups, own.leaves, strict=True)
    ]
    adam = torch.optim.Adam(groups, lr=0.0, betas=(0.6561, 0.996), eps=1e-15, fused=True)
    for n, leaf in enumerate(own.leaves):
        leaf.grad = random(*leaf.shape, seed=n) if n != 1 else None
    adam.step()
    return own, adam


def test_moments_and_decays_are_stored_as_torch_does():
    """Those of torch's Adam are read; what is stored of them has its keys and reads back to the
    bit.
    """
    own, adam = stepped()
    buffer = BytesIO()
    torch.save(adam.state_dict(), buffer)
    buffer.seek(0)
    again, _ = optimiser()
    again = Optimiser(again.field, optimiser()[1], torch.load(buffer, weights_only=True))
    assert again.betas == (0.6561, 0.996)
    for n, (leaf, twin) in enumerate(zip(own.leaves, again.leaves, strict=True)):
        moments = again.moments_of(twin)
        if n == 1:
            assert not any(moment.any() for moment in moments), "it had no gradient"
            continue
        assert all(
            torch.equal(moment, adam.state[leaf][name])
            for moment, name in zip(moments, STORED, strict=True)
        )
    stored, torchs = again.state_dict(), adam.state_dict()
    assert stored["state"].keys() - torchs["state"].keys() <= {1}
    assert [group["params"] for group in stored["param_groups"]] == [
        g["params"] for g in torchs["param_groups"]
    ]
    third = Optimiser(again.field, optimiser()[1], stored)
    for twin, leaf in zip(again.leaves, third.leaves, strict=True):
        assert same(again.moments_of(twin), third.moments_of(leaf))


def test_moments_of_other_groups_are_refused():
    """They are of another field."""
    own, adam = stepped()
    with pytest.raises(ValueError, match="tensors per group"):
        Optimiser(own.field, Still(KEYS), adam.state_dict())


def test_moments_are_zero_at_first_and_can_be_forgotten():
    """Of one tensor without its number of steps; of the motion with it."""
    own, adam = stepped()
    again = Optimiser(own.field, optimiser()[1], adam.state_dict())
    fresh, _ = optimiser()
    assert not any(moment.any() for leaf in fresh.leaves for moment in fresh.moments_of(leaf))
    again.forget("mean")
    step, *both = again.moments_of(again.tensors["mean"])
    assert (float(step), any(moment.any() for moment in both)) == (1.0, False)
    again.forget_motion()
    assert not any(moment.any() for moment in again.moments_of(again.motion[0]))
    assert again.moments_of(again.tensors["quaternion"])[1].any()


@pytest.mark.parametrize("device", DEVICES)
def test_scales_stay_below_their_limit(device):
    """After every step, those of the start included; without a limit they do not."""
    found = {}
    for limit in (None, 0.05):
        settings = demo(scale_max=limit)
        observations = observe(small(), settings, device)
        state = begin(observations, settings, seed=0, device=device)
        advance(state, observations, settings, 3)
        found[limit] = state.optimiser.field.log_scale.detach()
    assert (found[None] > math.log(0.05)).any()
    assert found[0.05].max().item() == pytest.approx(math.log(0.05))
    assert (found[0.05] < math.log(0.05) - 1e-3).any()
    with pytest.raises(ValueError, match="scale_max must be above 0"):
        demo(scale_max=0.0)
