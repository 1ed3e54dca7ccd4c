"""Findings of ``gftorf check`` about phase, without ground truth: order, offset, wraps."""

from __future__ import annotations

import math

import numpy as np

from ..constants import SPEED_OF_LIGHT
from .decode import unambiguous_range
from .falloff import Pairs
from .hypotheses import EXPLAINS, TURNED_GAIN, hypotheses, offset_by_falloff, stated_pairs
from .noise import amplitudes_of, quad_noise
from .report import Report
from .sequence import Sequence
from .temporal import camera_rests

SHOWN = 3  # hypotheses in a message
# [1] of the quads: on thirty simulated scenes, where bodies move, a cosine leaves 0.022 at most
NO_COSINE, NOISES = 0.05, 2.0  # and as many times the noise
FITTED = 3  # unknowns of a cosine and a constant
MEDIAN_NOISE = 1.25  # of a median over that of a mean, both of normal distributions
# [1] of the pairs of neighbours on one surface: none wraps where all surfaces are well within the
# range, one in a thousand where a dark and noisy one is at 0.94 of it
WRAPPED_SHARE = 2.5e-3


def phase(sequence: Sequence, report: Report) -> None:
    """Order, then offset, then wraps: each can be mistaken for the next, and is reported alone."""
    for rule in (order, offset, wraps):
        before = len(report.findings)
        rule(sequence, report)
        if len(report.findings) > before:
            return


def order(sequence: Sequence, report: Report) -> None:
    """Order and sign of the shifts, by ranked hypotheses; if it is right, what no cosine fits."""
    stated, *others = hypotheses(sequence)
    best = others[0]
    text = f"{stated.degrees} degrees as stated: {stated.evidence}"
    report.add("order", f"{text}; next best {best.degrees}: {best.evidence}")
    better = [one for one in others if one.beats(stated)]
    if better:
        listed = "; ".join(
            f"{k}. {one.option(sequence, report.form)} ({one.evidence})"
            for k, one in enumerate(better[:SHOWN], start=1)
        )
        report.warn(
            "order",
            f"quad order doubtful: {stated.degrees} degrees, {stated.evidence}; better: {listed}",
        )
    elif stated.unexplained > max(NO_COSINE, NOISES * _noise(sequence)):
        report.warn(
            "wiggling",
            f"{stated.unexplained:.0%} of the quads is no cosine of the shift, noise would be "
            f"{_noise(sequence):.1%}: harmonics of the modulation, wrong shifts, or a response "
            "that is not linear; distances wiggle with the phase",
        )


def _noise(sequence: Sequence) -> float:
    """Noise of the quads that :func:`hypotheses` compares, over their size, of a typical pixel."""
    noise, quartets = quad_noise(sequence), sequence.complete_quartets
    assert noise is not None, "there are complete quartets"
    amplitude = amplitudes_of(sequence, quartets[len(quartets) // 2])
    relative = noise.sigma(amplitude) / np.maximum(amplitude, np.finfo(np.float64).tiny)
    averaged = len(quartets) if camera_rests(sequence) else 1
    free = 1.0 - FITTED / len(relative)  # share of the noise that a cosine and a constant leave
    typical = math.sqrt(2.0 * free) * float(np.median(relative))
    return MEDIAN_NOISE * typical / math.sqrt(averaged)


def offset(sequence: Sequence, report: Report) -> None:
    """Phase offset, by the fall-off of the amplitude."""
    fit = offset_by_falloff(sequence)
    if fit is None:
        report.add("fall-off", "too few pixels on one surface")
        return
    best, measure, stated = fit
    used = sequence.calibration.phase_offset
    text = f"{stated:.3f} with phase_offset {used:.3g}, least {measure:.3f} with {best:+.2f} rad"
    report.add("fall-off", f"{text}; 1 is none, see docs/check.md")
    if stated - measure > TURNED_GAIN and measure < EXPLAINS:
        report.warn(
            "offset",
            f"amplitudes fall with distance as they should with a phase_offset near {best:+.1f} "
            f"rad, measure {measure:.2f}, not with {used:.4g} rad, {stated:.2f}: degrees, or not "
            "calibrated?",
        )


def wraps(sequence: Sequence, report: Report) -> None:
    """Surfaces on which the distance jumps by the unambiguous range."""
    pairs, range_m = stated_pairs(sequence), SPEED_OF_LIGHT / (2.0 * sequence.frequencies[0])
    if pairs is None or len(sequence.frequencies) > 1:
        return
    share = _wrapped(pairs, sequence.calibration.phase_offset)
    report.add("wraps", f"{share:.2%} of neighbours on one surface jump by {range_m:.4g} m")
    if share > WRAPPED_SHARE:
        report.warn(
            "wrap",
            f"{share:.1%} of neighbours on one surface jump by {unambiguous_range(sequence):.4g} "
            "m: surfaces reach beyond the unambiguous range, or phase_offset is wrong",
        )


def _wrapped(pairs: Pairs, used: float) -> float:
    """Share of pairs with the end of the range between them."""
    turns = np.mod((pairs.phases - used) / (2.0 * math.pi), 1.0)
    return float((np.abs(turns[1] - turns[0]) > 0.5).mean())
