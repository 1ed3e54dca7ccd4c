"""F-TöRF folders as sequences: the one place that knows their layout, which data_specs/ftorf.toml describes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..constants import FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .calibration import read_calibration, read_colour_intrinsics, read_shifts, read_times
from .folder import (
    NOT_IN_FAMILY,
    SLOT_FOLDERS,
    empty_quads,
    first_size,
    format_of,
    load,
    numbered,
    read_distances,
    read_field,
    refuse_absurd_ids,
    truth_of,
)
from .ftorf_write import write
from .poses import read_novel, read_static_colour_poses, read_static_poses
from .problems import Problems
from .sequence import ColourCamera, Flow, Sequence, Truth

__all__ = ["read", "read_truth", "write"]

FORMAT = "ftorf"


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read an F-ToeRF folder: quads, calibration, colour, flow and novel views, never truth, phasors or masks.

    Args:
        path: The folder.
        frame_rate_hz: Raw frames per second; None takes the folder's times, or 120 Hz if it states none.

    Raises:
        InputError: If the folder or a file in it is not what data_specs/ftorf.toml describes; names all of it at once.
        UsageError: If the rate is not above 0.
        ResourceError: If it does not fit into memory.
    """
    root, fields = _root(Path(path)), specs.fields(FORMAT)
    problems = Problems()
    sources = dict.fromkeys(NOT_IN_FAMILY, "default none")
    sources["from_phasors"] = "file tofType0 .. tofType3: raw quads"
    frame_paths, copies = _measured_files(root)
    size = first_size(frame_paths, fields["quads"], problems)
    calibrated = read_calibration(root, FORMAT, problems, size.get("W"))
    times = problems.attempt(
        read_times, root, FORMAT, max(frame_paths) + 1, frame_rate_hz, default_hz=FRAME_RATE_HZ, sources=sources
    )
    frames = max(frame_paths) + 1 if times is None else len(times)
    shifts = problems.attempt(read_shifts, root, frames, sources)
    poses, counts = problems.attempt(read_static_poses, root, frames, sources) or (None, False)
    images = {}
    for name in ("colour", "forward_flow", "backward_flow"):
        images[name], sources[name] = read_field(root, fields[name], frames, size, problems)
    colour, intrinsics, colour_poses = images["colour"], None, None
    sources |= dict.fromkeys(("colour_intrinsics", "colour_from_world"), "default none")
    if colour:
        if all((image == image[..., :1]).all() for image in colour.values()):
            sources["colour"] += "; its three channels are equal: amplitude, not colour"
        height, width = next(iter(colour.values())).shape[:2]
        intrinsics = problems.attempt(read_colour_intrinsics, root, FORMAT, calibrated, size, (height, width), sources)
        if poses is not None:
            colour_poses = problems.attempt(read_static_colour_poses, root, poses, counts, sources)
    novel = problems.attempt(read_novel, root, FORMAT, sources)
    quads = empty_quads(root, frames, size)
    measured_images, source = load(root, fields["quads"], frame_paths, size, problems)
    for n, image in measured_images.items():
        quads[n] = image
    problems.raise_if_any(root)
    assert times is not None
    assert shifts is not None
    assert poses is not None
    measured = np.zeros(frames, dtype=bool)
    measured[list(frame_paths)] = True
    sources |= calibrated.sources
    sources["quads"] = source
    sources["measured"] = f"file {len(frame_paths)} of {frames} raw frames" + (
        f"; {copies} files of another slot than their id's are warped copies, ignored" if copies else ""
    )
    return Sequence(
        quads=quads,
        measured=measured,
        shifts=shifts,
        times=times,
        camera_from_world=poses,
        intrinsics=calibrated.intrinsics,
        calibration=calibrated.calibration,
        colour=ColourCamera(images=colour, intrinsics=intrinsics, camera_from_world=colour_poses),
        flow=Flow(forward=images["forward_flow"], backward=images["backward_flow"]),
        novel_from_world=novel,
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
    root, problems, fields = _root(Path(path)), Problems(), specs.fields(FORMAT)
    size = first_size(_measured_files(root)[0], fields["quads"], problems)
    images = read_distances(root, fields["distance"], frames, size, problems)
    static, _ = read_field(root, fields["phasor_distance"], frames, size, problems)
    problems.raise_if_any(root)
    return truth_of(images, static, frames)


def _root(path: Path) -> Path:
    """The folder, if it is a complete one of this format."""
    format_of(path)
    missing = [name for name in (*SLOT_FOLDERS, "cams") if not (path / name).is_dir()]
    if not missing:
        return path
    raise InputError(
        "not an F-ToeRF folder" if len(missing) > 1 else f"{missing[0]} missing",
        where=path,
        why=f"expected an F-ToeRF folder with tofType0 .. tofType3 and cams, found no {', '.join(missing)}",
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
    refuse_absurd_ids(measured)
    return dict(sorted(measured.items())), copies
