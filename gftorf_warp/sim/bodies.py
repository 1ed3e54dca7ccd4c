"""Bodies of named scenes: boxes, balls, people, walls and rooms, with textures."""

from __future__ import annotations

from ..constants import FRAME_RATE_HZ
from .assembly import Assembly, Level, Part
from .curves import Curve, Guided
from .paths import Line, Path, Still, Vector
from .world import Body, Box, Sphere, Texture

CLOTH, SKIN = 0.62, 0.06  # [turns] hues


def plain(reflectance: float, hue: float | None = None) -> Texture:
    """One reflectance [1] everywhere; ``hue`` in turns."""
    return Texture(low=reflectance, high=reflectance, hue=hue)


def around(reflectance: float, contrast: float, cell: float, hue: float | None = None) -> Texture:
    """Reflectance [1] that varies by ``contrast`` of itself from cell to cell of ``cell`` [m]."""
    low, high = reflectance * (1 - contrast), min(1.0, reflectance * (1 + contrast))
    return Texture(low=low, high=high, cell=cell, hue=hue)


def box(size: Vector, where: Path | Vector, texture: Texture) -> Body:
    """A box, by full edge lengths [m], on a path or at rest at a position [m]."""
    return Body(shape=Box(size=size), texture=texture, path=_path(where))


def ball(radius: float, where: Path | Vector, texture: Texture) -> Body:
    """A ball of ``radius`` [m], likewise."""
    return Body(shape=Sphere(radius=radius), texture=texture, path=_path(where))


def level(axis: int, value: float, texture: Texture) -> Body:
    """An infinite plane, textured in world axes: x (0), y (1) or z (2) is ``value`` [m]."""
    return Body(shape=Level(axis=axis, value=value), texture=texture, path=Still())


def wall_and_floor(z: float, y: float, wall: Texture, floor: Texture) -> tuple[Body, Body]:
    """An infinite back wall at ``z`` [m] and an infinite floor at ``y`` [m]."""
    return level(2, z, wall), level(1, y, floor)


def room(
    *,
    left: float = -2.1,
    right: float = 2.1,
    top: float = -1.6,
    floor: float = 1.15,
    back: float = 4.2,
    hue: float | None = None,
) -> Body:
    """A textured room by coordinates [m]; the wall behind the camera is at -0.5."""
    front = -0.5
    return Body(
        shape=Box(size=(right - left, floor - top, back - front), inside=True),
        texture=Texture(low=0.3, high=0.75, cell=0.3, hue=hue),
        path=Still(position=((left + right) / 2, (top + floor) / 2, (front + back) / 2)),
    )


def person(x: float | Curve, y: float, z: float) -> tuple[Body, Body]:
    """Torso and head; (x, y, z) is the middle of the torso [m]."""
    torso, head = ((x, y, z), (x, y - 0.44, z))
    paths = [
        Guided(x=x, y=y, z=z) if isinstance(x, Curve) else (x, y, z) for x, y, z in (torso, head)
    ]
    return box((0.42, 0.60, 0.24), paths[0], plain(0.3, CLOTH)), ball(
        0.11, paths[1], plain(0.45, SKIN)
    )


def chair() -> Assembly:
    """A chair of nine boxes around the middle of its seat: seat, four legs, two posts, two bars."""
    bar, out = 0.0272, 0.1556  # [m]
    boxes: list[tuple[Vector, Vector]] = [((0.35, bar, 0.35), (0.0, 0.0, 0.0))]
    boxes += [((bar, 0.35, bar), (x, 0.175, z)) for x in (-out, out) for z in (-out, out)]
    boxes += [((bar, 0.389, bar), (x, -0.1944, out)) for x in (-out, out)]
    boxes += [((0.311, 0.070, bar), (0.0, y, out)) for y in (-out, -0.3111)]
    return Assembly(parts=tuple(Part(shape=Box(size=size), position=at) for size, at in boxes))


def passing(frames: int, position: Vector, velocity: Vector) -> Line:
    """Constant velocity [m/s] through ``position`` [m] in the middle of ``frames`` raw frames."""
    return Line(position=position, velocity=velocity, passing_s=(frames - 1) / 2 / FRAME_RATE_HZ)


def _path(where: Path | Vector) -> Path:
    return where if isinstance(where, Path) else Still(position=where)
