"""Recordings of phasors: two images for each instant, I and Q or amplitude and phase.

    I = amplitude cos(phase),     Q = amplitude sin(phase)

A camera that combines its quads itself delivers these. The quads are no longer known, so an instant
becomes the four raw frames I/2, -I/2, Q/2, -Q/2 of shifts 0, 180, 90, 270 degrees at one time, as
those of a TöRF folder.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Complex64, Float

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from ..data.sequence import Sequence
from .keys import Key, Settings

TAPS = tuple(
    order
    for first, second in (("I", "Q"), ("I", "-Q"), ("amplitude", "phase"), ("amplitude", "-phase"))
    for order in ((first, second), (second, first))
)
KEY = Key(
    name="values.turn",
    kind=float,
    about="stored numbers of a whole turn, with taps amplitude and phase: 4096 of 12 bits, 360 "
    "degrees, 6.2831853 rad",
    example=4096.0,
    above=0.0,
)


def are_stored(settings: Settings) -> bool:
    """Whether the taps of a recording are those of phasors."""
    return settings["sensor.taps"] in TAPS


def with_shifts(settings: Settings) -> Settings:
    """The settings with the shifts of the raw frames that phasors become.

    Raises:
        UsageError, InputError: If keys state shifts or several frequencies, or the unit of the
            phase is missing.
    """
    if settings.given("sensor.shifts_deg"):
        why = f"phasors have no shifts, and sensor.taps is {', '.join(settings['sensor.taps'])}"
        fix = "remove it; if Q or the phase shrinks with distance, name it -Q or -phase"
        raise settings.wrong("sensor.shifts_deg", why, fix)
    degrees = tuple(math.degrees(shift) for shift in CANONICAL_SHIFTS)
    settings = replace(settings, values={**settings.values, "sensor.shifts_deg": degrees})
    settings.require(*([KEY.name] if "amplitude" in settings["sensor.taps"] else []))
    if len(settings["sensor.f_mod_hz"]) > 1:
        why = "a capture of phasors has one frequency, found several"
        raise settings.wrong("sensor.f_mod_hz", why, "import each frequency by itself")
    if settings["sensor.dc_offset"]:
        why = "phasors have no constant part"
        raise settings.wrong("sensor.dc_offset", why, "remove it")
    return settings


def phasor_of(
    images: Mapping[str, Float[np.ndarray, "H W"]], settings: Settings
) -> Complex64[np.ndarray, "H W"]:
    """The phasor of two images by the names of their taps; NaN where one of them is."""
    values = {n.lstrip("-"): -image if n[0] == "-" else image for n, image in images.items()}
    phasor = np.empty(next(iter(values.values())).shape, np.complex64)
    if "I" in values:
        phasor.real, phasor.imag = values["I"], values["Q"]
    else:
        phase = 2.0 * math.pi / settings[KEY.name] * values["phase"].astype(np.float64)
        phasor.real = values["amplitude"] * np.cos(phase)
        phasor.imag = values["amplitude"] * np.sin(phase)
    return phasor


def as_raw_frames(phasors: Sequence) -> Sequence:
    """A sequence of phasors, whose ``quads`` are complex and whose raw frame n is phasor n, with
    the four raw frames of each.
    """

    def four(values: np.ndarray) -> np.ndarray:
        return np.repeat(values, FRAMES_PER_QUARTET, axis=0)

    half, colour = phasors.quads / np.float32(2.0), phasors.colour
    quads = np.stack([half.real, -half.real, half.imag, -half.imag], axis=1)
    frames = FRAMES_PER_QUARTET * len(half)
    exposures, poses = phasors.exposures, colour.camera_from_world
    return replace(
        phasors,
        quads=quads.reshape(frames, *half.shape[1:]),
        shifts=np.resize(CANONICAL_SHIFTS, frames),
        measured=four(phasors.measured),
        times=four(phasors.times),
        exposures=None if exposures is None else four(exposures),
        camera_from_world=four(phasors.camera_from_world),
        colour=replace(
            colour,
            images={FRAMES_PER_QUARTET * n: image for n, image in colour.images.items()},
            camera_from_world=None if poses is None else four(poses),
        ),
        from_phasors=True,
    )
