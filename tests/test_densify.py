"""Cloning, splitting, pruning and resetting: rows and moments together,
on sets small enough to check by hand.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from plain_step import plain_adam
from small_runs import KEYS, field, random

from gftorf_warp.recon import densify
from gftorf_warp.recon.optimiser import STORED, Optimiser, rates_at
from gftorf_warp.recon.settings import DensifySettings, ReconSettings, Schedule
from gftorf_warp.recon.stepper import visibility_pruning_is_due
from gftorf_warp.render import descent
from gftorf_warp.render.api import ScreenGradient
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.motion import Nodes

SETTINGS = DensifySettings(
    every=100,
    start=250,
    stop_share=0.6,
    gradient_min=0.5,
    clone_scale_max=0.1,
    opacity_min=0.01,
    gaussians_min=2,
)
CAMERA = Camera(width=40, height=20, fx=30.0, fy=30.0, cx=20.0, cy=10.0)


def optimiser(n=6):
    """Gaussians 0..n-1 told apart by every tensor, after one step, so that moments exist."""
    start = field(random(n, 3), torch.arange(n) % 2)
    start = replace(
        start,
        opacity_logit=torch.linspace(1.0, 3.0, n),
        log_scale=torch.full((n, 3), math.log(0.05)),
    )
    result = Optimiser(start, Nodes(KEYS, random(2, 3), torch.ones(2, dtype=torch.long)))
    generator = torch.Generator().manual_seed(1)
    gradients = [torch.randn(leaf.shape, generator=generator) for leaf in result.leaves]
    plain_adam(
        result, gradients, dict.fromkeys(rates_at(ReconSettings(preset="test"), 0), 1e-4), None
    )
    return result


def moments(optimiser):
    """Copies of Adam's state, by tensor."""
    return {
        name: {
            key: value.clone()
            for key, value in zip(STORED, optimiser.moments_of(tensor), strict=True)
        }
        for name, tensor in optimiser.tensors.items()
    }


def statistics(*gradient):
    """One pixel per Gaussian, with these gradients."""
    zero = torch.zeros(len(gradient))
    one = torch.ones(len(gradient))
    return densify.Statistics(
        gradient=torch.tensor(gradient), pixels=one, weight=0.25 * one, earlier=zero
    )


def generator():
    """A seeded one."""
    return torch.Generator().manual_seed(7)


def test_the_statistic_is_the_pixel_weighted_mean_in_half_image_sizes():
    """Two images, worked out by hand."""
    seen = densify.start(field(random(2, 3), None))
    screens = [
        ScreenGradient(values=torch.tensor(values))
        for values in ([[0.3, 0, 2, 0.5], [0, 0.1, 0, 0]], [[0, 0.4, 6, 3], [0, 0.2, 5, 0.25]])
    ]
    step = descent.StepResults.empty(2, 1, torch.device("cpu"))
    descent.add_statistics(
        screens, (CAMERA.width, CAMERA.height), step, seen.gradient, seen.pixels, seen.weight
    )
    assert seen.weight.tolist() == [3.5, 0.25]
    torch.testing.assert_close(seen.mean_gradient, torch.tensor([(2 * 6.0 + 6 * 4.0) / 8, 2.0]))


def test_a_small_gaussian_is_cloned_with_fresh_moments():
    """The others keep their values and moments."""
    adam = optimiser()
    before, old = adam.field.map(torch.clone), moments(adam)
    counts, _ = densify.densify(
        adam, statistics(0, 0, 1.0, 0, 0, 0), SETTINGS, generator(), prunes_scale=False
    )
    assert counts == {"cloned": 1, "split": 0, "pruned": 0}
    rows = torch.tensor([0, 1, 2, 3, 4, 5, 2])
    for name, value in adam.field.tensors().items():
        torch.testing.assert_close(
            value.detach(), before.tensors()[name].detach()[rows], rtol=0, atol=0
        )
    for name, state in moments(adam).items():
        for key in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(state[key][:6], old[name][key], rtol=0, atol=0)
            assert old[name][key][2].abs().max() > 0
            assert state[key][6].abs().max() == 0
    assert len(adam.state_dict()["state"]) == 6


def test_a_large_gaussian_is_split_in_two_smaller_ones_drawn_from_itself():
    """Halves lie along the long axis, turned with it."""
    adam = optimiser(3)
    with torch.no_grad():
        adam.tensors["log_scale"][1] = torch.tensor([math.log(0.4), math.log(1e-6), math.log(1e-6)])
        half = math.sqrt(0.5)
        # turns its x axis to y
        adam.tensors["quaternion"][1] = torch.tensor([half, 0.0, 0.0, half])
    before = adam.field.map(lambda t: t.detach().clone())
    counts, _ = densify.densify(
        adam, statistics(0, 9.0, 0), SETTINGS, generator(), prunes_scale=False
    )
    assert counts == {"cloned": 0, "split": 1, "pruned": 0}
    after = adam.field
    torch.testing.assert_close(after.mean.detach()[:2], before.mean[[0, 2]], rtol=0, atol=0)
    torch.testing.assert_close(after.scale.detach()[2:, 0], torch.full((2,), 0.4 / 1.6))
    torch.testing.assert_close(after.opacity.detach()[2:], before.opacity[1].expand(2))
    assert (after.layer[2:] == before.layer[1]).all()
    offset = (after.mean.detach() - before.mean[1])[2:]
    assert offset[:, 1].abs().min() > 1e-3
    assert (offset[0] - offset[1]).norm() > 1e-3
    assert offset[:, [0, 2]].abs().max() < 1e-5, "halves lie on the long axis"
    assert moments(adam)["mean"]["exp_avg"][2:].abs().max() == 0


def test_halves_have_the_spread_of_the_original():
    """Their covariance is that of the Gaussian they came from."""
    n = 4000
    adam = optimiser(n)
    with torch.no_grad():
        adam.tensors["mean"].zero_()
        adam.tensors["log_scale"].copy_(torch.tensor([0.3, 0.2, 0.1]).log().expand(n, 3))
        adam.tensors["quaternion"].copy_(random(1, 4).expand(n, 4))
    whole = adam.field.map(lambda tensor: tensor.detach().clone())
    counts, _ = densify.densify(
        adam, statistics(*[1.0] * n), SETTINGS, generator(), prunes_scale=False
    )
    assert counts == {"cloned": 0, "split": n, "pruned": 0}
    drawn = adam.field.mean.detach()
    w, x, y, z = torch.nn.functional.normalize(whole.quaternion[0], dim=0).tolist()
    rotation = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    want = rotation @ torch.diag(torch.tensor([0.09, 0.04, 0.01])) @ rotation.T
    torch.testing.assert_close(drawn.T @ drawn / len(drawn), want, rtol=0, atol=0.006)


def test_faint_gaussians_are_pruned_and_the_floor_holds():
    """Rows and moments go together; too few are never left."""
    adam = optimiser()
    with torch.no_grad():
        adam.tensors["opacity_logit"][[1, 4]] = -6.0
    kept = adam.tensors["mean"].detach()[[0, 2, 3, 5]].clone()
    old = moments(adam)
    counts, _ = densify.densify(
        adam, statistics(*[0.0] * 6), SETTINGS, generator(), prunes_scale=False
    )
    assert counts == {"cloned": 0, "split": 0, "pruned": 2}
    torch.testing.assert_close(adam.tensors["mean"].detach(), kept, rtol=0, atol=0)
    torch.testing.assert_close(
        moments(adam)["mean"]["exp_avg"], old["mean"]["exp_avg"][[0, 2, 3, 5]]
    )
    with torch.no_grad():
        adam.tensors["opacity_logit"][:3] = -6.0
    densify.densify(adam, statistics(*[0.0] * 4), SETTINGS, generator(), prunes_scale=False)
    assert len(adam.field) == 4, "one would remain, the floor is two"


def test_sizes_are_judged_only_when_asked():
    """Too large and too small ones go in later rounds only."""
    adam = optimiser()
    settings = replace(SETTINGS, scale_range=(0.01, 1.0))
    with torch.no_grad():
        adam.tensors["log_scale"][0] = math.log(5.0)
        adam.tensors["log_scale"][1] = math.log(0.001)
    before, nothing = adam.field.mean.detach().clone(), statistics(*[0.0] * 6)
    densify.densify(adam, nothing, settings, generator(), prunes_scale=False)
    assert len(adam.field) == 6
    densify.densify(adam, nothing, settings, generator(), prunes_scale=True)
    torch.testing.assert_close(adam.field.mean.detach(), before[2:], rtol=0, atol=0)


def test_who_was_not_seen_goes_when_the_unseen_are_judged():
    """What was seen before the last round counts as well,
    copies are as seen as what they come from.
    """
    adam = optimiser()
    before = adam.field.mean.detach().clone()
    seen = statistics(0, 0, 1.0, 0, 0, 0)
    seen.weight[[1, 3, 4]] = 0.0
    counts, seen = densify.densify(adam, seen, SETTINGS, generator(), prunes_scale=False)
    assert counts == {"cloned": 1, "split": 0, "pruned": 0}, "nobody is judged"
    assert seen.earlier.tolist() == [0.25, 0, 0.25, 0, 0, 0.25, 0.25]
    assert seen.weight.abs().sum() + seen.pixels.abs().sum() + seen.gradient.abs().sum() == 0
    seen.weight[[3, 4]] = torch.tensor([2.0, 0.125])
    with torch.no_grad():
        adam.tensors["opacity_logit"][0] = -6.0
    counts, seen = densify.densify(
        adam, seen, SETTINGS, generator(), prunes_scale=False, unseen_weight=0.125
    )
    assert counts == {"cloned": 0, "split": 0, "pruned": 3}, "0 is faint, 1 and 4 are behind others"
    torch.testing.assert_close(adam.field.mean.detach(), before[[2, 3, 5, 2]], rtol=0, atol=0)
    assert seen.earlier.tolist() == [0, 0, 0, 0], "from here on it is judged anew"


@pytest.mark.parametrize("floor", [2, 65])
def test_a_round_is_as_if_it_first_added_and_then_removed(floor):
    """All at once and one after the other, to the bit: rows, moments, random vectors,
    and the sizes of halves.
    """
    settings = replace(SETTINGS, opacity_min=0.3, scale_range=(0.08, 0.4), gaussians_min=floor)
    everybody = replace(settings, opacity_min=1e-6, scale_range=(1e-6, 1e6))
    found = []
    for rounds in ([settings], [everybody, replace(settings, gradient_min=None)]):
        adam, known = optimiser(60), statistics(*random(60, seed=2).tolist())
        with torch.no_grad():
            adam.tensors["log_scale"].copy_(random(60, 3, seed=3) * 3.5 - 4.0)
            adam.tensors["opacity_logit"].copy_(random(60, seed=4) * 6.0 - 3.0)
        own, counts = generator(), dict.fromkeys(("cloned", "split", "pruned"), 0)
        for one in rounds:
            more, known = densify.densify(adam, known, one, own, prunes_scale=True)
            counts = {name: counts[name] + number for name, number in more.items()}
        found.append((counts, adam))
    (counts, adam), (others, twin) = found
    assert counts == others
    assert counts["cloned"] > 5
    assert counts["split"] > 5
    assert (counts["pruned"] > 20) == (floor == 2)
    for name, tensor in adam.tensors.items():
        assert torch.equal(tensor, twin.tensors[name])
        for one, other in zip(
            adam.moments_of(tensor), twin.moments_of(twin.tensors[name]), strict=True
        ):
            assert torch.equal(one, other)


def test_visibility_pruning_is_due_when_every_raw_frame_was_compared():
    """Densification at 100, 200, .. of 60 raw frames: two epochs lie between."""
    observations = SimpleNamespace(batches=[[0] * 4] * 15)
    state = SimpleNamespace(images=0, unseen_at=0)
    due = []
    for state.images in range(100, 1000, 100):
        if visibility_pruning_is_due(state, observations, replace(SETTINGS, unseen_from=300)):
            due.append(state.images)
            state.unseen_at = state.images
        assert not visibility_pruning_is_due(state, observations, SETTINGS)
    assert due == [300, 500, 700, 900]


def test_the_cap_lets_the_largest_gradients_through():
    """Two may be added, five want to."""
    adam = optimiser()
    settings = replace(SETTINGS, gaussians_max=8)
    before = adam.field.mean.detach().clone()
    densify.densify(
        adam, statistics(0.6, 3.0, 0.7, 0.1, 2.0, 0.9), settings, generator(), prunes_scale=False
    )
    assert len(adam.field) == 8
    torch.testing.assert_close(adam.field.mean.detach()[6:], before[[1, 4]], rtol=0, atol=0)


def test_reset_dims_and_forgets():
    """What is fainter stays as it is; moments of other tensors stay."""
    adam = optimiser()
    with torch.no_grad():
        adam.tensors["opacity_logit"][2] = -9.0
    densify.reset_opacity(adam, SETTINGS)
    opacity = adam.field.opacity.detach()
    assert opacity.max() == pytest.approx(0.01, rel=1e-4)
    assert opacity[2] == pytest.approx(1 / (1 + math.exp(9.0)), rel=1e-4)
    assert moments(adam)["opacity_logit"]["exp_avg"].abs().max() == 0
    assert moments(adam)["mean"]["exp_avg"].abs().max() > 0


def test_rebuilt_tensors_go_on_being_optimised():
    """New tensors are the ones Adam steps."""
    adam = optimiser()
    densify.densify(adam, statistics(0, 0, 1.0, 0, 0, 0), SETTINGS, generator(), prunes_scale=False)
    before = adam.field.mean.detach().clone()
    gradients = [100.0 * torch.ones_like(leaf) for leaf in adam.leaves]
    plain_adam(adam, gradients, dict.fromkeys(rates_at(ReconSettings(preset="test"), 0), 0.1), None)
    assert ((adam.field.mean.detach() - before) < 0).all()


def test_rounds_and_resets_are_due_when_the_schedule_says():
    """Counted in images, although a step takes four."""
    schedule = Schedule(images=10_000)
    options = replace(SETTINGS, reset_every=1900)
    rounds = [
        n for n in range(4, 10_001, 4) if densify.densification_is_due(n - 4, n, options, schedule)
    ]
    assert rounds[0] == 300
    assert rounds[-1] == 5900
    assert len(rounds) == 57
    resets = [n for n in range(4, 10_001, 4) if densify.reset_is_due(n - 4, n, options, schedule)]
    # 5700 lies in the last tenth before the end at 6000, which is quiet
    assert resets == [1900, 3800]
    never = replace(options, every=None)
    assert not any(
        densify.densification_is_due(n - 4, n, never, schedule) for n in range(4, 10_001, 4)
    )
    assert not any(densify.reset_is_due(n - 4, n, never, schedule) for n in range(4, 10_001, 4))
