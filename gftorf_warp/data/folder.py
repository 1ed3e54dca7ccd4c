"""Sequence folders: their format, numbered files and images."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..constants import FRAMES_PER_QUARTET
from ..errors import InputError
from . import resources, specs
from .arrays import as_float32, read_array, read_shape
from .capture_json import NAME as CAPTURE
from .problems import Problems
from .untrusted import FRAMES_MAX, refuse_archive

SLOT_FOLDERS = tuple(f"tofType{slot}" for slot in range(FRAMES_PER_QUARTET))
PHASOR_FOLDER = "tof"
EXPECTED = (
    "expected a folder with capture.json (a capture), tofType0 .. tofType3 and cams (F-ToeRF: "
    "raw quads), or tof and cams (ToeRF: phasors)"
)
UNFINISHED = "unfinished.md"  # exists in the folder of an incomplete recording


def format_of(path: Path) -> str:
    """Format of a sequence folder: ``capture`` with its own description, ``ftorf`` with raw quads,
    else ``torf``.

    Folders with raw quads may hold phasors too, so quads are looked for first; captures have a
    folder tof as well.

    Raises:
        InputError: If it is neither; points to a sequence one level up or down, if there is one.
    """

    def error(what: str, actual: str, fix: str = "check the path") -> InputError:
        return InputError(what, where=path, why=f"{EXPECTED}, found {actual}", fix=fix)

    if not path.exists():
        raise error("no such folder", "nothing")
    if not path.is_dir():
        refuse_archive(path)
        raise error("not a folder", "a file")
    form = format_or_none(path)
    if form is not None:
        return form
    if (path / UNFINISHED).is_file():
        files = "files of an interrupted `gftorf simulate`"
        raise error("an unfinished recording", files, "repeat that command, which continues")
    for other in [path.absolute().parent, *sorted(filter(Path.is_dir, path.iterdir()))]:
        if format_or_none(other) is not None:
            raise error("one level off", f"one at {other}", f"use {other}")
    raise error("not a sequence folder", "none of them")


def format_or_none(path: Path) -> str | None:
    """Format of a folder by the names in it; None if it has none."""
    if (path / UNFINISHED).is_file():
        return None
    if (path / CAPTURE).is_file():
        return "capture"
    if any((path / name).is_dir() for name in SLOT_FOLDERS):
        return "ftorf"
    return "torf" if (path / PHASOR_FOLDER).is_dir() else None


def numbered(root: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by the number in their name, in order; other names are ignored.

    Args:
        root: The sequence.
        pattern: Relative name, for example ``forward_flow/flow_{id}.npy``; numbers of .exr files
            have six digits, others four or more.
    """
    folder, _, name = pattern.rpartition("/")
    before, _, after = name.partition("{id}")
    digits = r"\d{6}" if after == ".exr" else r"\d{4}|[1-9]\d{4,8}"
    matcher = re.compile(rf"{re.escape(before)}({digits}){re.escape(after)}")
    if not (root / folder).is_dir():
        return {}
    matches = ((matcher.fullmatch(entry.name), entry) for entry in (root / folder).iterdir())
    return dict(sorted((int(match[1]), entry) for match, entry in matches if match))


def refuse_absurd_ids(files: dict[int, Path]) -> None:
    """Check that the ids are numbers of frames: memory is allocated in proportion.

    Raises:
        InputError: If not.
    """
    if max(files) >= FRAMES_MAX:
        why = f"expected ids below {FRAMES_MAX}, found {max(files)}"
        fix = "count frames from 0000"
        raise InputError("frame id too large", where=files[max(files)], why=why, fix=fix)


def first_size(files: dict[int, Path], spec: specs.Field, problems: Problems) -> dict[str, int]:
    """Rows H and columns W in the first readable header; without one empty, and the problems."""
    unread = Problems()
    for file in files.values():
        shape = unread.attempt(read_shape, file, spec)
        if shape is not None:
            return {"H": shape[0], "W": shape[1]}
    problems.errors += unread.errors
    return {}


def read_field(
    root: Path,
    spec: specs.Field,
    frames: range,
    size: dict[str, int],
    problems: Problems,
    first_id: int = 0,
) -> tuple[dict[int, np.ndarray], str]:
    """Images of one field from the best folder that has any, of ``frames`` and by frame, and their
    source; ``first_id`` is the id of frame 0.
    """
    for pattern in spec.paths:
        files = {n - first_id: file for n, file in numbered(root, pattern).items()}
        if files:
            used = {n: file for n, file in files.items() if n in frames}
            images, source = load(root, spec, used, size, problems)
            ignored = len(files) - len(used)
            other = f"; {ignored} of other frames ignored" if ignored else ""
            return images, f"{source}, {len(used)} images{other}"
    return {}, "default none"


def load(
    root: Path, spec: specs.Field, files: dict[int, Path], size: dict[str, int], problems: Problems
) -> tuple[dict[int, np.ndarray], str]:
    """Read image files as float32; all have the shape of the first."""
    images: dict[int, np.ndarray] = {}
    rounded: str | None = None
    bound = size
    for n, file in files.items():
        array = problems.attempt(read_array, file, spec, bound)
        if array is None:
            continue
        axes = zip(spec.shapes[0], array.shape, strict=True)
        bound = {letter: n for letter, n in axes if isinstance(letter, str)} | size
        image = problems.attempt(as_float32, file, spec, array)
        if image is not None:
            images[n], lossy = image
            rounded = str(array.dtype) if lossy else rounded
    folder = next(iter(files.values())).parent.relative_to(root) if files else ""
    where = f"{SLOT_FOLDERS[0]} .. {SLOT_FOLDERS[-1]}" if str(folder) in SLOT_FOLDERS else folder
    return images, f"file {where}" + (f", {rounded} rounded to float32" if rounded else "")


def empty_quads(root: Path, frames: int, size: dict[str, int]) -> np.ndarray:
    """Zeros [F, H, W].

    Raises:
        ResourceError: If they do not fit into memory.
    """
    shape = frames, size.get("H", 1), size.get("W", 1)
    need = resources.to_read(frames, shape[1] * shape[2])
    resources.require(need, root, "read a shorter recording, or smaller images")
    return np.zeros(shape, dtype=np.float32)
