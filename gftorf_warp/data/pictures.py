"""PNG and TIFF files of any depth as arrays; sizes are checked before anything is decoded."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .untrusted import FRAMES_MAX, SIDE_MAX, check_unpacked, read_bytes, unreadable

PNG = b"\x89PNG\r\n\x1a\n"
WIDTH_TAG, HEIGHT_TAG = 256, 257
BYTES_PER_PIXEL = 8  # at most: four channels of 16 bits
TAG_FORMATS = {3: "H", 4: "I"}  # a size is a number of 16 or 32 bits


@contextlib.contextmanager
def without_log_of_opencv() -> Iterator[None]:
    """Context in which OpenCV prints nothing about a damaged file: our error says it."""
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def read_picture(path: Path) -> np.ndarray:
    """The pages [P, H, W] or [P, H, W, C] in their stored type, one of a PNG file; three or four
    channels C in the order red, green, blue.

    Raises:
        InputError: If it is no whole PNG or TIFF file, its pages differ, or it is too large.
    """
    import cv2

    data = read_bytes(path)
    sizes = [_png_size(path, data)] if data.startswith(PNG) else _tiff_sizes(path, data)
    within = all(1 <= side <= SIDE_MAX for size in sizes for side in size)
    if not within or len(sizes) > FRAMES_MAX:
        text = f"{len(sizes)} pages, the first of {sizes[0]}"
        raise unreadable(path, f"expected 1 to {SIDE_MAX} pixels a side, found {text}")
    if data.startswith(PNG):
        _check_sums(path, data)
    try:
        pixels = sum(width * height for width, height in sizes)
        check_unpacked(BYTES_PER_PIXEL * pixels, len(data))
        with without_log_of_opencv():
            done, pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (ValueError, cv2.error) as error:
        raise unreadable(path, str(error).splitlines()[0][:200]) from error
    shapes = {(page.shape, page.dtype) for page in pages}
    if not done or len(pages) != len(sizes) or len(shapes) != 1:
        text = f"{len(pages)} of them, of shapes {sorted(map(str, shapes))}"
        raise unreadable(path, f"expected {len(sizes)} whole pages of one shape, found {text}")
    images = np.stack(pages)
    if images.ndim == 4 and images.shape[-1] in (3, 4):  # OpenCV keeps blue first
        images = images[..., [2, 1, 0, *range(3, images.shape[-1])]]
    return images


def _png_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height in the header of a PNG file."""
    if len(data) < 24:
        raise unreadable(path, f"expected a PNG file, found {len(data)} bytes")
    width, height = struct.unpack_from(">2I", data, 16)
    return width, height


def _check_sums(path: Path, data: bytes) -> None:
    """Check the CRC of every part of a PNG file: libpng prints to stderr about damaged ones, and
    may return what it could decode.

    Raises:
        InputError: If one is another than stored, or the file ends before its last part.
    """
    start, kind = len(PNG), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data.ljust(start + 8, b"\0"), start)
        end = start + 8 + length
        stored = data[end : end + 4]
        if len(stored) < 4:
            raise unreadable(path, f"expected a whole PNG file, found its first {len(data)} bytes")
        if zlib.crc32(data[start + 4 : end]) != int.from_bytes(stored, "big"):
            name = kind.decode("ascii", "replace")
            raise unreadable(path, f"expected a whole PNG file, found a damaged part {name!r}")
        start = end + 4


def _tiff_sizes(path: Path, data: bytes) -> list[tuple[int, int]]:
    """Width and height of each page of a TIFF file, from its directories."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or len(data) < 8 or struct.unpack_from(f"{order}H", data, 2)[0] != 42:
        why = f"expected a PNG or a TIFF file (not BigTIFF), found one that starts {data[:8]!r}"
        raise unreadable(path, why)
    sizes: list[tuple[int, int]] = []
    seen = set()
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    try:
        while start:
            if start in seen:
                raise ValueError("its directories form a circle")
            seen.add(start)
            count = struct.unpack_from(f"{order}H", data, start)[0]
            sides = {}
            for entry in range(start + 2, start + 2 + 12 * count, 12):
                tag, kind, _ = struct.unpack_from(f"{order}HHI", data, entry)
                if tag in (WIDTH_TAG, HEIGHT_TAG) and kind in TAG_FORMATS:
                    form = f"{order}{TAG_FORMATS[kind]}"
                    sides[tag] = struct.unpack_from(form, data, entry + 8)[0]
            sizes.append((sides.get(WIDTH_TAG, 0), sides.get(HEIGHT_TAG, 0)))
            start = struct.unpack_from(f"{order}I", data, start + 2 + 12 * count)[0]
    except (struct.error, ValueError) as error:
        raise unreadable(path, f"expected the directories of a TIFF file, found {error}") from error
    if not sizes:
        raise unreadable(path, "expected a TIFF file with a page, found none")
    return sizes
