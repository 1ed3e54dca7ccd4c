"""Gaussians at rest: who they are, that they stay, wake up and are stored, in single and in captured steps."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import KEYS, demo, field, random, same, small, stored
from test_captured_steps import DEVICES, alike, begun, published

from gftorf_warp.errors import InputError
from gftorf_warp.recon import checkpoint, gating, presets, step
from gftorf_warp.recon.captured import CapturedSteps
from gftorf_warp.recon.gating import Asking, is_due, judge_after
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch, GateSettings, Kernels
from gftorf_warp.recon.state import from_dict, to_dict
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.motion import MotionSettings
from gftorf_warp.scene.network import Network
from gftorf_warp.scene.still import rests

ON = GateSettings(still_pixels=True, margin=0, every=10)


def gated(make=published, **changes):
    """A short run with a gate, with Gaussians so small that some of them are at rest."""
    settings = make(**changes)
    return replace(settings, gate=ON, rates=settings.rates.times(0.1), init=replace(settings.init, count=600))


def begun_small(settings, device="cpu"):
    """As ``begun``, at a tenth of the size."""
    state, observations = begun(settings, device)
    with torch.no_grad():
        state.optimiser.tensors["log_scale"] -= 2.5 if settings.preset == "released" else 0.5
    return state, observations


def swaying(motion):
    """Let a network say something: far from rest, other at every place."""
    with torch.no_grad():
        weight = motion.head.weight
        weight += (3e-3 * random(*weight.shape)).to(weight)


def demo_gated(**changes):
    """The demo preset, whose motion is that of nodes."""
    return gated(lambda **more: demo(images=60, kernels=Kernels.STEP, **more), **changes)


def test_who_only_still_pixels_see_sleeps_and_wakes_up():
    """A judgement is about where Gaussians are, whatever they were; the layer they belong to is not forgotten."""
    settings = gated()
    state, observations = begun_small(settings)
    assert (state.optimiser.layer == 1).all()
    state.images = 6
    assert judge_after(state, 4, observations, settings)
    asleep = rests(state.optimiser.field, observations.still, observations.cameras[0])
    assert 0.1 < asleep.float().mean() < 0.9
    assert torch.equal(state.optimiser.layer, 1 - 2 * asleep.long())
    moved = (state.motion.key_offset(state.attachment, 1) != 0).any(dim=1)
    assert torch.equal(moved, ~asleep)
    observations = replace(observations, still=~observations.still)
    state.images = 10
    assert judge_after(state, 9, observations, settings)
    assert (state.optimiser.layer[asleep] == 1).all()
    assert not judge_after(state, 10, observations, settings)


def test_what_never_moved_goes_on_so():
    """The static layer of a start from phase is nobody's to wake up, nodes or not."""
    settings = demo_gated()
    state, observations = begun_small(settings)
    static = state.optimiser.layer == 0
    assert 0 < static.sum() < len(static)
    state.images = 4
    attached = state.attachment
    changing = replace(observations, still=torch.zeros_like(observations.still))
    assert not judge_after(state, 0, changing, settings)
    assert torch.equal(state.optimiser.layer, (~static).long())
    assert state.attachment is attached, "nodes stay attached as they were"
    assert judge_after(state, 0, replace(observations, still=torch.ones_like(observations.still)), settings)
    assert torch.equal(state.optimiser.layer[static], torch.zeros(int(static.sum()), dtype=torch.long))
    assert (state.optimiser.layer[~static] == -1).any()
    assert not state.motion.key_offset(state.attachment, 1)[state.optimiser.layer < 0].any()


def test_judgements_come_at_the_end_of_the_warm_up_after_rounds_and_regularly():
    """Warm-up is 6 images here, rounds come every 8 from 16 to 32; frozen Gaussians stay where they are."""
    frozen = gated()
    frozen = replace(frozen, schedule=replace(frozen.schedule, freeze_from=0.5))
    settings = replace(frozen, schedule=replace(frozen.schedule, freeze_from=None))
    assert [n for n in range(1, 60) if is_due(n - 1, n, settings)] == [6, 10, 16, 20, 24, 30, 32, 40, 50]
    assert [n for n in range(1, 60) if is_due(n - 1, n, frozen)] == [6, 10, 16, 20, 24, 30]
    at_once = replace(settings, schedule=replace(settings.schedule, warm_up=0))
    assert [n for n in range(4, 13, 4) if is_due(n - 4, n, at_once)] == [4, 12]
    off = replace(settings, gate=GateSettings(every=1))
    assert not any(is_due(n - 1, n, off) for n in range(60))


class Counting(Network):
    """A network that remembers how many asked."""

    def __init__(self):
        settings = MotionSettings(layers=1, width=8)
        super().__init__(KEYS, settings, duration=1.0, length=1.0, generator=torch.Generator().manual_seed(0))
        self.told = []

    def offsets(self, attachment, moment):
        """As a network, and counted."""
        self.told.append(len(attachment))
        return super().offsets(attachment, moment)


def test_whole_buckets_ask_and_only_who_is_awake_is_moved(monkeypatch):
    """20 awake of 200 and 56 dead rows: two buckets of 16 ask, with a gradient of those 20 alone."""
    monkeypatch.setattr(gating, "BUCKET", 16)
    motion = Counting()
    swaying(motion)
    layer = torch.full((256,), -1)
    layer[30:50] = 1
    layer[200:] = 0
    everybody = field(random(256, 3), layer)
    asking = Asking(motion, gated=True)
    assert asking.counts is None
    assert asking.follow(layer), "nothing lay anywhere before"
    assert asking.counts == (20, 32)
    keys = torch.tensor([1, 2], dtype=torch.int32)
    motion.told.clear()
    found = asking.offsets(everybody, None, keys)
    attached = asking.offsets(everybody, motion.attach_at(everybody.mean), keys)
    want = motion.key_offsets(motion.attach(everybody), [1, 2])
    assert motion.told == [32, 32, 20]
    torch.testing.assert_close(found, want)
    assert torch.equal(found, attached)
    assert torch.equal((found != 0).any(dim=2).all(dim=0), layer > 0)
    parameters = list(motion.parameters())
    cotangent = random(2, 256, 3, seed=1)
    gradients = [torch.autograd.grad((offsets * cotangent).sum(), parameters) for offsets in (found, want)]
    for got, expected in zip(*gradients, strict=True):
        assert expected.abs().max() > 0
        torch.testing.assert_close(got, expected)
    assert not asking.follow(torch.where(torch.arange(256) < 30, 1, 0)), "as many buckets as before"
    assert asking.counts == (30, 32)
    assert asking.follow(torch.where(torch.arange(256) < 40, 1, 0)), "more of them"
    assert asking.counts == (40, 48)
    assert asking.follow(torch.zeros(256, dtype=torch.long))
    assert not asking.offsets(everybody, None, keys).any()
    assert not Asking(motion, gated=False).follow(layer)


def test_nobody_at_all_is_awake():
    """Nobody asks, nothing is moved, and there is nothing to learn."""
    motion = Counting()
    everybody = field(random(5, 3), torch.full((5,), -1))
    found = motion.key_offsets(motion.attach(everybody), [0, 1])
    assert found.shape == (2, 5, 3)
    assert not found.any()
    assert motion.told == []


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
@pytest.mark.parametrize("make", [gated, demo_gated], ids=["network", "nodes"])
def test_captured_steps_are_single_steps(make, batch, device, monkeypatch):
    """With some at rest and some awake, through judgements, rounds and a reset."""
    monkeypatch.setattr(gating, "BUCKET", 64)
    settings = make(batch=batch)
    single, observations = begun_small(settings, device)
    whole, _ = begun_small(settings, device)
    right = torch.arange(observations.still.shape[1], device=device) >= 20  # of the sliding box, some
    observations = replace(observations, still=right.expand_as(observations.still))
    if make is gated:
        swaying(single.motion)
        swaying(whole.motion)
    steps, shares = CapturedSteps(whole, observations, settings), set()
    while single.images < 40:
        assert step.step(single, observations, settings) is None
        steps.step()
        assert torch.equal(single.optimiser.layer, whole.optimiser.layer)
        shares.add(int((whole.optimiser.layer < 0).sum()))
    assert steps.collect() == 0
    assert max(shares) > 0, "some slept"
    alike(single, whole)


@pytest.mark.parametrize("freeze", [None, 0.5])
def test_steps_whose_gaussians_are_all_awake_are_steps_without_a_gate(freeze):
    """Where no pixel is still."""
    settings = gated()
    settings = replace(settings, schedule=replace(settings.schedule, freeze_from=freeze))
    some, observations = begun(settings)
    whole, _ = begun(settings)
    observations = replace(observations, still=torch.zeros_like(observations.still))
    steps = CapturedSteps(some, observations, settings)
    other = CapturedSteps(whole, observations, replace(settings, gate=GateSettings()))
    while whole.images < 40:
        steps.step()
        other.step()
    assert steps.asking.counts[0] == len(some.optimiser.field)
    assert other.asking.counts is None
    assert steps.collect() == other.collect() == 0
    alike(whole, some)


@pytest.mark.parametrize("kernels", [Kernels.LOSS, Kernels.GRAPH])
def test_a_finished_run_moves_who_was_awake_and_an_interrupted_one_goes_on(tmp_path, kernels):
    """What is stored is what training saw, to the bit."""
    settings = replace(gated(), kernels=kernels)
    run = reconstruct(small(), tmp_path / "whole", settings, images=60)
    layer = run.field.layer
    assert 0 < (layer < 0).sum() < len(layer)
    offsets = run.motion.key_offsets(run.attachment, [0, 1, 2])
    assert torch.equal((offsets != 0).any(dim=2).all(dim=0), layer > 0)
    kept = checkpoint.last(run.path)
    half = from_dict(kept, "cpu")
    assert torch.equal(half.attachment, run.attachment)
    images = run.renderer(["quads"])(0.05, run.camera).quads
    torch.testing.assert_close(images, run.render(0.05).quads, rtol=1e-5, atol=1e-6)
    everybody = replace(run, attachment=run.motion.attach(replace(run.field, layer=None)))
    assert not torch.equal(everybody.render(0.05).quads, run.render(0.05).quads)
    state, observations = begun(settings)
    single = step.Singles(state, observations, settings)
    while state.images < 24:
        single.step()
    again = from_dict(copy.deepcopy(to_dict(state)), "cpu")
    other = step.Singles(again, observations, settings)
    while state.images < 40:
        single.step()
        other.step()
    assert same(*({**to_dict(one), "seconds": 0} for one in (state, again)))


def test_what_an_older_version_stored_asks_for_everybody(tmp_path):
    """Its layers said nothing to a network, static ones included."""
    run = reconstruct(small(), tmp_path / "run", published(batch=Batch.QUARTET), images=8)
    old = stored(run.path) | {"seconds": 0.0, "format": 2}
    old["field"]["layer"] = torch.zeros_like(old["field"]["layer"])
    checkpoint.save(run.path, old)
    opened = Run.open(run.path)
    assert opened.motion.key_offset(opened.attachment, 1).any(dim=1).all()
    old["format"] = 3
    checkpoint.save(run.path, old)
    opened = Run.open(run.path)
    assert not opened.motion.key_offset(opened.attachment, 1).any()


def test_a_network_is_asked_for_everybody_who_is_not_at_rest():
    """A start from measured phase knows a static layer: nodes pin it, a network decides for itself."""
    state, _ = begun(replace(published(), init=demo().init))
    assert (state.optimiser.layer == 1).all()
    assert state.motion.key_offset(state.attachment, 1).any(dim=1).all()


def test_a_moving_camera_has_no_still_pixels():
    """Said before anything is written."""
    sequence = small()
    poses = sequence.camera_from_world.copy()
    poses[:, 0, 3] += 1e-3 * np.arange(sequence.frames)
    with pytest.raises(InputError, match=r"gate\.still_pixels") as error:
        observe(replace(sequence, camera_from_world=poses), gated(), "cpu")
    assert "leave gate.still_pixels=true out" in error.value.fix


def test_no_preset_has_a_gate_and_a_short_run_has_short_intervals():
    """Every approximation is asked for by name."""
    assert not any(presets.preset(name).gate.still_pixels for name in presets.PRESETS)
    assert observe(small(), demo(), "cpu").still is None
    whole = presets.preset("released")
    short = presets.shortened(replace(whole, gate=GateSettings(still_pixels=True)), whole.schedule.images // 10)
    assert short.gate == GateSettings(still_pixels=True, every=50)


@pytest.mark.parametrize("wrong", [{"every": 0}, {"margin": -1}])
def test_settings_that_make_no_sense(wrong):
    """Refused where they are made."""
    with pytest.raises(ValueError, match="must be"):
        GateSettings(**wrong)
