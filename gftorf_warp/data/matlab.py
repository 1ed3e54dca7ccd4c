"""One real array of a MATLAB 5 file: no cells, structures, objects or code.

Used instead of ``scipy.io.loadmat``, which crashes the interpreter on damaged files. A file is 128
bytes of header and then elements: a tag (type, length) and the data, padded to eight bytes; four
bytes or fewer fit into the tag. A matrix is an element of elements: flags with the class, size,
name, values by column.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from .untrusted import UNPACKED_MAX

MATRIX, COMPRESSED = 14, 15
INTEGERS = ("i1", "u1", "i2", "u2", "i4", "u4")
NUMBERS = dict(enumerate(INTEGERS, start=1)) | {7: "f4", 9: "f8", 12: "i8", 13: "u8"}
CLASSES = {6: "f8", 7: "f4"} | dict(enumerate((*INTEGERS, "i8", "u8"), start=8))
COMPLEX = 0x0800
AXES_MAX = 5  # cycles, slots, taps, rows and columns


def read_matrix(data: bytes, name: str | None, *, unpacked_max: int = UNPACKED_MAX) -> np.ndarray:
    """Array [rows, columns, ...] of a variable in the content of a file, in the type of its class.

    Args:
        data: Content of a file.
        name: Name of the variable; None: the only one.
        unpacked_max: Bytes that a compressed variable may have.

    Raises:
        ValueError: If the file is not of this kind, damaged, or has no such array of real numbers.
    """
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("no MATLAB 5 header")
    order = "<" if data[126:128] == b"IM" else ">"
    names, only = [], None
    for stored in _elements(data[128:], order):
        packed = stored[0] == COMPRESSED
        inner = _elements(_unpacked(stored[1], unpacked_max), order) if packed else iter([stored])
        kind, content = next(inner, (0, b""))
        if kind == MATRIX:
            parts = list(_elements(content, order))
            names.append(parts[2][1].decode("ascii", "replace") if len(parts) > 2 else "")
            if names[-1] == name:
                return _matrix(parts, order)
            only = parts
    if name is not None or only is None or len(names) > 1:
        expected = "one variable" if name is None else f"variable {name!r}"
        raise ValueError(f"no {expected} but {names}")
    return _matrix(only, order)


def _matrix(parts: list[tuple[int, bytes]], order: str) -> np.ndarray:
    """Values of a matrix from its flags, size, name and real part."""
    axes = len(parts[1][1]) // 4 if len(parts) > 1 else 0
    whole = len(parts) == 4 and [len(parts[0][1]), len(parts[1][1])] == [8, 4 * axes]
    if not (whole and 2 <= axes <= AXES_MAX):
        raise ValueError("not an array of real numbers with rows and columns")
    flags = struct.unpack(order + "I", parts[0][1][:4])[0]
    shape = struct.unpack(f"{order}{axes}i", parts[1][1])
    kind, values = parts[3]
    if flags & 0xFF not in CLASSES or flags & COMPLEX or kind not in NUMBERS or min(shape) < 1:
        text = f"class {flags & 0xFF}, type {kind}, size {shape}"
        raise ValueError(f"{text} is no matrix of real numbers")
    stored = np.dtype(order + NUMBERS[kind])
    if len(values) != math.prod(shape) * stored.itemsize:
        raise ValueError(f"{len(values)} bytes for {shape} numbers of {stored}")
    with np.errstate(over="ignore", invalid="ignore"):
        return np.frombuffer(values, stored).reshape(shape, order="F").astype(CLASSES[flags & 0xFF])


def _unpacked(data: bytes, most: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, most)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if not unpacker.eof:
        why = f"truncated, or unpack to more than {most} bytes"
        raise ValueError(f"compressed data are {why}")
    return content


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and content of each element in turn."""
    start = 0
    while start < len(data):
        if start + 8 > len(data):
            raise ValueError("truncated")
        kind, length = struct.unpack_from(order + "2I", data, start)
        if kind >> 16:  # the small form: both halves in four bytes, content in the other four
            kind, length, begin, step = kind & 0xFFFF, kind >> 16, start + 4, 8
            if length > 4:
                raise ValueError(f"a small element of {length} bytes")
        else:
            begin, step = start + 8, 8 + (length if kind == COMPRESSED else (length + 7) // 8 * 8)
        if begin + length > len(data):
            raise ValueError("truncated")
        yield kind, data[begin : begin + length]
        start += step
