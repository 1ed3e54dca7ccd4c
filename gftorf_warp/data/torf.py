"""TöRF folders of phasors: their layout, which data_specs/torf.toml describes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..constants import FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .arrays import read_shape
from .decode import quartet_phasor
from .family import Stored
from .folder import numbered, refuse_absurd_ids
from .poses import SAME_POSE
from .problems import Problems
from .sequence import Sequence, Truth
from .writing import calibration_files, float32, inexpressible, npy, shortest

FORMAT = "torf"
# [Hz] the sensor is that of the F-ToeRF recordings
PHASOR_RATE_HZ = FRAME_RATE_HZ / FRAMES_PER_QUARTET
# the length of a phasor is up to 2 sqrt(2) times as large
QUAD_MAX = float(np.finfo(np.float32).max) / 4.0


def stored(root: Path) -> Stored:
    """The measured phasors of a folder of this format.

    Ids count from 0, or from the smallest id of tof/ and color/, 0001 in the original recordings;
    where the times of the folder outnumber its largest id, they count from 0.

    Raises:
        InputError: If there are no phasors, or an id is absurd.
    """
    fields = specs.fields(FORMAT)
    files = numbered(root, fields["phasor"].paths[0])
    if not files:
        why = "expected files tof/{id}.npy with ids of four digits, 0000.npy or 0001.npy and so "
        why += "on, found none"
        fix = "name each phasor by its number"
        raise InputError("no phasors", where=root / "tof", why=why, fix=fix)
    refuse_absurd_ids(files)
    first_id = min([*files, *numbered(root, fields["colour"].paths[0])])
    times, field = root / fields["frame_times"].paths[0], fields["frame_times"]
    stated = Problems().attempt(read_shape, times, field) if times.exists() else None
    if stated is not None and stated[0] > max(files):
        first_id = 0
    return Stored(
        root=root,
        form=FORMAT,
        files={n - first_id: file for n, file in files.items()},
        field="phasor",
        counted="phasors",
        step=FRAMES_PER_QUARTET,
        rate_hz=PHASOR_RATE_HZ,
        first_id=first_id,
        note=f", ids from {first_id:04d}",
    )


def files(sequence: Sequence, truth: Truth | None) -> Iterator[tuple[str, bytes]]:
    """Name and content of every file of a folder with the complete quartets as phasors.

    A sequence of phasors is written so that reading it again gives the same one: images bit by bit
    in float32, calibration in float64. Of raw quads, phasor i gets the time, pose, colour and truth
    of raw frame 4i, as phasors beside F-ToeRF quads are named; incomplete quartets, other colour
    images, optical flow and the constant part of the quads are left out.

    Raises:
        UsageError: If the quads are too large, or no quartet is complete.
        InputError: If the shifts of a quartet do not determine a phase.
    """
    largest = np.abs(sequence.quads).max()
    if not largest < QUAD_MAX:
        raise inexpressible(FORMAT, "quads", f"numbers below {QUAD_MAX:.2g}", f"{largest:.2g}")
    if not sequence.complete_quartets:
        expected = "one or more with all of their four raw frames"
        raise inexpressible(FORMAT, "quartets", expected, f"none in {sequence.frames} raw frames")
    step = FRAMES_PER_QUARTET
    starts = slice(0, sequence.frames // step * step, step)
    poses, of_colour = sequence.camera_from_world[starts], sequence.colour.camera_from_world
    colour_poses = poses if of_colour is None else of_colour[starts]
    yield from calibration_files(sequence, sequence.times[starts], poses)
    relative = poses @ np.linalg.inv(colour_poses)
    if np.ptp(relative, axis=0).max() <= SAME_POSE:
        yield "cams/relative_pose.npy", npy(relative[0].astype(np.float64))
    # what is constant loses its last bits
    yield "cams/color_extrinsics.npy", npy(colour_poses.astype(np.float64))
    for i in sequence.complete_quartets:
        yield f"tof/{i:04d}.npy", npy(_phasor(sequence, i))
    for i in range(len(poses)):
        if step * i in sequence.colour.images:
            yield f"color/{i:04d}.npy", npy(shortest(float32(sequence.colour.images[step * i])))
        if truth is not None and truth.known[step * i]:
            yield f"distance/{i:04d}.npy", npy(float32(truth.distance[step * i]))
            if truth.phasor_distance is not None:
                yield f"phasor_distance/{i:04d}.npy", npy(float32(truth.phasor_distance[step * i]))


def _phasor(sequence: Sequence, i: int) -> np.ndarray:
    """Phasor of quartet i [H, W, 3]: re, im and their length, float32."""
    quads = sequence.quads[FRAMES_PER_QUARTET * i : FRAMES_PER_QUARTET * (i + 1)]
    if sequence.from_phasors:
        re, im = quads[0] - quads[1], quads[2] - quads[3]  # exact: halving was
    else:
        re, im = quartet_phasor(sequence, i)
    return float32(np.stack([re, im, np.hypot(re, im)], axis=-1))
