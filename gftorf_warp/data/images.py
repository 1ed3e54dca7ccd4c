"""Pictures on disk: float32 OpenEXR for numbers, PNG for eyes.

What ``gftorf render`` writes by the thousand is laid out here and not compressed. Compression takes 20 ms of a CPU for
six 320x240 images and leaves four fifths of them, since the last bits of float32 are noise; and OpenEXR's own writer
takes memory that is not contiguous for something else, and a full disk for none.
"""

from __future__ import annotations

import functools
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import InputError
from .arrays import SIDE_MAX
from .files import atomic_write

CHANNELS_MAX = 256  # a rendering has a few dozen; a forged header may claim millions
_SHORT = 31  # [bytes] of a channel's name; longer ones are announced in the version of the file


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray]) -> None:
    """Write named float32 images of one size as an OpenEXR file, atomically.

    Args:
        path: The file; its folder must exist.
        channels: Images [H, W] by name, for example ``{"distance": ..., "quads.0": ...}``; any real type that float32
            holds. Viewers show the names R, G, B as colour. NaN is kept.

    Raises:
        ValueError: If there are no channels, or their shapes differ or are not [H, W].
        UsageError, ResourceError: If the file cannot be written.
    """
    atomic_write(path, exr_bytes(channels))


def exr_bytes(channels: Mapping[str, np.ndarray]) -> memoryview:
    """Named images of one size, see :func:`write_exr`, as the content of an OpenEXR file.

    Raises:
        ValueError: If there are no channels, or their shapes differ or are not [H, W].
    """
    shapes = {image.shape for image in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        found = ", ".join(f"{name} {image.shape}" for name, image in channels.items()) or "none"
        raise ValueError(f"channels must be images [H, W] of one shape, got {found}")
    (height, width), names = next(iter(shapes)), sorted(channels, key=str.encode)
    row = 8 + 4 * width * len(names)  # [bytes] its number, how many bytes follow, and the channels' pixels
    start = _exr_start(tuple(name.encode() for name in names), height, width, row)
    content = np.empty(len(start) + height * row, np.uint8)
    content[: len(start)] = np.frombuffer(start, np.uint8)
    rows = content[len(start) :].reshape(height, row)
    rows[:, :4] = np.arange(height, dtype="<i4").view(np.uint8).reshape(height, 4)
    rows[:, 4:8] = np.frombuffer(struct.pack("<i", row - 8), np.uint8)
    pixels = rows[:, 8:].view("<f4").reshape(height, len(names), width)
    for k, name in enumerate(names):
        pixels[:, k] = channels[name]
    return content.data


@functools.lru_cache(maxsize=64)
def _exr_start(names: tuple[bytes, ...], height: int, width: int, row: int) -> bytes:
    """What stands before the rows, as OpenEXR writes it: one part, float32 scan lines; and where each begins."""
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    of_channel = struct.pack("<iB3xii", 2, 0, 1, 1)  # float32, not for perception, every pixel
    attributes = [
        (b"channels", b"chlist", b"".join(name + b"\0" + of_channel for name in names) + b"\0"),
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
        (b"type", b"string", b"scanlineimage"),
    ]
    parts = [name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value for name, kind, value in attributes]
    version = 2 | (0x400 if max(map(len, names)) > _SHORT else 0)
    header = struct.pack("<2i", 20000630, version) + b"".join(parts) + b"\0"
    begin = len(header) + 8 * height
    return header + (begin + row * np.arange(height, dtype="<u8")).tobytes()


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Read the images [H, W] of a single-part OpenEXR file by channel name.

    Raises:
        InputError: If it is missing, damaged, truncated, too large, or has subsampled channels.
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file():
        raise InputError("no such picture", where=path, why="expected an OpenEXR file", fix="check the path")
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            header = file.header()
            low, high = header["dataWindow"]
            width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
            parts, names = len(file.parts), {channel.name for channel in header["channels"]}
            sampled = any(channel.xSampling != 1 or channel.ySampling != 1 for channel in header["channels"])
        if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX and parts == 1 and len(names) <= CHANNELS_MAX):
            raise ValueError(f"{parts} parts of {width}x{height} with {len(names)} channels")
        if sampled:
            raise ValueError("subsampled channels")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            images = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        if images.keys() != names or any(image.shape != (height, width) for image in images.values()):
            raise ValueError(f"{len(images)} of {len(names)} channels could be read")
    except Exception as error:  # the library turns whatever it meets into whatever it likes
        raise InputError(
            "unreadable picture",
            where=path,
            why=f"expected one whole OpenEXR part of at most {SIDE_MAX}x{SIDE_MAX}, found {error}",
            fix="copy or export the file again",
        ) from error
    return images


def png_bytes(rgb: np.ndarray) -> bytes:
    """An 8-bit colour image [H, W, 3], uint8, red first, as the content of a PNG file.

    Raises:
        ValueError: If it is another type or shape.
    """
    import cv2

    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"rgb {rgb.dtype} {rgb.shape} must be uint8 [H, W, 3]")
    done, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))  # OpenCV keeps blue first
    if not done:
        raise ValueError(f"rgb {rgb.shape} could not be encoded")
    return data.tobytes()


def indexed_png_bytes(index: np.ndarray, palette: np.ndarray) -> bytes:
    """A picture of at most 256 colours as the content of a PNG file: a byte per pixel, not compressed.

    As it is, it is smaller than what OpenCV makes of three bytes per pixel, and takes a thirtieth of the time.

    Args:
        index: Image [H, W], uint8: which colour.
        palette: The colours [C, 3], uint8, red first.

    Raises:
        ValueError: If they are other types or shapes.
    """
    if index.dtype != np.uint8 or index.ndim != 2 or palette.dtype != np.uint8 or palette.shape[1:] != (3,):
        raise ValueError(f"index {index.dtype} {index.shape} must be uint8 [H, W], of colours {palette.shape} [C, 3]")
    height, width = index.shape
    lines = np.zeros((height, 1 + width), np.uint8)  # each begins with how it differs from the one above: it does not
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
