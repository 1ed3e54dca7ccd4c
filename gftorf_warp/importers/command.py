"""``gftorf import``: a foreign recording as a capture, with every decision stated."""

from __future__ import annotations

import difflib
import logging
from pathlib import Path

from ..data.files import atomic_write, refuse_target
from ..data.sequence import Sequence
from ..data.write import write
from ..data.writing import refuse_inexpressible
from ..errors import InputError, UsageError
from .imported import Imported
from .keys import load, template
from .kinds import KINDS, Kind

LOG = logging.getLogger("gftorf_warp")


def kind_of(name: str) -> Kind:
    """The kind of this name.

    Raises:
        UsageError: If there is none.
    """
    if name not in KINDS:
        close = difflib.get_close_matches(name, KINDS, n=1)
        fix = f"did you mean {close[0]}?" if close else "gftorf import --list"
        why = f"there are {', '.join(KINDS)}"
        raise UsageError(f"unknown kind {name}", where="gftorf import", why=why, fix=fix)
    return KINDS[name]


def template_of(name: str, out: str | Path | None = None) -> str:
    """The commented TOML file of a kind; with ``out`` it is written there, and its path returned.

    Raises:
        UsageError: If there is no such kind, or a file of that name exists.
    """
    kind = kind_of(name)
    text = template(f"gftorf import {name}: {kind.about}", kind.keys)
    if out is None:
        return text
    if Path(out).exists():
        why, fix = "a file of that name exists", "choose another name"
        raise UsageError("not overwritten", where=out, why=why, fix=fix)
    atomic_write(out, text.encode())
    return str(out)


def read_recording(name: str, source: str | Path, config: str | Path | None = None) -> Imported:
    """A foreign recording in memory.

    Args:
        name: Its kind.
        source: File or folder.
        config: TOML file with what the recording does not say.

    Raises:
        UsageError: If there is no such kind, or a file of keys is needed.
        InputError: If the source or the file of keys is not what it should be.
    """
    kind, source = kind_of(name), Path(source)
    settings = load(None if config is None else Path(config), kind.keys)
    if not source.exists():
        why, fix = "expected a file or folder, found nothing", "check the path"
        raise InputError("no such source", where=source, why=why, fix=fix)
    return kind.read(source, settings)


def import_recording(
    name: str,
    source: str | Path,
    out: str | Path | None,
    config: str | Path | None = None,
) -> list[str]:
    """Read a foreign recording and write it as a capture; without ``out`` write nothing.

    Returns:
        Lines for people: what was understood, and the folder. What is uncertain is logged as
        warnings.

    Raises:
        UsageError, InputError: As :func:`read_recording`, or if the folder is not empty.
        ResourceError: If the disk is full.
    """
    if out is not None:
        refuse_target(Path(out))  # before minutes of reading
    imported = read_recording(name, source, config)
    refuse_inexpressible("capture", imported.sequence, imported.truth)  # a dry run says so, too
    lines = [_summary(imported.sequence), *imported.understood]
    for text in imported.uncertain:
        LOG.warning("uncertain: %s", text)
    if out is None:
        return lines
    readme = _readme(f"gftorf import {name}", lines, imported.uncertain)
    write("capture", out, imported.sequence, imported.truth, readme=readme)
    return [*lines, str(out)]


def _summary(sequence: Sequence) -> str:
    size = f"{sequence.width}x{sequence.height}"
    frequencies = ", ".join(f"{f / 1e6:.6g} MHz" for f in sequence.frequencies)
    measured = int(sequence.measured.sum())
    cycles = f"cycles of {sequence.cycle} at {frequencies}"
    frames = f"{measured} of {sequence.frames} raw frames of {size}"
    return f"{frames} over {sequence.times[-1]:.4g} s, {cycles}"


def _readme(command: str, understood: list[str], uncertain: tuple[str, ...]) -> str:
    """README.md of the capture."""
    lines = [f"# Imported by `{command}`", "", *(f"* {line}" for line in understood)]
    lines += ["", "## Uncertain", "", *(f"* {line}" for line in uncertain)] if uncertain else []
    return "\n".join(lines) + "\n"
