"""Rigid paths of which each coordinate and each angle is a curve: a sum of a few simple motions.

They describe swinging, falling, opening and waving. A hinge is a fixed position, a turn, and an arm
from its axis to the body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .paths import Path, Vector, rigid, rotation_matrix

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A coordinate [m] or angle [deg] as a function of time: the sum of all terms below.

    Eased terms follow e(t) = (1 - cos(pi t)) / 2, from 0 to 1 within the first second, constant
    before and after.
    """

    start: float = 0.0
    """Value at time 0, without the swing."""
    rate: float = 0.0
    """First derivative at time 0 [per s]."""
    acceleration: float = 0.0
    """Second derivative [per s^2]."""
    swing: float = 0.0
    """Amplitude of swing sin(2 pi swing_hz t + phase)."""
    swing_hz: float = 1.0
    """Its frequency [Hz]."""
    swing_phase_deg: float = 0.0
    """Its phase at time 0 [deg]."""
    eased: float = 0.0
    """Amplitude of e(t)."""
    arched: float = 0.0
    """Amplitude of sin(pi e(t)): out and back."""

    def __call__(self, time: float) -> float:
        """Value at ``time`` [s]."""
        value = self.start + self.rate * time + 0.5 * self.acceleration * time**2
        value += self.swing * math.sin(
            2.0 * math.pi * self.swing_hz * time + math.radians(self.swing_phase_deg)
        )
        ease = 0.5 - 0.5 * math.cos(math.pi * min(max(time, 0.0), 1.0))
        return value + self.eased * ease + self.arched * math.sin(math.pi * ease)


@dataclass(frozen=True, kw_only=True)
class Turn:
    """A turn about one coordinate axis."""

    axis: str
    """'x', 'y' or 'z'."""
    angle: float | Curve
    """Angle [deg]; positive takes y to z, z to x, x to y."""

    def __post_init__(self):
        if self.axis not in AXES:
            raise ValueError(f"axis must be one of {', '.join(AXES)}, got {self.axis!r}")


@dataclass(frozen=True, kw_only=True)
class Guided(Path):
    """A pivot, rotations one after the other, and an arm that turns with the body."""

    x: float | Curve = 0.0
    """x of the pivot [m]."""
    y: float | Curve = 0.0
    """y of the pivot [m]."""
    z: float | Curve = 0.0
    """z of the pivot [m]."""
    turns: tuple[Turn, ...] = ()
    """Orientation as the product of these, the first leftmost: the last is applied first."""
    arm: Vector = (0.0, 0.0, 0.0)
    """From the pivot to the origin of the body's axes, in those axes [m]."""

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Pose at ``time`` [s]."""
        rotation = np.eye(3)
        for turn in self.turns:
            x, y, z = (component * _at(turn.angle, time) for component in AXES[turn.axis])
            rotation = rotation @ rotation_matrix((x, y, z))
        point = np.array([_at(coordinate, time) for coordinate in (self.x, self.y, self.z)])
        return rigid(rotation, point + rotation @ np.asarray(self.arm))


def _at(value: float | Curve, time: float) -> float:
    return value(time) if isinstance(value, Curve) else value
