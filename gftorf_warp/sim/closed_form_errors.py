"""Errors of the closed form on a recording, and a table of what each level of the ladder adds to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..data.decode import closed_form_distance
from ..data.sequence import Sequence, Truth
from ..data.truth import known_distance, moving_and_static
from ..errors import InputError
from .ideal_sensor import ideal_recording
from .ladder import LEVELS
from .scene import Scene


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


def _mean(values: np.ndarray) -> float | None:
    found = values[np.isfinite(values)]
    return float(found.mean()) if found.size else None
