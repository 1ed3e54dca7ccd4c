"""Tracing: rigid bodies as triangle meshes, balls and endless planes, and the light that a C-ToF
camera gets from them.

The second way from a scene to an image: no Gaussian, no sorting, no compositing, and no gradient.
Each body has one mesh that is built once; poses move the rays. NumPy in, NumPy out, on the CPU or
on CUDA from the same kernels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Complex, Float, Int

from ..constants import SPEED_OF_LIGHT
from ..kernels.geometry import CameraView
from ..kernels.tracing import light_paths, rays
from ..scene.camera import Camera
from ..scene.optics import Beam
from . import runtime
from .buffers import RenderSettings, available_threads
from .launch import view_of
from .side_by_side import run_side_by_side

ROWS_MIN = 8  # [px] per CPU thread: handing over fewer costs more than it saves


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidBody:
    """A textured surface in its own axes: triangles, a ball, or an endless plane."""

    points: Float[np.ndarray, "V 3"] | None = None
    """Vertices [m]; None: no triangles."""
    triangles: Int[np.ndarray, "T 3"] | None = None
    """Three vertices each, counter-clockwise as seen from the side of the normal; None: no
    triangles."""
    radius: float | None = None
    """Radius of a ball [m]; None: no ball."""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the ball [m]; the texture is that of the body's axes all the same."""
    normal: tuple[float, float, float] | None = None
    """Unit normal of an endless plane, which is seen from both sides; None: no plane."""
    height: float = 0.0
    """Coordinate of the plane along its normal [m]."""
    low: float
    """Smallest reflectance [1]."""
    high: float
    """Largest reflectance [1]."""
    cell: float
    """Edge of a texture cell [m]."""
    gloss: float = 0.0
    """Share of the reflectance that is mirrored into a lobe, the rest is Lambert's [1]."""
    shininess: float = 50.0
    """Exponent of the lobe [1]: its half width is about 1.2 / sqrt(shininess) [rad]."""

    def __post_init__(self):
        if not 0 <= self.gloss <= 1 or not 0 <= self.shininess < math.inf:
            got = f"{self.gloss} and {self.shininess}"
            raise ValueError(f"gloss must be 0 to 1, shininess 0 or more and finite, got {got}")
        meshed = self.points is not None or self.triangles is not None
        if self.radius is not None or self.normal is not None:
            if meshed or (self.radius is None) == (self.normal is None):
                got = f"radius {self.radius}, normal {self.normal}"
                raise ValueError(f"a body is a ball, a plane or triangles, not both: {got}")
            if self.radius is not None and not 0 < self.radius < math.inf:
                raise ValueError(f"radius must be above 0 and finite, got {self.radius}")
            if not np.isfinite([*self.centre, self.height]).all():
                got = f"{self.centre} and {self.height}"
                raise ValueError(f"centre and height must be finite, got {got}")
            if self.normal is not None and abs(np.linalg.norm(self.normal) - 1) > 1e-6:
                raise ValueError(f"normal must have length 1, got {self.normal}")
            return
        if self.points is None or self.triangles is None or len(self.triangles) == 0:
            raise ValueError(
                "a body without a radius or a normal needs points and at least one triangle"
            )
        if not np.isfinite(self.points).all():
            raise ValueError("points must be finite")
        first, last = self.triangles.min(), self.triangles.max()
        if first < 0 or last >= len(self.points):
            raise ValueError(f"triangles name points {first} to {last} of {len(self.points)}")

    @property
    def reach(self) -> float:
        """Distance of the farthest point from the centre [m]; unused for a plane."""
        if self.points is None:
            return self.radius or 0.0
        return float(np.linalg.norm(self.points, axis=1).max())


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A point that shines into a pyramid about the z axis of the camera."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place in camera axes [m]; away from the camera, bodies cast shadows that it sees."""
    beam_deg: tuple[float, float] | None = None
    """Full angles across and down that are lit, below 180 [deg]; None: all directions."""
    beam: Beam | None = None
    """How it shines to the side, and then not backwards; None: evenly."""

    def __post_init__(self):
        if self.beam_deg is not None and not all(0 < angle < 180 for angle in self.beam_deg):
            raise ValueError(f"beam_deg must be between 0 and 180, got {self.beam_deg}")


@dataclass(frozen=True, kw_only=True)
class Bounces:
    """Light that met more than one surface, by random paths."""

    count: int = 0
    """Surfaces after the first one that a path may meet; 0: direct light only."""
    paths: int = 64
    """Paths per pixel, rounded up to a multiple of the instants."""

    def __post_init__(self):
        if self.count < 0 or self.paths < 1:
            got = f"{self.count} and {self.paths}"
            raise ValueError(f"count must not be negative and paths at least 1, got {got}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """Mean light of every pixel for a source intensity of 1, without the sensor's phase offset.

    What met more than one surface is ``light - direct`` and ``amplitude - direct_amplitude``.
    """

    light: Complex[np.ndarray, "h H W"]
    """Sum of amplitude exp(i phase) at each harmonic of the requested modulation
    [relative units]."""
    amplitude: Float[np.ndarray, "H W"]
    """Sum of the amplitudes [relative units]: at least the length of each ``light``."""
    direct: Complex[np.ndarray, "h H W"]
    """The part of ``light`` that met one surface only; it has no random part."""
    direct_amplitude: Float[np.ndarray, "H W"]
    """The part of ``amplitude`` that met one surface only."""
    ambient: Float[np.ndarray, "H W"]
    """Mean reflectance of the rays [1], 0 for those that meet nothing: what comes back of light
    from everywhere."""
    error: Float[np.ndarray, "H W"]
    """Standard error of the first of the harmonics, real and imaginary part together, estimated
    from the spread of the random paths [relative units]: over ``abs(light[0])`` it bounds that of
    the phase [rad]. 0 without bounces, NaN for a single path."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstHits:
    """The first surface on the ray through the centre of every pixel."""

    distance: Float[np.ndarray, "H W"]
    """Along the ray [m]; NaN where nothing is hit."""
    z_depth: Float[np.ndarray, "H W"]
    """Third camera coordinate [m]; NaN where nothing is hit."""
    normal: Float[np.ndarray, "H W 3"]
    """Unit normal in the world, towards the side that is seen; NaN where nothing is hit."""
    body: Int[np.ndarray, "H W"]
    """Index of the body; -1 where nothing is hit."""


class Tracer:
    """Bodies on one device and buffers for their images of one size.

    Args:
        bodies: Rigid bodies of the scene.
        width: Columns of the images [px].
        height: Rows of the images [px].
        harmonics: Multiples of the modulation frequency at which light is wanted.
        device: Name of the device.
        threads: CPU threads; None: as many as this process may use. The images do not depend on it.
    """

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        width: int,
        height: int,
        *,
        harmonics: tuple[int, ...] = (1,),
        device: str = "cpu",
        threads: int | None = None,
    ):
        runtime.start()
        self.device = wp.get_device(device)
        self.width, self.height = width, height
        # kept alive: kernels get their ids only
        self._meshes = [_mesh(body, self.device) for body in bodies]
        self._solids = _solids(bodies, self._meshes, self.device)
        self._poses: dict[int, tuple[wp.array, wp.array]] = {}
        self._harmonics = wp.array(harmonics, dtype=wp.int32, device=self.device)
        wanted = (threads or available_threads()) if self.device.is_cpu else 1
        self._parts = max(1, min(wanted, height // ROWS_MIN))
        shape = (height, width)
        kinds = wp.vec2, wp.float32, wp.float32
        sizes = (len(harmonics), *shape), shape, shape
        self._direct = [*map(self._empty, sizes, kinds)]
        self._indirect = [*map(self._empty, sizes, kinds)]
        of_hit = wp.float32, wp.float32, wp.vec3, wp.int32
        self._hits = [self._empty(shape, dtype) for dtype in of_hit]

    def light(
        self,
        cameras: Sequence[Camera],
        world_from_body: Float[np.ndarray, "T B 4 4"],
        f_mod_hz: float,
        *,
        subsamples: int = 1,
        lamp: Lamp = Lamp(),
        bounces: Bounces = Bounces(),
        seed: int = 0,
    ) -> Light:
        """Light averaged over T instants: direct on a grid of rays, indirect over random paths.

        Args:
            cameras: The camera at each instant; only its pose may change.
            world_from_body: Pose of each body at each instant [m].
            f_mod_hz: Modulation frequency [Hz].
            subsamples: Rays per pixel and axis, on a regular grid: the same for every image.
            lamp: Where the light is and where it shines.
            bounces: How much of the light that met more than one surface is added.
            seed: Of the random paths, 0 to 2^31 - 1; direct light has none.

        Raises:
            ValueError: If there is no instant, or sizes do not fit.
        """
        if subsamples < 1 or not f_mod_hz > 0:
            got = f"{subsamples} and {f_mod_hz}"
            raise ValueError(f"subsamples must be at least 1 and f_mod_hz above 0, got {got}")
        view = self._view(cameras[0])
        poses = self._place(cameras, world_from_body)
        inputs = [*view, _emitter(lamp, f_mod_hz), self._harmonics, self._solids, *poses]
        self._over_rows(light_paths.trace_light, [*inputs, subsamples], self._direct)
        direct, amplitude, ambient = (array.numpy().copy() for array in self._direct)
        total, error = amplitude, np.zeros_like(amplitude)
        light = direct = direct.view(np.complex64)[..., 0]
        if bounces.count:
            count = -(-bounces.paths // len(cameras)) * len(cameras)
            inputs += [bounces.count, count, seed]
            self._over_rows(light_paths.trace_bounces, inputs, self._indirect)
            more, indirect, error = (array.numpy().copy() for array in self._indirect)
            light, total = direct + more.view(np.complex64)[..., 0], amplitude + indirect
        return Light(
            light=light,
            amplitude=total,
            direct=direct,
            direct_amplitude=amplitude,
            ambient=ambient,
            error=error,
        )

    def first_hits(self, camera: Camera, world_from_body: Float[np.ndarray, "B 4 4"]) -> FirstHits:
        """First hit of the centre ray of every pixel, with all bodies at these poses [m].

        Raises:
            ValueError: If sizes do not fit.
        """
        view = self._view(camera)
        poses = self._place([camera], world_from_body[None])
        self._over_rows(rays.trace_hits, [*view, self._solids, *poses], self._hits)
        distance, z_depth, normal, body = (array.numpy().copy() for array in self._hits)
        return FirstHits(distance=distance, z_depth=z_depth, normal=normal, body=body)

    def _view(self, camera: Camera) -> tuple[CameraView, bool]:
        """The camera as kernels read it, and whether it is no pinhole."""
        if (camera.width, camera.height) != (self.width, self.height):
            want = f"{self.width}x{self.height}"
            raise ValueError(f"camera {camera.width}x{camera.height} must be {want}")
        return view_of(camera, RenderSettings()), bool(camera.distortion)

    def _place(
        self, cameras: Sequence[Camera], world_from_body: np.ndarray
    ) -> tuple[wp.array, wp.array]:
        """Body from camera, composed in float64: nothing is lost far from the world's origin."""
        want = (len(cameras), len(self._meshes), 4, 4)
        if len(cameras) == 0 or world_from_body.shape != want:
            raise ValueError(
                f"world_from_body {world_from_body.shape} must be {want}, with at least one instant"
            )
        world_from_camera = np.linalg.inv([camera.camera_from_world for camera in cameras])
        poses = np.linalg.inv(world_from_body) @ world_from_camera[:, None]
        if len(cameras) not in self._poses:
            arrays = self._empty(want[:2], wp.mat33), self._empty(want[:2], wp.vec3)
            self._poses[len(cameras)] = arrays
        rotation, translation = self._poses[len(cameras)]
        rotation.assign(poses[..., :3, :3].astype(np.float32, order="C"))
        translation.assign(poses[..., :3, 3].astype(np.float32, order="C"))
        return rotation, translation

    def _over_rows(self, kernel, inputs: list, outputs: list[wp.array]) -> None:
        """Launch over the rows, interleaved among CPU threads to balance their work."""
        parts = self._parts
        commands = [
            runtime.launch(
                kernel,
                (len(range(part, self.height, parts)), self.width),
                [*inputs, part, parts],
                outputs,
                device=self.device,
                record_cmd=parts > 1,
            )
            for part in range(parts)
        ]
        if parts > 1:
            run_side_by_side(commands, parts)

    def _empty(self, shape: tuple[int, ...], dtype) -> wp.array:
        return wp.empty(shape, dtype=dtype, device=self.device)


def _mesh(body: RigidBody, device: wp.Device) -> wp.Mesh | None:
    if body.points is None or body.triangles is None:
        return None
    points, indices = np.asarray(body.points, np.float32), np.asarray(body.triangles, np.int32)
    return wp.Mesh(
        points=wp.array(points, dtype=wp.vec3, device=device),
        indices=wp.array(indices.ravel(), dtype=wp.int32, device=device),
    )


def _emitter(lamp: Lamp, f_mod_hz: float) -> light_paths.Emitter:
    emitter = light_paths.Emitter()
    emitter.position = wp.vec3(*lamp.position)
    across, down = lamp.beam_deg or (0.0, 0.0)
    emitter.limited = lamp.beam_deg is not None
    emitter.spread = wp.vec2(math.tan(math.radians(across) / 2), math.tan(math.radians(down) / 2))
    emitter.cycles = f_mod_hz / SPEED_OF_LIGHT
    if lamp.beam is not None:
        emitter.power, emitter.factor, emitter.least = lamp.beam
    return emitter


def _solids(bodies: Sequence[RigidBody], meshes: Sequence, device: wp.Device) -> wp.array:
    solids = []
    for body, mesh in zip(bodies, meshes, strict=True):
        solid = rays.Solid()
        ball_or_mesh = rays.BALL if mesh is None else rays.MESH
        solid.shape = ball_or_mesh if body.normal is None else rays.PLANE
        solid.mesh = mesh.id if mesh is not None else wp.uint64(0)
        solid.radius, solid.centre = body.radius or 0.0, wp.vec3(*body.centre)
        solid.reach = body.reach
        solid.normal, solid.height = wp.vec3(*(body.normal or (0.0, 0.0, 0.0))), body.height
        solid.low, solid.high, solid.cell = body.low, body.high, body.cell
        solid.gloss, solid.shininess = body.gloss, body.shininess
        solids.append(solid)
    return wp.array(solids, dtype=rays.Solid, device=device)
