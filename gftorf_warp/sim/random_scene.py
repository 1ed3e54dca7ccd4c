"""Scenes drawn from a number: a room with 0 to 5 bodies at rest and 1 to 4 that move.

:func:`random_scene` draws everything from its number, light and noise included, so that ranges of
numbers are sets of scenes: some to choose settings with, others to validate them. All surfaces are
within the unambiguous range: 7.5 m at 20 MHz or, in a quarter of the scenes, 2.5 m at 60 MHz, where
lengths are a third. Wrapped distances and saturation are out of scope.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, SPEED_OF_LIGHT
from ..scene.sensor import Sensor
from .assembly import Assembly, Part
from .bodies import box
from .gaussian_cover import clearance
from .paths import Still, Viewpoint
from .random_bodies import drawn_path, drawn_shape, drawn_texture
from .scene import Scene
from .sensors import PALINDROMIC, SEQUENTIAL
from .world import Body, Box, Sphere, first_hit

PREFIX = "random"
STREAM = 1507  # first part of the seed: other draws from the same number are independent
FRAMES = 60
TIMES = np.arange(FRAMES) / FRAME_RATE_HZ  # [s]
FULL_RANGE = 7.5  # [m] unambiguous range for which lengths are given
FAR = 0.97  # [1] share of the unambiguous range for the farthest corner: noise must not wrap
NEAR = 0.6  # [m] between camera and bodies, at any frequency
APART = 1.1  # [m] the same in the middle of the sequence, where bodies are placed
WALL, WALLS = 0.2, 5  # [m] thickness of walls, and their number
ORDERS = (CANONICAL_SHIFTS, CANONICAL_SHIFTS, PALINDROMIC, SEQUENTIAL)
SMALL, SEEN = (80, 60), 30  # [px] an image, and the pixels of it in which a moving body is seen
STANDING = 0.999  # [1] height of poles over that of the room
FILLED = 0.25  # [1] largest share of the image that a body may fill


@dataclass(frozen=True, kw_only=True)
class Room:
    """Inner faces of a room in world axes, with the camera at the origin [m]."""

    left: float
    """x of the left wall."""
    right: float
    """x of the right wall."""
    top: float
    """y of the ceiling."""
    floor: float
    """y of the floor."""
    back: float
    """z of the back wall."""

    @property
    def farthest(self) -> float:
        """Distance of the farthest corner [m]."""
        x, y = max(-self.left, self.right), max(-self.top, self.floor)
        return math.sqrt(x**2 + y**2 + self.back**2)

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> bool:
        """Whether all points are inside."""
        low, high = (self.left, self.top, -np.inf), (self.right, self.floor, self.back)
        return bool(((points > low) & (points < high)).all())


@functools.lru_cache(maxsize=256)
def random_scene(number: int) -> Scene:
    """The scene ``random-NUMBER`` of a number, 0 or more.

    Drawn are: 20 or 60 MHz and the order of the shifts; room, field of view and direction of the
    camera; bodies (boxes, balls, poles, panels, sticks, frames of thin bars), sizes, reflectances
    and textures; straight, axial, circular, swinging, oscillating and turning motion, 0.2 to 4 m
    within 60 raw frames at 20 MHz; light over a factor of 60, so that the noise of the closed form
    varies by more than a decade, and ambient light in a third of the scenes.

    Raises:
        ValueError: If the number is negative.
    """
    if number < 0:
        raise ValueError(f"the number of a random scene must be 0 or more, got {number}")
    draw = np.random.default_rng((STREAM, number))
    unit = 1.0 if draw.random() < 0.75 else 1.0 / 3.0  # at 20 MHz, at 60 MHz
    sensor, room = _sensor(draw, unit), _room(draw, unit)
    yaw, pitch = np.radians((draw.uniform(-18.0, 18.0), draw.uniform(-4.0, 12.0)))
    ahead = math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)
    scene = Scene(
        name=f"{PREFIX}-{number}",
        description="drawn",
        motion="drawn",
        bodies=_walls(draw, room, unit),
        frames=FRAMES,
        width=320,
        height=240,
        horizontal_fov_deg=float(draw.uniform(50.0, 70.0)),
        subsamples=3,
        sensor=sensor,
        camera_path=Viewpoint(position=(0.0, 0.0, 0.0), target=ahead),
    )
    resting, moving = int(draw.integers(0, 6)), int(draw.integers(1, 5))
    names: dict[bool, list[str]] = {False: [], True: []}
    for moves in (False,) * resting + (True,) * moving:
        scene, name = _with_body(draw, scene, room, unit, moves)
        names[moves].append(name)
    things = ", ".join(names[False]) or "nothing"
    text = f"a room {room.back:.1f} m deep at {20 / unit:.0f} MHz; at rest: {things}"
    return replace(scene, description=text, motion=", ".join(names[True]))


def _sensor(draw: np.random.Generator, unit: float) -> Sensor:
    """Frequency, order of shifts, light and ambient light; neither full well nor quantisation."""
    # amplitudes are as large at both scales: nearer surfaces, less light
    light = 3.144e5 * unit**2 * 10.0 ** draw.uniform(-0.4, 1.4)
    ambient = 10.0 ** draw.uniform(4.0, 5.0) if draw.random() < 1 / 3 else 0.0
    return Sensor(
        f_mod_hz=SPEED_OF_LIGHT / (2.0 * FULL_RANGE * unit),
        shifts=ORDERS[draw.integers(len(ORDERS))],
        noise=True,
        electrons_per_unit=light,
        ambient_electrons=ambient,
        full_well_electrons=math.inf,
        adc_bits=None,
    )


def _room(draw: np.random.Generator, unit: float) -> Room:
    """A room whose farthest corner is within the unambiguous range."""
    while True:
        left, right, top, floor = draw.uniform((1.3, 1.3, 0.9, 0.8), (3.0, 3.0, 1.9, 1.5)) * unit
        back = draw.uniform(max(3.4 * unit, 1.6), 6.6 * unit)
        room = Room(left=-left, right=right, top=-top, floor=floor, back=back)
        if room.farthest <= FAR * FULL_RANGE * unit:
            return room


def _walls(draw: np.random.Generator, room: Room, unit: float) -> tuple[Body, ...]:
    """Back wall, floor, ceiling and side walls as thick plates that overlap in the corners."""
    wide, high, deep = (
        length + 2 * WALL
        for length in (room.right - room.left, room.floor - room.top, room.back + 1.0)
    )
    x, y, z = (room.left + room.right) / 2, (room.top + room.floor) / 2, room.back / 2
    plates = (
        ((wide, high, WALL), (x, y, room.back + WALL / 2)),
        ((wide, WALL, deep), (x, room.floor + WALL / 2, z)),
        ((wide, WALL, deep), (x, room.top - WALL / 2, z)),
        ((WALL, high, deep), (room.left - WALL / 2, y, z)),
        ((WALL, high, deep), (room.right + WALL / 2, y, z)),
    )
    return tuple(box(size, at, drawn_texture(draw, 0.2, 0.8, unit)) for size, at in plates)


def _with_body(
    draw: np.random.Generator, scene: Scene, room: Room, unit: float, moves: bool
) -> tuple[Scene, str]:
    """The scene with one more body, and what that is; drawn again until it fits."""
    while True:
        kind, shape = drawn_shape(draw, unit, moves, STANDING * (room.floor - room.top))
        x, y, z = _point_in_view(draw, scene, room, unit, shape.reach)
        if kind == "pole":
            y = (room.top + room.floor) / 2
        if moves:
            name, path = drawn_path(draw, (x, y, z), unit, turned=kind != "ball")
            name = f"{kind} {name}"
        else:
            turn = (0.0, float(draw.uniform(-90.0, 90.0)), 0.0)
            name, path = kind, Still(position=(x, y, z), turn_deg=turn)
        body = Body(shape=shape, texture=drawn_texture(draw, 0.1, 0.95, unit), path=path)
        grown = replace(scene, bodies=(*scene.bodies, body))
        times = TIMES if moves else TIMES[:1]
        inside = all(room.holds(_extent(body, time)) for time in times.tolist())
        if inside and _distance(body, times) > NEAR and _is_seen(grown):
            return grown, name


def _point_in_view(
    draw: np.random.Generator, scene: Scene, room: Room, unit: float, reach: float
) -> tuple[float, float, float]:
    """A point in the inner part of the image, in world axes [m]."""
    camera = scene.camera()
    u, v = draw.uniform((-0.8, -0.75), (0.8, 0.75))
    nearest = max(NEAR, APART * unit) + reach
    z = draw.uniform(nearest, max(0.85 * room.back, 1.1 * nearest))
    local = z * np.array((u * camera.width / 2 / camera.fx, v * camera.height / 2 / camera.fy, 1.0))
    x, y, z = (scene.camera_path.world_from_body(0.0)[:3, :3] @ local).tolist()
    return x, y, z


def _distance(body: Body, times: Float[np.ndarray, "F"]) -> float:
    """Least distance of a body from the camera [m]."""
    return float(clearance(body, np.zeros(3), times).min())


def _extent(body: Body, time: float) -> Float[np.ndarray, "P 3"]:
    """Corners of a box around a body at a time [s], in world axes [m]."""
    shape, pose = body.shape, body.path.world_from_body(time)
    corners = np.indices((2, 2, 2)).reshape(3, 8).T - 0.5
    if isinstance(shape, Sphere):
        return 2.0 * shape.radius * corners + pose[:3, 3]
    parts = shape.parts if isinstance(shape, Assembly) else (Part(shape=shape),)
    boxes = [(part.position, part.shape) for part in parts if isinstance(part.shape, Box)]
    halves = [np.abs(position) + np.asarray(each.size) / 2 for position, each in boxes]
    size = 2.0 * np.max(halves, axis=0)
    return (size * corners) @ pose[:3, :3].T + pose[:3, 3]


def _is_seen(scene: Scene) -> bool:
    """Whether no body fills the image, and every moving one is seen at some time."""
    most = np.zeros(len(scene.bodies), dtype=np.int64)
    for time in TIMES[[0, FRAMES // 2, -1]].tolist():
        hit = first_hit(scene.bodies, scene.camera(SMALL), time).body
        most = np.maximum(most, np.bincount(hit.ravel(), minlength=len(most)))
    moves = [body.moves for body in scene.bodies]
    return (
        most[WALLS:].max() <= FILLED * SMALL[0] * SMALL[1] and most[moves].min(initial=SEEN) >= SEEN
    )
