"""Sensors by name: two products and three of public data sets (sensor notes, 3).

    gftorf simulate occlusion --override sensor=mlx75027
    sensor = "mlx75027"                                     in a scene file

A name sets every field of the sensor; single ones can be changed after it. Products are
approximated: no unit was measured, and unpublished values are assumed, as stated below. Lens, image
size and field of view are the scene's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from ..scene.pattern import Pattern
from ..scene.sensor import Sensor

# real F-TöRF files: -cos, +sin, +cos, -sin
PALINDROMIC = tuple(math.radians(angle) for angle in (180, 90, 0, 270))
SEQUENTIAL = tuple(math.radians(angle) for angle in (0, 90, 180, 270))
GAIN, DARK = 0.01, 0.2  # [1] PRNU and DSNU, assumed for both makers


def ftorf_synthetic() -> Sensor:
    """The synthetic F-TöRF sequences: one ideal tap, an instant; 19.986 MHz."""
    return Sensor(
        f_mod_hz=SPEED_OF_LIGHT / 15.0,
        shifts=CANONICAL_SHIFTS,
        dc_offset=1.0,
        unipolar=True,
        exposure_s=0.0,
    )


def ftorf_real() -> Sensor:
    """The real F-TöRF captures: two taps, their order of shifts, electrons of an OPT8241.

    The files say 19.986 MHz, the paper 30 MHz: ``sensor.f_mod_hz=29.979e6`` for the latter.
    """
    return Sensor(f_mod_hz=SPEED_OF_LIGHT / 15.0, shifts=PALINDROMIC, noise=True)


def torf_real() -> Sensor:
    """The TöRF captures: 29.979 MHz, unambiguous to 5 m, to be written as phasors, 30 a second."""
    return Sensor(f_mod_hz=SPEED_OF_LIGHT / 10.0, shifts=PALINDROMIC, noise=True)


def opt8241_cdk() -> Sensor:
    """Like a TI OPT8241 in its CDK-EVM kit, at 30 MHz.

    From its datasheet: contrast, 12 bits; from its SDK: exposure at 18/64 duty, phase pattern.
    Assumed: read noise, full well, dark current, electrons per code, PRNU, DSNU, and the f/1.2 lens
    behind the electrons per unit.
    """
    return Sensor(
        f_mod_hz=30e6,
        shifts=PALINDROMIC,
        noise=True,
        exposure_s=2.34e-3,
        electrons_per_unit=3.144e5,
        contrast=0.45,
        dark_electrons_per_s=5.0e4,
        read_noise_electrons=80.0,
        full_well_electrons=1.0e5,
        adc_bits=12,
        electrons_per_code=32.0,
        pattern=Pattern(phase=1.0, gain=GAIN, dark=DARK),
    )


def mlx75027() -> Sensor:
    """Like a Melexis MLX75027 at 60 MHz, with the light, lens and exposure of the other.

    From its datasheet 1.0: contrast .85 at 40 and .78 at 100 MHz, which a cutoff of 303 MHz fits;
    read noise, full well and dark current at the middle temperature; 12 bits of 94.3 electrons.
    Electrons per unit are the other's times the area of a pixel, (10 um / 15 um)^2, at the same
    efficiency of 51 %. Assumed: PRNU, DSNU.
    """
    return Sensor(
        f_mod_hz=60e6,
        shifts=SEQUENTIAL,
        noise=True,
        exposure_s=2.34e-3,
        electrons_per_unit=3.144e5 * (10.0 / 15.0) ** 2,
        contrast=0.865,
        contrast_cutoff_hz=303e6,
        dark_electrons_per_s=5.1e4,
        read_noise_electrons=83.0,
        full_well_electrons=1.06e5,
        adc_bits=12,
        electrons_per_code=1.0 / 0.0106,
        pattern=Pattern(gain=GAIN, dark=DARK),
    )


SENSORS: Mapping[str, Sensor] = {
    make.__name__: make()
    for make in (ftorf_synthetic, ftorf_real, torf_real, opt8241_cdk, mlx75027)
}
"""Every named sensor."""


def effect_rows(sensor: Sensor) -> dict[str, str]:
    """Rows of a data card on effects beyond one frequency, a sine and equal pixels."""
    rows, pattern = {}, sensor.pattern
    if sensor.further_hz:
        listed = [f"{float(f) / 1e6:.9g} MHz" for f in (sensor.f_mod_hz, *sensor.further_hz)]
        shots = f"{len(sensor.cycle)} raw frames"
        rows["cycle"] = f"{shots}: all shifts at {', then at '.join(listed)}"
    if any(sensor.harmonic_contrast):
        ratios = [f"{sensor.contrast_ratio(h):.4g} at harmonic {h}" for h in sensor.harmonics[1:]]
        rows["contrast of harmonics"] = f"relative to the first: {', '.join(ratios)}"
    if sensor.contrast_cutoff_hz is not None:
        static = f"it is that of 0 Hz, {sensor.contrast:g}, over 1 + (f / cutoff)^2"
        rows["cutoff of the contrast"] = f"{sensor.contrast_cutoff_hz / 1e6:g} MHz: {static}"
    if sensor.adc_zero:
        rows["zero of the ADC"] = f"{sensor.adc_zero:g}, added to every stored quad"
    if pattern != Pattern():
        rows["fixed pattern"] = (
            f"phase {pattern.phase:g} times that of an OPT8241 kit, response to light "
            f"+-{100 * pattern.gain:g} %, dark current +-{100 * pattern.dark:g} %, specimen "
            f"{pattern.seed}"
        )
    return rows
