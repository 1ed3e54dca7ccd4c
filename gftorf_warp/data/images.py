"""Pictures for people as PNG files."""

from __future__ import annotations

import struct
import zlib

import numpy as np


def png_bytes(rgb: np.ndarray, *, flat: bool = False) -> bytes:
    """An 8-bit colour image [H, W, 3], uint8, red first, as the content of a PNG file.

    ``flat``: whether neighbours mostly have the same colour, as in enlarged and drawn pictures;
    those are encoded in half the time and space without prediction.

    Raises:
        ValueError: If it is another type or shape.
    """
    import cv2

    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"rgb {rgb.dtype} {rgb.shape} must be uint8 [H, W, 3]")
    # OpenCV keeps blue first
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    done, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]), options if flat else [])
    if not done:
        raise ValueError(f"rgb {rgb.shape} could not be encoded")
    return data.tobytes()


def indexed_png_bytes(index: np.ndarray, palette: np.ndarray) -> bytes:
    """Indices [H, W] into a palette [C, 3], both uint8, red first, as the content of a PNG file.

    It is not compressed: smaller than three bytes per pixel by OpenCV, in a thirtieth of the time.

    Raises:
        ValueError: If they are other types or shapes.
    """
    fits = index.ndim == 2 and palette.shape[1:] == (3,)
    if not fits or {index.dtype, palette.dtype} != {np.dtype(np.uint8)}:
        expected = f"must be uint8 [H, W], of colours {palette.shape} [C, 3]"
        raise ValueError(f"index {index.dtype} {index.shape} {expected}")
    height, width = index.shape
    # each begins with how it differs from the one above: it does not
    lines = np.zeros((height, 1 + width), np.uint8)
    lines[:, 1:] = index
    chunks = [
        (b"IHDR", struct.pack(">2I5B", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", palette.tobytes()),
        (b"IDAT", zlib.compress(lines.data, 0)),
        (b"IEND", b""),
    ]
    parts = [b"\x89PNG\r\n\x1a\n"]
    for kind, content in chunks:
        checksum = zlib.crc32(content, zlib.crc32(kind))
        parts += [struct.pack(">I", len(content)), kind, content, struct.pack(">I", checksum)]
    return b"".join(parts)
