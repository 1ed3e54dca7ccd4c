"""Meshes of each time, PLY or OBJ: rendered distances of the sequence's cameras, fused by a
truncated signed distance and turned into triangles by marching cubes, see render/surface.py.

A camera that rests sees one side of things, so their backs are open. Where the rendering is mostly
transparent, nothing is known.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..data import resources
from ..data.files import write_through
from ..errors import UsageError
from ..evaluate.metrics import normalised
from ..render.surface import surface
from ..scene.camera import Camera
from .moments import Moments, Progress
from .points import OPAQUE, world_points

NODES = 160  # along the longest side of the scene: a voxel of 3 cm in a room of 5 m
VIEWS = 16  # poses of a moving camera from which a time is rendered, spread evenly
RENDERED = ("distance", "opacity")


def write(moments: Moments, folder: Path, progress: Progress, *, kind: str) -> None:
    """Fill a folder with one file per time, whose ``kind`` is ``ply`` or ``obj``.

    Raises:
        UsageError: If nothing is opaque.
        ResourceError: If memory cannot hold the grid.
    """
    for index in range(len(moments)):
        cameras = views_of(moments, index)
        distance = distances(moments, index, cameras)
        low, nodes, voxel = grid(distance, cameras)
        need = resources.to_fuse(math.prod(nodes))
        resources.require(need, folder, "leave mesh and obj out: points need less")
        device = str(moments.run.field.device)
        vertices, triangles = surface(distance, cameras, low, nodes, voxel, device)
        about = [*moments.about(index), f"voxel {voxel:.4g} metres"]
        data = ENCODED[kind](vertices, triangles, about)
        write_through(moments.path(folder, index, kind), data)
        progress(index + 1, len(moments))


def views_of(moments: Moments, index: int) -> list[Camera]:
    """Where the index-th time is seen from: its own camera, and other poses of the sequence."""
    camera = moments.cameras[index]
    poses = np.unique(moments.run.sequence().camera_from_world, axis=0)
    others = poses[np.linspace(0, len(poses) - 1, min(len(poses), VIEWS)).astype(int)]
    moved = [pose for pose in others if not np.array_equal(pose, camera.camera_from_world)]
    return [camera, *(camera.at(pose) for pose in moved)] if can_turn(moments) else [camera]


def can_turn(moments: Moments) -> bool:
    """Whether a time can be seen from the pose of another: a run without Gaussians has its own."""
    return len(moments.run.field) > 0


def distances(moments: Moments, index: int, cameras: list[Camera]) -> Float[np.ndarray, "V H W"]:
    """Distances over opacity [m] of one time, NaN where less than half of the light is stopped.

    Raises:
        UsageError: If that is everywhere.
    """
    times = [moments.times[index]] * len(cameras)
    images = []
    for image in moments.run.images(times, cameras, RENDERED):
        distance = normalised(image["distance"], image["opacity"])
        images.append(np.where(image["opacity"] >= OPAQUE, distance, np.nan))
    stacked = np.stack(images)
    if np.isnan(stacked).all():
        why, fix = f"nothing is opaque at {times[0]:.6g} s", "choose other --times"
        raise UsageError("no surface to export", where=moments.run.path, why=why, fix=fix)
    return stacked


def grid(
    distance: Float[np.ndarray, "V H W"], cameras: list[Camera]
) -> tuple[Float[np.ndarray, "3"], tuple[int, int, int], float]:
    """Least corner [m], nodes and voxel [m] of a grid around what is seen, two voxels more."""
    pairs = zip(distance, cameras, strict=True)
    points = np.concatenate([world_points(d, c, np.isfinite(d)) for d, c in pairs], axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    voxel = max(float((high - low).max()), 1e-3) / (NODES - 5)
    x, y, z = np.ceil((high - low) / voxel).astype(int) + 5
    return low - 2.0 * voxel, (int(x), int(y), int(z)), voxel


def _ply(
    vertices: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "T 3"], about: list[str]
) -> bytes:
    data = _exported(vertices, triangles, "ply")
    comments = "".join(f"comment {line}\n" for line in about).encode("ascii")
    return data.replace(b"element vertex", comments + b"element vertex", 1)


def _obj(
    vertices: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "T 3"], about: list[str]
) -> bytes:
    comments = "".join(f"# {line}\n" for line in about).encode("ascii")
    return comments + _exported(vertices, triangles, "obj")


def _exported(
    vertices: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "T 3"], kind: str
) -> bytes:
    import trimesh

    buffer = io.BytesIO()
    trimesh.Trimesh(vertices, triangles, process=False).export(buffer, file_type=kind)
    return buffer.getvalue()


ENCODED: dict[str, Callable[..., bytes]] = {"ply": _ply, "obj": _obj}
