"""OpenEXR files of named channels, in one part or several; files are read back after writing.

A file of one part is not compressed: the last bits of float32 are noise, so that compressing six
320x240 images takes 20 ms of a CPU and leaves four fifths of their size. Parts of a capture are
compressed, once for all readers.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..errors import InputError, ResourceError
from .files import atomic_path, one_of_many
from .untrusted import CHANNELS_MAX, PARTS_MAX, SIDE_MAX, check_unpacked

# of captures; half is refused: its steps are 2 mm at 2 m
TYPES = {np.dtype(np.float32), np.dtype(np.uint32)}

_PRINTING = threading.Lock()
if hasattr(os, "register_at_fork"):  # a forked process must not inherit another thread's lock
    _release = _PRINTING.release
    os.register_at_fork(before=_PRINTING.acquire, after_in_parent=_release, after_in_child=_release)

Attribute = str | int | float
NO_ATTRIBUTES: Mapping[str, Attribute] = MappingProxyType({})
Channels = dict[str, np.ndarray]
Parts = dict[str, Channels]


def write_exr(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    *,
    attributes: Mapping[str, Attribute] = NO_ATTRIBUTES,
    one_of: bool = False,
) -> None:
    """Write images [H, W] of one size as float32 in an OpenEXR file of one part, atomically.

    NaN is kept; viewers show the names R, G, B as colour. ``attributes`` go into the header, floats
    as arrays of one float64. ``one_of``: whether it is a file inside ``files.many_files``.

    Raises:
        ValueError: If there are no channels, or their shapes differ or are not [H, W].
        UsageError, ResourceError: If the file cannot be written.
    """
    import OpenEXR

    images = {
        name: np.ascontiguousarray(image, dtype=np.float32) for name, image in channels.items()
    }
    _check_images([images])
    header: dict[str, Any] = {
        "compression": OpenEXR.NO_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    for name, value in attributes.items():  # a single float would lose half of its digits
        header[name] = np.array([value]) if isinstance(value, float) else value
    with one_of_many(Path(path)) if one_of else atomic_path(path) as temporary:
        file = OpenEXR.File(header, dict(images))  # which changes the dictionary
        _write(temporary, file, [images], Path(path))


def write_parts(path: str | Path, parts: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write a new OpenEXR file of several parts, losslessly compressed, and flush it to the disk.

    ``parts`` are channels [H, W] by name, by name of the part; all of one size, float32 or uint32.

    Raises:
        ValueError: If there is nothing to write, or sizes or types do not fit.
        ResourceError: If the content read back differs.
        OSError: If the file cannot be written.
    """
    import OpenEXR

    whole = {
        n: {c: np.ascontiguousarray(image) for c, image in channels.items()}
        for n, channels in parts.items()
    }
    _check_images(list(whole.values()))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    file = OpenEXR.File([OpenEXR.Part(dict(header), dict(c), name) for name, c in whole.items()])
    _write(Path(path), file, list(whole.values()), Path(path))
    with open(path, "rb+") as written:
        os.fsync(written.fileno())


def read_exr(path: str | Path) -> Channels:
    """Read the images [H, W] of an OpenEXR file of one part by channel name.

    Raises:
        InputError: If it is missing, damaged, truncated, too large, or has subsampled channels or
            several parts.
    """
    return next(iter(_read(Path(path), 1).values()))


def read_parts(path: str | Path) -> Parts:
    """Read the channels [H, W] of an OpenEXR file by name, by name of the part.

    Raises:
        InputError: If the file is missing, damaged, truncated, too large, or has subsampled or
            half-precision channels.
    """
    path = Path(path)
    parts = _read(path, PARTS_MAX)
    types = {image.dtype for channels in parts.values() for image in channels.values()}
    if types - TYPES:
        names = ", ".join(map(str, types - TYPES))
        raise _unreadable(path, PARTS_MAX, f"{names} instead of float32")
    return parts


def _check_images(parts: list[Channels]) -> None:
    """Check sizes and types: OpenEXR writes wrong pixels without an error."""
    images = [image for channels in parts for image in channels.values()]
    shapes, types = {image.shape for image in images}, {image.dtype for image in images}
    if len(shapes) != 1 or images[0].ndim != 2 or not types <= TYPES:
        kinds = ", ".join(sorted({str((i.shape, i.dtype)) for i in images})) or "none"
        expected = "channels must be float32 or uint32 images [H, W] of one shape"
        raise ValueError(f"{expected}, got {kinds}")


def _write(path: Path, file: Any, parts: list[Channels], where: Path) -> None:
    """Write a file and compare it: OpenEXR does not notice a full disk at the end of a file."""
    # so that a folder without permission and a full disk are different errors
    path.touch(exist_ok=False)
    try:
        with file:
            file.write(str(path))
    except RuntimeError as error:
        why, fix = str(error), "free disk space"
        raise ResourceError("cannot write picture", where=where, why=why, fix=fix) from error
    try:
        back = list(_read(path, PARTS_MAX).values())
    except InputError:
        back = []
    if not _same(back, parts):
        why, fix = "reading it back gave other pixels", "check the disk, and that it is not full"
        raise ResourceError("picture damaged while writing", where=where, why=why, fix=fix)


def _read(path: Path, parts_max: int) -> Parts:
    """Every part of a file; sizes are checked before anything is allocated."""
    import OpenEXR

    if not path.is_file():
        why, fix = "expected an OpenEXR file", "check the path"
        raise InputError("no such picture", where=path, why=why, fix=fix)
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            stated = [_stated(part.header) for part in file.parts]
            names = {part.name() for part in file.parts}
        if not 1 <= len(stated) <= parts_max or len(names) != len(stated):
            raise ValueError(f"{len(stated)} parts")
        pixels = sum(math.prod(shape) * len(channels) for shape, channels in stated)
        check_unpacked(4 * pixels, path.stat().st_size)
        with _silence(), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = {
                part.name(): {c: np.array(channel.pixels) for c, channel in part.channels.items()}
                for part in file.parts
            }
        for (shape, channels), got in zip(stated, parts.values(), strict=True):
            if got.keys() != channels or any(image.shape != shape for image in got.values()):
                raise ValueError(f"{len(got)} of {len(channels)} channels")
    except Exception as error:  # the library raises many kinds of exceptions
        raise _unreadable(path, parts_max, str(error)) from error
    return parts


class _OtherThreads:
    """Standard output of all threads but one.

    One object for the whole process: ``print`` holds no reference to the stream it writes to, so
    one that was freed while another thread printed would crash the process.
    """

    stream: Any = None
    silent: int | None = None  # identity of the thread

    def write(self, text: str) -> int:
        """Write, or drop, a text."""
        return len(text) if threading.get_ident() == self.silent else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_OTHER_THREADS = _OtherThreads()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop what OpenEXR prints to stdout about damaged pixels: their channels are missing, too."""
    with _PRINTING:
        _OTHER_THREADS.stream, _OTHER_THREADS.silent = sys.stdout, threading.get_ident()
        sys.stdout = _OTHER_THREADS
        try:
            yield
        finally:
            sys.stdout, _OTHER_THREADS.silent = _OTHER_THREADS.stream, None


def _unreadable(path: Path, parts_max: int, actual: str) -> InputError:
    count = "one whole OpenEXR part" if parts_max == 1 else "whole OpenEXR parts"
    why = f"expected {count} of at most {SIDE_MAX}x{SIDE_MAX} in float32, found {actual}"
    fix = "copy or export the file again"
    return InputError("unreadable picture", where=path, why=why, fix=fix)


def _stated(header: Mapping) -> tuple[tuple[int, int], set[str]]:
    """Shape and channel names in the header of a part."""
    low, high = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    channels = header["channels"]
    sized = 1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX
    if not (sized and 1 <= len(channels) <= CHANNELS_MAX):
        raise ValueError(f"a part of {width}x{height} with {len(channels)} channels")
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in channels):
        raise ValueError("subsampled channels")
    return (height, width), {channel.name for channel in channels}


def _same(one: list[Channels], other: list[Channels]) -> bool:
    """Whether all parts have the same bits."""
    if [part.keys() for part in one] != [part.keys() for part in other]:
        return False
    return all(a[c].tobytes() == b[c].tobytes() for a, b in zip(one, other, strict=True) for c in a)
