"""Dumps of Melexis MLX75026 and MLX75027 by V4L2: buffers without headers, one phase in each.

The sensor has two taps, A at the shift of PHASE_SEQ and B half a turn later. Its control
OUTPUT_MODE says what a pixel is: A - B, the usual one, A, B, or both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int16

from ..data.folder import empty_quads
from ..errors import InputError
from . import camera_keys, pose_keys, regular, sensor_keys, timing
from .imported import Imported, Notes
from .keys import Key, Settings
from .pixel_formats import CODES, FORMATS, twelve_bits
from .raw_files import buffers_of, files_of, raw_bytes

MODES = {"A-B": 0.0, "A": 0.0, "B": 180.0, "A&B": 0.0}  # [deg] added to the shift of the quad
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
    *pose_keys.KEYS,
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
    exposures = timing.exposures_of(settings, len(quads))
    turned = ", ".join(f"{-shift % 360:g}" for shift in settings["sensor.shifts_deg"])
    notes.uncertain.append(
        "the sign of PHASE_SEQ is not documented: if distances shrink where they should grow, "
        f"write sensor.shifts_deg = [{turned}]"
    )
    if not settings.given("sensor.shifts_deg"):
        notes.uncertain.append("PHASE_SEQ is taken as 0, 180, 90, 270, the default of the driver")
    return regular.imported(source, settings, notes, quads, modulation, times, exposures=exposures)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where the pixels of a buffer are."""

    form: str
    """Pixel format."""
    rows: int
    """Rows."""
    columns: int
    """Stored columns, those of both taps if both are stored."""
    used: int
    """Bytes of a row that are pixels."""
    line: int
    """Bytes from one row to the next."""
    step: int
    """Bytes from one buffer to the next."""

    @classmethod
    def of(cls, settings: Settings) -> Layout:
        """That of the keys.

        Raises:
            InputError: If they contradict each other.
        """
        (width, height), form = settings["raw.size"], settings["raw.format"]
        columns = 2 * width if settings["raw.output_mode"] == "A&B" else width
        if columns * FORMATS[form] % 8:
            why = f"expected an even number of columns, since two share three bytes, found {width}"
            raise settings.wrong("raw.size", why, "give the size of the stored image")
        used = columns * FORMATS[form] // 8
        line = settings["raw.bytesperline"] or used
        step = settings["raw.sizeimage"] or line * height
        if line < used or step < line * height:
            why = f"expected at least {used} bytes in a row and {line * height} in a buffer, found "
            why += f"{line} and {step}"
            raise settings.wrong("raw.bytesperline", why, "give what VIDIOC_G_FMT returns")
        return cls(form=form, rows=height, columns=columns, used=used, line=line, step=step)

    def other_formats(self, size: int) -> str:
        """The pixel formats whose buffers would fill a file of so many bytes, in words."""
        bytes_ = {form: self.rows * self.columns * bits // 8 for form, bits in FORMATS.items()}
        fit = [form for form, step in bytes_.items() if size and size % step == 0]
        return f", whole buffers of {' or '.join(fit)}" if fit else ""


def _quads(source: Path, settings: Settings, notes: Notes) -> Float[np.ndarray, "F H W"]:
    """Values of all buffers."""
    layout, (width, height) = Layout.of(settings), settings["raw.size"]
    what = f"{layout.columns}x{height} pixels of {layout.form}"
    buffers = buffers_of(files_of(source), layout.step, what, layout.other_formats)
    quads = empty_quads(source, len(buffers), {"H": height, "W": width})
    ends = 0
    for n, (path, first) in enumerate(buffers):
        rows = raw_bytes(path, first, layout.line * height).reshape(height, layout.line)
        try:
            codes = twelve_bits(np.ascontiguousarray(rows[:, : layout.used]), layout.form)
        except ValueError as error:
            why, fix = f"buffer {n}: {error}", "give another raw.format, size or bytesperline"
            raise InputError("not this pixel format", where=path, why=why, fix=fix) from error
        quads[n], full = _value(codes, settings["raw.output_mode"], settings["raw.both"])
        ends += full
    notes.understood.append(f"buffers: {len(buffers)}, {width}x{height}, {layout.form}")
    if ends:
        notes.uncertain.append(f"{ends} codes are at an end of their range: saturated, and kept")
    return quads


def _value(
    codes: Int16[np.ndarray, "H n"], mode: str, both: str | None
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
