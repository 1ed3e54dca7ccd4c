"""From mean light to what a sensor writes down: taps, shot and read noise, full well, ADC (sensor notes, 2.3 to 2.5).

With a the amplitude and q = a (cos(psi - shift) + b) the quad of a pixel in relative units, and G electrons per unit,

    N_s = G a                                            modulated electrons, both taps together
    n_A, n_B = 1/2 [N_a + N_s +- C G q] + N_dark         mean electrons per tap; N_a ambient, C contrast
    n'  = min(Poisson(n) + Normal(0, s_r), full well)    per tap
    differential   code = clip(round((n'_A - n'_B) / e))           signed;    quad = code e / (C G)
    unipolar       code = clip(round(n'_A / e) + pedestal)         unsigned;  quad = (n'_A - N_a/2 - N_dark) 2 / (C G)

A unipolar sensor has C = 1 / b; the constant levels that it subtracts are known to it. The numbers written are in
relative units again, and without clipping their mean is q. Their phase noise is that of section 2.5; for four shifts

    sigma_psi = sqrt((N_s + N_a)/2 + N_dark + s_r^2) / (C N_s)     differential, b = 0
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..scene.sensor import Sensor

REFERENCE_EXPOSURE_S = 2.34e-3  # the exposure that electrons_per_unit refers to


class Reading(NamedTuple):
    """One raw frame as recorded."""

    quad: Float[np.ndarray, "H W"]
    """Relative units, float32."""
    saturated: Bool[np.ndarray, "H W"]
    """Where a tap was full or the ADC at its end: the quad is then wrong, not only noisy."""


def electron_gain(sensor: Sensor) -> float:
    """Modulated electrons per exposure and relative unit of amplitude, G, both taps together [e-]."""
    return sensor.electrons_per_unit * sensor.exposure_s / REFERENCE_EXPOSURE_S


def contrast(sensor: Sensor) -> float:
    """Demodulation contrast C [1]: a setting of a differential sensor, 1 / dc_offset of a unipolar one."""
    return 1.0 / float(sensor.dc_offset) if sensor.unipolar else sensor.contrast


def mean_taps(
    quad: Float[np.ndarray, "H W"], amplitude: Float[np.ndarray, "H W"], sensor: Sensor
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Mean electrons (n_A, n_B) of the two taps.

    Args:
        quad: Mean quad of the raw frame, DC offset included [relative units].
        amplitude: Mean amplitude a, source intensity included [relative units].
        sensor: Gain, contrast, ambient and dark electrons.

    Raises:
        ValueError: If a tap would hold a negative number of electrons: contrast and DC offset contradict each other.
    """
    gain = electron_gain(sensor)
    signal = contrast(sensor) * gain * np.asarray(quad, dtype=np.float64)
    if sensor.unipolar:  # the offset is the light itself, not a difference of the taps
        signal = signal - gain * np.asarray(amplitude, dtype=np.float64)
    common = 0.5 * (sensor.ambient_electrons + gain * np.asarray(amplitude, dtype=np.float64))
    dark = sensor.dark_electrons_per_s * sensor.exposure_s
    taps = common + 0.5 * signal + dark, common - 0.5 * signal + dark
    least = min(tap.min() for tap in taps)
    if least < -1e-3:  # less than rounding of float32 quads can do
        raise ValueError(
            f"a tap would hold {least:.3g} electrons: contrast {contrast(sensor):.3g} times (1 + |dc_offset|) "
            f"{1 + abs(float(sensor.dc_offset)):.3g} must not exceed 1 for a differential sensor"
        )
    return np.maximum(taps[0], 0.0), np.maximum(taps[1], 0.0)


def read_out(
    quad: Float[np.ndarray, "H W"],
    amplitude: Float[np.ndarray, "H W"],
    sensor: Sensor,
    generator: np.random.Generator,
) -> Reading:
    """What ``sensor`` writes down for one raw frame.

    Args:
        quad: Mean quad, DC offset included [relative units].
        amplitude: Mean amplitude a, source intensity included [relative units].
        sensor: Without ``noise`` the mean is returned as it is.
        generator: Source of all randomness. The order of draws is fixed: shots A, shots B, reads A, reads B.

    Raises:
        ValueError: If the sensor's contrast and DC offset contradict each other, see :func:`mean_taps`.
    """
    if not sensor.noise:
        return Reading(np.asarray(quad, dtype=np.float32), np.zeros(np.shape(quad), dtype=bool))
    mean_a, mean_b = mean_taps(quad, amplitude, sensor)
    shots_a, shots_b = generator.poisson(mean_a), generator.poisson(mean_b)  # exact at any mean: no normal limit needed
    tap_a = shots_a + generator.normal(0.0, sensor.read_noise_electrons, mean_a.shape)
    tap_b = shots_b + generator.normal(0.0, sensor.read_noise_electrons, mean_b.shape)
    full_a, full_b = tap_a >= sensor.full_well_electrons, tap_b >= sensor.full_well_electrons
    tap_a, tap_b = (np.minimum(tap, sensor.full_well_electrons) for tap in (tap_a, tap_b))
    unit = contrast(sensor) * electron_gain(sensor)
    if sensor.unipolar:
        electrons, clipped = quantise(tap_a, sensor)
        level = 0.5 * sensor.ambient_electrons + sensor.dark_electrons_per_s * sensor.exposure_s
        return Reading((2.0 * (electrons - level) / unit).astype(np.float32), full_a | clipped)
    electrons, clipped = quantise(tap_a - tap_b, sensor)
    return Reading((electrons / unit).astype(np.float32), full_a | full_b | clipped)


def quantise(
    electrons: Float[np.ndarray, "H W"], sensor: Sensor
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Electrons through the ADC and back [e-], and where it was at an end of its range.

    Codes run from -2^(bits-1) to 2^(bits-1) - 1. A unipolar sensor has a pedestal, one 64th of the range above the
    lowest code, so that read noise around zero is not cut off; it is subtracted again.
    """
    if sensor.adc_bits is None:
        return electrons, np.zeros(np.shape(electrons), dtype=bool)
    codes = 2**sensor.adc_bits
    low, high = -codes // 2, codes // 2 - 1
    zero = low + codes // 64 if sensor.unipolar else 0
    code = np.round(electrons / sensor.electrons_per_code) + zero
    return (np.clip(code, low, high) - zero) * sensor.electrons_per_code, (code <= low) | (code >= high)
