"""Waveforms of modulation: their harmonics, and the contrast of each.

Light is emitted as 1 + sum_h s_h cos(h w t), a tap opens as (1 + sum_h m_h cos(h (w t - shift))) /
2, and a quad has

    sum_h C_h cos(h (psi - shift)),   C_h = s_h m_h / 2

(sensor notes, 2.3). Decoding assumes a sine, so harmonics cause a phase-dependent phase error,
*wiggling*.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence

import numpy as np


class Waveform(enum.StrEnum):
    """The shape of one period."""

    SINE = "sine"
    SQUARE = "square"


def harmonics_of(wave: Waveform, count: int, duty: float = 0.5) -> tuple[float, ...]:
    """Cosine coefficients 1 .. ``count`` of a periodic wave whose mean is 1 [1].

    A sine is 1 + cos, a square wave on for the share ``duty`` of a period; a short pulse has a
    larger first coefficient, 2 sin(pi D) / (pi D).

    Raises:
        ValueError: If the duty is not between 0 and 1, or there is no coefficient.
    """
    if not 0 < duty < 1 or count < 1:
        raise ValueError(f"duty {duty} must be between 0 and 1, and count {count} at least 1")
    if Waveform(wave) is Waveform.SINE:
        return (1.0, *[0.0] * (count - 1))
    angles = [math.pi * h * duty for h in range(1, count + 1)]
    return tuple(2.0 * math.sin(angle) / angle for angle in angles)


def contrasts(
    emission: Waveform, demodulation: Waveform, count: int, duty: float = 0.5
) -> tuple[float, ...]:
    """Contrast C_h of harmonics h = 1 .. ``count`` [1]; ``duty`` of the emission, taps 1/2.

    Raises:
        ValueError: If the duty is not between 0 and 1, or there is no coefficient.
    """
    pairs = zip(harmonics_of(emission, count, duty), harmonics_of(demodulation, count), strict=True)
    return tuple(0.5 * s * m for s, m in pairs)


def contrast_ratios(
    emission: Waveform, demodulation: Waveform, count: int, duty: float = 0.5
) -> tuple[float, ...]:
    """C_h / C_1 for h = 2 .. ``count`` [1]; arguments as in :func:`contrasts`.

    Rounding errors of contrasts that are exactly 0, those of even harmonics of a square wave, are
    set to 0.
    """
    first, *others = contrasts(emission, demodulation, count, duty)
    return tuple(0.0 if abs(other) < 1e-12 else other / first for other in others)


def peak(ratios: Sequence[float]) -> float:
    """Largest magnitude of cos x + sum_h r_h cos(h x) [1]; ``ratios`` start at h = 2."""
    # 256 points in the shortest period
    x = np.linspace(0.0, 2.0 * math.pi, 256 * (len(ratios) + 1))
    wave = sum(r * np.cos(h * x) for h, r in enumerate((1.0, *ratios), start=1))
    return float(np.abs(wave).max())
