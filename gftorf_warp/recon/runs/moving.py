"""What a run of windows knows of outlines that move: its flow, its static layer alone, and what its
Gaussians fail to explain of other raw frames.

A raw frame measures one component of the phasor. Those before and after it measure the other one,
mostly of surfaces that moved on. So the Gaussians of its quartet are rendered at their times, and
what they fail to explain there is moved back with the surface, to be interpolated in time: where
their outlines are a little wrong, they are so in all these raw frames.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ...data.temporal import camera_rests
from ...render.api import Rendering, rasterize
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from ...scene.measured import frame_period, sample
from ...scene.windows import Windows
from .. import closed_form
from ..observations import input_of
from ..other_frames import FLOW_WEIGHT_MIN, SPAN, OtherFrames, normals_of
from ..phasors import MeasuredPhasors
from ..settings import Input
from .gaussians import widened
from .stored import StoredRun

TURNED = 0.7  # [1] sine between the shifts of two raw frames, from which one tells of the other
FLOW_SIDE = 5  # [px] side of the box over which the velocity of a surface is averaged
LIGHTEST = 0.02  # [1] mean weight of moving Gaussians there, below which nothing moves


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
            rendering: With its distance.
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
            across=self._across(n, frames, rendering, present, camera, images),
        )

    def _across(
        self,
        n: int,
        frames: list[int],
        rendering: Rendering,
        present: _Present,
        camera: Camera,
        moving: Float[Tensor, "3 H W"],
    ) -> Float[Tensor, "H W"] | None:
        """How much too small the component across raw frame n is rendered [quad units], from the
        nearest of the other ``frames`` before and after that tell it; None if none does, or with a
        DC offset.
        """
        sequence = self.measured.sequence
        if sequence.calibration.dc_offset != 0.0:
            return None
        turns = {m: float(sequence.shifts[m] - sequence.shifts[n]) for m in frames}
        telling = [m for m in frames if abs(math.sin(turns[m])) > TURNED]
        before, after = [m for m in telling if m < n], [m for m in telling if m > n]
        nearest = before[-1:] + after[:1]
        if not nearest:
            return None
        own = self.measured.residual(rendering.phasor[0], rendering.phasor[1], n)
        weight, *flow = avg_pool2d(moving, FLOW_SIDE, 1, FLOW_SIDE // 2, count_include_pad=False)
        velocity = torch.stack(flow) / weight.clamp_min(FLOW_WEIGHT_MIN) * (weight > LIGHTEST)
        times = [float(sequence.times[m] - sequence.times[n]) for m in nearest]
        result = torch.zeros_like(own)
        for m, time in zip(nearest, times, strict=True):
            later = time / frame_period(sequence)
            re, im, _ = self._rendering(present.moved(later), camera, "phasor").phasor
            there = moved_back(self.measured.residual(re, im, m), later * velocity)
            share = 1.0 if len(times) == 1 else 1.0 - abs(time) / (times[1] - times[0])
            result += share * (there - math.cos(turns[m]) * own) / math.sin(turns[m])
        return result

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


def moved_back(
    image: Float[Tensor, "H W"], displacement: Float[Tensor, "2 H W"]
) -> Float[Tensor, "H W"]:
    """An image at x + displacement(x) [px], bilinear, edges repeated."""
    y, x = (torch.arange(side, device=image.device) + 0.5 for side in image.shape)
    there = torch.stack(torch.meshgrid(x, y, indexing="xy")) + displacement
    return sample(image[None], there.flatten(1).T).view(image.shape)
