"""Shapes with reflectance on rigid paths, and the exact first hit of every pixel.

The hits are the ground truth: closed forms in float64 that share no step with the renderer. Light
and camera coincide: a surface of reflectance rho met under the angle of incidence i has the
amplitude rho cos(i) / d^2 (sensor notes, 2.2).
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from ..scene.camera import Camera
from .paths import Path, Still, inverse
from .texture import Texture

CHUNK = 1 << 14  # rays at a time: their arrays stay in the cache
# [rad] between neighbours of a spiral that covers a sphere evenly
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


class Grid(NamedTuple):
    """Points that cover a surface."""

    point: Float[np.ndarray, "N 3"]
    """Positions in the axes of the shape [m]."""
    normal: Float[np.ndarray, "N 3"]
    """Unit normals."""
    other: Float[np.ndarray, "N 3"]
    """Normal of the other face at an edge, else the same: visible only if both face the viewer."""
    limb: float
    """Visible only if the cosine of incidence is above this [1]: covers end inside outlines."""


class Shape(abc.ABC):
    """A surface in its axes, seen from one side; see also sim/assembly.py, sim/meshes.py."""

    @abc.abstractmethod
    def hit(
        self, origin: Float[np.ndarray, "3"], ray: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"]]:
        """Distance along unit rays to the first hit [m], inf without any, and its face."""

    @abc.abstractmethod
    def normal(
        self, point: Float[np.ndarray, "P 3"], face: Int[np.ndarray, "P"]
    ) -> Float[np.ndarray, "P 3"]:
        """Unit normals at points of the surface, towards the side from which it is seen."""

    def grid(self, spacing: float, inset: float) -> Grid:
        """Points about ``spacing`` [m] apart, ``inset`` [m] away from possible outlines.

        Raises:
            ValueError: If the shape has no such grid, and so cannot be covered while it moves.
        """
        del spacing, inset
        raise ValueError(
            f"{self} cannot be covered while it moves: let its path be Still, or take engine 'mesh'"
        )

    @property
    def grid_area(self) -> float:
        """Area that :meth:`grid` covers [m^2]; 0 if there is no grid."""
        return 0.0

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Largest distance of the surface from the origin of its axes [m]."""

    def clearance(self, point: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Lower bound of the distance to points in its own axes [m]; 0 or less inside of it.

        That of the bounding sphere, unless a shape knows better.
        """
        return np.linalg.norm(point, axis=1) - self.reach


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A box about its origin; ``inside`` makes it a room, seen from within."""

    size: tuple[float, float, float]
    """Full edge lengths along x, y, z [m]."""
    inside: bool = False
    """False: a solid. True: a room."""

    def __post_init__(self):
        _check_lengths(self.size)

    def hit(self, origin, ray):
        """Slab method; faces are numbered 2 axis + (1 on the positive side)."""
        near, far = np.full(len(ray), -np.inf), np.full(len(ray), np.inf)
        face = np.zeros(len(ray), dtype=np.int64)
        # one axis after the other: reductions over rows of three are slow
        for axis, along in enumerate(ray.T):
            half = self.size[axis] / 2
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (-half - origin[axis]) / along, (half - origin[axis]) / along
            enter, leave = np.minimum(a, b), np.maximum(a, b)
            decides = leave < far if self.inside else enter > near
            side = (along > 0) if self.inside else (along < 0)
            np.copyto(face, 2 * axis + side, where=decides)
            np.maximum(near, enter, out=near)
            np.minimum(far, leave, out=far)
        distance = far if self.inside else near
        return np.where((near < far) & (distance > 0), distance, np.inf), face

    def normal(self, point, face):
        """Along the axis of the face: outwards, or inwards in a room."""
        normal = np.zeros_like(point)
        positive = (face % 2 == 1) != self.inside
        normal[np.arange(len(face)), face // 2] = np.where(positive, 1.0, -1.0)
        return normal

    def grid(self, spacing, inset):
        """A regular grid on each of the six faces, and a row along each of the twelve edges."""
        half = np.asarray(self.size) / 2
        turned = -1.0 if self.inside else 1.0
        points, normals, others = [], [], []
        for axis, u, v in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            flat = _grid(self.size[u] - 2 * inset, self.size[v] - 2 * inset, spacing)
            row = _grid(self.size[axis] - 2 * inset, spacing, spacing)[:, 0]
            for side in (-1.0, 1.0):
                face = np.empty((len(flat), 3))
                face[:, axis], face[:, u], face[:, v] = side * half[axis], flat[:, 0], flat[:, 1]
                points.append(face)
                normals.append(np.tile(turned * side * np.eye(3)[axis], (len(flat), 1)))
                others.append(normals[-1])
                # edge along ``axis`` of the faces ``side`` of u and ``across`` of v
                for across in (-1.0, 1.0):
                    edge = np.empty((len(row), 3))
                    edge[:, axis], edge[:, u], edge[:, v] = row, side * half[u], across * half[v]
                    points.append(edge)
                    normals.append(np.tile(turned * side * np.eye(3)[u], (len(row), 1)))
                    others.append(np.tile(turned * across * np.eye(3)[v], (len(row), 1)))
        return Grid(np.concatenate(points), np.concatenate(normals), np.concatenate(others), 0.0)

    @property
    def grid_area(self) -> float:
        """Six faces."""
        x, y, z = self.size
        return 2.0 * (x * y + y * z + z * x)

    @property
    def reach(self) -> float:
        """Half the diagonal [m]."""
        return float(np.linalg.norm(self.size)) / 2

    def clearance(self, point):
        """The distance; of a room, from the nearest wall to points inside."""
        beyond = np.abs(point) - np.asarray(self.size) / 2
        if self.inside:
            return -beyond.max(axis=1)
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1)


@dataclass(frozen=True, kw_only=True)
class Plane(Shape):
    """A rectangle in the plane z = 0, visible from its -z side."""

    size: tuple[float, float]
    """Edge lengths along x and y [m]."""

    def __post_init__(self):
        _check_lengths(self.size)

    def hit(self, origin, ray):
        """Where z = 0, if the ray comes from -z and meets the rectangle."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / ray[:, 2]
        met = (ray[:, 2] > 0) & (distance > 0)
        point = origin + ray * np.where(met, distance, 0.0)[:, None]
        met &= (np.abs(point[:, :2]) <= np.asarray(self.size) / 2).all(1)
        return np.where(met, distance, np.inf), np.zeros(len(ray), dtype=np.int64)

    def normal(self, point, face):
        """-z everywhere."""
        del face
        return np.broadcast_to([0.0, 0.0, -1.0], point.shape).copy()

    def grid(self, spacing, inset):
        """A regular grid."""
        flat = _grid(self.size[0] - 2 * inset, self.size[1] - 2 * inset, spacing)
        point = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
        normal = self.normal(point, np.zeros(len(point), dtype=np.int64))
        return Grid(point, normal, normal, 0.0)

    @property
    def grid_area(self) -> float:
        """The rectangle."""
        return self.size[0] * self.size[1]

    @property
    def reach(self) -> float:
        """Half the diagonal [m]."""
        return float(np.linalg.norm(self.size)) / 2

    def clearance(self, point):
        """The distance."""
        half = np.array([*self.size, 0.0]) / 2
        return np.linalg.norm(np.maximum(np.abs(point) - half, 0.0), axis=1)


@dataclass(frozen=True, kw_only=True)
class Sphere(Shape):
    """A ball about its origin, seen from outside."""

    radius: float
    """Radius [m]."""

    def __post_init__(self):
        _check_lengths((self.radius,))

    def hit(self, origin, ray):
        """The nearer root of |origin + t ray| = radius."""
        along = -ray @ origin
        discriminant = along**2 - (origin @ origin - self.radius**2)
        distance = along - np.sqrt(np.maximum(discriminant, 0.0))
        met = (discriminant > 0) & (distance > 0)
        return np.where(met, distance, np.inf), np.zeros(len(ray), dtype=np.int64)

    def normal(self, point, face):
        """Away from the centre."""
        del face
        return point / np.linalg.norm(point, axis=1, keepdims=True)

    def grid(self, spacing, inset):
        """A golden-angle spiral, the most even cover of a sphere that a formula gives."""
        count = max(8, int(np.ceil(4 * np.pi * self.radius**2 / spacing**2)))
        z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        around = np.sqrt(1.0 - z**2)
        angle = GOLDEN_ANGLE * np.arange(count)
        normal = np.stack([around * np.cos(angle), around * np.sin(angle), z], axis=1)
        # radius (1 - sin) = inset where the cosine is small
        limb = np.sqrt(min(0.5, 2.0 * inset / self.radius))
        return Grid(self.radius * normal, normal, normal, float(limb))

    @property
    def grid_area(self) -> float:
        """The surface."""
        return 4.0 * np.pi * self.radius**2

    @property
    def reach(self) -> float:
        """The radius [m]."""
        return self.radius


def _check_lengths(lengths: tuple[float, ...]) -> None:
    if not all(0 < length < np.inf for length in lengths):
        raise ValueError(f"lengths must be above 0 and finite, got {lengths}")


def _grid(width: float, height: float, spacing: float) -> Float[np.ndarray, "N 2"]:
    """Centres of grid cells, at most ``spacing`` large, of a rectangle about the origin."""
    columns, rows = (max(1, int(np.ceil(length / spacing))) for length in (width, height))
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * max(width, 0.0)
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * max(height, 0.0)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A shape of one texture on one path."""

    shape: Shape
    """Its surface."""
    texture: Texture
    """Its reflectance."""
    path: Path
    """Its motion."""

    def __post_init__(self):
        if self.moves and not np.isfinite(self.shape.reach):
            raise ValueError(f"{self.shape} is infinite, so it cannot move: let its path be still")

    @property
    def moves(self) -> bool:
        """Whether the path is anything but :class:`Still`."""
        return not isinstance(self.path, Still)


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """The first surface on the centre ray of every pixel at one instant."""

    distance: Float[np.ndarray, "H W"]
    """Distance along the ray [m]; NaN where nothing is hit."""
    body: Int[np.ndarray, "H W"]
    """Index of the body; -1 where nothing is hit."""
    face: Int[np.ndarray, "H W"]
    """Number of its face."""
    point: Float[np.ndarray, "H W 3"]
    """The hit in the world [m]; NaN where there is none."""
    normal: Float[np.ndarray, "H W 3"]
    """Unit normal in the world, towards the camera; NaN where there is none."""
    reflectance: Float[np.ndarray, "H W"]
    """Reflectance rho [1]; 0 where nothing is hit."""
    amplitude: Float[np.ndarray, "H W"]
    """rho cos(incidence) / d^2 for a source intensity of 1, gloss included [relative units]; 0
    where nothing is hit."""


def first_hit(bodies: tuple[Body, ...], camera: Camera, time: float) -> Hits:
    """First hit of every pixel's centre ray with ``bodies`` at ``time`` [s], in float64."""
    shape, centre = (camera.height, camera.width), camera.centre
    poses = [candidate.path.world_from_body(time) for candidate in bodies]
    ray = camera.rays(dtype=torch.float64).numpy().reshape(-1, 3)
    distance, body = np.full(len(ray), np.inf), np.full(len(ray), -1)
    face, normal = np.zeros(len(ray), dtype=np.int64), np.full((len(ray), 3), np.nan)
    reflectance, amplitude = np.zeros(len(ray)), np.zeros(len(ray))
    for start in range(0, len(ray), CHUNK):
        part = slice(start, start + CHUNK)
        nearest = distance[part], body[part], face[part]
        _nearest(bodies, poses, centre, ray[part], *nearest)
        surface = normal[part], reflectance[part], amplitude[part]
        _surface(bodies, poses, centre, ray[part], *nearest, *surface)
    distance[body < 0] = np.nan
    return Hits(
        distance=distance.reshape(shape),
        body=body.reshape(shape),
        face=face.reshape(shape),
        point=(centre + ray * distance[:, None]).reshape(*shape, 3),
        normal=normal.reshape(*shape, 3),
        reflectance=reflectance.reshape(shape),
        amplitude=amplitude.reshape(shape),
    )


def _nearest(
    bodies: tuple[Body, ...],
    poses: list[np.ndarray],
    centre: np.ndarray,
    ray: np.ndarray,
    distance: np.ndarray,
    body: np.ndarray,
    face: np.ndarray,
) -> None:
    """Write the distance [m] of every ray's first hit, the body and its face."""
    for index, (candidate, pose) in enumerate(zip(bodies, poses, strict=True)):
        rays = rays_to_ball(centre, ray, pose[:3, 3], candidate.shape.reach)
        if len(rays) == 0:
            continue
        own = ray if len(rays) == len(ray) else ray.take(rays, axis=0)
        origin = pose[:3, :3].T @ (centre - pose[:3, 3])
        reached, side = candidate.shape.hit(origin, own @ pose[:3, :3])
        nearer = np.flatnonzero(reached < distance[rays])
        chosen = rays[nearer]
        distance[chosen], body[chosen], face[chosen] = reached[nearer], index, side[nearer]


def _surface(
    bodies: tuple[Body, ...],
    poses: list[np.ndarray],
    centre: np.ndarray,
    ray: np.ndarray,
    distance: np.ndarray,
    body: np.ndarray,
    face: np.ndarray,
    normal: np.ndarray,
    reflectance: np.ndarray,
    amplitude: np.ndarray,
) -> None:
    """Write normal, reflectance and amplitude where a ray hits a body."""
    for index, (candidate, pose) in enumerate(zip(bodies, poses, strict=True)):
        hit = np.flatnonzero(body == index)
        if len(hit) == 0:
            continue
        rotation, own, reached = pose[:3, :3], ray.take(hit, axis=0), distance[hit]
        point = rotation.T @ (centre - pose[:3, 3]) + (own @ rotation) * reached[:, None]
        upright = candidate.shape.normal(point, face[hit]) @ rotation.T
        x, y, z = (upright * own).T
        rho, cosine = candidate.texture(point), np.abs(x + y + z)
        normal[hit], reflectance[hit] = upright, rho
        amplitude[hit] = rho * candidate.texture.shading(cosine) / reached**2


def rays_to_ball(
    origin: Float[np.ndarray, "3"],
    ray: Float[np.ndarray, "P 3"],
    centre: Float[np.ndarray, "3"],
    radius: float,
) -> Int[np.ndarray, "R"]:
    """Indices of the rays that meet a ball: only these can hit what is inside of it."""
    to = np.subtract(centre, origin)
    outside = to @ to - radius**2
    if outside < 0:
        return np.arange(len(ray))
    along = ray @ to
    return np.flatnonzero((along > 0) & (to @ to - along**2 <= (radius * (1 + 1e-9)) ** 2))


def flow_of(
    bodies: tuple[Body, ...],
    point: Float[np.ndarray, "H W 3"],
    body: Int[np.ndarray, "H W"],
    cameras: tuple[Camera, Camera],
    times: tuple[float, float],
) -> Float[np.ndarray, "2 H W"]:
    """Optical flow [px] of points [m] of bodies from the first to the second of two times [s].

    Points move with their bodies, and the camera moves, too. NaN where ``point`` is; occluded or
    not.
    """
    moved = point.copy()
    for index, candidate in enumerate(bodies):
        if candidate.moves:
            first, second = (candidate.path.world_from_body(time) for time in times)
            step, hit = second @ np.linalg.inv(first), body == index
            moved[hit] = point[hit] @ step[:3, :3].T + step[:3, 3]
    pairs = zip(cameras, (point, moved), strict=True)
    start, end = (camera.project(torch.from_numpy(where)) for camera, where in pairs)
    return np.moveaxis((end - start).numpy(), -1, 0)


def albedo(bodies: tuple[Body, ...], hits: Hits, time: float) -> Float[np.ndarray, "H W 3"]:
    """Albedo in linear RGB [1] of the bodies in ``hits`` at ``time`` [s]; 0 without hit."""
    colour = np.zeros(hits.point.shape)
    for index, candidate in enumerate(bodies):
        hit = hits.body == index
        body_from_world = inverse(candidate.path.world_from_body(time))
        local = hits.point[hit] @ body_from_world[:3, :3].T + body_from_world[:3, 3]
        colour[hit] = candidate.texture.albedo(local)
    return colour
