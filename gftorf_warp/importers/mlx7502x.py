"""Dumps of Melexis MLX75026 and MLX75027 by V4L2: buffers without headers, one phase in each.

The sensor has two taps, A at the shift of PHASE_SEQ and B half a turn later. Its control
OUTPUT_MODE says what a pixel is: A - B, the usual one, A, B, or both.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int16, UInt8

from ..data.folder import empty_quads
from ..errors import InputError
from . import camera_keys, sensor_keys, timing
from .at_rest import at_rest
from .imported import Imported, Notes
from .keys import Key, Settings
from .raw_files import files_of, raw_bytes, size_of

FORMATS = {"Y12": 16, "Y12P": 12, "Y16": 16}  # bits of a stored pixel
MODES = {"A-B": 0.0, "A": 0.0, "B": 180.0, "A&B": 0.0}  # [deg] added to the shift of the quad
CODES = 1 << 12
SHIFTS_DEG = replace(
    sensor_keys.SHIFTS_DEG,
    about="PHASE_SEQ: phase shift of each buffer of a cycle [deg], with a sign that makes the "
    "phase grow with distance",
    default=(0.0, 180.0, 90.0, 270.0),
    needed=False,
)
KEYS = (
    Key(
        name="raw.format",
        kind=str,
        about="pixel format: Y12 is 12 bits in the lower of 16, Y16 in the upper, Y12P packed",
        example="Y12P",
        needed=True,
        choices=tuple(FORMATS),
    ),
    Key(
        name="raw.size",
        kind=int,
        about="columns and rows; 640, 480 of an MLX75027, 320, 240 of an MLX75026",
        example=(640, 480),
        needed=True,
        shape=(2,),
        least=2,
    ),
    Key(
        name="raw.output_mode",
        kind=str,
        about="OUTPUT_MODE: what a pixel is",
        example="A",
        default="A-B",
        choices=tuple(MODES),
    ),
    Key(
        name="raw.both",
        kind=str,
        about="where A&B, twice as wide, has its taps: halves, A on the left, or columns, A B A B",
        example="halves",
        choices=("halves", "columns"),
    ),
    Key(
        name="raw.bytesperline",
        kind=int,
        about="bytes from one row to the next, if rows are padded",
        example=1280,
        least=1,
    ),
    Key(
        name="raw.sizeimage",
        kind=int,
        about="bytes from one buffer to the next, if buffers are padded",
        example=614400,
        least=1,
    ),
    replace(sensor_keys.F_MOD_HZ, about="FREQ_MOD: one, or one for each buffer of a cycle [Hz]"),
    SHIFTS_DEG,
    *sensor_keys.OFFSETS,
    *timing.KEYS,
    *camera_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """Buffers in one file or several, in the order of their names, as raw frames.

    Raises:
        UsageError, InputError: If keys are missing, or buffers and keys do not fit together.
    """
    settings.require()
    notes = Notes()
    modulation = sensor_keys.modulation_of(settings, notes)
    mode = settings["raw.output_mode"]
    if mode == "A&B":
        settings.require("raw.both")
    quads = _quads(source, settings, notes)
    modulation = replace(modulation, shifts=modulation.shifts + np.radians(MODES[mode]))
    taken = {"A&B": ", taken as A - B", "B": ", shifts half a turn later"}.get(mode, "")
    notes.understood.append(f"taps: {mode}{taken} ({settings.source('raw.output_mode')})")
    times = timing.times_of(settings, source, notes, len(quads), len(modulation.shifts))
    lens = camera_keys.intrinsics_of(settings, notes, settings["raw.size"][0])
    exposures = timing.exposures_of(settings, len(quads))
    sequence = at_rest(quads, modulation, times, lens, notes, exposures=exposures)
    notes.uncertain.append(
        "the sign of PHASE_SEQ is not documented: if distances shrink where they should grow, "
        f"write sensor.shifts_deg = {[-shift for shift in settings['sensor.shifts_deg']]}"
    )
    if not settings.given("sensor.shifts_deg"):
        notes.uncertain.append("PHASE_SEQ is taken as 0, 180, 90, 270, the default of the driver")
    return Imported(
        sequence=sequence, understood=tuple(notes.understood), uncertain=tuple(notes.uncertain)
    )


def twelve_bits(stored: UInt8[np.ndarray, "H n"], form: str) -> Int16[np.ndarray, "H W"]:
    """Codes 0 .. 4095 of rows of bytes in a format of V4L2.

    Y12P: two pixels are three bytes, the upper eight bits of each and then the lower four of both,
    those of the second one above. Y12 may have its sign repeated in the four bits above.

    Raises:
        ValueError: If there are other bits where there should be none.
    """
    if form == "Y12P":
        first, second, low = (stored[:, n::3].astype(np.int16) for n in range(3))
        codes = np.stack([first << 4 | low & 15, second << 4 | low >> 4], axis=2)
        return codes.reshape(len(stored), -1)
    words = stored.view("<u2")
    if form == "Y16":
        unused, codes = words & 15, words >> 4
    else:
        sign = np.where(words & 0x800, 15, 0)
        unused, codes = words >> 12, words & 0xFFF
        unused = np.where(unused == sign, 0, unused)
    if unused.any():
        raise ValueError(
            f"bits that {form} leaves at 0 are set in {int((unused > 0).sum())} pixels"
        )
    return codes.astype(np.int16)


def _quads(source: Path, settings: Settings, notes: Notes) -> Float[np.ndarray, "F H W"]:
    """Values of all buffers."""
    (width, height), form = settings["raw.size"], settings["raw.format"]
    mode = settings["raw.output_mode"]
    stored = 2 * width if mode == "A&B" else width
    if stored * FORMATS[form] % 8:
        why = f"expected an even number of columns, since two share three bytes, found {width}"
        raise settings.wrong("raw.size", why, "give the size of the stored image")
    used = stored * FORMATS[form] // 8
    line = settings["raw.bytesperline"] or used
    step = settings["raw.sizeimage"] or line * height
    if line < used or step < line * height:
        why = f"expected at least {used} bytes in a row and {line * height} in a buffer, found "
        why += f"{line} and {step}"
        raise settings.wrong("raw.bytesperline", why, "give what VIDIOC_G_FMT returns")
    files = files_of(source)
    for path in files:
        size = size_of(path)
        if size == 0 or size % step:
            why = f"expected buffers of {step} bytes ({stored}x{height} pixels of {form}), found "
            why += f"{size} bytes{_other_format(size, stored * height)}"
            raise InputError("not whole buffers", where=path, why=why, fix="correct the keys")
    counts = [size_of(path) // step for path in files]
    quads = empty_quads(source, sum(counts), {"H": height, "W": width})
    ends, n = 0, 0
    for path, count in zip(files, counts, strict=True):
        for k in range(count):
            rows = raw_bytes(path, k * step, line * height).reshape(height, line)[:, :used]
            try:
                codes = twelve_bits(np.ascontiguousarray(rows), form)
            except ValueError as error:
                fix = "give another raw.format, raw.size or raw.bytesperline"
                what = "not this pixel format"
                raise InputError(what, where=path, why=f"buffer {k}: {error}", fix=fix) from error
            quads[n], full = _value(codes, mode, settings["raw.both"])
            ends += full
            n += 1
    notes.understood.append(f"buffers: {n} in {len(files)} files, {width}x{height}, {form}")
    if ends:
        notes.uncertain.append(f"{ends} codes are at an end of their range: saturated, and kept")
    return quads


def _value(
    codes: Int16[np.ndarray, "H n"], mode: str, both: str
) -> tuple[Float[np.ndarray, "H W"], int]:
    """Quads of a buffer's codes, and the number of codes at an end of their range."""
    if mode == "A-B":  # signed
        values = np.where(codes >= CODES // 2, codes - CODES, codes)
        return values.astype(np.float32), int((np.abs(values + 0.5) > CODES // 2 - 1).sum())
    full = int((codes == CODES - 1).sum())
    if mode != "A&B":
        return codes.astype(np.float32), full
    half = codes.shape[1] // 2
    halves = both == "halves"
    a, b = (codes[:, :half], codes[:, half:]) if halves else (codes[:, ::2], codes[:, 1::2])
    return (a - b).astype(np.float32), full


def _other_format(size: int, pixels: int) -> str:
    """The pixel formats whose buffers would fit."""
    fit = [form for form, bits in FORMATS.items() if size and size % (pixels * bits // 8) == 0]
    return f", whole buffers of {' or '.join(fit)}" if fit else ""
