"""Poses in files of other programs: COLMAP, TUM, nerfstudio, matrices.

Each becomes camera_to_world with x right, y down, z forward and the program's own unit of length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.arrays import LIMITS
from ..data.poses import rigid
from ..data.untrusted import read_text, unreadable
from ..errors import InputError
from .lens_files import read_object
from .text_files import numbers, read_rows

FORMS = ("colmap", "tum", "nerfstudio", "matrices")
UNIT_TOLERANCE = 1e-2  # written with three digits, a unit quaternion is off by less
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes: x right, y up, z backward


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """P poses as a file states them."""

    camera_to_world: Float[np.ndarray, "P 4 4"]
    """Poses with x right, y down, z forward, in the file's unit of length."""
    stamps: Float[np.ndarray, "P"] | None = None
    """Time of each [s], increasing; None: the file has none."""
    names: tuple[str, ...] | None = None
    """Name of the image of each; None: the file has none."""


def read_trajectory(path: Path, form: str, *, world_to_camera: bool, opengl: bool) -> Trajectory:
    """The poses in a file.

    Args:
        path: images.txt of COLMAP; lines ``time tx ty tz qx qy qz qw`` of TUM; transforms.json of
            nerfstudio; matrices as [P, 4, 4] or [P, 3, 4] in a .npy file, or one a line as text.
        form: One of ``FORMS``.
        world_to_camera: Direction of matrices.
        opengl: Whether the camera axes of matrices and of TUM are x right, y up, z backward.

    Raises:
        InputError: If it is not of this form, or a pose is no rotation and translation.
    """
    if form == "colmap":
        trajectory = _colmap(path)
    elif form == "tum":
        trajectory = _tum(path)
    elif form == "nerfstudio":
        trajectory = _nerfstudio(path)
    else:
        trajectory = Trajectory(camera_to_world=_matrices(path))
    poses = trajectory.camera_to_world
    fine = rigid(poses)
    if not fine.all():
        n = int(np.argmin(fine))
        why = f"expected rotations and translations, found at pose {n} {poses[n].tolist()}"
        fix = "export rigid poses; a scale belongs into poses.metres_per_unit"
        raise InputError("no pose", where=path, why=why, fix=fix)
    if form == "colmap" or (form == "matrices" and world_to_camera):
        poses = np.linalg.inv(poses)
    if form == "nerfstudio" or (opengl and form != "colmap"):
        poses = poses @ FLIP
    return Trajectory(camera_to_world=poses, stamps=trajectory.stamps, names=trajectory.names)


def _colmap(path: Path) -> Trajectory:
    """images.txt: two lines an image, ``ID QW QX QY QZ TX TY TZ CAMERA NAME`` and its points, which
    may be an empty line. World to camera.
    """
    text = read_text(path).rstrip().splitlines()
    lines = [(number, line) for number, line in enumerate(text, 1) if not line.startswith("#")]
    poses, names = [], []
    for number, line in lines[::2]:
        words = line.split(maxsplit=9)
        if len(words) != 10:
            why = "expected ID QW QX QY QZ TX TY TZ CAMERA NAME and a line of points for each "
            raise unreadable(path, f"{why}image, found {line[:80]!r} in line {number}")
        values = numbers(path, number, words[1:8])
        poses.append(_pose(path, np.array(values[:4]), values[4:]))
        names.append(words[9].strip())
    if not poses:
        raise unreadable(path, "expected images.txt of COLMAP, found no image")
    return Trajectory(camera_to_world=np.stack(poses), names=tuple(names))


def _tum(path: Path) -> Trajectory:
    """``time tx ty tz qx qy qz qw``, camera to world."""
    poses: list[np.ndarray] = []
    stamps: list[float] = []
    for number, words in read_rows(path):
        if len(words) != 8:
            why = "expected time tx ty tz qx qy qz qw in each line, found "
            raise unreadable(path, f"{why}{len(words)} numbers in line {number}")
        time, *values = numbers(path, number, words)
        if stamps and time <= stamps[-1]:
            why = f"expected times that increase, found {time:.9g} after {stamps[-1]:.9g} in line "
            raise unreadable(path, f"{why}{number}")
        stamps.append(time)
        quaternion = np.array([values[6], *values[3:6]])
        poses.append(_pose(path, quaternion, values[:3]))
    return Trajectory(camera_to_world=np.stack(poses), stamps=np.array(stamps))


def _nerfstudio(path: Path) -> Trajectory:
    """transforms.json: camera to world, OpenGL's camera axes."""
    frames = read_object(path).get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise unreadable(path, "expected a list frames of images, as nerfstudio writes it")
    matrices, names = [], []
    for number, frame in enumerate(frames):
        matrix, name = frame.get("transform_matrix"), frame.get("file_path")
        if not isinstance(name, str):
            raise unreadable(path, f"expected a file_path in frames[{number}], found {name!r:.80}")
        try:
            matrices.append(np.array(matrix, dtype=np.float64).reshape(4, 4))
        except (ValueError, TypeError) as error:
            why = f"expected a 4x4 transform_matrix in frames[{number}], found {matrix!r:.80}"
            raise unreadable(path, why) from error
        names.append(name)
    return Trajectory(camera_to_world=np.stack(matrices), names=tuple(names))


def _matrices(path: Path) -> Float[np.ndarray, "P 4 4"]:
    if path.suffix.lower() == ".npy":
        try:
            stored = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # the header is a Python literal: a damaged one raises anything
            raise unreadable(path, f"expected an array of numpy.save, found {error}") from error
        whole = stored.ndim == 3 and stored.shape[1:] in ((3, 4), (4, 4))
        if not whole or not 1 <= len(stored) <= LIMITS["P"] or stored.dtype.kind not in "fiu":
            why = f"expected numbers of shape (P, 4, 4) or (P, 3, 4), found {stored.dtype} "
            raise unreadable(path, f"{why}{stored.shape}")
        values = np.asarray(stored, dtype=np.float64)
    else:
        rows = [numbers(path, number, words) for number, words in read_rows(path)]
        if {len(row) for row in rows} not in ({12}, {16}):
            raise unreadable(path, "expected a matrix of 12 or 16 numbers in each line")
        values = np.array(rows).reshape(len(rows), -1, 4)
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, : values.shape[1]] = values
    return poses


def _pose(
    path: Path, wxyz: Float[np.ndarray, "4"], translation: list[float]
) -> Float[np.ndarray, "4 4"]:
    """A pose of a unit quaternion and a translation."""
    length = float(np.linalg.norm(wxyz))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise unreadable(path, f"expected unit quaternions, found {wxyz.tolist()} (w, x, y, z)")
    w, x, y, z = wxyz / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = translation
    return pose
