"""Steps as one graph: on a CPU the same work without a graph, against single steps."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import demo, random, small

from gftorf_warp.recon import presets, step
from gftorf_warp.recon.captured import CapturedSteps, steps_of, unsuitable
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.settings import Batch, Kernels
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.step import Singles
from gftorf_warp.render import perceptron
from gftorf_warp.scene.motion import MotionSettings, Products

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


def alike(one, other, few=0.01):
    """Two states after the same images: to rounding on a CPU, but for a share of ``few`` elements on a GPU.

    Atomic additions of the blend's backward pass happen there in any order, so gradients differ by a rounding, graph or
    not. Adam, whose epsilon is far below any gradient, makes whole steps of gradients that are nothing but rounding: a
    few elements may be a few steps apart, which is no error.
    """
    few = few if one.optimiser.leaves[0].is_cuda else 0.0
    assert len(one.optimiser.field) == len(other.optimiser.field)
    for leaf, twin in zip(one.optimiser.leaves, other.optimiser.leaves, strict=True):
        apart = ~torch.isclose(leaf, twin, rtol=1e-3, atol=2e-5)
        assert apart.float().mean() <= few
        torch.testing.assert_close(leaf, twin, rtol=1e-3, atol=2e-2 if few else 2e-5)
    assert one.sums.keys() == other.sums.keys()
    for name in one.sums:
        torch.testing.assert_close(one.sums[name], other.sums[name], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(one.statistics.pixels, other.statistics.pixels, rtol=1e-3 if few else 0, atol=4 * few)
    torch.testing.assert_close(one.statistics.gradient, other.statistics.gradient, rtol=1e-2, atol=1e-6 + 1e-2 * few)


SETTINGS = [published, lambda **c: demo(images=60, kernels=Kernels.STEP, **c)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
@pytest.mark.parametrize("make", SETTINGS, ids=["published", "demo"])
def test_steps_are_single_steps(make, batch, device):
    """Every tensor, sum and statistic after 20 images and after 40, with all that happens on the way.

    On a GPU roundings grow: whether a pixel still takes a splat is decided otherwise somewhere in between, and those
    who are behind it differ by a part of a step. Measured on an H200 with quartets of ``demo``: 2e-6 at most after 20
    images, after 40 4.5 % of the quaternions and 2.2 % of the harmonics, a third of a step at most.
    """
    settings = make(batch=batch)
    single, observations = begun(settings, device)
    whole, _ = begun(settings, device)
    assert unsuitable(observations, settings, whole) is None
    replay = CapturedSteps(whole, observations, settings)
    for images, few in ((20, 0.01), (40, 0.06)):
        while single.images < images:
            assert step.step(single, observations, settings) is None
            replay.step()
            assert single.images == whole.images
        assert replay.collect() == 0
        alike(single, whole, few)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("make", SETTINGS, ids=["network", "nodes"])
def test_rows_that_nobody_sees_are_in_no_mean(make, device):
    """Dead rows are displaced like others, and there are ten times as many as Gaussians in ``published``."""
    settings = make(batch=Batch.QUARTET)
    settings = replace(settings, weights=replace(settings.weights, motion_size=0.5))
    single, observations = begun(settings, device)
    whole, _ = begun(settings, device)
    steps = CapturedSteps(whole, observations, settings)
    while single.images < 20:
        assert step.step(single, observations, settings) is None
        steps.step()
    assert steps.collect() == 0
    assert single.sums["motion_size"] > 0.01
    for name, value in single.sums.items():  # no more: where little moves, the direction of its gradient is rounding
        torch.testing.assert_close(whole.sums[name], value, rtol=2e-3, atol=1e-6)


def test_branches_share_nothing_that_one_of_them_makes(monkeypatch):
    """Weights are filled in before the first branch: another one does not know when it would be done."""
    settings = published(batch=Batch.QUARTET)
    steps = CapturedSteps(*begun(settings), settings)
    counts, fork = [], steps._branches.fork

    @contextlib.contextmanager
    def watched(number):
        before = len(steps._ones)
        with fork(number):
            yield
        counts.append((before, len(steps._ones)))

    monkeypatch.setattr(steps._branches, "fork", watched)
    while steps.state.images < 20:
        steps.step()
    assert len(counts) == 20
    assert all(before == after > 0 for before, after in counts)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
def test_a_replay_is_the_same_work_without_a_graph(batch, device):
    """The same kernels in the same order; what differs on a GPU is the order of atomic additions, see ``alike``."""
    settings = published(batch=batch)
    states = []
    for graphs in (False, True):
        state, observations = begun(settings, device)
        steps = CapturedSteps(state, observations, settings, graphs=graphs)
        while state.images < 40:
            steps.step()
        assert steps.collect() == 0
        states.append(state)
    alike(*states)


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_that_is_not_finite_is_counted_and_changes_nothing(device):
    """One quad of one frame is not a number: its steps do nothing, the others go on."""
    settings = published(batch=Batch.FRAME)
    state, observations = begun(settings, device)
    observations.quads[observations.batches[0][0]] = float("nan")
    steps = CapturedSteps(state, observations, settings)
    for _ in observations.batches:
        before = [leaf.detach().clone() for leaf in state.optimiser.leaves]
        skipped = state.skipped
        steps.step()
        in_a_row = steps.collect()
        assert in_a_row == state.skipped - skipped
        if in_a_row:
            pairs = zip(before, state.optimiser.leaves, strict=True)
            assert all(old.shape != new.shape or torch.equal(old, new) for old, new in pairs)
    assert state.skipped == 1
    assert int(state.sums["count"]) == len(observations.batches) - 1
    assert all(leaf.isfinite().all() for leaf in state.optimiser.leaves)


def of_full_size(**changes):
    """A short run with the published network, in half precision."""
    full, settings = MotionSettings(), published(**changes)
    sizes = {"layers": full.layers, "width": full.width, "skip_after": full.skip_after}
    frequencies = {"position_frequencies": full.position_frequencies, "time_frequencies": full.time_frequencies}
    return replace(settings, motion=replace(settings.motion, products=Products.HALF, **sizes, **frequencies))


@pytest.mark.parametrize("device", DEVICES)
def test_the_network_goes_by_kernels_where_they_fit(device, monkeypatch):
    """On Hopper those of the published network; other sizes never, nor on a CPU."""
    for settings, size in ((of_full_size(), True), (published(), False)):
        state, observations = begun(settings, device)
        fitting = size and perceptron.fits(state.motion.form, observations.quads.device)
        CapturedSteps(state, observations, settings)
        assert isinstance(state.motion.form.passes, perceptron.TensorCores) == fitting
    assert device != "cpu" or not fitting
    asked = []
    monkeypatch.setattr(perceptron, "fits", lambda *given: asked.append(given) or True)
    state, observations = begun(settings, device)
    form = state.motion.form
    CapturedSteps(state, observations, settings)
    assert isinstance(state.motion.form.passes, perceptron.TensorCores), "it is what decides"
    assert asked == [(form, observations.quads.device)]


@pytest.mark.skipif(
    not torch.cuda.is_available() or torch.cuda.get_device_capability() != (9, 0), reason="needs CUDA with sm_90"
)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
def test_steps_learn_by_tensor_cores(batch):
    """In graphs: every step is sound, and every tensor of the network learns."""
    settings = of_full_size(batch=batch)
    state, observations = begun(settings, "cuda")
    before = [value.detach().clone() for value in state.motion.parameters()]
    steps = CapturedSteps(state, observations, settings)
    assert isinstance(state.motion.form.passes, perceptron.TensorCores)
    while state.images < 40:
        steps.step()
    assert steps.collect() == 0
    assert state.skipped == 0
    for old, new in zip(before, state.motion.parameters(), strict=True):
        assert new.isfinite().all()
        assert not torch.equal(old, new)


def test_a_run_is_captured_where_that_pays():
    """By default on a GPU only; on a CPU it costs time and changes nothing but roundings."""
    settings = demo(images=8)
    assert settings.kernels == Kernels.AUTO
    state, observations = begun(settings)
    assert isinstance(steps_of(state, observations, settings), Singles)
    wanted = replace(settings, kernels=Kernels.GRAPH)
    assert isinstance(steps_of(state, observations, wanted), CapturedSteps)
    elsewhere = replace(observations, quads=observations.quads.to("meta"))
    assert elsewhere.quads.device.type != "cpu"
    away = np.eye(4)
    away[0, 3] = 0.1
    moving = [*observations.cameras[:-1], observations.cameras[-1].at(away)]
    for which in (Kernels.AUTO, Kernels.GRAPH):  # a camera that moves is no constant of a graph
        seen = replace(elsewhere, cameras=moving)
        assert isinstance(steps_of(state, seen, replace(settings, kernels=which)), Singles)
