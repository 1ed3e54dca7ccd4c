"""Look-alikes of the five recorded F-ToeRF scenes: static OPT8241 at 20 MHz (notes, 4.3).

Only subject and kind of motion are borrowed. At 30 MHz all but the fan would wrap; the target wraps
at 20 MHz too. Colours are free choices.
"""

from __future__ import annotations

import math
from functools import partial

from ..scene.sensor import Sensor
from .bodies import around, ball, box, plain, wall_and_floor
from .curves import Curve, Guided, Turn
from .lookalikes import MIDDLE, look_alike
from .paths import Path
from .sensors import PALINDROMIC
from .world import Body, Texture

# [deg] 320 pixels at the focal length of 230 of the OPT8241
FIELD_OF_VIEW_DEG = math.degrees(2 * math.atan(160 / 230))
SENSOR = Sensor(f_mod_hz=20e6, shifts=PALINDROMIC, noise=True)
GRAVITY = 9.81  # [m/s^2]
RPM = 550.0  # [1/min] of the fan; at 600 three blades take each other's places in every quartet
_recorded = partial(look_alike, sensor=SENSOR, horizontal_fov_deg=FIELD_OF_VIEW_DEG)


@_recorded("a cushion falls and tumbles", "falling, 18 px per quartet", 2.108, frames=64)
def pillow() -> tuple[Body, ...]:
    """Thrown down, tumbling."""
    path = Guided(
        x=0.15,
        y=Curve(start=-1.1, rate=0.3, acceleration=GRAVITY),
        z=2.4,
        turns=(Turn(axis="z", angle=Curve(rate=80.0)), Turn(axis="x", angle=Curve(rate=60.0))),
    )
    return (
        *wall_and_floor(4.2, 1.15, around(0.5, 0.2, 0.4), around(0.35, 0.2, 0.4)),
        box((0.5, 0.36, 0.14), path, plain(0.7)),
    )


@_recorded(
    "a bat is swung in front of a person who stands",
    "turning, 117 px per quartet at the tip",
    1.492,
)
def baseball() -> tuple[Body, ...]:
    """Fast and thin: the tip moves at 26 m/s, more than 100 pixels in a quartet."""
    rate = -math.degrees(25.0)  # [deg/s]
    swing = Turn(axis="y", angle=Curve(start=-rate * MIDDLE, rate=rate))
    bat = Guided(x=0.0, y=0.05, z=2.6, turns=(swing,), arm=(0.62, 0.0, 0.0))
    return (
        *wall_and_floor(4.5, 1.3, around(0.5, 0.2, 0.4), around(0.3, 0.2, 0.4)),
        box((0.4, 0.7, 0.24), (-0.05, 0.2, 2.75), plain(0.35)),
        box((0.16, 0.9, 0.16), (-0.15, 0.95, 2.75), plain(0.2)),
        box((0.16, 0.9, 0.16), (0.08, 0.95, 2.75), plain(0.2)),
        ball(0.12, (0.0, -0.3, 2.75), plain(0.4)),
        box((0.84, 0.06, 0.06), bat, plain(0.5)),
    )


@_recorded(
    "a person does jumping jacks", "arms and legs on arcs, 22 px per quartet", 2.970, frames=68
)
def jacks() -> tuple[Body, ...]:
    """Many joints at once."""
    limbs = []
    for side in (-1, 1):
        arm = Turn(axis="z", angle=Curve(start=-55.0 * side, swing=75.0 * side, swing_hz=1.6))
        leg = Turn(axis="z", angle=Curve(start=64.0 * side, swing=-11.0 * side, swing_hz=1.6))
        shoulder = Guided(x=0.22 * side, y=-0.22, z=2.8, turns=(arm,), arm=(0.3 * side, 0.0, 0.0))
        hip = Guided(x=0.1 * side, y=0.28, z=2.8, turns=(leg,), arm=(0.42 * side, 0.0, 0.0))
        limbs.append(box((0.6, 0.1, 0.1), shoulder, plain(0.35)))
        limbs.append(box((0.84, 0.14, 0.14), hip, plain(0.25)))

    def bobbing(y: float) -> Path:
        return Guided(y=Curve(start=y, swing=0.06, swing_hz=3.2, swing_phase_deg=90.0), z=2.8)

    return (
        *wall_and_floor(4.5, 1.2, around(0.4, 0.2, 0.4), around(0.25, 0.2, 0.4)),
        box((0.4, 0.6, 0.24), bobbing(-0.02), plain(0.3)),
        ball(0.12, bobbing(-0.5), plain(0.45)),
        *limbs,
    )


@_recorded(
    "a chequered board is carried past, before a wall beyond the unambiguous range",
    "sideways, 9 px per quartet, wraps",
    1925.6,
    frames=68,
)
def target() -> tuple[Body, ...]:
    """A wall beyond the unambiguous range: a third of all pixels wraps."""
    board = Guided(
        x=Curve(start=-4.0 * MIDDLE, rate=4.0),
        y=-0.1,
        z=Curve(start=4.0 + 1.2 * MIDDLE, rate=-1.2),
        turns=(Turn(axis="y", angle=Curve(start=-60.0 * MIDDLE, rate=60.0)),),
    )
    checks = Texture(low=0.05, high=0.5, cell=0.117)
    return (
        *wall_and_floor(6.8, 1.4, around(0.12, 0.3, 0.5), around(0.1, 0.3, 0.5)),
        box((0.7, 0.7, 0.04), board, checks),
    )


@_recorded(f"three blades of a fan turn at {RPM:g} rpm", "turning, 57 px per quartet", 10.31)
def fan() -> tuple[Body, ...]:
    """Periodic: the blades pass a third of their circle in four raw frames."""

    def blade(first: float) -> Body:
        spin = Turn(axis="z", angle=Curve(start=first, rate=6.0 * RPM))
        path = Guided(z=1.5, turns=(spin, Turn(axis="x", angle=25.0)), arm=(0.12, 0.0, 0.0))
        return box((0.2, 0.1, 0.008), path, plain(0.6))

    return (
        *wall_and_floor(3.5, 1.1, plain(0.5), plain(0.3)),
        *(blade(120.0 * i) for i in range(3)),
        box((0.06, 1.0, 0.06), (0.0, 0.55, 1.56), plain(0.4)),
        box((0.1, 0.1, 0.12), (0.0, 0.0, 1.53), plain(0.4)),
    )


RECORDED = (pillow, baseball, jacks, target, fan)
