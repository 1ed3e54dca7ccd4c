"""The ladder: one scene from ideal and synchronous to fully realistic in named steps, so that an error has a cause.

Each level is the one before it and a few settings more (sensor notes, 1.2). What a level takes from the scene itself is
``OWN``: the scene's own light, well and ADC count from the level on that is about them. All levels are traced by engine
mesh, since light beside the camera and light that bounces need it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ..data.decode import closed_form_distance
from ..data.sequence import Sequence, Truth
from ..data.truth import known_distance, moving_and_static
from ..errors import InputError, UsageError
from ..scene.pattern import Pattern
from ..scene.sensor import Sensor
from ..scene.waveform import Waveform, contrast_ratios, peak
from .ideal import ideal_recording
from .scene import Scene

OWN = object()
"""Stands for the value of the scene itself."""
NO_LIMIT_ELECTRONS = 1e12  # [e-] a well that nothing fills
FINE_ADC_BITS = 20  # with the scene's own step it reaches 1.7e7 electrons: it rounds, but does not clip
EMITTER_M = (0.04, 0.0, 0.0)  # [m] sensor notes 2.6: 40 mm beside the lens, where a scene says nothing
BEAM_DEG = (74.4, 59.3)  # [deg] the advertised field of view of the OPT8241 kit, sensor notes 3


@dataclass(frozen=True, kw_only=True)
class Level:
    """What one step of the ladder adds."""

    name: str
    """What the command line calls it."""
    adds: str
    """What is new, in words."""
    scene: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the scene."""
    sensor: Mapping[str, Any] = field(default_factory=dict)
    """Fields of its sensor."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of :func:`gftorf_warp.sim.simulate.simulate`."""


LEVELS = (
    Level(
        name="sync",
        adds="direct light at the camera, one ray per pixel, ideal sensor, all quads of a quartet at one instant",
        scene={"subsamples": 1, "emitter": (0.0, 0.0, 0.0), "beam_deg": None},
        sensor={
            "full_well_electrons": NO_LIMIT_ELECTRONS,
            "adc_bits": FINE_ADC_BITS,
            "harmonic_contrast": (),
            "pattern": Pattern(),
            "row_time_s": 0.0,
        },
        options={"engine": "mesh", "bounces": 0, "exposure_samples": 1, "noise": False, "sync": True},
    ),
    Level(name="L0", adds="one quad after the other", sensor={"row_time_s": OWN}, options={"sync": False}),
    Level(name="L1", adds="noise and ADC", sensor={"noise": True}, options={"noise": True}),
    Level(
        name="L2",
        adds="area of pixels, motion blur, light beside the camera with its shadows",
        scene={"subsamples": OWN, "emitter": EMITTER_M},
        options={"exposure_samples": 4},
    ),
    Level(
        name="L3",
        adds="light that bounces, in a beam",
        scene={"beam_deg": BEAM_DEG},
        options={"bounces": 3, "paths": 64},
    ),
    Level(
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


class Errors(NamedTuple):
    """How wrong the closed form is: mean squared error of the distance [m^2 x 100]; None where there is no such pixel.

    Truth is that of the first raw frame of each quartet, and distances that wrap are not unwrapped. The first and the
    last quartet do not count, as in the published tables, where there are more than two.
    """

    all: float | None
    """Against geometry, on all pixels."""
    moving: float | None
    """Against geometry, where the distance changes within a quartet."""
    static: float | None
    """Against geometry, where it does not."""
    static_phasor: float | None
    """Against the static-phasor distance, on all pixels: what motion and the sensor did, not the light."""


def adds_of(name: str) -> str:
    """What a level adds, in words."""
    return next(level.adds for level in LEVELS if level.name == name)


def at_level(scene: Scene, name: str, options: Mapping[str, Any]) -> tuple[Scene, dict[str, Any]]:
    """A scene and the options of a recording as they are at a level of the ladder.

    Args:
        scene: The scene itself.
        name: One of ``NAMES``.
        options: What else was asked for; ``sync`` stays if it is set, everything else that a level says is the level's.

    Raises:
        UsageError: If there is no such level.
    """
    if name not in NAMES:
        why = f"the levels are {', '.join(NAMES)}, each the one before and something more"
        raise UsageError(f"there is no level {name!r}", where="--level", why=why, fix="take one of these")
    of_scene: dict[str, Any] = {}
    of_sensor: dict[str, Any] = {}
    chosen: dict[str, Any] = {}
    for level in LEVELS[: NAMES.index(name) + 1]:
        of_scene |= level.scene
        of_sensor |= level.sensor
        chosen |= level.options
    sensor = _changed(scene.sensor, {k: v for k, v in of_sensor.items() if v is not OWN})
    if of_scene["emitter"] == EMITTER_M and any(scene.emitter):
        of_scene["emitter"] = OWN
    if of_scene["beam_deg"] == BEAM_DEG and scene.beam_deg is not None:
        of_scene["beam_deg"] = OWN
    changed = replace(scene, sensor=sensor, closed_form=None, **{k: v for k, v in of_scene.items() if v is not OWN})
    return changed, {**options, **chosen, "sync": chosen["sync"] or bool(options.get("sync"))}


def closed_form_errors(sequence: Sequence, truth: Truth | None) -> Errors:
    """Errors of the closed form of a recording.

    Raises:
        InputError: If nothing can be decoded or compared.
    """
    quartets = sequence.complete_quartets
    quartets = quartets[1:-1] if len(quartets) > 2 else quartets
    if truth is None or not quartets:
        raise InputError(
            "nothing to compare",
            where=sequence.path or "sequence",
            why=f"expected truth and a complete quartet, found {'no ' if truth is None else ''}truth and {quartets}",
            fix=f"simulate at least the {sequence.cycle} raw frames of a cycle",
        )
    frames = [sequence.cycle * i for i in quartets]
    decoded = np.stack([closed_form_distance(sequence, i) for i in quartets])
    distance = known_distance(truth)
    squares = 100.0 * (decoded - distance[frames]) ** 2
    moving, static = moving_and_static(distance, frames, from_phasors=sequence.from_phasors, cycle=sequence.cycle)
    one = len(sequence.frequencies) == 1  # a static-phasor distance is that of one frequency, and wraps with it
    by_phasor = (
        None if truth.phasor_distance is None or not one else 100.0 * (decoded - truth.phasor_distance[frames]) ** 2
    )
    return Errors(
        all=_mean(squares),
        moving=_mean(squares[moving]),
        static=_mean(squares[static]),
        static_phasor=None if by_phasor is None else _mean(by_phasor),
    )


def with_closed_form(scene: Scene) -> Scene:
    """A scene that knows the error of its closed form: mean over ideal quads of its own sensor [m^2 x 100].

    A scene that knows it already is left alone; one that is too short for a cycle stays without.
    """
    if scene.closed_form is not None or scene.frames < len(scene.sensor.cycle):
        return scene
    return replace(scene, closed_form=closed_form_errors(*ideal_recording(scene)).all)


def ladder_table(rows: Mapping[str, Errors]) -> list[str]:
    """Lines of a table: the error of each level, by name, and what the level added to the one before."""
    heads = ("all", "moving", "static", "vs phasor", "added")
    lines = [f"{'closed form, MSE x100 [m^2]':<28}" + "".join(f"{head:>11}" for head in heads) + "  what is new"]
    before = None
    for level in LEVELS:
        if level.name not in rows:
            continue
        errors = rows[level.name]
        added = None if before is None or errors.all is None else errors.all - before
        cells = "".join(f"{'-' if value is None else f'{value:.4g}':>11}" for value in (*errors, added))
        lines.append(f"{level.name:<28}{cells}  {level.adds}")
        before = errors.all
    return lines


def _changed(sensor: Sensor, settings: Mapping[str, Any]) -> Sensor:
    """A sensor with other settings.

    One tap can never hold less than nothing: if harmonics make its light swing farther, its constant part rises too.
    """
    swing = peak(settings["harmonic_contrast"])
    if sensor.unipolar and float(sensor.dc_offset) < swing:
        settings = {**settings, "dc_offset": swing}
    return replace(sensor, **settings)


def _mean(values: np.ndarray) -> float | None:
    found = values[np.isfinite(values)]
    return float(found.mean()) if found.size else None
