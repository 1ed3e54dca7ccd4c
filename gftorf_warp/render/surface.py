"""Surfaces as triangles from distance images: a truncated signed distance field, and marching
cubes. NumPy in and out, on the CPU or on CUDA from the same kernels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from ..kernels.geometry import CameraView
from ..kernels.meshing.signed_distance import fuse
from ..scene.camera import Camera
from . import runtime
from .buffers import RenderSettings
from .launch import VIEW_DTYPE, view_bits

TRUNCATION = 4.0  # [voxels] half the thickness of what surfaces are averaged over
ON_NODE = 1e-3  # [voxels] a vertex so near to a node is on it


def surface(
    distance: Float[np.ndarray, "V H W"],
    cameras: Sequence[Camera],
    low: Float[np.ndarray, "3"],
    nodes: tuple[int, int, int],
    voxel: float,
    device: str = "cpu",
) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "T 3"]]:
    """Triangles of what cameras see, with their front towards the cameras.

    What no camera sees, and what is hidden behind it, has no surface.

    Args:
        distance: Along the rays [m]; NaN: unknown.
        cameras: Of these images, one each, all of one size and all with or all without a lens.
        low: The corner of a grid with the least coordinates [m].
        nodes: Nodes of the grid along each axis.
        voxel: Distance of neighbouring nodes [m].
        device: Name of the device.

    Returns:
        Vertices in the world [m], and three of them for each triangle.
    """
    from warp.geometry import IsoSurfaceMarchingCubes

    runtime.start()
    bits = np.concatenate([view_bits(camera, RenderSettings()) for camera in cameras])
    views = wp.array(bits.view(VIEW_DTYPE), dtype=CameraView, device=device)
    images = wp.array(np.ascontiguousarray(distance, np.float32), dtype=float, device=device)
    field = wp.empty(nodes, dtype=float, device=device)
    hidden = wp.empty(nodes, dtype=wp.uint8, device=device)
    origin = wp.vec3(*map(float, low))
    inputs = [views, bool(cameras[0].distortion), images, origin, voxel, TRUNCATION * voxel]
    with runtime.LAUNCHING:
        outputs = [field, hidden]
        runtime.launch(fuse, nodes, inputs, outputs, device=device)
        high = origin + voxel * wp.vec3(*(float(n - 1) for n in nodes))
        mesh = IsoSurfaceMarchingCubes.extract(field, 0.0, lower=origin, upper=high)
    vertices, corners = (array.numpy() for array in mesh)
    known = beside_no(hidden.numpy().astype(bool), (vertices - np.asarray(low)) / voxel)
    return chosen(vertices, corners.reshape(-1, 3), known)


def beside_no(
    hidden: Bool[np.ndarray, "X Y Z"], vertices: Float[np.ndarray, "P 3"]
) -> Bool[np.ndarray, "P"]:
    """Whether neither node of the edge that a vertex is on is hidden; ``vertices`` [voxels]."""
    ends = (np.floor(vertices + ON_NODE), np.ceil(vertices - ON_NODE))
    largest = np.array(hidden.shape) - 1
    nodes = [tuple(np.clip(end, 0, largest).astype(int).T) for end in ends]
    return ~(hidden[nodes[0]] | hidden[nodes[1]])


def chosen(
    vertices: Float[np.ndarray, "P 3"],
    triangles: Int[np.ndarray, "T 3"],
    wanted: Bool[np.ndarray, "P"],
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, "t 3"]]:
    """Triangles all of whose vertices are wanted, and the vertices that they need."""
    used, corners = np.unique(triangles[wanted[triangles].all(axis=1)], return_inverse=True)
    return vertices[used], corners.reshape(-1, 3).astype(np.int32)
