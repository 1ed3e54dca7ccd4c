"""Padding rows: what they hold, when memory is allocated anew,
and what attaching a state costs the host.
"""

from dataclasses import replace

import pytest
import torch
from small_runs import demo, small
from waits import WAITS, Operations, Reads

from gftorf_warp.recon import densify
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.padded import (
    BUCKET,
    CAPTURE_S,
    LAST_BUCKET,
    PADDING_LOGIT,
    PADDING_ROW_S,
    PaddedParameters,
)
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.stepper import densify_after
from gftorf_warp.scene.motion import MotionSettings

NETWORK = MotionSettings(kind="network", layers=3, width=16, skip_after=1)


def begun(count=300, motion=NETWORK):
    """A state of so many Gaussians with moments, half of which want to be more; motion None:
    that of the demo.
    """
    settings = demo(images=1000)
    settings = replace(settings, motion=motion or settings.motion)
    rules = replace(
        settings.densify, every=8, start=4, stop_share=0.6, gradient_min=0.5, clone_scale_max=0.05
    )
    rules = replace(
        rules, scale_from=0, scale_range=(0.001, 10.0), unseen_from=1, unseen_weight=0.0
    )
    settings = replace(settings, init=replace(settings.init, count=count), densify=rules)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=3, device="cpu")
    for leaf in state.optimiser.leaves[: len(state.optimiser.tensors)]:
        for moment in state.optimiser.moments_of(leaf):
            moment.add_(0.5)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        scale = state.optimiser.tensors["log_scale"]
        scale += torch.randn(scale.shape, generator=generator)
    some = {name: torch.rand(len(scale), generator=generator) for name in densify.STATISTICS}
    state.statistics = densify.Statistics(
        **some | {"gradient": some["gradient"] * some["pixels"].clamp_min(1.0)}
    )
    return state, observations, settings


@pytest.mark.parametrize("motion", [NETWORK, None], ids=["network", "nodes"])
def test_a_state_is_moved_to_the_bit_and_the_rest_is_padding(motion):
    """After a densification with padding as without, to the bit;
    padding rows have no moments and no opacity.
    """
    states = []
    for pads in (False, True):
        state, observations, settings = begun(motion=motion)
        padded, state.images = PaddedParameters(pads=True), 16
        if pads:
            assert padded.attach(state)
        densify_after(state, observations, 8, settings)
        if pads:
            assert not padded.attach(state)
            assert padded.holds(state)
        states.append(state)
    one, other = states
    count = len(one.optimiser.field)
    assert count not in (300, BUCKET)
    for name, tensor in one.optimiser.tensors.items():
        twin = other.optimiser.tensors[name]
        assert torch.equal(tensor, twin)
        for moment, known in zip(
            one.optimiser.moments_of(tensor), other.optimiser.moments_of(twin), strict=True
        ):
            assert torch.equal(moment, known)
    if not other.motion.follows_means:
        assert torch.equal(padded.binding[:count], one.binding)
    for name in densify.STATISTICS:
        assert torch.equal(getattr(one.statistics, name), getattr(other.statistics, name))
    assert (padded.values["opacity_logit"][count:] == PADDING_LOGIT).all()
    assert all(bool(value.isfinite().all()) for value in padded.values.values())
    for _, *moments in padded.moments.values():
        assert not any(moment[count:].any() for moment in moments)
    assert not padded.statistics.earlier[count:].any()


def resized(state, count):
    """The same with so many Gaussians, copies of the first where there were fewer."""
    rows = torch.arange(count).clamp_max(len(state.optimiser.field) - 1)
    state.optimiser.replace(rows, count, lambda *_: None)
    state.statistics = densify.start(state.optimiser.field)


def test_rows_of_removed_gaussians_become_padding():
    """In the same memory: no opacity, moments, statistics or weight in means are left."""
    state, _, _ = begun()
    padded = PaddedParameters(pads=True)
    assert padded.attach(state)
    count = 100
    resized(state, count)
    assert not padded.attach(state)
    assert (padded.values["opacity_logit"][count:] == PADDING_LOGIT).all()
    assert (state.optimiser.tensors["opacity_logit"] > PADDING_LOGIT).all()
    for _, *moments in padded.moments.values():
        assert all(moment[:count].any() and not moment[count:].any() for moment in moments)
    padded.statistics.weight[:] = 1.0
    assert not padded.attach(state)
    assert padded.statistics.weight.tolist() == [1.0] * count + [0.0] * (padded.rows - count)
    assert padded.mean_weight.tolist() == pytest.approx(
        [1 / count] * count + [0.0] * (padded.rows - count)
    )


def test_memory_is_kept():
    """Other addresses need new graphs: there are spare rows,
    and they are released once they have cost as much.
    """
    state, _, _ = begun(3000)
    padded = PaddedParameters(pads=True)
    assert padded.attach(state)
    assert padded.rows == BUCKET
    resized(state, BUCKET)
    assert not padded.attach(state, steps=25)
    resized(state, BUCKET + 1)
    assert padded.attach(state, steps=25)
    assert padded.rows == 2 * BUCKET
    resized(state, 100)
    # so many steps of unnecessary rows cost a capture
    patience = int(CAPTURE_S / PADDING_ROW_S / BUCKET)
    assert not padded.attach(state, steps=patience - 1)
    assert padded.attach(state, steps=2)
    assert padded.rows == BUCKET
    resized(state, 100)
    assert not padded.attach(state, grows=False), "other addresses are not free"
    assert padded.attach(state, free=True, grows=False)
    assert padded.rows == LAST_BUCKET
    assert not padded.attach(state, free=True, grows=False)


@pytest.mark.parametrize("where", ["padded", "alone"])
def test_a_densification_waits_once(where):
    """All numbers are read at once: a GPU idles from there to the next step,
    6 to 10 us an operation.
    """
    state, observations, settings = begun()
    padded, state.images = PaddedParameters(pads=True), 16
    if where == "padded":
        padded.attach(state)
    before = len(state.optimiser.field)
    with Operations() as operations, Reads() as reads:
        densify_after(state, observations, 8, settings)
        if where == "padded":
            padded.attach(state)
    assert len(state.optimiser.field) != before
    assert reads.found == 1
    assert not WAITS & set(operations.found)
    assert operations.found.total() <= (90 if where == "padded" else 80)
