"""Closed-form distance of a quartet, as if its four raw frames had been taken at once: the C-ToF baseline.

A quad of shift theta is a (cos(psi - theta) + b) = (a cos psi) cos theta + (a sin psi) sin theta + a b, linear in three
unknowns: least squares over the quads of a quartet gives the phasor 2a (cos psi, sin psi), for the four canonical
shifts the differences of opposite quads, and d = ((atan2(im, re) - phase_offset) mod 2 pi) c / 4 pi f.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from ..constants import FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError
from .sequence import Sequence

RANK_TOLERANCE = 1e-3  # singular values of three unknowns are about 1; two shifts closer than 0.1 degrees are one


def quartet_phasor(sequence: Sequence, i: int) -> Float[np.ndarray, "2 H W"]:
    """Phasor (re, im) = 2a (cos psi, sin psi) of quartet i from raw frames 4i .. 4i + 3, float64, in quad units.

    Raises:
        ValueError: If a frame of the quartet was not measured.
        InputError: If its shifts do not determine a phase.
    """
    if sequence.frequencies_hz is not None and len(set(sequence.frequencies_hz.tolist())) > 1:
        raise InputError(
            "several modulation frequencies",
            where=sequence.path or "sequence",
            why=f"four raw frames give a distance at one, found {sorted(set(sequence.frequencies_hz.tolist()))} Hz",
            fix="decode whole cycles, with gftorf_warp.scene.unwrap.cycle_distance",
        )
    if i not in sequence.complete_quartets:
        raise ValueError(f"quartet {i} must be one of the complete ones, {sequence.complete_quartets}")
    frames = slice(FRAMES_PER_QUARTET * i, FRAMES_PER_QUARTET * (i + 1))
    shifts = sequence.shifts[frames]
    model = np.stack([np.cos(shifts), np.sin(shifts), np.ones(len(shifts))], axis=1)
    if np.linalg.svd(model, compute_uv=False).min() < RANK_TOLERANCE:
        raise InputError(
            "phase shifts",
            where=f"{sequence.path or 'sequence'}, frames {frames.start} .. {frames.stop - 1}",
            why=f"expected at least three distinct shifts, found {np.degrees(shifts).tolist()} degrees",
            fix="correct tof_permutation.npy, or the shifts in capture.json",
        )
    return np.tensordot(2.0 * np.linalg.pinv(model)[:2], sequence.quads[frames].astype(np.float64), axes=1)


def closed_form_distance(sequence: Sequence, i: int) -> Float[np.ndarray, "H W"]:
    """Distance [m] of quartet i in [0, c/2f), decoded from raw frames 4i .. 4i + 3 as if simultaneous; float64.

    Raises:
        ValueError: If a frame of the quartet was not measured.
        InputError: If its shifts do not determine a phase.
    """
    re, im = quartet_phasor(sequence, i)
    return distance_from_phase(np.arctan2(im, re), sequence)


def distance_from_phase(phase: np.ndarray, sequence: Sequence) -> np.ndarray:
    """Distance [m] in [0, c/2f) of measured phases [rad], phase offset removed; same shape."""
    wrapped = np.mod(phase - sequence.phase_offset, 2.0 * math.pi)
    wrapped = np.where(wrapped < 2.0 * math.pi, wrapped, 0.0)  # the modulo of -1e-17 rounds up to 2 pi
    return wrapped * (SPEED_OF_LIGHT / (4.0 * math.pi * sequence.f_mod_hz))


def largest_amplitude(sequence: Sequence) -> float:
    """Largest length of a quartet's phasor over all pixels and complete quartets, twice the amplitude of a quad.

    Raises:
        InputError: If no quartet is complete, or all of them are dark.
    """
    largest = max(
        (float(np.hypot(*quartet_phasor(sequence, i)).max()) for i in sequence.complete_quartets), default=0.0
    )
    if not largest > 0.0:
        raise InputError(
            "no light" if sequence.complete_quartets else "no complete quartet",
            where=sequence.path or "sequence",
            why="expected four consecutive raw frames 4i .. 4i + 3 with light, found "
            f"{len(sequence.complete_quartets)} complete quartets, largest amplitude {largest:g}",
            fix="complete the recording",
        )
    return largest


def quad_scale(sequence: Sequence) -> tuple[float, str]:
    """Factor that brings the quads to order one, and where it is from.

    Returns:
        The file's own factor if it states one, else 1 / (largest phasor amplitude of the sequence); its source.

    Raises:
        InputError: If there is no factor and no light to compute one from.
    """
    if sequence.quad_scale is not None:
        return float(sequence.quad_scale), sequence.sources.get("quad_scale", "setting of the sequence")
    return 1.0 / largest_amplitude(sequence), "inferred 1 / largest phasor amplitude"
