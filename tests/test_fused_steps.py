"""Steps with kernels and with torch: the same run to rounding, and the same guarantees."""

import copy
from dataclasses import replace

import pytest
import torch
from small_runs import demo, random, rows, same, small

from gftorf_warp.recon import step
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.settings import DensifySettings, Kernels
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render import descent
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.gaussians import GaussianField

SETTINGS = demo(images=48, log_every=8)


def after(settings, steps, recording=None):
    """The state after some steps, from Gaussians that are not round: the orientation of a ball has no gradient."""
    observations = observe(recording or small(), settings, "cpu")
    state = begin(observations, settings, seed=3, device="cpu")
    with torch.no_grad():
        scale = state.optimiser.tensors["log_scale"]
        scale += 0.5 * random(*scale.shape)
    for _ in range(steps):
        assert step.step(state, observations, settings) is None
    return state, observations


@pytest.mark.parametrize("kernels", [Kernels.LOSS, Kernels.STEP])
def test_six_steps_with_kernels_are_six_steps_with_torch(kernels):
    """Against a black background, which needs no draw: every tensor, moment and sum."""
    states = [after(demo(images=48, background=0.0, kernels=which), 6)[0] for which in (Kernels.NONE, kernels)]
    start, _ = after(demo(images=48, background=0.0), 0)
    for leaf, other, before in zip(*(s.optimiser.leaves for s in (*states, start)), strict=True):
        moved = (leaf - before).detach().abs().max()
        assert moved > 0
        apart = (leaf - other).detach().abs() / moved
        assert apart.mean() < 1e-5
        assert (apart > 1e-3).float().mean() < 0.01, "Adam makes whole steps of gradients that are rounding; but few"
    for one, other in zip(*(s.optimiser.adam.state.values() for s in states), strict=True):
        assert float(one["step"]) == float(other["step"]) == 6
    for name in states[0].sums:
        torch.testing.assert_close(states[0].sums[name], states[1].sums[name], rtol=1e-4, atol=1e-6)


def test_backgrounds_of_kernels_do_what_those_of_torch_do(monkeypatch):
    """Torch's steps, given the kernel's backgrounds, are the kernel's steps: nothing else differs."""
    by_kernel, _ = after(demo(images=48, kernels=Kernels.STEP), 4)
    drawn = step._backgrounds
    with_kernel = demo(kernels=Kernels.STEP)
    monkeypatch.setattr(step, "_backgrounds", lambda s, o, f, _, w, n: drawn(s, o, f, with_kernel, w, n))
    by_torch, _ = after(demo(images=48, kernels=Kernels.NONE), 4)
    torch.testing.assert_close(by_kernel.sums["loss"], by_torch.sums["loss"], rtol=1e-4, atol=0)
    monkeypatch.undo()
    other, _ = after(demo(images=48, kernels=Kernels.NONE), 4)
    assert abs(float(other.sums["loss"] / by_torch.sums["loss"]) - 1) > 1e-4, "other draws are seen in the loss"
    assert float(other.sums["loss"] / by_torch.sums["loss"]) == pytest.approx(1, rel=0.2)


def test_a_stored_state_goes_on_to_the_same_bytes():
    """Also from one way of steps to another: all keep the same moments."""
    settings = demo(images=48, kernels=Kernels.STEP)
    state, observations = after(settings, 3)
    again = from_dict(copy.deepcopy(to_dict(state)), "cpu")
    for each in (state, again):
        step.step(each, observations, settings)
    assert same(to_dict(state), to_dict(again))
    mixed = from_dict(to_dict(after(demo(images=48), 3)[0]), "cpu")
    assert step.step(mixed, observations, settings) is None
    assert {float(kept["step"]) for kept in mixed.optimiser.adam.state.values()} == {4.0}


def test_a_step_that_is_not_sound_changes_nothing(monkeypatch):
    """Parameters, moments and sums stay, and the run goes on."""
    settings = demo(images=48, kernels=Kernels.STEP)
    state, observations = after(settings, 2)
    before = to_dict(state)
    leaves = [leaf.detach().clone() for leaf in state.optimiser.leaves]
    whole = step.terms

    def broken(*arguments):
        found, seen = whole(*arguments)
        return {name: value * float("nan") for name, value in found.items()}, seen

    monkeypatch.setattr(step, "terms", broken)
    assert step.step(state, observations, settings) is not None
    assert all(torch.equal(leaf, old) for leaf, old in zip(state.optimiser.leaves, leaves, strict=True))
    assert same(to_dict(state)["sums"], before["sums"])
    assert {float(kept["step"]) for kept in state.optimiser.adam.state.values()} == {2.0}
    monkeypatch.undo()
    assert step.step(state, observations, settings) is None
    assert all(leaf.isfinite().all() for leaf in state.optimiser.leaves)


def test_a_whole_run_by_kernels_ends_where_torchs_does(tmp_path):
    """Rounds rebuild the moments that the kernel goes on with; other backgrounds move the end a little."""
    options = DensifySettings(every=40, start=20, stop_share=0.9, gradient_min=1e-6, clone_scale_max=0.04)
    ends = {}
    for which in set(Kernels) - {Kernels.AUTO}:  # which is one of the others
        settings = demo(images=160, log_every=40, densify=options, kernels=which)
        run = reconstruct(small(), tmp_path / which, settings, seed=3)
        first, *_, last = rows(run.path)
        assert last["gaussians"] > first["gaussians"]
        ends[which] = last
    for which in (Kernels.LOSS, Kernels.STEP, Kernels.GRAPH):
        assert ends[which]["loss"] == pytest.approx(ends[Kernels.NONE]["loss"], rel=0.05)
        assert ends[which]["quad_psnr_db"] == pytest.approx(ends[Kernels.NONE]["quad_psnr_db"], abs=1.0)


def test_every_image_of_a_run_has_a_background_of_its_own(monkeypatch):
    """Four images per step, and the next step goes on counting."""
    seen, whole = [], step.fused.uniform

    def uniform(shape, origin, amplitude, **stream):
        seen.append(tuple(origin.tolist()))
        return whole(shape, origin, amplitude, **stream)

    monkeypatch.setattr(step.fused, "uniform", uniform)
    after(demo(images=48, kernels=Kernels.STEP), 3)
    assert seen == [(3, n) for n in range(12)]


def test_dead_gaussians_behind_the_living_change_nothing():
    """What fills up a capacity: no pixel differs, no gradient reaches it, and Adam's step on it is zero."""
    state, observations = after(SETTINGS, 0)
    living, count = state.optimiser.field.map(torch.Tensor.detach), 37
    dead = living.map(lambda value: torch.zeros_like(value[:count]))
    dead.mean.copy_(living.mean[:count])  # in sight: it is the opacity that makes them nothing
    dead.log_scale.fill_(-2.0)
    dead.quaternion[:, 0] = 1.0
    dead.opacity_logit.fill_(-30.0)
    pairs = zip(living.tensors().items(), dead.tensors().values(), strict=True)
    padded = GaussianField(**{name: torch.cat([value, filling]) for (name, value), filling in pairs})
    images, gradients = [], []
    for field in (living, padded):
        leaves = {name: value.clone().requires_grad_() for name, value in field.parameters().items()}
        seen = rasterize(replace(field, **leaves), observations.cameras[0], observations.sensor)
        images.append(seen.quads.detach())
        gradients.append(torch.autograd.grad((seen.quads.square() + seen.distance).sum(), [*leaves.values()]))
    assert torch.equal(*images)
    for short, long in zip(*gradients, strict=True):
        torch.testing.assert_close(long[: len(short)], short, rtol=1e-5, atol=1e-6 * float(short.abs().max()))
        assert torch.equal(long[len(short) :], torch.zeros_like(long[len(short) :]))
    moments = [(torch.zeros(()), torch.zeros(count, 3), torch.zeros(count, 3))]
    ledger = descent.Ledger.empty(1, torch.device("cpu"))
    descent.descend(
        descent.AdamTable([dead.mean], [torch.zeros(count, 3)], moments),
        torch.ones(1),
        ledger,
        [0.0] * len(descent.FOUND_NAMES),
        motion_from=1,
        motion_gradient_max=None,
        pairs=[torch.zeros(1, dtype=torch.int32)],
        capacity=0,
        betas=(0.9, 0.999),
        epsilon=1e-15,
    )
    assert ledger.counts.tolist() == [0, 0, 0, 0]
    assert float(moments[0][0]) == 1
    assert torch.equal(dead.mean, living.mean[:count])
