"""Packets of a .vxl file of the TI Voxel SDK, all numbers with the low byte first.

    file     version, 2 bytes, and three generators, 4 bytes each; then packets
    packet   VOXEL, type, 1 byte, size of the body, 4 bytes; body
    data     number of the frame, 4 bytes; time [us], 8; count, 4 or 8; as many bytes
    settings frame type, 1 byte; size, 4; size of the table, 4; names and values

A name, and a value that is a text, is a length of 4 bytes and as many characters; any other value
is a number of 4 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from .raw_files import raw_bytes, size_of

FILE, PACKET, SETTINGS = struct.Struct("<2B3I"), struct.Struct("<5sBI"), struct.Struct("<BII")
COUNTS = (struct.Struct("<iQI"), struct.Struct("<iQQ"))  # of two versions of the SDK
MAGIC, VERSION = b"VOXEL", (0, 1)
DATA, CONFIGURATION = 0, 1  # types of packets
RAW_FRAME = 1  # frame type whose settings describe raw data
TEXTS = {b"phaseOffsetsFile", b"phaseOffsets", b"crossTalkCoefficients"}
NUMBERS = {
    name.encode()
    for name in (
        *("version", "tofFrameType", "quadCount", "bytesPerPixel", "dataArrangeMode"),
        *("roiX", "roiY", "roiWidth", "roiHeight", "frameWidth", "frameHeight"),
        *("maxFrameWidth", "maxFrameHeight", "rowsToMerge", "columnsToMerge"),
        *("histogramEnabled", "dealiased16BitMode"),
    )
}


@dataclass(frozen=True, kw_only=True)
class Data:
    """Where a frame's raw data are in the file."""

    number: int
    """Number that the camera gave the frame."""
    time_us: int
    """When it arrived [us]."""
    first: int
    """First byte in the file."""
    count: int
    """Number of bytes."""


def packets(path: Path) -> Iterator[Data | dict[str, int | bytes]]:
    """Frames, and settings of raw frames by name, in the order of the file.

    Raises:
        InputError: If it is no such file, or is damaged or truncated.
    """
    size = size_of(path)
    head = raw_bytes(path, 0, min(FILE.size, size)).tobytes()
    if len(head) < FILE.size or FILE.unpack(head)[:2] != VERSION:
        why = f"expected a file that begins with {bytes(VERSION)!r}, found {head[:2]!r}"
        raise InputError("no .vxl file", where=path, why=why, fix="check the path")
    first = FILE.size
    while first < size:
        magic, kind, length = PACKET.unpack(raw_bytes(path, first, PACKET.size).tobytes())
        body = first + PACKET.size
        if magic != MAGIC or kind not in (DATA, CONFIGURATION) or body + length > size:
            why = f"expected {MAGIC!r}, type {DATA} or {CONFIGURATION} and a body of at most "
            why += f"{size - body} bytes, found {magic!r}, {kind} and {length}"
            raise _damaged(path, first, why)
        if kind == DATA:
            yield _data(path, body, length)
        else:
            settings = _settings(path, body, raw_bytes(path, body, length).tobytes())
            if settings is not None:
                yield settings
        first = body + length


def _data(path: Path, body: int, length: int) -> Data:
    """A frame, whose count is the rest of its packet in one of the two versions."""
    for layout in COUNTS:
        if length >= layout.size:
            head = raw_bytes(path, body, layout.size).tobytes()
            number, time_us, count = layout.unpack(head)
            if count == length - layout.size:
                return Data(number=number, time_us=time_us, first=body + layout.size, count=count)
    why = f"expected a frame whose count of bytes fills its packet of {length}, found another count"
    raise _damaged(path, body, why)


def _settings(path: Path, body: int, content: bytes) -> dict[str, int | bytes] | None:
    """Settings of raw frames by name; None if they are of another type of frames."""
    if len(content) < SETTINGS.size:
        raise _damaged(path, body, f"expected settings, found {len(content)} bytes")
    kind, length, table = SETTINGS.unpack_from(content)
    if kind != RAW_FRAME:
        return None
    left = content[SETTINGS.size :]
    if (length, table) != (len(left) + 4, len(left)):
        why = f"expected a table of {len(left)} bytes, found sizes {length} and {table}"
        raise _damaged(path, body, why)
    values: dict[str, int | bytes] = {}
    while left:
        name, left = _text(path, body, left)
        if name in TEXTS:
            values[name.decode()], left = _text(path, body, left)
        elif name in NUMBERS and len(left) >= 4:
            values[name.decode()], left = int.from_bytes(left[:4], "little"), left[4:]
        else:
            raise _damaged(path, body, f"expected a known name and its value, found {name[:40]!r}")
    return values


def _text(path: Path, body: int, left: bytes) -> tuple[bytes, bytes]:
    """A text at the beginning of some bytes, and the bytes after it."""
    length = int.from_bytes(left[:4], "little")
    if len(left) < 4 + length:
        why = f"expected a text of {length} bytes, found {max(len(left) - 4, 0)}"
        raise _damaged(path, body, why)
    return left[4 : 4 + length], left[4 + length :]


def _damaged(path: Path, first: int, why: str) -> InputError:
    fix = "copy or record the file again"
    return InputError("damaged", where=f"{path}, byte {first}", why=why, fix=fix)
