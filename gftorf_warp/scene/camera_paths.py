"""Viewpoints: poses that face a point, turn about one, or lead through others.

All poses are ``camera_from_world`` [m], for ``Camera.at`` and for ``poses`` of
``evaluate.views.render_to_video``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..data.poses import interpolated

Point = Sequence[float] | Float[np.ndarray, "3"]
DOWN = (0.0, 1.0, 0.0)  # in the world of a camera that rests at the origin
PARALLEL = 1e-6  # sine of the angle below which two directions are one


def look_at(eye: Point, target: Point, down: Point = DOWN) -> Float[np.ndarray, "4 4"]:
    """A pose at ``eye`` with ``target`` in the middle of the image.

    Args:
        eye: Position of the camera in the world [m].
        target: Point on the axis of the camera [m].
        down: Direction in the world that is down in the image, as far as the view lets it be.

    Raises:
        ValueError: If eye and target are one point, or the view is along ``down``.
    """
    at, to, below = (np.asarray(point, np.float64) for point in (eye, target, down))
    ahead, across = to - at, np.cross(below, to - at)
    length = float(np.linalg.norm(ahead))
    if not np.linalg.norm(across) > PARALLEL * length * np.linalg.norm(below):
        given = f"from {at.tolist()} to {to.tolist()}"
        raise ValueError(f"look_at needs a view that is not along down {below.tolist()}: {given}")
    z, x = ahead / length, across / np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = x, np.cross(z, x), z
    pose[:3, 3] = -pose[:3, :3] @ at
    return pose


def orbit(
    camera_from_world: Float[np.ndarray, "4 4"],
    pivot: Point,
    turn_deg: float,
    count: int,
    down: Point = DOWN,
) -> Float[np.ndarray, "M 4 4"]:
    """``count`` poses of a camera that is carried about a vertical axis, the first as given.

    Args:
        camera_from_world: Where it starts.
        pivot: Point on the axis [m].
        turn_deg: Angle from the first to the last pose [deg]; positive: to the camera's right.
        count: Number of poses.
        down: Direction of the axis in the world.
    """
    import cv2

    axis = np.asarray(down, np.float64) / np.linalg.norm(down)
    poses = []
    for angle in np.radians(np.linspace(0.0, turn_deg, count)):
        carried = np.eye(4)  # the world as the camera has it, turned the other way
        carried[:3, :3] = cv2.Rodrigues(angle * axis)[0]
        carried[:3, 3] = np.asarray(pivot) - carried[:3, :3] @ pivot
        poses.append(np.asarray(camera_from_world, np.float64) @ carried)
    return np.stack(poses)


def along(poses: Float[np.ndarray, "P 4 4"], count: int) -> Float[np.ndarray, "M 4 4"]:
    """``count`` poses from the first to the last of P, as many between each two neighbours.

    Centres move along straight lines, and rotations are about one axis between two neighbours.
    """
    cameras = np.linalg.inv(np.asarray(poses, np.float64))
    times = np.linspace(0.0, len(cameras) - 1.0, count)
    stamps = np.arange(len(cameras), dtype=np.float64)
    return np.linalg.inv(interpolated(times, stamps, cameras))
