"""Raw frames of a Luxonis OAK with the ToF sensor 33D, without headers: 12 bits in 16.

A frame is several parts, one below the other; the pixels of a part are blocks of 2x2, one for each
of the four taps A B / C D, which take four shifts at one time. The second part of a frequency has
its shifts exchanged between the taps (phase shuffle). None of this is documented.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.folder import empty_quads
from ..errors import InputError
from . import camera_keys, pose_keys, regular, sensor_keys, timing
from .imported import Imported, Notes
from .keys import Key, Settings
from .pixel_formats import CODES, twelve_bits
from .raw_files import buffers_of, files_of, raw_bytes

TAPS = 4
STRAIGHT, SHUFFLED = (0.0, 90.0, 180.0, 270.0), (180.0, 270.0, 0.0, 90.0)
# of the two frequencies of the sensor, a part with each order of taps
SHIFTS_DEG = (*STRAIGHT, *SHUFFLED, *STRAIGHT, *SHUFFLED)
F_MOD_HZ = (*(80e6,) * 8, *(100e6,) * 8)
KEYS = (
    Key(
        name="raw.size",
        kind=int,
        about="columns and rows of a frame as it is stored",
        example=(1280, 3848),
        default=(1280, 3848),
        shape=(2,),
        least=2,
    ),
    Key(
        name="raw.parts",
        kind=int,
        about="parts of a frame, one below the other, each with its own exposure",
        example=4,
        default=4,
        least=1,
    ),
    Key(
        name="raw.part_rows",
        kind=int,
        about="rows of a part that are pixels; those before them are left out",
        example=960,
        default=960,
        least=2,
    ),
    replace(
        sensor_keys.F_MOD_HZ,
        about="modulation frequency, or that of each tap A, B, C, D of each part [Hz]",
        default=F_MOD_HZ,
        needed=False,
    ),
    replace(
        sensor_keys.SHIFTS_DEG,
        about="phase shift of each tap A, B, C, D of each part [deg]",
        default=SHIFTS_DEG,
        needed=False,
    ),
    *sensor_keys.OFFSETS,
    Key(
        name="time.cycle_rate_hz",
        kind=float,
        about="frames per second [Hz]",
        example=10.0,
        needed=True,
        above=0.0,
    ),
    Key(
        name="time.slot_period_s",
        kind=float,
        about="from one part of a frame to the next [s]; 0: one instant",
        example=0.005,
        needed=True,
        least=0.0,
    ),
    *(key for key in timing.KEYS if key.name == "time.exposure_s"),
    *camera_keys.KEYS,
    *pose_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """Frames in one file or several, in the order of their names, four raw frames for each part.

    Raises:
        UsageError, InputError: If keys are missing, or frames and keys do not fit together.
    """
    settings.require()
    notes = Notes()
    modulation = sensor_keys.modulation_of(settings, notes)
    parts = settings["raw.parts"]
    if len(modulation.shifts) != TAPS * parts:
        why = f"expected {TAPS * parts}, {TAPS} for each of {parts} parts, found "
        why += f"{len(modulation.shifts)}"
        raise settings.wrong("sensor.shifts_deg", why, "list those of all taps and parts")
    quads = _quads(source, settings, notes)
    starts = np.arange(len(quads) // (TAPS * parts)) / settings["time.cycle_rate_hz"]
    text = f"{settings['time.cycle_rate_hz']:g} frames per second"
    frames = len(starts) * parts
    of_parts = timing.with_slots(settings, notes, starts, frames, parts, text)
    exposures = timing.exposures_of(settings, len(quads))
    for name, what in (
        ("raw.parts", "order of parts: 80 MHz, 80 MHz shuffled, 100 MHz, 100 MHz shuffled"),
        ("sensor.shifts_deg", "shifts of taps: 0, 90, 180, 270, and shuffled 180, 270, 0, 90"),
        ("raw.part_rows", "the first rows of a part are not pixels"),
    ):
        if not settings.given(name):
            text = f"{what}: assumed, since nothing public documents it; {name} states it"
            notes.uncertain.append(text)
    notes.uncertain.append("taps are taken as blocks of 2x2 pixels, A B above C D")
    times = np.repeat(of_parts, TAPS)
    return regular.imported(source, settings, notes, quads, modulation, times, exposures=exposures)


def _quads(source: Path, settings: Settings, notes: Notes) -> Float[np.ndarray, "F H W"]:
    """Codes of all taps of all parts; they contain ambient light."""
    (columns, rows), parts = settings["raw.size"], settings["raw.parts"]
    used, of_part = settings["raw.part_rows"], rows // settings["raw.parts"]
    if rows % parts or used > of_part or used % 2 or columns % 2:
        why = f"expected {parts} parts of one height, even numbers of columns and of rows with "
        why += f"pixels, found {columns}x{rows}, of which {used} rows are pixels"
        raise settings.wrong("raw.size", why, "correct raw.size, raw.parts and raw.part_rows")
    step = 2 * columns * rows
    buffers = buffers_of(files_of(source), step, f"{columns}x{rows} pixels of 16 bits")
    size = {"H": used // 2, "W": columns // 2}
    quads = empty_quads(source, len(buffers) * parts * TAPS, size)
    full = 0
    for n, (path, first) in enumerate(buffers):
        stored = raw_bytes(path, first, step).reshape(rows, 2 * columns)
        try:
            codes = twelve_bits(stored, "Y12")
        except ValueError as error:
            why, fix = f"frame {n}: {error}", "set raw.size, or record RAW12 unpacked"
            raise InputError("no RAW12 in 16 bits", where=path, why=why, fix=fix) from error
        pixels = codes.reshape(parts, of_part, columns)[:, of_part - used :]
        full += int((pixels == CODES - 1).sum())
        blocks = pixels.reshape(parts, used // 2, 2, columns // 2, 2).transpose(0, 2, 4, 1, 3)
        taken = slice(n * parts * TAPS, (n + 1) * parts * TAPS)
        quads[taken] = blocks.reshape(-1, *quads.shape[1:])
    text = f"frames: {len(buffers)} of {parts} parts, {size['W']}x{size['H']} blocks of {TAPS} taps"
    notes.understood.append(text)
    if full:
        notes.uncertain.append(f"{full} codes are the largest, {CODES - 1}: saturated, and kept")
    return quads
