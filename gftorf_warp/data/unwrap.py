"""Phase unwrapping by several modulation frequencies, as a sensor computes it.

With f_i = m_i f_0 and m_1, m_2, .. without common divisor the range is c / 2 f_0. A wrapped phase
at f_1 leaves the m_1 candidates (psi_1 + 2 pi k) / m_1 for the phase at f_0. Each candidate
predicts the other phases; the one with the smallest residual of a straight line through all phases
is chosen. For two frequencies that is the pair of candidates closest on the circle (sensor notes,
2.7). The phases are from raw frames of different times: motion between them breaks this before
noise does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..constants import SPEED_OF_LIGHT

# f_1 / f_2 is a fraction of numbers up to this: more candidates are closer than any noise allows
MULTIPLE_MAX = 16
# [1] of the ratio: beyond it the phases drift by more than 0.01 rad over the common range
COMMENSURATE = 1e-4
CONFIDENT = 0.5  # [1] below, another distance has less than twice the residual of the chosen one


class Chosen(NamedTuple):
    """Candidate that fits the phases of several frequencies best."""

    turns: Int[np.ndarray, "*n"]
    """Whole turns k of the first phase, 0 .. m_1 - 1."""
    confidence: Float[np.ndarray, "*n"]
    """1 - (residual of the chosen candidate) / (residual of the second best) [1]: 1 if all phases
    agree, 0 if two distances explain them equally well."""


def multiples(frequencies_hz: Sequence[float]) -> tuple[tuple[int, ...], float]:
    """Multiples m_i without common divisor, and f_0 [Hz], of two or more modulation frequencies.

    Raises:
        ValueError: If two are equal, or they are no small multiples of one frequency.
    """
    listed = ", ".join(f"{f:g}" for f in frequencies_hz)
    if not all(math.isfinite(f) and f > 0 for f in frequencies_hz):
        raise ValueError(f"frequencies must be finite and above 0, got {listed} Hz")
    first = frequencies_hz[0]
    ratios = [Fraction(1), *(_ratio(f, first, listed) for f in frequencies_hz[1:])]
    scale = math.lcm(*(ratio.denominator for ratio in ratios))
    integers = tuple(int(ratio * scale) for ratio in ratios)
    if len(set(integers)) < len(integers):
        raise _incommensurate(listed)
    return integers, sum(f / m for f, m in zip(frequencies_hz, integers, strict=True)) / len(
        integers
    )


def _ratio(one_hz: float, other_hz: float, listed: str) -> Fraction:
    """One / other as a fraction of numbers up to 16."""
    low, high = sorted((one_hz, other_hz))
    ratio = Fraction(low / high).limit_denominator(MULTIPLE_MAX)
    if ratio.numerator == 0 or abs(high / low * float(ratio) - 1.0) > COMMENSURATE:
        raise _incommensurate(listed)
    return ratio if one_hz == low else 1 / ratio


def _incommensurate(listed: str) -> ValueError:
    return ValueError(
        f"{listed} Hz must be different multiples, up to {MULTIPLE_MAX}, of one frequency"
    )


def common_range(frequencies_hz: Sequence[float]) -> float:
    """Unambiguous range [m] of some frequencies together: c / 2 f_0, or c / 2f of a single one.

    Raises:
        ValueError: If they are no small multiples of one.
    """
    base = multiples(frequencies_hz)[1] if len(frequencies_hz) > 1 else frequencies_hz[0]
    return SPEED_OF_LIGHT / (2.0 * base)


def choose(phases: Float[np.ndarray, "f *n"], ms: Sequence[int]) -> Chosen:
    """Choose among the m_1 candidates of the first phase the one that fits all phases best.

    ``phases`` are at m_i f_0 [rad], phase offset removed; ``ms`` are two or more multiples m_i.
    """
    turn = 2.0 * math.pi
    m = np.asarray(ms, dtype=np.float64).reshape(-1, *[1] * (phases.ndim - 1))
    first = np.mod(phases[0], turn)
    best, second = (np.full(phases.shape[1:], np.inf) for _ in range(2))
    turns = np.zeros(phases.shape[1:], dtype=np.int64)
    for k in range(ms[0]):
        expected = m * ((first + turn * k) / ms[0])
        error = np.mod(phases - expected + math.pi, turn) - math.pi
        error[0] = 0.0
        left = np.sum(error**2, axis=0) - np.sum(m * error, axis=0) ** 2 / float(np.sum(m**2))
        left = np.maximum(left, 0.0)
        nearer = left < best
        second = np.where(nearer, best, np.minimum(second, left))
        turns[nearer] = k
        best = np.where(nearer, left, best)
    # one candidate, which the other phases may contradict: compared with a whole turn of the finest
    if ms[0] == 1:
        second = np.full(phases.shape[1:], _spacing(m.ravel()))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.sqrt(np.where(second > 0, best / second, 1.0))
    return Chosen(turns, np.clip(1.0 - share, 0.0, 1.0))


def _spacing(m: np.ndarray) -> float:
    """Smallest squared residual [rad^2] of one more turn of one phase where all others agree."""
    return float(min((2.0 * math.pi) ** 2 * (1.0 - one**2 / np.sum(m**2)) for one in m))


def wrapped(phase: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """A phase [rad] in [0, 2 pi)."""
    turn = 2.0 * math.pi
    remainder = np.mod(phase, turn)
    return np.where(remainder < turn, remainder, 0.0)  # the modulo of -1e-17 rounds up to 2 pi
