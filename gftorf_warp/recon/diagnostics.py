"""Diagnostics along a run: rows of ``diagnostics.jsonl``, which change nothing of the optimisation.

d and d_ToF drift apart where quads do not determine the distance (method, sections 2.5 and 9), and
static surfaces drift along rays: neither shows in the loss. So a few fixed raw frames are rendered
with a black background, at the poses and the size of the optimisation, without gradients and
without random numbers. This is the only file of recon/ that reads ground truth; only the report
reads its rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..data.estimates import steady_pixels
from ..data.sequence import Sequence, Truth
from ..data.temporal import camera_rests
from ..data.truth import known_distance, moving_and_static, nearest
from ..render.api import rasterize
from ..render.bridge import pairs_of
from ..render.buffers import Distortion, Workspace
from ..scene.motion import Displacement
from ..scene.sensor import phasor_from_quads
from ..scene.unwrap import common_range, distance_from_phasors
from .observations import Observations
from .record import Metrics
from .settings import ReconSettings
from .state import State

ROWS = 40  # along a run, besides its first image
FRAMES = 4  # rendered per row: about a hundredth of the time of a run of some thousand images
# (tile, splat) pairs that a GPU may list uncounted: 16 MB; the published runs have a tenth
PAIRS = 1 << 22
Row = dict[str, float | int | None]
Wanted = dict[str, tuple[Tensor | None, Tensor | None]]  # image and mask by name


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendered:
    """One row on the device, not read back yet."""

    sums: dict[str, Tensor | None]
    """Sum over pixels and number of pixels by name, float64."""
    pairs: Int[Tensor, "S"]
    """(tile, splat) pairs of every frame."""
    counted: bool
    """Whether they were counted before memory was allocated, so that none was dropped."""


class Diagnostics:
    """Renders and writes the rows."""

    def __init__(self, observations: Observations, truth: Truth | None, path: Path):
        """Choose raw frames and masks.

        Args:
            observations: What is being fitted.
            truth: Of the sequence, at its own resolution; None: unknown.
            path: The file of rows, ``RUN/diagnostics.jsonl``.
        """
        sequence = observations.sequence
        self.observations = observations
        self.rows = Metrics(path)
        known = None if truth is None or not truth.known.any() else truth
        self.frames = diagnostic_frames(sequence, known)
        self.truth: Tensor | None = None
        self.moving: Tensor | None = None
        self.static: Tensor | None = None
        self._workspace = Workspace()
        device = observations.quads.device
        if known is not None:
            if len(known.distance) != sequence.frames:
                raise ValueError(
                    f"truth of {len(known.distance)} raw frames for a sequence of {sequence.frames}"
                )
            distance = nearest(known_distance(known), sequence.height, sequence.width)
            masks = moving_and_static(
                distance, self.frames, from_phasors=sequence.from_phasors, cycle=sequence.cycle
            )
            self.moving, self.static = (torch.tensor(mask, device=device) for mask in masks)
            self.truth = torch.tensor(distance[self.frames], dtype=torch.float32, device=device)
        elif (steady := measured_static(sequence)) is not None:
            self.static = torch.tensor(steady, device=device).expand(len(self.frames), -1, -1)

    def due(self, before: int, after: int, total: int) -> bool:
        """Whether a row is due between two numbers of optimised images.

        Rows lie where images / total = (k / 40)^2, so denser at the start, and at the end; depends
        on nothing else.

        Args:
            before: Optimised images after the step before; below zero: there was none yet.
            after: Optimised images now.
            total: Of the whole run.
        """
        if before < 0 or after >= total:
            return True
        return _mark(after, total) > _mark(before, total)

    def rewind(self, images: int) -> None:
        """Drop rows beyond ``images``, from which the run is continued."""
        self.rows.rewind(images)

    def add(self, state: State, settings: ReconSettings) -> Row:
        """:meth:`render` and :meth:`write` one row."""
        return self.write(self.render(state, settings), state, settings)

    @torch.no_grad()
    def render(self, state: State, settings: ReconSettings, *, counted: bool = False) -> Rendered:
        """Render the frames and sum up what a row needs, without waiting for a GPU.

        Args:
            state: Of the optimisation.
            settings: Of the run.
            counted: Whether (tile, splat) pairs are counted first, which waits; on a CPU always.
        """
        field, shown = state.optimiser.field, self.observations
        binding = state.motion.bind(field) if state.motion.follows_means else state.binding
        bare = replace(field, colour_sh=None)
        capacity = None if counted or field.device.type == "cpu" else PAIRS
        # no gradients: no memory for an order of their sums
        kept = replace(
            settings.render,
            distortion=Distortion.PAPER,
            pair_capacity=capacity,
            deterministic=False,
        )
        images: dict[str, list[Tensor]] = {
            name: [] for name in ("d", "d_tof", "opacity", "distortion", "offset")
        }
        pairs: list[Tensor] = []
        displacements = [Displacement(torch.zeros_like(field.mean), None)] * len(self.frames)
        if state.images >= settings.schedule.warm_up:  # before, nothing moves
            times = [float(shown.sequence.times[frame]) for frame in self.frames]
            displacements = state.motion.at_times(binding, times)
        for frame, displacement in zip(self.frames, displacements, strict=True):
            length = displacement.offset.norm(dim=1, keepdim=True)
            moved, camera, where = bare.moved(*displacement), shown.cameras[frame], self._workspace
            rendering = rasterize(moved, camera, shown.sensor, kept, extra=length, workspace=where)
            assert rendering.extra is not None
            pairs.append(pairs_of(where).clone())
            images["d"].append(rendering.distance)
            light = [rendering.quads]
            for f in shown.sensor.further_hz:
                other = replace(shown.sensor, f_mod_hz=f, further_hz=())
                light.append(
                    rasterize(moved, camera, other, kept, images=("quads",), workspace=where).quads
                )
            phasors = [phasor_from_quads(quads, shown.sensor.shifts) for quads in light]
            images["d_tof"].append(distance_from_phasors(phasors, shown.sensor))
            images["opacity"].append(rendering.opacity)
            images["distortion"].append(rendering.distortion)
            images["offset"].append(rendering.extra[0] / rendering.opacity.clamp_min(1e-6))
        wanted = self._quantities({name: torch.stack(parts) for name, parts in images.items()})
        return Rendered(sums=_sums(wanted), pairs=torch.cat(pairs), counted=capacity is None)

    def write(self, rendered: Rendered, state: State, settings: ReconSettings) -> Row:
        """Append a row to the file and return it; the state must still be the same.

        Errors are means over all known pixels of the frames; None where unknown or not finite. The
        keys: images, gaussians; d_mse_x100 and d_tof_mse_x100, also as ``moving.`` and ``static.``
        [m^2 x 100]; transmittance T_e [1]; distortion, the sum over all pairs [m^2];
        offset_static_m, the length of the displacement of what static pixels see;
        d_minus_dtof_static_m, |d - d_ToF| there up to a whole unambiguous range.
        """
        if not rendered.counted and max(rendered.pairs.tolist()) > PAIRS:
            rendered = self.render(state, settings, counted=True)
        row: Row = {"images": state.images, "gaussians": len(state.optimiser.field)}
        row |= _means(rendered.sums)
        self.rows.add(row)
        return row

    def _quantities(self, images: dict[str, Tensor]) -> Wanted:
        """Images [S, H, W] whose means are the numbers of a row, and their masks."""
        everywhere = torch.ones_like(images["d"], dtype=torch.bool)
        groups = {"": everywhere, "moving.": self.moving, "static.": self.static}
        wanted: Wanted = {}
        for prefix, mask in groups.items():
            for name in ("d", "d_tof"):
                wanted[f"{prefix}{name}_mse_x100"] = None, None
                if self.truth is not None and mask is not None:
                    error = 100.0 * (images[name] - self.truth).square()
                    wanted[f"{prefix}{name}_mse_x100"] = error, mask & ~self.truth.isnan()
        wanted["transmittance"] = 1.0 - images["opacity"], everywhere
        wanted["distortion"] = images["distortion"], everywhere
        period = common_range(self.observations.sensor)
        apart = torch.remainder(images["d"] - images["d_tof"] + 0.5 * period, period) - 0.5 * period
        wanted["offset_static_m"] = images["offset"], self.static
        wanted["d_minus_dtof_static_m"] = apart.abs(), self.static
        return wanted


def diagnostic_frames(sequence: Sequence, truth: Truth | None) -> list[int]:
    """At most four starts of quartets, spread over the sequence, neither the first nor the last if
    there are others.

    With a truth, quartets that it knows nothing of do not count.
    """
    every = range(0, sequence.frames, sequence.cycle)
    starts = [n for n in every if truth is None or truth.known[n]] or [*every]
    inner = starts[1:-1] or starts
    chosen = np.linspace(0, len(inner) - 1, min(FRAMES, len(inner))).round().astype(int)
    return [inner[k] for k in chosen]


def measured_static(sequence: Sequence) -> Bool[np.ndarray, "H W"] | None:
    """Pixels that rest as far as can be measured: bright ones of the half that changes least.

    None where the camera moves, so that no pixel rests, or where no quartet is complete.
    """
    if not (sequence.complete_quartets and camera_rests(sequence)):
        return None
    return steady_pixels(sequence)


def _mark(images: int, total: int) -> int:
    """Number of marks (k / 40)^2 at or before images / total, in whole numbers."""
    return math.isqrt(ROWS * ROWS * images // total)


def _sums(images: Wanted) -> dict[str, Tensor | None]:
    """Sums over masks and numbers of their pixels, in double precision; None without a mask."""
    sums: dict[str, Tensor | None] = dict.fromkeys(images)
    for name, (image, mask) in images.items():
        if image is not None and mask is not None:
            sums[name] = torch.stack(
                [torch.where(mask, image, 0.0).double().sum(), mask.sum().double()]
            )
    return sums


def _means(sums: dict[str, Tensor | None]) -> Row:
    """Means in one transfer; None without a pixel, or if not finite."""
    present = {name: pair for name, pair in sums.items() if pair is not None}
    means: Row = dict.fromkeys(sums)
    for name, (total, count) in zip(
        present, torch.stack([*present.values()]).tolist(), strict=True
    ):
        if count and math.isfinite(total):
            means[name] = total / count
    return means
