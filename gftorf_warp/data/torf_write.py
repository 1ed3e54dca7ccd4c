"""Writing a sequence as a TöRF folder of phasors: the inverse of :func:`gftorf_warp.data.torf.read`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..constants import FRAMES_PER_QUARTET
from .decode import quartet_phasor
from .poses import SAME_POSE
from .sequence import Sequence, Truth
from .writing import (
    calibration_files,
    float32,
    inexpressible,
    npy,
    shortest,
    write_folder,
)

QUAD_MAX = float(np.finfo(np.float32).max) / 4.0  # the length of a phasor is up to 2 sqrt(2) times as large


def write(
    path: str | Path,
    sequence: Sequence,
    truth: Truth | None = None,
    *,
    readme: str | None = None,
    sheet: bytes | None = None,
) -> Path:
    """Write the complete quartets of a sequence as phasors, in a ToeRF folder.

    Arguments and errors are those of :func:`writing.write_folder`, and an InputError if the shifts of a quartet do not
    determine a phase. A sequence of phasors is written so that reading it again gives the same one: images bit by bit
    in float32, calibration in float64. Of raw quads, phasor i gets the time, pose, colour and truth of raw frame 4i, as
    phasors beside F-ToeRF quads are named; incomplete quartets, other colour images, optical flow and the constant part
    of the quads are left out.
    """
    return write_folder(path, "torf", sequence, truth, _files, readme=readme, sheet=sheet)


def _files(sequence: Sequence, truth: Truth | None) -> Iterator[tuple[str, bytes]]:
    """Every file of the folder, by relative name."""
    largest = np.abs(sequence.quads).max()
    if not largest < QUAD_MAX:
        raise inexpressible("torf", "quads", f"numbers below {QUAD_MAX:.2g}", f"{largest:.2g}")
    if not sequence.complete_quartets:
        raise inexpressible(
            "torf", "quartets", "one or more with all of their four raw frames", f"none in {sequence.frames} raw frames"
        )
    step = FRAMES_PER_QUARTET
    starts = slice(0, sequence.frames // step * step, step)
    poses = sequence.camera_from_world[starts]
    colour_poses = poses if sequence.colour.camera_from_world is None else sequence.colour.camera_from_world[starts]
    yield from calibration_files(sequence, sequence.times[starts], poses)
    relative = poses @ np.linalg.inv(colour_poses)
    if np.ptp(relative, axis=0).max() <= SAME_POSE:
        yield "cams/relative_pose.npy", npy(relative[0].astype(np.float64))
    yield "cams/color_extrinsics.npy", npy(colour_poses.astype(np.float64))  # what is constant loses its last bits
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
