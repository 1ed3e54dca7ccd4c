"""Collecting input errors of a folder, so that one pass reports all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from ..errors import InputError

SHOWN = 20  # a broken export has the same error in every file
P = ParamSpec("P")
T = TypeVar("T")


class Problems:
    """A list of input errors that is raised at the end, as one."""

    def __init__(self) -> None:
        self.errors: list[InputError] = []

    def attempt(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """Call a function; collects an input error and returns None."""
        try:
            return function(*args, **kwargs)
        except InputError as error:
            self.errors.append(error)
            return None

    def add(self, what: str, where: object, why: str, fix: str) -> None:
        """Add an input error."""
        self.errors.append(InputError(what, where=where, why=why, fix=fix))

    def raise_if_any(self, where: object) -> None:
        """Raise the only InputError as it is, or several as one of ``where`` that lists them."""
        if not self.errors:
            return
        if len(self.errors) == 1:
            raise self.errors[0]
        lines = [f"{error.where}: {error.what}: {error.why}" for error in self.errors[:SHOWN]]
        if len(self.errors) > SHOWN:
            lines.append(f"and {len(self.errors) - SHOWN} more")
        why, fixes = "\n       ".join(lines), dict.fromkeys(error.fix for error in self.errors)
        what, fix = f"{len(self.errors)} problems", "\n       ".join(fixes)
        raise InputError(what, where=where, why=why, fix=fix)
