"""Named settings. A preset is a function of what was recorded that returns them; an ablation
changes some of them.

The published values are those of the paper or, where it is silent, of its released code: method.md,
sections 4 to 7, is where each stands. Lengths that were given in multiples of a scene scale are
metres here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from ..errors import UsageError
from ..render.buffers import ClampGradient, Distortion, RenderSettings, SplatDistance, Stop, Support
from ..scene.initialise import Init, InitSettings
from ..scene.motion import MotionSettings, Products
from ..scene.network import Network
from .recorded import Recorded
from .settings import (
    Batch,
    BatchRule,
    DensifySettings,
    Input,
    Method,
    Norm,
    Rates,
    ReconSettings,
    Schedule,
    Weights,
)
from .volume_presets import ftorf, torf, volume

__all__ = [
    "ABLATIONS",
    "PRESETS",
    "Recorded",
    "ablated",
    "best",
    "ctof",
    "demo",
    "dgs",
    "dgs_depth",
    "fast",
    "flow2d",
    "ftorf",
    "paper",
    "preset",
    "released",
    "shortened",
    "temporal",
    "torf",
    "volume",
]


def best(recorded: Recorded = Recorded()) -> ReconSettings:
    """The default: a static background, and moving Gaussians that exist during one quartet each,
    both started from measured phase. A moving camera has nodes instead, as ``demo`` has.
    """
    if recorded.camera_moves:
        return replace(demo(recorded), preset="best", fallback=True, outlines=True, attempts_max=2)
    rates = Rates(
        mean=1e-3,
        log_scale=3e-2,
        quaternion=2e-2,
        opacity_logit=0.05,
        reflectivity_sh=3e-3,
        motion=3e-3,
    )
    return ReconSettings(
        preset="best",
        input=recorded.input,
        width_max=320,
        init=InitSettings(kind=Init.QUARTETS, moving_spacing=1.0),
        motion=MotionSettings(kind="windows", nodes=40),
        render=RenderSettings(low_pass=0.1, splat_distance=SplatDistance.PLANE),
        rates=rates,
        rates_last=rates.times(0.2),
        weights=Weights(
            ssim=0.2, distortion=3e-3, colour=1.0 if recorded.input == Input.PHASOR else 0.0
        ),
        schedule=Schedule(images=4000 if recorded.width <= 160 else 8000, batch=Batch.QUARTET),
        densify=DensifySettings(every=None),
        scale_max=0.05 * recorded.scene_scale,  # where the paper prunes (section 6.6)
        background=0.3,
        fallback=True,
        outlines=True,
        attempts_max=2,
    )


def demo(recorded: Recorded = Recorded()) -> ReconSettings:
    """Minutes on two CPU cores: small images, motion nodes instead of a network, and a start from
    measured phase.

    Neither heuristic of method section 6.4 is used. Slow reflectivity hurts once the start is
    close, since errors of the decoded amplitude have to be repaired; low initial reflectivity is
    meaningless where it is measured.
    """
    rates = Rates(
        mean=1e-3,
        log_scale=3e-2,
        quaternion=2e-2,
        opacity_logit=0.02,
        reflectivity_sh=1e-2,
        motion=1e-3,
    )
    return ReconSettings(
        preset="demo",
        input=recorded.input,
        width_max=160,
        rates=rates,
        rates_last=rates.times(0.3),
        weights=Weights(
            ssim=0.2, distortion=0.1, colour=1.0 if recorded.input == Input.PHASOR else 0.0
        ),
        schedule=Schedule(images=4000, batch=Batch.QUARTET),
        densify=DensifySettings(every=None),
    )


def paper(recorded: Recorded = Recorded()) -> ReconSettings:
    """Everything as the paper has it, and as the released code has it where the paper is silent
    (section 6).
    """
    phasor = recorded.input == Input.PHASOR
    scale, (near, far) = recorded.scene_scale, recorded.bounds
    rates = Rates(
        mean=1.6e-4 * scale,
        log_scale=1e-3,
        quaternion=1e-3,
        opacity_logit=0.05,
        reflectivity_sh=1.6e-4,  # constant: heuristic H1
        colour_constant=2.5e-3,
        colour_rest=1.25e-4,
        motion=8e-4,
    )
    return ReconSettings(
        preset="paper",
        input=recorded.input,
        init=InitSettings(
            kind=Init.RANDOM, count=100_000, opacity=0.1, reflectivity=0.1, bounds=(near, far)
        ),
        motion=MotionSettings(kind=Network.kind, input_scale=1.0),
        render=RenderSettings(near=near, far=far),
        rates=rates,
        rates_last=replace(rates, mean=1.6e-6 * scale, motion=1.6e-6),
        weights=Weights(
            quads=1.0,  # real scenes 5
            ssim=0.2,
            colour=1.0 if phasor else 0.0,
            colour_norm=Norm.L2,
            flow=0.0 if phasor else 8e-4,
        ),
        schedule=Schedule(
            images=60_000,
            batch=Batch.FRAME,
            warm_up=2000,
            colour_from=2000,
            flow_from=2000,
            sh_degree_every=1000,
        ),
        densify=DensifySettings(
            every=100,
            start=250,
            stop_share=1.0 if phasor else 0.6,
            gradient_min=4e-4 if phasor else 2e-4,
            clone_scale_max=0.01 * scale,
            opacity_min=0.01,
            scale_range=(0.001 * scale, 0.05 * scale),
            scale_from=2000 if phasor else 3000,
            reset_every=3000,
            reset_faster=(2001, 1500) if phasor else None,
        ),
        background=1.0,
        motion_gradient_max=None,
    )


def released(recorded: Recorded = Recorded()) -> ReconSettings:
    """The published code where it differs from the paper: tables 6.3 to 6.7.

    Its renderer stops early, straightens the clamp and cuts splats at three sigma of 16-pixel
    tiles. ``weights.quads``, ``quad_scale``, ``init.reflectivity``, ``rates.reflectivity_sh`` and
    ``densify.gradient_min`` have other values for single scenes in table 6.3; these are those of
    its synthetic row. Its phasor is half of ours, so for phasors reflectivity and its rate are half
    of what stands there, which changes nothing else.

    It scatters 100,000 Gaussians over a box of which the cameras see little: 19 % of them project
    into the image, the others never get a gradient and vanish at the first opacity reset (mistake 1
    of section 10). Those 19 % are drawn in the frusta here, at the same density.
    """
    base = paper(recorded)
    phasor, scale = recorded.input == Input.PHASOR, recorded.scene_scale
    argument = 0.5 * 1.6e-4 if phasor else 1.6e-5
    return replace(
        base,
        preset="released",
        init=replace(base.init, count=19_000, reflectivity=0.5 * 0.1 if phasor else 0.02),
        motion=replace(base.motion, input_scale=1.1),
        render=replace(
            base.render,
            support=Support.SIGMA3_TILE16,
            stop=Stop.EXCLUSIVE,
            clamp_gradient=ClampGradient.STRAIGHT,
            distortion=Distortion.RELEASED,
        ),
        rates=replace(base.rates, reflectivity_sh=argument * scale**2),
        rates_last=replace(base.rates_last, reflectivity_sh=argument),
        weights=replace(base.weights, colour_norm=Norm.L1, motion_size=0.05 if phasor else 0.0),
        schedule=replace(
            base.schedule,
            images=20_000,
            batch_rule=BatchRule.LINEAR,  # of single frames, as published, it changes nothing
            motion_decay_from=2000,
            pause_after_reset=200,
            freeze_from=base.densify.stop_share if base.densify.stop_share < 1.0 else None,
        ),
        densify=replace(base.densify, loses_step=True),
        motion_gradient_max=1.0,
    )


def fast(recorded: Recorded = Recorded()) -> ReconSettings:
    """``released`` on a GPU in seconds: quartets, a network in half precision, visibility pruning.

    A quarter of the steps, with four times the rates. So the rate of the network has a linear
    warm-up, which prevents dead ReLUs, and Gaussians are optimised for 0.8 of the run, not 0.6.
    """
    base = released(recorded)
    freezes = base.schedule.freeze_from is not None
    return replace(
        base,
        preset="fast",
        motion=replace(base.motion, products=Products.HALF),
        schedule=replace(
            base.schedule,
            batch=Batch.QUARTET,
            motion_ramp=1000,
            freeze_from=0.8 if freezes else None,
        ),
        densify=replace(base.densify, unseen_from=300, unseen_weight=0.03),
    )


def dgs(recorded: Recorded = Recorded()) -> ReconSettings:
    """Deformable 3D Gaussians: the same network and renderer, colour alone,
    one query per image (section 7).
    """
    base = paper(replace(recorded, input=Input.PHASOR))
    return replace(
        base,
        preset="dgs",
        input=recorded.input,
        weights=Weights(quads=0.0, ssim=0.2, colour=1.0, colour_norm=Norm.L1),
        schedule=replace(base.schedule, images=40_000, warm_up=3000, colour_from=0, flow_from=0),
    )


def dgs_depth(recorded: Recorded = Recorded()) -> ReconSettings:
    """``dgs`` with the closed-form distance as a second loss,
    which is as wrong as the camera where things move.
    """
    base = dgs(recorded)
    return replace(base, preset="dgs_depth", weights=replace(base.weights, depth=DEPTH_WEIGHT))


def ctof(recorded: Recorded = Recorded()) -> ReconSettings:
    """The closed form of every quartet, as a run to compare with: nothing is fitted."""
    base = ReconSettings(preset="ctof", method=Method.CTOF, input=recorded.input)
    return replace(base, schedule=replace(base.schedule, images=1))


def temporal(recorded: Recorded = Recorded()) -> ReconSettings:
    """The closed form of what stands still, averaged over the recording, and of single quartets
    elsewhere: the least that a reconstruction must beat. Needs a resting camera.
    """
    return replace(ctof(recorded), preset="temporal", method=Method.TEMPORAL)


def flow2d(recorded: Recorded = Recorded()) -> ReconSettings:
    """The closed form of quartets whose raw frames optical flow brought to one time (section 7),
    by dense inverse search or, with ``--flow deepflow``, by DeepFlow.
    """
    return replace(ctof(recorded), preset="flow2d", method=Method.FLOW2D)


DEPTH_WEIGHT = 0.1  # [1/m] unpublished
# [1/m^2] unpublished; of 1e-4, 1e-3 and 1e-2 the largest that did no harm at small size
DISTORTION_WEIGHT = 1e-3
PRESETS: dict[str, Callable[[Recorded], ReconSettings]] = {
    function.__name__: function
    for function in (
        best,
        demo,
        paper,
        released,
        fast,
        dgs,
        dgs_depth,
        ctof,
        temporal,
        flow2d,
        torf,
        ftorf,
        volume,
    )
}
"""All presets by name."""

SLOW, FAST = 1.6e-4, 1.6e-3  # learning rates of reflectivity with and without H1 (section 7)
DIM, BRIGHT = 0.1, 0.5  # initial reflectivities with and without H2
ABLATIONS: dict[str, tuple[float, float, float]] = {
    "nobias": (FAST, BRIGHT, 0.0),
    "dd": (FAST, BRIGHT, DISTORTION_WEIGHT),
    "h1": (SLOW, BRIGHT, 0.0),
    "h1h2": (SLOW, DIM, 0.0),
    "h1h2dd": (SLOW, DIM, DISTORTION_WEIGHT),
}
"""Rows of the ablation table: learning rate of reflectivity, initial reflectivity, weight of the
depth distortion."""


def preset(name: str, recorded: Recorded = Recorded()) -> ReconSettings:
    """The settings of a name.

    Raises:
        UsageError: If there are none.
    """
    if name not in PRESETS:
        raise _unknown("preset", name, list(PRESETS))
    return PRESETS[name](recorded)


def ablated(settings: ReconSettings, row: str) -> ReconSettings:
    """Settings with the reflectivity and the depth distortion of a row of the ablation table
    (section 7).

    Raises:
        UsageError: If there is no such row, or neither heuristic applies.
    """
    if row not in ABLATIONS:
        raise _unknown("ablation", row, list(ABLATIONS))
    if settings.method != Method.GAUSSIANS:
        raise UsageError(
            f"preset {settings.preset} has no ablations",
            where="--ablation",
            why="they change Gaussians, and it has none",
            fix="use --preset paper or --preset released",
        )
    measured = settings.init.kind != Init.RANDOM
    if measured or settings.weights.quads == 0:
        raise UsageError(
            f"preset {settings.preset} has no ablations",
            where="--ablation",
            why="its reflectivities start where they were measured, so neither heuristic is in it"
            if measured
            else "it compares nothing that depends on reflectivity",
            fix="use --preset paper or --preset released",
        )
    rate, reflectivity, distortion = ABLATIONS[row]
    return replace(
        settings,
        ablation=row,
        init=replace(settings.init, reflectivity=reflectivity),
        rates=replace(settings.rates, reflectivity_sh=rate),
        rates_last=replace(settings.rates_last, reflectivity_sh=rate),
        weights=replace(settings.weights, distortion=distortion),
    )


SCHEDULE = (
    "warm_up motion_decay_from motion_ramp pause_after_reset colour_from flow_from sh_degree_every"
)
DENSIFY = "every start scale_from unseen_from reset_every"


def shortened(settings: ReconSettings, images: int) -> ReconSettings:
    """The same course in fewer images: every interval that is counted in images shrinks alike.

    Learning rates stay, so a run a tenth as long also moves a tenth as far.
    """
    share, faster = images / settings.schedule.images, settings.densify.reset_faster

    def shorter(interval: int | None) -> int | None:
        return max(round(share * interval), 1) if interval else interval

    def changed(group, names: str, **others):
        values = {name: shorter(getattr(group, name)) for name in names.split()}
        return replace(group, **values, **others)

    resets = None if faster is None else tuple(map(shorter, faster))
    return replace(
        settings,
        schedule=changed(settings.schedule, SCHEDULE, images=images),
        densify=changed(settings.densify, DENSIFY, reset_faster=resets),
    )


def _unknown(kind: str, name: str, known: list[str]) -> UsageError:
    why, option = f"available: {', '.join(known)}", f"--{kind}"
    return UsageError(
        f"unknown {kind} {name}", where=option, why=why, fix=f"use {option} {known[0]}"
    )
