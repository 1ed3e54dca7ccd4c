"""Reading single untrusted files: nothing in them is executed,
and sizes are checked before allocation.
"""

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

SIDE_MAX = 8192  # [px] no C-ToF image is larger; a forged header would ask for terabytes
LIMITS = {"H": SIDE_MAX, "W": SIDE_MAX, "h": SIDE_MAX, "w": SIDE_MAX} | dict.fromkeys(
    "FPM", 1_000_000
)
# .json and .mat calibration files hold a few numbers; a larger one is something else
SMALL_FILE_BYTES = 65_536
KINDS = {"f": "floating point", "i": "integer", "u": "unsigned integer"}


def read_array(path: Path, field: Field, sizes: Mapping[str, int] | None = None) -> np.ndarray:
    """Read one array file and check it against the description of its field.

    Args:
        path: A .npy or .mat file.
        field: What it has to be.
        sizes: Known values of letters in the field's shapes, for example ``{"H": 240, "W": 320}``.

    Returns:
        The array in its stored type, little endian, without infinities, and without NaN unless the
        field allows them.

    Raises:
        InputError: If it is not a plain numeric array of the expected type, shape and content.
    """
    array = _read_mat(path, field) if path.suffix == ".mat" else _read_npy(path, field, sizes or {})
    _check(path, field, array.shape, array.dtype, sizes or {})
    finite = np.isfinite(array) if field.nan == "error" else ~np.isinf(array)
    if not finite.all():
        bad = np.argwhere(~finite)
        raise InputError(
            f"{len(bad)} values of {field.name} are not finite",
            where=path,
            why="expected "
            f"{'finite numbers' if field.nan == 'error' else 'numbers, or NaN for unknown'}, found "
            f"{array[tuple(bad[0])]} first at index {[int(i) for i in bad[0]]} of shape "
            f"{array.shape}",
            fix="export the file again; a frame that was not measured is an absent file, not NaN"
            if field.role == "measurement" and field.nan == "error"
            else "correct the numbers",
        )
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def read_stored(root: Path, field: Field) -> tuple[np.ndarray, str] | None:
    """Array of a field from the first of its files that exist, and the relative name; None if there
    is none.

    Raises:
        InputError: If a file is not valid, or files of one field disagree.
    """
    found = {path: read_array(root / path, field) for path in field.paths if (root / path).exists()}
    if not found:
        return None
    path, first = next(iter(found.items()))
    if any(not np.array_equal(_compared(array), _compared(first)) for array in found.values()):
        texts = ", ".join(f"{array.tolist()} in {name}" for name, array in found.items())
        why = f"expected the same value in all of its files, found {texts}"
        raise InputError(
            f"{field.name}: files disagree", where=root / path, why=why, fix="remove the wrong file"
        )
    return first, path


def _compared(array: np.ndarray) -> np.ndarray:
    """Of a 3x3 or 4x4 matrix the part that both have; of a number, MATLAB's 1x1 or not,
    the number.
    """
    return array[:3, :3] if array.ndim == 2 and array.size > 1 else array.reshape(-1)


def read_shape(path: Path, field: Field) -> tuple[int, ...]:
    """Shape that the header of a .npy file states, checked like :func:`read_array` checks it; no
    data are read.

    Raises:
        InputError: If the file is not a plain numeric array of the expected type and number of
            axes.
    """
    with _open(path, field) as file:
        shape, _, dtype = _header(path, field, file)
    _check(path, field, shape, dtype, {})
    return shape


def as_float32(path: Path, field: Field, array: np.ndarray) -> tuple[np.ndarray, bool]:
    """Convert a checked array to float32.

    Returns:
        The converted array, and whether digits were lost.

    Raises:
        InputError: If a number is beyond the range of float32.
    """
    with np.errstate(over="ignore"):
        converted = np.ascontiguousarray(array, dtype=np.float32)
    if np.isinf(converted).any():
        raise InputError(
            f"{field.name} beyond float32",
            where=path,
            why=f"expected numbers below 3.4e38, found {np.nanmax(np.abs(array)):.3g}",
            fix="divide the recording by one factor",
        )
    if array.dtype.itemsize <= 2 or array.dtype == np.float32:
        return converted, False
    with np.errstate(invalid="ignore"):
        return converted, not np.array_equal(
            converted.astype(np.float64), array.astype(np.float64), equal_nan=True
        )


def read_choice(path: Path, field: Field) -> str:
    """Read a .json file that holds one key with one of a few values.

    Raises:
        InputError: If it is anything else.
    """
    expected = (
        f"expected {{{json.dumps(field.key)}: {' or '.join(json.dumps(c) for c in field.choices)}}}"
    )
    text = _small_file(path, field)
    try:
        content = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{field.name} is not JSON",
            where=path,
            why=f"{expected}, found {error}",
            fix="correct or remove the file",
        ) from error
    if (
        not isinstance(content, dict)
        or set(content) != {field.key}
        or content[field.key] not in field.choices
    ):
        raise InputError(
            f"unknown {field.name}",
            where=path,
            why=f"{expected}, found {text[:200].decode('utf-8', 'replace')!r}",
            fix="correct or remove the file",
        )
    return content[field.key]


def _read_npy(path: Path, field: Field, sizes: Mapping[str, int]) -> np.ndarray:
    with _open(path, field) as file:
        shape, fortran, dtype = _header(path, field, file)
        _check(path, field, shape, dtype, sizes)
        found = path.stat().st_size - file.tell()
        expected = math.prod(shape) * dtype.itemsize
        if found != expected:
            raise InputError(
                f"{field.name}: file is "
                f"{'truncated' if found < expected else 'longer than its array'}",
                where=path,
                why=f"expected {expected} bytes of data for shape {shape} of {dtype}, found "
                f"{found}",
                fix="copy or export the file again",
            )
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
        raise InputError(
            f"{field.name}: not a .npy array",
            where=path,
            why=f"expected an array as numpy.save writes it, found {_excerpt(path)} ({error})",
            fix="export the array again with numpy.save",
        ) from error
    if dtype.hasobject:
        raise InputError(
            f"{field.name}: pickled Python objects",
            where=path,
            why=f"expected plain numbers, found dtype {dtype}; loading it could execute code, so "
            f"it was not loaded",
            fix="save a numeric array: numpy.save(path, array.astype(numpy.float32), "
            "allow_pickle=False)",
        )
    return tuple(int(n) for n in shape), fortran, dtype


def _read_mat(path: Path, field: Field) -> np.ndarray:
    data = _small_file(path, field)
    assert field.mat_key is not None
    try:
        return read_matrix(data, field.mat_key)
    except ValueError as error:
        raise InputError(
            f"{field.name}: no MATLAB matrix",
            where=path,
            why=f"expected a MATLAB 5 file with a real matrix {field.mat_key!r}, found "
            f"{_excerpt(path)} ({error})",
            fix=f"save the matrix under the name {field.mat_key!r} with save -v7, or as .npy",
        ) from error


def _check(
    path: Path, field: Field, shape: tuple[int, ...], dtype: np.dtype, sizes: Mapping[str, int]
) -> None:
    """Check type and shape against the field's description,
    and bounds of letters without a known value.
    """
    if dtype.kind not in field.dtypes:
        raise InputError(
            f"{field.name}: wrong type",
            where=path,
            why=f"expected {' or '.join(KINDS[kind] for kind in field.dtypes)}, found {dtype}",
            fix="export numbers",
        )
    if any(_matches(shape, allowed, sizes) for allowed in field.shapes):
        return
    expected = " or ".join(_shape_text(allowed, sizes) for allowed in field.shapes)
    raise InputError(
        f"{field.name}: wrong shape",
        where=path,
        why=f"expected {expected}, found {shape}",
        fix="export the array in that shape; all images of one kind have one size",
    )


def _matches(
    shape: tuple[int, ...], allowed: tuple[int | str, ...], sizes: Mapping[str, int]
) -> bool:
    if not allowed:
        return math.prod(shape) == 1 and len(shape) <= 2  # MATLAB writes a number as 1x1
    if len(shape) != len(allowed):
        return False
    for n, size in zip(shape, allowed, strict=True):
        if isinstance(size, int) or size in sizes:
            if n != (size if isinstance(size, int) else sizes[size]):
                return False
        elif not 1 <= n <= LIMITS[size]:
            return False
    return True


def _shape_text(allowed: tuple[int | str, ...], sizes: Mapping[str, int]) -> str:
    if not allowed:
        return "one number"
    return "(" + ", ".join(str(sizes.get(n, n) if isinstance(n, str) else n) for n in allowed) + ")"


def _open(path: Path, field: Field) -> Any:
    if not path.is_file():  # opening a pipe would block
        raise InputError(
            f"{field.name}: no such file",
            where=path,
            why=f"expected a file, found "
            f"{'a folder' if path.is_dir() else 'nothing that can be read'}",
            fix="complete the folder",
        )
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(
            f"{field.name}: cannot be read",
            where=path,
            why=str(error),
            fix="check permissions and the disk",
        ) from error


def _small_file(path: Path, field: Field) -> bytes:
    with _open(path, field) as file:
        data = file.read(SMALL_FILE_BYTES + 1)
    if len(data) > SMALL_FILE_BYTES:
        raise InputError(
            f"{field.name}: file too large",
            where=path,
            why=f"expected at most {SMALL_FILE_BYTES} bytes, found {path.stat().st_size}",
            fix="keep only the documented value in it",
        )
    return data


def _excerpt(path: Path) -> str:
    """First bytes of a file, for a message."""
    with path.open("rb") as file:
        start = file.read(24)
    return f"a file that starts with {start!r}" if start else "an empty file"
