"""Calibration of an F-TöRF folder: everything in cams/ and the permutation, each value with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError, UsageError
from . import specs
from .arrays import read_array, read_choice
from .problems import Problems

FORMAT = "ftorf"
DEPTH_RANGES_M = (0.03, 30_000.0)  # [m] 10 GHz to 10 kHz: beyond, the number is another quantity or unit
FOCAL_MIN = 0.05  # of the image width: a view of 168 degrees; what is shorter is given in image widths or millimetres
ROTATION_TOLERANCE = 1e-4  # float32 poses are off by 1e-7, mixed-up or scaled matrices by much more


@dataclass(kw_only=True)
class Calibration:
    """What cams/ says; the names are those of :class:`gftorf_warp.data.sequence.Sequence`."""

    f_mod_hz: float = math.nan
    phase_offset: float = 0.0
    dc_offset: float = 0.0
    quad_scale: float | None = None
    fx: float = math.nan
    fy: float = math.nan
    cx: float = math.nan
    cy: float = math.nan
    sources: dict[str, str] = field(default_factory=dict)


def read_calibration(root: Path, problems: Problems, width: int | None) -> Calibration:
    """Read everything in cams/ that does not depend on the number of frames.

    Args:
        root: The F-ToeRF folder.
        problems: Takes what is wrong.
        width: Columns of the quads; None if they could not be read, and then intrinsics are not judged by it.
    """
    result = Calibration()
    depth_range = problems.attempt(_scalar, root, "depth_range", result.sources, "f_mod_hz")
    if depth_range is not None:
        result.f_mod_hz = SPEED_OF_LIGHT / depth_range
        result.sources["f_mod_hz"] += f", depth_range {depth_range:.9g} m"
    phase_offset = problems.attempt(_scalar, root, "phase_offset", result.sources, "phase_offset")
    dc_offset = problems.attempt(_scalar, root, "dc_offset", result.sources, "dc_offset")
    result.phase_offset, result.dc_offset = phase_offset or 0.0, dc_offset or 0.0
    result.quad_scale = problems.attempt(_scalar, root, "quad_values_scale_factor", result.sources, "quad_scale")
    problems.attempt(_intrinsics, root, result, width)
    return result


def read_shifts(root: Path, frames: int, sources: dict[str, str]) -> np.ndarray:
    """Shift of each raw frame [F] [rad]: slot k has canonical channel argsort(permutation)[k].

    Raises:
        InputError: If the permutation is none.
    """
    spec = specs.fields(FORMAT)["permutation"]
    path = root / spec.paths[0]
    if path.exists():
        values = read_array(path, spec)
        if sorted(values.tolist()) != [0, 1, 2, 3]:
            raise InputError(
                "unknown permutation",
                where=path,
                why=f"expected the numbers 0, 1, 2, 3 in some order, found {values.tolist()}",
                fix="store the order with canonical = raw[permutation], canonical being +cos, -cos, +sin, -sin",
            )
        sources["shifts"] = f"file {spec.paths[0]}: {[int(v) for v in values]}"
    else:
        values = np.array(spec.default)
        sources["shifts"] = "default order +cos, -cos, +sin, -sin (no tof_permutation.npy)"
    channel_of_slot = np.argsort(values)
    return np.array(CANONICAL_SHIFTS)[channel_of_slot[np.arange(frames) % FRAMES_PER_QUARTET]]


def read_times(root: Path, frames: int, frame_rate_hz: float | None, sources: dict[str, str]) -> np.ndarray:
    """Time of each raw frame [F] [s]; the file may hold more than ``frames``, when the last were not measured.

    Raises:
        UsageError: If the given rate is no rate.
        InputError: If the file has too few times, or they decrease.
    """
    spec = specs.fields(FORMAT)["frame_times"]
    path = root / spec.paths[0]
    times = read_array(path, spec).astype(np.float64) if path.exists() else None
    if times is not None:
        if len(times) < frames or times[0] != 0.0 or (np.diff(times) < 0).any():
            steps = np.flatnonzero(np.diff(times) < 0)
            raise InputError(
                "frame_times",
                where=path,
                why=f"expected {frames} or more times in seconds that start at 0 and never decrease, "
                f"found {len(times)} from {times[0]:g} to {times[-1]:g}"
                + (f", decreasing after frame {steps[0]}" if len(steps) else ""),
                fix="correct the order and subtract the first time, or remove the file for 120 Hz",
            )
        frames = len(times)
        sources["times"] = f"file {spec.paths[0]}"
    if frame_rate_hz is not None:
        if not (math.isfinite(frame_rate_hz) and frame_rate_hz > 0):
            raise UsageError(
                "frame rate", where="frame_rate_hz", why=f"expected more than 0, found {frame_rate_hz}", fix="give Hz"
            )
        sources["times"] = f"setting {frame_rate_hz:g} Hz"
        return np.arange(frames) / frame_rate_hz
    if times is not None:
        return times
    sources["times"] = f"default {FRAME_RATE_HZ:g} Hz"
    return np.arange(frames) / FRAME_RATE_HZ


def read_poses(root: Path, frames: int, sources: dict[str, str]) -> np.ndarray:
    """camera_from_world of each raw frame [F, 4, 4] [m]: identity, unless cams/poses.json says that the file counts.

    Raises:
        InputError: If poses that count are too few, too many, or no rigid motions.
    """
    all_fields = specs.fields(FORMAT)
    spec, marker = all_fields["tof_extrinsics"], all_fields["poses"]
    path = root / spec.paths[0]
    counts = (root / marker.paths[0]).exists() and bool(read_choice(root / marker.paths[0], marker))
    stored = read_array(path, spec).astype(np.float64) if path.exists() or counts else None
    if not counts:
        sources["camera_from_world"] = "default identity" + _ignored(stored, spec.paths[0])
        return np.tile(np.eye(4), (frames, 1, 1))
    assert stored is not None
    if len(stored) != frames:
        raise InputError(
            "tof_extrinsics: wrong length",
            where=path,
            why=f"expected one pose for each of {frames} raw frames, found {len(stored)}",
            fix=f"complete the poses, or remove {marker.paths[0]} for a static camera",
        )
    fine = rigid(stored)
    if not fine.all():
        n = int(np.argmin(fine))
        raise InputError(
            f"tof_extrinsics: {int((~fine).sum())} poses are no rigid motions",
            where=path,
            why=f"expected rotations of determinant +1 and a last row 0 0 0 1, found at frame {n} {stored[n].tolist()}",
            fix="store camera_from_world with axes x right, y down, z forward",
        )
    sources["camera_from_world"] = f"file {spec.paths[0]}"
    return stored


def rigid(poses: np.ndarray) -> np.ndarray:
    """Whether each of the matrices [F, 4, 4] is a rotation and a translation [F]."""
    rotation = np.asarray(poses, dtype=np.float64)[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        defect = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        proper = np.linalg.det(rotation) > 0
    last_row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1)
    return (
        (defect <= ROTATION_TOLERANCE) & proper & (last_row <= ROTATION_TOLERANCE) & np.isfinite(poses).all(axis=(1, 2))
    )


def _ignored(stored: np.ndarray | None, name: str) -> str:
    if stored is None or np.array_equal(stored, np.broadcast_to(np.eye(4), stored.shape)):
        return ": the camera of this format stands still"
    return f": {name} holds other poses, which this format's loaders ignore"


def _scalar(root: Path, name: str, sources: dict[str, str], key: str) -> float | None:
    """One number and its source; None if it has neither file nor default."""
    spec = specs.fields(FORMAT)[name]
    found = {path: float(read_array(root / path, spec).reshape(())) for path in spec.paths if (root / path).exists()}
    if len(set(found.values())) > 1:
        raise InputError(
            f"{name}: files disagree",
            where=root / spec.paths[0],
            why=f"expected one value, found {', '.join(f'{value!r} in {path}' for path, value in found.items())}",
            fix="remove the wrong file",
        )
    if not found:
        sources[key] = f"default {spec.default} (no {spec.paths[0]})" if spec.default is not None else "default none"
        return spec.default if isinstance(spec.default, float) else None
    path, value = next(iter(found.items()))
    bounds = {"depth_range": DEPTH_RANGES_M, "quad_values_scale_factor": (math.ulp(0.0), math.inf)}.get(name)
    if bounds and not bounds[0] <= value <= bounds[1]:
        raise InputError(
            f"implausible {name}",
            where=root / path,
            why=f"expected {name} in {spec.unit}, "
            + (f"{bounds[0]:g} to {bounds[1]:g}" if name == "depth_range" else "above 0")
            + f", found {value:g}",
            fix="store speed of light / modulation frequency in metres, 15 for 20 MHz"
            if name == "depth_range"
            else "store the factor, or remove the file",
        )
    sources[key] = f"file {path}"
    return value


def _intrinsics(root: Path, result: Calibration, width: int | None) -> None:
    """Pinhole matrix and pixel centre into ``result``."""
    all_fields = specs.fields(FORMAT)
    spec, centre = all_fields["tof_intrinsics"], all_fields["pixel_centre"]
    found = {path: read_array(root / path, spec) for path in spec.paths if (root / path).exists()}
    path, stored = next(iter(found.items()), (spec.paths[0], None))
    if stored is None:
        raise InputError(
            "tof_intrinsics missing",
            where=root / path,
            why=f"expected {' or '.join(spec.paths)}, found neither",
            fix="store the 3x3 pinhole matrix of the ToF camera in pixels",
        )
    matrix = stored.astype(np.float64)
    if len(found) > 1 and not all(np.array_equal(other[:3, :3], matrix[:3, :3]) for other in found.values()):
        raise InputError(
            "tof_intrinsics: files disagree",
            where=root / path,
            why=f"expected one matrix, found different ones in {' and '.join(found)}",
            fix="remove the wrong file",
        )
    focal = (matrix[0, 0], matrix[1, 1])
    pinhole = np.eye(len(matrix))
    pinhole[0, 0], pinhole[1, 1], pinhole[:2, 2] = *focal, matrix[:2, 2]
    if not np.allclose(matrix, pinhole, atol=1e-6) or min(focal) <= 0 or min(focal) < FOCAL_MIN * (width or 0):
        raise InputError(
            "implausible intrinsics",
            where=root / path,
            why=f"expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy at least {FOCAL_MIN} of the "
            f"width ({'unknown' if width is None else width}), found {matrix.tolist()}",
            fix="store pixels, not fractions of the width or millimetres; no skew, not transposed",
        )
    result.fx, result.fy = map(float, focal)
    if (root / centre.paths[0]).exists():
        convention = read_choice(root / centre.paths[0], centre)
        source = f"file {centre.paths[0]}"
    else:
        convention = "half" if width is not None and matrix[0, 2] == width / 2 else "integer"
        source = f"inferred from cx = {matrix[0, 2]:g} at width {width}"
    half = 0.5 if convention == "integer" else 0.0
    result.cx, result.cy = float(matrix[0, 2] + half), float(matrix[1, 2] + half)
    result.sources |= dict.fromkeys(("fx", "fy"), f"file {path}")
    added = "cx, cy + 0.5" if half else "kept"
    result.sources |= dict.fromkeys(("cx", "cy"), f"file {path}, {convention} pixel centres ({added}), {source}")
    result.sources["pixel_centre"] = f"{source}: {convention}"
