"""Numbers between host and device: what was sent is what is read, in its order,
and what is asked for is told once.
"""

import math
from dataclasses import replace

import pytest
import torch
from test_stepper import begun, published

from gftorf_warp.recon import stepper
from gftorf_warp.recon.padded import PaddedParameters
from gftorf_warp.recon.settings import Batch
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.render.cuda import SLOTS, DeviceReadback, DeviceUpload
from gftorf_warp.render.pair_capacity import READ_EVERY, PairCapacity

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]
INTEGERS = [0, -1, 2**31 - 1, -(2**31), 7]
REALS = [0.1, -0.0, 1e-45, math.inf, -math.inf, math.nan, 3e38]


def outbox(device):
    """Room for both kinds of numbers, integers first."""
    made = DeviceUpload(
        [(len(INTEGERS), torch.int32), (len(REALS), torch.float32)], torch.device(device)
    )
    return made, *made.parts


def bits(tensor):
    """Of numbers of 32 bits, on the CPU."""
    return tensor.cpu().contiguous().view(torch.int32)


@pytest.mark.parametrize("device", DEVICES)
def test_both_kinds_arrive_to_the_bit(device):
    """In one memory, each read as what it is; numbers that are none, too."""
    made, integers, reals = outbox(device)
    assert (integers.dtype, reals.dtype) == (torch.int32, torch.float32)
    assert not integers.any()
    assert not reals.any()
    assert reals.data_ptr() == integers.data_ptr() + 4 * len(INTEGERS)
    made.send(INTEGERS, REALS)
    assert integers.tolist() == INTEGERS
    assert torch.equal(bits(reals), bits(torch.tensor(REALS)))


@pytest.mark.parametrize("device", DEVICES)
def test_a_shorter_list_says_nothing_of_the_rest(device):
    """What is said arrives all the same; a kind that is left out is a mistake."""
    made, integers, reals = outbox(device)
    made.send([5], [0.5, 0.25])
    assert (integers[0], reals[:2].tolist()) == (5, [0.5, 0.25])
    made.send([], [1.5])
    assert reals[0] == 1.5
    with pytest.raises(ValueError, match="zip"):
        made.send([5])


@pytest.mark.parametrize("device", DEVICES)
def test_every_step_reads_its_own_numbers(device):
    """Though the host is ahead, more often than there are slots;
    where they are read stays the same.
    """
    made, integers, reals = outbox(device)
    places = integers.data_ptr(), reals.data_ptr()
    steps = 5 * SLOTS
    found = torch.zeros(steps, 2, device=device)
    for step in range(steps):
        made.send([step] * len(INTEGERS), [step + 0.5])
        found[step, 0] = integers[-1]
        found[step, 1] = reals[0]
    assert found[:, 0].tolist() == list(range(steps))
    assert found[:, 1].tolist() == [step + 0.5 for step in range(steps)]
    assert (integers.data_ptr(), reals.data_ptr()) == places


@pytest.mark.parametrize("device", DEVICES)
def test_an_answer_is_that_of_the_question_and_told_once(device):
    """Not of what came later; the newest where several have arrived; nothing where nobody asked."""
    there = torch.tensor([1, 2], dtype=torch.int32, device=device)
    readback = DeviceReadback(there)
    assert readback.latest(wait=True) is None
    readback.request()
    there += 10
    assert readback.latest(wait=True) == [1, 2]
    assert readback.latest(wait=True) is None
    for _ in range(3):
        readback.request()
        there += 10
    assert readback.latest(wait=True) == [31, 32]
    assert readback.latest() is None


@pytest.mark.parametrize("device", DEVICES)
def test_who_asks_too_often_is_not_heard(device):
    """As many answers as slots may be on their way; afterwards one may ask again."""
    there = torch.zeros(1, dtype=torch.int32, device=device)
    readback = DeviceReadback(there)
    for _ in range(SLOTS + 3):
        readback.request()
        there += 1
    assert readback.latest(wait=True) == [SLOTS - 1]
    readback.request()
    assert readback.latest(wait=True) == [SLOTS + 3]


def watched(settings, device, monkeypatch):
    """Steps with padding rows, on a CPU without graphs."""
    monkeypatch.setattr(stepper, "PaddedParameters", lambda *, pads: PaddedParameters(pads=True))  # noqa: ARG005
    settings = replace(settings, graph=device != "cpu")
    state, observations = begun(settings, device)
    return state, Stepper(state, observations, settings)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("deterministic", [False, True])
def test_steps_read_pair_counts_now_and_then(deterministic, device, monkeypatch):
    """In every ``READ_EVERY``-th replay; the same numbers at the same steps where a run is
    deterministic.
    """
    settings = published(batch=Batch.FRAME)
    settings = replace(settings, render=replace(settings.render, deterministic=deterministic))
    state, steps = watched(settings, device, monkeypatch)
    requested, results, replays = [], {}, []
    request, latest = DeviceReadback.request, DeviceReadback.latest

    def kept(self, *, wait):
        assert wait == deterministic
        found = latest(self, wait=wait)
        replays.append(found)
        if found is not None:
            results[len(replays)] = found
        return found

    monkeypatch.setattr(
        DeviceReadback, "request", lambda self: requested.append(len(replays) + 1) or request(self)
    )
    monkeypatch.setattr(DeviceReadback, "latest", kept)
    while state.images < 40:
        steps.step()
    assert requested == list(range(READ_EVERY, len(replays) + 1, READ_EVERY))
    assert len(requested) >= 2
    if deterministic or device == "cpu":
        assert [*results] == requested
    assert all(counts[2] > 0 for counts in results.values())


def test_the_capacity_grows_as_soon_as_a_count_is_near_it(monkeypatch):
    """In the very replay, on a CPU; without a readback nothing is learnt."""
    settings = published(batch=Batch.FRAME)
    settings = replace(settings, densify=replace(settings.densify, every=None))
    _, steps = watched(settings, "cpu", monkeypatch)
    replays, learnt, latest = [], [], DeviceReadback.latest
    monkeypatch.setattr(
        DeviceReadback, "latest", lambda self, **k: replays.append(latest(self, **k)) or replays[-1]
    )
    monkeypatch.setattr(PairCapacity, "is_nearly_full", lambda *_: True)
    monkeypatch.setattr(PairCapacity, "learn", lambda *_, **__: learnt.append(len(replays)))
    while len(replays) < 3 * READ_EVERY:
        steps.step()
    later = {count for count in learnt if count >= READ_EVERY}  # new stages also read counts
    assert later == {READ_EVERY, 2 * READ_EVERY, 3 * READ_EVERY}
