"""F-TöRF folders as sequences: the one place that knows their layout, which data_specs/ftorf.toml describes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..constants import FRAMES_PER_QUARTET
from ..errors import InputError, ResourceError
from . import specs
from .arrays import as_float32, read_array, read_shape
from .calibration import FORMAT, read_calibration, read_poses, read_shifts, read_times
from .ftorf_write import write
from .problems import Problems
from .sequence import Sequence, Truth

__all__ = ["numbered", "read", "read_truth", "write"]

SLOT_FOLDERS = tuple(f"tofType{slot}" for slot in range(FRAMES_PER_QUARTET))
FRAMES_MAX = 1_000_000  # over two hours at 120 Hz: a higher id is a typing error


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read an F-ToeRF folder: quads, calibration, colour and flow, never truth, phasors or masks.

    Args:
        path: The folder.
        frame_rate_hz: Raw frames per second; None takes the folder's times, or 120 Hz if it states none.

    Raises:
        InputError: If the folder or a file in it is not what data_specs/ftorf.toml describes; names all of it at once.
        UsageError: If the rate is not above 0.
        ResourceError: If it does not fit into memory.
    """
    root = _root(Path(path))
    problems = Problems()
    sources: dict[str, str] = {}
    frame_paths, copies = _measured_files(root)
    size = _size(frame_paths, problems)
    calibration = read_calibration(root, problems, size.get("W"))
    times = problems.attempt(read_times, root, max(frame_paths) + 1, frame_rate_hz, sources)
    frames = max(frame_paths) + 1 if times is None else len(times)
    shifts = problems.attempt(read_shifts, root, frames, sources)
    poses = problems.attempt(read_poses, root, frames, sources)
    colour, sources["colour"] = _images(root, "colour", frames, size, problems)
    forward, sources["forward_flow"] = _images(root, "forward_flow", frames, size, problems)
    backward, sources["backward_flow"] = _images(root, "backward_flow", frames, size, problems)
    if colour and all((image == image[..., :1]).all() for image in colour.values()):
        sources["colour"] += "; its three channels are equal: amplitude, not colour"
    try:
        quads = np.zeros((frames, size.get("H", 1), size.get("W", 1)), dtype=np.float32)
    except MemoryError as error:
        raise ResourceError(
            "not enough memory", where=root, why=f"{frames} frames of {size} do not fit", fix="use a shorter recording"
        ) from error
    images, source = _load(root, "quads", frame_paths, size, problems)
    for n, image in images.items():
        quads[n] = image
    problems.raise_if_any(root)
    assert times is not None
    assert shifts is not None
    assert poses is not None
    measured = np.zeros(frames, dtype=bool)
    measured[list(frame_paths)] = True
    sources |= calibration.sources
    sources["quads"] = source
    sources["measured"] = f"file {len(frame_paths)} of {frames} raw frames" + (
        f"; {copies} files of another slot than their id's are warped copies, ignored" if copies else ""
    )
    return Sequence(
        quads=quads,
        measured=measured,
        shifts=shifts,
        times=times,
        f_mod_hz=calibration.f_mod_hz,
        phase_offset=calibration.phase_offset,
        dc_offset=calibration.dc_offset,
        fx=calibration.fx,
        fy=calibration.fy,
        cx=calibration.cx,
        cy=calibration.cy,
        camera_from_world=poses,
        quad_scale=calibration.quad_scale,
        colour=colour,
        forward_flow=forward,
        backward_flow=backward,
        sources=sources,
        path=root,
    )


def read_truth(path: str | Path, *, frames: int) -> Truth | None:
    """Read the true distances stored beside a sequence.

    Args:
        path: The F-ToeRF folder.
        frames: Number F of raw frames of the sequence; later ids are not read.

    Returns:
        Truth, with NaN where the file has NaN or 0 and at frames without a file; None if no frame has a file.

    Raises:
        InputError: If a distance image is not what data_specs/ftorf.toml describes.
    """
    root, problems = _root(Path(path)), Problems()
    size = _size(_measured_files(root)[0], problems)
    images, _ = _images(root, "distance", frames, size, problems)
    for n, image in images.items():
        if (image < 0).any():
            error = InputError(
                "distance: negative",
                where=root / f"synthetic_depth/{n:04d}.npy",
                why=f"expected metres along the ray, NaN where unknown, found {np.nanmin(image):g}",
                fix="store NaN where the distance is unknown",
            )
            problems.errors.append(error)
    problems.raise_if_any(root)
    if not images:
        return None
    distance = np.full((frames, size["H"], size["W"]), np.nan, dtype=np.float32)
    for n, image in images.items():
        distance[n] = np.where(image == 0, np.nan, image)
    known = np.zeros(frames, dtype=bool)
    known[list(images)] = True
    return Truth(distance=distance, known=known)


def numbered(root: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by the number in their name, in order; other names are left alone.

    Args:
        root: The sequence.
        pattern: Where they lie, for example ``forward_flow/flow_{id}.npy``.
    """
    folder, _, name = pattern.rpartition("/")
    before, _, after = name.partition("{id}")
    matcher = re.compile(rf"{re.escape(before)}(\d{{4}}|[1-9]\d{{4,8}}){re.escape(after)}")
    if not (root / folder).is_dir():
        return {}
    found = ((matcher.fullmatch(entry.name), entry) for entry in (root / folder).iterdir())
    return dict(sorted((int(match[1]), entry) for match, entry in found if match))


def _root(path: Path) -> Path:
    """The folder, if it is one of this format; else the nearest explanation of what it is instead."""
    expected = "expected an F-ToeRF folder with tofType0 .. tofType3 and cams"
    if not path.is_dir():
        raise InputError(
            "no such folder" if not path.exists() else "not a folder",
            where=path,
            why=f"{expected}, found {'a file' if path.exists() else 'nothing'}",
            fix="check the path",
        )
    missing = [name for name in (*SLOT_FOLDERS, "cams") if not (path / name).is_dir()]
    if not missing:
        return path
    if set(SLOT_FOLDERS) <= set(missing):
        near = [path.absolute().parent, *sorted(entry for entry in path.iterdir() if entry.is_dir())]
        for other in near:
            if (other / SLOT_FOLDERS[0]).is_dir():
                raise InputError(
                    "one level off", where=path, why=f"{expected}, found one at {other}", fix=f"use {other}"
                )
        if (path / "tof").is_dir():
            raise InputError(
                "a ToeRF folder, which holds phasors",
                where=path,
                why=f"{expected}, found tof/ but no raw quads",
                fix="use a recording with raw quads",
            )
    raise InputError(
        "not an F-ToeRF folder" if len(missing) > 1 else f"{missing[0]} missing",
        where=path,
        why=f"{expected}, found no {', '.join(missing)}",
        fix="complete the folder",
    )


def _measured_files(root: Path) -> tuple[dict[int, Path], int]:
    """File of each measured raw frame, and how many files of another slot than their id's there are."""
    spec = specs.fields(FORMAT)["quads"]
    measured: dict[int, Path] = {}
    copies = 0
    for slot in range(FRAMES_PER_QUARTET):
        files = numbered(root, spec.paths[0].replace("{slot}", str(slot)))
        own = {n: file for n, file in files.items() if n % FRAMES_PER_QUARTET == slot}
        measured |= own
        copies += len(files) - len(own)
    if not measured:
        raise InputError(
            "no raw frames",
            where=root / SLOT_FOLDERS[0],
            why="expected files tofType{id % 4}/{id}.npy with ids of four digits, 0000.npy, 0004.npy, .., found none",
            fix="name each measured quad by its raw frame",
        )
    if max(measured) >= FRAMES_MAX:
        raise InputError(
            "raw frame id too large",
            where=measured[max(measured)],
            why=f"expected ids below {FRAMES_MAX}, found {max(measured)}",
            fix="count raw frames from 0000",
        )
    return dict(sorted(measured.items())), copies


def _size(files: dict[int, Path], problems: Problems) -> dict[str, int]:
    """Rows and columns that the first readable header states; empty if none is."""
    spec = specs.fields(FORMAT)["quads"]
    unread = Problems()
    for file in files.values():
        shape = unread.attempt(read_shape, file, spec)
        if shape is not None:
            return {"H": shape[0], "W": shape[1]}
    problems.errors += unread.errors
    return {}


def _images(
    root: Path, name: str, frames: int, size: dict[str, int], problems: Problems
) -> tuple[dict[int, np.ndarray], str]:
    """Images of one field from the best folder that has any, by raw frame below ``frames``, and their source."""
    for pattern in specs.fields(FORMAT)[name].paths:
        files = numbered(root, pattern)
        if files:
            used = {n: file for n, file in files.items() if n < frames}
            images, source = _load(root, name, used, size, problems)
            late = f"; {len(files) - len(used)} of later frames ignored" if len(used) < len(files) else ""
            return images, f"{source}, {len(used)} images{late}"
    return {}, "default none"


def _load(
    root: Path, name: str, files: dict[int, Path], size: dict[str, int], problems: Problems
) -> tuple[dict[int, np.ndarray], str]:
    """Read image files as float32; what the first one leaves open of their shape binds the others."""
    spec = specs.fields(FORMAT)[name]
    images: dict[int, np.ndarray] = {}
    rounded: str | None = None
    bound = dict(size)
    for n, file in files.items():
        array = problems.attempt(read_array, file, spec, bound)
        if array is None:
            continue
        bound = dict(zip((s for s in spec.shapes[0] if isinstance(s, str)), _free(array, spec), strict=True)) | size
        image = problems.attempt(as_float32, file, spec, array)
        if image is not None:
            images[n], lossy = image
            rounded = str(array.dtype) if lossy else rounded
    folder = next(iter(files.values())).parent.relative_to(root) if files else ""
    where = "tofType0 .. tofType3" if name == "quads" else folder
    return images, f"file {where}" + (f", {rounded} rounded to float32" if rounded else "")


def _free(array: np.ndarray, spec: specs.Field) -> list[int]:
    """Lengths of the axes that the field names by a letter."""
    return [n for n, letter in zip(array.shape, spec.shapes[0], strict=True) if isinstance(letter, str)]
