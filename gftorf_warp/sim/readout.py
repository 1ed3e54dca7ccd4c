"""Read-out of a sensor: taps, shot and read noise, full well and ADC.

See sensor notes, 2.3 to 2.5. With S_h the light of a pixel at harmonic h, a the amplitude, r_h the
contrast of h relative to that of the first, and p the fixed phase pattern, the quad in relative
units is

    q = Re sum_h r_h S_h exp(i h (phase_offset + p - shift)) + a b

With G electrons per unit,

    N_s = G a                                            modulated electrons, both taps together
    n_A, n_B = 1/2 [N_a + N_s +- C G q] + N_dark         mean electrons per tap; N_a ambient
    n'  = min(Poisson(n) + Normal(0, s_r), full well)    per tap
    differential   code = clip(round((n'_A - n'_B) / e)),      quad = code e / (C G)
    unipolar       code = clip(round(n'_A / e) + pedestal)
                   quad = (n'_A - N_a/2 - N_dark) 2 / (C G)

C is the contrast. Differential codes are signed. A unipolar sensor has C = 1 / b. It subtracts
constant levels: ambient light, measured by a frame without active light, and the mean dark current
of all pixels. The fixed pattern multiplies all light by the gain of each pixel, and the dark
current by another factor. Results are in relative units again; without clipping their mean is q
times the gain. tests/closed_forms.py predicts their phase noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from ..errors import UsageError
from ..scene.electrons import contrast, dark_electrons, electron_gain
from ..scene.optics import Shading
from ..scene.pattern import dark_map, gain_map, phase_map
from ..scene.sensor import Sensor
from ..scene.waveform import peak

ELECTRONS_MAX = 1e18  # of a mean that can be drawn: NumPy counts in 64 bits
Level = float | Float[np.ndarray, "H W"]


class Reading(NamedTuple):
    """One raw frame as recorded."""

    quad: Float[np.ndarray, "H W"]
    """Relative units, float32."""
    saturated: Bool[np.ndarray, "H W"]
    """Whether a tap was full or the ADC at an end of its range: the quad is then biased."""
    total: Float[np.ndarray, "H W"] | None = None
    """Sum of both taps, ambient and dark electrons included [relative units], float32; None: not
    read."""


def why_impossible(sensor: Sensor) -> str | None:
    """Why the taps of a sensor would hold negative light; None if they do not."""
    height, offset = peak(sensor.harmonic_contrast), abs(float(sensor.dc_offset))
    share = float(contrast(sensor))
    if share * height + (0.0 if sensor.unipolar else share * offset) <= 1.0 + 1e-6:
        return None
    kind = "one tap allows" if sensor.unipolar else "differential taps allow"
    harmonics = f", peak {height:g} with its harmonics" if sensor.harmonic_contrast else ""
    actual = f"{share:g} (1 + {offset:g}){harmonics}"
    return f"{kind} contrast (1 + |dc_offset|) <= 1, not {actual}"


def mean_quad(
    light: Complex[np.ndarray, "h H W"], amplitude: Float[np.ndarray, "H W"], sensor: Sensor
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Mean quad of the sensor's first shift, and mean amplitude, of every pixel.

    ``light`` is the sum of amplitude exp(i h phase) for each h of ``sensor.harmonics``, for a
    source intensity of 1 and without phase offset [relative units]; ``amplitude`` likewise.

    Raises:
        ValueError: If there is light at another number of harmonics.
    """
    if len(light) != len(sensor.harmonics):
        wanted = f"{len(sensor.harmonics)}, the number of harmonics"
        raise ValueError(f"light {light.shape} must start with {wanted}")
    intensity = float(sensor.source_intensity)
    amplitude = intensity * amplitude.astype(np.float64)
    pattern = phase_map(sensor.pattern, *amplitude.shape)
    angle = float(sensor.phase_offset) - sensor.shifts[0] + (0.0 if pattern is None else pattern)
    quad = intensity * (light[0] * np.exp(1j * angle)).real + float(sensor.dc_offset) * amplitude
    for h, image in zip(sensor.harmonics[1:], light[1:], strict=True):
        quad = quad + intensity * sensor.contrast_ratio(h) * (image * np.exp(1j * h * angle)).real
    return quad, amplitude


def mean_taps(
    quad: Float[np.ndarray, "H W"],
    amplitude: Float[np.ndarray, "H W"],
    sensor: Sensor,
    ambient: Float[np.ndarray, "H W"] | None = None,
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Mean electrons (n_A, n_B) of the two taps; arguments as for :func:`read_out`.

    Raises:
        ValueError: If a tap would hold a negative number of electrons: contrast and DC offset
            contradict each other.
    """
    gain = electron_gain(sensor)
    signal = float(contrast(sensor)) * gain * np.asarray(quad, dtype=np.float64)
    light = gain * np.asarray(amplitude, dtype=np.float64)
    if sensor.unipolar:  # the offset is the light of the tap, not a difference of two
        signal = signal - light
    common = 0.5 * (_ambient(sensor, ambient) + light)
    spread = dark_map(sensor.pattern, *common.shape)
    dark = dark_electrons(sensor) if spread is None else dark_electrons(sensor) * spread
    taps = common + 0.5 * signal + dark, common - 0.5 * signal + dark
    least = min(tap.min() for tap in taps)
    if least < -1e-3:  # beyond the rounding errors of float32 quads
        share, height = float(contrast(sensor)), 1 + abs(float(sensor.dc_offset))
        raise ValueError(
            f"a tap would hold {least:.3g} electrons: contrast {share:.3g} times (1 + |dc_offset|) "
            f"{height:.3g} must not exceed 1 for a differential sensor"
        )
    return np.maximum(taps[0], 0.0), np.maximum(taps[1], 0.0)


def read_out(
    quad: Float[np.ndarray, "H W"],
    amplitude: Float[np.ndarray, "H W"],
    sensor: Sensor,
    generator: np.random.Generator,
    *,
    ambient: Float[np.ndarray, "H W"] | None = None,
    shading: Shading | None = None,
    taps: bool = False,
) -> Reading:
    """Simulate the read-out of one raw frame.

    Args:
        quad: Mean quad, DC offset included [relative units].
        amplitude: Mean amplitude a, source intensity included [relative units].
        sensor: Without ``noise`` the mean is returned, after ``shading`` and the pattern of the
            gain.
        generator: Source of all randomness. The order of draws is fixed: shots A, shots B, reads A,
            reads B.
        ambient: Share of even ambient light that each pixel reflects [1]; None: 1.
        shading: Factors of the light of each pixel; None: 1.
        taps: Whether the sum of both taps is wanted, too.

    Raises:
        ValueError: If the sensor's contrast and DC offset contradict each other.
        UsageError: If there are more electrons than a 64-bit number counts.
    """
    response = gain_map(sensor.pattern, *np.shape(quad))
    for active, other in [
        *([] if shading is None else [shading]),
        *([] if response is None else [(response, response)]),
    ]:
        quad, amplitude = quad * active, amplitude * active
        ambient = other if ambient is None else ambient * other
    unit = float(contrast(sensor)) * electron_gain(sensor)
    if not sensor.noise:
        exact = np.asarray(quad, dtype=np.float32), np.zeros(np.shape(quad), dtype=bool)
        if not taps:
            return Reading(*exact)
        both = np.add(*mean_taps(quad, amplitude, sensor, ambient)) / unit
        return Reading(*exact, both.astype(np.float32))
    mean_a, mean_b = mean_taps(quad, amplitude, sensor, ambient)
    most = max(mean_a.max(), mean_b.max())
    if not most <= ELECTRONS_MAX:
        raise UsageError(
            "more electrons than can be drawn",
            where="sensor",
            why=f"a tap collects {most:.3g} of them in one exposure",
            fix="lower the light: electrons_per_unit, ambient_electrons, exposure_s or the pattern",
        )
    shots_a, shots_b = generator.poisson(mean_a), generator.poisson(mean_b)
    tap_a = shots_a + generator.normal(0.0, sensor.read_noise_electrons, mean_a.shape)
    tap_b = shots_b + generator.normal(0.0, sensor.read_noise_electrons, mean_b.shape)
    full_a, full_b = tap_a >= sensor.full_well_electrons, tap_b >= sensor.full_well_electrons
    tap_a, tap_b = (np.minimum(tap, sensor.full_well_electrons) for tap in (tap_a, tap_b))
    total = ((tap_a + tap_b) / unit).astype(np.float32) if taps else None
    if sensor.unipolar:
        electrons, clipped = quantise(tap_a, sensor)
        level = 0.5 * _ambient(sensor, ambient) + dark_electrons(sensor)
        return Reading(
            (2.0 * (electrons - level) / unit).astype(np.float32), full_a | clipped, total
        )
    electrons, clipped = quantise(tap_a - tap_b, sensor)
    return Reading((electrons / unit).astype(np.float32), full_a | full_b | clipped, total)


def quantise(
    electrons: Float[np.ndarray, "H W"], sensor: Sensor
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Electrons after quantisation by the ADC [e-], and whether it was at an end of its range.

    Codes run from -2^(bits-1) to 2^(bits-1) - 1. A unipolar sensor has a pedestal, one 64th of the
    range above the lowest code, so that read noise around zero is not clipped; it is subtracted
    again.
    """
    if sensor.adc_bits is None:
        return electrons, np.zeros(np.shape(electrons), dtype=bool)
    codes = 2**sensor.adc_bits
    low, high = -codes // 2, codes // 2 - 1
    zero = low + codes // 64 if sensor.unipolar else 0
    code = np.round(electrons / sensor.electrons_per_code) + zero
    ends = (code <= low) | (code >= high)
    return (np.clip(code, low, high) - zero) * sensor.electrons_per_code, ends


def _ambient(sensor: Sensor, share: Float[np.ndarray, "H W"] | None) -> Level:
    """Ambient electrons of a pixel, both taps together [e-]."""
    return sensor.ambient_electrons if share is None else sensor.ambient_electrons * share
