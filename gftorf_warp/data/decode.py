"""Closed-form distance of a quartet, as if its raw frames had been taken at once: the C-ToF
baseline.

A quad of shift theta is a (cos(psi - theta) + b) = (a cos psi) cos theta + (a sin psi) sin theta +
a b, linear in three unknowns: least squares over the quads of one frequency gives the phasor 2a
(cos psi, sin psi), for the four canonical shifts the differences of opposite quads, and d =
((atan2(im, re) - phase_offset) mod 2 pi) c / 4 pi f. Where a cycle has several frequencies, their
phases together choose the turn of the first, see unwrap.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ..constants import SPEED_OF_LIGHT
from ..errors import InputError
from .cycles import solution
from .kept import kept
from .sequence import Sequence
from .unwrap import CONFIDENT, choose, common_range, multiples, wrapped


@dataclass(frozen=True, kw_only=True, eq=False)
class Decoded:
    """One quartet as a sensor would decode it, float64."""

    phasors: Float[np.ndarray, "f 2 H W"]
    """(re, im) = 2a (cos psi, sin psi) at each frequency, in the order of ``Sequence.frequencies``
    [quad units]."""
    single: Float[np.ndarray, "f H W"]
    """Distance that each frequency gives by itself [m], in [0, c/2f)."""
    distance: Float[np.ndarray, "H W"]
    """Distance by all frequencies together [m], in [0, :func:`unambiguous_range`)."""
    confidence: Float[np.ndarray, "H W"] | None
    """How much better one distance explains the phases than any other [1], see unwrap.py, 0 where
    there is no light; None for a single frequency, where there is nothing to choose."""

    @property
    def ambiguous(self) -> Bool[np.ndarray, "H W"]:
        """Pixels where a distance some whole turns away would explain the phases nearly as well."""
        if self.confidence is None:
            return np.zeros(self.distance.shape, dtype=bool)
        return self.confidence < CONFIDENT


@kept
def decode_quartet(sequence: Sequence, i: int) -> Decoded:
    """Phasors and distances of quartet i, as if its raw frames had been taken at once; read-only.

    Any three or more shifts at each frequency will do, evenly spaced or not, in any order.

    Raises:
        ValueError: If a frame of the quartet was not measured.
        InputError: If its shifts do not determine a phase, or its frequencies have no common range.
    """
    phasors = _phasors(sequence, i)[1]
    phases, frequencies = np.arctan2(phasors[:, 1], phasors[:, 0]), sequence.frequencies
    single = np.stack(
        [distance_from_phase(p, sequence, f) for p, f in zip(phases, frequencies, strict=True)]
    )
    distance, confidence = single[0], None
    unambiguous_range(sequence)  # raises the error of frequencies without one
    if len(frequencies) > 1:
        chosen = choose(phases - sequence.calibration.phase_offset, multiples(frequencies)[0])
        distance = single[0] + chosen.turns * (SPEED_OF_LIGHT / (2.0 * frequencies[0]))
        lit = np.hypot(phasors[:, 0], phasors[:, 1]).min(axis=0) > 0
        confidence = np.where(lit, chosen.confidence, 0.0)
    for array in (single, distance) if confidence is None else (single, distance, confidence):
        array.flags.writeable = False
    return Decoded(phasors=phasors, single=single, distance=distance, confidence=confidence)


def quartet_phasors(
    sequence: Sequence, i: int
) -> list[tuple[list[int], Float[np.ndarray, "2 H W"]]]:
    """Raw frames and phasor of quartet i at each of ``Sequence.frequencies``; raises as
    :func:`decode_quartet`.
    """
    return list(zip(*_phasors(sequence, i), strict=True))


@kept
def _phasors(sequence: Sequence, i: int) -> tuple[list[list[int]], Float[np.ndarray, "f 2 H W"]]:
    """Raw frames at each frequency of quartet i, and the phasors decoded from them."""
    if i not in sequence.complete_quartets:
        raise ValueError(f"quartet {i} must be complete, one of {sequence.complete_quartets}")
    first, last = sequence.cycle * i, sequence.cycle * (i + 1) - 1
    groups, phasors = [], []
    for f in sequence.frequencies:
        frames = first + np.flatnonzero(sequence.frame_frequencies[first : last + 1] == f)
        shifts = sequence.shifts[frames]
        rows = solution(shifts)
        if rows is None:
            where = f"{sequence.path or 'sequence'}, frames {first} .. {last}"
            text = f"{np.degrees(shifts).tolist()} degrees"
            why = f"expected at least three distinct shifts, found {text}"
            fix = "correct tof_permutation.npy, or the shifts in capture.json"
            raise InputError("phase shifts", where=where, why=why, fix=fix)
        groups.append(frames.tolist())
        phasors.append(np.tensordot(rows, sequence.quads[frames].astype(np.float64), axes=1))
    stack = np.stack(phasors)
    stack.flags.writeable = False
    return groups, stack


def quartet_phasor(sequence: Sequence, i: int) -> Float[np.ndarray, "2 H W"]:
    """Phasor (re, im) [quad units] of quartet i, first frequency; see :func:`decode_quartet`."""
    return quartet_phasors(sequence, i)[0][1]


def closed_form_distance(sequence: Sequence, i: int) -> Float[np.ndarray, "H W"]:
    """Distance [m] of quartet i in [0, :func:`unambiguous_range`); raises as
    :func:`decode_quartet`.
    """
    return decode_quartet(sequence, i).distance


def distance_from_phase(
    phase: np.ndarray, sequence: Sequence, f_mod_hz: float | None = None
) -> np.ndarray:
    """Distance [m] in [0, c/2f) of measured phases [rad] at a frequency; None: the first."""
    f_mod_hz = sequence.calibration.f_mod_hz if f_mod_hz is None else f_mod_hz
    metres_per_rad = SPEED_OF_LIGHT / (4.0 * math.pi * f_mod_hz)
    return wrapped(phase - sequence.calibration.phase_offset) * metres_per_rad


def unambiguous_range(sequence: Sequence) -> float:
    """Unambiguous range of a sequence [m]: c/2f, or c / 2 f_0 of all its frequencies together.

    Raises:
        InputError: If its frequencies are no small multiples of one.
    """
    try:
        return common_range(sequence.frequencies)
    except ValueError as error:
        what, where = "frequencies without a common range", sequence.path or "sequence"
        fix = "record at frequencies like 60 and 40 MHz, or keep the raw frames of one of them"
        raise InputError(what, where=where, why=str(error), fix=fix) from error


def largest_amplitude(sequence: Sequence) -> float:
    """Largest length of a phasor over all complete quartets, twice the amplitude of a quad.

    Raises:
        InputError: If no quartet is complete, or none has light.
    """
    quartets, where = sequence.complete_quartets, sequence.path or "sequence"
    phasors = (phasor for i in quartets for _, phasor in quartet_phasors(sequence, i))
    largest = max((float(np.hypot(*phasor).max()) for phasor in phasors), default=0.0)
    if not largest > 0.0:
        what = "no light" if quartets else "no complete quartet"
        why = "expected all raw frames of a cycle, with light, found "
        why += f"{len(quartets)} complete quartets, largest amplitude {largest:g}"
        raise InputError(what, where=where, why=why, fix="complete the recording")
    return largest


def quad_scale(sequence: Sequence) -> tuple[float, str]:
    """Factor that scales the quads to order one, and its source: the factor of the file, or else
    1 / (largest phasor amplitude).

    Raises:
        InputError: If there is no factor and no light to compute one from.
    """
    if sequence.calibration.quad_scale is not None:
        source = sequence.sources.get("quad_scale", "setting of the sequence")
        return float(sequence.calibration.quad_scale), source
    return 1.0 / largest_amplitude(sequence), "inferred 1 / largest phasor amplitude"
