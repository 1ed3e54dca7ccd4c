"""Distortion of a lens by OpenCV's five coefficients, and its inverse.

With x = X/Z, y = Y/Z and r^2 = x^2 + y^2, a lens images the point (x, y) of a pinhole image at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Rays are computed by the inverse, by Newton's iteration. Raw frames are never resampled to undo a
distortion: interpolation mixes surfaces as motion does.

A polynomial that was fitted inside an image may not be monotonic outside, and would fold invisible
points into the image. Within a disc of radius R about the axis it does not fold; outside, it is
extrapolated by the tangent:

    p = min(1, R / r) (x, y),   (x', y')  becomes  D(p) + J(p) ((x, y) - p)

J is symmetric, and positive definite in the disc, so that (x', y') moves outwards along every ray
from the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

Coordinate = TypeVar("Coordinate", np.ndarray, Tensor)
STEPS_MAX = 30
CONVERGED = 1e-12  # [1] of image coordinates, a billionth of a pixel
ANGLES, RADII = 64, 512  # numbers of angles and radii at which a lens is checked for folds
SHRINK_MIN = 1e-3  # [1] least area magnification; at 0 the image folds


def inside(x: Coordinate, y: Coordinate, radius: float) -> tuple[Coordinate, Coordinate]:
    """The point (x, y) [1], clamped to ``radius`` [1] from the axis."""
    share = (radius**2 / (x * x + y * y).clip(radius**2)) ** 0.5
    return share * x, share * y


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
        """From k1, k2, p1, p2, k3, OpenCV's order; None is a pinhole."""
        names = [f.name for f in fields(cls)]
        return cls(**dict(zip(names, coefficients or [0.0] * 5, strict=True)))

    def __bool__(self) -> bool:
        """Whether any coefficient is not zero."""
        return any(vars(self).values())

    def apply(
        self, x: Coordinate, y: Coordinate, radius: float = math.inf
    ) -> tuple[Coordinate, Coordinate]:
        """Image of the point (x, y) [1] of a pinhole image; beyond ``radius`` by the tangent."""
        if math.isfinite(radius):
            near_x, near_y = inside(x, y, radius)
            xx, xy, yy = self.slope(near_x, near_y)
            dx, dy = x - near_x, y - near_y
            x, y = self.apply(near_x, near_y)
            return x + (xx * dx + xy * dy), y + (xy * dx + yy * dy)
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def undo(
        self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."], radius: float = math.inf
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """Inverse of :meth:`apply` at (x, y) [1], which are broadcast.

        Raises:
            ValueError: If a position has no inverse, or two.
        """
        wanted = np.broadcast_arrays(*(np.asarray(axis, dtype=np.float64) for axis in (x, y)))
        u, v = (axis.copy() for axis in wanted)
        with np.errstate(all="ignore"):  # divergence is detected below
            for _ in range(STEPS_MAX):
                got = self.apply(u, v, radius)
                dx, dy = wanted[0] - got[0], wanted[1] - got[1]
                xx, xy, yx, yy = self._derivative(u, v, radius)
                area = xx * yy - xy * yx
                u, v = u + (dx * yy - dy * xy) / area, v + (dy * xx - dx * yx) / area
                if max(np.abs(dx).max(initial=0.0), np.abs(dy).max(initial=0.0)) < CONVERGED:
                    break
            got = self.apply(u, v, radius)
            error = np.maximum(np.abs(wanted[0] - got[0]), np.abs(wanted[1] - got[1]))
            good = error < 1e3 * CONVERGED * np.maximum(1.0, np.hypot(*wanted))
            good &= self._unfolded(u, v, radius)
        if not good.all():
            worst = np.unravel_index(np.argmin(good), good.shape)
            where = f"({wanted[0][worst]:.3g}, {wanted[1][worst]:.3g})"
            raise ValueError(
                f"a lens with {self} cannot be undone at {where} focal lengths from the principal "
                "point"
            )
        return u, v

    def _derivative(self, x, y, radius):
        """All four derivatives of ``apply``; beyond ``radius`` they are not symmetric."""
        if not math.isfinite(radius):
            xx, xy, yy = self.slope(x, y)
            return xx, xy, xy, yy
        near_x, near_y = inside(x, y, radius)
        xx, xy, yy = self.slope(near_x, near_y)
        r = np.maximum(np.hypot(x, y), radius)
        cosine, sine, step = x / r, y / r, 1e-4 * radius
        ends = [self.slope(near_x + side * cosine, near_y + side * sine) for side in (step, -step)]
        bend = [
            (there - here) / (2 * step) * (r - radius) * radius / r
            for there, here in zip(*ends, strict=True)
        ]
        # along (-sine, cosine)
        to_x, to_y = bend[1] * cosine - bend[0] * sine, bend[2] * cosine - bend[1] * sine
        return xx - to_x * sine, xy + to_x * cosine, xy - to_y * sine, yy + to_y * cosine

    def slope(self, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate, Coordinate]:
        """Derivatives [1] of the polynomial: d x'/dx, d x'/dy = d y'/dx, d y'/dy."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        bend = 2 * (self.k1 + r2 * (2 * self.k2 + 3 * self.k3 * r2))
        return (
            radial + bend * x * x + 2 * self.p1 * y + 6 * self.p2 * x,
            bend * x * y + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + bend * y * y + 6 * self.p1 * y + 2 * self.p2 * x,
        )

    def radius(self, corner: float, most: float) -> float:
        """Radius R of the disc in which the lens does not fold [1], at most ``most``.

        Raises:
            ValueError: If it folds nearer to the axis than ``corner`` [1].
        """
        angle = np.linspace(0.0, 2.0 * math.pi, ANGLES, endpoint=False)
        part = np.linspace(0.0, most, RADII + 1)[1:, None]
        x, y = part * np.cos(angle), part * np.sin(angle)
        xx, xy, yy = self.slope(x, y)
        good = ((xx * yy - xy * xy > SHRINK_MIN) & (xx > 0)).all(axis=1)
        radius = most if good.all() else most * int(good.argmin()) / RADII
        if radius < corner:
            raise ValueError(
                f"a lens with {self} folds the image {radius:.3g} focal lengths from the "
                f"principal point, and the image reaches to {corner:.3g}"
            )
        return radius

    def _unfolded(self, x, y, radius):
        """Whether the lens does not fold between the axis and (x, y)."""
        if math.isfinite(radius):
            x, y = inside(x, y, radius)
        good = np.ones(np.shape(x), dtype=bool)
        for part in np.linspace(0.1, 1.0, 10):
            xx, xy, yy = self.slope(part * x, part * y)
            good &= (xx * yy - xy * xy > SHRINK_MIN) & (xx > 0)
        return good
