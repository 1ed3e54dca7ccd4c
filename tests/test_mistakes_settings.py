"""Known mistakes in settings (method, section 10): hidden decays, lengths by the wrong range, late
resets, harmonics.

Each test is named after the number of the mistake it would fail at; design/mistakes.md lists all of
them.
"""

import dataclasses
from dataclasses import replace

import pytest
from mistakes import ramp, wall

from gftorf_warp.recon import densify, presets, terms
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.optimiser import rates_at
from gftorf_warp.recon.settings import BatchRule, FlowSource, Input
from gftorf_warp.recon.state import begin
from gftorf_warp.scene.initialise import Init, InitSettings
from gftorf_warp.scene.motion import MotionSettings

RECORDED = [
    presets.Recorded(input=kind, unambiguous_range=d)
    for kind, d in ((Input.QUADS, 7.5), (Input.PHASOR, 5.0))
]
FITTED = [name for name in presets.PRESETS if presets.preset(name).method.fits]


@pytest.mark.parametrize("recorded", RECORDED, ids=["quads", "phasor"])
@pytest.mark.parametrize("name", FITTED)
def test_mistake_03_both_ends_of_every_rate_are_stated(name, recorded):
    """First and last rate of every group are fields, what is in force is log-linear between them,
    and nothing else.
    """
    settings = presets.preset(name, recorded)
    plain = {
        "pause_after_reset": 0,
        "freeze_from": None,
        "motion_ramp": 0,
        "batch_rule": BatchRule.NONE,
    }
    settings = replace(settings, schedule=replace(settings.schedule, **plain))
    first, last = (dataclasses.asdict(rates) for rates in (settings.rates, settings.rates_last))
    assert first.keys() == last.keys() == rates_at(settings, 0).keys()
    total = settings.schedule.images
    for group in first.keys() - {"motion"}:
        got = [rates_at(settings, n)[group] for n in (0, total // 4, total // 2, total)]
        ratio = last[group] / first[group]
        assert got == pytest.approx([first[group] * ratio**share for share in (0, 0.25, 0.5, 1)]), (
            group
        )
    begin_at = max(settings.schedule.warm_up, settings.schedule.motion_decay_from)
    assert rates_at(settings, total)["motion"] == pytest.approx(last["motion"])
    assert (
        rates_at(settings, begin_at)["motion"] > last["motion"] or first["motion"] == last["motion"]
    )


def test_mistake_03_the_decay_of_the_published_code_is_spelled_out():
    """Reflectivity: constant in the paper, 68 times down in the released code for quads and 30
    times for phasors.
    """
    quads, phasor = RECORDED
    for recorded in RECORDED:
        paper = presets.paper(recorded)
        assert paper.rates.reflectivity_sh == paper.rates_last.reflectivity_sh == 1.6e-4
    released = presets.released(quads)
    assert released.rates.reflectivity_sh == pytest.approx(1.09e-3, rel=2e-3)
    assert released.rates_last.reflectivity_sh == pytest.approx(1.6e-5)
    settings = replace(released, schedule=replace(released.schedule, freeze_from=None))
    assert rates_at(settings, released.schedule.images // 2)["reflectivity_sh"] == pytest.approx(
        1.32e-4, rel=5e-3
    )
    released = presets.released(phasor)
    assert released.rates.reflectivity_sh / released.rates_last.reflectivity_sh == pytest.approx(
        30.25
    )
    assert released.rates.mean == pytest.approx(8.8e-4)
    assert released.rates_last.mean == pytest.approx(8.8e-6)


def test_mistake_09_lengths_follow_the_unambiguous_range():
    """S is 1.1 of it, 8.25 m at depth_range 15; the network sees positions in units of 7.5 m,
    or 8.25 m.
    """
    quads = RECORDED[0]
    for name, unit in (("paper", 7.5), ("released", 8.25)):
        settings = presets.preset(name, quads)
        assert settings.rates.mean == pytest.approx(1.6e-4 * 8.25)
        assert settings.densify.clone_scale_max == pytest.approx(0.0825)
        assert settings.init.bounds == pytest.approx((0.135, 7.425))
        motion = MotionSettings(
            kind="network",
            width=16,
            layers=3,
            skip_after=1,
            input_scale=settings.motion.input_scale,
        )
        settings = replace(
            settings,
            init=InitSettings(kind=Init.RANDOM, count=50),
            motion=motion,
            flow=FlowSource.NONE,
        )
        state = begin(observe(wall(ramp(12, 16)), settings, "cpu"), settings, seed=0, device="cpu")
        assert state.motion.length == pytest.approx(unit, rel=1e-6)


@pytest.mark.parametrize("recorded", RECORDED, ids=["quads", "phasor"])
@pytest.mark.parametrize("images", [3000, 20_000, 30_000])
@pytest.mark.parametrize("name", FITTED)
def test_mistake_12_the_last_tenth_before_a_freeze_or_the_end_is_free_of_resets(
    name, images, recorded
):
    """At any length, also when the course is compressed;
    phasors would be reset at 19,500 of 20,000 otherwise.
    """
    settings = presets.preset(name, recorded)
    long = replace(settings, schedule=replace(settings.schedule, images=images))
    for course in (long, presets.shortened(settings, images)):
        freeze = course.schedule.freeze_from
        end = images * min(course.densify.stop_share, 1.0 if freeze is None else freeze)
        resets = densify.resets(course.densify, course.schedule)
        assert all(n < 0.9 * end for n in resets)
        if course.densify.every is not None and images >= 20_000:
            assert resets, "there must be resets for this to mean something"


@pytest.mark.parametrize("name", FITTED)
def test_mistake_14_every_preset_ends_with_all_harmonics(name):
    """They may begin at degree 0, as published; they never end there because the camera rests."""
    for recorded in RECORDED:
        settings = presets.preset(name, recorded)
        for course in (settings, presets.shortened(settings, 300)):
            assert terms.render_settings_at(course, course.schedule.images // 2).sh_degree == 3
        assert settings.render.sh_degree == 3
