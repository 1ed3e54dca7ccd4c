"""Distortion of a lens, OpenCV's five coefficients, and its inverse.

With x = X/Z, y = Y/Z and r^2 = x^2 + y^2, a lens images what a pinhole would have at (x, y) at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Rays are looked up by the inverse, found once per pixel by Newton's iteration. Raw frames are never resampled to undo a
distortion: interpolation mixes surfaces as motion does.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

Coordinate = TypeVar("Coordinate", np.ndarray, Tensor)
STEPS_MAX = 30
CONVERGED = 1e-12  # [1] of image coordinates, a billionth of a pixel
SHRINK_MIN = 1e-3  # [1] area on the sensor per area of the pinhole's image; at 0 the lens folds the world over


@dataclass(frozen=True, kw_only=True)
class Distortion:
    """Coefficients as OpenCV names them [1]; the default is a pinhole."""

    k1: float = 0.0
    """Of r^2; negative: barrel."""
    k2: float = 0.0
    """Of r^4."""
    p1: float = 0.0
    """Tangential, down."""
    p2: float = 0.0
    """Tangential, across."""
    k3: float = 0.0
    """Of r^6."""

    def __post_init__(self):
        for f in fields(self):
            if not math.isfinite(getattr(self, f.name)):
                raise ValueError(f"{f.name} must be finite, got {getattr(self, f.name)}")

    @classmethod
    def of(cls, coefficients: tuple[float, float, float, float, float] | None) -> Distortion:
        """That of k1, k2, p1, p2, k3, OpenCV's order; None is a pinhole."""
        return (
            cls()
            if coefficients is None
            else cls(**dict(zip((f.name for f in fields(cls)), coefficients, strict=True)))
        )

    def __bool__(self) -> bool:
        """Whether there is any."""
        return any(astuple(self))

    def apply(self, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
        """Where the lens images what a pinhole would have at (x, y) [1]; arrays or tensors of any shape."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def undo(
        self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """Where a pinhole would have what the lens images at (x, y) [1], which are broadcast.

        Raises:
            ValueError: If some place on the sensor sees nothing, or two things, through such a lens.
        """
        wanted = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        u, v = (axis.copy() for axis in wanted)
        with np.errstate(all="ignore"):  # what runs away is found below
            for _ in range(STEPS_MAX):
                got = self.apply(u, v)
                dx, dy = wanted[0] - got[0], wanted[1] - got[1]
                xx, xy, yy = self._slope(u, v)
                area = xx * yy - xy * xy
                u, v = u + (dx * yy - dy * xy) / area, v + (dy * xx - dx * xy) / area
                if np.abs(dx).max() < CONVERGED and np.abs(dy).max() < CONVERGED:
                    break
            got = self.apply(u, v)
            error = np.maximum(np.abs(wanted[0] - got[0]), np.abs(wanted[1] - got[1]))
            good = (error < 1e3 * CONVERGED) & self._unfolded(u, v)
        if not good.all():
            worst = np.unravel_index(np.argmin(good), good.shape)
            raise ValueError(
                f"a lens with {self} cannot be undone at ({wanted[0][worst]:.3g}, {wanted[1][worst]:.3g}) focal "
                f"lengths from the principal point"
            )
        return u, v

    def _slope(self, x, y):
        """Derivatives of what the lens images: d x'/dx, d x'/dy = d y'/dx, d y'/dy."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        bend = 2 * (self.k1 + r2 * (2 * self.k2 + 3 * self.k3 * r2))
        return (
            radial + bend * x * x + 2 * self.p1 * y + 6 * self.p2 * x,
            bend * x * y + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + bend * y * y + 6 * self.p1 * y + 2 * self.p2 * x,
        )

    def _unfolded(self, x, y):
        """Whether the lens images everything between the axis and (x, y) the right way round."""
        good = np.ones(np.shape(x), dtype=bool)
        for part in np.linspace(0.1, 1.0, 10):
            xx, xy, yy = self._slope(part * x, part * y)
            good &= (xx * yy - xy * xy > SHRINK_MIN) & (xx > 0)
        return good
