"""Closed forms of a sensor that tests compare with: what a cycle decodes to,
failures of unwrapping, wiggling, noise.

A tap holds B + A cos(..) electrons and adds read noise of deviation s_r. With K equally spaced
shifts (sensor notes, 2.2 to 2.5)

    sigma_psi = sqrt(2/K) sqrt(B + s_r^2) / A      one tap          sigma_d = c / (4 pi f) sigma_psi
              = sqrt(1/K) sqrt(B + s_r^2) / A      two taps

for all phases, except with three shifts of one tap. An ADC of e electrons per code adds e^2/12 to
the variance of a quad: to one tap, or half of it to each of two.
"""

import math

import numpy as np
import torch

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.scene.electrons import contrast, dark_electrons, electron_gain
from gftorf_warp.scene.sensor import phasor_from_quads
from gftorf_warp.scene.unwrap import distance_from_phasors


def cycle_distance(quads, sensor):
    """Distance [m] in [0, c / 2 f_0) of the raw frames [cycle, ...] of one cycle,
    in the order of ``sensor.cycle``.
    """
    sets = quads.reshape(-1, len(sensor.shifts), *quads.shape[1:])
    return distance_from_phasors([phasor_from_quads(one, sensor.shifts) for one in sets], sensor)


def unwrap_failure(sigma, m1, m2):
    """Probability that unwrapping of two phases takes a wrong candidate,
    noise ``sigma`` [rad] on both.
    """
    return math.erfc(math.pi / (sigma * math.sqrt(2.0 * (m1**2 + m2**2))))


def wiggling(phase, ratios, samples):
    """Decoded minus true phase [rad] of ``samples`` equally spaced shifts, to first order in the
    harmonics' ratios.

    A harmonic is aliased to the fundamental if it is a neighbour of a multiple of the number of
    shifts, and has no effect otherwise (sensor notes, 2.6).
    """
    error = np.zeros(np.shape(phase))
    for h, ratio in enumerate(ratios, start=2):
        if (h - 1) % samples == 0:
            error = error + ratio * np.sin((h - 1) * phase)
        if (h + 1) % samples == 0:
            error = error - ratio * np.sin((h + 1) * phase)
    return error


def phase_noise(
    mean,
    amplitude,
    read,
    samples,
    *,
    taps=2,
    phase=None,
):
    """Standard deviation of a decoded phase [rad], where it is small against 1.

    Args:
        mean: Mean electrons B of a tap [e-]; number or tensor.
        amplitude: Amplitude A of the electrons of a tap [e-]; likewise.
        read: Standard deviation of the read noise of a tap [e-].
        samples: Number K of equally spaced shifts.
        taps: 1, or 2 whose difference is taken.
        phase: True phase [rad]; only K = 3 with one tap depends on it. None: the mean over all
            phases.

    Raises:
        ValueError: If there are fewer than three shifts, or another number of taps.
    """
    if samples < 3 or taps not in (1, 2):
        raise ValueError(
            f"a phase needs at least 3 samples, got {samples}, of 1 or 2 taps, got {taps}"
        )
    mean, amplitude = (
        torch.as_tensor(mean, dtype=torch.float64),
        torch.as_tensor(amplitude, dtype=torch.float64),
    )
    tap = mean + read**2
    variance = 2.0 / (taps * samples) * tap / amplitude**2
    if taps == 1 and samples == 3 and phase is not None:
        variance = variance * (
            1.0 - amplitude * torch.cos(3.0 * torch.as_tensor(phase)) / (2.0 * tap)
        )
    return variance.sqrt()


def predicted_phase_noise(amplitude, sensor):
    """Standard deviation [rad] of the phase that ``sensor`` decodes at its first frequency.

    A plain sine, equally spaced shifts and nothing full are assumed; patterns are left out.

    Args:
        amplitude: Relative amplitude a = s r / d^2 of one surface [1]; number or tensor.
        sensor: Electrons, contrast, taps, number of shifts.
    """
    active = electron_gain(sensor) * torch.as_tensor(amplitude, dtype=torch.float64)
    taps = 1 if sensor.unipolar else 2
    step = 0.0 if sensor.adc_bits is None else sensor.electrons_per_code
    added = math.sqrt(sensor.read_noise_electrons**2 + step**2 / (12.0 * taps))
    mean = 0.5 * (sensor.ambient_electrons + active) + dark_electrons(sensor)
    return phase_noise(mean, 0.5 * contrast(sensor) * active, added, len(sensor.shifts), taps=taps)


def predicted_distance_noise(amplitude, sensor):
    """Standard deviation [m] of a decoded distance; see :func:`predicted_phase_noise`.

    Differentiable by ``f_mod_hz``: -sigma (1/f + C'/C). The modulation frequency with the least
    noise is the cutoff of the contrast; long before, distances are no longer unambiguous.
    """
    return (
        SPEED_OF_LIGHT
        / (4.0 * math.pi * sensor.f_mod_hz)
        * predicted_phase_noise(amplitude, sensor)
    )
