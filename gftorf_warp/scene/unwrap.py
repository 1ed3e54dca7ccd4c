"""Unwrapping of several frequencies in torch, by the candidates of data/unwrap.py.

The choice has no gradient; the distance is that of the first phase, and differentiable with respect
to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..data import unwrap as numbers
from .sensor import Sensor, distance_from_phasor, within_half_turn


def unwrap(phases: Sequence[Tensor], ms: Sequence[int]) -> Tensor:
    """Phase [rad] in [0, 2 pi) at the common frequency f_0, from wrapped phases at m_i f_0.

    The result is as exact as the first phase, and differentiable with respect to it; the others
    only select among the candidates.

    Raises:
        ValueError: If the multiples are not positive or have a common divisor.
    """
    if min(ms) < 1 or math.gcd(*ms) != 1:
        raise ValueError(
            f"multiples must be positive and without common divisor, got {', '.join(map(str, ms))}"
        )
    turn = 2.0 * math.pi
    phases = [torch.as_tensor(phase) for phase in phases]
    known = np.stack([phase.detach().cpu().double().numpy() for phase in phases])
    turns = torch.as_tensor(numbers.choose(known, ms).turns).to(phases[0])
    base = (torch.remainder(phases[0], turn) + turn * turns) / ms[0]
    # a remainder can round up to a whole turn
    return torch.where(base >= turn, torch.zeros_like(base), base)


def frequencies_of(sensor: Sensor) -> tuple[float, ...]:
    """All modulation frequencies of a sensor [Hz], in the order of its cycle."""
    return (float(sensor.f_mod_hz), *sensor.further_hz)


def common_range(sensor: Sensor) -> float:
    """Unambiguous range [m] of all frequencies of a sensor together: c / 2 f_0.

    Raises:
        ValueError: If they are no small multiples of one frequency.
    """
    if not sensor.further_hz:
        return sensor.unambiguous_range
    return numbers.common_range(frequencies_of(sensor))


def distance_from_phasors(phasors: Sequence[tuple[Tensor, Tensor]], sensor: Sensor) -> Tensor:
    """Distance [m] in [0, c / 2 f_0) of phasors (re, im), one for each frequency of a sensor.

    Raises:
        ValueError: If there are more or fewer than the sensor has frequencies, or these do not fit.
    """
    frequencies = frequencies_of(sensor)
    if len(phasors) != len(frequencies):
        raise ValueError(f"{len(phasors)} phasors for {len(frequencies)} frequencies")
    if len(phasors) == 1:
        return distance_from_phasor(*phasors[0], sensor)
    offset = within_half_turn(sensor.phase_offset)
    angles = [torch.atan2(im, re) - offset for re, im in phasors]
    phases = [torch.remainder(angle, 2.0 * math.pi) for angle in angles]
    ms, _ = numbers.multiples(frequencies)
    return unwrap(phases, ms) * ms[0] / sensor.phase_slope
