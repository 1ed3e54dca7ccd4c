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

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..settings import Method, ReconSettings
from . import composite
from .choice import Choice, Given
from .composite import Samples
from .rays import Depths, Rays
from .scene_flow import BACKWARD, FORWARD, Neighbours, neighbours, projected, regularisers
from .targets import Around, Draw, Targets, picked
from .volume import Volume


class FtorfKey(NamedTuple):
    """Which operations a step consists of."""

    flows: bool
    """Whether anything flows yet; what follows is False until then."""
    before: int
    """Raw frames before the start of the quartet that are compared."""
    after: int
    """Those after it."""
    earlier: bool = False
    """Whether there is a quartet before."""
    later: bool = False
    """Whether there is one after it."""
    optical: bool = False
    """Whether its optical flow is compared."""


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

    def choice(self, targets: Targets, step: int, settings: ReconSettings, draw: Draw) -> Choice:
        """A quartet, the raw frames around it that are compared, and the weights of the step."""
        options, quartet = self.settings.scene_flow, draw.one_of(self.box.quartets)
        flows = step >= options.simultaneous_share * settings.schedule.images
        every = targets.around(quartet, after_only=not flows)
        around = self.compared(every, draw) if flows else every
        before, after = len(around.before), len(around.after)
        numbers: dict[str, Sequence[float]] = {
            "quartet": [quartet],
            "view": [self.box.cycle * quartet],
            "frames": around.frames,
            "shift": around.shift,
            "slope": around.slope,
        }
        if not flows:
            return Choice(FtorfKey(flows, before, after), numbers)
        earlier, later = (other in self.box.quartets for other in (quartet - 1, quartet + 1))
        ways = [quartet + 1] * later + [quartet - 1] * earlier
        weight = settings.weights.flow * max(0.0, 1.0 - step / options.vanishes_at)
        optical = weight > 0 and quartet in targets.flow_rows
        numbers |= {
            "before": around.before,
            "after": around.after,
            "own": [quartet] + [quartet - 1] * earlier + [quartet + 1] * later,
            "visited": [quartet] * (before + after) + ways,
            "larger": [(len(every.frames) - 1) / max(1, before + after)],
            "flow_row": [targets.flow_rows[quartet] if optical else 0],
            "flow_weight": [float(weight)],
        }
        return Choice(FtorfKey(flows, before, after, earlier, later, optical), numbers)

    def terms(
        self, targets: Targets, key: FtorfKey, given: Given, settings: ReconSettings, draw: Draw
    ) -> dict[str, Tensor]:
        """Raw frames around one quartet, its optical flow, and the regularisers of the flow."""
        pixels = draw.pixels(self.settings.rays, targets.views.pixels)
        rays = targets.views.rays(given["view"], pixels)
        depths, weight = self.depths(rays, draw), settings.weights.quads
        points = rays.at(depths.z)
        if not key.flows:
            with self.precision():
                trunk = self.trunk(points[None], given["quartet"])
                samples = self.samples(trunk, rays, depths, draw=draw)
            mse = _errors(targets, given, samples, pixels).mean()
            more = self.more_terms(rays, depths, samples, settings)
            return {"quads": weight * mse} | self.noted(mse, samples) | more
        with self.precision():
            # the flows of its neighbours are of the same products
            rows = points.expand(len(given["own"]), *points.shape)
            own, flow = self.values_and_flow(rows, given["own"], seen=1, flowing=0)
            flows = neighbours(flow, earlier=key.earlier, later=key.later)
            beside, gap = self._beside(key, given, points, flows)
            samples = self.samples(torch.cat([own, beside]), rays, depths, draw=draw)
        errors = _errors(targets, given, samples, pixels)
        terms = {
            "quads": weight * (errors[0] + given["larger"][0] * errors[1:].sum()),
            **regularisers(flows, gap, self.settings.scene_flow),
            **self.noted(errors.mean(), samples),
        }
        if key.optical:
            measured = picked(targets.flow, given["flow_row"], pixels)
            weights, near = (samples.alpha * samples.transmittance)[0], self.box.bounds[0]
            apart = projected(targets.camera, measured, weights, rays, depths, flows, near)
            terms["flow"] = given["flow_weight"][0] * apart
        return terms | self.more_terms(rays, depths, samples, settings)

    def compared(self, around: Around, draw: Draw) -> Around:  # noqa: ARG002
        """Which of the raw frames around a quartet start a step compares: all."""
        return around

    def more_terms(
        self,
        rays: Rays,  # noqa: ARG002
        depths: Depths,  # noqa: ARG002
        samples: Samples,  # noqa: ARG002
        settings: ReconSettings,  # noqa: ARG002
    ) -> dict[str, Tensor]:
        """Weighted terms of the loss that were not published: none."""
        return {}

    def values_and_flow(
        self, points: Float[Tensor, "T R S 3"], quartets: Int[Tensor, "T"], seen: int, flowing: int
    ) -> tuple[Float[Tensor, "t R S w"], Float[Tensor, "u R S 2 3"]]:
        """Values of the first rows of points at the quartets of the rows, ``seen`` of them, and
        scene flow [m] of those from row ``flowing`` on.
        """
        trunk = self.trunk(points, quartets)
        if seen == flowing:  # the gradient of a split is one copy, that of two slices four
            values, flows = trunk.split([seen, len(trunk) - seen])
        else:
            values, flows = trunk[:seen], trunk[flowing:]
        return values, self.moving.flow(flows, self.box.reach)

    def _beside(
        self, key: FtorfKey, given: Given, points: Float[Tensor, "R S 3"], flows: Neighbours
    ) -> tuple[Float[Tensor, "b R S w"], Tensor]:
        """Values of the points where the raw frames beside the start of a quartet see them, and the
        mean gap after a flow and the flow back [m].
        """
        before, after = (given[name][:, None, None, None] for name in ("before", "after"))
        moved = [points + before * flows.from_before, points + after * flows.from_after]
        ways = [(flows.forward, BACKWARD)] * key.later + [(flows.backward, FORWARD)] * key.earlier
        moved += [(points + flow)[None] for flow, _ in ways]
        count = key.before + key.after
        beside, back = self.values_and_flow(
            torch.cat(moved), given["visited"], seen=count, flowing=count
        )
        gaps = [
            (flow + returned[..., returns, :]).abs().mean()
            for (flow, returns), returned in zip(ways, back, strict=True)
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
                row = points[None]
                _, flow = self.values_and_flow(row, self.quartet(source), seen=0, flowing=0)
                points = points + abs(share) * flow[0, ..., BACKWARD if share > 0 else FORWARD, :]
            return self.samples(self.trunk(points[None], self.quartet(quartet))[0], rays, depths)


def _errors(
    targets: Targets, given: Given, samples: Samples, pixels: Int[Tensor, "R"]
) -> Float[Tensor, "B"]:
    """Mean squared error of the slot that each raw frame measured [optimised units^2]."""
    sensor = targets.observations.sensor
    passed = samples.transmittance
    shift, slope = (given[name][:, None, None] for name in ("shift", "slope"))
    rendered = composite.modulated(samples, sensor, passed, shift, slope)
    measured = targets.quads[given["frames"][:, None], pixels]
    return (rendered - measured).square().mean(dim=1)
