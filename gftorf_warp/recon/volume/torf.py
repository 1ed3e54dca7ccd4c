"""Method ``torf``: two networks blended along the ray, fitted to phasors and colour
(neural_volumes.md, sections 1 and 2; Attal et al. 2021).

One network knows no time. The other gets 256 values of its quartet, and b, which it predicts, says
how much of a sample is what moves:

    alpha = (1 - b) alpha_static + b alpha_moving,    the same for alpha times light and colour

A quartet counts as simultaneous, so what moves within one is at a wrong distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ..settings import Method, ReconSettings
from . import composite
from .choice import Choice, Given
from .composite import Samples
from .rays import Depths, Rays
from .targets import Draw, Targets, picked
from .volume import Volume

FALLEN = 0.1  # [1] weight of the phasors from ``quads_fall_at`` on


class Torf(Volume):
    """A volume with a part that rests and a part that moves from quartet to quartet."""

    method = Method.TORF
    faithful: ClassVar[tuple[str, ...]] = (
        "networks, encodings, time codes, 128 samples, compositing, 1,024 rays per step",
        "phasor (weight 8, 0.8 from step 125,000) and colour (weight 2) in turn, Adam at 1e-3",
    )
    assumed: ClassVar[tuple[str, ...]] = (
        "poses are those of the recording; published real scenes optimise theirs",
        "bounds of the rays are from decoded distances; published ones were chosen per scene",
        "the blend has its factor b also in front of what moves, which the release leaves out",
        "400,000 steps; the release states 2,000,000 and was stopped by hand",
        "falloff of its synthetic scenes, L^2 / F^2 = 4 halved",
        "the fifth output of the light, a bias of the phase that was never used, is left out",
    )

    def choice(self, targets: Targets, step: int, settings: ReconSettings, draw: Draw) -> Choice:
        """A phasor or a colour image in turn, if there is colour."""
        if targets.colour is not None and settings.weights.colour > 0 and step % 2:
            row = draw.one_of(range(len(targets.colour_frames)))
            quartet = targets.colour_frames[row] // targets.cycle
            return Choice("colour", {"row": [row], "view": [row], "quartet": [quartet]})
        row = draw.one_of(range(len(targets.phasor_frames)))
        frame, fallen = targets.phasor_frames[row], self.settings.quads_fall_at
        falls = fallen is not None and step >= fallen
        numbers: dict[str, Sequence[float]] = {
            "row": [row],
            "view": [frame],
            "quartet": [frame // targets.cycle],
            "slope": [targets.phasor_slopes[row]],
            "weight": [settings.weights.quads * (FALLEN if falls else 1.0)],
        }
        return Choice("phasor", numbers)

    def terms(
        self, targets: Targets, key: str, given: Given, settings: ReconSettings, draw: Draw
    ) -> dict[str, Tensor]:
        """The error of a phasor or of a colour image."""
        if key == "colour":
            return {"colour": settings.weights.colour * self._colour(targets, given, draw)}
        mse, samples = self._phasor(targets, given, draw)
        return {"quads": given["weight"][0] * mse} | self.noted(mse, samples)

    def _phasor(self, targets: Targets, given: Given, draw: Draw) -> tuple[Tensor, Samples]:
        """Mean squared error of (re, im) [optimised units^2], and the samples that have it."""
        pixels = draw.pixels(self.settings.rays, targets.views.pixels)
        rays = targets.views.rays(given["view"], pixels)
        samples = self._drawn(rays, given["quartet"], draw)
        sensor, passed = targets.observations.sensor, samples.transmittance
        rendered = composite.phasor(samples, sensor, passed, given["slope"])[:2]
        apart = rendered - picked(targets.phasors, given["row"], pixels)
        return torch.mean(apart.square()), samples

    def _colour(self, targets: Targets, given: Given, draw: Draw) -> Tensor:
        """Mean squared error of the colour [1]."""
        assert targets.colour is not None
        assert targets.colour_views is not None
        pixels = draw.pixels(self.settings.rays, targets.colour_views.pixels)
        rays = targets.colour_views.rays(given["view"], pixels)
        samples = self._drawn(rays, given["quartet"], draw, colour=True)
        rendered = composite.colour(samples, samples.transmittance)
        return torch.mean((rendered - picked(targets.colour, given["row"], pixels)).square())

    def _drawn(
        self, rays: Rays, quartet: Int[Tensor, "1"], draw: Draw, *, colour: bool = False
    ) -> Samples:
        """Samples at random z-depths of their cells, with noise on their densities."""
        return self._blended(rays, self.depths(rays, draw), quartet, draw, colour=colour)

    def _blended(
        self,
        rays: Rays,
        depths: Depths,
        quartet: Int[Tensor, "1"],
        draw: Draw | None,
        *,
        colour: bool,
    ) -> Samples:
        """Samples of both networks as one."""
        assert self.resting is not None, "settings of method torf have network.static"
        points = rays.at(depths.z)
        with self.precision():
            trunk = self.trunk(points[None], quartet)[0]
            share = self.moving.blend(trunk)
            moving = self.samples(trunk, rays, depths, draw=draw, colour=colour)
            trunk = self.resting.trunk(self.unit(points), None)
            resting = self.samples(
                trunk, rays, depths, draw=draw, colour=colour, network=self.resting
            )

        def mixed(rests: Tensor, moves: Tensor, share: Tensor) -> Tensor:
            return (1.0 - share) * rests + share * moves

        both = resting.colour, moving.colour
        return Samples(
            distance=moving.distance,
            alpha=mixed(resting.alpha, moving.alpha, share),
            strength=mixed(resting.strength, moving.strength, share),
            colour=None
            if both[0] is None or both[1] is None
            else mixed(both[0], both[1], share[..., None]),
        )

    def samples_at(self, time: float, rays: Rays, depths: Depths) -> Samples:
        """Samples of the quartet whose middle is nearest to a time [s]."""
        half = 0.5 * self.box.period * (1.0 - 1.0 / self.box.cycle)
        half = 0.0 if self.box.simultaneous else half
        middles = np.array(self.box.quartet_times)[self.box.quartets] + half
        quartet = self.quartet(self.box.quartets[int(np.abs(middles - time).argmin())])
        return self._blended(rays, depths, quartet, None, colour=self.box.colour)
