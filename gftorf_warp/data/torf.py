"""TöRF folders as sequences: the one place that knows their layout, which data_specs/torf.toml describes.

A folder of N phasors becomes 4 N raw frames: quartet i holds re/2, -re/2, im/2, -im/2 of phasor i, with the canonical
shifts, one time and one pose. Their differences are the phasor again, exactly, since halving a float32 is exact.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .arrays import read_shape
from .calibration import read_calibration, read_colour_intrinsics, read_times
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
from .poses import read_moving_colour_poses, read_moving_poses, read_novel
from .problems import Problems
from .sequence import ColourCamera, Sequence, Truth
from .torf_write import write

__all__ = ["phasor_files", "read", "read_truth", "write"]

FORMAT = "torf"
PHASOR_RATE_HZ = FRAME_RATE_HZ / FRAMES_PER_QUARTET  # [Hz] the sensor is that of the F-ToeRF recordings


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read a ToeRF folder: phasors, calibration, poses, colour and novel views, never truth or masks.

    Args:
        path: The folder.
        frame_rate_hz: Phasors per second; None takes the folder's times, or 30 Hz if it states none.

    Raises:
        InputError: If the folder or a file in it is not what data_specs/torf.toml describes; names all of it at once.
        UsageError: If the rate is not above 0.
        ResourceError: If it does not fit into memory.
    """
    root, fields, step = _root(Path(path)), specs.fields(FORMAT), FRAMES_PER_QUARTET
    problems = Problems()
    sources = dict.fromkeys(NOT_IN_FAMILY, "default none")
    files, first_id = phasor_files(root)
    size = first_size(files, fields["phasor"], problems)
    if not (root / "cams").is_dir():
        missing = InputError(
            "cams missing",
            where=root,
            why="expected a folder cams with tof_intrinsics, found none",
            fix="complete the folder",
        )
        problems.errors.append(missing)
    calibrated = read_calibration(root, FORMAT, problems, size.get("W"))
    times = problems.attempt(
        read_times, root, FORMAT, max(files) + 1, frame_rate_hz, default_hz=PHASOR_RATE_HZ, sources=sources
    )
    phasors = max(files) + 1 if times is None else len(times)
    poses = problems.attempt(read_moving_poses, root, phasors, sources)
    colour, sources["colour"] = read_field(root, fields["colour"], phasors, size, problems, first_id)
    intrinsics, colour_poses = None, None
    sources |= dict.fromkeys(("colour_intrinsics", "colour_from_world"), "default none")
    if colour:
        height, width = next(iter(colour.values())).shape[:2]
        intrinsics = problems.attempt(read_colour_intrinsics, root, FORMAT, calibrated, size, (height, width), sources)
        if poses is not None:
            colour_poses = problems.attempt(read_moving_colour_poses, root, poses, sources)
    novel = problems.attempt(read_novel, root, FORMAT, sources)
    quads = empty_quads(root, step * phasors, size)
    images, sources["quads"] = load(root, fields["phasor"], files, size, problems)
    for i, image in images.items():
        re, im = np.moveaxis(image[..., :2], -1, 0) / np.float32(2.0)
        quads[step * i : step * (i + 1)] = re, -re, im, -im
    problems.raise_if_any(root)
    assert times is not None
    assert poses is not None
    measured = np.zeros(phasors, dtype=bool)
    measured[list(files)] = True
    sources |= calibrated.sources
    sources["measured"] = f"file {len(files)} of {phasors} phasors, ids from {first_id:04d}"
    sources["shifts"] = "file tof: phasors, as four simultaneous quads 0, pi, pi/2, 3 pi/2"
    sources["from_phasors"] = "file tof: phasors"
    sources["dc_offset"] = "default 0: a phasor has no constant part"
    sources |= dict.fromkeys(("forward_flow", "backward_flow"), "default none")
    return Sequence(
        quads=quads,
        measured=np.repeat(measured, step),
        shifts=np.tile(CANONICAL_SHIFTS, phasors),
        times=np.repeat(times, step),
        camera_from_world=np.repeat(poses, step, axis=0),
        intrinsics=calibrated.intrinsics,
        calibration=calibrated.calibration,
        from_phasors=True,
        colour=ColourCamera(
            images={step * i: image for i, image in colour.items()},
            intrinsics=intrinsics,
            camera_from_world=None if colour_poses is None else np.repeat(colour_poses, step, axis=0),
        ),
        novel_from_world=novel,
        sources=sources,
        path=root,
    )


def read_truth(path: str | Path, *, frames: int) -> Truth | None:
    """Read the true distances stored beside a sequence, each for the four raw frames of its phasor.

    Args:
        path: The ToeRF folder.
        frames: Number F of raw frames of the sequence, four per phasor; later ids are not read.

    Returns:
        Truth, with NaN where the file has NaN or 0 and at frames without a file; None if no frame has a file.

    Raises:
        InputError: If a distance image is not what data_specs/torf.toml describes.
    """
    root, problems, fields, step = _root(Path(path)), Problems(), specs.fields(FORMAT), FRAMES_PER_QUARTET
    files, first_id = phasor_files(root)
    size = first_size(files, fields["phasor"], problems)
    images = read_distances(root, fields["distance"], frames // step, size, problems, first_id)
    static, _ = read_field(root, fields["phasor_distance"], frames // step, size, problems, first_id)
    problems.raise_if_any(root)
    return truth_of(images, static, frames, step)


def phasor_files(root: Path) -> tuple[dict[int, Path], int]:
    """File of each phasor 0, 1, .. that was measured, and the id of phasor 0.

    Ids count from 0, or from the smallest id of tof/ and color/, 0001 in the original recordings; where the times
    of the folder outnumber its largest id, they count from 0.

    Raises:
        InputError: If there are none, or an id is absurd.
    """
    fields = specs.fields(FORMAT)
    files = numbered(root, fields["phasor"].paths[0])
    if not files:
        raise InputError(
            "no phasors",
            where=root / "tof",
            why="expected files tof/{id}.npy with ids of four digits, 0000.npy or 0001.npy and so on, found none",
            fix="name each phasor by its number",
        )
    refuse_absurd_ids(files)
    first_id = min([*files, *numbered(root, fields["colour"].paths[0])])
    times = root / fields["frame_times"].paths[0]
    stated = Problems().attempt(read_shape, times, fields["frame_times"]) if times.exists() else None
    if stated is not None and stated[0] > max(files):
        first_id = 0
    return {n - first_id: file for n, file in files.items()}, first_id


def _root(path: Path) -> Path:
    """The folder, if it is one of this format."""
    if format_of(path) != FORMAT:
        raise InputError(
            "an F-ToeRF folder, which holds raw quads",
            where=path,
            why=f"expected a ToeRF folder with tof and cams, found {', '.join(SLOT_FOLDERS)} or some of them",
            fix="read it as a sequence of raw quads",
        )
    return path
