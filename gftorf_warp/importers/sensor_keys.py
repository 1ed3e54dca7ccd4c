"""Keys of the modulation: frequencies, phase shifts, taps and offsets of a cycle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..constants import SPEED_OF_LIGHT
from ..data.calibration import DEPTH_RANGES_M
from ..data.cycles import QUADS_MIN, determined
from ..data.sequence import Calibration
from .imported import Notes
from .keys import Key, Settings

F_MOD_HZ = Key(
    name="sensor.f_mod_hz",
    kind=float,
    about="modulation frequency, or that of each raw frame of a cycle [Hz]",
    example=(20e6,),
    needed=True,
    shape=(None,),
    above=0.0,
)
SHIFTS_DEG = Key(
    name="sensor.shifts_deg",
    kind=float,
    about="phase shift of each raw frame of a cycle, in the order of time [deg]: "
    "quad = a (cos(phase - shift) + b)",
    example=(0.0, 90.0, 180.0, 270.0),
    needed=True,
    shape=(None,),
)
OFFSETS = (
    Key(
        name="sensor.phase_offset_deg",
        kind=float,
        about="measured minus true phase [deg]",
        example=0.0,
        default=0.0,
    ),
    Key(
        name="sensor.dc_offset",
        kind=float,
        about="constant part b of a quad as a multiple of its amplitude",
        example=0.0,
        default=0.0,
    ),
)
KEYS = (F_MOD_HZ, SHIFTS_DEG, *OFFSETS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Modulation:
    """What the K raw frames of a cycle measure."""

    frequencies_hz: Float[np.ndarray, "K"]
    """Modulation frequency of each [Hz]."""
    shifts: Float[np.ndarray, "K"]
    """Phase shift of each [rad]."""
    calibration: Calibration
    """Constants of the sensor, with the length of the cycle."""


def modulation_of(settings: Settings, notes: Notes) -> Modulation:
    """The modulation that the keys state.

    Raises:
        UsageError, InputError: If keys are missing, contradict each other, or determine no phase.
    """
    shifts = np.radians(settings["sensor.shifts_deg"])
    given = settings["sensor.f_mod_hz"]
    cycle = len(shifts)
    if len(given) not in (1, cycle):
        why = f"expected one frequency or one for each of {cycle} shifts, found {len(given)}"
        raise settings.wrong("sensor.f_mod_hz", why, "list both for every raw frame of a cycle")
    frequencies = np.resize(np.array(given), cycle)
    low, high = (SPEED_OF_LIGHT / metres for metres in reversed(DEPTH_RANGES_M))
    if not ((frequencies >= low) & (frequencies <= high)).all():
        why = f"expected {low:.3g} to {high:.3g} Hz, found {frequencies.tolist()}"
        raise settings.wrong("sensor.f_mod_hz", why, "give Hz: 20 MHz is 20e6")
    if cycle < QUADS_MIN or not determined(shifts, frequencies):
        why = "expected three or more different shifts at each frequency, found "
        why += f"{list(settings['sensor.shifts_deg'])} degrees at {frequencies.tolist()} Hz"
        raise settings.wrong("sensor.shifts_deg", why, "list one whole cycle, in degrees")
    for f in dict.fromkeys(frequencies.tolist()):
        degrees = np.degrees(shifts[frequencies == f])
        text = ", ".join(f"{degree:g}" for degree in degrees)
        notes.understood.append(f"sensor: {f / 1e6:g} MHz with shifts {text} degrees")
    offset, dc = settings["sensor.phase_offset_deg"], settings["sensor.dc_offset"]
    notes.understood.append(
        f"sensor: phase offset {offset:g} degrees ({settings.source('sensor.phase_offset_deg')}), "
        f"DC offset {dc:g} ({settings.source('sensor.dc_offset')})"
    )
    calibration = Calibration(
        f_mod_hz=float(frequencies[0]),
        phase_offset=math.radians(offset),
        dc_offset=dc,
        cycle_length=cycle,
    )
    return Modulation(frequencies_hz=frequencies, shifts=shifts, calibration=calibration)
