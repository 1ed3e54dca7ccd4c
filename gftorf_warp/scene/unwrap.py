"""Two modulation frequencies together know distances farther than each alone (sensor notes, 2.7).

With f_i = m_i f_0 and m_1, m_2 without common divisor the range is c / 2 f_0. Each wrapped phase leaves m_i candidates
(psi_i + 2 pi k) / m_i for the phase at f_0; of all pairs the one that is closest *on the circle* is taken. The two
phases are from raw frames of different times: what moves between them breaks this before noise does.
"""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor

from ..constants import SPEED_OF_LIGHT
from .sensor import Sensor, phasor_from_quads

MULTIPLE_MAX = 16  # f_1 / f_2 is a fraction of numbers up to this: more candidates are closer than any noise allows
COMMENSURATE = 1e-4  # [1] of the ratio: beyond it the phases drift by more than 0.01 rad over the common range


def multiples(first_hz: float, second_hz: float) -> tuple[int, int, float]:
    """(m_1, m_2, f_0 [Hz]) of two modulation frequencies.

    Raises:
        ValueError: If they are equal, or no small multiples of one frequency.
    """
    if not (math.isfinite(first_hz) and math.isfinite(second_hz) and first_hz > 0 and second_hz > 0):
        raise ValueError(f"frequencies must be finite and above 0, got {first_hz} and {second_hz} Hz")
    swapped = first_hz < second_hz
    ratio = Fraction(min(first_hz, second_hz) / max(first_hz, second_hz)).limit_denominator(MULTIPLE_MAX)
    low, high = ratio.numerator, ratio.denominator
    found = max(first_hz, second_hz) / min(first_hz, second_hz)
    if low == 0 or low == high or abs(found * low / high - 1.0) > COMMENSURATE:
        raise ValueError(
            f"{first_hz:g} and {second_hz:g} Hz must be different multiples, up to {MULTIPLE_MAX}, of one frequency"
        )
    m1, m2 = (low, high) if swapped else (high, low)
    return m1, m2, 0.5 * (first_hz / m1 + second_hz / m2)


def unwrap_pair(first: Tensor, second: Tensor, m1: int, m2: int) -> Tensor:
    """Phase [rad] in [0, 2 pi) at the common frequency f_0, from wrapped phases at m_1 f_0 and m_2 f_0.

    Args:
        first: Phase at m_1 f_0 [rad], any shape, wrapped or not; the result is as exact as this one, and differentiable
            by it.
        second: Phase at m_2 f_0 [rad], same shape; it decides between the candidates only.
        m1: Positive, without common divisor with ``m2``.
        m2: Likewise.

    Raises:
        ValueError: If ``m1`` and ``m2`` are not positive or have a common divisor.
    """
    if m1 < 1 or m2 < 1 or math.gcd(m1, m2) != 1:
        raise ValueError(f"multiples must be positive and without common divisor, got {m1} and {m2}")
    turn = 2.0 * math.pi
    first, second = torch.as_tensor(first), torch.as_tensor(second)
    one = torch.stack([(torch.remainder(first, turn) + turn * k) / m1 for k in range(m1)])
    two = torch.stack([(torch.remainder(second, turn) + turn * k) / m2 for k in range(m2)])
    gap = torch.remainder(one[:, None] - two[None] + math.pi, turn) - math.pi
    chosen = gap.detach().abs().amin(dim=1).argmin(dim=0, keepdim=True)
    base = torch.gather(one, 0, chosen)[0]
    return torch.where(base >= turn, torch.zeros_like(base), base)  # a remainder can round up to a whole turn


def unwrap_failure(sigma: float, m1: int, m2: int) -> float:
    """Probability that :func:`unwrap_pair` takes a wrong candidate, phase noise ``sigma`` [rad] on both."""
    return math.erfc(math.pi / (sigma * math.sqrt(2.0 * (m1**2 + m2**2))))


def common_range(sensor: Sensor) -> float:
    """Range [m] that all frequencies of a sensor know together: c / 2 f_0, or c / 2f of a single one.

    Raises:
        ValueError: If there are more than two frequencies, or no small multiples of one.
    """
    if not sensor.further_hz:
        return sensor.unambiguous_range
    return SPEED_OF_LIGHT / (2.0 * _pair(sensor)[2])


def cycle_distance(quads: Tensor, sensor: Sensor) -> Tensor:
    """Distance [m] in [0, c / 2 f_0) of one cycle, as the sensor would decode it: each frequency, then both.

    Args:
        quads: The raw frames [cycle, ...] in the order of ``sensor.cycle``: of one frequency or of two.
        sensor: Its shifts, frequencies and phase offset, which is the same at both frequencies.

    Raises:
        ValueError: If the number of raw frames is another, shifts determine no phase, or frequencies do not fit.
    """
    if len(quads) != len(sensor.cycle):
        raise ValueError(f"quads {tuple(quads.shape)} must start with {len(sensor.cycle)}, the raw frames of a cycle")
    sets = quads.reshape(-1, len(sensor.shifts), *quads.shape[1:])
    phasors = [phasor_from_quads(one, sensor.shifts) for one in sets]
    phases = [torch.remainder(torch.atan2(im, re) - sensor.phase_offset, 2.0 * math.pi) for re, im in phasors]
    if not sensor.further_hz:
        wrapped = torch.where(phases[0] >= 2.0 * math.pi, torch.zeros_like(phases[0]), phases[0])
        return wrapped / sensor.phase_slope
    m1, m2, _ = _pair(sensor)
    return unwrap_pair(phases[0], phases[1], m1, m2) * m1 / sensor.phase_slope


def _pair(sensor: Sensor) -> tuple[int, int, float]:
    if len(sensor.further_hz) > 1:
        raise ValueError(f"two frequencies are unwrapped together, not {1 + len(sensor.further_hz)}")
    return multiples(float(sensor.f_mod_hz), sensor.further_hz[0])
