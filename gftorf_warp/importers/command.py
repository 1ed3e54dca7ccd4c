"""``gftorf import``: a foreign recording as a capture, with every decision stated."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

from ..data.capture_json import MANIFEST
from ..data.files import as_errors, atomic_write, refuse_target, sweep, temporary_name
from ..data.resources import Need, to_import
from ..data.sequence import Sequence
from ..data.untrusted import read_text, refuse_archive
from ..data.write import write
from ..data.writing import refuse_inexpressible
from ..errors import InputError, UsageError
from ..similar import did_you_mean
from .imported import Imported
from .keys import load, template
from .kinds import KINDS, Kind
from .raw_files import check_resources

LOG = logging.getLogger("gftorf_warp")
README = "README.md"  # what was understood, in the capture


def kind_of(name: str) -> Kind:
    """The kind of this name.

    Raises:
        UsageError: If there is none.
    """
    if name not in KINDS:
        fix = did_you_mean(name, KINDS, "gftorf import --list")
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
    refuse_archive(source)
    return kind.read(source, settings)


def import_recording(
    name: str,
    source: str | Path,
    out: str | Path | None,
    config: str | Path | None = None,
) -> list[str]:
    """Read a foreign recording and write it as a capture; without ``out`` write nothing.

    A folder that an earlier import of this kind wrote is left as it is if this one would write the
    same bytes, so that a command that was killed after its last step can be repeated.

    Returns:
        Lines for people: what was understood, and the folder. What is uncertain is logged as
        warnings.

    Raises:
        UsageError, InputError: As :func:`read_recording`, or if the folder is not empty.
        ResourceError: If memory or disk cannot hold the recording.
    """
    again = out is not None and _is_import(Path(out), name)
    if out is not None and not again:
        refuse_target(Path(out))  # before minutes of reading
    imported = read_recording(name, source, config)
    refuse_inexpressible("capture", imported.sequence, imported.truth)  # a dry run says so, too
    if out is not None:
        pixels = imported.sequence.height * imported.sequence.width
        check_resources(Need(disk=to_import(imported.sequence.frames, pixels).disk), Path(out))
    lines = [_summary(imported.sequence), *imported.understood]
    for text in imported.uncertain:
        LOG.warning("uncertain: %s", text)
    if out is None:
        return lines
    readme = _readme(name, lines, imported.uncertain)
    given = imported.sequence, imported.truth
    if again:
        _refuse_different(Path(out), lambda path: write("capture", path, *given, readme=readme))
    else:
        write("capture", out, *given, readme=readme)
    return [*lines, str(out)]


def _is_import(out: Path, name: str) -> bool:
    """Whether a folder is what an import of this kind wrote, by the title of its README.md."""
    readme = out / README
    if not ((out / MANIFEST).is_file() and readme.is_file()):
        return False
    return read_text(readme).partition("\n")[0] == _title(name)


def _refuse_different(out: Path, write: Callable[[Path], Path]) -> None:
    """Raise a UsageError unless a folder holds what ``write`` would write.

    It is written again beside it, and the sums of all files are compared.
    """
    sweep(out)  # of a process that was killed here
    temporary = temporary_name(out.absolute())
    try:
        with as_errors(temporary):
            temporary.mkdir()
        copy = write(temporary / "capture")
        same = all(read_text(out / n) == read_text(copy / n) for n in (MANIFEST, README))
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    if not same:
        why, fix = "it holds another import", "choose another path, or remove the folder first"
        raise UsageError("folder is not empty", where=out, why=why, fix=fix)


def _summary(sequence: Sequence) -> str:
    size = f"{sequence.width}x{sequence.height}"
    frequencies = ", ".join(f"{f / 1e6:.6g} MHz" for f in sequence.frequencies)
    measured = int(sequence.measured.sum())
    cycles = f"cycles of {sequence.cycle} at {frequencies}"
    frames = f"{measured} of {sequence.frames} raw frames of {size}"
    return f"{frames} over {sequence.times[-1]:.4g} s, {cycles}"


def _title(name: str) -> str:
    """First line of README.md."""
    return f"# Imported by `gftorf import {name}`"


def _readme(name: str, understood: list[str], uncertain: tuple[str, ...]) -> str:
    """README.md of the capture."""
    lines = [_title(name), "", *(f"* {line}" for line in understood)]
    lines += ["", "## Uncertain", "", *(f"* {line}" for line in uncertain)] if uncertain else []
    return "\n".join(lines) + "\n"
