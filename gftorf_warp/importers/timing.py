"""Keys of the times of raw frames, and the times they give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from .imported import Notes
from .keys import Key, Settings
from .text_files import numbers, read_rows

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
KEYS = (
    Key(
        name="time.rate_hz",
        kind=float,
        about="raw frames per second, evenly [Hz]",
        example=120.0,
        needed=True,
        unless=("time.cycle_rate_hz", "time.file"),
        above=0.0,
    ),
    Key(
        name="time.cycle_rate_hz",
        kind=float,
        about="cycles per second, whose raw frames are slot_period_s apart [Hz]",
        example=30.0,
        above=0.0,
    ),
    Key(
        name="time.slot_period_s",
        kind=float,
        about="from one raw frame of a cycle to the next, with cycle_rate_hz or times of cycles "
        "[s]; 0: one instant",
        example=0.002,
        least=0.0,
    ),
    Key(
        name="time.file",
        kind=str,
        about="text file with the time of every raw frame, or of every cycle, in its first column",
        example="times.csv",
    ),
    Key(
        name="time.unit",
        kind=str,
        about="unit of the times in that file",
        example="s",
        default="s",
        choices=tuple(UNITS),
    ),
    Key(
        name="time.exposure_s",
        kind=float,
        about="length of an exposure [s]",
        example=0.001,
        above=0.0,
    ),
)


def times_of(
    settings: Settings, root: Path, notes: Notes, frames: int, cycle: int
) -> Float[np.ndarray, "F"]:
    """Time of each of F raw frames since the first [s].

    Args:
        settings: Values of ``KEYS``.
        root: The recording; a file of times is there or beside the TOML file.
        notes: What was understood is added.
        frames: Number F of raw frames.
        cycle: Raw frames of a cycle.

    Raises:
        UsageError, InputError: If keys are missing or contradict each other, or the file does not
            have one time for every raw frame or every cycle, which never decrease.
    """
    ways = [name for name in (*KEYS[0].unless, KEYS[0].name) if settings.given(name)]
    if len(ways) > 1:
        why = f"{' and '.join(ways)} are given, which both state the times"
        raise settings.wrong(ways[0], why, "keep one of them")
    if settings.given("time.file"):
        return _of_file(settings, root, notes, frames, cycle)
    if settings.given("time.cycle_rate_hz"):
        settings.require("time.slot_period_s")
        rate = settings["time.cycle_rate_hz"]
        starts = np.arange(-(-frames // cycle)) / rate
        source = f"{rate:g} cycles per second"
        return with_slots(settings, notes, starts, frames, cycle, source)
    if settings.given("time.slot_period_s"):
        why = "time.rate_hz states the times of all raw frames, evenly"
        fix = "remove it, or count cycles: time.cycle_rate_hz in place of time.rate_hz"
        raise settings.wrong("time.slot_period_s", why, fix)
    rate = settings["time.rate_hz"]
    notes.understood.append(f"times: {rate:g} raw frames per second, evenly (time.rate_hz)")
    return np.arange(frames) / rate


def exposures_of(settings: Settings, frames: int) -> Float[np.ndarray, "F"] | None:
    """Length of the exposure of each raw frame [s]; None if it is not given."""
    length = settings["time.exposure_s"]
    return None if length is None else np.full(frames, length)


def _of_file(
    settings: Settings, root: Path, notes: Notes, frames: int, cycle: int
) -> Float[np.ndarray, "F"]:
    path = settings.file("time.file", root)
    assert path is not None
    rows = read_rows(path)
    try:
        float(rows[0][1][0])
    except ValueError:
        notes.understood.append(f"times: line {rows[0][0]} of {path.name} is a heading")
        rows = rows[1:]
    unit = settings["time.unit"]
    stored = np.array([numbers(path, n, words[:1])[0] for n, words in rows]) * UNITS[unit]
    cycles = -(-frames // cycle)
    if len(stored) not in (frames, cycles):
        why = f"expected {frames} times, one for every raw frame, or {cycles}, one for every cycle "
        why += f"of {cycle}, found {len(stored)} in {path}"
        raise settings.wrong("time.file", why, "complete the file, or give time.rate_hz")
    if (np.diff(stored) < 0).any():
        n = int(np.argmax(np.diff(stored) < 0)) + 1
        why = f"expected times that never decrease, found {stored[n]:g} s after {stored[n - 1]:g} s"
        raise settings.wrong("time.file", f"{why} in line {rows[n][0]} of {path}", "sort them")
    stored = stored - stored[0]
    if (np.diff(stored) == 0).any():
        notes.uncertain.append(f"{path.name} has equal times: they are taken as one instant")
    if len(stored) < frames:
        settings.require("time.slot_period_s")
        source = f"times of cycles in {path.name} in {unit}"
        return with_slots(settings, notes, stored, frames, cycle, source)
    notes.understood.append(f"times: of every raw frame in {path.name} in {unit}, from the first")
    return stored


def with_slots(
    settings: Settings,
    notes: Notes,
    starts: Float[np.ndarray, "C"],
    frames: int,
    cycle: int,
    source: str,
) -> Float[np.ndarray, "F"]:
    """Times of raw frames from those of the first of each of C cycles [s]."""
    period = settings["time.slot_period_s"]
    if len(starts) > 1 and (cycle - 1) * period > np.diff(starts).min():
        why = f"{cycle} raw frames {period:g} s apart take longer than the shortest cycle, "
        why += f"{np.diff(starts).min():g} s"
        raise settings.wrong("time.slot_period_s", why, "give seconds")
    notes.understood.append(f"times: {source}, raw frames of a cycle {period:g} s apart")
    return (starts[:, None] + np.arange(cycle) * period).reshape(-1)[:frames]
