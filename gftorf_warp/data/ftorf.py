"""F-TöRF folders of raw quads: their layout, which data_specs/ftorf.toml describes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .family import Stored
from .folder import SLOT_FOLDERS, numbered, refuse_absurd_ids
from .sequence import Sequence, Truth
from .writing import (
    calibration_files,
    float32,
    inexpressible,
    json_bytes,
    npy,
    shortest,
    with_zero,
)

FORMAT = "ftorf"
# [rad] a shift is stored as one of four names; what differs by more is another shift
SHIFT_TOLERANCE = 1e-6


def stored(root: Path) -> Stored:
    """The measured raw frames of a folder; other files of tofType0 .. are warped copies.

    Raises:
        InputError: If the folder is not complete, or has no raw frame.
    """
    missing = [name for name in (*SLOT_FOLDERS, "cams") if not (root / name).is_dir()]
    if missing:
        what = "not an F-ToeRF folder" if len(missing) > 1 else f"{missing[0]} missing"
        why = "expected an F-ToeRF folder with tofType0 .. tofType3 and cams, found no "
        why += ", ".join(missing)
        raise InputError(what, where=root, why=why, fix="complete the folder")
    pattern = specs.fields(FORMAT)["quads"].paths[0]
    measured: dict[int, Path] = {}
    copies = 0
    for slot in range(FRAMES_PER_QUARTET):
        files = numbered(root, pattern.replace("{slot}", str(slot)))
        of_slot = {n: file for n, file in files.items() if n % FRAMES_PER_QUARTET == slot}
        measured |= of_slot
        copies += len(files) - len(of_slot)
    if not measured:
        why = "expected files tofType{id % 4}/{id}.npy with ids of four digits, 0000.npy, "
        why += "0004.npy, .., found none"
        fix = "name each measured quad by its raw frame"
        raise InputError("no raw frames", where=root / SLOT_FOLDERS[0], why=why, fix=fix)
    refuse_absurd_ids(measured)
    note = f"; {copies} files of another slot than their id's are warped copies, ignored"
    return Stored(
        root=root,
        form=FORMAT,
        files=dict(sorted(measured.items())),
        field="quads",
        counted="raw frames",
        step=1,
        rate_hz=FRAME_RATE_HZ,
        note=note if copies else "",
    )


def files(sequence: Sequence, truth: Truth | None) -> Iterator[tuple[str, bytes]]:
    """Name and content of every file of a folder.

    Reading it again gives the same sequence: images bit by bit in float32, calibration in float64;
    only a frequency that was not read from such a folder may change in its last bit, since its
    inverse is stored.

    Raises:
        UsageError: If the slots do not have the four canonical shifts, one each, or the sequence is
            of phasors.
    """
    if sequence.from_phasors:
        expected = "raw quads that were measured one by one"
        raise inexpressible(FORMAT, "phasors", expected, "phasors: write format torf")
    poses, colour_poses = sequence.camera_from_world, sequence.colour.camera_from_world
    colour_poses = poses if colour_poses is None else colour_poses
    yield from calibration_files(sequence, sequence.times, poses)
    yield "tof_permutation.npy", npy(_permutation(sequence))
    yield "cams/poses.json", json_bytes({"poses": "camera_from_world"})
    yield "cams/color_extrinsics.npy", npy(colour_poses.astype(np.float64))
    yield "cams/dc_offset.npy", npy(np.float64(sequence.calibration.dc_offset))
    if sequence.calibration.adc_zero:
        yield "cams/adc_zero.npy", npy(np.float64(sequence.calibration.adc_zero))
    for n in np.flatnonzero(sequence.measured).tolist():
        yield f"tofType{n % FRAMES_PER_QUARTET}/{n:04d}.npy", npy(with_zero(sequence, n))
    for n, image in sequence.colour.images.items():
        yield f"color/{n:04d}.npy", npy(shortest(float32(image)))
    for n, image in sequence.flow.forward.items():
        yield f"forward_flow_2/flow_{n:04d}.npy", npy(float32(image))
    for n, image in sequence.flow.backward.items():
        yield f"backward_flow_2/flow_{n:04d}.npy", npy(float32(image))
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
    one_each = all(len(slot) <= 1 for slot in slots) and len(set(used)) == len(used)
    if gap.min(axis=1).max() > SHIFT_TOLERANCE or not one_each:
        expected = "each of the four slots to have its own of the shifts 0, pi, pi/2, 3 pi/2 in "
        expected += "every quartet"
        actual = f"{np.round(sequence.shifts[:8], 6).tolist()} .. over {sequence.frames} frames"
        raise inexpressible(FORMAT, "phase shifts", expected, actual)
    # of a recording shorter than a quartet
    unused = iter(sorted(set(range(FRAMES_PER_QUARTET)) - set(used)))
    return np.argsort([next(iter(slot)) if slot else next(unused) for slot in slots])
