"""Point the camera at a scene: one image per raw frame, read out by the sensor; beside it the analytic truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ..constants import FRAMES_PER_QUARTET
from ..data.sequence import Sequence, Truth
from ..render.trace import Bounces
from ..scene.camera import Camera
from ..scene.optics import shading
from ..scene.sensor import Sensor, distance_from_phasor
from .assembly import has_mesh
from .layers import TRUTHS, layers
from .look import Look, Splatted, look, look_colour
from .paths import inverse
from .readout import mean_quad, read_out
from .rolling import rolling_hits, take_rolling
from .scene import Scene
from .traced import Traced, lights_itself, trace_colour
from .world import Hits, first_hit, flow_of

Progress = Callable[[int, int], None]
Images = dict[str, np.ndarray]
Keep = Callable[[str, Callable[[], Images]], tuple[Images, bool]]
"""Images of a name, made now or kept from an interrupted recording, and whether they were made now."""

ENGINES = ("gaussian", "mesh")
"""Ways from a scene to an image: splats that cover it, or rays through its surfaces."""

LAYER = "layer "  # begins the names of layers among the images of a raw frame
PATHS = 7  # tells the random numbers of paths from those of the read-out and of the colour camera


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Distance as the engine sees it against the analytic truth, over interior pixels of still bodies.

    Splats have a mean distance, divided by opacity; rays have a first hit.
    """

    mean: float
    """Mean of the absolute difference [m]."""
    max: float
    """Largest absolute difference [m]."""
    pixels: int
    """Number of interior pixels in the image; their mean over all raw frames if the camera moves."""

    def __str__(self) -> str:
        return f"mean {1e3 * self.mean:.1f} mm, max {1e3 * self.max:.1f} mm over {self.pixels} pixels"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What :func:`record` returns."""

    sequence: Sequence
    """As a camera would have recorded it."""
    truth: Truth
    """Analytic distance along each pixel's centre ray at the time of each raw frame; what a sensor without noise would
    decode if nothing moved; amplitude; which body is seen."""
    gap: Gap | None
    """Engine against truth on still interior pixels; None if no such pixel exists."""
    saturated: float
    """Share of pixels and raw frames in which a tap or the ADC was full [1]."""


def frame_times(sensor: Sensor, frames: int, *, sync: bool) -> Float[np.ndarray, "F"]:
    """Time of each raw frame [s]: n times the frame period, or, ``sync``, that of the first frame of its cycle."""
    frame = np.arange(frames)
    return (frame - frame % len(sensor.cycle) if sync else frame) * sensor.frame_period_s


def seen_by(cameras: list[Camera]) -> dict[str, Any]:
    """The fields of a sequence that say how its ToF camera looks, the same in all raw frames, and where it is."""
    camera = cameras[0]
    return {
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        "distortion": astuple(camera.distortion) if camera.distortion else None,
        "camera_from_world": np.stack([camera.camera_from_world for camera in cameras]),
    }


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
    engine: str = "gaussian",
    bounces: int = 0,
    paths: int = 64,
    device: str = "cpu",
    truth: str | None = None,
    progress: Progress | None = None,
    keep: Keep | None = None,
) -> Recording:
    """Record ``scene``, in memory. Arguments are those of :func:`gftorf_warp.sim.simulate.simulate`.

    ``truth`` None is neither of its amounts: no layers, for layouts that have no place for them.

    Every raw frame depends on its number and on the settings alone, so that it may as well come from an interrupted
    recording: ``keep`` decides, see sim/unfinished.py; None makes all of them.

    Raises:
        ValueError: If the sensor's contrast and DC offset contradict each other, see sim/readout.py; if there is no
            such engine, or it cannot make the light that is asked for.
    """
    frames = scene.frames if frames is None else frames
    keep = keep or _made_now
    sensor = replace(scene.sensor, noise=noise and scene.sensor.noise)
    times = frame_times(sensor, frames, sync=sync)
    cameras = [scene.camera(size, float(time)) for time in times]
    camera = cameras[0]
    distances, bodies, interior = _truth(scene, size, cameras, times)
    longest = frame_times(sensor, max(frames, scene.frames), sync=False)  # for fewer frames the same covers and images
    evenness = shading(scene.lens, camera, beam=not lights_itself(scene, bounces))
    take = _engine(engine, scene, size, longest, Bounces(count=bounces, paths=paths), device, seed, truth)
    shots = [sensor.at_frame(n) for n in range(frames)]
    offsets = ((np.arange(exposure_samples) + 0.5) / exposure_samples - 0.5) * sensor.exposure_s

    def expose(n: int) -> Images:
        seen = take(n, [float(times[n] + offset) for offset in offsets], float(times[n]), shots[n])
        random = np.random.default_rng((seed, n))  # frame n: whatever F is
        reading = read_out(seen.quad, seen.amplitude, shots[n], random, ambient=seen.ambient, shading=evenness)
        return {
            "quad": reading.quad,
            "saturated": reading.saturated.sum(),
            "amplitude": seen.amplitude.astype(np.float32),
            "distance": seen.distance,
            "phasor_distance": _static_distance(seen, shots[n]),
            **{f"{LAYER}{name}": image for name, image in (seen.layers or {}).items()},
        }

    quads, phasor_distances, amplitudes = (np.zeros(distances.shape, dtype=np.float32) for _ in range(3))
    more: dict[str, np.ndarray] = {}
    largest, total, full = 0.0, 0.0, 0
    for n in range(frames):
        images, made = keep(f"frame-{n:06d}", partial(expose, n))
        quads[n], amplitudes[n], phasor_distances[n] = (images[k] for k in ("quad", "amplitude", "phasor_distance"))
        for name in (name for name in images if name.startswith(LAYER)):
            stack = more.setdefault(name.removeprefix(LAYER), np.zeros((frames, *images[name].shape), np.float32))
            stack[n] = images[name]
        full += int(images["saturated"])
        difference = np.abs(images["distance"] - distances[n])[interior[n]]
        total += float(difference.sum())
        largest = max(largest, float(difference.max(initial=0.0)))
        if progress is not None and (made or n + 1 == frames):
            progress(n + 1, frames)

    pixels = int(interior.sum())
    forward, backward = _flows(scene, cameras, times) if flow else ({}, {})
    return Recording(
        sequence=Sequence(
            quads=quads,
            measured=np.ones(frames, dtype=bool),
            shifts=np.array([shot.shifts[0] for shot in shots]),
            times=times,
            f_mod_hz=float(sensor.f_mod_hz),
            frequencies_hz=np.array([float(shot.f_mod_hz) for shot in shots]) if sensor.further_hz else None,
            cycle_length=None if len(sensor.cycle) == FRAMES_PER_QUARTET else len(sensor.cycle),
            phase_offset=float(sensor.phase_offset),
            dc_offset=float(sensor.dc_offset),
            **seen_by(cameras),
            novel_from_world=np.stack([inverse(view.world_from_body(0.0)) for view in scene.novel_views])
            if scene.novel_views
            else None,
            forward_flow=forward,
            backward_flow=backward,
            exposures=np.full(frames, sensor.exposure_s),
            sensor=sensor_settings(sensor),
            **_colour(scene, size, times, longest, engine, keep, seed=seed, noise=noise),
        ),
        truth=Truth(
            distance=distances.astype(np.float32),
            known=np.ones(frames, dtype=bool),
            phasor_distance=phasor_distances,
            amplitude=amplitudes,
            body=bodies,
            layers=more,
        ),
        gap=Gap(mean=total / pixels, max=largest, pixels=round(pixels / frames)) if pixels else None,
        saturated=full / quads.size,
    )


def _engine(
    engine: str,
    scene: Scene,
    size,
    longest: Float[np.ndarray, "F"],
    bounces: Bounces,
    device: str,
    seed: int,
    truth: str | None,
) -> Callable[[int, list[float], float, Sensor], Look]:
    """What takes an image: a function of a raw frame's number, the instants it averages, its time, and the sensor."""
    if engine not in ENGINES:
        raise ValueError(f"engine {engine!r} must be one of {', '.join(ENGINES)}")
    if engine == "mesh":
        traced = Traced(
            scene,
            lambda time: scene.camera(size, time),
            harmonics=scene.sensor.harmonics,
            bounces=bounces,
            device=device,
            rolls=scene.sensor.row_time_s > 0,
        )

        def trace(n: int, instants: list[float], time: float, sensor: Sensor, row: int | None = None) -> Look:
            numbers = (seed, n, PATHS) if row is None else (seed, n, PATHS, row)  # frame n: whatever F is
            random = int(np.random.default_rng(numbers).integers(2**31))
            mean = traced.light(instants, float(sensor.f_mod_hz), random, row=row)
            still = mean if instants == [time] else traced.light([time], float(sensor.f_mod_hz), random, row=row)
            quad, amplitude = mean_quad(mean.light, mean.amplitude, sensor)
            phasor = still.light[0] * np.exp(1j * float(sensor.phase_offset))
            hits = traced.first_hits(time, row=row)
            known = None if truth is None else layers(mean, hits, sensor, truth, bounced=bounces.count > 0)
            return Look(quad, amplitude, hits.distance, phasor, mean.ambient, known)

        if scene.sensor.row_time_s > 0:
            return partial(take_rolling, trace, height=scene.camera(size, 0.0).height)
        return trace
    if scene.sensor.row_time_s > 0:
        raise ValueError(f"row_time_s {scene.sensor.row_time_s} needs engine 'mesh': {engine!r} has one time per image")
    if needs_mesh(scene, bounces.count):
        raise ValueError(
            f"emitter {scene.emitter}, beam_deg {scene.beam_deg} and {bounces.count} bounces need engine 'mesh': "
            f"{engine!r} has direct light at the camera only, no gloss, and no mesh that moves"
        )
    if truth == TRUTHS[-1]:
        raise ValueError(f"truth {truth!r} needs engine 'mesh': {engine!r} has no layers")
    splatted = Splatted(scene, lambda time: _fine(scene.camera(size, time), scene), longest)

    def render(n: int, instants: list[float], time: float, sensor: Sensor) -> Look:
        del n
        looks = [look(splatted, instant, sensor, scene.subsamples) for instant in instants]
        still = looks[0] if instants == [time] else look(splatted, time, sensor, scene.subsamples)
        quad, amplitude, distance = (np.mean(images, axis=0) for images in list(zip(*looks, strict=True))[:3])
        return Look(quad, amplitude, distance, still.phasor)

    return render


def _made_now(name: str, make: Callable[[], Images]) -> tuple[Images, bool]:
    del name
    return make(), True


def _static_distance(seen: Look, sensor: Sensor) -> Float[np.ndarray, "H W"]:
    """What a closed form decodes from four quads taken at once without noise [m], float32; NaN where there is no light.

    In [0, c/2f): all light that reaches the pixel is in it, also what bounced. Harmonics of a sensor are not.
    """
    phasor = torch.from_numpy(np.asarray(seen.phasor, dtype=np.complex128))
    distance = distance_from_phasor(phasor.real, phasor.imag, sensor).numpy()
    return np.where(np.abs(seen.phasor) > 0, distance, np.nan).astype(np.float32)


def sensor_settings(sensor: Sensor) -> dict[str, Any]:
    """Every number of a sensor by name, for files: what a reader can check a result against."""
    plain: dict[str, Any] = {}
    for f in fields(sensor):
        value = getattr(sensor, f.name)
        if is_dataclass(value):
            plain[f.name] = {part.name: getattr(value, part.name) for part in fields(value)}
        elif isinstance(value, tuple):
            plain[f.name] = [float(item) for item in value]
        else:
            plain[f.name] = value.item() if isinstance(value, torch.Tensor) else value
    return plain


def needs_mesh(scene: Scene, bounces: int) -> bool:
    """Whether splats cannot do it: a lamp away from the camera, a beam, bounces, gloss, a mesh that moves."""
    bodies = any(body.texture.gloss > 0 or (body.moves and has_mesh(body.shape)) for body in scene.bodies)
    return bodies or any(scene.emitter) or scene.beam_deg is not None or bounces > 0


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
        surface = hit.body * (hit.face.max() + 1) + hit.face
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                inside &= np.roll(surface, (dy, dx), (0, 1)) == surface  # what wraps around the image is masked above
    return inside


def _fine(camera: Camera, scene: Scene) -> Camera:
    """The camera at the resolution of the rays."""
    return camera.resized(camera.width * scene.subsamples, camera.height * scene.subsamples)


def _truth(
    scene: Scene, size, cameras: list[Camera], times: Float[np.ndarray, "F"]
) -> tuple[Float[np.ndarray, "F H W"], Int[np.ndarray, "F H W"], Bool[np.ndarray, "F H W"]]:
    """Distance [m] and body of every raw frame, and its still interior: one for all raw frames of a camera at rest."""
    distances, bodies, interior = [], [], []
    for camera, time in zip(cameras, times, strict=True):
        if scene.sensor.row_time_s > 0:
            camera_at = partial(scene.camera, size)
            hit = rolling_hits(scene.bodies, camera_at, float(time), scene.sensor, camera.height)
        else:
            hit = first_hit(scene.bodies, camera, float(time))
        distances.append(hit.distance)
        bodies.append(hit.body.astype(np.int16))
        interior.append(still_interior(scene, [hit]))
    inside = np.stack(interior)
    inside = inside if scene.camera_moves else np.broadcast_to(inside.all(axis=0), inside.shape)
    return np.stack(distances), np.stack(bodies), inside


def _colour(scene: Scene, size, times, longest, engine: str, keep: Keep, *, seed: int, noise: bool) -> dict[str, Any]:
    """The fields of a sequence that a colour camera fills: an image at every quartet start, and its poses."""
    if scene.colour is None:
        return {}
    spread = scene.colour.noise
    cameras = [scene.colour_camera(size, float(time)) for time in times]
    if engine == "gaussian":
        splatted = Splatted(scene, lambda time: _fine(scene.colour_camera(size, time), scene), longest, colour=True)

    def expose(n: int) -> Images:
        if engine == "gaussian":
            image = look_colour(splatted, float(times[n]), scene.subsamples)
        else:
            image = trace_colour(scene, cameras[n], float(times[n]))
        if noise:
            image = image + np.random.default_rng((seed, n, 3)).normal(0.0, spread, image.shape)
        return {"colour": image.astype(np.float32)}

    starts = range(0, len(times), len(scene.sensor.cycle))
    images = {n: keep(f"colour-{n:06d}", partial(expose, n))[0]["colour"] for n in starts}
    first = cameras[0]
    return {
        "colour": images,
        "colour_intrinsics": (first.fx, first.fy, first.cx, first.cy),
        "colour_from_world": np.stack([camera.camera_from_world for camera in cameras]),
    }


def _flows(scene: Scene, cameras: list[Camera], times: Float[np.ndarray, "F"]) -> tuple[dict, dict]:
    """Exact optical flow at quartet starts, from n to n + K and to n - K; occlusion is not looked at.

    It is what an estimate from images would give: motion of the scene and of the camera together.
    """
    flows: tuple[dict, dict] = {}, {}
    cycle = len(scene.sensor.cycle)
    starts = range(0, len(times), cycle)
    for flow, step in zip(flows, (cycle, -cycle), strict=True):
        for n in starts:
            if 0 <= n + step < len(times):
                flow[n] = _flow(scene, cameras[n], cameras[n + step], float(times[n]), float(times[n + step]))
    return flows


def _flow(scene: Scene, camera: Camera, other: Camera, time: float, later: float) -> Float[np.ndarray, "2 H W"]:
    """Where what ``camera`` sees at ``time`` is in the image of ``other`` at ``later`` [px]; NaN: nothing is seen."""
    hit = first_hit(scene.bodies, camera, time)
    return flow_of(scene.bodies, hit.point, hit.body, (camera, other), (time, later)).astype(np.float32)
