"""Errors that a user can fix: what is wrong, where, why, and a fix; a class for each exit code."""


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
    """Options that are invalid or contradict each other."""

    exit_code = 2


class InputError(GftorfError):
    """A file or folder is missing, damaged, or not of the expected kind."""

    exit_code = 3


class DivergedError(GftorfError):
    """A loss or a rendering is not finite; the last good checkpoint is kept."""

    exit_code = 4


class ResourceError(GftorfError):
    """Not enough disk, memory or GPU."""

    exit_code = 5


class BusyError(GftorfError):
    """Another process works on the same run."""

    exit_code = 6


class Terminated(KeyboardInterrupt):
    """SIGTERM reached the process: as after Ctrl-C, but with another exit code."""


def _rebuild(kind: type[GftorfError], what: str, where: str, why: str, fix: str) -> GftorfError:
    return kind(what, where=where, why=why, fix=fix)
