"""How evenly light reaches the pixels: fall-off of the lens, beam of the emitter (sensor notes, 2.2 and 2.8).

With th the angle between a pixel's ray and the optical axis, a pixel gets

    of its own light       beam(th) cos^n(th) V(r)         of any light      cos^n(th) V(r)

times what it would get otherwise. r is 1 in the farthest corner of the image. On a frontal wall an isotropic emitter
gives cos^3; with a lens of n = 4 cos^7; and with it and a beam of power -3, which lights the wall evenly, cos^4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .camera import Camera
from .distortion import Distortion


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What a real lens does that a pinhole does not; the default is a pinhole."""

    distortion: Distortion = field(default_factory=Distortion)
    """Where it images what, as OpenCV says it."""
    cosine_power: float = 0.0
    """Power n of the cosine by which the image darkens towards its edge [1]; 4: the law of a thin lens."""
    vignetting: tuple[float, ...] = ()
    """Coefficients v of V = 1 + v_1 r^2 + v_2 r^4 + ... [1], r = 1 in the farthest corner; none: V = 1."""
    beam_power: float = 0.0
    """Power of the cosine of the angle by which the emitter at the camera shines less to the side [1]; 0: evenly;
    -3: a wall in front is lit evenly. The light over the whole image stays the same."""

    def __post_init__(self):
        for name, values in (
            ("cosine_power", (self.cosine_power,)),
            ("beam_power", (self.beam_power,)),
            ("vignetting", self.vignetting),
        ):
            if not all(math.isfinite(value) for value in values):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        r2 = np.linspace(0.0, 1.0, 101)
        if not (self._vignette(r2) > 0).all() or self._vignette(r2).max() > 1 + 1e-9:
            raise ValueError(f"vignetting must keep V above 0 and not above 1 for r from 0 to 1, got {self.vignetting}")

    def _vignette(self, r2: np.ndarray) -> np.ndarray:
        """V at squared radii [1]."""
        return np.polynomial.polynomial.polyval(r2, (1.0, *self.vignetting)) * np.ones_like(r2)


class Shading(NamedTuple):
    """What of the light reaches each pixel, as a multiple [1]."""

    active: Float[np.ndarray, "H W"]
    """Of the emitter's light: beam and lens."""
    ambient: Float[np.ndarray, "H W"]
    """Of all other light: the lens alone."""


def shading(lens: Lens, camera: Camera) -> Shading | None:
    """How evenly light reaches the pixels of a camera; None: alike everywhere.

    The beam is that of an emitter at the camera. Its mean over the solid angle of the image, as a pinhole of the same
    field of view has it, is 1: what a beam takes from the edge it gives to the middle.
    """
    if not (lens.cosine_power or lens.vignetting or lens.beam_power):
        return None
    cosine = camera.directions()[..., 2].numpy()
    tangent = np.sqrt(np.maximum(1.0 / cosine**2 - 1.0, 0.0))
    ambient = cosine**lens.cosine_power * lens._vignette(
        (tangent / tangent.max()) ** 2 if tangent.max() > 0 else tangent
    )
    beam = cosine**lens.beam_power
    solid_angle = cosine**3  # of a pixel of a flat sensor, up to a factor
    return Shading(active=ambient * beam * (solid_angle.sum() / (solid_angle * beam).sum()), ambient=ambient)


def lens_rows(lens: Lens) -> dict[str, str]:
    """What of a lens and a beam goes beyond a pinhole and even light, for people; empty: nothing."""
    rows = {}
    if lens.distortion:
        rows["distortion"] = f"{lens.distortion}, OpenCV's coefficients"
    if lens.cosine_power or lens.vignetting:
        more = "".join(f" {v:+g} r^{2 * i}" for i, v in enumerate(lens.vignetting, start=1))
        rows["fall-off"] = f"cosine to the power {lens.cosine_power:g}, times 1{more} with r = 1 in the farthest corner"
    if lens.beam_power:
        rows["beam"] = f"cosine to the power {lens.beam_power:g}, mean 1 over the image"
    return rows
