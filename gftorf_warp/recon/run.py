"""A reconstruction to look at: its Gaussians and their motion at any time,
in the units of the sequence.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import gc
import logging
import math
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..data.sequence import Sequence
from ..data.synchronised import synchronised
from ..data.temporal import averaged
from ..errors import InputError
from ..render.api import Rendering, rasterize
from ..render.buffers import RenderSettings
from ..render.inputs import DIFFERENTIABLE
from ..render.replay import Replay
from ..render.series import on_host
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion, Still
from ..scene.sensor import Sensor
from . import checkpoint, closed_form, edits, outlines, source
from .fallback import Fallback
from .joined import Joined, Window, folder_of, refused
from .read_back import read_back, render_settings
from .residuals import Residuals, residuals
from .settings import FlowSource, Method
from .state import field_and_motion
from .volume.models import volume_from_dict
from .volume.render import rendering_of
from .volume.settings import settings_of
from .volume.volume import Volume

LOG = logging.getLogger("gftorf_warp")


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What :func:`gftorf_warp.reconstruct` returns, and what is found again in its folder."""

    path: Path
    """The folder of the run."""
    config: dict
    """Content of ``config.json``."""
    camera: Camera
    """The camera of raw frame 0 at the sequence's own resolution."""
    sensor: Sensor
    """The sensor, with the four canonical shifts, at all its frequencies."""
    quad_scale: float
    """The sequence's units times this are those of the optimisation."""
    field: GaussianField
    """The Gaussians where nothing has moved, in the units of the optimisation."""
    motion: Motion
    """Where they are at which time."""
    binding: Float[Tensor, "N M"] = dataclasses.field(repr=False)
    """How each Gaussian hangs on the motion."""

    @classmethod
    def open(cls, path: str | Path, device: torch.device | str = "cpu") -> Run:
        """Read a run from its folder: config and newest checkpoint. A run of the methods ``ctof``,
        ``temporal`` and ``flow2d`` needs no checkpoint.

        Raises:
            InputError: If the folder is no run, or holds no checkpoint that can be read and whose
            Gaussians and motion are finite.
        """
        path = Path(path)
        found = read_back(path)
        config, camera, sensor = found.config, found.camera, found.sensor
        if config.get("windows"):
            return WindowedRun.of_windows(path, config, camera, sensor, device)
        kinds = {Method.CTOF: ClosedForm, Method.TEMPORAL: Temporal, Method.FLOW2D: Flow2D}
        method = Method(config["settings"].get("method", Method.GAUSSIANS))
        if (kind := kinds.get(method)) is not None:
            return kind.of(path, config, camera, sensor, device)
        stored = checkpoint.last(path, device)
        if stored is None:
            raise InputError(
                "the run has no checkpoint",
                where=path,
                why="nothing was reconstructed yet",
                fix="run `gftorf reconstruct` with this --out first",
            )
        reached = {"images_optimised": stored["images"], "seconds_reconstruct": stored["seconds"]}
        damaged = [newer.name for newer in checkpoint.after(path, stored["images"])]
        if damaged:
            reached["damaged_checkpoints"] = damaged
        config = config | reached  # of an interrupted run, config.json does not say
        if method.is_volume:
            known = settings_of(config["settings"]["volume"])
            volume = volume_from_dict(path, method, known, stored, device)
            return VolumeRun.of(path, config, camera, sensor, device, volume=volume)
        with checkpoint.rebuilding(path):
            gaussians, motion, binding = field_and_motion(stored, device)
        edits.check_finite(path, gaussians, motion)
        return cls(
            path=path,
            config=config,
            camera=camera,
            sensor=sensor,
            quad_scale=config["quad_scale"],
            field=gaussians,
            motion=motion,
            binding=binding,
        )

    def edited(self, field: GaussianField, rows: Int[Tensor, "N"] | None = None) -> Run:
        """This run with other Gaussians under its motion, for example a selection of its own.

        Args:
            field: In the units of the optimisation, with the tensors of ``self.field``.
            rows: Which of this run's Gaussians each of them moves like; None: as many, in order.

        Raises:
            ValueError: If the field or ``rows`` does not fit, or something is not finite.
        """
        binding = edits.binding_of(field, rows, self.field, self.motion, self.binding)
        return replace(self, field=field, binding=binding)

    def save(self, out: str | Path) -> Run:
        """Store this run, edited or not, in a new or empty folder, and open it there.

        Its config.json names the folder it is from. `gftorf reconstruct` goes on with it if it is
        asked for more images; the moments of Adam begin at zero.

        Raises:
            InputError: If the folder of the run has no checkpoint any more.
            UsageError: If ``out`` is not empty or cannot be written.
            ResourceError: If the disk is full.
        """
        out = Path(out)
        edits.save(self.path, out, self.config, self.field, self.motion, self.binding)
        return Run.open(out, self.field.device)

    @property
    def gaussians(self) -> int:
        """Number N of Gaussians."""
        return len(self.field)

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.field.colour_sh is not None

    @property
    def colour_scale(self) -> float:
        """The units of the sequence's colour images times this are those of the optimisation."""
        return float(self.config.get("colour_scale") or 1.0)

    @torch.no_grad()
    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "N D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """What the sensor would see at one instant, before black.

        With the settings ``fallback`` and ``outlines``, the distance is that of the measurement
        where this knows better, and of one of two surfaces in mixed pixels, which ``source``
        states.

        Quads (of the four canonical shifts) and phasor are in the units of the sequence, colour in
        those of its colour images, distances in metres. No gradients. Before the first raw frame
        and beyond the last quartet everything stays as it was there.

        Args:
            time: Seconds since raw frame 0, any number.
            camera: Where from, and how many pixels; None is the sequence's own.
            extra: More channels per Gaussian, composited like colour.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.
        """
        camera = camera or self.camera
        rendering = rasterize(
            self.widened(self.field.moved(*self.motion.at(self.binding, time)), camera),
            camera,
            self._at(f_mod_hz),
            self.render_settings,
            extra=extra,
        )
        rendering = replace(
            rendering,
            quads=rendering.quads / self.quad_scale,
            phasor=rendering.phasor / self.quad_scale,
            colour=None if rendering.colour is None else rendering.colour / self.colour_scale,
        )
        return self.corrected(rendering, time, camera, f_mod_hz)

    def corrected(
        self, rendering: Rendering, time: float, camera: Camera, f_mod_hz: float | None = None
    ) -> Rendering:
        """A rendering, with its phasor, after the settings ``fallback`` and ``outlines``."""
        if self.fallback is not None:
            rendering = self.fallback.applied(rendering, time, camera)
        if self.config["settings"].get("outlines"):
            rendering = outlines.resolved(rendering, self._at(f_mod_hz))
        return rendering

    def _at(self, f_mod_hz: float | None) -> Sensor:
        return (
            self.sensor
            if f_mod_hz is None
            else replace(self.sensor, f_mod_hz=f_mod_hz, further_hz=())
        )

    def renderer(
        self,
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
        *,
        f_mod_hz: float | None = None,
        corrected: bool = True,
    ) -> Callable[[float, Camera], Rendering]:
        """:meth:`render` for many images: a function of time [s] and camera, which keeps what
        images share.

        Its images differ from those of :meth:`render` by rounding only, and the next call
        overwrites them.

        Args:
            images: Names of what is wanted of quads, phasor, colour, distance, opacity and
                distortion; others have no elements and cost nothing.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.
            corrected: Whether the settings ``fallback`` and ``outlines`` apply.
        """
        names = frozenset(images) - {"source"}
        corrected = corrected and "distance" in names and self._corrects
        if corrected:
            names |= {"phasor"}
        field = self.field if "colour" in names else replace(self.field, colour_sh=None)
        sensor = replace(
            self._at(f_mod_hz),
            source_intensity=float(self.sensor.source_intensity) / self.quad_scale,
        )
        optimised = self.camera.resized(*self.config["size_optimised"])
        known = field, self.motion, self.binding, sensor, self.render_settings, optimised, names
        replay = Replay(*known, colour_scale=self.colour_scale)
        if not corrected:
            return replay
        return lambda time, camera: self.corrected(replay(time, camera), time, camera, f_mod_hz)

    @property
    def _corrects(self) -> bool:
        return bool(self.config["settings"].get("outlines")) or self.fallback is not None

    @functools.cached_property
    def explained(self) -> Residuals | None:
        """How well the run explains the quads of its sequence, see recon/residuals.py."""
        return residuals(self, self.sequence())

    @functools.cached_property
    def fallback(self) -> Fallback | None:
        """Where the measurement knows the distance better than the Gaussians; None without that
        setting, and for a sequence that cannot be read again, which is logged.
        """
        if not self.config["settings"].get("fallback"):
            return None
        try:
            sequence = self.sequence()
            return Fallback.of(self.explained, sequence, self.camera, self.field.device)
        except InputError as error:
            LOG.warning("no fallback to the measurement: %s: %s", error.what, error.why)
            return None

    def images(
        self,
        times: Iterable[float],
        cameras: Iterable[Camera],
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
    ) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
        """:meth:`renderer` for a loop that wants arrays on the host: on CUDA, they come while the
        next are rendered.

        Every image is whole, in the order of ``times``: one that needs more memory than was
        reserved is rendered again. Arrays stay valid for as long as anything refers to them, see
        :meth:`Series.on_host`.

        Args:
            times: Seconds since raw frame 0 of each image.
            cameras: Where from, one each.
            images: As in :meth:`renderer`.
        """
        names = tuple(images)
        yield from on_host(self.renderer(names), zip(times, cameras, strict=True), names)

    def widened(self, field: GaussianField, camera: Camera) -> GaussianField:
        """Gaussians as wide as they looked while they were optimised, for a camera that resolves
        more.

        The renderer's low-pass filter widens every Gaussian on the image, by ``low_pass`` at any
        resolution. One that was fitted to smaller images would look thinner here by the difference,
        which is added to it as low_pass ((z / f)^2 of the optimisation - (z / f)^2 of
        ``camera``) [m^2].
        """
        optimised = self.camera.resized(*self.config["size_optimised"])
        footprint, footprint_here = (_footprint(field, view) for view in (optimised, camera))
        missing = self.render_settings.low_pass * (
            footprint.square() - footprint_here.square()
        ).clamp_min(0.0)
        return replace(field, log_scale=0.5 * (field.scale.square() + missing[:, None]).log())

    @property
    def render_settings(self) -> RenderSettings:
        """How the run was rendered while it was optimised."""
        return render_settings(self.config)

    @functools.cached_property
    def _held(self) -> weakref.WeakValueDictionary[str, Sequence]:
        """The sequence, as long as anybody else holds it."""
        return weakref.WeakValueDictionary()

    def sequence(self) -> Sequence:
        """The sequence it was made from, read again unless it is still in use.

        Raises:
            InputError: If it was never on disk, is gone, cannot be read, or is another one by now.
        """
        if (held := self._held.get("sequence")) is not None:
            return held
        self._held["sequence"] = sequence = source.sequence_of(self.path, self.config)
        return sequence

    def linked(self, sequence: str | Path) -> Run:
        """The run with its sequence in another folder, which config.json then remembers.

        Raises:
            InputError: If the folder holds no sequence, or another one.
            BusyError: If a process works on the run.
        """
        return replace(self, config=source.link(self.path, self.config, sequence))


class WithoutGaussians(Run, abc.ABC):
    """A run of another method, whose field is empty."""

    @classmethod
    def of(
        cls,
        path: Path,
        config: dict,
        camera: Camera,
        sensor: Sensor,
        device: torch.device | str,
        **more: Any,
    ) -> Self:
        """The run that a config describes.

        Args:
            path: Its folder.
            config: Content of its ``config.json``.
            camera: The camera of raw frame 0.
            sensor: The sensor, with the four canonical shifts.
            device: Where images are wanted.
            more: Further fields of the class.
        """
        field, motion = closed_form.no_gaussians(device), Still(torch.tensor([0.0, 1.0])).to(device)
        return cls(
            path=path,
            config=config,
            camera=camera,
            sensor=sensor,
            quad_scale=config.get("quad_scale", 1.0),
            field=field,
            motion=motion,
            binding=motion.bind(field),
            **more,
        )

    def renderer(
        self,
        images: Iterable[str] = (),  # noqa: ARG002
        *,
        f_mod_hz: float | None = None,
        corrected: bool = True,  # noqa: ARG002
    ) -> Callable[[float, Camera], Rendering]:
        """:meth:`render`: there is nothing that images share."""
        return functools.partial(self.render, f_mod_hz=f_mod_hz)


class ClosedForm(WithoutGaussians):
    """A run without Gaussians, which renders its own measurements."""

    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """The measured quartet nearest to a time, as if it had been taken at that instant.

        Quads are the measured ones in canonical order, computed from the phasor where the sensor
        has another shift; the distance is what all frequencies together decode to, and nothing is
        transparent. There is no colour and no distortion, and extra channels are zero.

        Args:
            time: Seconds since raw frame 0, any number; during a quartet its own, else the nearest
                complete one.
            camera: None, or the sequence's own at the time.
            extra: Channels per Gaussian, of which there are none.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.

        Raises:
            InputError: If the sequence cannot be read again, or none of its quartets is complete.
            UsageError: If it is asked for from another camera.
        """
        if camera is not None:
            closed_form.check_camera(self._measured, time, camera, self.camera, self.path)
        return closed_form.rendering_of(
            self._shown(time),
            time,
            self.sensor.shifts,
            f_mod_hz=f_mod_hz,
            extra_channels=None if extra is None else extra.shape[1],
            device=self.field.device,
        )

    def _shown(self, time: float) -> Sequence:  # noqa: ARG002
        """What holds the quartet that is decoded at a time [s]."""
        return self._measured

    @functools.cached_property
    def _measured(self) -> Sequence:
        return closed_form.checked(self.sequence())


class Temporal(ClosedForm):
    """A run without Gaussians, which renders the temporal mean of its measurements where a quartet
    agrees with its pixel's median, and the quartet elsewhere.
    """

    @functools.cached_property
    def _measured(self) -> Sequence:
        return averaged(closed_form.checked(self.sequence()))


class Flow2D(ClosedForm):
    """A run without Gaussians, which renders the closed form of raw frames that optical flow
    brought to the time of the rendering.
    """

    def _shown(self, time: float) -> Sequence:
        matcher = FlowSource(self.config["settings"]["flow"]).matcher
        return synchronised(self._measured, time, matcher).sequence


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowedRun(WithoutGaussians):
    """A run of a long recording, whose windows are runs of their own, see joined.py.

    Times are those of the recording. Two windows are in memory at a time.
    """

    joined: Joined[Run]
    """Its windows."""

    @classmethod
    def of_windows(
        cls,
        path: Path,
        config: dict,
        camera: Camera,
        sensor: Sensor,
        device: torch.device | str,
    ) -> Self:
        """The run of a folder that holds windows.

        Raises:
            InputError: If not all of them are reconstructed.
        """
        source.check_windows(path, config)

        def opened(number: int) -> Run:
            gc.collect()  # a window that was closed may still refer to itself
            window = Run.open(folder_of(path, number), device)
            return replace(window, config=window.config | {"sequence": config["sequence"]})

        windows = [Window.of(stored) for stored in config["windows"]]
        return cls.of(path, config, camera, sensor, device, joined=Joined(windows, opened))

    @property
    def gaussians(self) -> int:
        """Number of Gaussians of all windows."""
        return int(self.config["gaussians"])

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.config.get("colour_scale") is not None

    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """What the sensor would see at one instant; as :meth:`Run.render`, extra channels are 0."""
        fits = Method(self.config["settings"].get("method", Method.GAUSSIANS)).fits
        if fits:
            camera = camera or self.camera
        rendering = self.joined.rendered(
            time, lambda window, local: window.render(local, camera, f_mod_hz=f_mod_hz)
        )
        return _with_empty_extra(rendering, extra)

    def renderer(
        self,
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
        *,
        f_mod_hz: float | None = None,
        corrected: bool = True,
    ) -> Callable[[float, Camera], Rendering]:
        """As :meth:`Run.renderer`."""
        names = tuple(images)
        renderers: Joined[Callable[[float, Camera], Rendering]] = self.joined.mapped(
            lambda window: window.renderer(names, f_mod_hz=f_mod_hz, corrected=corrected)
        )
        return lambda time, camera: renderers.rendered(
            time, lambda render, local: render(local, camera)
        )

    def corrected(
        self, rendering: Rendering, time: float, camera: Camera, f_mod_hz: float | None = None
    ) -> Rendering:
        """As :meth:`Run.corrected`, by the windows of the time."""
        return self.joined.rendered(
            time, lambda window, local: window.corrected(rendering, local, camera, f_mod_hz)
        )

    def edited(self, field: GaussianField, rows: Int[Tensor, "N"] | None = None) -> Run:  # noqa: ARG002
        """Refused.

        Raises:
            UsageError: Always: each window has Gaussians of its own.
        """
        raise refused(self.path)

    def save(self, out: str | Path) -> Run:  # noqa: ARG002
        """Refused, as :meth:`edited`."""
        raise refused(self.path)


@dataclass(frozen=True, kw_only=True, eq=False)
class VolumeRun(WithoutGaussians):
    """A run of a neural volume."""

    volume: Volume
    """What is seen."""

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.volume.box.colour

    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """What the sensor would see at one instant; as :meth:`Run.render`, extra channels are 0.

        Args:
            time: Seconds since raw frame 0, any number; beyond the recording as at its ends.
            camera: Where from, and how many pixels; None is the sequence's own.
            extra: Channels per Gaussian, of which there are none.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.
        """
        camera = camera or self.camera
        found = rendering_of(
            self.volume,
            time,
            camera,
            self._at(f_mod_hz),
            quad_scale=self.quad_scale,
            colour_scale=self.colour_scale,
        )
        return _with_empty_extra(found, extra)


def _with_empty_extra(rendering: Rendering, extra: Float[Tensor, "0 D"] | None) -> Rendering:
    """A rendering without Gaussians, whose extra channels are zero if they are wanted."""
    if extra is None:
        return rendering
    size = rendering.distance.shape
    return replace(rendering, extra=rendering.distance.new_zeros(extra.shape[1], *size))


def _footprint(field: GaussianField, camera: Camera) -> Float[Tensor, "N"]:
    """Width of a pixel at each Gaussian [m]."""
    pose = torch.as_tensor(camera.camera_from_world).to(field.mean)
    return (field.mean @ pose[2, :3] + pose[2, 3]) / math.sqrt(camera.fx * camera.fy)
