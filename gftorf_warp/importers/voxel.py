"""Recordings of the TI Voxel SDK (OPT8241 and its like) in quad mode: .vxl files.

    quad k of Q = amplitude cos(phase - 360 degrees k / Q)

A pixel is its Q quads of 16 bits, of which the lower twelve are a signed number.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.cycles import QUADS_MIN
from ..data.folder import empty_quads
from ..data.untrusted import SIDE_MAX
from ..errors import InputError
from . import camera_keys, pose_keys, regular, sensor_keys, timing
from .imported import Imported, Notes
from .keys import Settings
from .raw_files import raw_bytes
from .voxel_packets import Data, packets

# tofFrameType: what a pixel is
TYPES = {0: "amplitude and phase", 1: "in-phase and quadrature", 2: "quads"}
QUADS = 2
PHASES = 4096  # steps of a stored phase in a turn
QUADS_MAX = 100  # the SDK refuses more
WAYS = ("time.rate_hz", "time.cycle_rate_hz", "time.file")
KEYS = (
    sensor_keys.F_MOD_HZ,
    replace(
        sensor_keys.SHIFTS_DEG,
        about=f"{sensor_keys.SHIFTS_DEG.about}; without, 360 / Q apart",
        needed=False,
    ),
    *sensor_keys.OFFSETS,
    *(replace(key, needed=False) for key in timing.KEYS),
    *camera_keys.KEYS,
    *pose_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """Frames of Q quads as raw frames, with the times at which they arrived.

    Raises:
        UsageError, InputError: If keys are missing, or the file is damaged or has no quads.
    """
    if not any(map(settings.given, WAYS)):
        settings.require("time.slot_period_s")
    settings.require()
    notes = Notes()
    all_packets = list(packets(source))
    frames = [packet for packet in all_packets if isinstance(packet, Data)]
    tables = [packet for packet in all_packets if isinstance(packet, dict)]
    shape = _shape(source, tables, notes)
    if not frames:
        why, fix = "expected frames, found settings only", "record again"
        raise InputError("an empty recording", where=source, why=why, fix=fix)
    modulation = _modulation(shape[2], settings, notes)
    quads = _quads(source, frames, shape, notes)
    times = _times(source, frames, shape[2], settings, notes)
    exposures = timing.exposures_of(settings, len(quads))
    return regular.imported(source, settings, notes, quads, modulation, times, exposures=exposures)


def _modulation(count: int, settings: Settings, notes: Notes) -> sensor_keys.Modulation:
    """That of the keys, with even shifts if they state none."""
    if not settings.given("sensor.shifts_deg"):
        shifts = tuple(360.0 * k / count for k in range(count))
        settings = replace(settings, values={**settings.values, "sensor.shifts_deg": shifts})
    modulation = sensor_keys.modulation_of(settings, notes)
    if len(modulation.shifts) != count:
        why = f"expected {count} shifts, one for each quad, found {len(modulation.shifts)}"
        raise settings.wrong("sensor.shifts_deg", why, "list one for each quad")
    return modulation


def _shape(
    source: Path, tables: list[dict[str, int | bytes]], notes: Notes
) -> tuple[int, int, int]:
    """Rows, columns and quads of every frame, by the settings of the recording."""
    shapes = [_one_shape(source, table) for table in tables]
    if len(set(shapes)) != 1:
        why = f"expected settings of one size, found {sorted(set(shapes)) or 'none'}"
        raise InputError("settings of raw frames", where=source, why=why, fix="record again")
    for name, value in tables[-1].items():
        if isinstance(value, bytes) and value:
            notes.uncertain.append(f"{name}: the recording has {TABLES[name](value)}")
    return shapes[0]


def _offsets(stored: bytes) -> str:
    """Phase offsets of single pixels, in words."""
    steps = np.frombuffer(stored[: len(stored) // 2 * 2], "<i2")
    if not len(steps):
        return f"phase offsets of {len(stored)} byte, which are cut short"
    degrees = 360.0 / PHASES * steps.astype(np.float64)
    mean, spread = degrees.mean(), degrees.std()
    text = f"phase offsets of {len(steps)} pixels, {mean:.4g} degrees with a spread of {spread:.3g}"
    return f"{text}, which are not applied; sensor.phase_offset_deg takes their mean"


TABLES = {  # settings of the recording that change its phases
    "phaseOffsets": _offsets,
    "phaseOffsetsFile": lambda _: "a file of phase offsets of single pixels, not applied",
    "crossTalkCoefficients": lambda _: "coefficients against cross-talk, which are not applied",
}


def _one_shape(source: Path, table: dict[str, int | bytes]) -> tuple[int, int, int]:
    values = {name: value for name, value in table.items() if isinstance(value, int)}
    kind = values.get("tofFrameType")
    if kind != QUADS:
        frame_type = TYPES[kind] if kind in TYPES else f"tofFrameType {kind}"
        why = f"expected quads, found {frame_type}, which the controller has computed already"
        fix = "record with a controller that passes quads"
        raise InputError("no quads", where=source, why=why, fix=fix)
    sides = []
    for size, merged, stored in (
        ("roiHeight", "rowsToMerge", "frameHeight"),
        ("roiWidth", "columnsToMerge", "frameWidth"),
    ):
        whole, step = values.get(size, 0), max(values.get(merged, 1), 1)
        binned = -(-whole // step)
        sides.append(min(values.get(stored, binned), binned))
    count = values.get("quadCount", 4)
    if not (min(sides) > 0 and max(sides) <= SIDE_MAX and QUADS_MIN <= count <= QUADS_MAX):
        why = f"expected rows, columns and {QUADS_MIN} to {QUADS_MAX} quads, found {sides} and "
        why += f"{count}"
        raise InputError("settings of raw frames", where=source, why=why, fix="record again")
    return sides[0], sides[1], count


def _quads(
    source: Path, frames: list[Data], shape: tuple[int, int, int], notes: Notes
) -> Float[np.ndarray, "F H W"]:
    """Quads of all frames: the lower twelve bits of 16, with sign."""
    height, width, count = shape
    size = 2 * height * width * count
    quads = empty_quads(source, len(frames) * count, {"H": height, "W": width})
    for frame, values in zip(frames, quads.reshape(-1, count, height, width), strict=True):
        if frame.count < size:
            why = f"expected {size} bytes for {width}x{height} pixels of {count} quads in frame "
            why += f"{frame.number}, found {frame.count}"
            raise InputError("frame too small", where=source, why=why, fix="record again")
        words = raw_bytes(source, frame.first, size).view("<u2").reshape(height, width, count)
        values[:] = ((words << 4).astype(np.int16) >> 4).transpose(2, 0, 1)
    text = f"frames: {len(frames)} with numbers {frames[0].number} to {frames[-1].number}"
    notes.understood.append(f"{text}, {width}x{height} pixels of {count} quads")
    return quads


def _times(
    source: Path, frames: list[Data], count: int, settings: Settings, notes: Notes
) -> Float[np.ndarray, "F"]:
    """Time of each raw frame [s]: of the keys, or else of the file."""
    if any(map(settings.given, WAYS)):
        return timing.times_of(settings, source, notes, len(frames) * count, count)
    first = frames[0].time_us
    starts = np.array([1e-6 * (frame.time_us - first) for frame in frames])
    if (np.diff(starts) < 0).any():
        n = int(np.argmax(np.diff(starts) < 0)) + 1
        why = f"expected times that never decrease, found an earlier one at frame {n}"
        raise InputError("times", where=source, why=why, fix="give time.cycle_rate_hz instead")
    notes.uncertain.append(
        "times are when frames arrived at the computer, not when they were taken"
    )
    text = "times of the file"
    return timing.with_slots(settings, notes, starts, len(frames) * count, count, text)
