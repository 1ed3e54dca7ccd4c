"""Scenes as TOML files: the fields of :class:`gftorf_warp.sim.scene.Scene`, as tables.

A table holds the fields of a dataclass; others have their defaults. `kind` selects a class: a shape
is "box", "plane", "sphere", "level", "assembly" or "mesh", a path "still", "line", "arc", "guided",
"viewpoint" or "sweep". A sensor may be a name of sim/sensors.py, or a table with that name as
`preset`. Paths of files are relative to the scene file. See examples/scene.toml.
"""

from __future__ import annotations

import math
import types
import typing
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path as FilePath
from typing import Any, Union

from ..data.texts import read_toml
from ..errors import InputError
from ..scene.sensor import Sensor
from ..similar import did_you_mean
from .assembly import Assembly, Level
from .checks import UNLIMITED
from .curves import Guided
from .meshes import Mesh
from .paths import Arc, Line, Path, Still, Sweep, Viewpoint
from .scene import Scene
from .sensors import SENSORS
from .world import Box, Plane, Shape, Sphere

PATHS = (Still, Line, Arc, Guided, Viewpoint, Sweep)
KINDS: dict[type, dict[str, type]] = {
    base: {kind.__name__.lower(): kind for kind in kinds}
    for base, kinds in ((Shape, (Box, Plane, Sphere, Level, Assembly, Mesh)), (Path, PATHS))
}
NOT_THERE = ("closed_form", "overrides")  # fields of a scene that are no settings
SIZES = {"frames": 48, "width": 160, "height": 120}  # defaults


def read_scene(path: str | FilePath) -> Scene:
    """The scene that a TOML file describes.

    Raises:
        InputError: If the file cannot be read, it is no TOML, or a table does not match its
            dataclass.
    """
    path = FilePath(path)
    table = read_toml(path)
    described = f"scene of {path.name}"
    texts = {"name": path.stem, "description": described, "motion": "as its file says"}
    for key in NOT_THERE:
        if key in table:
            raise _wrong(path, key, "it is no setting", "leave it out")
    scene = _made(Scene, {**SIZES, **texts, **table}, path, "")
    try:
        scene.camera()
    except ValueError as error:
        raise _wrong(path, "camera_path", str(error), "choose another view") from error
    return scene


def _made(kind: type, table: Any, path: FilePath, where: str) -> Any:
    """A dataclass of ``kind``, or of the kind that the table names."""
    if not isinstance(table, dict):
        raise _wrong(path, where, f"expected a table, found {table!r}", "write { ... } or [...]")
    table = dict(table)
    preset = None
    if kind is Sensor and "preset" in table:
        preset = _preset(table.pop("preset"), path, where)
    if kind in KINDS:
        kinds, named = KINDS[kind], table.pop("kind", None)
        if not isinstance(named, str) or named not in kinds:
            why = f"expected one of {', '.join(kinds)}, found {named!r}"
            raise _wrong(path, _join(where, "kind"), why, "name one")
        kind = kinds[named]
    known = {f.name: f for f in fields(kind)}
    hints = typing.get_type_hints(kind)
    for key in table:
        if key not in known:
            fix = did_you_mean(key, known, f"there are {', '.join(known)}")
            raise _wrong(path, _join(where, key), f"a {kind.__name__} has no such setting", fix)
    for name, f in known.items():
        if name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise _wrong(path, _join(where, name), f"a {kind.__name__} needs it", "add it")
    given = table.items()
    values = {key: _value(hints[key], value, path, _join(where, key)) for key, value in given}
    try:
        return kind(**values) if preset is None else replace(preset, **values)
    except ValueError as error:
        raise _wrong(path, where or "scene", str(error), "choose another value") from error


def _value(kind: Any, value: Any, path: FilePath, where: str) -> Any:
    """A TOML value as the value of a field of a dataclass."""
    if typing.get_origin(kind) in (Union, types.UnionType):
        options = [option for option in typing.get_args(kind) if option is not type(None)]
        table = isinstance(value, dict)
        kind = next((option for option in options if _is_table(option) == table), options[0])
    if kind is Sensor and isinstance(value, str):
        return _preset(value, path, where)
    if _is_table(kind):
        return _made(kind, value, path, where)
    if typing.get_origin(kind) is tuple:
        wanted = typing.get_args(kind)
        if not isinstance(value, list):
            raise _wrong(path, where, f"expected a list, found {value!r}", "write [ ... ]")
        if wanted[1:] == (Ellipsis,):
            wanted = wanted[:1] * len(value)
        if len(value) != len(wanted):
            why = f"expected {len(wanted)} values, found {len(value)}"
            raise _wrong(path, where, why, "correct the list")
        pairs = enumerate(zip(wanted, value, strict=True))
        return tuple(_value(one, item, path, f"{where}[{i}]") for i, (one, item) in pairs)
    if kind is FilePath and type(value) is str:
        return path.parent / value
    unlimited = where == UNLIMITED and value == math.inf
    if kind is float and type(value) in (int, float) and (math.isfinite(value) or unlimited):
        return float(value)
    if kind is not float and type(value) is kind:  # a bool is an int to isinstance
        return value
    names = {float: "a finite number", int: "a whole number", bool: "true or false"}
    names |= {str: "a text", FilePath: "a path"}
    why = f"expected {names.get(kind, kind)}, found {value!r}"
    raise _wrong(path, where, why, "correct the value")


def _preset(name: Any, path: FilePath, where: str) -> Sensor:
    """A sensor by name."""
    if not isinstance(name, str) or name not in SENSORS:
        raise _wrong(path, where, f"there is no sensor {name!r}", f"there are {', '.join(SENSORS)}")
    return SENSORS[name]


def _is_table(kind: Any) -> bool:
    return kind in KINDS or is_dataclass(kind)


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _wrong(path: FilePath, where: str, why: str, fix: str) -> InputError:
    return InputError("not a scene", where=f"{path}, {where}", why=why, fix=fix)
