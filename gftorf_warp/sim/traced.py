"""What a camera sees of a scene, by rays through the shapes themselves: meshes, balls and endless planes, no splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int

from ..render.trace import Bounces, FirstHits, Lamp, Light, RigidBody, Tracer
from ..scene.camera import Camera
from ..scene.optics import beam_of
from .assembly import Assembly, Level, Part
from .look import pooled
from .meshes import Mesh
from .scene import Scene
from .world import Body, Box, Plane, Shape, Sphere, albedo_seen, flow_of


class Traced:
    """A scene as meshes for one camera.

    Args:
        scene: Bodies and their paths, rays per pixel, place and beam of the emitter.
        camera_at: The camera at a time [s].
        harmonics: Multiples of the modulation frequency at which light is wanted.
        bounces: Light that met more than one surface.
        device: Name of the device that traces.
        rolls: Whether rows are traced one by one, each with a ``row`` of its own.
    """

    def __init__(
        self,
        scene: Scene,
        camera_at: Callable[[float], Camera],
        *,
        harmonics: tuple[int, ...] = (1,),
        bounces: Bounces = Bounces(),
        device: str = "cpu",
        rolls: bool = False,
    ):
        self.scene, self.camera_at, self.bounces = scene, camera_at, bounces
        pieces = [(index, piece) for index, body in enumerate(scene.bodies) for piece in rigid_bodies(body)]
        self._body = np.array([index for index, _ in pieces], dtype=np.int32)  # of each piece
        camera = camera_at(0.0)
        beam = beam_of(scene.lens, camera) if lights_itself(scene, bounces.count) else None
        self._lamp = Lamp(position=scene.emitter, beam_deg=scene.beam_deg, beam=beam)
        self._tracer = Tracer(
            [piece for _, piece in pieces],
            camera.width,
            1 if rolls else camera.height,
            harmonics=harmonics,
            device=device,
        )

    def light(self, times: Sequence[float], f_mod_hz: float, seed: int = 0, *, row: int | None = None) -> Light:
        """Mean light over instants [s] of an exposure, for a source intensity of 1; ``seed`` is of the bounces."""
        return self._tracer.light(
            [self._camera(time, row) for time in times],
            np.stack([self._poses(time) for time in times]),
            f_mod_hz,
            subsamples=self.scene.subsamples,
            lamp=self._lamp,
            bounces=self.bounces,
            seed=seed,
        )

    def first_hits(self, time: float, *, row: int | None = None) -> FirstHits:
        """Distance, z-depth, normal and body on the centre ray of every pixel at ``time`` [s]."""
        hits = self._tracer.first_hits(self._camera(time, row), self._poses(time))
        return replace(hits, body=np.where(hits.body < 0, hits.body, self._body[hits.body]))

    def flow(self, time: float, later: float) -> Float[np.ndarray, "2 H W"]:
        """How what is seen at ``time`` moves until ``later`` [px], see world.py; NaN: nothing is seen."""
        camera, hits = self.camera_at(time), self.first_hits(time)
        rays = camera.rays(dtype=torch.float64).numpy()
        point = camera.centre + rays * hits.distance[..., None]
        return flow_of(self.scene.bodies, point, hits.body, (camera, self.camera_at(later)), (time, later))

    def _camera(self, time: float, row: int | None) -> Camera:
        return self.camera_at(time) if row is None else self.camera_at(time).row(row)

    def _poses(self, time: float) -> Float[np.ndarray, "P 4 4"]:
        """Pose of the body of each piece [m]."""
        return np.stack([body.path.world_from_body(time) for body in self.scene.bodies])[self._body]


def lights_itself(scene: Scene, bounces: int) -> bool:
    """Whether a beam is part of the light that is traced: of a lamp at the camera it can be multiplied afterwards.

    That is so unless light comes from elsewhere or bounces.
    """
    return bounces > 0 or any(scene.emitter)


def trace_colour(scene: Scene, camera: Camera, time: float) -> Float[np.ndarray, "H W 3"]:
    """Mean albedo of every pixel in linear RGB [1] over its rays; black where they meet nothing."""
    n = scene.subsamples
    fine = camera.resized(camera.width * n, camera.height * n)
    colour = albedo_seen(scene.bodies, fine, time)
    return np.stack([pooled(channel, n) for channel in np.moveaxis(colour, -1, 0)], axis=-1)


def rigid_bodies(body: Body) -> list[RigidBody]:
    """A body of the world as the tracer takes it: one piece, or several that share its pose and its texture.

    The flat-sided parts of an assembly are one piece together; each of its balls is another.
    """
    shape, texture = body.shape, body.texture
    made = partial(
        RigidBody,
        low=texture.low,
        high=texture.high,
        cell=texture.cell,
        gloss=texture.gloss,
        shininess=texture.shininess,
    )
    if isinstance(shape, Level):
        x, y, z = np.eye(3)[shape.axis].tolist()
        return [made(normal=(x, y, z), height=shape.value)]
    parts = shape.parts if isinstance(shape, Assembly) else (Part(shape=shape),)
    pieces = [made(radius=part.shape.radius, centre=part.position) for part in parts if isinstance(part.shape, Sphere)]
    flat = [part for part in parts if not isinstance(part.shape, Sphere)]
    if flat:
        meshes = [triangles_of(part.shape) for part in flat]
        before = np.cumsum([0, *(len(points) for points, _ in meshes[:-1])])
        points = np.concatenate([points + part.position for part, (points, _) in zip(flat, meshes, strict=True)])
        triangles = np.concatenate([mesh + first for first, (_, mesh) in zip(before, meshes, strict=True)])
        pieces.append(made(points=points, triangles=triangles))
    return pieces


def triangles_of(shape: Shape) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]:
    """Vertices [m] and triangles of a flat-sided shape, counter-clockwise as seen from its visible side.

    Raises:
        ValueError: If the shape is no box, plane or mesh.
    """
    if isinstance(shape, Mesh):
        return shape.surface
    if isinstance(shape, Plane):
        x, y = np.asarray(shape.size) / 2
        points = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return points, np.array([[0, 2, 1], [0, 3, 2]])
    if not isinstance(shape, Box):
        raise ValueError(f"{type(shape).__name__} has no triangles")
    corners = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij"), axis=-1).reshape(8, 3)
    faces = []
    for axis, u, v in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # u x v points along the axis
        place = 4 >> np.array([axis, u, v])  # of a corner's number, per axis
        for side in (0, 1):
            square = [int(side * place[0] + a * place[1] + b * place[2]) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
            outwards = square if side else square[::-1]
            turned = outwards[::-1] if shape.inside else outwards
            faces += [turned[:3], [turned[0], turned[2], turned[3]]]
    return corners * np.asarray(shape.size), np.array(faces)
