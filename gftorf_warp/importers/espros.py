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
from . import camera_keys, sensor_keys, timing
from .at_rest import at_rest
from .codes import fill
from .espros_frames import DCS, Quartets, read_quartets
from .imported import Imported, Notes
from .keys import Key, Settings

ZERO = 2048.0  # stored number of DCS 0 where numbers are not signed
RANGE = 4096  # numbers of 12 bits; what lies outside is one of these codes, as it is or less ZERO
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
    lens = camera_keys.intrinsics_of(settings, notes, quads.shape[2])
    exposures = timing.exposures_of(settings, len(quads))
    if exposures is None and quartets.exposure_s is not None:
        exposures = np.full(len(quads), quartets.exposure_s)
    sequence = at_rest(quads, modulation, times, lens, notes, exposures=exposures)
    return Imported(
        sequence=sequence, understood=tuple(notes.understood), uncertain=tuple(notes.uncertain)
    )


def _once(quartets: Quartets, notes: Notes) -> tuple[np.ndarray, np.ndarray]:
    """Number of the DCS of each raw frame [F], and its image [F, H, W], without repeated ones."""
    dcs = quartets.dcs
    count = len(dcs)
    changed = (dcs[1:] != dcs[:-1]).any(axis=(2, 3))  # [N - 1, 4]
    if count < 3 or not (changed.sum(axis=1) == 1).all():
        return np.tile(np.arange(DCS), count), dcs.reshape(-1, *dcs.shape[2:])
    slots = changed.argmax(axis=1)
    if not (np.diff(slots) % DCS == 1).all():
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
    size = {"H": dcs.shape[1], "W": dcs.shape[2]}
    quads = empty_quads(source, len(dcs), size)
    zero = settings["values.zero"]
    if zero is None:
        zero = 0.0 if _negative(dcs) else ZERO
        text = f"stored numbers are {'' if zero else 'partly '}"
        text += "not negative" if zero else "negative"
        notes.uncertain.append(f"{text}: {zero:g} is taken to mean 0; values.zero states it")
    else:
        notes.understood.append(f"values: {zero:g} means 0 (values.zero)")
    counts = dict.fromkeys(CODES.values(), 0)
    for n, image in enumerate(dcs):
        values = image.astype(np.float64)
        quads[n] = values - zero
        outside = ~(np.abs(values - zero + 0.5) <= RANGE / 2)  # NaN is outside
        left = outside.copy()
        for code, what in CODES.items():
            forms = [code - less - wrap for less in (0, ZERO) for wrap in (0, 1 << 16)]
            here = outside & np.isin(values, forms)
            counts[what] += int(here.sum())
            left &= ~here
        if left.any():
            found = values[left][0]
            why = (
                f"expected {zero - RANGE / 2:g} to {zero + RANGE / 2 - 1:g} around values.zero, or "
            )
            why += f"a code such as {min(CODES)}, found {found:g} in image {n}"
            raise InputError("no DCS", where=source, why=why, fix="correct values.zero")
        quads[n][outside] = np.nan
    for what, count in counts.items():
        if count:
            text = f"{count} values are {what}: each is replaced by the value of its pixel in the "
            notes.uncertain.append(f"{text}nearest raw frame of its DCS")
    return quads


def _negative(dcs: np.ndarray) -> bool:
    """Whether numbers that are no codes are negative."""
    codes = [code - (1 << 16) for code in CODES]
    return any(bool(((image < 0) & ~np.isin(image, codes)).any()) for image in dcs)


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
