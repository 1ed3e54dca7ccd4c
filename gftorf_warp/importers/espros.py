"""ESPROS TOFcams: quartets as the camera sends them, or as its recorder stores them.

    DCS k = amplitude cos(phase - k 90 degrees),     stored number = DCS + zero

In rolling mode a camera sends four DCS after every new one, so that three of them are repeated:
each is taken once, with its own time.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.folder import empty_quads
from ..errors import InputError
from . import camera_keys, pose_keys, regular, sensor_keys, timing
from .codes import fill
from .espros_frames import DCS, Quartets, read_quartets
from .imported import Imported, Notes
from .keys import Key, Settings

ZERO = 2048.0  # stored number of DCS 0 where numbers are not signed
RANGE = 4096  # numbers of 12 bits; what lies outside is one of these codes
CODES = {64002: "too bright for the converter", 64003: "saturated"}
KEYS = (
    Key(
        name="values.zero",
        kind=float,
        about="stored number that means 0; without, 0 if some are negative, 2048 if not",
        example=2048.0,
    ),
    Key(
        name="recorder.turned",
        kind=bool,
        about="whether an HDF5 recording has its images a quarter turn clockwise; without, if they "
        "are higher than wide",
        example=True,
    ),
    replace(sensor_keys.F_MOD_HZ, needed=False),
    replace(
        sensor_keys.SHIFTS_DEG,
        about="phase shift of DCS 0, 1, 2, 3 [deg]",
        default=(0.0, 90.0, 180.0, 270.0),
        needed=False,
    ),
    *sensor_keys.OFFSETS,
    *(replace(key, needed=False) for key in timing.KEYS),
    *camera_keys.KEYS,
    *pose_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """Quartets of a TOFcam as raw frames.

    Raises:
        UsageError, InputError: If keys are missing, or files and keys do not fit together.
        ResourceError: If an HDF5 file is given and h5py is not installed.
    """
    settings.require()
    notes = Notes()
    quartets = read_quartets(source, settings["recorder.turned"], notes)
    if quartets.f_mod_hz is not None and not settings.given("sensor.f_mod_hz"):
        values = {**settings.values, "sensor.f_mod_hz": (quartets.f_mod_hz,)}
        settings = replace(settings, values=values)
    settings.require("sensor.f_mod_hz")
    modulation = sensor_keys.modulation_of(settings, notes)
    if len(modulation.shifts) != DCS:
        why = f"expected a shift for each of {DCS} DCS, found {len(modulation.shifts)}"
        raise settings.wrong("sensor.shifts_deg", why, "give four")
    slots, dcs = _once(quartets, notes)
    first = int(slots[0])
    modulation = replace(
        modulation,
        shifts=np.roll(modulation.shifts, -first),
        frequencies_hz=np.roll(modulation.frequencies_hz, -first),
    )
    quads = _quads(source, dcs, settings, notes)
    never = fill(quads, np.ones(len(quads), dtype=bool), DCS)
    if never:
        notes.uncertain.append(f"{never} pixels are never measured in some DCS: they are 0")
    times = _times(source, quartets, len(quads), settings, notes)
    exposures = timing.exposures_of(settings, len(quads))
    if exposures is None and quartets.exposure_s is not None:
        exposures = np.full(len(quads), quartets.exposure_s)
    return regular.imported(source, settings, notes, quads, modulation, times, exposures=exposures)


def _once(quartets: Quartets, notes: Notes) -> tuple[np.ndarray, np.ndarray]:
    """Number of the DCS of each raw frame [F], and its image [F, H, W], without repeated ones."""
    dcs, count = quartets.dcs, len(quartets.dcs)
    changed = (dcs[1:] != dcs[:-1]).any(axis=(2, 3))  # [N - 1, 4]
    slots = changed.argmax(axis=1)
    rolling = (changed.sum(axis=1) == 1).all() and (np.diff(slots) % DCS == 1).all()
    if count < 3 or not rolling:
        return np.tile(np.arange(DCS), count), dcs.reshape(-1, *dcs.shape[2:])
    oldest = (slots[0] + np.arange(DCS)) % DCS
    notes.understood.append(
        f"rolling mode: each quartet repeats three DCS of the one before; {count + DCS - 1} raw "
        f"frames, from DCS {oldest[0]} on"
    )
    new = dcs[np.arange(1, count), slots]
    return np.concatenate([oldest, slots]), np.concatenate([dcs[0, oldest], new])


def _quads(
    source: Path, dcs: np.ndarray, settings: Settings, notes: Notes
) -> Float[np.ndarray, "F H W"]:
    """Values of stored images; NaN where they hold a code."""
    zero = _zero(dcs, settings, notes)
    quads = empty_quads(source, len(dcs), {"H": dcs.shape[1], "W": dcs.shape[2]})
    counts = dict.fromkeys(CODES, 0)
    for n, image in enumerate(dcs):
        values = image.astype(np.float64) - zero
        outside = ~(np.abs(values + 0.5) <= RANGE / 2)  # NaN is outside
        unknown = outside.copy()
        for code in CODES:
            here = outside & np.isin(image, _forms(code))
            counts[code] += int(here.sum())
            unknown &= ~here
        if unknown.any():
            low, high = zero - RANGE / 2, zero + RANGE / 2 - 1
            why = f"expected {low:g} to {high:g} around values.zero, or a code such as "
            why += f"{min(CODES)}, found {image[unknown][0]:g} in image {n}"
            raise InputError("no DCS", where=source, why=why, fix="correct values.zero")
        quads[n] = np.where(outside, np.nan, values)
    for code, count in counts.items():
        if count:
            text = f"{count} values are {CODES[code]}: each is replaced by the value of its pixel "
            notes.uncertain.append(f"{text}in the nearest raw frame of its DCS")
    return quads


def _zero(dcs: np.ndarray, settings: Settings, notes: Notes) -> float:
    """The stored number that means 0."""
    zero = settings["values.zero"]
    if zero is not None:
        notes.understood.append(f"values: {zero:g} means 0 (values.zero)")
        return zero
    codes = [form for code in CODES for form in _forms(code)]
    signed = any(bool(((image < 0) & ~np.isin(image, codes)).any()) for image in dcs)
    zero, what = (0.0, "some") if signed else (ZERO, "no")
    text = f"{what} stored numbers are negative: {zero:g} is taken to mean 0"
    notes.uncertain.append(f"{text}; values.zero states it")
    return zero


def _forms(code: int) -> list[float]:
    """Numbers as which a code may be stored: as it is or less the zero, in 16 bits with sign or
    without.
    """
    return [float(code - less - wrap) for less in (0, ZERO) for wrap in (0, 1 << 16)]


def _times(
    source: Path, quartets: Quartets, frames: int, settings: Settings, notes: Notes
) -> Float[np.ndarray, "F"]:
    """Time of each raw frame [s]: of the keys, or else of the recorder."""
    ways = ("time.rate_hz", "time.cycle_rate_hz", "time.file")
    stored = quartets.times
    if stored is None or any(map(settings.given, ways)):
        if not any(map(settings.given, ways)):
            settings.require("time.rate_hz")
        return timing.times_of(settings, source, notes, frames, DCS)
    if not np.isfinite(stored).all() or (np.diff(stored) < 0).any():
        why = f"expected seconds that never decrease, found {stored[:8].tolist()} .."
        raise InputError("timestamps", where=source, why=why, fix="give time.rate_hz instead")
    notes.uncertain.append("timestamps of the recorder are taken as seconds, when a frame arrived")
    stored = stored - stored[0]
    if frames != DCS * len(stored):  # rolling: one raw frame for each quartet, three before
        period = float(np.median(np.diff(stored)))
        before = -period * np.arange(DCS - 1, 0, -1)
        return np.concatenate([before, stored]) + period * (DCS - 1)
    settings.require("time.slot_period_s")
    return timing.with_slots(settings, notes, stored, frames, DCS, "timestamps of the recorder")
