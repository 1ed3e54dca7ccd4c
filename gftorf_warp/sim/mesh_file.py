"""Read triangles from PLY and OBJ files, and check that they are a surface."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

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
    points, triangles = _loaded(file)
    if len(triangles) == 0:
        raise _wrong(file, "it has no triangle", "export the surface, not a cloud of points")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise _wrong(
            file, f"a face names vertex {triangles.max()} of {len(points)}", "export it again"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if len(bad):
        raise _wrong(
            file,
            f"{len(bad)} of {len(points)} vertices are no numbers, the first is {bad[0]}",
            "correct them",
        )
    points, same = np.unique(scale * points, axis=0, return_inverse=True)
    triangles = same.reshape(-1)[triangles]
    _check_area(file, points, triangles)
    borders = _check_edges(file, triangles)
    if open:
        return points, triangles
    if borders:
        raise _wrong(
            file,
            f"the surface is open: {borders} edges have one triangle only",
            "close the holes, or set open = true for a sheet that is seen from one side",
        )
    corner = points[triangles]
    volume = np.einsum("ti,ti->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    return points, (triangles if (volume < 0) == inside else triangles[:, ::-1])


def _loaded(file: Path) -> tuple[np.ndarray, np.ndarray]:
    if file.suffix.lower() not in SUFFIXES:
        raise _wrong(
            file,
            f"its name ends in {file.suffix!r}",
            f"give one that ends in {' or '.join(SUFFIXES)}",
        )
    try:
        with file.open("rb") as stream:
            stream.read(1)
    except OSError as error:
        raise _wrong(
            file, error.strerror or str(error), "correct the path, relative to the scene file"
        ) from error
    import trimesh

    options: dict[str, Any] = {"skip_materials": True} if file.suffix.lower() == ".obj" else {}
    try:
        with warnings.catch_warnings():
            # non-finite vertices are checked afterwards
            warnings.simplefilter("ignore", RuntimeWarning)
            mesh: Any = trimesh.load(file, process=False, force="mesh", **options)
            return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # readers of the formats raise many kinds
        raise _wrong(
            file, f"it cannot be read: {type(error).__name__}, {error}", "export it again"
        ) from error


def _check_area(file: Path, points: np.ndarray, triangles: np.ndarray) -> None:
    corner = points[triangles]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(1)
    twice = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    flat = np.flatnonzero(~(twice > FLAT * longest**2))
    if len(flat):
        raise _wrong(
            file,
            f"{len(flat)} of {len(triangles)} triangles have no area, the first is {flat[0]}",
            "remove degenerate faces in the program that made it",
        )


def _check_edges(file: Path, triangles: np.ndarray) -> int:
    """Number of borders: edges of one triangle.

    Raises:
        InputError: If an edge has more than two triangles, or two that wind it the same way.
    """
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, number, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    crowded = int((count > 2).sum())
    if crowded:
        raise _wrong(
            file,
            f"it is no surface: {crowded} edges have three triangles or more",
            "split it into bodies that have an inside",
        )
    forward = np.bincount(
        number.reshape(-1), weights=edges[:, 0] < edges[:, 1], minlength=len(count)
    )
    twisted = int(((count == 2) & (forward != 1)).sum())
    if twisted:
        raise _wrong(
            file,
            f"at {twisted} edges two neighbours show opposite sides",
            "make its normals consistent and export it again",
        )
    return int((count == 1).sum())


def _wrong(file: Path, why: str, fix: str) -> InputError:
    return InputError("no mesh that can be traced", where=file, why=why, fix=fix)
