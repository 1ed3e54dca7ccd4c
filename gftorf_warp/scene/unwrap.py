"""Unwrapping of several modulation frequencies in torch: the candidates are chosen as data/unwrap.py chooses them.

What is chosen has no gradient; the distance is that of the first phase, and differentiable by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..data import unwrap as numbers
from .sensor import Sensor, phasor_from_quads


def unwrap(phases: Sequence[Tensor], ms: Sequence[int]) -> Tensor:
    """Phase [rad] in [0, 2 pi) at the common frequency f_0, from wrapped phases at m_i f_0.

    Args:
        phases: One of any shape for each frequency [rad], wrapped or not; the result is as exact as the first, and
            differentiable by it. The others decide between the candidates only.
        ms: Their multiples: positive, without a common divisor.

    Raises:
        ValueError: If the multiples are not positive or have a common divisor.
    """
    if min(ms) < 1 or math.gcd(*ms) != 1:
        raise ValueError(f"multiples must be positive and without common divisor, got {', '.join(map(str, ms))}")
    turn = 2.0 * math.pi
    phases = [torch.as_tensor(phase) for phase in phases]
    known = np.stack([phase.detach().cpu().double().numpy() for phase in phases])
    turns = torch.as_tensor(numbers.choose(known, ms).turns).to(phases[0])
    base = (torch.remainder(phases[0], turn) + turn * turns) / ms[0]
    return torch.where(base >= turn, torch.zeros_like(base), base)  # a remainder can round up to a whole turn


def unwrap_failure(sigma: float, m1: int, m2: int) -> float:
    """Probability that :func:`unwrap` of two phases takes a wrong candidate, noise ``sigma`` [rad] on both."""
    return math.erfc(math.pi / (sigma * math.sqrt(2.0 * (m1**2 + m2**2))))


def frequencies_of(sensor: Sensor) -> tuple[float, ...]:
    """All modulation frequencies of a sensor [Hz], in the order of its cycle."""
    return (float(sensor.f_mod_hz), *sensor.further_hz)


def common_range(sensor: Sensor) -> float:
    """Range [m] that all frequencies of a sensor know together: c / 2 f_0, or c / 2f of a single one.

    Raises:
        ValueError: If they are no small multiples of one frequency.
    """
    return numbers.common_range(frequencies_of(sensor)) if sensor.further_hz else sensor.unambiguous_range


def cycle_distance(quads: Tensor, sensor: Sensor) -> Tensor:
    """Distance [m] in [0, c / 2 f_0) of one cycle, as the sensor would decode it: each frequency, then all.

    Args:
        quads: The raw frames [cycle, ...] in the order of ``sensor.cycle``.
        sensor: Its shifts, frequencies and phase offset, which is the same at all frequencies.

    Raises:
        ValueError: If the number of raw frames is another, shifts determine no phase, or frequencies do not fit.
    """
    if len(quads) != len(sensor.cycle):
        raise ValueError(f"quads {tuple(quads.shape)} must start with {len(sensor.cycle)}, the raw frames of a cycle")
    sets = quads.reshape(-1, len(sensor.shifts), *quads.shape[1:])
    return distance_from_phasors([phasor_from_quads(one, sensor.shifts) for one in sets], sensor)


def distance_from_phasors(phasors: Sequence[tuple[Tensor, Tensor]], sensor: Sensor) -> Tensor:
    """Distance [m] in [0, c / 2 f_0) of phasors (re, im), one for each frequency of a sensor.

    For a single frequency that is :func:`gftorf_warp.scene.sensor.distance_from_phasor`.

    Raises:
        ValueError: If there are more or fewer than the sensor has frequencies, or these do not fit.
    """
    frequencies = frequencies_of(sensor)
    if len(phasors) != len(frequencies):
        raise ValueError(f"{len(phasors)} phasors for {len(frequencies)} frequencies")
    turn = 2.0 * math.pi
    phases = [torch.remainder(torch.atan2(im, re) - sensor.phase_offset, turn) for re, im in phasors]
    if len(phases) == 1:
        wrapped = torch.where(phases[0] >= turn, torch.zeros_like(phases[0]), phases[0])
        return wrapped / sensor.phase_slope
    ms, _ = numbers.multiples(frequencies)
    return unwrap(phases, ms) * ms[0] / sensor.phase_slope
