"""Keys of the TOML file that says what a recording does not say itself.

A kind of import lists its keys once; the file is checked against them, what is missing is asked for
by name, and a commented template is written from them.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..data.texts import read_toml
from ..errors import InputError, UsageError
from ..similar import did_you_mean, similar

CONFIG = "--config"
WORDS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}


@dataclass(frozen=True, kw_only=True)
class Key:
    """One key of the file."""

    name: str
    """Its name, with the table before a dot: ``sensor.f_mod_hz``."""
    kind: type
    """float, int, str or bool: what the value, or each number of a list, is."""
    about: str
    """What it means, with unit, in a line."""
    example: Any
    """A value as in the file, shown where there is no default."""
    default: Any = None
    """Value where the file has none; None: not given."""
    needed: bool = False
    """Whether it is required, since no default is right."""
    unless: tuple[str, ...] = ()
    """Keys that replace a needed one."""
    shape: tuple[int | None, ...] = ()
    """Lengths of nested lists, None is any, and 0 only if the default is empty; of ``(None,)`` a
    single value may be written without brackets. Lists become tuples."""
    choices: tuple[Any, ...] = ()
    """Allowed values; empty: any."""
    least: float | None = None
    """Smallest allowed number; None: any."""
    above: float | None = None
    """Numbers must be above this; None: any."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Values of the keys of one import: ``settings["sensor.f_mod_hz"]``."""

    keys: Mapping[str, Key]
    """All keys of the kind, by name."""
    values: Mapping[str, Any]
    """Values that the file gives, by name of the key."""
    path: Path | None = None
    """The file; None if there is none."""

    def __getitem__(self, name: str) -> Any:
        """The value that the file gives, or the default.

        Raises:
            UsageError, InputError: If it is needed and missing; names all missing keys.
        """
        if self.keys[name].needed and name not in self.values:
            self.require()
        return self.values.get(name, self.keys[name].default)

    def given(self, name: str) -> bool:
        """Whether the file has this key."""
        return name in self.values

    def source(self, name: str) -> str:
        """Where the value of a key is from, in words."""
        return f"{name} of {self.path.name}" if name in self.values and self.path else "default"

    def require(self, *names: str) -> None:
        """Check that all needed keys are given, and these besides, whether needed or not.

        Raises:
            UsageError: If some are missing and there is no file; names all of them.
            InputError: If some are missing in the file.
        """
        needed = [key.name for key in self.keys.values() if key.needed]
        missing = [
            self.keys[name]
            for name in dict.fromkeys([*needed, *names])
            if not any(given in self.values for given in (name, *self.keys[name].unless))
        ]
        if not missing:
            return
        lines = [f"{key.name}: {key.about}{_instead(key)}" for key in missing]
        what = f"{len(missing)} keys are missing" if len(missing) > 1 else "a key is missing"
        why = "the recording does not say\n       " + "\n       ".join(lines)
        if self.path is None:
            fix = "write them to a TOML file (`gftorf import KIND --template`) and add "
            raise UsageError(what, where=CONFIG, why=why, fix=f"{fix}{CONFIG} FILE.toml")
        raise InputError(what, where=self.path, why=why, fix="add them")

    def refuse_without(self, name: str) -> None:
        """Check that no key of the table of ``name`` is given without it; those with a default
        may be.

        Raises:
            InputError: If one is, since it would do nothing.
        """
        table = name.rpartition(".")[0]
        of_table = [key for key in self.values if key.startswith(f"{table}.")]
        alone = [key for key in of_table if self.keys[key].default is None]
        if alone and not self.given(name):
            why = f"{', '.join(alone)} mean nothing without {name}: {self.keys[name].about}"
            raise InputError(
                "a key is missing", where=self.path, why=why, fix="add it, or remove these"
            )

    def wrong(self, name: str, why: str, fix: str) -> InputError:
        """The error for a key whose value does not fit."""
        return InputError(f"{name}: not usable", where=self.path or CONFIG, why=why, fix=fix)

    def file(self, name: str, root: Path | None) -> Path | None:
        """The file that a key names, relative to the TOML file or the recording ``root``; None: not
        given.

        Raises:
            InputError: If it is in neither folder, or no file.
        """
        if not self[name]:
            return None
        folders = [root if root.is_dir() else root.parent] if root else []
        folders += [self.path.parent] if self.path else []
        for folder in folders:
            path = folder / self[name]
            inside = path.resolve().is_relative_to(folder.resolve())
            if inside and path.is_file():
                return path
        places = " or ".join(dict.fromkeys(str(folder) for folder in folders))
        why = f"expected a file in {places}, found none named {self[name]!r}"
        raise self.wrong(name, why, "name a file in one of these folders")


def load(path: Path | None, keys: Iterable[Key]) -> Settings:
    """The values of a TOML file, checked against the keys; without a file none.

    Raises:
        InputError: If it cannot be read, has an unknown key, or a value of another kind.
    """
    known = {key.name: key for key in keys}
    if path is None:
        return Settings(keys=known, values={})
    flat = dict(_flattened(read_toml(path), known))
    for name in flat:
        if name not in known:
            raise _unknown(path, name, list(known))
    values = {name: _value(path, known[name], value) for name, value in flat.items()}
    return Settings(keys=known, values=values, path=path)


def template(title: str, keys: Iterable[Key]) -> str:
    """A TOML file of all keys in comments, with their defaults, or else examples. Defaults are not
    set: where a key is not given, a file that it is about may state the value.
    """
    lines = [
        f"# {title}",
        "# Remove '# ' before a key to give its value; others have their defaults.",
    ]
    table = ""
    for key in sorted(keys, key=lambda key: "." in key.name):
        head, _, name = key.name.rpartition(".")
        if head != table:
            lines += ["", f"[{head}]"]
            table = head
        allowed = f"; {', '.join(map(str, key.choices))}" if key.choices else ""
        text = f"{'needed: ' if key.needed else ''}{key.about}{allowed}{_instead(key)}"
        text += "" if key.default is None else " [default:]"
        lines += textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="#   ")
        value = key.example if key.default is None else key.default
        lines.append(f"# {name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _instead(key: Key) -> str:
    return f" (or {', or '.join(key.unless)})" if key.unless else ""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    # quotes of TOML that take backslashes of paths as they are
    return f"'{value}'" if isinstance(value, str) else repr(value)


def _flattened(
    table: Mapping[str, Any], known: Mapping[str, Key], before: str = ""
) -> Iterable[tuple[str, Any]]:
    for key, value in table.items():
        name = f"{before}{key}"
        if isinstance(value, dict) and any(other.startswith(f"{name}.") for other in known):
            yield from _flattened(value, known, f"{name}.")
        else:
            yield name, value


def _unknown(path: Path, name: str, known: list[str]) -> InputError:
    last = name.rpartition(".")[2]
    others = {other.rpartition(".")[2]: other for other in known}  # right key, wrong table
    close = similar(name, known) or others.get(similar(last, others) or "", "")
    fix = did_you_mean(close, known, f"there are {', '.join(known)}")
    what = f"unknown key {name}"
    return InputError(what, where=path, why="this kind of import has no such key", fix=fix)


def _value(path: Path, key: Key, value: Any) -> Any:
    """A value of the file as the key has it."""
    if key.shape == (None,) and not isinstance(value, list):
        value = [value]
    leaves: list[Any] = []
    made = _shaped(key, value, key.shape, leaves)
    bounds = [key.least is None or leaf >= key.least for leaf in leaves if made is not None]
    bounds += [key.above is None or leaf > key.above for leaf in leaves if made is not None]
    bounds += [not key.choices or leaf in key.choices for leaf in leaves]
    if made is not None and all(bounds):
        return made
    expected = WORDS[key.kind] if not key.choices else f"one of {', '.join(map(str, key.choices))}"
    expected += f" of at least {key.least:g}" if key.least is not None else ""
    expected += f" above {key.above:g}" if key.above is not None else ""
    if key.shape:
        sizes = " x ".join("any" if n is None else str(n) for n in key.shape)
        expected = f"a list ({sizes}) with {expected} each"
    why = f"expected {expected}, found {str(value)[:80]!r}; {key.about}"
    fix = f"for example {key.name.rpartition('.')[2]} = {_toml(key.example)}"
    raise InputError(f"{key.name}: not valid", where=path, why=why, fix=fix)


def _shaped(key: Key, value: Any, shape: tuple[int | None, ...], leaves: list[Any]) -> Any:
    """The value with lists as tuples; None if it is of another shape or kind."""
    if shape:
        least = 0 if key.default == () else 1
        if not isinstance(value, list) or len(value) != (shape[0] or max(least, len(value))):
            return None
        items = tuple(_shaped(key, item, shape[1:], leaves) for item in value)
        return None if None in items else items
    whole_number = key.kind is float and type(value) is int
    if type(value) is not key.kind and not whole_number:  # a bool is an int to isinstance
        return None
    try:
        value = key.kind(value)
    except OverflowError:
        return None
    if key.kind is float and not math.isfinite(value):
        return None
    leaves.append(value)
    return value
