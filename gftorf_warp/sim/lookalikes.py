"""Look-alikes of the seven synthetic F-ToeRF scenes: as hard for the closed form.

Scene files, materials and speeds of the published scenes are not public. These are recipes of ours
with about two knobs each, turned until the error of the closed form was near the published one, and
for that alone (sensor notes, 4.2). Raw frame n is at n / 120 s; ``STEP`` turns metres per raw frame
into metres per second.
"""

from __future__ import annotations

from functools import partial

from ..constants import FRAME_RATE_HZ
from ..scene.sensor import Sensor
from .bodies import around, box, chair, passing, plain, wall_and_floor
from .paths import Arc, Line, Path, Vector
from .scene import recipe
from .world import Body, Texture

FRAMES = 60
STEP = FRAME_RATE_HZ  # [1/s]
MIDDLE = (FRAMES - 1) / 2 / FRAME_RATE_HZ  # [s] between the two raw frames in the middle
# one ideal tap; frequency and shifts are those of the public files
SENSOR = Sensor(dc_offset=1.0, unipolar=True)
look_alike = partial(recipe, frames=FRAMES, width=320, height=240)
_synthetic = partial(look_alike, sensor=SENSOR)


@_synthetic("a small plain cube slides in front of a wall", "sideways, 10 px per quartet", 0.105)
def sliding_cube() -> tuple[Body, ...]:
    """Purely sideways and plain: only outlines go wrong."""
    cube = passing(FRAMES, (0.0, 0.47, 2.4984), (0.021817 * STEP, 0.0, 0.0))
    return (*wall_and_floor(2.6, 0.9, plain(0.5), plain(0.4)), _cube(0.16, cube, plain(0.55)))


@_synthetic("a small plain cube slides behind a pole", "sideways, hidden for a while", 0.142)
def occlusion() -> tuple[Body, ...]:
    """The cube is gone for a while."""
    pole = box((0.08, 2.0, 0.08), (0.05, 0.1, 1.0), plain(0.5))
    cube = passing(FRAMES, (0.0, 0.15, 2.25), (0.023274 * STEP, 0.0, 0.0))
    return (*wall_and_floor(2.5, 0.9, plain(0.5), plain(0.4)), pole, _cube(0.2, cube, plain(0.5)))


@_synthetic("three textured cubes come nearer at three speeds", "axial, 2.4 to 4.0 m/s", 2.047)
def z_motion_speed_test() -> tuple[Body, ...]:
    """Phase changes on whole faces, and the closed form lags and ripples."""
    starts = ((-0.45, 0.30, 1.0), (0.05, -0.22, 0.8), (0.48, 0.25, 0.6))
    grey = around(0.5, 0.2, 0.3)
    cubes = [
        _cube(0.168, Line(position=(x, y, 3.2), velocity=(0.0, 0.0, -0.033051 * part * STEP)), grey)
        for x, y, part in starts
    ]
    return (*wall_and_floor(3.9, 1.0, around(0.5, 0.2, 0.3), around(0.4, 0.2, 0.3)), *cubes)


@_synthetic(
    "three textured cubes slide at three speeds", "sideways, 12 to 30 px per quartet", 3.148
)
def speed_test_texture() -> tuple[Body, ...]:
    """Three speeds side by side, with texture."""
    rows = ((-0.55, 0.032567), (0.05, 0.054280), (0.62, 0.081420))
    cubes = [_cube(0.383, _row(y, 3.2, step), around(0.5, 0.2, 0.25)) for y, step in rows]
    return (*wall_and_floor(3.8, 1.0, around(0.5, 0.2, 0.25), around(0.4, 0.2, 0.25)), *cubes)


@_synthetic(
    "three chairs of thin bars slide at three speeds", "sideways, thin parts, 10 to 30 px", 0.670
)
def speed_test_chair() -> tuple[Body, ...]:
    """Bars of two pixels, so that nearly every pixel of a chair is an outline."""
    rows = ((-0.55, 0.032124), (0.05, 0.064248), (0.62, 0.096372))
    chairs = [
        Body(shape=chair(), texture=around(0.5, 0.1, 0.3), path=_row(y, 3.561, step))
        for y, step in rows
    ]
    return (*wall_and_floor(3.8, 1.0, around(0.5, 0.1, 0.3), around(0.4, 0.1, 0.3)), *chairs)


@_synthetic(
    "a bright plain cube swings on a circle before a dark wall",
    "arc, 31 px per quartet, dark wall",
    37.50,
)
def arcing_cube() -> tuple[Body, ...]:
    """Bright and near before dark and far: what mixes may decode to any distance."""
    path = Arc(centre=(0.0, 0.1, 2.6), radius=1.2, start_deg=-145.0, rate_deg_per_s=1.8644 * STEP)
    return (*wall_and_floor(4.5, 1.1, plain(0.15), plain(0.12)), _cube(0.311, path, plain(0.4)))


@_synthetic(
    "three large textured cubes come nearer on crossing ways before a dark wall",
    "sideways and axial, 4.9 to 5.7 m/s",
    43.78,
)
def acute_z_speed_test() -> tuple[Body, ...]:
    """Sideways and nearer at once; the cubes pass through each other."""
    ways: tuple[tuple[Vector, Vector], ...] = (
        ((-1.5, 0.1, 4.2), (0.25, 0.1, 2.0)),
        ((1.6, -0.5, 3.8), (-0.05, -0.2, 2.1)),
        ((-0.5, 0.6, 4.6), (1.0, 0.45, 2.4)),
    )
    dark = around(0.08, 0.5, 0.2)
    cubes = [_cube(0.9875, _way(*way), around(0.5, 0.5, 0.2)) for way in ways]
    return (*wall_and_floor(6.05, 1.2, dark, dark), *cubes)


def _row(y: float, z: float, step: float) -> Line:
    """To the right at height ``y`` and depth ``z`` [m], ``step`` metres per raw frame."""
    return passing(FRAMES, (0.0, y, z), (step * STEP, 0.0, 0.0))


def _cube(edge: float, path: Path, texture: Texture) -> Body:
    return box((edge, edge, edge), path, texture)


def _way(start: Vector, end: Vector) -> Line:
    """Straight from ``start`` to ``end`` [m], from the first raw frame to the last."""
    seconds = (FRAMES - 1) / FRAME_RATE_HZ
    x, y, z = ((b - a) / seconds for a, b in zip(start, end, strict=True))
    return Line(position=start, velocity=(x, y, z))


TEXTURED = (z_motion_speed_test, speed_test_texture, speed_test_chair)
SYNTHETIC = (sliding_cube, occlusion, *TEXTURED, arcing_cube, acute_z_speed_test)
"""All seven, easiest kind of motion first."""
