"""Errors that a user can fix: what is wrong, where, why, and a fix; a class for each exit code."""

import difflib
from collections.abc import Iterable

SIMILAR = 0.5  # [1] of the letters of two names; `batch` and `schedule.batch` share 0.53


class GftorfError(Exception):
    """Base of all errors that end a command without a traceback.

    Args:
        what: What is wrong, in a few words.
        where: File, field or option it concerns.
        why: What was expected and what was found.
        fix: What the user can do about it.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object, why: str, fix: str):
        self.what, self.where, self.why, self.fix = what, str(where), why, fix
        super().__init__(f"{what} - {self.where}\n  why: {why}\n  fix: {fix}")

    def __reduce__(self):
        return _rebuild, (type(self), self.what, self.where, self.why, self.fix)


class UsageError(GftorfError):
    """The options cannot be meant that way."""

    exit_code = 2


class InputError(GftorfError):
    """A file or folder is not what it has to be."""

    exit_code = 3


class DivergedError(GftorfError):
    """The optimisation left the numbers; the last good checkpoint is kept."""

    exit_code = 4


class ResourceError(GftorfError):
    """Not enough disk, memory or GPU."""

    exit_code = 5


class BusyError(GftorfError):
    """Another process works on the same run."""

    exit_code = 6


class Terminated(KeyboardInterrupt):
    """SIGTERM reached the process: as after Ctrl-C, but with another exit code."""


def similar(name: str, known: Iterable[str]) -> str | None:
    """The most similar of the ``known`` names; None if none is similar."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=SIMILAR)
    return close[0] if close else None


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """A fix for an unknown name: a question after the most similar of the ``known`` ones, or
    ``otherwise`` if none is similar.
    """
    close = similar(name, known)
    return otherwise if close is None else f"did you mean {close}?"


def _rebuild(kind: type[GftorfError], what: str, where: str, why: str, fix: str) -> GftorfError:
    return kind(what, where=where, why=why, fix=fix)
