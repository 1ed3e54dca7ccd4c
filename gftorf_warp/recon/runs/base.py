"""A run of Gaussians, and what runs of all kinds have in common."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...errors import InputError
from ...render.api import Rendering
from ...render.inputs import DIFFERENTIABLE
from ...render.series import on_host
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from .. import checkpoint, edits, outlines
from ..fallback import Fallback
from ..phasors import MeasuredPhasors
from ..read_back import ReadBack, read_back
from ..residuals import Residuals, residuals
from ..settings import Method
from ..state import field_and_motion
from . import gaussians
from .moving import MovingOutlines
from .stored import StoredRun, at_frequency

LOG = logging.getLogger("gftorf_warp")
CORRECTED = {"distance", "opacity", "quads", "phasor"}  # by the settings fallback and outlines
KINDS: dict[str, type[Run]] = {}
"""The class of each method, and of ``windows``; ``recon/run.py`` fills it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run(StoredRun):
    """What :func:`gftorf_warp.reconstruct` returns, and what its folder stores.

    >>> from gftorf_warp import Run, reconstruct, simulate
    >>> recording = simulate("demo", "demo", frames=8, size=(24, 18))
    >>> path = reconstruct(recording, "run", images=8).path
    >>> run = Run.open(path)
    >>> run.render(time=0.0123, camera=run.camera.resized(48, 36)).distance.shape
    torch.Size([36, 48])
    """

    @classmethod
    def open(cls, path: str | Path, device: torch.device | str = "cpu") -> Run:
        """Read a run from its folder: config and newest checkpoint. A run of the methods ``ctof``,
        ``temporal`` and ``flow2d`` needs no checkpoint.

        Raises:
            InputError: If the folder is no run, or holds no checkpoint that can be read and whose
            Gaussians and motion are finite.
        """
        path = Path(path)
        described = read_back(path)
        method = described.config["settings"].get("method", Method.GAUSSIANS)
        kind = KINDS["windows" if described.config.get("windows") else method]
        return kind._opened(path, described, device)

    @classmethod
    def _opened(cls, path: Path, described: ReadBack, device: torch.device | str) -> Run:
        """The run of a folder whose config is of this kind."""
        stored, described = newest(path, described, device)
        with checkpoint.rebuilding(path):
            content = field_and_motion(stored, device)
        edits.check_finite(path, *content[:2])
        return cls._of(path, described, *content)

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
        states. With ``fallback``, quads and phasor too are corrected by what was measured.

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
        rendering = gaussians.rendering_of(self, time, camera, extra=extra, f_mod_hz=f_mod_hz)
        return self.corrected(rendering, time, camera, f_mod_hz)

    def corrected(
        self,
        rendering: Rendering,
        time: float,
        camera: Camera,
        f_mod_hz: float | None = None,
        *,
        light_only: bool = False,
    ) -> Rendering:
        """A rendering, with its phasor, after the settings ``fallback`` and ``outlines``; with
        ``light_only`` its quads and phasor only, which outlines do not change.
        """
        if not self._corrects:
            return rendering
        fitted = rests = None
        if self.fallback is not None:
            fitted = rendering.distance if self.fallback.averages else None
            rests = self.fallback.rests_at(rendering, time, camera)
            rendering = self.fallback.applied(rendering, time, camera)
        sensor, measured = at_frequency(self.sensor, f_mod_hz), self._measured_phasors
        frequency, phasor = float(sensor.f_mod_hz), None
        if measured is not None:
            phasor = measured.corrected(rendering, time, camera, frequency, averaged=rests)
        if self.config["settings"].get("outlines") and not light_only:
            moves = self.fallback is not None and self.fallback.camera_moves
            others, whole = None, phasor
            if self._moving_outlines is not None:
                others = self._moving_outlines.at(rendering, time, camera, frequency)
            if measured is not None and others is not None and others.quadrature is not None:
                whole = measured.corrected(
                    rendering, time, camera, frequency, averaged=rests, quadrature=others.quadrature
                )
            rendering = outlines.resolved(
                rendering, sensor, whole, camera_moves=moves, fitted=fitted, others=others
            )
        if phasor is None or self.fallback is None:
            return rendering
        return phasor.within(rendering, sensor)

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
        corrected = corrected and bool(names & CORRECTED) and self._corrects
        if corrected:
            names |= {"distance", "phasor"}
        replay = gaussians.replay_of(self, names, f_mod_hz)
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
        """Where measured distances are more accurate than those of the Gaussians; None without that
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

    @functools.cached_property
    def _measured_phasors(self) -> MeasuredPhasors | None:
        """What was measured of mixed pixels; None for a sequence that cannot be read again, which
        is logged.
        """
        try:
            return MeasuredPhasors.of(self.sequence(), self.camera, self.field.device)
        except InputError as error:
            LOG.warning("outlines from renderings alone: %s: %s", error.what, error.why)
            return None

    @functools.cached_property
    def _moving_outlines(self) -> MovingOutlines | None:
        """What other raw frames tell of them; None where they cannot be followed."""
        measured = self._measured_phasors
        return None if measured is None else MovingOutlines.of(self, measured)

    def images(
        self,
        times: Iterable[float],
        cameras: Iterable[Camera],
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
    ) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
        """:meth:`renderer` with arrays on the host: on CUDA, they are copied while the
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
        """Gaussians as wide as during the optimisation, for a camera that resolves more:
        :func:`gftorf_warp.recon.runs.gaussians.widened`.
        """
        return gaussians.widened(self, field, camera)


def newest(
    run: Path, described: ReadBack, device: torch.device | str
) -> tuple[dict[str, Any], ReadBack]:
    """The newest checkpoint in the folder of a run, and its config with how far that is.

    Raises:
        InputError: If there is no checkpoint that can be read.
    """
    stored = checkpoint.last(run, device)
    if stored is None:
        raise InputError(
            "the run has no checkpoint",
            where=run,
            why="nothing was reconstructed yet",
            fix="run `gftorf reconstruct` with this --out first",
        )
    reached = {"images_optimised": stored["images"], "seconds_reconstruct": stored["seconds"]}
    damaged = [newer.name for newer in checkpoint.after(run, stored["images"])]
    if damaged:
        reached["damaged_checkpoints"] = damaged
    # of an interrupted run, config.json does not say
    return stored, replace(described, config=described.config | reached)
