"""Infinite planes, and several shapes that move as one rigid body."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from .meshes import Mesh
from .paths import Vector
from .world import Grid, Shape, rays_to_ball

# numbers that the faces of one part may use; a box has 6, a mesh as many as triangles
FACES = 1 << 32


@dataclass(frozen=True, kw_only=True)
class Level(Shape):
    """The infinite plane where one coordinate has a value, visible from both sides.

    Its axes are the world's, so that its texture is hashed from world coordinates. It cannot move,
    since no finite number of splats covers it.
    """

    axis: int
    """The coordinate: 0 is x, 1 is y, 2 is z."""
    value: float
    """Its value on the plane [m]."""

    def __post_init__(self):
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis must be 0, 1 or 2, got {self.axis}")

    def hit(self, origin, ray):
        """Hits of the plane; face 1 by rays along which the coordinate grows, else 0."""
        along = ray[:, self.axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.value - origin[self.axis]) / along
        return np.where(distance > 0, distance, np.inf), (along > 0).astype(np.int64)

    def normal(self, point, face):
        """Along the axis, towards the origin of the ray."""
        normal = np.zeros_like(point)
        normal[:, self.axis] = np.where(face > 0, -1.0, 1.0)
        return normal

    @property
    def reach(self) -> float:
        """Infinite."""
        return float("inf")


@dataclass(frozen=True, kw_only=True)
class Part:
    """One shape of an assembly."""

    shape: Shape
    """Its surface."""
    position: Vector = (0.0, 0.0, 0.0)
    """Origin of its axes in the axes of the assembly, which are parallel [m]."""

    def __post_init__(self):
        if not np.isfinite(self.shape.reach):
            raise ValueError(f"a part must be finite, {self.shape} is not")
        if isinstance(self.shape, Assembly):
            raise ValueError(
                "a part must be a single shape: list the parts of all assemblies in one"
            )


@dataclass(frozen=True, kw_only=True)
class Assembly(Shape):
    """Shapes of one texture that are fixed to each other: a chair, the frame of a door."""

    parts: tuple[Part, ...] = field(default_factory=tuple)
    """The shapes; parts may touch and overlap."""

    def __post_init__(self):
        if not self.parts:
            raise ValueError("an assembly needs at least one part")

    def hit(self, origin, ray):
        """The nearest hit of any part; face ``FACES`` times the part plus the face of the part."""
        distance, face = np.full(len(ray), np.inf), np.zeros(len(ray), dtype=np.int64)
        near = rays_to_ball(origin, ray, np.zeros(3), self.reach)
        for index, part in enumerate(self.parts):
            position = np.asarray(part.position)
            rays = near[rays_to_ball(origin, ray[near], position, part.shape.reach)]
            reached, side = part.shape.hit(origin - position, ray[rays])
            nearer = reached < distance[rays]
            chosen = rays[nearer]
            distance[chosen], face[chosen] = reached[nearer], FACES * index + side[nearer]
        return distance, face

    def normal(self, point, face):
        """Normal of the part that was hit."""
        normal = np.zeros_like(point)
        for index, part in enumerate(self.parts):
            mine = face // FACES == index
            normal[mine] = part.shape.normal(point[mine] - part.position, face[mine] % FACES)
        return normal

    def grid(self, spacing, inset):
        """The grids of all parts, hidden ones included."""
        grids = [part.shape.grid(spacing, inset) for part in self.parts]
        points, normals, others, limbs = zip(*grids, strict=True)
        moved = [p + part.position for p, part in zip(points, self.parts, strict=True)]
        joined = (np.concatenate(arrays) for arrays in (moved, normals, others))
        return Grid(*joined, max(limbs))

    @property
    def grid_area(self) -> float:
        """Of all parts."""
        return sum(part.shape.grid_area for part in self.parts)

    @cached_property
    def reach(self) -> float:
        """Of the farthest part [m]."""
        return max(float(np.linalg.norm(part.position)) + part.shape.reach for part in self.parts)

    def clearance(self, point: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """The least of its parts."""
        return np.min([part.shape.clearance(point - part.position) for part in self.parts], axis=0)


def has_mesh(shape: Shape) -> bool:
    """Whether a shape is a mesh, or an assembly with one among its parts."""
    return isinstance(shape, Mesh) or (
        isinstance(shape, Assembly) and any(has_mesh(part.shape) for part in shape.parts)
    )
