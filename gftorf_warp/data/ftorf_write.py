"""Writing a sequence as an F-TöRF folder: the inverse of :func:`gftorf_warp.data.ftorf.read`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from .folder import SLOT_FOLDERS
from .sequence import Sequence, Truth
from .writing import (
    calibration_files,
    float32,
    inexpressible,
    json_bytes,
    npy,
    shortest,
    write_folder,
)

SHIFT_TOLERANCE = 1e-6  # [rad] a shift is stored as one of four names; what differs by more is another shift


def write(
    path: str | Path,
    sequence: Sequence,
    truth: Truth | None = None,
    *,
    readme: str | None = None,
    sheet: bytes | None = None,
) -> Path:
    """Write a sequence as an F-ToeRF folder; arguments and errors are those of :func:`writing.write_folder`.

    Reading it again gives the same sequence: images bit by bit in float32, calibration in float64; only a frequency
    that was not read from such a folder may change in its last bit, since its inverse is stored. Every slot needs one
    of the four canonical shifts, each slot another.
    """
    return write_folder(path, "ftorf", sequence, truth, _files, readme=readme, sheet=sheet, folders=SLOT_FOLDERS)


def _files(sequence: Sequence, truth: Truth | None) -> Iterator[tuple[str, bytes]]:
    """Every file of the folder, by relative name."""
    if sequence.from_phasors:
        raise inexpressible("ftorf", "phasors", "raw quads that were measured one by one", "phasors: write format torf")
    poses = sequence.camera_from_world
    colour_poses = poses if sequence.colour.camera_from_world is None else sequence.colour.camera_from_world
    yield from calibration_files(sequence, sequence.times, poses)
    yield "tof_permutation.npy", npy(_permutation(sequence))
    yield "cams/poses.json", json_bytes({"poses": "camera_from_world"})
    yield "cams/color_extrinsics.npy", npy(colour_poses.astype(np.float64))
    yield "cams/dc_offset.npy", npy(np.float64(sequence.calibration.dc_offset))
    for n in np.flatnonzero(sequence.measured).tolist():
        yield f"tofType{n % FRAMES_PER_QUARTET}/{n:04d}.npy", npy(float32(sequence.quads[n]))
    for n, image in sequence.colour.images.items():
        yield f"color/{n:04d}.npy", npy(shortest(float32(image)))
    for direction, images in (("forward", sequence.flow.forward), ("backward", sequence.flow.backward)):
        for n, image in images.items():
            yield f"{direction}_flow_2/flow_{n:04d}.npy", npy(float32(image))
    if truth is not None:
        for n in np.flatnonzero(truth.known).tolist():
            yield f"synthetic_depth/{n:04d}.npy", npy(float32(truth.distance[n]))
            if truth.phasor_distance is not None:
                yield f"phasor_distance/{n:04d}.npy", npy(float32(truth.phasor_distance[n]))


def _permutation(sequence: Sequence) -> np.ndarray:
    """The permutation with canonical = raw[permutation], from the shift of every slot.

    Raises:
        UsageError: If the slots do not have the four canonical shifts, one each.
    """
    gap = np.abs(sequence.shifts[:, None] - np.array(CANONICAL_SHIFTS))
    gap = np.minimum(gap % (2 * math.pi), -gap % (2 * math.pi))
    channel = gap.argmin(axis=1)
    slots = [set(channel[slot::FRAMES_PER_QUARTET].tolist()) for slot in range(FRAMES_PER_QUARTET)]
    used = [next(iter(slot)) for slot in slots if len(slot) == 1]
    if gap.min(axis=1).max() > SHIFT_TOLERANCE or any(len(slot) > 1 for slot in slots) or len(set(used)) < len(used):
        raise inexpressible(
            "ftorf",
            "phase shifts",
            "each of the four slots to have its own of the shifts 0, pi, pi/2, 3 pi/2 in every quartet",
            f"{np.round(sequence.shifts[:8], 6).tolist()} .. over {sequence.frames} frames",
        )
    unused = iter(sorted(set(range(FRAMES_PER_QUARTET)) - set(used)))  # of a recording shorter than a quartet
    return np.argsort([next(iter(slot)) if slot else next(unused) for slot in slots])
