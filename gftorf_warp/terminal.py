"""Terminal output: progress with the remaining time, log lines, Warp's messages, errors."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

from .errors import GftorfError, InputError, ResourceError, Terminated

LOG = logging.getLogger("gftorf_warp")
PLAIN_EVERY_S = 10.0  # [s] between two progress lines where the output is not a terminal
WORD_MAX = 240  # characters of a word in a message; a path of several folders has fewer
LIVE_EVERY_S = 0.2  # [s] between two redraws where it is
# of Warp's native code; our first line reports it
NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
# of torch, Warp, OpenCV, Python's threads, and the loader of libraries
OUT_OF_MEMORY = (
    *("can't allocate memory", "Failed to allocate", "Insufficient memory", "std::bad_alloc"),
    *("can't start new thread", "failed to map segment"),
)
# of Warp, when the machine code of a kernel is not in memory; no class identifies it
LOST_KERNEL = re.compile(r"Failed to (find (forward|backward) kernel|load CPU module)")


class Progress:
    """Progress of a loop: a line redrawn on a terminal, a plain line per ten seconds elsewhere.

    Called as ``progress(done, total, name=value, ...)``; the values are printed.
    """

    def __init__(self, label: str, *, quiet: bool = False, unit: str | None = None):
        """Start the clock; with the name of items, ``unit``, their rate is printed."""
        self.label, self.quiet, self.unit = label, quiet, unit
        self.live = sys.stderr.isatty()
        self.start = self.shown = time.monotonic()
        self.width = 0
        self.first: int | None = None

    def __call__(self, done: int, total: int, **values: object) -> None:
        """Print that ``done`` of ``total`` steps are finished."""
        now = time.monotonic()
        # a resumed loop does not start at zero; its rate excludes earlier steps
        if self.first is None:
            self.first, self.start = done, now
        every = LIVE_EVERY_S if self.live else PLAIN_EVERY_S
        if self.quiet or (now - self.shown < every and done < total):
            return
        self.shown = now
        if self.unit and done > self.first and now > self.start:
            values = {f"{self.unit}/s": (done - self.first) / (now - self.start), **values}
        line = progress_line(self.label, done, total, self.first, now - self.start, values)
        if self.live:
            end = "\n" if done >= total else ""
            print(f"\r{line:<{self.width}}", end=end, file=sys.stderr, flush=True)
            self.width = 0 if done >= total else len(line)
        else:
            print(line, file=sys.stderr, flush=True)


def progress_line(
    label: str, done: int, total: int, first: int, elapsed_s: float, values: dict[str, object]
) -> str:
    """One line of progress; the time left [s] follows from the speed since step ``first``."""
    given = {name: value for name, value in values.items() if value is not None}
    shown = [f"{name} {_digits(value)}" for name, value in given.items()]
    if done >= total:
        shown.append(f"{elapsed_s:.1f} s")
    elif done > first:
        shown.append(f"{(total - done) * elapsed_s / (done - first):.0f} s left")
    return f"  {label} {done}/{total}  " + "  ".join(shown)


def _digits(value: object) -> str:
    """A value with four digits or, of a large one, all before the point."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e15 else f"{value:.4g}"


def start_warp() -> None:
    """Initialise Warp with its messages in our log, without the one about a missing CUDA driver."""
    import warp as wp

    from .render import runtime

    wp.config.log_level = wp.LOG_WARNING
    with _native_stderr() as lines:
        runtime.start()
    wp.config.log_level = wp.LOG_INFO
    for line in lines:
        if NO_DRIVER not in line:
            LOG.warning("warp: %s", line)


def kernel_cache() -> Path:
    """Folder of Warp's compiled kernels."""
    import warp as wp

    return Path(wp.config.kernel_cache_dir)


def kernels_are_cached() -> bool:
    """Whether the cache holds kernels of this package, of any version."""
    return any(kernel_cache().glob("wp_gftorf_warp*"))


def home_as_tilde(path: Path) -> str:
    """A path with ~ for the home folder."""
    with contextlib.suppress(ValueError, RuntimeError):
        return f"~/{path.relative_to(Path.home())}"
    return str(path)


@contextlib.contextmanager
def logging_to_stderr(level: int) -> Iterator[None]:
    """Send the package's log to stderr while a command runs: plain lines, warnings marked."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Plain())
    handler.setLevel(level)  # run.log may want more than the terminal
    before = LOG.level, LOG.propagate
    LOG.addHandler(handler)
    LOG.setLevel(level)
    LOG.propagate = False
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.level, LOG.propagate = before


def as_known_error(error: BaseException) -> GftorfError | None:
    """The error as one that a user can fix; None for a bug."""
    if isinstance(error, GftorfError):
        return error
    text = str(error)
    if _is_out_of_memory(error, text):
        return ResourceError(
            "out of memory",
            where=text.splitlines()[0][:120] if text else "this process",
            why="the arrays of this command do not fit",
            fix="use a smaller --size or fewer --frames, or --device cpu if the GPU is full",
        )
    if LOST_KERNEL.match(text):
        return ResourceError(
            "a kernel cannot be loaded",
            where=text.splitlines()[0][:120],
            why="memory is short, or its file in the kernel cache is damaged",
            fix="free memory, or remove the folder of kernels that the first line of the log names",
        )
    if not isinstance(error, OSError):
        return None
    where, why = error.filename or "a file", error.strerror or text
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        fix = "free disk space, or choose another --out"
        return ResourceError("no space left", where=where, why=why, fix=fix)
    fix = "check the path and its permissions"
    return InputError("cannot read or write", where=where, why=why, fix=fix)


def _is_out_of_memory(error: BaseException, text: str) -> bool:
    """Whether an error with this text says that there is no memory: Python's, torch's, of a thread
    or a process that cannot start, or of a library that cannot be loaded.
    """
    if isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EAGAIN):
        return True
    named = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return named or any(words in text for words in OUT_OF_MEMORY)


def print_error(error: BaseException, *, debug: bool) -> int:
    """Print an error to stderr, in three lines if a user can fix it; returns the exit code."""
    if debug:
        traceback.print_exception(error)
    known = as_known_error(error)
    if known is not None:
        print(f"error: {_shortened(str(known))}", file=sys.stderr)
        return known.exit_code
    stop = _stop_behind(error)
    if stop is not None:
        how, code = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        print(f"{how}: finished work is kept; the same command resumes it", file=sys.stderr)
        return code
    summary = (str(error).splitlines() or [""])[0]
    hint = "" if debug else "; --debug shows where"
    print(f"error: unexpected {type(error).__name__}: {summary}{hint}", file=sys.stderr)
    return 1


def _stop_behind(error: BaseException) -> KeyboardInterrupt | None:
    """The signal that an error came of: a bare ``except`` of a library, as Warp has in arrays of
    structs, makes another error of it.
    """
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__context__
    return cause


def _shortened(text: str) -> str:
    """A message without the middle of words, such as paths, that fill more than a few lines."""

    def shorter(match: re.Match[str]) -> str:
        return f"{match[0][: WORD_MAX // 2]}...{match[0][-WORD_MAX // 2 :]}"

    return re.sub(rf"\S{{{WORD_MAX + 1},}}", shorter, text)


class _Plain(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        mark = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return mark + _shortened(record.getMessage())


@contextlib.contextmanager
def _native_stderr() -> Iterator[list[str]]:
    """Collect lines that native code writes to file descriptor 2."""
    lines: list[str] = []
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            written = sink.read().decode(errors="replace").splitlines()
            lines.extend(line for line in written if line.strip())
