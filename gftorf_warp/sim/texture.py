"""Reflectance of a surface: a pattern in the axes of its body, partly Lambertian, partly glossy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SATURATION = 0.6  # [1] of the colours: no channel is less than 0.4 of the brightest
HUE_SPREAD = 0.2  # [turns] range of the hues of one texture
TEXTURE_ORIGIN = 37.0001  # [m] cell numbers are positive, cell borders not at round numbers


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Reflectance in hashed cells of a 3-D grid (sensor notes, 4.1); ``low == high``: plain.

    In colour each cell has a hue, hashed from other bits, and its brightest channel is its
    reflectance.
    """

    low: float
    """Smallest reflectance [1]."""
    high: float
    """Largest reflectance [1]."""
    cell: float = 0.3
    """Edge of a cell [m]."""
    hue: float | None = None
    """Middle of the cells' hues, in turns: 0 red, 1/3 green, 2/3 blue; None: all hues."""
    gloss: float = 0.0
    """Share of the reflectance in a specular lobe, the rest Lambertian [1]; engine 'mesh' only."""
    shininess: float = 50.0
    """Exponent of that lobe [1]: 10 is satin, 1000 nearly a mirror; its half width is 1.2 /
    sqrt(shininess) [rad]."""

    def __post_init__(self):
        if not 0 <= self.gloss <= 1 or not 0 <= self.shininess < np.inf:
            got = f"{self.gloss} and {self.shininess}"
            raise ValueError(f"gloss must be 0 to 1, shininess 0 or more and finite, got {got}")
        if self.gloss > 0 and self.high > 1:
            most = f"high {self.high} must be <= 1"
            raise ValueError(f"a glossy surface reflects at most the incident light: {most}")
        if not 0 <= self.low <= self.high:
            got = f"low {self.low}, high {self.high}"
            raise ValueError(f"reflectances must be 0 <= low <= high, got {got}")
        if not self.cell > 0:
            raise ValueError(f"cell must be above 0, got {self.cell}")

    def __repr__(self):
        """Without the hue, and without the lobe if there is none."""
        names = ("low", "high", "cell", *(("gloss", "shininess") if self.gloss else ()))
        return f"Texture({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    def __call__(self, point: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Reflectance [1] at points in the body's axes [m]."""
        return self.low + (self.high - self.low) * (self._hash(point) & 0xFFFF) / 65535.0

    def albedo(self, point: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Albedo in linear RGB [1] at points in the body's axes [m]."""
        unit = ((self._hash(point) >> 16) & 0xFFFF) / 65536.0
        hue = unit if self.hue is None else self.hue + HUE_SPREAD * (unit - 0.5)
        # HSV to RGB, all sectors at once
        ramp = np.abs((6.0 * hue[:, None] + [0.0, 4.0, 2.0]) % 6.0 - 3.0) - 1.0
        return self(point)[:, None] * (1.0 - SATURATION * (1.0 - np.clip(ramp, 0.0, 1.0)))

    def shading(self, cosine: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        """Amplitude [1] per reflectance at this cosine of incidence, light at the camera."""
        # cosine between the view and the mirrored light
        twice = np.maximum(2.0 * cosine**2 - 1.0, 0.0)
        lobe = 0.5 * (self.shininess + 2.0) * twice**self.shininess if self.gloss else 0.0
        return cosine * (1.0 + self.gloss * (lobe - 1.0))

    def _hash(self, point: Float[np.ndarray, "P 3"]) -> Int[np.ndarray, "P"]:
        """A number of each point's cell; the lower 32 bits are those of unbounded integers."""
        x, y, z = np.floor((point.T + TEXTURE_ORIGIN) / self.cell).astype(np.int64)
        return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) * 2654435761
