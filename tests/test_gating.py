"""Gaussians at rest that do not ask the motion network: who they are, what they take, and that they wake up."""

from dataclasses import replace

import pytest
import torch
from small_runs import KEYS, field, random
from test_captured_steps import DEVICES, alike, begun, published

from gftorf_warp.recon import gating, presets, step
from gftorf_warp.recon.captured import CapturedSteps, steps_of
from gftorf_warp.recon.gating import Gate
from gftorf_warp.recon.settings import Batch, GateSettings, Kernels
from gftorf_warp.scene.motion import MotionSettings
from gftorf_warp.scene.network import Network

GATE = 1e-3  # [m]
ROWS, COUNT = 256, 200


class Swaying(Network):
    """Each Gaussian goes to and fro as far as it says."""

    def __init__(self, far):
        super().__init__(KEYS, MotionSettings(layers=1, width=8), duration=1.0, length=1.0)
        self.far = torch.nn.Parameter(far)

    def attach_at(self, mean):
        """The number of a Gaussian is its place."""
        return mean[:, :1]

    def key_offsets(self, attachment, keys):
        """Minus or plus so far, by turns."""
        sides = torch.tensor([-1.0, 1.0, -1.0, 1.0])[keys.long()]
        away = sides[:, None] * self.far[attachment[:, 0].long()]
        return torch.stack([away, torch.ones_like(away), torch.ones_like(away)], dim=2)  # a constant is rest


@pytest.fixture
def swaying(monkeypatch):
    """A gate in front of 200 Gaussians, and rows behind them; the first twenty move by ten gates."""
    monkeypatch.setattr(gating, "BUCKET", 16)
    far = torch.where(torch.arange(ROWS) < 20, 10 * GATE, 0.3 * GATE)
    motion = Swaying(far)
    settings = replace(published(), gate=GateSettings(distance=GATE, after=4, every=10))
    places = torch.arange(ROWS)[:, None].float().repeat(1, 3)
    return Gate(settings, motion), motion, field(places, None)


def test_who_moves_asks(swaying):
    """Twenty are awake, two buckets ask; those beside them are the first that follow."""
    gate, motion, everybody = swaying
    with torch.no_grad():
        motion.far[100:112] = 0.4 * GATE
    assert gate.counts is None
    assert gate.judge(everybody, COUNT), "nothing lay anywhere before"
    assert gate.awake.nonzero()[:, 0].tolist() == list(range(20))
    assert gate.active.tolist() == [*range(20), *range(100, 112)]
    assert gate.counts == (20, 32)
    assert not gate.is_shut(8)
    assert gate.is_shut(9), "one in eight steps asks everybody"
    assert not gate.judge(everybody, COUNT), "and now everything lies where it did"


def test_rest_begins_at_half_and_ends_at_the_whole(swaying):
    """In between a Gaussian stays as it is."""
    gate, motion, everybody = swaying
    course = [(0.7, True), (0.4, False), (0.7, False), (1.1, True), (0.7, True), (0.4, False)]
    for share, awake in course:
        with torch.no_grad():
            motion.far[50] = share * GATE
        gate.judge(everybody, COUNT)
        assert bool(gate.awake[50]) is awake, share
    assert not gate.awake[COUNT:].any()


def test_what_rests_is_kept_exactly_and_has_no_gradient(swaying):
    """Whatever the network has come to say in between; who is active follows it."""
    gate, motion, everybody = swaying
    with torch.no_grad():
        motion.far[100:112] = 0.4 * GATE
    gate.judge(everybody, COUNT)
    keys = torch.tensor([1, 2], dtype=torch.int32)
    kept = motion.key_offsets(motion.attach(everybody), keys).detach()
    with torch.no_grad():
        motion.far += 0.25
    found = gate.offsets(everybody, None, keys, gated=True)
    assert torch.equal(found, gate.offsets(everybody, motion.attach(everybody), keys, gated=True))
    rests = torch.ones(ROWS, dtype=torch.bool)
    rests[gate.active] = False
    assert torch.equal(found[:, rests], kept[:, rests])
    now = gate.offsets(everybody, None, keys, gated=False)
    assert torch.equal(found[:, ~rests], now[:, ~rests])
    found[:, :, 0].abs().sum().backward()
    assert torch.equal(motion.far.grad != 0, ~rests)


def test_who_rests_wakes_up(swaying):
    """If it moves, or if the network has come to hold it elsewhere: another constant is no motion, but no rest."""
    gate, motion, everybody = swaying
    gate.judge(everybody, COUNT)
    assert not gate.awake[60:62].any()
    with torch.no_grad():
        motion.far[60] = 5 * GATE
    gate.table[:, 61] += 2 * GATE
    gate.judge(everybody, COUNT)
    assert gate.awake[60:62].all()
    assert int(gate.awake.sum()) == 22
    assert {60, 61} <= set(gate.active.tolist())


def test_copies_are_taken_for_what_they_come_from(swaying):
    """After a round: rows removed, one copied; tables and lists go along, and more rows are more buckets."""
    gate, _, everybody = swaying
    gate.judge(everybody, COUNT)
    table = gate.table.clone()
    origin = torch.cat([torch.arange(10, COUNT), torch.tensor([10, 150])])
    assert not gate.follow(origin, ROWS), "as many buckets as before"
    assert gate.awake.nonzero()[:, 0].tolist() == [*range(10), 190]
    assert torch.equal(gate.table[:, : len(origin)], table[:, origin])
    assert not gate.follow(None, ROWS)
    assert gate.follow(torch.arange(10).repeat(30), 320), "elsewhere, since all of these move"
    assert len(gate.active) == 304
    assert gate.awake[:300].all()
    assert not gate.awake[300:].any()


def test_judgements_begin_late_and_come_regularly(swaying):
    """Warm-up is 6 images here, and then 4 more; the first one is not missed by whoever begins later."""
    gate, _, everybody = swaying
    assert [n for n in range(1, 30) if gate.is_due(n - 1, n)] == list(range(10, 30))
    gate.judge(everybody, COUNT)
    assert [n for n in range(1, 45) if gate.is_due(n - 1, n)] == [10, 20, 30, 40]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
@pytest.mark.parametrize("freeze", [None, 0.5])
def test_steps_whose_gaussians_are_all_awake_are_steps_without_a_gate(batch, device, freeze):
    """With a gate of nothing, rounds and a reset included; half of the rows are dead, and do not ask."""
    settings = published(batch=batch)
    settings = replace(settings, schedule=replace(settings.schedule, freeze_from=freeze))
    gated = replace(settings, gate=GateSettings(distance=1e-12, after=2, every=5, open_every=3))
    whole, observations = begun(settings, device)
    some, _ = begun(settings, device)
    steps, other = CapturedSteps(whole, observations, settings), CapturedSteps(some, observations, gated)
    shut = 0
    while whole.images < 40:
        steps.step()
        shut += other.gate.is_shut(some.images // (1 if batch == Batch.FRAME else 4))
        other.step()
    assert shut >= 4
    assert len(other.gate.active) < other.padded.rows
    assert int(other.gate.awake.sum()) == len(some.optimiser.field)
    assert steps.collect() == other.collect() == 0
    alike(whole, some)


@pytest.mark.parametrize("device", DEVICES)
def test_a_gate_stays_at_the_right_rows_through_a_run(device, monkeypatch):
    """Rounds come and go between judgements: nobody is lost, and steps are sound."""
    monkeypatch.setattr(gating, "BUCKET", 16)
    settings = published(batch=Batch.FRAME)
    settings = replace(settings, rates=settings.rates.times(0.1), gate=GateSettings(distance=4.4e-3, after=2, every=20))
    state, observations = begun(settings, device)
    with torch.no_grad():  # far from rest, so that some move by more than others
        head = state.motion.head.weight
        head += (4e-3 * random(*head.shape)).to(device)
    steps, counts = CapturedSteps(state, observations, settings), set()
    while state.images < 50:
        steps.step()
        if state.images < 9:
            continue
        gate, count = steps.gate, len(state.optimiser.field)
        counts.add(count)
        active = torch.zeros(steps.padded.rows, dtype=torch.bool, device=device)
        active[gate.active] = True
        assert active[gate.awake].all(), "whoever is awake asks"
        assert len(gate.awake) == steps.padded.rows
        assert not gate.awake[count:].any()
        assert 0 < int(gate.awake.sum()) < count
        assert len(gate.active) < count
    assert len(counts) > 1, "rounds did change something"
    assert steps.collect() == 0
    assert all(leaf.isfinite().all() for leaf in state.optimiser.leaves)


def test_no_preset_has_a_gate_and_a_short_run_has_short_intervals():
    """Every approximation is asked for by name."""
    assert all(presets.preset(name).gate.distance is None for name in presets.PRESETS)
    whole = presets.preset("released")
    short = presets.shortened(replace(whole, gate=GateSettings(distance=GATE)), whole.schedule.images // 10)
    assert short.gate == GateSettings(distance=GATE, every=50, after=100)


def test_single_steps_say_that_they_have_no_gate(caplog):
    """They ignore it, aloud."""
    settings = replace(published(), kernels=Kernels.LOSS, gate=GateSettings(distance=GATE))
    state, observations = begun(settings)
    with caplog.at_level("INFO", "gftorf_warp"):
        assert isinstance(steps_of(state, observations, settings), step.Singles)
    assert "gate.distance is known to captured steps only" in caplog.text


@pytest.mark.parametrize("wrong", [{"distance": 0.0}, {"every": 0}, {"after": -1}, {"open_every": 0}])
def test_settings_that_make_no_sense(wrong):
    """Refused where they are made."""
    with pytest.raises(ValueError, match="must be"):
        GateSettings(**wrong)
