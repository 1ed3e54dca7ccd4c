"""A measurement as residuals compare it with a fit: all that does not depend on the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..constants import SPEED_OF_LIGHT
from ..data import temporal
from ..data.decode import closed_form_distance, unambiguous_range
from ..data.noise import QuadNoise, quad_noise
from ..data.sequence import Sequence
from ..errors import InputError
from .observations import as_compared, reduced
from .settings import Input, Method

CONTRADICTION = 0.025  # [unambiguous ranges of the first frequency] 19 cm at 20 MHz
SIGMAS = 3.0  # [standard deviations of the temporal mean] that are no contradiction


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """The Q complete quartets of a recording."""

    sequence: Sequence
    """At the size of the fit; without a constant part if phasors are compared."""
    noise: QuadNoise
    """Of its quads."""
    changes: Bool[np.ndarray, "Q H W"] | None
    """Where the quartet does not agree with its pixel's median; None: the camera moves."""
    mean: Float[np.ndarray, "Q H W"] | None
    """Distance of the temporal mean [m]; None: the camera moves."""
    reach: Float[np.ndarray, "H W"] | None
    """A fit that is farther from it [m] contradicts it; None: the camera moves."""

    @classmethod
    def of(cls, sequence: Sequence, config: Mapping[str, Any]) -> Compared | None:
        """That of a sequence at its own size, for a run with this config.json.

        Returns:
            None where nothing was fitted to quads (closed forms, colour alone), or no quartet is
            complete.
        """
        settings = config.get("settings", {})
        fitted = Method(settings.get("method", Method.GAUSSIANS)).fits
        if not fitted or not settings.get("weights", {}).get("quads", 1.0) > 0:
            return None
        width = config.get("size_optimised", (sequence.width, sequence.height))[0]
        compared = as_compared(reduced(sequence, width), Input(config.get("input", Input.QUADS)))
        try:
            noise = quad_noise(compared)
        except InputError:  # shifts that determine no phase can be fitted, but not decoded
            return None
        if noise is None:
            return None
        changes = mean = reach = None
        if temporal.camera_rests(compared):
            agrees, averaged = temporal.agreement(compared), temporal.averaged(compared)
            changes, quartets = ~agrees, compared.complete_quartets
            mean = np.stack([closed_form_distance(averaged, i) for i in quartets])
            far = CONTRADICTION * SPEED_OF_LIGHT / (2.0 * compared.frequencies[0])
            sigma = temporal.sigma_of_mean(compared, noise, agrees.sum(axis=0))
            reach = np.maximum(far, SIGMAS * sigma)
        return cls(sequence=compared, noise=noise, changes=changes, mean=mean, reach=reach)

    def contradicted(self, distance: Float[np.ndarray, "Q H W"]) -> Bool[np.ndarray, "Q H W"]:
        """Where rendered distances [m] are far from the mean of a quartet that agrees with it."""
        if self.changes is None or self.mean is None:
            return np.zeros(distance.shape, dtype=bool)
        period = unambiguous_range(self.sequence)
        apart = np.abs((distance - self.mean + 0.5 * period) % period - 0.5 * period)
        return ~self.changes & ~(apart <= self.reach)
