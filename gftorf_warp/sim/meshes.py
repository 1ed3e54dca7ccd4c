"""Triangle meshes from files, and the first hits of rays on them in float64.

The hits are truth and share nothing with the tracer: another hierarchy, another precision, all rays
of an image at once. Rays of one image start at one point o. With s = o - a for a corner a, edges e1
and e2 and the ray d,

    det = -d . (e1 x e2),       distance = s . (e1 x e2) / det
    u = d . (e2 x s) / det,     v = d . (s x e1) / det

(Moeller and Trumbore, 1997); the terms in brackets are the same for all rays of an image.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .mesh_file import read_mesh
from .world import Shape

LEAF = 16  # triangles in a leaf of the hierarchy
SLACK = 1e-12  # [1] barycentric tolerance: a ray between two triangles hits one of them
BOX_SLACK = 1e-9  # [1] relative tolerance of the distance to a box


class Node(NamedTuple):
    """A node of the bounding volume hierarchy, in the axes of the mesh."""

    low: Float[np.ndarray, "3"]
    """Smallest coordinates [m]."""
    high: Float[np.ndarray, "3"]
    """Largest coordinates [m]."""
    triangles: Int[np.ndarray, "L"] | None
    """Indices of the triangles of a leaf; None: an inner node."""
    parts: tuple[Node, Node] | None
    """The children of an inner node."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Mesh(Shape):
    """The triangles of a PLY or OBJ file; engine 'gaussian' covers it only if it is static."""

    file: FilePath
    """Path, relative to the scene file that names it."""
    scale: float = 1.0
    """Metres per unit of the file."""
    inside: bool = False
    """False: a solid. True: a room."""
    open: bool = False
    """Whether it may have borders: a sheet, visible from where it winds counter-clockwise."""

    def __post_init__(self):
        if not 0 < self.scale < np.inf:
            raise ValueError(f"scale must be above 0 and finite, got {self.scale}")
        if self.open and self.inside:
            raise ValueError("an open mesh has no inside: set open or inside, not both")
        object.__setattr__(self, "file", FilePath(self.file))
        _ = self.surface  # a bad file is an error when the scene is made

    def __repr__(self):
        """With a hash of the content instead of the path."""
        settings = f"scale={self.scale!r}, inside={self.inside!r}, open={self.open!r}"
        return f"Mesh(file={self.file.name!r}, sha256={self._digest!r}, {settings})"

    @cached_property
    def surface(self) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]:
        """Vertices [m] and triangles, counter-clockwise as seen from the visible side."""
        return read_mesh(self.file, scale=self.scale, inside=self.inside, open=self.open)

    def hit(self, origin, ray):
        """The nearest triangle that faces the ray; faces are numbers of triangles."""
        distance, face = np.full(len(ray), np.inf), np.zeros(len(ray), dtype=np.int64)
        corner, e1, e2, normal = self._edges
        s = origin - corner
        height = np.einsum("ti,ti->t", s, normal)
        facing = height > 0
        across, along = np.cross(e2, s), np.cross(s, e1)
        with np.errstate(divide="ignore"):
            inverse = 1.0 / ray
        waiting = [(self._root, np.arange(len(ray)))]
        while waiting:
            node, rays = waiting.pop()
            rays = rays[_enters(node, origin, inverse[rays], distance[rays])]
            if len(rays) == 0:
                continue
            if node.parts is not None:
                waiting += [(part, rays) for part in node.parts]
                continue
            mine = node.triangles[facing[node.triangles]]
            if len(mine) == 0:
                continue
            d = ray[rays]
            det = -d @ normal[mine].T
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = d @ across[mine].T / det, d @ along[mine].T / det
                reached = height[mine] / det
            met = (det > 0) & (u >= -SLACK) & (v >= -SLACK) & (u + v <= 1 + SLACK)
            reached = np.where(met, reached, np.inf)
            best = reached.argmin(1)
            nearest = reached[np.arange(len(rays)), best]
            nearer = nearest < distance[rays]
            distance[rays[nearer]], face[rays[nearer]] = nearest[nearer], mine[best[nearer]]
        return distance, face

    def normal(self, point, face):
        """Of the triangle: surfaces are flat between their edges."""
        del point
        normal = self._edges[3][face]
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @cached_property
    def reach(self) -> float:
        """Of the vertex farthest from the origin [m]."""
        return float(np.linalg.norm(self.surface[0], axis=1).max())

    @cached_property
    def _edges(self) -> tuple[np.ndarray, ...]:
        """First corner, two edges and their product, of every triangle."""
        points, triangles = self.surface
        a, b, c = (points[triangles[:, n]] for n in range(3))
        return a, b - a, c - a, np.cross(b - a, c - a)

    @cached_property
    def _root(self) -> Node:
        points, triangles = self.surface
        corner = points[triangles]
        return _tree(corner.min(1), corner.max(1), np.arange(len(triangles)))

    @cached_property
    def _digest(self) -> str:
        return hashlib.sha256(self.file.read_bytes()).hexdigest()[:16]


def _tree(low: np.ndarray, high: np.ndarray, members: np.ndarray) -> Node:
    """Hierarchy of boxes, split at the median along the axis in which triangles spread most."""
    box = low[members].min(0), high[members].max(0)
    if len(members) <= LEAF:
        return Node(*box, members, None)
    middle = low[members] + high[members]
    order = members[np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")]
    half = len(order) // 2
    return Node(*box, None, (_tree(low, high, order[:half]), _tree(low, high, order[half:])))


def _enters(node: Node, origin: np.ndarray, inverse: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Which rays of these inverse directions hit a box nearer than a limit [m]."""
    near, far = np.zeros(len(inverse)), limit * (1 + BOX_SLACK)
    for axis in range(3):
        # 0 times infinity: in the plane of a side, which then does not count
        with np.errstate(invalid="ignore"):
            a = (node.low[axis] - origin[axis]) * inverse[:, axis]
            b = (node.high[axis] - origin[axis]) * inverse[:, axis]
        near, far = np.fmax(near, np.fmin(a, b)), np.fmin(far, np.fmax(a, b))
    return near <= far * (1 + BOX_SLACK)
