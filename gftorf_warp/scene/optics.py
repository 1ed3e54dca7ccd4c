"""Non-uniform illumination: fall-off of the lens, beam of the emitter (notes, 2.2 and 2.8).

With th the angle between a pixel's ray and the optical axis, the light of a pixel is multiplied by

    light of the emitter: beam(th) cos^n(th) V(r) M         ambient light: cos^n(th) V(r) M

r is 1 in the farthest corner of the image, M is a measured map. On a frontal wall an isotropic
emitter gives cos^3; with a lens of n = 4 cos^7; with a beam of power -3, too, which lights the wall
evenly, cos^4.
"""

from __future__ import annotations

import hashlib
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
    """Deviations of a lens from a pinhole; the default is a pinhole."""

    distortion: Distortion = field(default_factory=Distortion)
    """Distortion in OpenCV's model."""
    cosine_power: float = 0.0
    """Power n of the cosine by which the image darkens towards its edge [1]; 4: a thin lens."""
    vignetting: tuple[float, ...] = ()
    """Coefficients v of V = 1 + v_1 r^2 + v_2 r^4 + ... [1], r = 1 in the farthest corner."""
    beam_power: float = 0.0
    """Power of the cosine by which the beam of the emitter weakens to the side [1]; 0: isotropic;
    -3: a frontal wall is lit evenly. The light over the whole image is the same."""
    falloff: FilePath | None = None
    """File of a map M of the light per pixel, normalised by its maximum [1]: .npy [h, w],
    one-channel .exr or grey .png, linear, of any size; relative to the scene file that names it.
    None: M = 1."""

    def __post_init__(self):
        for name in ("cosine_power", "beam_power", "vignetting"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        r2 = np.linspace(0.0, 1.0, 101)
        if not (self._vignette(r2) > 0).all() or self._vignette(r2).max() > 1 + 1e-9:
            raise ValueError(
                f"vignetting must keep V above 0 and not above 1 for r from 0 to 1, "
                f"got {self.vignetting}"
            )
        if self.falloff is not None:
            object.__setattr__(self, "falloff", FilePath(self.falloff))
            _ = self.map  # a bad file is an error when the lens is made

    def __repr__(self):
        """With a hash of the map instead of its path; without map, without that field."""
        shown = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name != "falloff"]
        if self.falloff is not None:
            shown.append(f"falloff=sha256 {hashlib.sha256(self.map.tobytes()).hexdigest()[:16]}")
        return f"Lens({', '.join(shown)})"

    @cached_property
    def map(self) -> Float[np.ndarray, "h w"] | None:
        """The map in ``falloff``, normalised by its maximum [1]."""
        return None if self.falloff is None else read_falloff(self.falloff)

    def _vignette(self, r2: np.ndarray) -> np.ndarray:
        """V at squared radii [1]."""
        return np.polynomial.polynomial.polyval(r2, (1.0, *self.vignetting)) * np.ones_like(r2)


class Beam(NamedTuple):
    """Beam of an emitter: factor max(cosine, least)^power, and nothing backwards."""

    power: float
    """Power of the cosine of the angle to the axis [1]."""
    factor: float
    """Intensity on the axis [1]."""
    least: float
    """Cosine beyond which a beam of negative power is constant: the image corner's [1]; else 0."""


class Shading(NamedTuple):
    """Factors of the light of each pixel [1]."""

    active: Float[np.ndarray, "H W"]
    """For the emitter's light: beam and lens."""
    ambient: Float[np.ndarray, "H W"]
    """For ambient light: the lens alone."""


def beam_of(lens: Lens, camera: Camera) -> Beam | None:
    """The beam of the emitter, of mean 1 over the solid angle of the image; None: isotropic."""
    if not lens.beam_power:
        return None
    cosine = camera.directions()[..., 2].numpy()
    solid_angle = cosine**3  # of a pixel of a flat sensor, up to a factor
    factor = float(solid_angle.sum() / (solid_angle * cosine**lens.beam_power).sum())
    return Beam(lens.beam_power, factor, float(cosine.min()) if lens.beam_power < 0 else 0.0)


def shading(lens: Lens, camera: Camera, *, beam: bool = True) -> Shading | None:
    """Factors of the light of the pixels of a camera; None: 1 everywhere.

    ``beam``: include that of an emitter at the camera; False if it is part of the traced light.
    """
    shape = beam_of(lens, camera) if beam else None
    if not (lens.cosine_power or lens.vignetting or lens.falloff or shape):
        return None
    cosine = camera.directions()[..., 2].numpy()
    tangent = np.sqrt(np.maximum(1.0 / cosine**2 - 1.0, 0.0))
    r2 = (tangent / tangent.max()) ** 2 if tangent.max() > 0 else tangent
    ambient = cosine**lens.cosine_power * lens._vignette(r2)
    if lens.map is not None:
        ambient = ambient * resized(lens.map, camera.height, camera.width)
    active = ambient if shape is None else ambient * cosine**shape.power * shape.factor
    return Shading(active=active, ambient=ambient)


def lens_rows(lens: Lens) -> dict[str, str]:
    """Rows of a data card on lens and beam; empty for a pinhole and an isotropic emitter."""
    rows = {}
    if lens.distortion:
        rows["distortion"] = f"{lens.distortion}, OpenCV's coefficients"
    if lens.cosine_power or lens.vignetting:
        more = "".join(f" {v:+g} r^{2 * i}" for i, v in enumerate(lens.vignetting, start=1))
        powers = f"cosine to the power {lens.cosine_power:g}, times 1{more}"
        rows["fall-off"] = f"{powers} with r = 1 in the farthest corner"
    if lens.falloff is not None and lens.map is not None:
        size, least = "{1}x{0}".format(*lens.map.shape), lens.map.min()
        rows["fall-off map"] = f"{lens.falloff.name}, {size}, down to {least:.3g} of its largest"
    if lens.beam_power:
        rows["beam"] = f"cosine to the power {lens.beam_power:g}, mean 1 over the image"
    return rows
