"""Single settings changed by name, as people type them: ``init.reflectivity=0.5``."""

from __future__ import annotations

import difflib
import enum
import types
import typing
from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from typing import Any, Union

from ..errors import UsageError
from .settings import ReconSettings

FIXED = ("preset", "ablation", "method")  # have options of their own


def changed(settings: ReconSettings, changes: Iterable[str]) -> ReconSettings:
    """Settings with some values replaced, in the order given.

    Args:
        settings: What is changed.
        changes: Texts ``name=value``; dots join the parts of a name, commas the values of a tuple, None is ``none``.

    Raises:
        UsageError: If a text has no value, a name is unknown, or a value is not of the kind of the setting.
    """
    for text in changes:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not value:
            raise _refused(text, "expected NAME=VALUE", "for example --set init.reflectivity=0.5")
        settings = _with(settings, name.split("."), value, name)
    return settings


def _with(settings: Any, path: list[str], value: str, name: str) -> Any:
    head, *rest = path
    kinds = typing.get_type_hints(type(settings))
    if head not in {f.name for f in fields(settings)} or (head in FIXED and not rest):
        before = name.removesuffix(".".join(path))
        known = sorted(before + other for other in set(names(settings)) - set(FIXED))
        close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
        raise _refused(name, "there is no such setting", f"did you mean {close[0]}?" if close else "see config.json")
    present = getattr(settings, head)
    if is_dataclass(present) == (not rest):
        inner = ", ".join(names(present)) if is_dataclass(present) else "nothing"
        raise _refused(name, f"{head} holds {inner}", "name a single setting")
    new = _with(present, rest, value, name) if rest else _parsed(value, kinds[head], name)
    try:
        return replace(settings, **{head: new})
    except ValueError as error:
        raise _refused(f"{name}={value}", str(error), "choose another value") from error


def names(settings: Any, prefix: str = "") -> list[str]:
    """All settings, those of parts by dots."""
    found = []
    for f in fields(settings):
        value = getattr(settings, f.name)
        found += names(value, f"{prefix}{f.name}.") if is_dataclass(value) else [prefix + f.name]
    return found


def _parsed(text: str, kind: Any, name: str) -> Any:
    """A typed value as what the setting holds."""
    if typing.get_origin(kind) in (Union, types.UnionType):
        options = typing.get_args(kind)
        if text.lower() == "none" and type(None) in options:
            return None
        kind = next(option for option in options if option is not type(None))
    if typing.get_origin(kind) is tuple:
        parts, kinds = text.split(","), typing.get_args(kind)
        if len(parts) != len(kinds):
            raise _refused(f"{name}={text}", f"expected {len(kinds)} values", "separate them by commas")
        return tuple(_parsed(part.strip(), one, name) for part, one in zip(parts, kinds, strict=True))
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise _refused(f"{name}={text}", "expected true or false", "choose one")
        return text.lower() == "true"
    try:
        value = kind(text)
        if value != value:
            raise ValueError("not a number")
        return value
    except ValueError:
        wanted = ", ".join(kind) if isinstance(kind, enum.EnumMeta) else {"int": "a whole number"}.get(kind.__name__)
        raise _refused(f"{name}={text}", f"expected {wanted or 'a number'}", "choose another value") from None


def _refused(what: str, why: str, fix: str) -> UsageError:
    return UsageError(f"cannot set {what}", where="--set", why=why, fix=fix)
