"""Estimates from images that reveal a wrong order, offset or scale (``gftorf check``)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..constants import SPEED_OF_LIGHT
from .decode import quartet_phasor
from .flow import warp_back
from .sequence import Sequence, Truth

STATIC_QUANTILE = 0.5  # the half of the pixels that changes least over time is taken as static
DARK_QUANTILE = 0.2  # the darkest pixels change by noise
BRIGHT_QUANTILE = 0.5  # and of those the brighter half, where noise is small
STILL_M = 1e-3  # [m] a pixel whose true distance changes less within a quartet is static
CHANGED = 0.25  # of the amplitude: more than noise on bright pixels
MOVING_PX = 0.5  # [px] flow above this is motion


def steady_pixels(sequence: Sequence) -> np.ndarray:
    """Bright pixels [H, W] whose quads of one slot change least, relative to their amplitude."""
    change = np.zeros(sequence.quads.shape[1:])
    for slot in range(step := sequence.cycle):
        frames = np.flatnonzero(sequence.measured[slot::step]) * step + slot
        if len(frames):
            change = np.maximum(change, np.ptp(sequence.quads[frames].astype(np.float64), axis=0))
    amplitude = np.mean(
        [np.hypot(*quartet_phasor(sequence, i)) for i in sequence.complete_quartets], axis=0
    )
    relative = change / np.maximum(amplitude, np.finfo(np.float64).tiny)
    steady = relative <= np.quantile(relative, STATIC_QUANTILE)
    return steady & (amplitude >= np.quantile(amplitude[steady], BRIGHT_QUANTILE)) & (amplitude > 0)


def changed_share(sequence: Sequence) -> float:
    """Fraction of pixels whose phasor changes from first to last complete quartet, but the darkest;
    those of the brighter half alone may all be near bodies that move.
    """
    first, last = (quartet_phasor(sequence, sequence.complete_quartets[at]) for at in (0, -1))
    amplitude = np.hypot(*first)
    bright = amplitude >= np.quantile(amplitude, DARK_QUANTILE)
    return float((np.hypot(*(last - first)) > CHANGED * amplitude)[bright].mean())


def distance_of_z(sequence: Sequence, truth: Truth) -> np.ndarray:
    """Distances [F, H, W] [m] if the numbers of the truth were z-depths."""
    y, x = np.mgrid[0 : sequence.height, 0 : sequence.width] + 0.5
    tof = sequence.intrinsics
    slope_x, slope_y = (x - tof.cx) / tof.fx, (y - tof.cy) / tof.fy
    return truth.distance * np.sqrt(1.0 + slope_x**2 + slope_y**2).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class PhasorMatch:
    """Relation of stored phasors to those of the quads."""

    correlation: float
    """Length of the complex correlation over steady pixels, 0..1."""
    angle: float
    """Its angle [rad]: 0 if both have the same phase."""
    conjugate: float
    """Length of the correlation with the mirrored phase; near 1 if the sign of the phase is
    swapped."""
    factor: float
    """Stored length / length of the quads' phasor."""


def phasor_match(sequence: Sequence, stored: dict[int, np.ndarray]) -> PhasorMatch | None:
    """Compare stored phasors [H, W, 3], by quartet start, with the quads on steady pixels."""
    steady = steady_pixels(sequence)
    common = [i for i in sequence.complete_quartets if sequence.cycle * i in stored]
    if not common:
        return None
    ours = np.stack([quartet_phasor(sequence, i)[:, steady] for i in common], axis=1)
    theirs = np.stack([stored[sequence.cycle * i][steady, :2].T for i in common], axis=1)
    theirs = theirs.astype(np.float64)
    a, b = ours[0] + 1j * ours[1], theirs[0] + 1j * theirs[1]
    length_a, length_b = (np.sqrt((np.abs(phasors) ** 2).sum()) for phasors in (a, b))
    if not length_b > 0:
        return PhasorMatch(correlation=0.0, angle=0.0, conjugate=0.0, factor=0.0)
    correlation = np.vdot(a, b) / (length_a * length_b)
    conjugate = np.vdot(a.conj(), b) / (length_a * length_b)
    return PhasorMatch(
        correlation=float(abs(correlation)),
        angle=float(np.angle(correlation)),
        conjugate=float(abs(conjugate)),
        factor=float(length_b / length_a),
    )


@dataclass(frozen=True, kw_only=True)
class PhaseFit:
    """Straight line of measured phase against true distance on static pixels."""

    depth_range: float
    """From the slope [m]."""
    phase_offset: float
    """From the intercept [rad], in (-pi, pi]."""
    rms_m: float
    """Root mean square of the residual, as a distance [m]."""
    pixels: int
    """Number of pixels."""


def phase_fit(sequence: Sequence, truth: Truth) -> PhaseFit | None:
    """Fit psi = 4 pi d / depth_range + phase_offset to a hundred static pixels or more, or None."""
    phases, distances = [], []
    kappa = 4.0 * math.pi * sequence.calibration.f_mod_hz / SPEED_OF_LIGHT
    for i in sequence.complete_quartets:
        frames = sequence.quartet_frames(i)
        if not truth.known[frames].all():
            continue
        distance = truth.distance[frames].astype(np.float64)
        still = np.isfinite(distance).all(axis=0)
        still &= np.ptp(np.nan_to_num(distance), axis=0) < STILL_M
        re, im = quartet_phasor(sequence, i)
        amplitude = np.hypot(re, im)
        still &= amplitude >= np.quantile(amplitude, 1.0 - BRIGHT_QUANTILE)
        phases.append(np.arctan2(im, re)[still])
        distances.append(distance[0][still])
    if sum(map(len, phases)) < 100:
        return None
    psi, d = np.concatenate(phases), np.concatenate(distances)
    centre = np.angle(np.exp(1j * (psi - kappa * d)).mean())  # initial offset, for unwrapping
    unwrapped = kappa * d + centre + np.angle(np.exp(1j * (psi - kappa * d - centre)))
    kept = np.ones(len(d), dtype=bool)
    for _ in range(3):  # outliers: a few pixels mix two distances
        slope, offset = kappa, centre
        if np.ptp(d[kept]) > STILL_M:
            slope, offset = np.polyfit(d[kept], unwrapped[kept], 1)
        residual = np.abs(unwrapped - slope * d - offset)
        kept = residual <= 4.0 * np.median(residual) + 1e-9
    return PhaseFit(
        depth_range=4.0 * math.pi / float(slope),
        phase_offset=float(np.angle(np.exp(1j * offset))),
        rms_m=float(np.sqrt((residual[kept] ** 2).mean()) / kappa),
        pixels=int(kept.sum()),
    )


def flow_match(
    sequence: Sequence, flow: dict[int, np.ndarray], step: int
) -> tuple[float, float, float, float] | None:
    """Test of flow: mean |difference| of quads n and n + step where the flow is not small.

    Returns:
        Unwarped, warped by the flow, warped by the flow with its sign flipped, and with dx and dy
        swapped, in quad units; None if no pixel moves.
    """
    sums, count = np.zeros(4), 0
    for n, image in flow.items():
        target = n + step
        if not 0 <= target < sequence.frames or not sequence.measured[[n, target]].all():
            continue
        known = np.nan_to_num(image)
        moving = np.isfinite(image).all(axis=0) & (np.hypot(*known) > MOVING_PX)
        for k, tried in enumerate((np.zeros_like(known), known, -known, known[::-1])):
            difference = warp_back(sequence.quads[target], tried) - sequence.quads[n]
            sums[k] += np.abs(difference)[moving].sum()
        count += int(moving.sum())
    if not count:
        return None
    unwarped, warped, flipped, swapped = (float(value) for value in sums / count)
    return unwarped, warped, flipped, swapped
