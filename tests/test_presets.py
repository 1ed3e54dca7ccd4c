"""The published settings, value by value, and what the schedule makes of them."""

import inspect
from dataclasses import fields, is_dataclass, replace

import pytest
import torch
from small_runs import advance, demo, small

from gftorf_warp import options
from gftorf_warp.demo import PRESET
from gftorf_warp.errors import UsageError
from gftorf_warp.recon import densify, presets
from gftorf_warp.recon.config import resolved
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.optimiser import frozen, rates_at
from gftorf_warp.recon.presets import Recorded
from gftorf_warp.recon.settings import Batch, Input, Norm, plain
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.terms import colour_weight, render_settings_at
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.buffers import ClampGradient, Stop, Support
from gftorf_warp.scene.initialise import Init, InitSettings
from gftorf_warp.scene.motion import MotionSettings, Products

# F-ToeRF at 15 m, ToeRF at 10 m
QUADS, PHASOR = Recorded(), Recorded(input=Input.PHASOR, unambiguous_range=5.0)


def test_one_preset_is_the_default_everywhere():
    """From Python, on the command line and in the demo."""
    default = inspect.signature(reconstruct).parameters["settings"].default
    words = ["reconstruct", "seq", "--out", "run"]
    assert default == options.parse(words).preset == PRESET == "best"


def test_paper_is_what_the_paper_says():
    """Counts, warm-up, network, losses, heuristics and length; one raw frame per step."""
    s = presets.paper()
    assert (s.init.kind, s.init.count, s.init.opacity, s.init.reflectivity) == (
        Init.RANDOM,
        100_000,
        0.1,
        0.1,
    )
    assert s.init.bounds == (s.render.near, s.render.far) == pytest.approx((0.135, 7.425))
    assert (s.schedule.images, s.schedule.warm_up, s.schedule.batch) == (60_000, 2000, Batch.FRAME)
    motion = s.motion
    assert (motion.kind, motion.layers, motion.width, motion.skip_after) == ("network", 8, 256, 5)
    assert (motion.position_frequencies, motion.time_frequencies, motion.input_scale) == (
        10,
        10,
        1.0,
    )
    assert (s.weights.quads, s.weights.ssim, s.weights.flow, s.weights.colour) == (
        1.0,
        0.2,
        8e-4,
        0.0,
    )
    assert (s.weights.distortion, s.weights.motion_size, s.background) == (0.0, 0.0, 1.0)
    assert s.rates.reflectivity_sh == s.rates_last.reflectivity_sh == 1.6e-4
    assert (s.rates.mean, s.rates_last.mean) == pytest.approx((1.32e-3, 1.32e-5))
    assert (s.rates.motion, s.rates_last.motion) == (8e-4, 1.6e-6)
    for name, rate in {"opacity_logit": 0.05, "log_scale": 1e-3, "quaternion": 1e-3}.items():
        assert getattr(s.rates, name) == getattr(s.rates_last, name) == rate
    assert (s.rates.colour_constant, s.rates.colour_rest) == (2.5e-3, 1.25e-4)
    assert (s.motion_gradient_max, s.schedule.freeze_from, s.schedule.pause_after_reset) == (
        None,
        None,
        0,
    )
    assert s.render.sh_degree == 3, "a camera at rest is no reason for fewer harmonics"


def test_densification_is_that_of_the_released_code_in_both():
    """Section 6.6."""
    for made in (presets.paper, presets.released):
        d = made(QUADS).densify
        assert (d.every, d.start, d.stop_share, d.gradient_min, d.opacity_min) == (
            100,
            250,
            0.6,
            2e-4,
            0.01,
        )
        assert (d.clone_scale_max, *d.scale_range) == pytest.approx((0.0825, 0.00825, 0.4125))
        assert (d.reset_every, d.reset_faster, d.scale_from) == (3000, None, 3000)
        d = made(PHASOR).densify
        assert (d.stop_share, d.gradient_min, d.reset_faster, d.scale_from) == (
            1.0,
            4e-4,
            (2001, 1500),
            2000,
        )


def test_released_differs_where_the_tables_say():
    """Sections 6.3, 6.5 and 6.7, for quads."""
    s = presets.released()
    assert (s.schedule.images, s.init.reflectivity, s.motion.input_scale) == (20_000, 0.02, 1.1)
    assert s.init.count == 0.19 * 100_000, "those that its cameras see"
    first, half = (rates_at(s, images) for images in (0, 10_000))
    assert first["reflectivity_sh"] == pytest.approx(1.09e-3, rel=2e-3)
    assert half["reflectivity_sh"] == pytest.approx(1.3e-4, rel=0.02)
    assert s.rates_last.reflectivity_sh == 1.6e-5
    assert s.motion_gradient_max == 1.0
    assert (s.render.support, s.render.stop) == (Support.SIGMA3_TILE16, Stop.EXCLUSIVE)
    assert s.render.clamp_gradient == ClampGradient.STRAIGHT
    shared = replace(s, preset="paper", motion_gradient_max=None, render=presets.paper().render)
    differing = {name for name, a, b in _leaves(shared, presets.paper()) if a != b}
    assert differing == {
        *(
            "schedule.images",
            "schedule.motion_decay_from",
            "schedule.pause_after_reset",
            "schedule.freeze_from",
        ),
        *("init.count", "init.reflectivity", "motion.input_scale"),
        *("rates.reflectivity_sh", "rates_last.reflectivity_sh"),
        *("weights.colour_norm", "densify.loses_step"),
        "schedule.batch_rule",  # of no meaning to single frames, which both compare
    }


def test_fast_is_released_but_for_what_makes_it_fast():
    """Named settings only; for phasors, where quartets mean nothing and nothing freezes,
    it stays so.
    """
    s = presets.fast()
    differing = {
        name for name, a, b in _leaves(replace(s, preset="released"), presets.released()) if a != b
    }
    assert differing == {
        *("motion.products", "schedule.batch", "schedule.motion_ramp", "schedule.freeze_from"),
        *("densify.unseen_from", "densify.unseen_weight"),
    }
    assert (s.motion.products, s.schedule.batch) == (Products.HALF, Batch.QUARTET)
    assert (s.schedule.motion_ramp, s.schedule.freeze_from) == (1000, 0.8)
    assert (s.densify.unseen_from, s.densify.unseen_weight) == (300, 0.03)
    assert presets.fast(PHASOR).schedule.freeze_from is None
    for made in (presets.demo, presets.paper, presets.released):
        assert made().densify.unseen_from is None, "an approximation is asked for"
        assert (made().schedule.motion_ramp, made().schedule.flow_every) == (0, 1)


def test_released_for_phasors():
    """ToeRF: other bounds, colour, no flow, no freeze; its phasor is a, ours 2a,
    so reflectivities are half.
    """
    s = presets.released(PHASOR)
    assert s.init.bounds == pytest.approx((0.09, 6.05))
    assert s.rates.mean == pytest.approx(8.8e-4)
    assert s.rates.reflectivity_sh == pytest.approx(4.84e-3 / 2)
    assert s.rates_last.reflectivity_sh == pytest.approx(1.6e-4 / 2)
    assert s.init.reflectivity == 0.1 / 2
    weights = s.weights
    assert (weights.flow, weights.colour, weights.colour_norm, weights.motion_size) == (
        0.0,
        1.0,
        Norm.L1,
        0.05,
    )
    assert presets.paper(PHASOR).weights.colour_norm == Norm.L2
    assert (colour_weight(s, 1999), colour_weight(s, 2000)) == (0.0, 1.0)
    assert s.schedule.freeze_from is None


def test_lengths_follow_the_unambiguous_range():
    """Nothing knows a scene by name: twice the range, twice every length."""
    once, twice = (presets.released(Recorded(unambiguous_range=r)) for r in (7.5, 15.0))
    lengths = [("densify", "clone_scale_max"), ("render", "far"), ("rates", "mean")]
    for part, name in lengths:
        assert getattr(getattr(twice, part), name) == pytest.approx(
            2 * getattr(getattr(once, part), name)
        )


def test_the_motion_waits_rests_and_goes_on_alone():
    """Warm-up, decay counted from its end, a pause after every reset,
    and the freeze of everything else.
    """
    s = presets.released()
    at = {images: rates_at(s, images) for images in (1999, 2000, 11_000, 11_999, 12_000)}
    assert at[1999]["motion"] == 0.0
    assert at[2000]["motion"] == pytest.approx(8e-4)
    assert at[11_000]["motion"] == pytest.approx((8e-4 * 1.6e-6) ** 0.5)
    assert (
        rates_at(s, 6199, reset_at=6000)["motion"]
        == 0.0
        < rates_at(s, 6200, reset_at=6000)["motion"]
    )
    assert at[11_999]["mean"] > 0
    assert {name for name, rate in at[12_000].items() if rate > 0} == {"motion"}
    assert not frozen(s, 11_999)
    assert frozen(s, 12_000)
    assert not frozen(presets.paper(), 60_000)


@pytest.mark.parametrize(
    ("made", "recorded", "want"),
    [
        (presets.released, QUADS, [3000, 6000, 9000]),
        (
            presets.released,
            PHASOR,
            [3000, 4500, 6000, 7500, 9000, 10_500, 12_000, 13_500, 15_000, 16_500],
        ),
        (presets.paper, QUADS, [3000 * k for k in range(1, 11)]),
    ],
)
def test_opacities_are_never_reset_shortly_before_a_freeze_or_the_end(made, recorded, want):
    """The published ToeRF settings reset 500 images before the end:
    what that dims cannot recover.
    """
    s = made(recorded)
    assert densify.resets(s.densify, s.schedule) == want
    assert resolved(s)["opacity_resets"] == want


def test_config_prints_the_resolved_schedule():
    """As JSON would hold it."""
    found = resolved(presets.released())
    assert (found["gaussians_frozen_from"], found["densify_until"], found["motion_from"]) == (
        12_000,
        12_000,
        2000,
    )
    assert (found["flow_from"], found["colour_from"], found["motion_rests_after_reset"]) == (
        2000,
        None,
        200,
    )
    assert found["rates_half_way"]["reflectivity_sh"] == pytest.approx(1.3e-4, rel=0.02)
    assert plain(presets.paper(PHASOR))["weights"]["colour_norm"] == "l2"


def test_harmonics_gain_a_degree_every_thousand_images():
    """And keep all three in the end."""
    s = presets.paper()
    degrees = [
        render_settings_at(s, images).sh_degree for images in (0, 999, 1000, 2999, 3000, 59_999)
    ]
    assert degrees == [0, 0, 1, 2, 3, 3]
    assert render_settings_at(presets.demo(), 0) == presets.demo().render


def test_ablations_change_reflectivity_and_distortion_and_nothing_else():
    """H1 is a rate and H2 a start; both rates are constant, as in the paper."""
    base = presets.paper()
    for row, (rate, reflectivity, distorted) in {
        "nobias": (1.6e-3, 0.5, False),
        "dd": (1.6e-3, 0.5, True),
        "h1": (1.6e-4, 0.5, False),
        "h1h2": (1.6e-4, 0.1, False),
        "h1h2dd": (1.6e-4, 0.1, True),
    }.items():
        s = presets.ablated(base, row)
        assert (s.rates.reflectivity_sh, s.rates_last.reflectivity_sh, s.init.reflectivity) == (
            rate,
            rate,
            reflectivity,
        )
        assert (s.weights.distortion > 0) == distorted
        allowed = {
            "ablation",
            "init.reflectivity",
            "rates.reflectivity_sh",
            "rates_last.reflectivity_sh",
        }
        assert {name for name, a, b in _leaves(s, base) if a != b} <= {
            *allowed,
            "weights.distortion",
        }
    assert [name for name, a, b in _leaves(presets.ablated(base, "h1h2"), base) if a != b] == [
        "ablation"
    ]
    with pytest.raises(UsageError, match="unknown ablation h3"):
        presets.ablated(base, "h3")
    for other in (presets.demo(), presets.dgs_depth(), presets.ctof()):
        with pytest.raises(UsageError, match="no ablations"):
            presets.ablated(other, "h1")


def test_shortened_keeps_the_course():
    """Intervals shrink with the run, shares and rates stay."""
    s = presets.shortened(presets.released(PHASOR), 2000)
    assert (s.schedule.images, s.schedule.warm_up, s.schedule.sh_degree_every) == (2000, 200, 100)
    assert (s.densify.every, s.densify.start, s.densify.reset_faster) == (10, 25, (200, 150))
    assert s.rates == presets.released(PHASOR).rates
    assert presets.shortened(presets.demo(), 100).densify.every is None


def small_published(**changes):
    """Paper's settings at a size for tests: twelve frames, 300 Gaussians, a narrow network."""
    s = presets.shortened(presets.paper(), changes.pop("images", 600))
    init = InitSettings(
        kind=Init.RANDOM, count=300, opacity=0.3, reflectivity=0.1, bounds=(1.0, 5.0)
    )
    motion = MotionSettings(kind="network", layers=3, width=16, skip_after=2)
    schedule = replace(
        s.schedule,
        **{name: changes.pop(name) for name in ("freeze_from", "warm_up") if name in changes},
    )
    return replace(s, init=init, motion=motion, schedule=schedule, **changes)


def test_nothing_moves_in_the_warm_up_and_the_network_learns_nothing():
    """Though it would move Gaussians already."""
    s = small_published(warm_up=6)
    observations = observe(small(), s, "cpu")
    state = begin(observations, s, seed=0, device="cpu")
    with torch.no_grad():
        state.motion.head.bias.fill_(0.5)  # half a metre: the renderings would differ
    before = [parameter.detach().clone() for parameter in state.motion.parameters()]
    still = begin(observations, s, seed=0, device="cpu")
    for _ in range(6):
        assert advance(state, observations, s) == 0
        assert advance(still, observations, s) == 0
    assert torch.equal(state.optimiser.field.mean, still.optimiser.field.mean)
    assert all(torch.equal(a, b) for a, b in zip(before, state.motion.parameters(), strict=True))
    advance(state, observations, s)
    assert not all(
        torch.equal(a, b) for a, b in zip(before, state.motion.parameters(), strict=True)
    )


def test_frozen_gaussians_stay_and_the_network_goes_on():
    """To the bit."""
    s = small_published(freeze_from=0.5, warm_up=0, images=8)
    s = replace(s, densify=replace(s.densify, every=None))
    observations = observe(small(), s, "cpu")
    state = begin(observations, s, seed=0, device="cpu")
    for _ in range(4):
        advance(state, observations, s)
    gaussians = {name: value.detach().clone() for name, value in state.optimiser.tensors.items()}
    weights = [parameter.detach().clone() for parameter in state.motion.parameters()]
    advance(state, observations, s)
    assert all(
        torch.equal(value, gaussians[name]) for name, value in state.optimiser.tensors.items()
    )
    assert not all(
        torch.equal(a, b) for a, b in zip(weights, state.motion.parameters(), strict=True)
    )


def test_the_step_of_a_round_is_lost_only_where_the_preset_says_so():
    """No pruning, no splitting: then the round itself changes nothing."""
    for loses in (True, False):
        options = replace(demo().densify, every=4, start=0, stop_share=1.0, gradient_min=None)
        s = small_published(
            warm_up=0, images=100, densify=replace(options, loses_step=loses, scale_from=1000)
        )
        observations = observe(small(), s, "cpu")
        state = begin(observations, s, seed=0, device="cpu")
        for _ in range(3):
            advance(state, observations, s)
        before = state.optimiser.field.mean.detach().clone()
        advance(state, observations, s)
        assert torch.equal(state.optimiser.field.mean, before) == loses


def _leaves(one, other, prefix=""):
    """(name, value, other value) of all fields of two settings, nested ones by dots."""
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if is_dataclass(a):
            yield from _leaves(a, b, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", a, b


def test_best_compares_wide_raw_frames_more_often():
    """One image is one raw frame or quartet: more pixels, more images, up to ``width_max``."""
    images = [presets.best(Recorded(width=width)).schedule.images for width in (96, 160, 161, 640)]
    assert images == [4000, 4000, 8000, 8000]
