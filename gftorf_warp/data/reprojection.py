"""Poses of a moving camera, tested by distances: what one quartet sees, another must see there.

Distances of quartet i are placed in space with its pose, seen from the pose of quartet j, and
compared with the distances of j. With right poses the median difference is noise; read the wrong
way round, or with axes of another convention, it is several times as large. Distances themselves
and the focal length change it too little in recordings of a second to be tested.
"""

from __future__ import annotations

from collections.abc import Callable

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
DARK = 0.3  # share of the pixels, the darkest, that are left out
PIXELS_MAX = 5000  # per pair of quartets: enough for a median
OVERLAP_MIN = 0.2  # share of the points that the other quartet must see
CAP = 0.3  # [1] an occlusion counts no more than this


def pose_convention(sequence: Sequence, report: Report) -> None:
    """Poses the wrong way round, or of a camera with other axes."""
    pairs = _pairs(sequence)
    if camera_rests(sequence) or not pairs:
        return
    poses = sequence.camera_from_world
    stated = _difference(sequence, poses, pairs)
    others = {name: _difference(sequence, made(poses), pairs) for name, made in CONVENTIONS.items()}
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


def _pairs(sequence: Sequence) -> list[tuple[int, int]]:
    """Quartets far from each other in time."""
    own = sequence.complete_quartets
    if len(own) < 2:
        return []
    first, quarter, half, last = (own[k * (len(own) - 1) // 4] for k in (0, 1, 2, 4))
    pairs = {(first, half), (first, last), (half, last), (quarter, last)}
    return sorted(pair for pair in pairs if pair[0] != pair[1])


def _difference(sequence: Sequence, poses: Poses, pairs: list[tuple[int, int]]) -> float:
    """Median relative difference of distances, mean over pairs; ``CAP`` without an overlap."""
    return float(np.mean([_of_pair(sequence, poses, i, j) for i, j in pairs]))


def _of_pair(sequence: Sequence, poses: Poses, i: int, j: int) -> float:
    import cv2

    middle = sequence.cycle // 2
    of_i, of_j = (poses[sequence.cycle * k + middle] for k in (i, j))
    relative = of_j @ np.linalg.inv(of_i)
    points = _points(sequence, i) @ relative[:3, :3].T + relative[:3, 3]
    tof, front = sequence.intrinsics, points[:, 2] > 0.0
    x, y = (
        focal * points[front, k] / points[front, 2] + centre - 0.5
        for k, (focal, centre) in enumerate(((tof.fx, tof.cx), (tof.fy, tof.cy)))
    )
    inside = (x >= 0) & (x < sequence.width - 1) & (y >= 0) & (y < sequence.height - 1)
    if inside.sum() < OVERLAP_MIN * len(points):
        return CAP
    expected = np.linalg.norm(points[front][inside], axis=1)
    at = x[inside, None].astype(np.float32), y[inside, None].astype(np.float32)
    image = closed_form_distance(sequence, j).astype(np.float32)
    found = cv2.remap(image, *at, cv2.INTER_LINEAR)[:, 0]
    return float(np.median(np.minimum(np.abs(found / expected - 1.0), CAP)))


def _points(sequence: Sequence, i: int) -> Float[np.ndarray, "P 3"]:
    """Bright pixels of quartet i as points in camera axes [m]; the lens is taken as a pinhole."""
    length = np.hypot(*quartet_phasor(sequence, i))
    rows, columns = np.nonzero(length > np.quantile(length, DARK))
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), PIXELS_MAX)).round().astype(int)
    rows, columns, tof = rows[chosen], columns[chosen], sequence.intrinsics
    x, y = (columns + 0.5 - tof.cx) / tof.fx, (rows + 0.5 - tof.cy) / tof.fy
    rays = np.stack([x, y, np.ones(len(x))], axis=-1)
    distance = closed_form_distance(sequence, i)[rows, columns]
    return rays * (distance / np.linalg.norm(rays, axis=1))[:, None]
