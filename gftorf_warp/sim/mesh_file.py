"""Read triangles from PLY and OBJ files, and check that they are a surface."""

from __future__ import annotations

import io
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..data.untrusted import MESH_MAX, read_bytes
from ..errors import InputError

SUFFIXES = (".ply", ".obj")
FLAT = 1e-9  # [1] height over longest edge, below which the normal of a triangle is undetermined


def read_mesh(
    file: Path, *, scale: float = 1.0, inside: bool = False, open: bool = False
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]:
    """Vertices [m] and triangles of a file, counter-clockwise as seen from the visible side.

    Vertices at the same position are merged, polygons triangulated, all objects joined; materials,
    colours and normals of the file are ignored.

    Args:
        file: A PLY or OBJ file.
        scale: Metres per unit of the file.
        inside: Whether a closed surface is visible from within, as a room is, whatever its winding
            in the file.
        open: Whether the surface may have borders. Then it is visible from the side from which the
            file winds it counter-clockwise.

    Raises:
        InputError: If the file cannot be read, it has no triangle, a vertex that is no number or a
            triangle without area, or it is no surface: an edge of three triangles, neighbours of
            opposite winding, or, without ``open``, a border.
    """
    refuse = partial(_refuse, file)
    points, triangles = _loaded(file)
    count = len(points)
    refuse(len(triangles) == 0, "it has no triangle", "export the surface, not a cloud of points")
    outside = triangles.min() < 0 or triangles.max() >= count
    refuse(outside, f"a face names vertex {triangles.max()} of {count}", "export it again")
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    why = f"{len(bad)} of {count} vertices are no numbers, the first is {bad[:1].sum()}"
    refuse(len(bad) > 0, why, "correct them")
    points, same = np.unique(scale * points, axis=0, return_inverse=True)
    triangles = same.reshape(-1)[triangles]
    corner = points[triangles]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(1)
    product = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flat = np.flatnonzero(~(np.linalg.norm(product, axis=1) > FLAT * longest**2))
    why = f"{len(flat)} of {len(triangles)} triangles have no area, the first is {flat[:1].sum()}"
    refuse(len(flat) > 0, why, "remove degenerate faces in the program that made it")
    crowded, twisted, borders = _edges(triangles)
    why = f"it is no surface: {crowded} edges have three triangles or more"
    refuse(crowded > 0, why, "split it into bodies that have an inside")
    why = f"at {twisted} edges two neighbours show opposite sides"
    refuse(twisted > 0, why, "make its normals consistent and export it again")
    if open:
        return points, triangles
    why = f"the surface is open: {borders} edges have one triangle only"
    fix = "close the holes, or set open = true for a sheet that is seen from one side"
    refuse(borders > 0, why, fix)
    volume = np.einsum("ti,ti->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    return points, (triangles if (volume < 0) == inside else triangles[:, ::-1])


def _loaded(file: Path) -> tuple[np.ndarray, np.ndarray]:
    suffix = file.suffix.lower()
    fix = f"give one that ends in {' or '.join(SUFFIXES)}"
    _refuse(file, suffix not in SUFFIXES, f"its name ends in {file.suffix!r}", fix)
    try:
        data = read_bytes(file, MESH_MAX)
    except InputError as error:
        raise _wrong(file, error.why, "correct the path, relative to the scene file") from error
    import trimesh

    options: dict[str, Any] = {"skip_materials": True} if suffix == ".obj" else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # non-finite vertices: checked later
            stream = io.BytesIO(data)
            mesh: Any = trimesh.load(
                stream, file_type=suffix[1:], process=False, force="mesh", **options
            )
            points, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
            if points.shape[1:] != (3,) or faces.shape[1:] != (3,):
                raise ValueError(f"vertices {points.shape} and faces {faces.shape}")
            return points, faces
    except Exception as error:  # readers of the formats raise many kinds
        why = f"it cannot be read: {type(error).__name__}, {error}"
        raise _wrong(file, why, "export it again") from error


def _edges(triangles: np.ndarray) -> tuple[int, int, int]:
    """Numbers of edges of three triangles or more, of two that wind it the same way, and of one."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, number, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    rising = edges[:, 0] < edges[:, 1]
    forward = np.bincount(number.reshape(-1), weights=rising, minlength=len(count))
    twisted = (count == 2) & (forward != 1)
    return int((count > 2).sum()), int(twisted.sum()), int((count == 1).sum())


def _refuse(file: Path, wrong: bool, why: str, fix: str) -> None:
    if wrong:
        raise _wrong(file, why, fix)


def _wrong(file: Path, why: str, fix: str) -> InputError:
    return InputError("no mesh that can be traced", where=file, why=why, fix=fix)
