"""Rigid paths: position and orientation of a body or a camera at any time.

A path is a pure function of time, so that poses at the instant of a raw frame and optical flow are
exact.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Vector = tuple[float, float, float]


def rotation_matrix(turn_deg: Vector) -> Float[np.ndarray, "3 3"]:
    """Rotation of a rotation vector [deg]: axis times angle (Rodrigues)."""
    vector = np.radians(np.asarray(turn_deg, dtype=np.float64))
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def rigid(
    rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """The 4x4 matrix that turns by ``rotation`` and then shifts by ``position`` [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def inverse(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion that undoes ``pose``."""
    rotation = pose[:3, :3].T
    return rigid(rotation, 0.0 - rotation @ pose[:3, 3])  # a difference, so that there is no -0.0


def looking_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """World from camera at ``position`` [m], z axis to ``target`` [m], x axis horizontal.

    Raises:
        ValueError: If the view is straight up or down, where no x axis is more level than another.
    """
    ahead = np.subtract(target, position, dtype=np.float64)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(ahead):
        view = f"a view from {np.asarray(position).tolist()} to {np.asarray(target).tolist()}"
        raise ValueError(f"{view} is straight up or down: no axis is level")
    ahead, right = ahead / np.linalg.norm(ahead), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return rigid(rotation, np.asarray(position, dtype=np.float64))


class Path(abc.ABC):
    """A rigid motion. Final classes: Still, Line, Arc, Guided; Viewpoint, Sweep for cameras."""

    @abc.abstractmethod
    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Pose at ``time`` [s]: maps points from the body's axes to the world [m]."""


@dataclass(frozen=True, kw_only=True)
class Still(Path):
    """A body that does not move."""

    position: Vector = (0.0, 0.0, 0.0)
    """Origin of the body's axes in the world [m]."""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """Orientation as a rotation vector [deg]."""

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """The pose, at any ``time`` [s]."""
        del time
        return rigid(rotation_matrix(self.turn_deg), np.asarray(self.position, dtype=np.float64))


@dataclass(frozen=True, kw_only=True)
class Line(Path):
    """Constant velocity, and optionally a constant spin about the body's origin."""

    position: Vector
    """Origin of the body's axes at ``passing_s`` [m]."""
    velocity: Vector
    """Velocity [m/s]."""
    passing_s: float = 0.0
    """Time at which the body is at ``position`` with orientation ``turn_deg`` [s]."""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """Orientation at ``passing_s``, as a rotation vector [deg]."""
    spin_deg_per_s: Vector = (0.0, 0.0, 0.0)
    """Angular velocity in world axes, as a rotation vector [deg/s]."""

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Pose at ``time`` [s]."""
        elapsed = time - self.passing_s
        x, y, z = self.spin_deg_per_s
        spin = rotation_matrix((x * elapsed, y * elapsed, z * elapsed))
        position = np.add(self.position, np.multiply(self.velocity, elapsed))
        return rigid(spin @ rotation_matrix(self.turn_deg), position)


@dataclass(frozen=True, kw_only=True)
class Arc(Path):
    """A horizontal circle at constant rate; the body turns with it."""

    centre: Vector
    """Centre of the circle in the world [m]."""
    radius: float
    """Radius [m]."""
    start_deg: float
    """Angle at time 0 [deg]: 0 is right of the centre (+x), 90 behind it (+z), -90 before it."""
    rate_deg_per_s: float
    """Angular rate [deg/s]."""

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Pose at ``time`` [s]."""
        degrees = self.start_deg + self.rate_deg_per_s * time
        angle = math.radians(degrees)
        offset = self.radius * np.array([math.cos(angle), 0.0, math.sin(angle)])
        return rigid(rotation_matrix((0.0, -degrees, 0.0)), np.add(self.centre, offset))


@dataclass(frozen=True, kw_only=True)
class Viewpoint(Path):
    """A static camera that faces a point."""

    position: Vector
    """Position in the world [m]."""
    target: Vector
    """Point on its z axis [m]."""

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """The pose, at any ``time`` [s]."""
        del time
        return looking_at(np.asarray(self.position), np.asarray(self.target))


@dataclass(frozen=True, kw_only=True)
class Sweep(Path):
    """A camera that swings to and fro on a horizontal arc about a point that it faces."""

    middle: Vector
    """Middle of the arc [m]."""
    target: Vector
    """Centre of the arc, on the camera's z axis [m]."""
    sweep_deg: float
    """Angle between the ends of the arc, seen from the target [deg]; above 0: from the left."""
    period_s: float
    """Time for the way out and back [s]."""
    rise: float = 0.0
    """Rise in the middle of the way out, and descent in the middle of the way back [m]."""

    def __post_init__(self):
        if self.period_s == 0:
            raise ValueError("period_s must not be 0: the camera swings out and back in it")

    def world_from_body(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Pose at ``time`` [s]; at time 0 it rests at one end of the arc."""
        phase = 2.0 * math.pi * time / self.period_s
        turn = rotation_matrix((0.0, 0.5 * self.sweep_deg * math.cos(phase), 0.0))
        position = np.add(self.target, turn @ np.subtract(self.middle, self.target))
        rise = [0.0, self.rise * math.sin(phase), 0.0]
        return looking_at(position - rise, np.asarray(self.target))
