"""Look-alikes of five ToeRF scenes: a person acts, and both cameras move on an arc.

Only the subject is borrowed; the recipes are ours (sensor notes, 4.4). One second, 30 quartets of
raw quads, each raw frame with its own pose; written with ``--format torf`` it becomes 30 phasors.
Colours are free choices.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .assembly import Assembly, Part
from .bodies import CLOTH, SKIN, around, box, person, plain, wall_and_floor
from .curves import Curve, Guided, Turn
from .lookalikes import look_alike
from .lookalikes_real import FIELD_OF_VIEW_DEG
from .paths import Path, Still, Vector, rotation_matrix
from .scene import ColourCamera, Recipe
from .sensors import torf_real
from .world import Body, Box

FRAMES = 120  # one second
COLOUR = ColourCamera(
    width=640,
    height=480,
    horizontal_fov_deg=math.degrees(2 * math.atan(320 / 520)),
    position=(0.04, 0.0, 0.0),
    noise=0.004,
)
FLOOR, WALL, WOOD = 0.09, 0.12, 0.10  # [turns] hues


def carried_camera(centre: float, yaw_deg_per_s: float, pitch_deg: float) -> Guided:
    """An arc about a point ``centre`` [m] ahead, looking down by ``pitch_deg``, with a tremor."""
    pitch = math.radians(pitch_deg)
    return Guided(
        y=Curve(swing=0.004, swing_hz=3.0),
        z=centre,
        turns=(
            Turn(axis="y", angle=Curve(start=-0.5 * yaw_deg_per_s, rate=yaw_deg_per_s)),
            Turn(axis="x", angle=-pitch_deg),
        ),
        arm=(0.0, centre * math.sin(pitch), -centre * math.cos(pitch)),
    )


def _carried(*texts: Any, centre: float, yaw_deg_per_s: float, pitch_deg: float = 0.0) -> Recipe:
    """A recipe with a colour camera, moving for one second."""
    return look_alike(
        *texts,
        sensor=torf_real(),
        frames=FRAMES,
        horizontal_fov_deg=FIELD_OF_VIEW_DEG,
        camera_path=carried_camera(centre, yaw_deg_per_s, pitch_deg),
        colour=COLOUR,
    )


@_carried(
    "a person opens the lid of a copier",
    "camera on an arc, lid and arm turn",
    0.123,
    centre=2.3,
    yaw_deg_per_s=6.0,
)
def photocopier() -> tuple[Body, ...]:
    """A lid is opened."""
    lift = Turn(axis="x", angle=Curve(start=-8.0, eased=-44.0))

    def lifted(arm: Vector) -> Path:
        return Guided(y=0.28, z=2.75, turns=(lift,), arm=arm)

    return (
        *_room(3.4, 1.1, 0.5, 0.3),
        box((1.10, 0.80, 0.64), (0.0, 0.70, 2.45), plain(0.55, 0.55)),
        box((1.04, 0.05, 0.60), lifted((0.0, -0.025, -0.30)), plain(0.45, 0.55)),
        box((0.40, 0.08, 0.08), lifted((0.62, -0.05, -0.55)), plain(0.4, CLOTH)),
        *person(0.85, 0.10, 2.55),
    )


@_carried(
    "a person opens a cupboard with things in it",
    "camera on an arc, door turns",
    0.395,
    centre=2.2,
    yaw_deg_per_s=-5.0,
)
def cupboard() -> tuple[Body, ...]:
    """A door is opened before things of several sizes."""
    swing = Turn(axis="y", angle=Curve(start=12.0, eased=60.0))

    def hinged(arm: Vector) -> Path:
        return Guided(x=-0.45, y=0.15, z=2.19, turns=(swing,), arm=arm)

    wood = plain(0.5, WOOD)
    case = [box((1.10, 1.70, 0.02), (0.10, 0.15, 2.64), wood)]
    case += [box((0.02, 1.70, 0.44), (x, 0.15, 2.42), wood) for x in (-0.44, 0.64)]
    boards = ((1.10, 0.44, -0.69), (1.10, 0.44, 0.99), (1.06, 0.42, 0.15))
    case += [box((width, 0.02, deep), (0.10, y, 2.42), wood) for width, deep, y in boards]
    turned = (0.0, -95.0, 0.0)
    x, y, z = np.add((0.65, 0.15, 2.19), rotation_matrix(turned) @ (-0.27, 0.0, 0.0)).tolist()
    return (
        *_room(3.2, 1.05, 0.5, 0.35),
        *case,
        box((0.22, 0.30, 0.20), (-0.20, -0.01, 2.45), plain(0.25, 0.0)),
        box((0.18, 0.20, 0.18), (0.15, 0.04, 2.45), plain(0.6, 0.5)),
        box((0.26, 0.36, 0.22), (0.38, 0.80, 2.45), around(0.4, 0.4, 0.06, 0.33)),
        box((0.54, 1.70, 0.02), hinged((0.27, 0.0, 0.0)), wood),
        box((0.54, 1.70, 0.02), Still(position=(x, y, z), turn_deg=turned), wood),
        box((0.08, 0.08, 0.40), hinged((0.50, 0.10, -0.22)), plain(0.4, SKIN)),
        *person(Curve(start=-0.95, swing=0.04, swing_hz=0.5), 0.10, 1.90),
    )


@_carried(
    "a person puts a carton on a desk",
    "camera on an arc, carton is carried",
    0.188,
    centre=2.2,
    yaw_deg_per_s=7.0,
)
def deskbox() -> tuple[Body, ...]:
    """A carton is carried in an arc onto a desk with a dark screen."""
    wood = plain(0.4, WOOD)
    curves = {"x": Curve(start=-0.42, eased=0.42), "y": Curve(start=0.27, arched=-0.12)}

    def carried(arm: Vector = (0.0, 0.0, 0.0)) -> Path:
        turn = Turn(axis="y", angle=Curve(eased=25.0))
        return Guided(**curves, z=Curve(start=2.10, eased=-0.10), turns=(turn,), arm=arm)

    return (
        *_room(3.3, 1.06, 0.5, 0.35),
        box((1.60, 0.04, 0.75), (0.0, 0.42, 2.15), plain(0.45, WOOD)),
        *(box((0.04, 0.62, 0.70), (x, 0.75, 2.15), wood) for x in (-0.74, 0.74)),
        box((0.52, 0.32, 0.04), (0.52, 0.22, 2.35), plain(0.06, 0.6)),
        box((0.34, 0.26, 0.28), carried(), around(0.5, 0.2, 0.08, 0.08)),
        *(
            box((0.08, 0.08, 0.45), carried((x, -0.02, 0.20)), plain(0.35, CLOTH))
            for x in (-0.21, 0.21)
        ),
        *person(Curve(start=-0.42, eased=0.42), 0.05, 2.75),
    )


def _phonebooth(wall: float) -> tuple[Body, ...]:
    """A person behind the frame of a door; ``wall`` [m] says how far away the room ends."""
    stile, rail = Box(size=(0.06, 2.0, 0.03)), Box(size=(0.80, 0.06, 0.03))
    parts = [Part(shape=stile, position=(x - 0.46, 0.0, 0.0)) for x in (0.03, 0.89)]
    parts += [Part(shape=rail, position=(0.0, y, 0.0)) for y in (-0.97, 0.0, 0.97)]
    swing = Turn(axis="y", angle=Curve(start=75.0, eased=-35.0))
    door = Guided(x=-0.48, y=0.05, z=2.30, turns=(swing,), arm=(0.46, 0.0, 0.0))

    def swaying(x: float) -> Curve:
        return Curve(start=x, swing=0.10, swing_hz=0.5)

    return (
        *_room(wall, 1.10, 0.45, 0.3),
        *(box((0.04, 2.10, 0.90), (x, 0.05, 2.75), plain(0.4, 0.98)) for x in (-0.50, 0.50)),
        box((1.04, 2.10, 0.03), (0.0, 0.05, 3.20), plain(0.35, 0.98)),
        box((1.04, 0.04, 0.90), (0.0, -1.0, 2.75), plain(0.4, 0.98)),
        Body(shape=Assembly(parts=tuple(parts)), texture=plain(0.5, 0.98), path=door),
        *person(swaying(0.05), -0.05, 2.85),
        *(
            box((0.14, 0.80, 0.14), Guided(x=swaying(x), y=0.65, z=2.85), plain(0.2, CLOTH))
            for x in (-0.05, 0.15)
        ),
    )


CLOSING = "a person closes the door of a phone booth"
FRAME_TURNS = "camera on an arc, frame of a door turns"


@_carried(CLOSING, FRAME_TURNS, 1.555, centre=2.6, yaw_deg_per_s=-4.0)
def phonebooth() -> tuple[Body, ...]:
    """In a room of usual depth."""
    return _phonebooth(3.4)


@_carried(
    f"{CLOSING}, before a wall that wraps", FRAME_TURNS, 1297.9, centre=2.6, yaw_deg_per_s=-4.0
)
def phonebooth_far() -> tuple[Body, ...]:
    """The same in a room that ends beyond the unambiguous range."""
    return _phonebooth(6.2)


@_carried(
    "a person turns the page of a book on a desk",
    "camera on an arc, a page turns",
    0.213,
    centre=1.7,
    yaw_deg_per_s=5.0,
    pitch_deg=10.0,
)
def studybook() -> tuple[Body, ...]:
    """Small, near and slow: a page of 2 mm is turned."""
    page = Turn(axis="z", angle=Curve(start=-10.0, eased=-160.0))
    cover = around(0.6, 0.4, 0.03, 0.15)
    reaching = Guided(x=Curve(start=0.30, eased=-0.20), y=Curve(start=0.38, arched=-0.10), z=1.78)
    return (
        *_room(3.0, 1.1, 0.5, 0.35),
        box((1.40, 0.04, 0.70), (0.0, 0.45, 1.65), plain(0.4, WOOD)),
        *(box((0.20, 0.02, 0.27), (x, 0.42, 1.55), cover) for x in (-0.10, 0.10)),
        box(
            (0.19, 0.002, 0.26),
            Guided(y=0.405, z=1.55, turns=(page,), arm=(0.095, 0.0, 0.0)),
            plain(0.7, 0.15),
        ),
        box((0.08, 0.07, 0.35), (-0.30, 0.38, 1.75), plain(0.4, CLOTH)),
        box((0.08, 0.07, 0.35), reaching, plain(0.4, CLOTH)),
        *person(Curve(swing=0.02, swing_hz=0.4), 0.10, 2.15),
    )


def _room(z: float, y: float, wall: float, floor: float) -> tuple[Body, Body]:
    return wall_and_floor(z, y, around(wall, 0.2, 0.3, WALL), around(floor, 0.2, 0.3, FLOOR))


CARRIED = (photocopier, cupboard, deskbox, phonebooth, phonebooth_far, studybook)
"""All five, and one variant."""
