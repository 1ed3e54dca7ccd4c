"""Presets of neural volumes: ``torf``, ``ftorf`` and ``volume``."""

from __future__ import annotations

from dataclasses import replace

from ..scene.initialise import Init, InitSettings
from .recorded import Recorded
from .settings import FlowSource, Input, Method, ReconSettings, Schedule, Weights
from .volume.settings import (
    PUBLISHED_STEPS,
    GridSettings,
    NetworkSettings,
    TimeCode,
    VolumeSettings,
)

GRID_STEPS = 6000  # of ``volume``
FALLOFF_RANGE = 7.5  # [m] F of the published synthetic scenes, at which falloffs are L^2 / F^2


def torf(recorded: Recorded = Recorded()) -> ReconSettings:
    """Neural volumes of phasors and colour: two networks blended (section 7), as our own code.
    Values are those of its real scenes; recon/volume/torf.py says what is assumed.
    """
    return ReconSettings(
        preset="torf",
        method=Method.TORF,
        input=Input.PHASOR,
        flow=FlowSource.NONE,
        init=InitSettings(kind=Init.RANDOM),
        volume=VolumeSettings(
            network=NetworkSettings(time_code=TimeCode.LEARNT, static=True),
            rays=1024,
            accumulated=1,
            falloff=0.5 * (2.0 * recorded.unambiguous_range / FALLOFF_RANGE) ** 2,
            rate=1e-3,
            rate_tenth_after=250_000,
            gradient_max=None,
            quads_fall_at=125_000,
        ),
        weights=Weights(quads=8.0, ssim=0.0, colour=2.0),
        schedule=Schedule(images=PUBLISHED_STEPS),
    )


def ftorf(recorded: Recorded = Recorded()) -> ReconSettings:
    """A neural volume of raw quads with 3D scene flow (section 7), as our own code. Values are
    those of its real scenes; recon/volume/ftorf.py says what is assumed. Needs a resting camera.
    """
    return ReconSettings(
        preset="ftorf",
        method=Method.FTORF,
        input=Input.QUADS,
        init=InitSettings(kind=Init.RANDOM),
        volume=VolumeSettings(falloff=(2.0 * recorded.unambiguous_range / FALLOFF_RANGE) ** 2),
        weights=Weights(quads=10.0, ssim=0.0, flow=0.01),
        schedule=Schedule(images=PUBLISHED_STEPS),
    )


def volume(recorded: Recorded = Recorded()) -> ReconSettings:
    """A neural volume of our own in minutes: losses and scene flow of ``ftorf`` with hash grids
    (recon/volume/grid_volume.py). Needs a resting camera.
    """
    base = ftorf(recorded)
    assert base.volume is not None
    scene_flow = replace(base.volume.scene_flow, simultaneous_share=0.1)
    return replace(
        base,
        preset="volume",
        method=Method.VOLUME,
        volume=replace(
            base.volume,
            grid=GridSettings(),
            scene_flow=scene_flow,
            rays=8192,
            accumulated=1,
            samples=48,
            density_noise=0.0,
            rate=1e-2,
            rate_tenth_after=GRID_STEPS,
            gradient_max=None,
            epsilon=1e-15,
        ),
        schedule=Schedule(images=GRID_STEPS),
    )
