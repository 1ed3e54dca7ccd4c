"""Look-alikes of the seven synthetic F-ToeRF scenes: as hard for the closed form as the published ones, not the same.

Scene files, materials and speeds of the published scenes are not public. These are recipes of ours with about two
knobs each, turned until the error of the closed form was near the published one, and for that alone (sensor notes,
4.2). Raw frame n is at n / 120 s; ``STEP`` turns metres per raw frame into metres per second.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from ..constants import FRAME_RATE_HZ
from ..scene.sensor import Sensor
from .assembly import Assembly, Level, Part
from .paths import Arc, Line, Still, Vector
from .scene import Scene
from .world import Body, Box, Shape, Texture

FRAMES = 60
STEP = FRAME_RATE_HZ  # [1/s]
MIDDLE = (FRAMES - 1) / 2 / FRAME_RATE_HZ  # [s] between the two raw frames in the middle
SENSOR = Sensor(dc_offset=1.0, unipolar=True)  # one ideal tap; frequency and shifts are those of the public files


def sliding_cube() -> Scene:
    """Purely sideways and plain: only outlines go wrong."""
    cube = Line(position=(0.0, 0.47, 2.4984), velocity=(0.021817 * STEP, 0.0, 0.0), passing_s=MIDDLE)
    return _synthetic(
        "sliding_cube",
        "a small plain cube slides in front of a wall",
        "sideways, 10 px per quartet",
        0.105,
        (*wall_and_floor(2.6, 0.9, plain(0.5), plain(0.4)), _cube(0.16, plain(0.55), cube)),
    )


def occlusion() -> Scene:
    """The cube is gone for a while."""
    pole = Body(shape=Box(size=(0.08, 2.0, 0.08)), texture=plain(0.5), path=Still(position=(0.05, 0.1, 1.0)))
    cube = Line(position=(0.0, 0.15, 2.25), velocity=(0.023274 * STEP, 0.0, 0.0), passing_s=MIDDLE)
    return _synthetic(
        "occlusion",
        "a small plain cube slides behind a pole",
        "sideways, hidden for a while",
        0.142,
        (*wall_and_floor(2.5, 0.9, plain(0.5), plain(0.4)), pole, _cube(0.2, plain(0.5), cube)),
    )


def z_motion_speed_test() -> Scene:
    """Phase changes on whole faces, and the closed form lags and ripples."""
    starts = ((-0.45, 0.30, 1.0), (0.05, -0.22, 0.8), (0.48, 0.25, 0.6))
    grey = around(0.5, 0.2, 0.3)
    cubes = [
        _cube(0.168, grey, Line(position=(x, y, 3.2), velocity=(0.0, 0.0, -0.033051 * part * STEP)))
        for x, y, part in starts
    ]
    return _synthetic(
        "z_motion_speed_test",
        "three textured cubes come nearer at three speeds",
        "axial, 2.4 to 4.0 m/s",
        2.047,
        (*wall_and_floor(3.9, 1.0, around(0.5, 0.2, 0.3), around(0.4, 0.2, 0.3)), *cubes),
    )


def speed_test_texture() -> Scene:
    """Three speeds side by side, with texture."""
    rows = ((-0.55, 0.032567), (0.05, 0.054280), (0.62, 0.081420))
    cubes = [_cube(0.383, around(0.5, 0.2, 0.25), _row(y, 3.2, step)) for y, step in rows]
    return _synthetic(
        "speed_test_texture",
        "three textured cubes slide at three speeds",
        "sideways, 12 to 30 px per quartet",
        3.148,
        (*wall_and_floor(3.8, 1.0, around(0.5, 0.2, 0.25), around(0.4, 0.2, 0.25)), *cubes),
    )


def speed_test_chair() -> Scene:
    """Bars of two pixels, so that nearly every pixel of a chair is an outline."""
    rows = ((-0.55, 0.032124), (0.05, 0.064248), (0.62, 0.096372))
    chairs = [Body(shape=chair(), texture=around(0.5, 0.1, 0.3), path=_row(y, 3.561, step)) for y, step in rows]
    return _synthetic(
        "speed_test_chair",
        "three chairs of thin bars slide at three speeds",
        "sideways, thin parts, 10 to 30 px",
        0.670,
        (*wall_and_floor(3.8, 1.0, around(0.5, 0.1, 0.3), around(0.4, 0.1, 0.3)), *chairs),
    )


def arcing_cube() -> Scene:
    """Bright and near before dark and far: what mixes may decode to any distance."""
    path = Arc(centre=(0.0, 0.1, 2.6), radius=1.2, start_deg=-145.0, rate_deg_per_s=1.8644 * STEP)
    return _synthetic(
        "arcing_cube",
        "a bright plain cube swings on a circle before a dark wall",
        "arc, 31 px per quartet, dark wall",
        37.50,
        (*wall_and_floor(4.5, 1.1, plain(0.15), plain(0.12)), _cube(0.311, plain(0.4), path)),
    )


def acute_z_speed_test() -> Scene:
    """Sideways and nearer at once; the cubes pass through each other, which is harmless for distance."""
    ways: tuple[tuple[Vector, Vector], ...] = (
        ((-1.5, 0.1, 4.2), (0.25, 0.1, 2.0)),
        ((1.6, -0.5, 3.8), (-0.05, -0.2, 2.1)),
        ((-0.5, 0.6, 4.6), (1.0, 0.45, 2.4)),
    )
    dark = around(0.08, 0.5, 0.2)
    cubes = [_cube(0.9875, around(0.5, 0.5, 0.2), _way(*way)) for way in ways]
    return _synthetic(
        "acute_z_speed_test",
        "three large textured cubes come nearer on crossing ways before a dark wall",
        "sideways and axial, 4.9 to 5.7 m/s",
        43.78,
        (*wall_and_floor(6.05, 1.2, dark, dark), *cubes),
    )


def chair() -> Assembly:
    """A chair of nine boxes around the middle of its seat: seat, four legs, two posts, two bars between them."""
    bar, out = 0.0272, 0.1556  # [m]
    boxes: list[tuple[Vector, Vector]] = [((0.35, bar, 0.35), (0.0, 0.0, 0.0))]
    boxes += [((bar, 0.35, bar), (x, 0.175, z)) for x in (-out, out) for z in (-out, out)]
    boxes += [((bar, 0.389, bar), (x, -0.1944, out)) for x in (-out, out)]
    boxes += [((0.311, 0.070, bar), (0.0, y, out)) for y in (-out, -0.3111)]
    return Assembly(parts=tuple(Part(shape=Box(size=size), position=at) for size, at in boxes))


def plain(reflectance: float, hue: float | None = None) -> Texture:
    """One reflectance [1] everywhere; ``hue`` in turns."""
    return Texture(low=reflectance, high=reflectance, hue=hue)


def around(reflectance: float, contrast: float, cell: float, hue: float | None = None) -> Texture:
    """Reflectance [1] that varies by ``contrast`` of itself from cell to cell of ``cell`` [m]; ``hue`` in turns."""
    low, high = reflectance * (1 - contrast), min(1.0, reflectance * (1 + contrast))
    return Texture(low=low, high=high, cell=cell, hue=hue)


def wall_and_floor(z: float, y: float, wall: Texture, floor: Texture) -> tuple[Body, Body]:
    """An endless back wall at ``z`` [m] and an endless floor at ``y`` [m], textured in world axes."""

    def still(shape: Shape, texture: Texture) -> Body:
        return Body(shape=shape, texture=texture, path=Still())

    return still(Level(axis=2, value=z), wall), still(Level(axis=1, value=y), floor)


def _cube(edge: float, texture: Texture, path: Line | Arc) -> Body:
    return Body(shape=Box(size=(edge, edge, edge)), texture=texture, path=path)


def _row(y: float, z: float, step: float) -> Line:
    """To the right at height ``y`` and depth ``z`` [m], ``step`` metres per raw frame, in the middle at half time."""
    return Line(position=(0.0, y, z), velocity=(step * STEP, 0.0, 0.0), passing_s=MIDDLE)


def _way(start: Vector, end: Vector) -> Line:
    """Straight from ``start`` to ``end`` [m], from the first raw frame to the last."""
    seconds = (FRAMES - 1) / FRAME_RATE_HZ
    x, y, z = ((b - a) / seconds for a, b in zip(start, end, strict=True))
    return Line(position=start, velocity=(x, y, z))


def look_alike(
    name: str,
    description: str,
    motion: str,
    closed_form: float,
    bodies: tuple[Body, ...],
    *,
    sensor: Sensor,
    frames: int = FRAMES,
    **others: Any,
) -> Scene:
    """A scene of 320x240 pixels; ``others`` are further fields of it."""
    return Scene(
        name=name,
        description=description,
        motion=motion,
        closed_form=closed_form,
        bodies=bodies,
        frames=frames,
        width=320,
        height=240,
        sensor=sensor,
        **others,
    )


_synthetic = partial(look_alike, sensor=SENSOR)
"""60 deg wide, 60 raw frames, an ideal sensor of one tap."""

SYNTHETIC = (
    sliding_cube,
    occlusion,
    z_motion_speed_test,
    speed_test_texture,
    speed_test_chair,
    arcing_cube,
    acute_z_speed_test,
)
"""All seven, easiest kind of motion first."""
