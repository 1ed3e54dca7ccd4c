"""Poses in a folder: of the ToF camera, of the colour camera, and of novel views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from . import specs
from .arrays import read_array, read_choice, read_stored

ROTATION_TOLERANCE = 1e-4  # float32 poses are off by 1e-7, mixed-up or scaled matrices by much more
SAME_POSE = 1e-9  # float64 products of poses differ by 1e-15, other poses by much more; [m] and [1]


def rigid(poses: np.ndarray) -> np.ndarray:
    """Whether each of the matrices [F, 4, 4] is a rotation and a translation [F]."""
    rotation = np.asarray(poses, dtype=np.float64)[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        defect = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        proper = np.linalg.det(rotation) > 0
    last_row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1)
    finite = np.isfinite(poses).all(axis=(1, 2))
    return (np.maximum(defect, last_row) <= ROTATION_TOLERANCE) & proper & finite


def interpolated(
    times: Float[np.ndarray, "F"], stamps: Float[np.ndarray, "P"], poses: Float[np.ndarray, "P 4 4"]
) -> Float[np.ndarray, "F 4 4"]:
    """Poses at times [s] between those at increasing stamps [s]: centres along straight lines,
    rotations about one axis at a constant rate. Outside, the first or the last pose.
    """
    import cv2

    result = np.empty((len(times), 4, 4))
    after = np.clip(np.searchsorted(stamps, times, side="right"), 1, max(1, len(stamps) - 1))
    for n, (time, k) in enumerate(zip(times, after, strict=True)):
        before, other = poses[k - 1], poses[min(k, len(stamps) - 1)]
        span = stamps[min(k, len(stamps) - 1)] - stamps[k - 1]
        share = float(np.clip((time - stamps[k - 1]) / span, 0.0, 1.0)) if span > 0 else 0.0
        turn = cv2.Rodrigues(before[:3, :3].T @ other[:3, :3])[0]
        result[n] = before
        if share > 0:
            result[n, :3, :3] = before[:3, :3] @ cv2.Rodrigues(share * turn)[0]
            result[n, :3, 3] = (1 - share) * before[:3, 3] + share * other[:3, 3]
    return result


def read_poses(root: Path, form: str, frames: int, sources: dict[str, str]) -> np.ndarray:
    """camera_from_world [F, 4, 4] [m] of each raw frame of F-ToeRF, of each phasor of ToeRF.

    Identity without a file; for F-ToeRF also with one, unless cams/poses.json enables its poses.

    Raises:
        InputError: If used poses are too few, too many, or no rigid motions.
    """
    spec = specs.fields(form)["tof_extrinsics"]
    path, name = root / spec.paths[0], spec.paths[0]
    sources["camera_from_world"] = f"file {name}"
    if form == "torf":
        if path.exists():
            advice = "store one world-to-camera pose per phasor, or state the number of phasors "
            advice += "by cams/frame_times.npy"
            return _motions(root, spec, frames, "phasors", advice)
        sources["camera_from_world"] = f"default identity: no {name}"
    elif _uses_poses(root):
        marker = specs.fields(form)["poses"].paths[0]
        advice = f"complete the poses, or remove {marker} for a static camera"
        return _motions(root, spec, frames, "raw frames", advice)
    else:
        stored = read_array(path, spec) if path.exists() else None
        still = stored is None or np.array_equal(stored, np.broadcast_to(np.eye(4), stored.shape))
        other = f"{name} holds other poses, which this format's loaders ignore"
        reason = "the camera of this format stands still" if still else other
        sources["camera_from_world"] = f"default identity: {reason}"
    return _identity(frames)


def _uses_poses(root: Path) -> bool:
    """Whether the poses of an F-ToeRF folder are used."""
    marker = specs.fields("ftorf")["poses"]
    path = root / marker.paths[0]
    return path.exists() and bool(read_choice(path, marker))


def read_colour_poses(
    root: Path, form: str, poses: np.ndarray, sources: dict[str, str]
) -> np.ndarray:
    """Pose of the colour camera at each image [F, 4, 4] [m], from the best file of the folder.

    F-ToeRF: cams/color_extrinsics.npy if poses are used, else the pose of the ToF camera. ToeRF: a
    relative pose E takes colour-camera to ToF-camera coordinates, so colour_from_world = inv(E) @
    camera_from_world; in this order, cams/relative_pose.npy; cams/color_extrinsics.npy, also where
    it equals the first, since it needs no product; cams/relative_R.mat and relative_T.mat as E = [R
    | -T]; the pose of the ToF camera.

    Raises:
        InputError: If a file is not what data_specs/ describes.
    """
    fields = specs.fields(form)
    absolute = fields["color_extrinsics"]
    name = absolute.paths[0]
    has_absolute, advice = (root / name).exists(), "complete the poses, or remove the file"
    if form == "ftorf":
        if has_absolute and _uses_poses(root):
            sources["colour_from_world"] = f"file {name}"
            return _motions(root, absolute, len(poses), "raw frames", advice)
        sources["colour_from_world"] = "default as the ToF camera"
        return poses.copy()
    spec, halves = fields["relative_pose"], [fields["relative_R"], fields["relative_T"]]
    if (root / spec.paths[0]).exists():
        relative = read_array(root / spec.paths[0], spec).astype(np.float64).reshape(1, 4, 4)
        _refuse_others(root / spec.paths[0], spec.name, relative)
        product = np.linalg.inv(relative[0]) @ poses
        sources["colour_from_world"] = f"file {spec.paths[0]}"
        if has_absolute:
            stored = read_array(root / name, absolute).astype(np.float64)
            if stored.shape == product.shape and np.abs(stored - product).max() <= SAME_POSE:
                sources["colour_from_world"] = f"file {name}, as {spec.paths[0]} says"
                return stored
            sources["colour_from_world"] += f"; {name} holds other poses, which it replaces"
        return product
    inferable = all((root / half.paths[0]).exists() for half in halves)
    if has_absolute:
        stored = _motions(root, absolute, len(poses), "phasors", advice)
        if not (inferable and np.array_equal(stored, _identity(len(poses)))):
            sources["colour_from_world"] = f"file {name}"
            return stored
    if inferable:
        rotation, translation = (
            read_array(root / half.paths[0], half).astype(np.float64) for half in halves
        )
        relative = _identity(1)
        relative[0, :3, :3], relative[0, :3, 3] = rotation, -translation.reshape(3)
        _refuse_others(root / halves[0].paths[0], halves[0].name, relative)
        files = "cams/relative_R.mat and relative_T.mat"
        sources["colour_from_world"] = f"inferred from {files} as E = [R | -T]"
        return np.linalg.inv(relative[0]) @ poses
    sources["colour_from_world"] = f"inferred as the ToF camera: neither {spec.paths[0]} nor {name}"
    return poses.copy()


def read_novel(root: Path, form: str, sources: dict[str, str]) -> np.ndarray | None:
    """Poses [M, 4, 4] [m] of novel views; None if there is no file.

    Raises:
        InputError: If they are no rigid motions.
    """
    spec = specs.fields(form)["test_poses"]
    stored_poses = read_stored(root, spec)
    if stored_poses is None:
        sources["novel_from_world"] = "default none"
        return None
    stored, name = stored_poses[0][:, :, :4].astype(np.float64), stored_poses[1]
    poses = _identity(len(stored))
    poses[:, : stored.shape[1]] = stored
    _refuse_others(root / name, spec.name, poses)
    sources["novel_from_world"] = f"file {name}, {len(poses)} poses"
    return poses


def _identity(frames: int) -> np.ndarray:
    return np.tile(np.eye(4), (frames, 1, 1))


def _motions(root: Path, spec: specs.Field, frames: int, counted: str, advice: str) -> np.ndarray:
    """Poses of one file [F, 4, 4], float64."""
    stored = read_array(root / spec.paths[0], spec).astype(np.float64)
    if len(stored) != frames:
        why = f"expected one pose for each of {frames} {counted}, found {len(stored)}"
        what = f"{spec.name}: wrong length"
        raise InputError(what, where=root / spec.paths[0], why=why, fix=advice)
    _refuse_others(root / spec.paths[0], spec.name, stored)
    return stored


def _refuse_others(path: Path, name: str, poses: np.ndarray) -> None:
    fine = rigid(poses)
    if not fine.all():
        n = int(np.argmin(fine))
        what = f"{name}: {int((~fine).sum())} poses are not rigid motions"
        why = "expected rotations of determinant +1 and a last row 0 0 0 1, found at pose "
        why += f"{n} {poses[n].tolist()}"
        fix = "store matrices that take world to camera (relative_pose: colour to ToF camera), "
        fix += "x right, y down, z forward"
        raise InputError(what, where=path, why=why, fix=fix)
