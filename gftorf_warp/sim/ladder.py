"""The ladder: a scene from ideal and synchronous to realistic in named levels.

Each level changes a few settings of the one before it (sensor notes, 1.2); ``OWN`` is the value of
the scene itself. All levels are traced by engine mesh, since light beside the camera and bounces
need it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from ..errors import UsageError
from ..scene.pattern import Pattern
from ..scene.sensor import Sensor
from ..scene.waveform import Waveform, contrast_ratios, peak
from .scene import Scene, overridden
from .settings import ResolvedSettings, SimSettings

OWN = object()
NO_LIMIT_ELECTRONS = 1e12  # [e-] a full well that is never reached
# with the scene's electrons per code up to 1.7e7 electrons: it rounds, but does not clip
FINE_ADC_BITS = 20
# [m] sensor notes 2.6: 40 mm beside the lens, if the scene has no other position
EMITTER_M = (0.04, 0.0, 0.0)
BEAM_DEG = (74.4, 59.3)  # [deg] the advertised field of view of the OPT8241 kit, sensor notes 3


@dataclass(frozen=True, kw_only=True)
class LadderLevel:
    """Changes of a level of the ladder to the one before it."""

    name: str
    """Name on the command line."""
    adds: str
    """Description of the changes."""
    scene: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the scene."""
    sensor: Mapping[str, Any] = field(default_factory=dict)
    """Fields of its sensor."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of :class:`gftorf_warp.sim.settings.SimSettings`."""


LEVELS = (
    LadderLevel(
        name="sync",
        adds="direct light at the camera, one ray per pixel, ideal sensor, all quads of a "
        "quartet at one instant",
        scene={"subsamples": 1, "emitter": (0.0, 0.0, 0.0), "beam_deg": None},
        sensor={
            "full_well_electrons": NO_LIMIT_ELECTRONS,
            "adc_bits": FINE_ADC_BITS,
            "harmonic_contrast": (),
            "pattern": Pattern(),
            "row_time_s": 0.0,
        },
        settings={
            "engine": "mesh",
            "bounces": 0,
            "exposure_samples": 1,
            "noise": False,
            "sync": True,
        },
    ),
    LadderLevel(
        name="L0",
        adds="one quad after the other",
        sensor={"row_time_s": OWN},
        settings={"sync": False},
    ),
    LadderLevel(name="L1", adds="noise and ADC", sensor={"noise": True}, settings={"noise": True}),
    LadderLevel(
        name="L2",
        adds="area of pixels, motion blur, light beside the camera with its shadows",
        scene={"subsamples": OWN, "emitter": EMITTER_M},
        settings={"exposure_samples": 4},
    ),
    LadderLevel(
        name="L3",
        adds="light that bounces, in a beam",
        scene={"beam_deg": BEAM_DEG},
        settings={"bounces": 3, "paths": 64},
    ),
    LadderLevel(
        name="L4",
        adds="saturation, harmonics, pixel pattern",
        sensor={
            "full_well_electrons": OWN,
            "adc_bits": OWN,
            "harmonic_contrast": contrast_ratios(Waveform.SQUARE, Waveform.SQUARE, 5),
            "pattern": Pattern(phase=1.0, gain=0.01, dark=0.2),
        },
    ),
)
NAMES = tuple(level.name for level in LEVELS)


def adds_of(name: str) -> str:
    """Description of the changes of a level."""
    return next(level.adds for level in LEVELS if level.name == name)


def resolved(scene: Scene, settings: SimSettings) -> tuple[Scene, ResolvedSettings]:
    """The scene as it is recorded, and settings with defaults, overrides and level applied.

    Resolving twice is the same as once. Settings that are given, and ``sync``, hold at every level.

    Raises:
        UsageError: If there is no such level, it does not fit the sensor, or a field cannot be
            overridden so.
    """
    scene = overridden(scene, settings.overrides)
    frames = scene.frames if settings.frames is None else settings.frames
    size = (scene.width, scene.height) if settings.size is None else settings.size
    values = {f.name: getattr(settings, f.name) for f in fields(SimSettings)}
    given = {k: v for k, v in values.items() if v is not None}
    given |= {"frames": frames, "size": size, "overrides": (), "level": None}
    name = settings.level
    if name is None:
        return scene, ResolvedSettings(**given)
    if name not in NAMES:
        why = f"the levels are {', '.join(NAMES)}, each the one before and something more"
        raise UsageError(
            f"there is no level {name!r}", where="--level", why=why, fix="take one of these"
        )
    of_scene, of_sensor, chosen = (
        {k: v for level in LEVELS[: NAMES.index(name) + 1] for k, v in getattr(level, part).items()}
        for part in ("scene", "sensor", "settings")
    )
    try:
        sensor = _changed(scene.sensor, {k: v for k, v in of_sensor.items() if v is not OWN})
    except ValueError as error:
        what, fix = f"level {name} does not fit this sensor", "change the sensor, or the level"
        raise UsageError(what, where="--level", why=str(error), fix=fix) from error
    if of_scene["emitter"] == EMITTER_M and any(scene.emitter):
        of_scene["emitter"] = OWN
    if of_scene["beam_deg"] == BEAM_DEG and scene.beam_deg is not None:
        of_scene["beam_deg"] = OWN
    of_scene = {k: v for k, v in of_scene.items() if v is not OWN}
    chosen |= given | {"sync": chosen["sync"] or settings.sync}
    scene = replace(scene, sensor=sensor, closed_form=None, **of_scene)
    return scene, ResolvedSettings(**chosen)


def _changed(sensor: Sensor, settings: Mapping[str, Any]) -> Sensor:
    """A sensor with other settings; harmonics raise the DC offset of a unipolar one."""
    swing = peak(settings["harmonic_contrast"])
    if sensor.unipolar and float(sensor.dc_offset) < swing:
        settings = {**settings, "dc_offset": swing}
    return replace(sensor, **settings)
