"""Shapes, textures and paths drawn at random, for :mod:`.random_scene`.

Lengths are drawn for an unambiguous range of 7.5 m and multiplied by ``unit`` [1].
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from ..constants import FRAME_RATE_HZ
from .assembly import Assembly, Part
from .curves import Curve, Guided, Turn
from .paths import Arc, Line, Path, Vector
from .world import Box, Shape, Sphere, Texture

MIDDLE = 59 / 2 / FRAME_RATE_HZ  # [s] middle of 60 raw frames
SECONDS = 2 * MIDDLE
AT_REST = ("box", "box", "ball", "ball", "pole", "pole", "panel", "frame")
MOVING = ("box", "box", "box", "ball", "ball", "stick", "stick", "frame")
MOTIONS = (*("sliding", "axial") * 2, "circling", "swinging", "oscillating", "turning")


def drawn_texture(draw: np.random.Generator, least: float, most: float, unit: float) -> Texture:
    """A mean reflectance between two [1], log-uniform; in 60 % of all draws varied in cells."""
    mean = _between(draw, least, most)
    contrast = draw.uniform(0.1, 0.7) if draw.random() < 0.6 else 0.0
    low, high = mean * (1 - contrast), min(mean * (1 + contrast), 1.0)
    return Texture(low=low, high=high, cell=unit * _between(draw, 0.05, 0.5))


def drawn_shape(
    draw: np.random.Generator, unit: float, moves: bool, height: float
) -> tuple[str, Shape]:
    """A shape with its name; ``height`` [m] is that of poles."""
    kind = str(draw.choice(MOVING if moves else AT_REST))
    thin = unit * _between(draw, 0.04, 0.18)
    long = unit * draw.uniform(0.6, 1.3)
    shape: Shape
    if kind == "ball":
        shape = Sphere(radius=unit * draw.uniform(0.12, 0.5))
    elif kind == "box":
        x, y, z = unit * draw.uniform(0.2, 1.0, 3)
        shape = Box(size=(x, y, z))
    elif kind == "panel":
        shape = Box(size=(long, unit * draw.uniform(0.4, 1.2), 0.3 * thin))
    elif kind == "frame":
        wide = unit * draw.uniform(0.35, 0.9)
        shape = _frame(wide, long, max(0.5 * thin, 0.03 * unit))
    else:
        shape = Box(size=(thin, height if kind == "pole" else long, thin))
    return kind, shape


def _frame(wide: float, high: float, bar: float) -> Assembly:
    """A rectangle of four bars in the plane z = 0 [m]."""
    rows: list[tuple[Vector, Vector]] = []
    for side in (-0.5, 0.5):
        rows.append(((wide, bar, bar), (0.0, side * (high - bar), 0.0)))
        rows.append(((bar, high, bar), (side * (wide - bar), 0.0, 0.0)))
    return Assembly(parts=tuple(Part(shape=Box(size=size), position=at) for size, at in rows))


def drawn_path(
    draw: np.random.Generator, at: Vector, unit: float, *, turned: bool
) -> tuple[str, Path]:
    """A motion through a point [m], near the middle of 60 raw frames, with its name.

    The way within 60 raw frames is 0.2 to 4 m, log-uniform. ``turned``: the orientation is drawn
    and in a third of the straight motions it changes.
    """
    kind = str(draw.choice(MOTIONS))
    way = unit * _between(draw, 0.2, 4.0)
    if kind == "circling":
        return kind, _circling(draw, at, way, unit)
    if kind == "swinging":
        return kind, _swinging(draw, at, way, unit)
    if kind == "oscillating":
        return kind, _oscillating(draw, at, way, turned)
    pitch, yaw, roll = (draw.uniform((-30.0, -180.0, -60.0), (30.0, 180.0, 60.0)) * turned).tolist()
    towards = np.array(at) if kind == "axial" else draw.normal(size=3) * (1.0, 0.35, 0.5)
    speed = draw.choice((-1.0, 1.0)) * way / SECONDS * (0.2 if kind == "turning" else 1.0)
    rate = _between(draw, 90.0, 720.0)  # [deg/s]
    turns = turned and (kind == "turning" or draw.random() < 1 / 3)
    spin = _vector(rate * _unit(draw.normal(size=3)) if turns else np.zeros(3))
    if kind == "turning" and not turned:
        kind, speed = "sliding", 5.0 * speed  # a ball that turns in place does not move
    return kind + (", turning" if turns and kind != "turning" else ""), Line(
        position=at,
        velocity=_vector(speed * _unit(towards)),
        passing_s=MIDDLE,
        turn_deg=(pitch, yaw, roll),
        spin_deg_per_s=spin,
    )


def _circling(draw: np.random.Generator, at: Vector, way: float, unit: float) -> Arc:
    """A horizontal circle that passes the point in the middle of the sequence."""
    radius, middle = unit * draw.uniform(0.3, 1.0), draw.uniform(-180.0, 180.0)
    rate = draw.choice((-1.0, 1.0)) * math.degrees(way / radius) / SECONDS
    x, z = radius * math.cos(math.radians(middle)), radius * math.sin(math.radians(middle))
    return Arc(
        centre=(at[0] - x, at[1], at[2] - z),
        radius=radius,
        start_deg=middle - rate * MIDDLE,
        rate_deg_per_s=rate,
    )


def _swinging(draw: np.random.Generator, at: Vector, way: float, unit: float) -> Guided:
    """A pendulum of which the point is the lowest."""
    length = unit * draw.uniform(0.4, 1.0)
    swing = Curve(swing=min(math.degrees(way / length / 2), 50.0), **_rhythm(draw))
    about = Turn(axis=str(draw.choice(("x", "z"))), angle=swing)
    yaw = Turn(axis="y", angle=draw.uniform(-90.0, 90.0))
    x, y, z = at
    return Guided(x=x, y=y - length, z=z, turns=(about, yaw), arm=(0.0, length, 0.0))


def _oscillating(draw: np.random.Generator, at: Vector, way: float, turned: bool) -> Guided:
    """To and fro through the point, on a straight line."""
    rhythm, along = _rhythm(draw), way / 2 * _unit(draw.normal(size=3) * (1.0, 0.35, 0.6))
    x, y, z = (
        Curve(start=start, swing=float(swing), **rhythm)
        for start, swing in zip(at, along, strict=True)
    )
    angles = (draw.uniform(-60.0, 60.0, 2) * turned).tolist()
    turns = tuple(Turn(axis=axis, angle=angle) for axis, angle in zip("yz", angles, strict=True))
    return Guided(x=x, y=y, z=z, turns=turns)


def _rhythm(draw: np.random.Generator) -> dict[str, float]:
    """Frequency and phase of a swing."""
    return {
        "swing_hz": float(draw.uniform(0.8, 3.0)),
        "swing_phase_deg": float(draw.uniform(-180.0, 180.0)),
    }


def _between(draw: np.random.Generator, least: float, most: float) -> float:
    """A log-uniform number."""
    return math.exp(draw.uniform(math.log(least), math.log(most)))


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)


def _vector(values: Float[np.ndarray, "3"]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
