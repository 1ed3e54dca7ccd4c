"""Poses to render from: those of a file, or the novel views of a sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.arrays import read_array
from ..data.poses import rigid
from ..data.sequence import Sequence
from ..data.specs import Field
from ..errors import InputError, UsageError

NOVEL = "novel"  # instead of a file: the novel views of the sequence
FIELD = Field(
    name="poses",
    paths=("FILE.npy",),
    kind="array",
    role="calibration",
    unit="m",
    meaning="Poses to render from, world to camera.",
    written="nothing",
    required=True,
    shapes=(("F", 4, 4), ("F", 3, 4)),
    dtypes="fiu",
)


def read(
    poses: str | Path | Float[np.ndarray, "M 4 4"], sequence: Sequence
) -> Float[np.ndarray, "M 4 4"]:
    """Poses to render from, world to camera [m].

    Args:
        poses: A .npy file of shape [M, 4, 4], or [M, 3, 4] without the last row 0 0 0 1; or
            ``novel``, the novel views of ``sequence``; or the matrices.
        sequence: What was measured.

    Raises:
        UsageError: If the sequence has no such poses.
        InputError: If the file cannot be read, or its matrices are not rigid motions.
    """
    if isinstance(poses, np.ndarray):
        return checked(poses.astype(np.float64), "poses")
    if str(poses) == NOVEL:
        if sequence.novel_from_world is None or not len(sequence.novel_from_world):
            why = f"{sequence.path or 'the sequence'} has no poses of novel views"
            fix = "give a .npy file of camera_from_world matrices, or leave --poses out"
            raise UsageError("no novel views", where="--poses novel", why=why, fix=fix)
        return np.asarray(sequence.novel_from_world, dtype=np.float64)
    path = Path(poses)
    if path.suffix != ".npy":
        why, fix = "expected a .npy file, or the word novel", "save the matrices with numpy.save"
        raise UsageError(f"cannot read poses from {path.name}", where="--poses", why=why, fix=fix)
    stored = read_array(path, FIELD).astype(np.float64)
    if stored.shape[1] == 3:
        last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(stored), 1, 4))
        stored = np.concatenate([stored, last], axis=1)
    return checked(stored, path)


def checked(poses: Float[np.ndarray, "M 4 4"], where: object) -> Float[np.ndarray, "M 4 4"]:
    """The same poses.

    Raises:
        InputError: If one is no rigid motion.
    """
    fine = rigid(poses)
    if not fine.all():
        m = int(np.argmin(fine))
        raise InputError(
            f"poses: {int((~fine).sum())} of {len(fine)} are no rigid motions",
            where=where,
            why=f"expected rotations of determinant +1 and a last row 0 0 0 1, found at index "
            f"{m} {poses[m].tolist()}",
            fix="store camera_from_world with axes x right, y down, z forward, in metres",
        )
    return poses


def middle(sequence: Sequence) -> float:
    """The middle of a sequence [s]."""
    return 0.5 * float(sequence.times[0] + sequence.times[-1])
