"""Steps as one graph: on a CPU the same work without a graph, against single steps."""

from dataclasses import replace

import pytest
import torch
from small_runs import demo, random, small

from gftorf_warp.recon import presets, step
from gftorf_warp.recon.captured import CapturedSteps, unsuitable
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.settings import Batch, Kernels
from gftorf_warp.recon.state import begin


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))]


def begun(settings, device="cpu"):
    """A state of Gaussians that are not round, and what it is fitted to."""
    observations = observe(small(), settings, device)
    state = begin(observations, settings, seed=3, device=device)
    with torch.no_grad():
        scale = state.optimiser.tensors["log_scale"]
        scale += 0.5 * random(*scale.shape).to(device)
    return state, observations


def published(**changes):
    """A short run of the published preset, small enough for a test: warm-up, network, flow, rounds and a reset."""
    settings = presets.shortened(presets.preset("released"), 60)
    motion = replace(settings.motion, layers=3, width=16, skip_after=1, position_frequencies=3, time_frequencies=2)
    init = replace(settings.init, count=300)
    densify = replace(settings.densify, every=8, start=12, reset_every=20, gradient_min=1e-6, loses_step=False)
    schedule = {name: changes.pop(name) for name in ("batch",) if name in changes}
    settings = replace(settings, motion=motion, init=init, densify=densify, kernels=Kernels.STEP, **changes)
    return replace(settings, schedule=replace(settings.schedule, warm_up=6, flow_from=8, **schedule))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
@pytest.mark.parametrize("make", [published, lambda **c: demo(images=60, kernels=Kernels.STEP, **c)])
def test_steps_are_single_steps(make, batch, device):
    """Every tensor, moment, sum and statistic after 40 images, with all that happens on the way."""
    settings = make(batch=batch)
    single, observations = begun(settings, device)
    whole, _ = begun(settings, device)
    assert unsuitable(observations, settings, whole) is None
    replay = CapturedSteps(whole, observations, settings)
    while single.images < 40:
        assert step.step(single, observations, settings) is None
        replay.step()
        assert single.images == whole.images
    assert replay.collect() == 0
    assert len(single.optimiser.field) == len(whole.optimiser.field)
    for one, other in zip(single.optimiser.leaves, whole.optimiser.leaves, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=2e-5)
    assert single.sums.keys() == whole.sums.keys()
    for name in single.sums:
        torch.testing.assert_close(single.sums[name], whole.sums[name], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(single.statistics.gradient, whole.statistics.gradient, rtol=1e-2, atol=1e-6)
    torch.testing.assert_close(single.statistics.pixels, whole.statistics.pixels)
