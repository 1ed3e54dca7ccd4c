"""Electrons that a sensor counts (sensor notes, 2.2 to 2.5)."""

from __future__ import annotations

from .sensor import Scalar, Sensor

REFERENCE_EXPOSURE_S = 2.34e-3  # of electrons_per_unit


def electron_gain(sensor: Sensor) -> float:
    """Modulated electrons G per exposure and unit of amplitude, both taps together [e-]."""
    return sensor.electrons_per_unit * sensor.exposure_s / REFERENCE_EXPOSURE_S


def contrast(sensor: Sensor) -> Scalar:
    """Contrast C at the modulation frequency [1]; 1 / dc_offset of a unipolar sensor."""
    if sensor.unipolar:
        return 1.0 / sensor.dc_offset
    if sensor.contrast_cutoff_hz is None:
        return sensor.contrast
    return sensor.contrast / (1.0 + (sensor.f_mod_hz / sensor.contrast_cutoff_hz) ** 2)


def dark_electrons(sensor: Sensor) -> float:
    """Mean dark electrons of a tap in one exposure, N_dark [e-]."""
    return sensor.dark_electrons_per_s * sensor.exposure_s
