"""What a run of windows knows of outlines that move: its flow, and its static layer alone."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from ...data.temporal import camera_rests
from ...render.api import Rendering, rasterize
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from ...scene.measured import frame_period
from ...scene.windows import Windows
from .. import closed_form
from ..observations import input_of
from ..other_frames import SPAN, OtherFrames, normals_of
from ..phasors import MeasuredPhasors
from ..quadrature import quadrature_residual
from ..settings import Input
from .gaussians import widened
from .stored import StoredRun


@dataclass(frozen=True, kw_only=True, eq=False)
class _Present:
    """The N Gaussians that exist at one time: the static layer, and what moves in its window."""

    field: GaussianField
    """At that time, without colour."""
    velocity: Float[Tensor, "N 3"]
    """[m per raw frame]"""
    moves: Bool[Tensor, "N 1"]
    """Whether they are of a moving surface."""

    def moved(self, frames: float) -> GaussianField:
        """Where the Gaussians are so many raw frames later, in the window or beyond it."""
        return replace(self.field, mean=self.field.mean + frames * self.velocity)


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingOutlines:
    """Moving outlines of a run of quads at one frequency, from a camera at rest."""

    run: StoredRun
    """The run; its motion is one of windows."""
    motion: Windows
    """Its motion."""
    measured: MeasuredPhasors
    """What was measured, of its sequence."""

    @classmethod
    def of(cls, run: StoredRun, measured: MeasuredPhasors) -> MovingOutlines | None:
        """Those of a run; None of one that outlines cannot be followed in."""
        sequence, motion = measured.sequence, run.motion
        if not isinstance(motion, Windows) or not bool((run.binding[:, 0] > 0.0).any()):
            return None
        compared = input_of(sequence, Input(run.config.get("input", Input.QUADS)))
        if compared != Input.QUADS or sequence.from_phasors or len(sequence.frequencies) > 1:
            return None
        if not camera_rests(sequence):
            return None
        return cls(run=run, motion=motion, measured=measured)

    @torch.no_grad()
    def at(
        self, rendering: Rendering, time: float, camera: Camera, f_mod_hz: float
    ) -> OtherFrames | None:
        """What other raw frames measured of the outlines of a rendering.

        Args:
            rendering: With its distance and phasor.
            time: Of the rendering [s].
            camera: Of the rendering.
            f_mod_hz: Modulation frequency [Hz].

        Returns:
            None unless the rendering is of a measured raw frame, seen from the sequence's own
            camera, and another one is near.
        """
        sequence = self.measured.sequence
        n = int(np.abs(sequence.times - time).argmin())
        at_frame = abs(sequence.times[n] - time) <= closed_form.TIME_S
        if not at_frame or not sequence.measured[n] or f_mod_hz not in sequence.frequencies:
            return None
        if closed_form.another_view(sequence, time, camera, self.measured.camera):
            return None
        near = range(max(n - SPAN, 0), min(n + SPAN + 1, sequence.frames))
        frames = [m for m in near if m != n and sequence.measured[m]]
        if not frames:
            return None
        present, (behind, opacity) = self._present(time), self._static
        moving, *flow = images = self._flow(present, camera)
        quadrature = None
        if closed_form.row_of(sequence, time, camera, self.measured.camera) is not None:
            quadrature = quadrature_residual(
                self.measured,
                n,
                frames,
                rendering.phasor,
                lambda later: self._rendering(present.moved(later), camera, "phasor").phasor,
                images,
            )

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=moving.device, dtype=torch.float32)

        later = (sequence.times[frames] - sequence.times[n]) / frame_period(sequence)
        slots = [m % sequence.cycle for m in frames]
        return OtherFrames(
            quads=tensor(sequence.quads[frames]),
            variance=self.measured.of_quads[slots],
            shifts=tensor(sequence.shifts[frames]),
            later=tensor(later),
            moving=moving,
            flow=torch.stack(flow),
            behind=behind,
            opacity=opacity,
            normals=normals_of(rendering.distance),
            quadrature=quadrature,
        )

    def _present(self, time: float) -> _Present:
        """The Gaussians of the window at that time."""
        run = self.run
        window = self.motion.keys_at(time).index[0] // 2
        start, end = self.motion.times[window : window + 2]
        keys = torch.tensor([2 * window, 2 * window + 1], device=run.field.device)
        rows = self.motion.present(run.binding, keys).nonzero()[:, 0]
        binding, field = run.binding[rows], run.field.map(lambda values: values[rows])
        before, after = self.motion.at_keys(binding, keys).offset
        velocity = (after - before) * frame_period(self.measured.sequence) / (end - start)
        field = replace(field.moved(*self.motion.at(binding, time)), colour_sh=None)
        return _Present(field=field, velocity=velocity, moves=binding[:, :1] > 0.0)

    def _flow(self, present: _Present, camera: Camera) -> Float[Tensor, "3 H W"]:
        """Weight of moving Gaussians [1], and their velocity times it [px per raw frame]."""
        field, later = present.field, present.moved(1.0)
        flow = camera.project(later.mean) - camera.project(field.mean)
        moves = present.moves.to(flow)
        extra = torch.cat([moves, torch.nan_to_num(flow) * moves], dim=1)
        rendering = self._rendering(field, camera, "opacity", extra=extra)
        assert rendering.extra is not None
        return rendering.extra

    @functools.cached_property
    def _static(self) -> tuple[Complex[Tensor, "H W"], Float[Tensor, "H W"]]:
        """Phasor [quad units] and opacity of the static layer alone."""
        run, camera = self.run, self.measured.camera
        rows: Int[Tensor, "S"] = (run.binding[:, 0] == 0.0).nonzero()[:, 0]
        field = replace(run.field.map(lambda values: values[rows]), colour_sh=None)
        rendering = self._rendering(field, camera, "phasor", "opacity")
        re, im, _ = rendering.phasor
        return torch.complex(re, im), rendering.opacity

    def _rendering(
        self,
        field: GaussianField,
        camera: Camera,
        *images: str,
        extra: Float[Tensor, "N D"] | None = None,
    ) -> Rendering:
        """Images of Gaussians without colour, phasors in the units of the sequence."""
        run, field = self.run, widened(self.run, field, camera)
        rendering = rasterize(
            field, camera, run.sensor, run.render_settings, extra=extra, images=images
        )
        return replace(rendering, phasor=rendering.phasor / run.quad_scale)
