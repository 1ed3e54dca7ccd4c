"""Pictures on disk: float32 OpenEXR for numbers, PNG for eyes. Every file is read back or checked before it counts.

Neither what is in EXR files nor previews of numbered colours are compressed: the last bits of float32 are noise, so
that compressing takes 20 ms of a CPU for six 320x240 images and leaves four fifths of them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import InputError, ResourceError
from .arrays import SIDE_MAX
from .files import atomic_path, one_of_many

CHANNELS_MAX = 256  # a rendering has a few dozen; a forged header may claim millions


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray], *, one_of: bool = False) -> None:
    """Write named float32 images of one size as an OpenEXR file, atomically.

    Args:
        path: The file; its folder must exist.
        channels: Images [H, W] by name, for example ``{"distance": ..., "quads.0": ...}``; any real type that float32
            holds. Viewers show the names R, G, B as colour. NaN is kept.
        one_of: Whether it is one of many files, in a folder that ``files.many_files`` looks after.

    Raises:
        ValueError: If there are no channels, or their shapes differ or are not [H, W].
        UsageError, ResourceError: If the file cannot be written.
    """
    import OpenEXR

    # a slice, a flip or Fortran order is written with wrong pixels and no error
    images = {name: np.ascontiguousarray(image, dtype=np.float32) for name, image in channels.items()}
    shapes = {image.shape for image in images.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        found = ", ".join(f"{name} {image.shape}" for name, image in images.items()) or "none"
        raise ValueError(f"channels must be images [H, W] of one shape, got {found}")
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    with one_of_many(Path(path)) if one_of else atomic_path(path) as temporary:
        temporary.touch(exist_ok=False)  # so that a place that cannot be written to is told from a disk that is full
        try:
            with OpenEXR.File(header, dict(images)) as file:  # it puts its own channels into the dictionary
                file.write(str(temporary))
        except RuntimeError as error:
            raise ResourceError("cannot write picture", where=path, why=str(error), fix="free disk space") from error
        back: dict[str, np.ndarray] = {}
        with suppress(InputError):  # the library does not notice a disk that is full at the end of a file
            back = read_exr(temporary)
        if back.keys() != images.keys() or any(back[n].tobytes() != image.tobytes() for n, image in images.items()):
            raise ResourceError(
                "picture damaged while writing",
                where=path,
                why="reading it back gave other pixels",
                fix="check the disk, and that it is not full",
            )


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
