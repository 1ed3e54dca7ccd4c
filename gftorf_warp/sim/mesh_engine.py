"""Engine mesh: rays are traced through the shapes: meshes, balls and infinite planes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from ..render.trace import Bounces, FirstHits, Lamp, Light, RigidBody, Tracer
from ..scene.camera import Camera
from ..scene.optics import beam_of
from ..scene.sensor import Sensor
from .assembly import Assembly, Level, Part
from .exposure import Exposure, pooled
from .meshes import Mesh
from .readout import mean_quad
from .rolling import join_rows, row_delays
from .scene import Scene
from .truth_layers import truth_layers
from .world import Body, Box, Plane, Shape, Sphere, albedo, first_hit

PATHS = 7  # part of the seed of the paths, unlike that of read-out and colour camera


class MeshEngine:
    """A scene as meshes for one camera.

    Args:
        scene: Bodies and their paths, rays per pixel, emitter; its sensor's rolling shutter.
        camera_at: The camera at a time [s].
        harmonics: Multiples of the modulation frequency at which light is wanted.
        bounces: Light that met more than one surface.
        device: Name of the device that traces.
        seed: Of the random paths of :meth:`expose`.
        truth: Amount of layers in an exposure, see sim/truth_layers.py; None: no layers.
    """

    def __init__(
        self,
        scene: Scene,
        camera_at: Callable[[float], Camera],
        *,
        harmonics: tuple[int, ...] = (1,),
        bounces: Bounces = Bounces(),
        device: str = "cpu",
        seed: int = 0,
        truth: str | None = None,
    ):
        self.scene, self.camera_at, self.bounces = scene, camera_at, bounces
        self.seed, self.truth = seed, truth
        pieces = [rigid_bodies(body) for body in scene.bodies]
        of_body = np.arange(len(pieces), dtype=np.int32)
        self._body = np.repeat(of_body, list(map(len, pieces)))  # of each piece
        camera = camera_at(0.0)
        beam = beam_of(scene.lens, camera) if beam_is_traced(scene, bounces.count) else None
        self._lamp = Lamp(position=scene.emitter, beam_deg=scene.beam_deg, beam=beam)
        self._tracer = Tracer(
            [piece for several in pieces for piece in several],
            camera.width,
            1 if scene.sensor.row_time_s > 0 else camera.height,
            harmonics=harmonics,
            device=device,
        )

    def light(
        self, times: Sequence[float], f_mod_hz: float, seed: int = 0, *, row: int | None = None
    ) -> Light:
        """Mean light over instants [s], for a source intensity of 1; ``seed`` of the bounces."""
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

    def expose(self, n: int, instants: list[float], time: float, sensor: Sensor) -> Exposure:
        """Raw frame ``n``: mean over ``instants`` [s]; phasor, distance, layers at ``time`` [s].

        With a rolling shutter these are the times of its first row.
        """
        if not self.scene.sensor.row_time_s > 0:
            return self._expose((n, PATHS), instants, time, sensor)
        delays = row_delays(sensor, self.camera_at(0.0).height).tolist()
        rows = []
        for row, delay in enumerate(delays):
            late = [instant + delay for instant in instants]
            rows.append(self._expose((n, PATHS, row), late, time + delay, sensor, row))
        return join_rows(rows)

    def _expose(
        self,
        numbers: tuple[int, ...],
        instants: list[float],
        time: float,
        sensor: Sensor,
        row: int | None = None,
    ) -> Exposure:
        f_mod_hz = float(sensor.f_mod_hz)
        seed = int(np.random.default_rng((self.seed, *numbers)).integers(2**31))
        mean = self.light(instants, f_mod_hz, seed, row=row)
        still = mean if instants == [time] else self.light([time], f_mod_hz, seed, row=row)
        quad, amplitude = mean_quad(mean.light, mean.amplitude, sensor)
        phasor = still.light[0] * np.exp(1j * float(sensor.phase_offset))
        hits, layers = self.first_hits(time, row=row), None
        if self.truth is not None:
            layers = truth_layers(mean, hits, sensor, self.truth, bounced=self.bounces.count > 0)
        return Exposure(quad, amplitude, hits.distance, phasor, mean.ambient, layers)

    def _camera(self, time: float, row: int | None) -> Camera:
        return self.camera_at(time) if row is None else self.camera_at(time).row(row)

    def _poses(self, time: float) -> Float[np.ndarray, "P 4 4"]:
        """Pose of the body of each piece [m]."""
        return np.stack([body.path.world_from_body(time) for body in self.scene.bodies])[self._body]


def beam_is_traced(scene: Scene, bounces: int) -> bool:
    """Whether the beam is part of the traced light; else it is multiplied afterwards."""
    return bounces > 0 or any(scene.emitter)


def traced_albedo(scene: Scene, camera: Camera, time: float) -> Float[np.ndarray, "H W 3"]:
    """Mean albedo of every pixel in linear RGB [1] over its rays; black where they meet nothing."""
    hits = first_hit(scene.bodies, camera.finer(scene.subsamples), time)
    colour = albedo(scene.bodies, hits, time)
    return np.moveaxis(pooled(np.moveaxis(colour, -1, 0), scene.subsamples), 0, -1)


def rigid_bodies(body: Body) -> list[RigidBody]:
    """The rigid bodies of the tracer for a body; all share its pose and its texture.

    The flat-sided parts of an assembly are one piece together; each of its balls is another.
    """
    shape, texture = body.shape, body.texture
    names = ("low", "high", "cell", "gloss", "shininess")
    made = partial(RigidBody, **{name: getattr(texture, name) for name in names})
    if isinstance(shape, Level):
        x, y, z = np.eye(3)[shape.axis].tolist()
        return [made(normal=(x, y, z), height=shape.value)]
    parts = shape.parts if isinstance(shape, Assembly) else (Part(shape=shape),)
    pieces, points, triangles, count = [], [], [], 0
    for part in parts:
        if isinstance(part.shape, Sphere):
            pieces.append(made(radius=part.shape.radius, centre=part.position))
            continue
        corners, faces = triangles_of(part.shape)
        points.append(corners + part.position)
        triangles.append(faces + count)
        count += len(corners)
    if points:
        pieces.append(made(points=np.concatenate(points), triangles=np.concatenate(triangles)))
    return pieces


def triangles_of(shape: Shape) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]:
    """Vertices [m] and triangles of a shape, counter-clockwise from its visible side.

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
    corners = np.indices((2, 2, 2)).reshape(3, 8).T - 0.5
    faces = []
    for axis, u, v in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # u x v points along the axis
        weight = 4 >> np.array([axis, u, v])  # of a corner's number, per axis
        for side in (0, 1):
            around = ((0, 0), (1, 0), (1, 1), (0, 1))
            square = [int(np.dot((side, a, b), weight)) for a, b in around]
            turned = square if side != shape.inside else square[::-1]
            faces += [turned[:3], [turned[0], turned[2], turned[3]]]
    return corners * np.asarray(shape.size), np.array(faces)
