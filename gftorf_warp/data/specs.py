"""The descriptions of formats in data_specs/ as values, which readers check and writers follow."""

from __future__ import annotations

import functools
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# an installed package carries a copy, see pyproject.toml
INSTALLED = Path(__file__).parent / "specs"
CHECKED_OUT = Path(__file__).parents[2] / "data_specs"

Size = int | str


@dataclass(frozen=True, kw_only=True)
class Field:
    """One field of a format; the comments on top of data_specs/ftorf.toml explain each entry."""

    name: str
    """Name in errors and reports."""
    paths: tuple[str, ...]
    """Relative names of its files, best first, with {slot} and {id} open."""
    kind: str
    """array, choice, json, exr or other."""
    role: str
    """measurement, calibration, truth, check or unused."""
    unit: str
    """Unit of the stored numbers."""
    meaning: str
    """Description in sentences."""
    written: str
    """Value that our writer stores."""
    required: bool
    """Whether a folder must have it."""
    fills: tuple[str, ...] = ()
    """Values of a Sequence or Truth that it becomes, by the names of ``Sequence.sources``."""
    shapes: tuple[tuple[Size, ...], ...] = ()
    """Allowed shapes, numbers or letters; () is any array of one number."""
    dtypes: str = ""
    """Allowed numpy kinds."""
    nan: str = "error"
    """error or unknown: meaning of a NaN."""
    default: float | tuple[int, ...] | None = None
    """The value where the file is missing."""
    mat_key: str | None = None
    """The one variable that is read from a .mat file."""
    key: str = ""
    """Key of a choice; path of a value in a JSON file; part of an EXR file."""
    choices: tuple[str, ...] = ()
    """Its allowed values."""
    channels: tuple[str, ...] = ()
    """Channels of a part of an EXR file."""


@functools.cache
def fields(name: str) -> dict[str, Field]:
    """Fields of a format by name, in the order of its file in data_specs/, like ``ftorf``."""
    folder = INSTALLED if INSTALLED.is_dir() else CHECKED_OUT
    content = tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
    return {
        entry["name"]: Field(**{key: _frozen(value) for key, value in entry.items()})
        for entry in content["field"]
    }


def location(name: str, field: str) -> str:
    """Where a format states a value, for messages: ``KEY in capture.json``, or the best file."""
    spec = fields(name)[field]
    return f"{spec.key} in {spec.paths[0]}" if spec.kind == "json" else spec.paths[0]


def layer_field(name: str) -> Field:
    """The field that describes a layer of the truth; ``{h}`` in its key is a harmonic.

    Raises:
        ValueError: If there is none.
    """
    for field in fields("capture").values():
        pattern = re.escape(field.key).replace(r"\{h\}", "[1-9][0-9]?")
        if "layers" in field.fills and re.fullmatch(pattern, name):
            return field
    raise ValueError(f"no layer is named {name!r}")


def _frozen(value: Any) -> Any:
    """Lists as tuples, all the way down; text without the line breaks of its file."""
    if isinstance(value, list):
        return tuple(_frozen(item) for item in value)
    return " ".join(value.split()) if isinstance(value, str) else value
