"""``capture.json``: every value is checked against data_specs/capture.toml."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import specs
from .problems import Problems
from .texts import read_json

NAME = "capture.json"
MANIFEST = "MANIFEST.sha256"
FORMAT = "capture"
FRAMES = "frames"
KINDS = {"f": (int, float), "i": (int,), "b": (bool,), "U": (str,), "O": (dict,)}
WORDS = {
    "f": "numbers",
    "i": "whole numbers",
    "b": "true or false",
    "U": "a text",
    "O": "an object",
}


def json_fields() -> dict[str, specs.Field]:
    """Fields of capture.json by name."""
    return {name: field for name, field in specs.fields(FORMAT).items() if field.kind == "json"}


def read_values(root: Path) -> dict[str, Any]:
    """Values of capture.json by field name: texts, objects and arrays; without absent fields.

    Raises:
        InputError: If it is not what data_specs/capture.toml describes; lists all problems.
    """
    path, problems = root / NAME, Problems()
    content = _load(path)
    frames = content.get(FRAMES)
    if not isinstance(frames, list) or {type(frame) for frame in frames} != {dict}:
        raise _wrong(path, FRAMES, "a list with an object for every raw frame", frames)
    version, fix = content.get("version"), "use a newer version of this program"
    if not isinstance(version, str) or version.partition(".")[0] != "1":
        raise _wrong(path, "version", "1.x, which this program reads", version, fix)
    problems.attempt(_refuse_unknown, path, content)
    for number, frame in enumerate(frames):
        problems.attempt(_refuse_unknown, path, frame, f"{FRAMES}[{number}]", f"{FRAMES}.")
    values = {}
    for name, field in json_fields().items():
        value = problems.attempt(_value, path, content, field)
        if value is not None:
            values[name] = value
    problems.raise_if_any(path)
    return values


def _load(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise _wrong(path, "the whole file", "an object", content)
    return content


def _refuse_unknown(path: Path, table: dict[str, Any], where: str = "", prefix: str = "") -> None:
    """Refuse keys that are not described: they are more often typing errors than additions."""
    known = [field.key for field in json_fields().values()]
    for key, value in table.items():
        full = f"{prefix}{key}"
        inside = [k for k in known if k.startswith(f"{full}.")]
        if key.startswith("x-") or full in known:
            continue
        if not inside:
            below = [k.removeprefix(prefix) for k in known if k.startswith(prefix)]
            expected = f"keys {', '.join(sorted({k.partition('.')[0] for k in below}))}, or x-.."
            raise _wrong(path, where or "the top", expected, key, "correct the key")
        if full != FRAMES and isinstance(value, dict):
            _refuse_unknown(path, value, full, f"{full}.")


def _value(path: Path, content: dict[str, Any], field: specs.Field) -> Any:
    """One value, checked; None if it is optional and absent."""
    if field.key.startswith(f"{FRAMES}."):
        key = field.key.removeprefix(f"{FRAMES}.")
        there = [key in frame for frame in content[FRAMES]]
        if not any(there) and not field.required:
            return None
        if not all(there):
            where = f"{FRAMES}[{there.index(False)}].{key}"
            raise _wrong(path, where, "a value for every raw frame", None)
        return _array(path, field, [frame[key] for frame in content[FRAMES]])
    value: Any = content
    for key in field.key.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    if value is None and not field.required:
        return None
    if field.choices:
        if value not in field.choices:
            raise _wrong(path, field.key, " or ".join(map(json.dumps, field.choices)), value)
        return value
    if field.dtypes in "OU":
        if not isinstance(value, KINDS[field.dtypes]):
            raise _wrong(path, field.key, WORDS[field.dtypes], value)
        return value
    return _array(path, field, value)


def _array(path: Path, field: specs.Field, value: Any) -> np.ndarray:
    """Numbers or truth values of the shape that the field has."""
    leaves, shape = _flatten(value)
    allowed = tuple(kind for letter in field.dtypes for kind in KINDS[letter])
    fits = len(shape) == len(field.shapes[0]) and all(
        isinstance(want, str) or want == got
        for want, got in zip(field.shapes[0], shape, strict=False)
    )
    # a bool is an int to isinstance
    numbers = math.prod(shape) == len(leaves) and all(type(leaf) in allowed for leaf in leaves)
    if not fits or not numbers:
        want = f"{WORDS[field.dtypes[0]]} of shape ({', '.join(map(str, field.shapes[0]))})"
        raise _wrong(path, field.key, want, value)
    kind = np.dtype({"f": "f8", "i": "i8", "b": "?"}[field.dtypes[0]])
    try:
        array: np.ndarray = np.array(leaves, dtype=kind).reshape(shape)
    except OverflowError as error:
        raise _wrong(path, field.key, "numbers of 64 bits", value) from error
    if not np.isfinite(array).all():
        raise _wrong(path, field.key, "finite numbers", value)
    return array


def _flatten(value: Any) -> tuple[list[Any], tuple[int, ...]]:
    """Leaves and shape of nested lists; the length of an uneven axis is -1."""
    if not isinstance(value, list):
        return [value], ()
    inner = [_flatten(item) for item in value]
    shapes = {shape for _, shape in inner}
    leaves = [leaf for item, _ in inner for leaf in item]
    return leaves, (len(value), *next(iter(shapes))) if len(shapes) == 1 else (len(value), -1)


def _wrong(
    path: Path, where: str, expected: str, value: Any, fix: str = "correct the file"
) -> InputError:
    text = "nothing" if value is None else json.dumps(value, default=str)
    shown = text if len(text) <= 80 else f"{text[:77]}..."
    why = f"expected {expected}, found {shown}"
    return InputError(f"{where}: not valid in a capture", where=path, why=why, fix=fix)
