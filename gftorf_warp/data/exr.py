"""OpenEXR files of several parts: what one camera recorded at one instant, each part of it with named channels."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import InputError, ResourceError
from .arrays import SIDE_MAX

PARTS_MAX = 64  # a raw frame has a handful; a forged header may claim millions
CHANNELS_MAX = 16  # of one part
TYPES = {np.dtype(np.float32), np.dtype(np.uint32)}  # half is refused: its steps are 2 mm at 2 m

Parts = dict[str, dict[str, np.ndarray]]


def write_parts(path: str | Path, parts: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write a new file, losslessly compressed, flush it to the disk and read it back.

    Args:
        path: A file that is not there; its folder must exist.
        parts: Channels [H, W] by name, by name of the part; all of one size, float32 or uint32. NaN is kept.

    Raises:
        ValueError: If there is nothing to write, or sizes or types do not fit.
        ResourceError: If what was written is not what can be read.
        OSError: If the file cannot be written.
    """
    import OpenEXR

    # a slice, a flip or Fortran order is written with wrong pixels and no error
    whole = {n: {c: np.ascontiguousarray(image) for c, image in channels.items()} for n, channels in parts.items()}
    images = [image for channels in whole.values() for image in channels.values()]
    found = {(image.shape, image.dtype) for image in images}
    if len({shape for shape, _ in found}) != 1 or images[0].ndim != 2 or not {t for _, t in found} <= TYPES:
        raise ValueError(
            f"channels must be float32 or uint32 images [H, W] of one shape, got {sorted(map(str, found))}"
        )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with open(path, "xb"):  # so that a place that cannot be written to is told from a disk that is full
        pass
    try:
        with OpenEXR.File([OpenEXR.Part(dict(header), dict(c), name) for name, c in whole.items()]) as file:
            file.write(str(path))
    except RuntimeError as error:
        raise ResourceError("cannot write picture", where=path, why=str(error), fix="free disk space") from error
    with open(path, "rb+") as written:
        os.fsync(written.fileno())
    back = read_parts(path)
    if not _same(back, whole):
        why = "reading it back gave other pixels"
        raise ResourceError("picture damaged while writing", where=path, why=why, fix="check the disk")


def read_parts(path: str | Path) -> Parts:
    """Channels [H, W] by name, by name of the part.

    Raises:
        InputError: If the file is missing, damaged, cut off, too large, or has subsampled or half-precision channels.
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file():
        raise InputError("no such picture", where=path, why="expected an OpenEXR file", fix="complete the folder")
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            stated = {part.name(): _stated(part.header) for part in file.parts}
            if not 1 <= len(file.parts) <= PARTS_MAX or len(stated) != len(file.parts):
                raise ValueError(f"{len(file.parts)} parts named {sorted(stated)}")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = {
                part.name(): {name: np.array(channel.pixels) for name, channel in part.channels.items()}
                for part in file.parts
            }
        for name, (shape, names) in stated.items():
            got = parts.get(name, {})
            if got.keys() != names or any(image.shape != shape or image.dtype not in TYPES for image in got.values()):
                raise ValueError(f"{len(got)} of {len(names)} channels of part {name} with {shape} float32 pixels")
    except Exception as error:  # the library turns whatever it meets into whatever it likes
        raise InputError(
            "unreadable picture",
            where=path,
            why=f"expected whole OpenEXR parts of at most {SIDE_MAX}x{SIDE_MAX} in float32, found {error}",
            fix="copy or export the file again",
        ) from error
    return parts


def _stated(header: Mapping) -> tuple[tuple[int, int], set[str]]:
    """Shape and channel names that the header of a part states, before anything is allocated."""
    low, high = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    channels = header["channels"]
    if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX and 1 <= len(channels) <= CHANNELS_MAX):
        raise ValueError(f"a part of {width}x{height} with {len(channels)} channels")
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in channels):
        raise ValueError("subsampled channels")
    return (height, width), {channel.name for channel in channels}


def _same(one: Parts, other: Parts) -> bool:
    """Whether all parts have the same bits."""
    if one.keys() != other.keys() or any(one[n].keys() != other[n].keys() for n in one):
        return False
    return all(one[n][c].tobytes() == other[n][c].tobytes() for n in one for c in one[n])
