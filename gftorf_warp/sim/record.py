"""Point the camera at a scene: one rendering per raw frame, read out by the sensor; beside it the analytic truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from ..constants import FRAMES_PER_QUARTET
from ..data.sequence import Sequence, Truth
from ..render.api import rasterize
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.sensor import Sensor
from .readout import read_out
from .scenes import Scene
from .splat import Cover, cover_moving, cover_still, merge
from .world import Hits, first_hit

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Rendered mean distance (divided by opacity) against the analytic truth, over interior pixels of still bodies."""

    mean: float
    """Mean of the absolute difference [m]."""
    max: float
    """Largest absolute difference [m]."""
    pixels: int
    """Number of interior pixels in the image."""

    def __str__(self) -> str:
        return f"mean {1e3 * self.mean:.1f} mm, max {1e3 * self.max:.1f} mm over {self.pixels} pixels"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What :func:`record` returns."""

    sequence: Sequence
    """As a camera would have recorded it."""
    truth: Truth
    """Analytic distance along each pixel's centre ray at the time of each raw frame."""
    gap: Gap | None
    """Renderer against truth on still interior pixels; None if no such pixel exists."""
    saturated: float
    """Share of pixels and raw frames in which a tap or the ADC was full [1]."""


class Splatted:
    """A scene as Gaussians: one rigid cover per moving body and one for everything that stays.

    Args:
        scene: Bodies and their paths.
        camera: The camera at the resolution of the rays, pixels times ``scene.subsamples``.
        times: Instants [s] at whose nearest approach the covers are still fine enough.
    """

    def __init__(self, scene: Scene, camera: Camera, times: Float[np.ndarray, "F"]):
        self._centre = camera.centre
        static = tuple(body for body in scene.bodies if not body.moves)
        self._static: GaussianField | None = cover_still(static, camera).seen(self._centre, 0.0) if static else None
        self._moving: list[Cover] = [cover_moving(body, camera, times) for body in scene.bodies if body.moves]

    def at(self, time: float) -> GaussianField:
        """All Gaussians that face the camera at ``time`` [s]."""
        moving = [cover.seen(self._centre, time) for cover in self._moving]
        return merge([*([] if self._static is None else [self._static]), *moving])


def frame_times(sensor: Sensor, frames: int, *, sync: bool) -> Float[np.ndarray, "F"]:
    """Time of each raw frame [s]: n times the frame period, or, ``sync``, that of the first frame of its quartet."""
    frame = np.arange(frames)
    return (frame - frame % FRAMES_PER_QUARTET if sync else frame) * sensor.frame_period_s


def record(
    scene: Scene,
    *,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    sync: bool = False,
    noise: bool = True,
    flow: bool = False,
    exposure_samples: int = 1,
    progress: Progress | None = None,
) -> Recording:
    """Record ``scene``, in memory. Arguments are those of :func:`gftorf_warp.sim.simulate.simulate`.

    Raises:
        ValueError: If the sensor's contrast and DC offset contradict each other, see sim/readout.py.
    """
    frames = scene.frames if frames is None else frames
    sensor = replace(scene.sensor, noise=noise and scene.sensor.noise)
    camera = scene.camera(size)
    fine = camera.resized(camera.width * scene.subsamples, camera.height * scene.subsamples)
    times = frame_times(sensor, frames, sync=sync)
    hits = [first_hit(scene.bodies, camera, float(time)) for time in times]
    interior = still_interior(scene, hits)
    longest = frame_times(sensor, max(frames, scene.frames), sync=False)
    splatted = Splatted(scene, fine, longest)  # the same covers for fewer frames, hence the same images
    shifts = np.array([sensor.shifts[n % len(sensor.shifts)] for n in range(frames)])

    quads = np.zeros((frames, camera.height, camera.width), dtype=np.float32)
    largest, total, full = 0.0, 0.0, 0
    for n in range(frames):
        offsets = ((np.arange(exposure_samples) + 0.5) / exposure_samples - 0.5) * sensor.exposure_s
        shot = sensor.with_shifts((float(shifts[n]),))
        looks = [_look(splatted.at(float(times[n] + offset)), fine, shot, scene.subsamples) for offset in offsets]
        quad, amplitude, distance = (np.mean(image, axis=0) for image in zip(*looks, strict=True))
        reading = read_out(quad, amplitude, sensor, np.random.default_rng((seed, n)))  # frame n: whatever F is
        quads[n] = reading.quad
        full += int(reading.saturated.sum())
        difference = np.abs(distance - hits[n].distance)[interior]
        total += float(difference.sum())
        largest = max(largest, float(difference.max(initial=0.0)))
        if progress is not None:
            progress(n + 1, frames)

    pixels = int(interior.sum())
    forward, backward = _flows(scene, camera, hits, times) if flow else ({}, {})
    return Recording(
        sequence=Sequence(
            quads=quads,
            measured=np.ones(frames, dtype=bool),
            shifts=shifts,
            times=times,
            f_mod_hz=float(sensor.f_mod_hz),
            phase_offset=float(sensor.phase_offset),
            dc_offset=float(sensor.dc_offset),
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            camera_from_world=np.tile(camera.camera_from_world, (frames, 1, 1)),
            forward_flow=forward,
            backward_flow=backward,
        ),
        truth=Truth(
            distance=np.stack([hit.distance for hit in hits]).astype(np.float32), known=np.ones(frames, dtype=bool)
        ),
        gap=Gap(mean=total / (pixels * frames), max=largest, pixels=pixels) if pixels else None,
        saturated=full / quads.size,
    )


def render_truth_gap(scene: Scene, *, frames: int = 1, size: tuple[int, int] | None = None) -> Gap | None:
    """Renderer against analytic truth on still interior pixels of the first ``frames`` raw frames, without noise."""
    return record(scene, frames=frames, size=size, noise=False).gap


def still_interior(scene: Scene, hits: list[Hits]) -> Bool[np.ndarray, "H W"]:
    """Pixels that see the same face of a still body, with all neighbours up to two pixels away, in every raw frame."""
    moves = np.array([*(body.moves for body in scene.bodies), False])  # the last stands for -1, nothing hit
    inside = np.ones(hits[0].body.shape, dtype=bool)
    inside[:2] = inside[-2:] = inside[:, :2] = inside[:, -2:] = False
    for hit in hits:
        inside &= ~moves[hit.body] & (hit.body >= 0)
        surface = hit.body * 8 + hit.face  # a shape has fewer than 8 faces
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                inside &= np.roll(surface, (dy, dx), (0, 1)) == surface  # what wraps around the image is masked above
    return inside


def _look(field: GaussianField, camera: Camera, sensor: Sensor, subsamples: int) -> tuple[np.ndarray, ...]:
    """Mean quad, mean amplitude and mean distance over opacity of every pixel at one instant."""
    with torch.no_grad():
        rendering = rasterize(field, camera, sensor)
    rows, columns = camera.height // subsamples, camera.width // subsamples

    def pooled(image: torch.Tensor) -> np.ndarray:
        return image.double().numpy().reshape(rows, subsamples, columns, subsamples).mean((1, 3))

    return (
        pooled(rendering.quads[0]),
        pooled(rendering.phasor[2]) / 2,  # the third channel of a phasor is 2a
        pooled(rendering.distance) / pooled(rendering.opacity),
    )


def _flows(scene: Scene, camera: Camera, hits: list[Hits], times: Float[np.ndarray, "F"]) -> tuple[dict, dict]:
    """Exact optical flow at quartet starts, from n to n + 4 and to n - 4; occlusion is not looked at."""
    flows: tuple[dict, dict] = {}, {}
    starts = range(0, len(times), FRAMES_PER_QUARTET)
    for flow, step in zip(flows, (FRAMES_PER_QUARTET, -FRAMES_PER_QUARTET), strict=True):
        for n in starts:
            if 0 <= n + step < len(times):
                flow[n] = _flow(scene, camera, hits[n], float(times[n]), float(times[n + step]))
    return flows


def _flow(scene: Scene, camera: Camera, hit: Hits, time: float, later: float) -> Float[np.ndarray, "2 H W"]:
    """Where what each pixel sees at ``time`` has gone in the image at ``later`` [px]; NaN where nothing is seen."""
    moved = hit.point.copy()
    for index, body in enumerate(scene.bodies):
        if body.moves:
            seen = hit.body == index
            step = body.path.world_from_body(later) @ np.linalg.inv(body.path.world_from_body(time))
            moved[seen] = hit.point[seen] @ step[:3, :3].T + step[:3, 3]
    here, there = (camera.project(torch.from_numpy(point)).numpy() for point in (hit.point, moved))
    return np.moveaxis(there - here, -1, 0).astype(np.float32)
