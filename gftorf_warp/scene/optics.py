"""How evenly light reaches the pixels: fall-off of the lens, beam of the emitter (sensor notes, 2.2 and 2.8).

With th the angle between a pixel's ray and the optical axis, a pixel gets

    of its own light       beam(th) cos^n(th) V(r) M       of any light      cos^n(th) V(r) M

times what it would get otherwise. r is 1 in the farthest corner of the image, M is a map that was measured. On a
frontal wall an isotropic emitter gives cos^3; with a lens of n = 4 cos^7; and with it and a beam of power -3, which
lights the wall evenly, cos^4.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .camera import Camera
from .distortion import Distortion
from .falloff import read_falloff, resized


@dataclass(frozen=True, kw_only=True, repr=False)
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
    falloff: FilePath | None = None
    """A map M of the light that reaches each pixel, over its largest value [1]: .npy [h, w], one-channel .exr or grey
    .png, linear, of any size; relative to the scene file that names it. None: M = 1."""

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

        if self.falloff is not None:
            object.__setattr__(self, "falloff", FilePath(self.falloff))
            _ = self.map  # a bad file is named when the lens is made

    def __repr__(self):
        """A map by content, not by place; without one, as if there were none."""
        shown = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name != "falloff"]
        if self.falloff is not None:
            shown.append(f"falloff=sha256 {hashlib.sha256(self.map.tobytes()).hexdigest()[:16]}")
        return f"Lens({', '.join(shown)})"

    @cached_property
    def map(self) -> Float[np.ndarray, "h w"] | None:
        """What ``falloff`` holds, over its largest value [1]."""
        return None if self.falloff is None else read_falloff(self.falloff)

    def _vignette(self, r2: np.ndarray) -> np.ndarray:
        """V at squared radii [1]."""
        return np.polynomial.polynomial.polyval(r2, (1.0, *self.vignetting)) * np.ones_like(r2)


class Beam(NamedTuple):
    """How an emitter shines to the side: factor max(cosine, least)^power, and nothing backwards."""

    power: float
    """Of the cosine of the angle to its axis [1]."""
    factor: float
    """In the direction of the axis [1]."""
    least: float
    """A beam that grows to the side grows up to this cosine, that of the corner of the image [1]; others: 0."""


class Shading(NamedTuple):
    """What of the light reaches each pixel, as a multiple [1]."""

    active: Float[np.ndarray, "H W"]
    """Of the emitter's light: beam and lens."""
    ambient: Float[np.ndarray, "H W"]
    """Of all other light: the lens alone."""


def beam_of(lens: Lens, camera: Camera) -> Beam | None:
    """The beam of the emitter of a camera; None: it shines evenly.

    Its mean over the solid angle of the image, as a pinhole of the same field of view has it, is 1: what a beam takes
    from the edge it gives to the middle.
    """
    if not lens.beam_power:
        return None
    cosine = camera.directions()[..., 2].numpy()
    solid_angle = cosine**3  # of a pixel of a flat sensor, up to a factor
    factor = float(solid_angle.sum() / (solid_angle * cosine**lens.beam_power).sum())
    return Beam(lens.beam_power, factor, float(cosine.min()) if lens.beam_power < 0 else 0.0)


def shading(lens: Lens, camera: Camera, *, beam: bool = True) -> Shading | None:
    """How evenly light reaches the pixels of a camera; None: alike everywhere.

    The beam is that of an emitter at the camera, on what it lights first; ``beam`` False: it is in the light already.
    """
    shape = beam_of(lens, camera) if beam else None
    if not (lens.cosine_power or lens.vignetting or lens.falloff or shape):
        return None
    cosine = camera.directions()[..., 2].numpy()
    tangent = np.sqrt(np.maximum(1.0 / cosine**2 - 1.0, 0.0))
    ambient = cosine**lens.cosine_power * lens._vignette(
        (tangent / tangent.max()) ** 2 if tangent.max() > 0 else tangent
    )
    if lens.map is not None:
        ambient = ambient * resized(lens.map, camera.height, camera.width)
    active = ambient if shape is None else ambient * cosine**shape.power * shape.factor
    return Shading(active=active, ambient=ambient)


def lens_rows(lens: Lens) -> dict[str, str]:
    """What of a lens and a beam goes beyond a pinhole and even light, for people; empty: nothing."""
    rows = {}
    if lens.distortion:
        rows["distortion"] = f"{lens.distortion}, OpenCV's coefficients"
    if lens.cosine_power or lens.vignetting:
        more = "".join(f" {v:+g} r^{2 * i}" for i, v in enumerate(lens.vignetting, start=1))
        rows["fall-off"] = f"cosine to the power {lens.cosine_power:g}, times 1{more} with r = 1 in the farthest corner"
    if lens.falloff is not None and lens.map is not None:
        height, width = lens.map.shape
        rows["fall-off map"] = f"{lens.falloff.name}, {width}x{height}, down to {lens.map.min():.3g} of its largest"
    if lens.beam_power:
        rows["beam"] = f"cosine to the power {lens.beam_power:g}, mean 1 over the image"
    return rows
