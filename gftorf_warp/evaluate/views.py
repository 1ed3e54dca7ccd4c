"""Images of a finished run as arrays: those scored, and those that ``gftorf render`` writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..constants import SOURCES
from ..data import resources, temporal
from ..data.decode import Decoded, closed_form_distance, decode_quartet
from ..data.sequence import Sequence
from ..errors import DivergedError, UsageError
from ..recon.raw_frames import RawFrames
from ..recon.residuals import quad_of_shift
from ..render.api import Rendering
from ..render.series import KEPT, View, on_host
from ..scene.camera import Camera
from ..scene.measured import frame_period
from ..scene.sensor import Sensor
from . import previews, renders, stored, video, writers
from .metrics import DISTANCES, TEMPORAL, distance_from_quads, normalised
from .pictures import Scale
from .poses import middle
from .poses import read as read_poses

if TYPE_CHECKING:
    from ..recon.run import Run


RENDERED = ("quads", "phasor", "distance", "opacity", "distance_median")


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Images of the S scored raw frames, at the sequence's own resolution, float32."""

    frames: list[int]
    """The scored raw frames n."""
    d: Float[np.ndarray, "S H W"]
    """Rendered mean distance, not divided by opacity [m]."""
    opacity: Float[np.ndarray, "S H W"]
    """Rendered opacity [1]."""
    d_median: Float[np.ndarray, "S H W"]
    """Rendered median distance [m]; 0 where more than half of the light passes."""
    d_tof: Float[np.ndarray, "S H W"]
    """Distance decoded from quads rendered at the time of the frame, at every frequency, in [0,
    range) [m]."""
    closed_form: Float[np.ndarray, "S H W"]
    """Distance decoded from the measured quartet that the frame belongs to, in [0, range) [m]."""
    quad_rendered: Float[np.ndarray, "S H W"]
    """The slot that was measured, as rendered [file units]."""
    quad_measured: Float[np.ndarray, "S H W"]
    """The slot as measured [file units]."""
    single: Float[np.ndarray, "S f H W"] | None = None
    """Distance decoded from each of several frequencies alone [m]; None: there is one."""
    confidence: Float[np.ndarray, "S H W"] | None = None
    """Agreement of the frequencies on the closed form [1], see data/unwrap.py; None: there is
    one."""

    d_fit: Float[np.ndarray, "S H W"] | None = None
    """Rendered mean distance before it was corrected [m]; None: it never is."""
    source: UInt8[np.ndarray, "S H W"] | None = None
    """Where ``d`` is from, an index of ``SOURCES``; None: from the fit everywhere."""
    over_time: Mapping[str, Float[np.ndarray, "S H W"]] = field(default_factory=dict)
    """Distances by averaging the measured quartets [m], by the names of ``TEMPORAL``; empty if the
    camera moves."""

    @property
    def d_normalised(self) -> Float[np.ndarray, "S H W"]:
        """Mean distance divided by opacity [m]."""
        return normalised(self.d, self.opacity)

    @property
    def source_shares(self) -> dict[str, float] | None:
        """Share of the pixels whose distance is from each of ``SOURCES`` [1]; None: all are the
        fit's.
        """
        if self.source is None:
            return None
        return {name: float((self.source == k).mean()) for k, name in enumerate(SOURCES)}

    @property
    def distances(self) -> dict[str, Float[np.ndarray, "S H W"]]:
        """All distances that there are [m], by their names in metrics.json."""
        known = {name: getattr(self, name) for name in DISTANCES if name not in TEMPORAL}
        return {**{k: v for k, v in known.items() if v is not None}, **self.over_time}


def gather(
    run: Run,
    sequence: Sequence,
    frames: list[int],
    *,
    rendered: RawFrames | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Views:
    """Render raw frames n at their own times and poses, before a black background.

    Args:
        run: What is rendered.
        sequence: Its sequence.
        frames: The raw frames.
        rendered: ``RawFrames(run, sequence, RENDERED)``, where others have used it; None: a new
            one.
        progress: Called with (frames done, frames in all).

    Raises:
        DivergedError: If a rendering is not finite.
    """
    rendered = rendered or RawFrames(run, sequence, RENDERED)
    chosen = sorted({n // sequence.cycle for n in frames})
    decoded = {i: decode_quartet(sequence, i) for i in chosen}
    quartets = [decoded[n // sequence.cycle] for n in frames]
    images = _rendered(run, rendered, frames, progress)
    return Views(
        frames=frames,
        closed_form=np.stack([one.distance for one in quartets]).astype(np.float32),
        over_time=_over_time(sequence, frames),
        quad_measured=sequence.quads[frames],
        **_agreement(quartets),
        **images,
    )


def _rendered(
    run: Run,
    rendered: RawFrames,
    frames: list[int],
    progress: Callable[[int, int], None] | None,
) -> dict[str, np.ndarray]:
    """The fields of :class:`Views` that are rendered."""
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("d", "opacity", "d_median", "d_tof", "quad_rendered")
    }
    sequence = rendered.sequence
    first, *further = sequence.frequencies
    for count, n in enumerate(frames, start=1):
        time, camera = float(sequence.times[n]), rendered.camera_at(n)
        light = {f: rendered(n, f) for f in sequence.frequencies}
        fit, measured = light[first], light[float(sequence.frame_frequencies[n])]
        rendering = run.corrected(fit, time, camera)
        if rendering.source is not None:
            rows.setdefault("d_fit", []).append(fit.distance.cpu().numpy().copy())
            rows.setdefault("source", []).append(rendering.source.cpu().numpy())
        others = [run.corrected(light[f], time, camera, f, light_only=True).quads for f in further]
        images = {
            "d": rendering.distance,
            "opacity": rendering.opacity,
            "d_median": rendering.distance_median,
            "d_tof": distance_from_quads(rendering.quads, run.sensor, *others),
            "quad_rendered": quad_of_shift(measured, run.sensor, float(sequence.shifts[n])),
        }
        for name, image in zip(images, torch.stack([*images.values()]).cpu(), strict=True):
            rows[name].append(finite(image, f"{name} of raw frame {n}", run))
        if progress is not None:
            progress(count, len(frames))
    return {name: np.stack(images) for name, images in rows.items()}


def _over_time(sequence: Sequence, frames: list[int]) -> dict[str, Float[np.ndarray, "S H W"]]:
    """The field ``over_time`` of raw frames of complete quartets."""
    if not temporal.camera_rests(sequence):
        return {}
    averaged, rows = temporal.averaged(sequence), [n // sequence.cycle for n in frames]
    by_quartet = {i: closed_form_distance(averaged, i).astype(np.float32) for i in {*rows}}
    images = [temporal.over_time(sequence, reduce) for reduce in (np.mean, np.median)]
    images = [np.broadcast_to(image, (len(rows), *image.shape)) for image in images]
    return dict(zip(TEMPORAL, [*images, np.stack([by_quartet[i] for i in rows])], strict=True))


def _agreement(quartets: list[Decoded]) -> dict[str, Any]:
    """The fields ``single`` and ``confidence`` where there are several frequencies."""
    confidence = [one.confidence for one in quartets if one.confidence is not None]
    if len(confidence) < len(quartets):
        return {}
    single = np.stack([one.single for one in quartets]).astype(np.float32)
    return {"single": single, "confidence": np.stack(confidence).astype(np.float32)}


def camera_at(run: Run, sequence: Sequence, time: float) -> Camera:
    """The camera at the pose of the raw frame nearest to ``time`` [s]."""
    return run.camera.at(sequence.camera_from_world[_nearest_frame(sequence, time)])


def _nearest_frame(sequence: Sequence, time: float) -> int:
    return int(np.abs(sequence.times - time).argmin())


def finite(image: torch.Tensor, name: str, run: Run) -> Float[np.ndarray, "*image"]:
    """A rendered image as float32.

    Raises:
        DivergedError: If it is not finite.
    """
    array = image.detach().cpu().numpy().astype(np.float32)
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        why = f"{bad} of {array.size} rendered values are NaN or infinite"
        fix = "reconstruct again with another --seed or preset"
        raise DivergedError(f"{name} is not finite", where=run.path, why=why, fix=fix)
    return array


def render_to_folder(
    run: Run,
    out: str | Path,
    what: str | Iterable[str] = ("distance", "quads"),
    times: Iterable[float] | None = None,
    *,
    poses: str | Path | Float[np.ndarray, "M 4 4"] | None = None,
    fresh: bool = False,
    arrays: bool = False,
    plain: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a run at some times: ``OUT/<what>/<index>.exr`` (float32) and a preview ``.png``.

    Headers of EXR files state time, units and camera, see previews.py; previews have a title, a
    colour bar and at least 640 columns.

    ``OUT/renders.json`` lists the times [s], the channels with their units, the scale of the
    previews, and poses if any were given; otherwise the pose is that of the raw frame nearest to
    each time. With ``arrays``, files are ``OUT/<what>/<channel>.npy``, float32 [S, H, W] of all S
    times, with the values of the EXR files.

    Args:
        run: A finished reconstruction.
        out: Folder, made if absent; one that holds these images is written again.
        what: Names out of distance, distance_median, quads, phasor, colour.
        times: Seconds since raw frame 0; None: the times of all raw frames, once each, truncated
            quartets included; with poses, the middle of the sequence.
        poses: World-to-camera matrices, see scene/camera_paths.py, a .npy file of them [M, 4, 4] or
            [M, 3, 4], or ``novel``, those of the sequence. Image k is rendered from pose k at time
            k; the shorter list repeats.
        fresh: Whether to move other content of ``out`` to ``out/old-<k>``.
        arrays: Whether to write arrays instead of pictures; many times as fast.
        plain: Whether previews are the images alone, a pixel for each.
        progress: Called with (times done, times in all).

    Raises:
        UsageError: If a name in ``what`` is unknown, the run has no colour, there are no such poses
            or times or the run has one view only, or ``out`` holds something else.
        InputError: If the poses cannot be read.
        ResourceError: If memory or disk cannot hold the images.
    """
    names = renders.checked(what)
    sequence = run.sequence()
    seconds, cameras = views_to_take(run, sequence, times, poses)

    render = renderer_of(run, names)
    taken = list(zip(seconds, cameras, strict=True))
    samples = samples_of(render, taken, run.sensor, names)
    out, channels = Path(out), {name: list(samples[0][name]) for name in names}
    reached = run.config.get("images_optimised")
    pixels, count = run.camera.height * run.camera.width, sum(map(len, channels.values()))
    held = stored.HELD if arrays else KEPT
    need = resources.to_render(len(seconds), pixels, count, arrays=arrays, held=held)
    resources.require(need, out, "render fewer --times or less of --what")
    listed: dict[str, Any] = {"run": str(run.path), "images_optimised": reached}
    listed["times_s"] = seconds
    taken_from = None
    if poses is not None:
        taken_from = [camera.camera_from_world.tolist() for camera in cameras]
    listed |= {"camera_from_world": taken_from, "channels": channels}
    if arrays:
        listed["arrays"] = True
    else:
        scales = scales_of(samples)
        listed["preview"] = {name: asdict(scale) for name, scale in scales.items()}
    renders.prepare_folder(out, listed, fresh=fresh)
    for name in names:
        (out / name).mkdir(exist_ok=True)
    if arrays:
        series = series_of(render, taken, run.sensor, names, kept=min(stored.HELD, len(taken)))
        shape = len(seconds), *next(iter(samples[0][names[0]].values())).shape
        stored.store_all(out, channels, series, shape, progress)
    else:
        series = series_of(render, taken, run.sensor, names)
        labels = labels_of(taken, sequence, plain=plain)
        writers.write_all(out, scales, series, len(seconds), progress, labels)
    return out


def render_to_video(
    run: Run,
    path: str | Path,
    what: str | Iterable[str] = ("distance",),
    times: Iterable[float] | None = None,
    *,
    poses: str | Path | Float[np.ndarray, "M 4 4"] | None = None,
    rate_hz: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a run as a video of pictures with titles and colour bars, several kinds in a row.

    Args:
        run: A finished reconstruction.
        path: A file that ends in .webm, .mp4, .gif or .webp, replaced if it exists.
        what: As in :func:`render_to_folder`, as are ``times``, ``poses`` and what is raised.
        times: One picture each, however far apart they are.
        poses: Where from.
        rate_hz: Pictures per second; None: see ``video.rate_of``.
        progress: Called with (times done, times in all).
    """
    path, names = video.checked(path), renders.checked(what)
    sequence = run.sequence()
    taken = list(zip(*views_to_take(run, sequence, times, poses), strict=True))
    render = renderer_of(run, names)
    scales = scales_of(samples_of(render, taken, run.sensor, names))
    series = series_of(render, taken, run.sensor, names)
    pairs = zip(series, labels_of(taken, sequence), strict=True)
    pictures = (previews.picture(images, scales, label.title or "") for images, label in pairs)
    video.write_video(path, pictures, len(taken), rate_hz=rate_hz, progress=progress)
    return path


def renderer_of(run: Run, names: Iterable[str]) -> Callable[[float, Camera], Rendering]:
    """A renderer of what the named kinds of images need."""
    return run.renderer({image for name in names for image in renders.NEEDS[name]})


def samples_of(
    render: Callable[[float, Camera], Rendering],
    taken: list[View],
    sensor: Sensor,
    names: Iterable[str],
) -> list[Mapping[str, previews.Channels]]:
    """The first, the middle and the last of some views."""
    few = [taken[i] for i in sorted({0, len(taken) // 2, len(taken) - 1})]
    return list(series_of(render, few, sensor, names, kept=len(few)))


def scales_of(samples: list[Mapping[str, previews.Channels]]) -> dict[str, Scale]:
    """The scale of all pictures of each kind."""
    return {
        name: previews.preview_scale(name, [sample[name] for sample in samples])
        for name in samples[0]
    }


def labels_of(
    taken: Iterable[View], sequence: Sequence, *, plain: bool = False
) -> list[previews.Label]:
    """What is written beside the pixels of each image: attributes, and titles unless ``plain``."""
    instants, first = np.unique(sequence.times, return_index=True)
    frame_at = dict(zip(instants.tolist(), first.tolist(), strict=True))
    labels = []
    for time, camera in taken:
        frame = frame_at.get(time)
        stated = asdict(camera) | {"camera_from_world": camera.camera_from_world.tolist()}
        known: dict[str, Any] = {"time_s": time, "camera": json.dumps(stated)}
        title = f"t = {time:.4f} s"
        if frame is not None:
            known, title = known | {"raw_frame": frame}, f"{title}, raw frame {frame}"
        labels.append(previews.Label(known, None if plain else title))
    return labels


def series_of(
    render: Callable[[float, Camera], Rendering],
    views: Iterable[View],
    sensor: Sensor,
    names: Iterable[str],
    *,
    kept: int = KEPT,
) -> Iterator[Mapping[str, previews.Channels]]:
    """Channels of each view as host arrays, valid while referenced; on CUDA, rendered ahead."""
    names = list(names)
    needed = sorted({image for name in names for image in renders.NEEDS[name]})
    for images in on_host(render, views, needed, kept=kept):
        yield {name: renders.named(name, images, sensor) for name in names}


def views_to_take(
    run: Run,
    sequence: Sequence,
    times: Iterable[float] | None,
    poses: str | Path | Float[np.ndarray, "M 4 4"] | None,
) -> tuple[list[float], list[Camera]]:
    """Time [s] and camera of every image of :func:`render_to_folder`, whose arguments these are."""
    camera_poses = None if poses is None else read_poses(poses, sequence)
    default = np.unique(sequence.times) if camera_poses is None else [middle(sequence)]
    seconds = [float(t) for t in (default if times is None else times)]
    if not seconds:
        why, fix = "the list is empty", "leave --times out"
        raise UsageError("no time to render", where="--times", why=why, fix=fix)
    last = float(sequence.times[-1]) + frame_period(sequence)
    outside = [time for time in seconds if not 0 <= time <= last]
    if outside:
        why = f"the sequence tells of 0 to {last:.6g} s, nothing of {outside[0]:.6g} s"
        fix = "choose times in between, in seconds, or leave --times out"
        raise UsageError("no such time", where="--times", why=why, fix=fix)
    if camera_poses is None:
        nearest = [_nearest_frame(sequence, time) for time in seconds]
        known = {n: run.camera.at(sequence.camera_from_world[n]) for n in set(nearest)}
        return seconds, [known[n] for n in nearest]
    count = max(len(seconds), len(camera_poses))
    cameras = [run.camera.at(pose) for pose in camera_poses]
    seconds = [seconds[k % len(seconds)] for k in range(count)]
    return seconds, [cameras[k % len(camera_poses)] for k in range(count)]
