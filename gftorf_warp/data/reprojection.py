"""Poses of a moving camera, tested by quartets: they see the same surface from two viewpoints.

Bright pixels of quartet i are placed in space with its pose, seen from the pose of quartet j, and
compared with what j measured there. Distances test the convention of the poses: read the wrong way
round, or with axes of another convention, they differ several times as much. Reflectivity, a d^2,
whose texture is finer, tests the scale: as all phases are the same at any modulation frequency,
only the parallax between metric poses tells distances that are too long by a common factor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .decode import closed_form_distance, quartet_phasor
from .report import Report
from .sequence import Sequence
from .temporal import camera_rests

Poses = Float[np.ndarray, "F 4 4"]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward: OpenGL, Blender
CONVENTIONS: dict[str, Callable[[Poses], Poses]] = {
    "camera to world instead of world to camera: invert them": np.linalg.inv,
    "of a camera that looks along -z (OpenGL): flip its y and z": lambda poses: FLIP @ poses,
    "both: camera to world, along -z": lambda poses: FLIP @ np.linalg.inv(poses),
}
# [1] ratio of the median differences: of six carried cameras 0.21 or less where the convention was
# wrong, and 1.9 or more where it was right
BETTER = 0.5
NOISE = 2e-3  # [1] relative difference of distances that is no evidence: 6 mm at 3 m
SCALES = (0.5, 0.6, 0.67, 0.75, 0.8, 0.9, 1.0, 1.1, 1.2, 1.33, 1.5, 1.67, 2.0)
# [1] ratio of the mean differences of reflectivity: of the same cameras 1.03 at most where the
# frequency was right, 1.03 to 1.27 where depth_range was 20 for 15
WORSE = 1.06
NEAR = 0.15  # [1] scales that differ less from the stated one are not told from it
DARK = 0.3  # share of the pixels, the darkest, that are left out
PIXELS_MAX = 5000  # per pair of quartets: enough for a median
OVERLAP_MIN = 0.2  # share of the points that the other quartet must see
CAP, CAP_LOG = 0.3, 0.5  # [1] an occlusion counts no more than this


class Difference(NamedTuple):
    """Differences between two quartets of one surface."""

    distance: float
    """Median relative difference of distances [1]."""
    reflectivity: float
    """Mean absolute difference of log reflectivity [1]."""


def pose_convention(sequence: Sequence, report: Report) -> None:
    """Poses the wrong way round, or of a camera with other axes; else, distances too long."""
    pairs = _pairs(sequence)
    if camera_rests(sequence) or not pairs:
        return
    poses = sequence.camera_from_world
    stated = _difference(sequence, poses, pairs).distance
    others = {
        name: _difference(sequence, made(poses), pairs).distance
        for name, made in CONVENTIONS.items()
    }
    name = min(others, key=others.__getitem__)
    report.add(
        "reprojection",
        f"distances seen again from other poses differ by {stated:.2%}, with poses taken as "
        f"{name.partition(':')[0]} {others[name]:.2%}",
    )
    if stated > NOISE and others[name] < BETTER * stated:
        report.warn(
            "pose convention",
            f"distances seen again from other poses differ by {stated:.1%}; by {others[name]:.1%} "
            f"only, if the poses are {name}",
        )
    else:
        _scale(sequence, report, pairs)


def _scale(sequence: Sequence, report: Report, pairs: list[tuple[int, int]]) -> None:
    """Distances that do not fit the parallax between poses."""
    poses = sequence.camera_from_world
    left = {k: _difference(sequence, poses, pairs, k).reflectivity for k in SCALES}
    best = min(left, key=left.__getitem__)
    worse = left[1.0] / left[best] if left[best] > 0.0 else 1.0
    report.add("parallax", f"fits distances times {best:g} best, as stated {worse:.2f} times worse")
    if worse > WORSE and abs(best - 1.0) > NEAR:
        f_mod_hz = sequence.calibration.f_mod_hz
        report.warn(
            "scale",
            f"the parallax between poses fits distances times {best:g}: f_mod_hz about "
            f"{f_mod_hz / best / 1e6:.3g} MHz instead of {f_mod_hz / 1e6:.4g}, or poses in another "
            f"unit; as stated the reflectivity differs {worse:.2f} times as much",
        )


def _pairs(sequence: Sequence) -> list[tuple[int, int]]:
    """Quartets far from each other in time."""
    quartets = sequence.complete_quartets
    if len(quartets) < 2:
        return []
    first, quarter, half, last = (quartets[k * (len(quartets) - 1) // 4] for k in (0, 1, 2, 4))
    pairs = {(first, half), (first, last), (half, last), (quarter, last)}
    return sorted(pair for pair in pairs if pair[0] != pair[1])


def _difference(
    sequence: Sequence, poses: Poses, pairs: list[tuple[int, int]], scale: float = 1.0
) -> Difference:
    """Mean over pairs, if distances are multiplied by ``scale``."""
    differences = [_of_pair(sequence, poses, i, j, scale) for i, j in pairs]
    return Difference(*np.mean(differences, axis=0).tolist())


def _of_pair(sequence: Sequence, poses: Poses, i: int, j: int, scale: float) -> Difference:
    """Bounds of the differences if less than ``OVERLAP_MIN`` is seen again."""
    import cv2

    middle = sequence.cycle // 2
    of_i, of_j = (poses[sequence.cycle * k + middle] for k in (i, j))
    relative = of_j @ np.linalg.inv(of_i)
    rays, distance, reflectivity = _bright(sequence, i)
    points = scale * distance[:, None] * rays @ relative[:3, :3].T + relative[:3, 3]
    tof, front = sequence.intrinsics, points[:, 2] > 0.0
    x, y = (
        focal * points[front, k] / points[front, 2] + centre - 0.5
        for k, (focal, centre) in enumerate(((tof.fx, tof.cx), (tof.fy, tof.cy)))
    )
    inside = (x >= 0) & (x < sequence.width - 1) & (y >= 0) & (y < sequence.height - 1)
    if inside.sum() < OVERLAP_MIN * len(points):
        return Difference(distance=CAP, reflectivity=CAP_LOG)
    at = x[inside, None].astype(np.float32), y[inside, None].astype(np.float32)
    measured, texture = (
        cv2.remap(image.astype(np.float32), *at, cv2.INTER_LINEAR)[:, 0]
        for image in (scale * closed_form_distance(sequence, j), _log_reflectivity(sequence, j))
    )
    expected = np.linalg.norm(points[front][inside], axis=1)
    apart = np.minimum(np.abs(measured / expected - 1.0), CAP)
    other = np.minimum(np.abs(texture - reflectivity[front][inside]), CAP_LOG)
    return Difference(distance=float(np.median(apart)), reflectivity=float(other.mean()))


def _bright(
    sequence: Sequence, i: int
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Rays in camera axes, distances [m] and log reflectivities of bright pixels of quartet i; the
    lens is taken as a pinhole.
    """
    length = np.hypot(*quartet_phasor(sequence, i))
    rows, columns = np.nonzero(length > np.quantile(length, DARK))
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), PIXELS_MAX)).round().astype(int)
    rows, columns, tof = rows[chosen], columns[chosen], sequence.intrinsics
    x, y = (columns + 0.5 - tof.cx) / tof.fx, (rows + 0.5 - tof.cy) / tof.fy
    rays = np.stack([x, y, np.ones(len(x))], axis=-1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = closed_form_distance(sequence, i)[rows, columns]
    return rays, distance, _log_reflectivity(sequence, i)[rows, columns]


def _log_reflectivity(sequence: Sequence, i: int) -> Float[np.ndarray, "H W"]:
    """Logarithm of amplitude times squared distance, up to a constant."""
    tiny = np.finfo(np.float32).tiny
    amplitude = np.hypot(*quartet_phasor(sequence, i))
    return np.log(np.maximum(amplitude, tiny) * closed_form_distance(sequence, i) ** 2 + tiny)
