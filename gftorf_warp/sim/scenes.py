"""All named scenes, and our own: textured rooms with moving bodies.

All distances of our own are inside the unambiguous range of 7.5 m.
"""

from __future__ import annotations

import re
from functools import partial

from .bodies import ball, box, passing, room
from .calibration import CALIBRATION
from .lookalikes import SYNTHETIC
from .lookalikes_real import RECORDED
from .lookalikes_torf import CARRIED
from .paths import Arc, Path, Still, Sweep, Vector, Viewpoint
from .random_scene import PREFIX, random_scene
from .scene import ColourCamera, Scene, recipe
from .world import Body, Plane, Texture

_ours = partial(recipe, frames=48, width=160, height=120)
TARGET = (0.0, 0.1, 2.7)  # [m] that the camera of the tour faces
VIEWS = (
    (-0.45, -0.1, 0.0),
    (-0.2, -0.35, 0.1),
    (0.0, 0.2, 0.0),
    (0.0, 0.0, 0.4),
    (0.2, -0.35, 0.1),
    (0.45, -0.1, 0.0),
)  # [m] off its path


def _box(edges: Vector, where: Path | Vector, cell: float = 0.15) -> Body:
    return box(edges, where, Texture(low=0.3, high=0.9, cell=cell))


@_ours(
    "a textured box crosses a textured room, coming nearer",
    "sideways and in depth",
    13.02,
    frames=44,
    width=96,
    height=72,
)
def demo() -> tuple[Body, ...]:
    """The scene of ``gftorf demo``: small, quick, wrong in closed form along the box."""
    return room(), _box((0.6, 0.6, 0.6), passing(44, (-0.16, -0.2, 2.65), (4.9, 2.9, -2.7)))


@_ours("a box slides from left to right in front of the back wall, past a ball", "sliding", 3.738)
def sliding() -> tuple[Body, ...]:
    """Purely sideways: only the outline of the box has errors."""
    still = ball(0.35, (1.25, 0.8, 3.7), Texture(low=0.5, high=0.9, cell=0.2))
    return room(), still, _box((0.6, 0.6, 0.6), passing(48, (0.0, -0.1, 2.8), (3.0, 0.0, 0.0)))


@_ours("a ball flies towards the camera while a box moves away from it", "axial", 2.637)
def axial() -> tuple[Body, ...]:
    """Along the line of sight: the phase changes, and the closed form lags and ripples."""
    approach = passing(48, (-0.55, 0.0, 2.9), (0.0, 0.0, -4.0))
    retreat = passing(48, (0.7, 0.2, 2.7), (0.0, 0.0, 3.0))
    texture = Texture(low=0.3, high=0.9, cell=0.12)
    return room(), ball(0.4, approach, texture), _box((0.6, 0.6, 0.6), retreat)


@_ours("a box swings on a horizontal circle, towards the camera and away", "arc", 6.471)
def arc() -> tuple[Body, ...]:
    """On a circle, turning: sideways and in depth in changing proportion."""
    path = Arc(centre=(0.0, 0.05, 3.2), radius=0.75, start_deg=-170.0, rate_deg_per_s=400.0)
    picture = _picture((0.9, 0.6), (-1.1, -0.7, 4.1), Texture(low=0.05, high=0.95, cell=0.15))
    return room(), picture, _box((0.5, 0.7, 0.5), path, 0.14)


@_ours(
    "a camera is carried past a desk over which a ball swings by; with a colour camera",
    "camera and ball on arcs",
    2.488,
    frames=120,
    camera_path=Sweep(
        middle=(0.0, 0.0, 0.0), target=TARGET, sweep_deg=9.0, period_s=2.0, rise=0.05
    ),
    colour=ColourCamera(width=320, height=240, position=(0.04, 0.0, 0.0), noise=0.004),
    novel_views=tuple(Viewpoint(position=at, target=TARGET) for at in VIEWS),
)
def tour() -> tuple[Body, ...]:
    """A camera moves past a desk, as in the TöRF family: phasors, colour, poses."""
    path = Arc(centre=(0.0, -0.2, 2.75), radius=0.55, start_deg=-180.0, rate_deg_per_s=180.0)
    desk = Texture(low=0.45, high=0.7, cell=0.25, hue=0.08)
    chest = Texture(low=0.3, high=0.9, cell=0.15, hue=0.35)
    carton = Texture(low=0.4, high=0.9, cell=0.12, hue=0.17)
    return (
        room(hue=0.55),
        box((2.2, 0.08, 1.0), (0.1, 0.62, 2.75), desk),
        box((0.5, 0.9, 0.5), (-1.35, 0.7, 3.6), chest),
        box((0.45, 0.36, 0.35), (0.65, 0.4, 2.75), carton),
        ball(0.2, (-0.6, 0.38, 2.65), Texture(low=0.5, high=0.95, cell=0.1, hue=0.75)),
        _picture((1.3, 0.8), (0.55, -0.75, 4.15), Texture(low=0.1, high=0.95, cell=0.16)),
        ball(0.3, path, Texture(low=0.35, high=0.95, cell=0.13, hue=0.98)),
    )


def _picture(size: tuple[float, float], position: Vector, texture: Texture) -> Body:
    return Body(shape=Plane(size=size), texture=texture, path=Still(position=position))


OURS = (demo, sliding, axial, arc, tour)
LOOK_ALIKES = (*SYNTHETIC, *RECORDED, *CARRIED)
SCENES: dict[str, Scene] = {
    scene.name: scene for scene in (make() for make in (*OURS, *LOOK_ALIKES, *CALIBRATION))
}
"""All named scenes, that of ``gftorf demo`` first, then the others of our own, ``OURS``."""


def named_scene(name: str, seed: int = 0) -> Scene | None:
    """A scene by its name; ``random`` is ``random-SEED``, drawn. None if there is none."""
    if name == PREFIX:
        return random_scene(seed)
    if match := re.fullmatch(rf"{PREFIX}-(\d+)", name):
        return random_scene(int(match[1]))
    return SCENES.get(name)
