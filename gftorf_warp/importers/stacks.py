"""Files of one or many images as arrays, by their suffix; large ones stay on the disk.

NumPy arrays and raw binary are mapped; the others are read whole, in their stored type.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.arrays import map_array
from ..data.exr import read_exr
from ..data.matlab import read_matrix
from ..data.pictures import read_picture
from ..data.resources import to_open
from ..data.untrusted import PACKED_MAX, read_bytes, unreadable
from ..errors import GftorfError, InputError
from . import hdf5_files
from .keys import Key, Settings
from .raw_files import check_resources, size_of

NUMPY, ZIPPED = (".npy",), (".npz",)
HDF5, MATLAB = (".h5", ".hdf5", ".he5"), (".mat",)
PICTURES, EXR, RAW = (".png", ".tif", ".tiff"), (".exr",), (".bin", ".raw", ".dat")
SUFFIXES = (*NUMPY, *ZIPPED, *HDF5, *MATLAB, *PICTURES, *EXR, *RAW)
TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
BY_AXES = {2: "rows columns", 3: "frames rows columns"}
KEYS = (
    Key(
        name="source.dataset",
        kind=str,
        about="name of the array in a .npz, .h5 or .mat file; without, its only one",
        example="quads",
    ),
    Key(
        name="source.channels",
        kind=str,
        about="channels of an EXR file, one for each tap; without, its only one",
        example=("A", "B"),
        shape=(None,),
    ),
    Key(
        name="raw.type",
        kind=str,
        about="of raw binary files: type of a value",
        example="uint16",
        choices=TYPES,
    ),
    Key(
        name="raw.shape",
        kind=int,
        about="of raw binary files: lengths of the axes but the first, which follows from the size",
        example=(240, 320),
        shape=(None,),
        least=1,
    ),
    Key(
        name="raw.big_endian",
        kind=bool,
        about="of raw binary files: whether the high byte is first",
        example=False,
        default=False,
    ),
    Key(
        name="raw.header_bytes",
        kind=int,
        about="of raw binary files: bytes before the first value",
        example=0,
        default=0,
        least=0,
    ),
    Key(
        name="raw.item_header_bytes",
        kind=int,
        about="of raw binary files: bytes before each item of the first axis",
        example=0,
        default=0,
        least=0,
    ),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stack:
    """The array of a file."""

    path: Path
    """The file."""
    array: np.ndarray
    """Numbers in their stored type; of any number of axes."""
    axes: str | None
    """Names of its axes where the file decides about them, separated by blanks; None: it does
    not."""


def needed_keys(path: Path) -> tuple[str, ...]:
    """Keys without which a file of this name cannot be read."""
    return ("raw.type", "raw.shape") if path.suffix.lower() in RAW else ()


def open_stack(path: Path, settings: Settings) -> Stack:
    """The array of a file.

    Raises:
        InputError: If it is not a whole file of its kind, holds no real numbers, or several arrays
            and none is named.
        ResourceError: If it is an HDF5 file and h5py is not installed, or too large for memory.
    """
    suffix, name = path.suffix.lower(), settings["source.dataset"]
    axes = None
    if suffix not in (*NUMPY, *RAW):
        check_resources(to_open(size_of(path)), path)
    if suffix in NUMPY:
        array = map_array(path)
    elif suffix in ZIPPED:
        array = _zipped(path, name)
    elif suffix in HDF5:
        array = hdf5_files.read_dataset(path, name)
    elif suffix in MATLAB:
        array = _matlab(path, name)
    elif suffix in PICTURES:
        pages = read_picture(path)
        if pages.ndim != 3:
            why = f"expected one channel, found {pages.shape[-1]}"
            fix = "export the quads in one channel, or name their files by source.files"
            raise InputError("a colour picture", where=path, why=why, fix=fix)
        array = pages[0] if len(pages) == 1 else pages
    elif suffix in EXR:
        array = _exr(path, settings["source.channels"])
        axes = "taps rows columns" if array.ndim == 3 else None
    elif suffix in RAW:
        array = _raw(path, settings)
    else:
        why = f"expected one of {', '.join(SUFFIXES)}, found {path.suffix or 'no suffix'}"
        raise InputError("unknown format", where=path, why=why, fix="name it by its format")
    if array.dtype.kind not in "iuf" or array.size == 0:
        why = f"expected real numbers, found {array.dtype} of shape {array.shape}"
        raise InputError("no images", where=path, why=why, fix="export numbers")
    return Stack(path=path, array=array, axes=axes)


def _zipped(path: Path, name: str | None) -> np.ndarray:
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            member = members[_only(path, name, list(members))]
            size = path.stat().st_size
            if member.file_size > PACKED_MAX * size or member.compress_size > size:
                raise ValueError(f"{member.file_size} bytes packed into {size}")
            check_resources(to_open(member.file_size), path)
        with np.load(path, allow_pickle=False) as arrays:
            return arrays[member.filename.removesuffix(".npy")]
    except GftorfError:
        raise
    except Exception as error:  # as of .npy files, and what damaged archives raise
        raise unreadable(
            path, f"expected arrays as numpy.savez writes them, found {error}"
        ) from error


def _only(path: Path, name: str | None, names: list[str]) -> str:
    """The named array, or the only one."""
    if (name is None and len(names) == 1) or name in names:
        return name or names[0]
    why = f"expected {'one array' if name is None else repr(name)}, found {', '.join(names)[:400]}"
    raise InputError("no such array", where=path, why=why, fix="name one, by source.dataset")


def _matlab(path: Path, name: str | None) -> np.ndarray:
    data = read_bytes(path)
    if data[512:520] == hdf5_files.MAGIC:  # version 7.3; HDF5 has the axes the other way round
        return hdf5_files.read_dataset(path, name).T
    try:
        return read_matrix(data, name, unpacked_max=PACKED_MAX * len(data))
    except ValueError as error:
        why = f"expected a MATLAB file with an array of real numbers, found {error}"
        fix = "save it with save -v7, and name the array, by source.dataset"
        raise InputError("unreadable", where=path, why=why, fix=fix) from error


def _exr(path: Path, names: tuple[str, ...] | None) -> np.ndarray:
    channels: Mapping[str, np.ndarray] = read_exr(path)
    if names is None and len(channels) > 1:
        why = f"it has channels {', '.join(channels)}"
        raise InputError("several channels", where=path, why=why, fix="name by source.channels")
    names = names or tuple(channels)
    missing = [name for name in names if name not in channels]
    if missing:
        why = f"expected channels {', '.join(names)}, found {', '.join(channels)}"
        raise InputError("no such channel", where=path, why=why, fix="correct source.channels")
    images = [channels[name] for name in names]
    return images[0] if len(images) == 1 else np.stack(images)


def _raw(path: Path, settings: Settings) -> np.ndarray:
    settings.require(*needed_keys(path))
    order = ">" if settings["raw.big_endian"] else "<"
    kind = np.dtype(settings["raw.type"]).newbyteorder(order)
    shape: tuple[int, ...] = settings["raw.shape"]
    head, before = settings["raw.header_bytes"], settings["raw.item_header_bytes"]
    item = before + math.prod(shape) * kind.itemsize
    size = path.stat().st_size if path.is_file() else 0
    items = (size - head) // item
    if items < 1 or (size - head) % item:
        why = f"expected {head} bytes and items of {item} ({before}, then {shape} of {kind.name}), "
        why += f"found {size}, which is {(size - head) / item:.6g} items"
        fix = "correct [raw], or copy the file again"
        raise InputError("not a whole number of images", where=path, why=why, fix=fix)
    mapped = np.memmap(path, np.uint8, "r", head, (items, item))
    return mapped[:, before:].view(kind).reshape(items, *shape)
