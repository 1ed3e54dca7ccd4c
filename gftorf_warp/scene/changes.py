"""Changes of single settings by name: ``init.reflectivity=0.5``, ``bodies.1.path.velocity=3,0,0``.

They apply to frozen dataclasses: dots select fields of nested ones, numbers select members of
tuples.
"""

from __future__ import annotations

import enum
import math
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, Union

from ..errors import UsageError
from ..similar import did_you_mean

Settings = TypeVar("Settings")


@dataclass(frozen=True, kw_only=True)
class Wording:
    """Texts of error messages, and which settings are special."""

    option: str
    """The command-line option."""
    example: str
    """A valid change."""
    where: str
    """Where all settings are listed, named if no similar one exists."""
    fixed: tuple[str, ...] = ()
    """Settings with options of their own, and those that cannot be changed."""
    named: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By name of a setting: its named values."""


def changed(settings: Settings, changes: Iterable[str], wording: Wording) -> Settings:
    """Settings with some values replaced, in the order given.

    Args:
        settings: A frozen dataclass.
        changes: Texts ``name=value``; dots join the parts of a name, commas the values of a tuple,
            None is ``none``.
        wording: Texts of error messages.

    Raises:
        UsageError: If a text has no value, a name is unknown, or a value is not of the kind of the
            setting.
    """
    for text in changes:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not value:
            fix = f"for example {wording.option} {wording.example}"
            raise _refused(text, "expected NAME=VALUE", fix, wording)
        settings = _with(settings, name.split("."), value, name, wording)
    return settings


def _with(settings: Any, path: list[str], value: str, name: str, wording: Wording) -> Any:
    head, *rest = path
    members = _members(settings)
    many = isinstance(settings, tuple)
    kinds = dict.fromkeys(members) if many else typing.get_type_hints(type(settings))
    if head not in members or (head in wording.fixed and not rest):
        before = name.removesuffix(".".join(path))
        known = sorted(before + other for other in set(names(settings)) - set(wording.fixed))
        fix = did_you_mean(name, known, f"see {wording.where}")
        raise _refused(name, "there is no such setting", fix, wording)
    present = members[head]
    if name in wording.named and not rest:
        whole = wording.named[name]
        if value in whole:
            return replace(settings, **{head: whole[value]})
        single = f"take one of {', '.join(whole)}, or name a single setting of it"
        fix = did_you_mean(value, whole, single)
        raise _refused(f"{name}={value}", f"there is no {head} of that name", fix, wording)
    if _has_parts(present) == (not rest):
        inner = ", ".join(names(present)) if _has_parts(present) else "nothing"
        raise _refused(name, f"{head} holds {inner}", "name a single setting", wording)
    if rest:
        new = _with(present, rest, value, name, wording)
    else:
        new = _parsed(value, kinds[head], name, wording)
    if many:
        return tuple(new if key == head else part for key, part in members.items())
    try:
        return replace(settings, **{head: new})
    except ValueError as error:
        raise _refused(f"{name}={value}", str(error), "choose another value", wording) from error


def require(
    settings: Any,
    *names: str,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> None:
    """Check fields of a dataclass: finite numbers, or tuples of such, within bounds, or None.

    Raises:
        ValueError: If not, which names the field, the bounds and the value.
    """
    bounds = {"above": above, "at least": at_least, "at most": at_most}
    wanted = " and ".join(f"{k} {bound:.9g}" for k, bound in bounds.items() if bound is not None)
    for name in names:
        value = getattr(settings, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is None or (
                math.isfinite(number)
                and (above is None or number > above)
                and (at_least is None or number >= at_least)
                and (at_most is None or number <= at_most)
            ):
                continue
            raise ValueError(f"{name} must be {wanted or 'finite'}, got {value}")


def names(settings: Any, prefix: str = "") -> list[str]:
    """Names of all settings, nested ones with dots."""
    listed = []
    for name, value in _members(settings).items():
        listed += names(value, f"{prefix}{name}.") if _has_parts(value) else [f"{prefix}{name}"]
    return listed


def _members(settings: Any) -> dict[str, Any]:
    if isinstance(settings, tuple):
        return {str(i): part for i, part in enumerate(settings)}
    return {f.name: getattr(settings, f.name) for f in fields(settings)}


def _has_parts(value: Any) -> bool:
    """Whether a value has nested settings: a dataclass, or a tuple of such."""
    many = isinstance(value, tuple) and bool(value)
    return is_dataclass(value) or (many and all(map(is_dataclass, value)))


def _parsed(text: str, kind: Any, name: str, wording: Wording) -> Any:
    """A typed value as what the setting holds."""

    def refused(why: str, fix: str) -> UsageError:
        return _refused(f"{name}={text}", why, fix, wording)

    if typing.get_origin(kind) in (Union, types.UnionType):
        options = typing.get_args(kind)
        if text.lower() == "none" and type(None) in options:
            return None
        kind = next(option for option in options if option is not type(None))
    if typing.get_origin(kind) is tuple:
        parts, wanted = text.split(","), typing.get_args(kind)
        if wanted[1:] == (Ellipsis,):
            wanted = wanted[:1] * len(parts)
        if len(parts) != len(wanted):
            raise refused(f"expected {len(wanted)} values", "separate them by commas")
        pairs = zip(parts, wanted, strict=True)
        return tuple(_parsed(part.strip(), one, name, wording) for part, one in pairs)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise refused("expected true or false", "choose one")
        return text.lower() == "true"
    if is_dataclass(kind) or kind is None:
        raise refused("it has fields, which a text cannot express", "write it in Python")
    try:
        value = kind(text)
        if value != value:
            raise ValueError("not a number")
        return value
    except ValueError:
        expected = "a whole number" if kind is int else "a number"
        if isinstance(kind, enum.EnumMeta):
            expected = ", ".join(kind)
        raise refused(f"expected {expected}", "choose another value") from None


def _refused(what: str, why: str, fix: str, wording: Wording) -> UsageError:
    return UsageError(f"cannot set {what}", where=wording.option, why=why, fix=fix)
