"""Record a scene: one image per raw frame, read out by the sensor, and its truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ..constants import FRAMES_PER_QUARTET
from ..data.sequence import Calibration, ColourCamera, Flow, Intrinsics, Sequence, Truth
from ..render.trace import Bounces
from ..scene.camera import Camera
from ..scene.optics import shading
from ..scene.sensor import Sensor, distance_from_phasor
from .checks import check_engine
from .exposure import Exposure
from .gaussian_engine import GaussianEngine
from .ladder import resolved
from .mesh_engine import MeshEngine, beam_is_traced, traced_albedo
from .paths import inverse
from .readout import read_out
from .rolling import rolling_hits
from .scene import Scene
from .settings import ResolvedSettings, SimSettings
from .world import Hits, first_hit, flow_of

Progress = Callable[[int, int], None]
Images = dict[str, np.ndarray]
Cached = Callable[[str, Callable[[], Images]], tuple[Images, bool]]
"""Images of a name, computed now or before an interruption, and whether computed now."""

LAYER = "layer "  # begins the names of layers among the images of a raw frame
LIGHT = ("direct", "error", "phasor")  # layers that the lens weakens, up to the harmonic in a name
COLOUR = 3  # part of the seed of the colour camera's noise


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Distance of the engine against the truth, over interior pixels of still bodies.

    Engine gaussian has a mean distance, divided by opacity; engine mesh has a first hit.
    """

    mean: float
    """Mean of the absolute difference [m]."""
    max: float
    """Largest absolute difference [m]."""
    pixels: int
    """Number of interior pixels in the image; the mean over raw frames if the camera moves."""

    def __str__(self) -> str:
        mean, most = 1e3 * self.mean, 1e3 * self.max
        return f"mean {mean:.1f} mm, max {most:.1f} mm over {self.pixels} pixels"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What :func:`record` returns."""

    sequence: Sequence
    """As a camera would have recorded it."""
    truth: Truth
    """Analytic distance along each pixel's centre ray at the time of each raw frame; the distance
    that a sensor without noise would decode if nothing moved; amplitude; visible body; layers of a
    capture."""
    gap: Gap | None
    """Engine against truth on still interior pixels; None if no such pixel exists."""
    saturated: float
    """Share of pixels and raw frames in which a tap or the ADC was full [1]."""


def frame_times(sensor: Sensor, frames: int, *, sync: bool) -> Float[np.ndarray, "F"]:
    """Time of each raw frame [s]; with ``sync``, that of the first frame of its cycle."""
    frame = np.arange(frames)
    return (frame - frame % len(sensor.cycle) if sync else frame) * sensor.frame_period_s


def sequence_fields(
    sensor: Sensor, times: Float[np.ndarray, "F"], cameras: list[Camera], **settings: Any
) -> dict[str, Any]:
    """Fields of a sequence by its sensor, with more ``settings``, times [s] and ToF cameras."""
    shots = [sensor.at_frame(n) for n in range(len(times))]
    frequencies = np.array([float(shot.f_mod_hz) for shot in shots])
    return {
        "intrinsics": _intrinsics(cameras[0]),
        "calibration": Calibration(
            f_mod_hz=float(sensor.f_mod_hz),
            phase_offset=float(sensor.phase_offset),
            dc_offset=float(sensor.dc_offset),
            adc_zero=sensor.adc_zero,
            cycle_length=None if len(sensor.cycle) == FRAMES_PER_QUARTET else len(sensor.cycle),
            settings=settings,
        ),
        "camera_from_world": np.stack([camera.camera_from_world for camera in cameras]),
        "shifts": np.array([shot.shifts[0] for shot in shots]),
        "times": times,
        "frequencies_hz": frequencies if sensor.further_hz else None,
    }


def _intrinsics(camera: Camera) -> Intrinsics:
    lens = astuple(camera.distortion) if camera.distortion else None
    return Intrinsics(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, distortion=lens)


def record(
    scene: Scene,
    settings: SimSettings = SimSettings(),
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    cached: Cached | None = None,
    **changes: Any,
) -> Recording:
    """Record ``scene``, in memory; all of ``settings`` apply but the layout on disk.

    Every raw frame depends on its number and on the settings alone, so that ``cached`` may return
    images of an interrupted recording, see sim/resume.py. Arguments as for ``simulate``.

    Raises:
        UsageError: If the settings contradict each other or the scene.
        ValueError: If the sensor's contrast and DC offset contradict each other.
    """
    scene, settings = resolved(scene, replace(settings, **changes))
    check_engine(scene, settings, device)
    cached = cached or _computed
    sensor = replace(scene.sensor, noise=settings.noise and scene.sensor.noise)
    times = frame_times(sensor, settings.frames or scene.frames, sync=settings.sync)
    cameras = [scene.camera(settings.size, float(time)) for time in times]
    distances, bodies, interior = _truth(scene, settings, times)
    expose = _exposing(scene, settings, sensor, times, device)
    images: Images = {}
    for n in range(len(times)):
        one, computed = cached(f"frame-{n:06d}", partial(expose, n))
        for name, image in one.items():
            images.setdefault(name, np.zeros((len(times), *image.shape), image.dtype))[n] = image
        if progress is not None and (computed or n + 1 == len(times)):
            progress(n + 1, len(times))
    views = [inverse(view.world_from_body(0.0)) for view in scene.novel_views]
    layers = {n.removeprefix(LAYER): image for n, image in images.items() if n.startswith(LAYER)}
    return Recording(
        sequence=Sequence(
            quads=images["quad"],
            measured=np.ones(len(times), dtype=bool),
            **sequence_fields(sensor, times, cameras, **sensor_settings(sensor)),
            novel_from_world=np.stack(views) if views else None,
            flow=_flows(scene, cameras, times) if settings.flow else Flow(),
            exposures=np.full(len(times), sensor.exposure_s) if sensor.exposure_s else None,
            tap_sums=dict(enumerate(images["tap_sum"])) if settings.taps else {},
            colour=_colour(scene, settings, times, cached),
        ),
        truth=Truth(
            distance=distances.astype(np.float32),
            known=np.ones(len(times), dtype=bool),
            phasor_distance=images["phasor_distance"],
            amplitude=images["amplitude"],
            body=bodies,
            layers=layers,
        ),
        gap=_gap(images["distance"], distances, interior),
        saturated=int(images["saturated"].sum()) / images["quad"].size,
    )


def _computed(_: str, compute: Callable[[], Images]) -> tuple[Images, bool]:
    return compute(), True


def longest_times(scene: Scene, settings: ResolvedSettings) -> Float[np.ndarray, "F"]:
    """Times [s] of the scene's own raw frames, and of all that are recorded if those are more.

    Covers are fine enough for all of them, so that a shorter recording has the same images.
    """
    return frame_times(scene.sensor, max(settings.frames or 0, scene.frames), sync=False)


def _exposing(
    scene: Scene,
    settings: ResolvedSettings,
    sensor: Sensor,
    times: Float[np.ndarray, "F"],
    device: str,
) -> Callable[[int], Images]:
    """A function that makes the images of a raw frame."""
    camera_at = partial(scene.camera, settings.size)
    evenness = shading(scene.lens, camera_at(0.0), beam=not beam_is_traced(scene, settings.bounces))
    samples = settings.exposure_samples
    offsets = ((np.arange(samples) + 0.5) / samples - 0.5) * sensor.exposure_s
    engine: MeshEngine | GaussianEngine
    if settings.engine == "gaussian":
        engine = GaussianEngine(scene, _fine(camera_at, scene), longest_times(scene, settings))
    else:
        engine = MeshEngine(
            scene,
            camera_at,
            harmonics=scene.sensor.harmonics,
            bounces=Bounces(count=settings.bounces, paths=settings.paths),
            device=device,
            seed=settings.seed,
            truth=settings.truth if settings.format == "capture" else None,
        )

    def expose(n: int) -> Images:
        shot, time = sensor.at_frame(n), float(times[n])
        exposure = engine.expose(n, [float(times[n] + offset) for offset in offsets], time, shot)
        random = np.random.default_rng((settings.seed, n))  # independent of the number of frames
        light = exposure.quad, exposure.amplitude
        reading = read_out(
            *light,
            shot,
            random,
            ambient=exposure.ambient,
            shading=evenness,
            taps=settings.taps,
        )
        seen = np.float32(1.0) if evenness is None else evenness.active.astype(np.float32)
        layers = {
            f"{LAYER}{name}": image * seen if name.partition(".")[0] in LIGHT else image
            for name, image in (exposure.layers or {}).items()
        }
        return {
            "quad": reading.quad,
            **({} if reading.total is None else {"tap_sum": reading.total}),
            "saturated": reading.saturated.sum(),
            "amplitude": exposure.amplitude.astype(np.float32) * seen,
            "distance": exposure.distance,
            "phasor_distance": _static_distance(exposure, shot),
            **layers,
        }

    return expose


def _fine(camera_at: Callable[[float], Camera], scene: Scene) -> Callable[[float], Camera]:
    """A camera at a time [s] at the resolution of the rays."""
    return lambda time: camera_at(time).finer(scene.subsamples)


def _static_distance(exposure: Exposure, sensor: Sensor) -> Float[np.ndarray, "H W"]:
    """Closed-form distance [m] in [0, c/2f), of all light, without harmonics; NaN without light."""
    phasor = torch.from_numpy(np.asarray(exposure.phasor, dtype=np.complex128))
    distance = distance_from_phasor(phasor.real, phasor.imag, sensor).numpy()
    return np.where(np.abs(exposure.phasor) > 0, distance, np.nan).astype(np.float32)


def sensor_settings(sensor: Sensor) -> dict[str, Any]:
    """Every field of a sensor by name, as numbers and lists for files."""
    plain: dict[str, Any] = {f.name: getattr(sensor, f.name) for f in fields(sensor)}
    for name, value in plain.items():
        if isinstance(value, tuple):
            plain[name] = [float(item) for item in value]
        elif isinstance(value, torch.Tensor):
            plain[name] = value.item()
        elif value == math.inf:  # JSON has no such number
            plain[name] = "inf"
    return plain | {"pattern": asdict(sensor.pattern)}


def still_interior(scene: Scene, hits: list[Hits]) -> Bool[np.ndarray, "H W"]:
    """Pixels that see the same face of a still body as all neighbours up to two pixels away."""
    # the last is index -1, nothing hit
    moves = np.array([*(body.moves for body in scene.bodies), False])
    inside = np.ones(hits[0].body.shape, dtype=bool)
    inside[:2] = inside[-2:] = inside[:, :2] = inside[:, -2:] = False
    for hit in hits:
        inside &= ~moves[hit.body] & (hit.body >= 0)
        surface = hit.body * (hit.face.max() + 1) + hit.face
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                # the wrapped border is masked above
                inside &= np.roll(surface, (dy, dx), (0, 1)) == surface
    return inside


def _truth(
    scene: Scene, settings: ResolvedSettings, times: Float[np.ndarray, "F"]
) -> tuple[Float[np.ndarray, "F H W"], Int[np.ndarray, "F H W"], Bool[np.ndarray, "F H W"]]:
    """Distance [m], body and still interior of every raw frame."""
    camera_at, height = partial(scene.camera, settings.size), scene.camera(settings.size).height
    images = []  # the rest of the hits is large
    for time in times.tolist():
        hit = rolling_hits(scene.bodies, camera_at, time, scene.sensor, height)
        images.append((hit.distance, hit.body.astype(np.int16), still_interior(scene, [hit])))
    distance, body, inside = (np.stack(each) for each in zip(*images, strict=True))
    inside = inside if scene.camera_moves else np.broadcast_to(inside.all(axis=0), inside.shape)
    return distance, body, inside


def _gap(
    distance: Float[np.ndarray, "F H W"],
    truth: Float[np.ndarray, "F H W"],
    interior: Bool[np.ndarray, "F H W"],
) -> Gap | None:
    difference = np.abs(distance[interior] - truth[interior])
    if not len(difference):
        return None
    pixels = round(len(difference) / len(truth))
    return Gap(mean=float(difference.mean()), max=float(difference.max()), pixels=pixels)


def _colour(
    scene: Scene, settings: ResolvedSettings, times: Float[np.ndarray, "F"], cached: Cached
) -> ColourCamera:
    """The colour camera: an image at every quartet start, and its poses."""
    if scene.colour is None:
        return ColourCamera()
    noise = scene.colour.noise
    camera_at = partial(scene.colour_camera, settings.size)
    cameras = [camera_at(float(time)) for time in times]
    albedo_at = lambda time: traced_albedo(scene, camera_at(time), time)  # noqa: E731
    if settings.engine == "gaussian":
        longest = longest_times(scene, settings)
        albedo_at = GaussianEngine(scene, _fine(camera_at, scene), longest, colour=True).albedo

    def expose(n: int) -> Images:
        image = albedo_at(float(times[n]))
        if settings.noise:
            random = np.random.default_rng((settings.seed, n, COLOUR))
            image = image + random.normal(0.0, noise, image.shape)
        return {"colour": image.astype(np.float32)}

    starts = range(0, len(times), len(scene.sensor.cycle))
    return ColourCamera(
        images={n: cached(f"colour-{n:06d}", partial(expose, n))[0]["colour"] for n in starts},
        intrinsics=_intrinsics(cameras[0]),
        camera_from_world=np.stack([camera.camera_from_world for camera in cameras]),
    )


def _flows(scene: Scene, cameras: list[Camera], times: Float[np.ndarray, "F"]) -> Flow:
    """Exact optical flow at quartet starts, from n to n + K and n - K, occluded or not.

    It is what an estimate from images would give: motion of the scene and of the camera together.
    """
    cycle = len(scene.sensor.cycle)
    flows = Flow()
    for n in range(0, len(times), cycle):
        hit = first_hit(scene.bodies, cameras[n], float(times[n]))
        for images, m in ((flows.forward, n + cycle), (flows.backward, n - cycle)):
            if 0 <= m < len(times):
                pair, instants = (cameras[n], cameras[m]), (float(times[n]), float(times[m]))
                flow = flow_of(scene.bodies, hit.point, hit.body, pair, instants)
                images[n] = flow.astype(np.float32)
    return flows
