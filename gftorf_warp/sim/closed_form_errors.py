"""Errors of the closed form, and a table of them by level of the ladder."""

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
    """Mean squared distance errors of the closed form [m^2 x 100]; None without any such pixel.

    Truth is that of the first raw frame of each quartet; distances are not unwrapped. The first and
    the last of more than two quartets are left out, as in the published tables.
    """

    all: float | None
    """Against geometry, on all pixels."""
    moving: float | None
    """Against geometry, where the distance changes within a quartet."""
    static: float | None
    """Against geometry, where it does not."""
    static_phasor: float | None
    """Against the static-phasor distance, on all pixels: errors without those of indirect light."""


def closed_form_errors(sequence: Sequence, truth: Truth | None) -> Errors:
    """Errors of the closed form of a recording.

    Raises:
        InputError: If nothing can be decoded or compared.
    """
    quartets = sequence.complete_quartets
    quartets = quartets[1:-1] if len(quartets) > 2 else quartets
    if truth is None or not quartets:
        actual = f"{'no ' if truth is None else ''}truth and {quartets}"
        why = f"expected truth and a complete quartet, found {actual}"
        fix = f"simulate at least the {sequence.cycle} raw frames of a cycle"
        where = sequence.path or "sequence"
        raise InputError("nothing to compare", where=where, why=why, fix=fix)
    frames = [sequence.cycle * i for i in quartets]
    decoded = np.stack([closed_form_distance(sequence, i) for i in quartets])
    distance = known_distance(truth)
    squares = 100.0 * (decoded - distance[frames]) ** 2
    moving, static = moving_and_static(
        distance, frames, from_phasors=sequence.from_phasors, cycle=sequence.cycle
    )
    by_phasor = None
    # it wraps with its one frequency
    if truth.phasor_distance is not None and len(sequence.frequencies) == 1:
        by_phasor = _mean(100.0 * (decoded - truth.phasor_distance[frames]) ** 2)
    return Errors(_mean(squares), _mean(squares[moving]), _mean(squares[static]), by_phasor)


def with_closed_form(scene: Scene) -> Scene:
    """The scene with its closed-form error: the mean over ideal quads of its sensor [m^2 x 100].

    It is unchanged if it has one already, or is too short for a cycle.
    """
    if scene.closed_form is not None or scene.frames < len(scene.sensor.cycle):
        return scene
    return replace(scene, closed_form=closed_form_errors(*ideal_recording(scene)).all)


def ladder_table(rows: Mapping[str, Errors]) -> list[str]:
    """Lines of a table: errors of each level, and the difference from the one before."""
    heads = ("all", "moving", "static", "vs phasor", "added")
    titles = "".join(f"{head:>11}" for head in heads)
    lines = [f"{'closed form, MSE x100 [m^2]':<28}{titles}  what is new"]
    before = None
    for level in LEVELS:
        if level.name not in rows:
            continue
        errors = rows[level.name]
        added = None if before is None or errors.all is None else errors.all - before
        shown = ("-" if value is None else f"{value:.4g}" for value in (*errors, added))
        cells = "".join(f"{text:>11}" for text in shown)
        lines.append(f"{level.name:<28}{cells}  {level.adds}")
        before = errors.all
    return lines


def _mean(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None
