"""Method ``ftorf``: one network of position and time, fitted to raw quads at their own times by a
3D scene flow (neural_volumes.md, sections 1 and 3; Okunev et al. 2024).

The network knows the first raw frame of every quartet i. Besides density and light it gives where a
point goes until quartet i + 1 and where it was at i - 1. A raw frame o after that of quartet i sees
a sample x where the network has it at

    x + |o| / K f,     f: flow from i + 1 back if o > 0, from i - 1 on if o < 0, both at x

composited along the ray of the raw frame, with the distances of that ray. So every raw frame is
compared in the one slot that it measured. Beyond the first and last quartet, f is the flow of
quartet i itself.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..settings import Method, ReconSettings
from . import composite
from .composite import Samples
from .rays import Depths, Rays
from .targets import Around, Draw, Targets
from .volume import Volume

FORWARD, BACKWARD = 0, 1  # rows of a flow


class Neighbours(NamedTuple):
    """Where samples go and come from; each is [R, S, 3] in metres."""

    forward: Tensor
    """From quartet i to the next."""
    backward: Tensor
    """From quartet i to the one before."""
    from_before: Tensor
    """From quartet i - 1 to quartet i, at the same points; ``forward`` without i - 1."""
    from_after: Tensor
    """From quartet i + 1 back to quartet i, at the same points; ``backward`` without i + 1."""


class Ftorf(Volume):
    """A volume that moves between quartets."""

    method = Method.FTORF
    faithful: ClassVar[tuple[str, ...]] = (
        "network, encodings, positional time code, samples, compositing, 256 rays in 4 "
        "accumulated steps, Adam at 2e-4 clipped by value",
        "raw quads at their own times (weight 10), 3D flow of a cycle, its three regularisers, "
        "25,000 of 400,000 steps in which a quartet is simultaneous",
    )
    assumed: ClassVar[tuple[str, ...]] = (
        "settings of the published synthetic table are not published (the released script for "
        "synthetic scenes never leaves its first stage and fits phasors): these are those of the "
        "real scenes with the DC offset of the recording",
        "bounds of the rays are from decoded distances; published ones were chosen per scene",
        "optical flow is that of the recording or by OpenCV; the publication uses RAFT",
        "four accumulated steps draw four quartets; raw frames after the last quartet start and "
        "their flow are those of the last quartet",
        "falloff of the synthetic scenes, 4 m^2; colour has no weight, as for real scenes",
    )

    def terms(self, targets: Targets, step: int, settings: ReconSettings, draw: Draw) -> dict:
        """Raw frames around one quartet, its optical flow, and the regularisers of the flow."""
        options, quartet = self.settings.scene_flow, draw.one_of(self.box.quartets)
        pixels = draw.pixels(self.settings.rays, targets.views.pixels)
        rays = targets.views.rays(self.box.cycle * quartet, pixels)
        depths, weight = self.depths(rays, draw), settings.weights.quads
        points = rays.at(depths.z)
        if step < options.simultaneous_share * settings.schedule.images:
            with self.precision():
                trunk = self.trunk(points[None], [quartet])
                samples = self.samples(trunk, rays, depths, draw=draw)
            around = targets.around(quartet, after_only=True)
            mse = _errors(targets, around, samples, pixels).mean()
            more = self.more_terms(rays, depths, samples, step, settings)
            return {"quads": weight * mse, "quad_mse": mse.detach()} | more
        every = targets.around(quartet)
        around = self.compared(every, draw)
        with self.precision():
            own, flows = self._quartet(quartet, points)
            beside, gap = self._beside(around, quartet, points, flows)
            samples = self.samples(torch.cat([own, beside]), rays, depths, draw=draw)
        errors = _errors(targets, around, samples, pixels)
        larger = (len(every.frames) - 1) / max(1, len(around.frames) - 1)
        kept = max(1, round(options.kinetic_share * depths.z.shape[1]))
        both = (flows.forward + flows.backward)[:, :kept]
        terms = {
            "quads": weight * (errors[0] + larger * errors[1:].sum()),
            "size": options.size * 0.5 * (flows.forward.abs() + flows.backward.abs()).mean(),
            "kinetic": options.kinetic * 0.5 * both.square().sum(dim=-1).mean(),
            "round_trip": options.round_trip * gap,
            "quad_mse": errors.mean().detach(),
        }
        weight = settings.weights.flow * max(0.0, 1.0 - step / options.vanishes_at)
        if weight > 0 and quartet in targets.flow_rows:
            measured = targets.flow[targets.flow_rows[quartet]][..., pixels]
            nearest = 0.5 * self.box.bounds[0]
            seen = rays.at((_weights(samples)[0] * depths.z).sum(dim=-1))
            terms["flow"] = weight * _projected(targets, measured, samples, seen, flows, nearest)
        return terms | self.more_terms(rays, depths, samples, step, settings)

    def compared(self, around: Around, draw: Draw) -> Around:  # noqa: ARG002
        """Which of the raw frames around a quartet start a step compares: all."""
        return around

    def more_terms(
        self,
        rays: Rays,  # noqa: ARG002
        depths: Depths,  # noqa: ARG002
        samples: Samples,  # noqa: ARG002
        step: int,  # noqa: ARG002
        settings: ReconSettings,  # noqa: ARG002
    ) -> dict[str, Tensor]:
        """Weighted terms of the loss that were not published: none."""
        return {}

    def values_and_flow(
        self,
        points: Float[Tensor, "T R S 3"],
        quartets: list[int],
        seen: slice,
        flowing: slice,
    ) -> tuple[Float[Tensor, "t R S w"], Float[Tensor, "u R S 2 3"]]:
        """Values of some rows of points at the quartets of the rows, and scene flow [m] of some."""
        trunk = self.trunk(points, quartets)
        return trunk[seen], self.moving.flow(trunk[flowing], self.box.reach)

    def _quartet(
        self, quartet: int, points: Float[Tensor, "R S 3"]
    ) -> tuple[Float[Tensor, "1 R S w"], Neighbours]:
        """Values and flows at a quartet; the flows of its neighbours are of the same products."""
        before, after = quartet - 1 in self.box.quartets, quartet + 1 in self.box.quartets
        quartets = [quartet] + [quartet - 1] * before + [quartet + 1] * after
        rows = points.expand(len(quartets), *points.shape)
        own, flow = self.values_and_flow(rows, quartets, slice(1), slice(None))
        forward, backward = flow[0, ..., FORWARD, :], flow[0, ..., BACKWARD, :]
        flows = Neighbours(
            forward=forward,
            backward=backward,
            from_before=flow[1, ..., FORWARD, :] if before else forward,
            from_after=flow[-1, ..., BACKWARD, :] if after else backward,
        )
        return own, flows

    def _beside(
        self, around: Around, quartet: int, points: Float[Tensor, "R S 3"], flows: Neighbours
    ) -> tuple[Float[Tensor, "b R S w"], Tensor]:
        """Values of the points where the raw frames beside the start of a quartet see them, and the
        mean gap after a flow and the flow back [m].
        """
        before, after = (share[:, None, None, None] for share in (around.before, around.after))
        ways = {
            other: flow
            for other, flow in ((quartet + 1, flows.forward), (quartet - 1, flows.backward))
            if other in self.box.quartets
        }
        moved = [points + before * flows.from_before, points + after * flows.from_after]
        moved += [(points + flow)[None] for flow in ways.values()]
        count = len(before) + len(after)
        beside, back = self.values_and_flow(
            torch.cat(moved), [quartet] * count + [*ways], slice(count), slice(count, None)
        )
        gaps = [
            (flow + found[..., BACKWARD if other > quartet else FORWARD, :]).abs().mean()
            for (other, flow), found in zip(ways.items(), back, strict=True)
        ]
        return beside, torch.stack(gaps).sum() if gaps else points.new_zeros(())

    def samples_at(self, time: float, rays: Rays, depths: Depths) -> Samples:
        """Samples moved from the nearest quartet start to a time [s]."""
        starts = np.array(self.box.quartet_times)[self.box.quartets]
        # the last quartet lasts for a period
        time = float(np.clip(time, starts[0], starts[-1] + self.box.period))
        nearest = int(np.abs(starts - time).argmin())
        quartet, points = self.box.quartets[nearest], rays.at(depths.z)
        share = (time - starts[nearest]) / self.box.period
        with self.precision():
            if share != 0.0:
                beside = quartet + (1 if share > 0 else -1)
                source = beside if beside in self.box.quartets else quartet
                nothing, all_rows = slice(0), slice(None)
                _, flow = self.values_and_flow(points[None], [source], nothing, all_rows)
                points = points + abs(share) * flow[0, ..., BACKWARD if share > 0 else FORWARD, :]
            return self.samples(self.trunk(points[None], [quartet])[0], rays, depths)


def _errors(
    targets: Targets, around: Around, samples: Samples, pixels: Int[Tensor, "R"]
) -> Float[Tensor, "B"]:
    """Mean squared error of the slot that each raw frame measured [optimised units^2]."""
    sensor = targets.observations.sensor
    passed = samples.transmittance
    found = composite.modulated(samples, sensor, passed, around.shift, around.slope)
    measured = targets.quads[around.frames][:, pixels]
    return (found - measured).square().mean(dim=1)


def _projected(
    targets: Targets,
    measured: Float[Tensor, "2 2 R"],
    samples: Samples,
    seen: Float[Tensor, "R 3"],
    flows: Neighbours,
    nearest: float,
) -> Tensor:
    """Mean absolute difference to the optical flow of a quartet start [px], where known; the
    first of the samples are those of the start, and nothing is nearer than ``nearest`` [m].
    """
    weight = _weights(samples)[0]
    start, known = _image(targets, seen, nearest), measured.isfinite()
    gaps = []
    for direction, flow in ((FORWARD, flows.forward), (BACKWARD, flows.backward)):
        moved = seen + (weight[..., None] * flow).sum(dim=1)
        apart = (_image(targets, moved, nearest) - start).T - measured[direction]
        gaps.append(torch.where(known[direction], apart, torch.zeros_like(apart)).abs().sum())
    return torch.stack(gaps).sum() / known.sum().clamp_min(1)


def _weights(samples: Samples) -> Float[Tensor, "*b R S"]:
    """Weights alpha T of samples [1]."""
    return samples.alpha * samples.transmittance


def _image(targets: Targets, points: Float[Tensor, "R 3"], nearest: float) -> Float[Tensor, "R 2"]:
    """Positions in the images of the camera at rest [px], of points at least so far away [m]."""
    depth = points[:, 2:].clamp_min(nearest)
    return targets.camera.project(torch.cat([points[:, :2], depth], dim=1))
