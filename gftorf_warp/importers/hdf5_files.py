"""Datasets of HDF5 files, MATLAB 7.3 files among them. Needs h5py, the extra ``import``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..data.resources import to_open
from ..data.untrusted import PACKED_MAX, unreadable
from ..errors import InputError, ResourceError
from .raw_files import check_resources

if TYPE_CHECKING:
    import h5py

MAGIC = b"\x89HDF\r\n\x1a\n"


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file, opened for reading; what h5py raises inside becomes an InputError.

    Raises:
        ResourceError: If h5py is not installed.
        InputError: If it is no HDF5 file, or is damaged.
    """
    try:
        import h5py
    except ImportError as error:
        why, fix = "HDF5 files need the package h5py", "pip install 'gftorf-warp[import]'"
        raise ResourceError("h5py is not installed", where=path, why=why, fix=fix) from error
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError) as error:
        raise unreadable(path, f"expected a whole HDF5 file, found {str(error)[:200]}") from error


def read_dataset(path: Path, name: str | None = None) -> np.ndarray:
    """Numbers of a dataset in its stored type; without a name the only one of two or more axes.

    Links to other files, virtual datasets and those stored elsewhere are refused.

    Raises:
        InputError: If there is no such dataset of numbers, it is not complete, or the file is
            damaged.
        ResourceError: If h5py is not installed.
    """
    with open_hdf5(path) as file:
        by_name = datasets(file)
        images = [key for key, dataset in by_name.items() if dataset.ndim >= 2]
        if name is None and len(images) != 1:
            raise _no_dataset(path, "one dataset of images", by_name)
        key = images[0] if name is None else name.strip("/")
        if key not in by_name:
            raise _no_dataset(path, f"a dataset {key!r}", by_name)
        return checked(path, by_name[key])


def datasets(file: h5py.File) -> dict[str, Any]:
    """All datasets of a file by name, those behind links not among them."""
    import h5py

    by_name: dict[str, Any] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            by_name[name] = item

    file.visititems(visit)
    return by_name


def checked(path: Path, dataset: h5py.Dataset) -> np.ndarray:
    """The numbers of a dataset, after a check that the file holds as many.

    Raises:
        InputError: If they are no numbers, stored elsewhere, or more than the file can hold.
        ResourceError: If memory cannot hold them.
    """
    where = f"{path}, {dataset.name}"
    if dataset.dtype.kind not in "iuf":
        why = f"expected numbers, found {dataset.dtype}"
        raise InputError("no numbers", where=where, why=why, fix="name a dataset of numbers")
    if dataset.is_virtual or dataset.external:
        why, fix = "its numbers lie in other files", "copy them into one file, with h5repack"
        raise InputError("a link out of the file", where=where, why=why, fix=fix)
    most = PACKED_MAX * path.stat().st_size
    if dataset.size == 0 or dataset.nbytes > most:
        why = f"expected 1 to {most} bytes, found {dataset.nbytes} for shape {dataset.shape}"
        raise InputError("not complete", where=where, why=why, fix="copy or export the file again")
    check_resources(to_open(dataset.nbytes), path)
    return np.asarray(dataset[()])


def _no_dataset(path: Path, expected: str, by_name: dict[str, Any]) -> InputError:
    shapes = [f"{name} {dataset.shape}" for name, dataset in by_name.items()]
    why = f"expected {expected}, found {', '.join(shapes)[:400] or 'none'}"
    fix = "name one, by source.dataset for kind arrays"
    return InputError("no such dataset", where=path, why=why, fix=fix)
