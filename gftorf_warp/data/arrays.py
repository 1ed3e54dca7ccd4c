"""Reading untrusted files: nothing in them is executed, sizes are checked before allocation."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .matlab import read_matrix
from .specs import Field
from .untrusted import SIDE_MAX, SMALL_FILE_BYTES, unreadable

LIMITS = {"H": SIDE_MAX, "W": SIDE_MAX, "h": SIDE_MAX, "w": SIDE_MAX} | dict.fromkeys(
    "FPM", 1_000_000
)
KINDS = {"f": "floating point", "i": "integer", "u": "unsigned integer"}


def read_array(path: Path, field: Field, sizes: Mapping[str, int] | None = None) -> np.ndarray:
    """Read a .npy or .mat file in its stored type and check it against the description of its
    field; no infinities, and NaN only where the field allows it.

    ``sizes`` are known values of letters in the field's shapes, like ``{"H": 240, "W": 320}``.

    Raises:
        InputError: If it is not a plain numeric array of the expected type, shape and content.
    """
    array = _read_mat(path, field) if path.suffix == ".mat" else _read_npy(path, field, sizes or {})
    _check(path, field, array.shape, array.dtype, sizes or {})
    finite = np.isfinite(array) if field.nan == "error" else ~np.isinf(array)
    if not finite.all():
        bad, fix = np.argwhere(~finite), "correct the numbers"
        expected = "finite numbers" if field.nan == "error" else "numbers, or NaN for unknown"
        why = f"expected {expected}, found {array[tuple(bad[0])]} first at index "
        why += f"{bad[0].tolist()} of shape {array.shape}"
        if field.role == "measurement" and field.nan == "error":
            fix = "export the file again; a frame that was not measured is an absent file, not NaN"
        what = f"{len(bad)} values of {field.name} are not finite"
        raise InputError(what, where=path, why=why, fix=fix)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def read_stored(root: Path, field: Field) -> tuple[np.ndarray, str] | None:
    """Array of a field from the first of its files that exist, and the relative name, or None.

    Raises:
        InputError: If a file is not valid, or files of one field disagree.
    """
    arrays = {
        path: read_array(root / path, field) for path in field.paths if (root / path).exists()
    }
    if not arrays:
        return None
    path, first = next(iter(arrays.items()))
    if any(not np.array_equal(_compared(array), _compared(first)) for array in arrays.values()):
        texts = ", ".join(f"{array.tolist()} in {name}" for name, array in arrays.items())
        why = f"expected the same value in all of its files, found {texts}"
        raise _invalid(root / path, field, "files disagree", why, "remove the wrong file")
    return first, path


def map_array(path: Path) -> np.ndarray:
    """The array of a .npy file of any type and shape, not read yet.

    Raises:
        InputError: If it is no whole .npy file of plain numbers.
    """
    try:
        if not path.is_file():  # opening a pipe would block
            raise ValueError("no file")
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # the header is a Python literal: a damaged one raises anything
        why = f"expected an array as numpy.save writes it, found {error}"
        raise unreadable(path, why) from error
    expected, size = array.offset + array.nbytes, path.stat().st_size
    if size != expected:
        raise unreadable(path, f"expected {expected} bytes, found {size}")
    return array


def _compared(array: np.ndarray) -> np.ndarray:
    """The 3x3 part of a matrix; a number as one element, also MATLAB's 1x1."""
    return array[:3, :3] if array.ndim == 2 and array.size > 1 else array.reshape(-1)


def read_shape(path: Path, field: Field) -> tuple[int, ...]:
    """Shape in the header of a .npy file, checked as by :func:`read_array`; no data are read.

    Raises:
        InputError: If the array does not have the expected type and number of axes.
    """
    with _open(path, field) as file:
        shape, _, dtype = _header(path, field, file)
    _check(path, field, shape, dtype, {})
    return shape


def as_float32(path: Path, field: Field, array: np.ndarray) -> tuple[np.ndarray, bool]:
    """Convert a checked array to float32; returns it, and whether digits were lost.

    Raises:
        InputError: If a number is beyond the range of float32.
    """
    with np.errstate(over="ignore"):
        converted = np.ascontiguousarray(array, dtype=np.float32)
    if np.isinf(converted).any():
        why = f"expected numbers below 3.4e38, found {np.nanmax(np.abs(array)):.3g}"
        raise _invalid(path, field, "beyond float32", why, "divide the recording by one factor")
    if array.dtype.itemsize <= 2 or array.dtype == np.float32:
        return converted, False
    with np.errstate(invalid="ignore"):
        wide = converted.astype(np.float64), array.astype(np.float64)
    return converted, not np.array_equal(*wide, equal_nan=True)


def read_choice(path: Path, field: Field) -> str:
    """Read a .json file that holds one key with one of a few values.

    Raises:
        InputError: If it is anything else.
    """
    choices = " or ".join(map(json.dumps, field.choices))
    expected = f"expected {{{json.dumps(field.key)}: {choices}}}"
    text, fix = _small_file(path, field), "correct or remove the file"
    try:
        content = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise _invalid(path, field, "not JSON", f"{expected}, found {error}", fix) from error
    if content not in [{field.key: choice} for choice in field.choices]:
        why = f"{expected}, found {text[:200].decode('utf-8', 'replace')!r}"
        raise InputError(f"unknown {field.name}", where=path, why=why, fix=fix)
    return content[field.key]


def _invalid(path: Path, field: Field, what: str, why: str, fix: str) -> InputError:
    return InputError(f"{field.name}: {what}", where=path, why=why, fix=fix)


def _read_npy(path: Path, field: Field, sizes: Mapping[str, int]) -> np.ndarray:
    with _open(path, field) as file:
        shape, fortran, dtype = _header(path, field, file)
        _check(path, field, shape, dtype, sizes)
        size = path.stat().st_size - file.tell()
        expected = math.prod(shape) * dtype.itemsize
        if size != expected:
            what = f"file is {'truncated' if size < expected else 'longer than its array'}"
            why = f"expected {expected} bytes of data for shape {shape} of {dtype}, found {size}"
            raise _invalid(path, field, what, why, "copy or export the file again")
        data = np.frombuffer(file.read(expected), dtype=dtype, count=math.prod(shape))
    return data.reshape(shape, order="F" if fortran else "C")


def _header(path: Path, field: Field, file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type in the header of a .npy file; only types without Python objects."""
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy writes no header that it warns about
            version = np.lib.format.read_magic(file)
            if version not in readers:
                raise ValueError(f"format version {version}")
            shape, fortran, dtype = readers[version](file)
    except Exception as error:
        # the header is a Python literal: a damaged one raises nearly any exception
        why = f"expected an array as numpy.save writes it, found {_excerpt(path)} ({error})"
        fix = "export the array again with numpy.save"
        raise _invalid(path, field, "not a .npy array", why, fix) from error
    if dtype.hasobject:
        why = f"expected plain numbers, found dtype {dtype}; loading it could execute code, so "
        why += "it was not loaded"
        fix = "save numbers: numpy.save(path, array.astype(numpy.float32), allow_pickle=False)"
        raise _invalid(path, field, "pickled Python objects", why, fix)
    return tuple(int(n) for n in shape), fortran, dtype


def _read_mat(path: Path, field: Field) -> np.ndarray:
    data = _small_file(path, field)
    assert field.mat_key is not None
    try:
        return read_matrix(data, field.mat_key)
    except ValueError as error:
        why = f"expected a MATLAB 5 file with a real matrix {field.mat_key!r}, found "
        why += f"{_excerpt(path)} ({error})"
        fix = f"save the matrix under the name {field.mat_key!r} with save -v7, or as .npy"
        raise _invalid(path, field, "no MATLAB matrix", why, fix) from error


def _check(
    path: Path, field: Field, shape: tuple[int, ...], dtype: np.dtype, sizes: Mapping[str, int]
) -> None:
    """Check type and shape against the field, and bounds of letters without a known value."""
    if dtype.kind not in field.dtypes:
        why = f"expected {' or '.join(KINDS[kind] for kind in field.dtypes)}, found {dtype}"
        raise _invalid(path, field, "wrong type", why, "export numbers")
    if any(_matches(shape, allowed, sizes) for allowed in field.shapes):
        return
    expected = " or ".join(_shape_text(allowed, sizes) for allowed in field.shapes)
    fix = "export the array in that shape; all images of one kind have one size"
    raise _invalid(path, field, "wrong shape", f"expected {expected}, found {shape}", fix)


def _matches(
    shape: tuple[int, ...], allowed: tuple[int | str, ...], sizes: Mapping[str, int]
) -> bool:
    if not allowed:
        return math.prod(shape) == 1 and len(shape) <= 2  # MATLAB writes a number as 1x1
    if len(shape) != len(allowed):
        return False
    for n, letter in zip(shape, allowed, strict=True):
        size = letter if isinstance(letter, int) else sizes.get(letter)
        if not (1 <= n <= LIMITS[str(letter)] if size is None else n == size):
            return False
    return True


def _shape_text(allowed: tuple[int | str, ...], sizes: Mapping[str, int]) -> str:
    if not allowed:
        return "one number"
    return "(" + ", ".join(str(sizes.get(n, n) if isinstance(n, str) else n) for n in allowed) + ")"


def _open(path: Path, field: Field) -> Any:
    if not path.is_file():  # opening a pipe would block
        kind = "a folder" if path.is_dir() else "nothing that can be read"
        why = f"expected a file, found {kind}"
        raise _invalid(path, field, "no such file", why, "complete the folder")
    try:
        return path.open("rb")
    except OSError as error:
        fix = "check permissions and the disk"
        raise _invalid(path, field, "cannot be read", str(error), fix) from error


def _small_file(path: Path, field: Field) -> bytes:
    with _open(path, field) as file:
        data = file.read(SMALL_FILE_BYTES + 1)
    if len(data) > SMALL_FILE_BYTES:
        why = f"expected at most {SMALL_FILE_BYTES} bytes, found {path.stat().st_size}"
        raise _invalid(path, field, "file too large", why, "keep only the documented value in it")
    return data


def _excerpt(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(24)
    return f"a file that starts with {start!r}" if start else "an empty file"
