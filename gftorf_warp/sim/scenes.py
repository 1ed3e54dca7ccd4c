"""Named scenes: a textured room, something that moves in it, and a sensor that looks on.

All distances stay inside the unambiguous range of 7.5 m. Axes: x right, y down, z forward; the camera is at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ..constants import FRAME_RATE_HZ
from ..scene.camera import Camera
from ..scene.sensor import Sensor
from .paths import Arc, Line, Still
from .world import Body, Box, Plane, Shape, Sphere, Texture


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Bodies on their paths, a camera that stays where it is, and a sensor."""

    name: str
    """What the command line calls it."""
    description: str
    """One line for people."""
    motion: str
    """Kind of motion: 'sliding', 'axial', 'arc' or 'sideways and in depth'."""
    bodies: tuple[Body, ...]
    """What there is; bodies whose path is ``Still`` are static."""
    frames: int
    """Default number of raw frames."""
    width: int
    """Default columns of the image."""
    height: int
    """Default rows of the image."""
    horizontal_fov_deg: float = 60.0
    """Horizontal field of view [deg]; pixels are square."""
    subsamples: int = 2
    """Rays per pixel and axis that a quad averages: a pixel has an area, and at outlines it mixes what it sees."""
    sensor: Sensor = field(default_factory=lambda: Sensor(noise=True))
    """The sensor; raw frame n has the shift ``sensor.shifts[n % 4]``."""

    def camera(self, size: tuple[int, int] | None = None) -> Camera:
        """The camera at (width, height) ``size`` [px], or at the default size."""
        return Camera.from_fov(*(size or (self.width, self.height)), self.horizontal_fov_deg)


def room(*, left: float = -2.1, right: float = 2.1, top: float = -1.6, floor: float = 1.15, back: float = 4.2) -> Body:
    """A textured room around the camera, walls at the given coordinates [m]; the wall behind the camera is at -0.5."""
    front = -0.5
    return Body(
        shape=Box(size=(right - left, floor - top, back - front), inside=True),
        texture=Texture(low=0.3, high=0.75, cell=0.3),
        path=Still(position=((left + right) / 2, (top + floor) / 2, (front + back) / 2)),
    )


def still(shape: Shape, position: tuple[float, float, float], low: float, high: float, cell: float) -> Body:
    """A body that stays at ``position`` [m], of reflectance ``low`` to ``high`` [1] in cells of ``cell`` [m]."""
    return Body(shape=shape, texture=Texture(low=low, high=high, cell=cell), path=Still(position=position))


def demo() -> Scene:
    """The scene of ``gftorf demo``: small, quick, and wrong in closed form wherever the box passes."""
    frames = 44
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    box = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(-0.16, -0.2, 2.65), velocity=(4.9, 2.9, -2.7), passing_s=middle),
    )
    return Scene(
        name="demo",
        description="a textured box crosses a textured room, coming nearer",
        motion="sideways and in depth",
        bodies=(room(), box),
        frames=frames,
        width=96,
        height=72,
    )


def sliding() -> Scene:
    """Purely sideways: no pixel inside the box changes its distance, only its outline goes wrong."""
    frames = 48
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    box = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(0.0, -0.1, 2.8), velocity=(3.0, 0.0, 0.0), passing_s=middle),
    )
    ball = still(Sphere(radius=0.35), (1.25, 0.8, 3.7), 0.5, 0.9, 0.2)
    return Scene(
        name="sliding",
        description="a box slides from left to right in front of the back wall, past a ball",
        motion="sliding",
        bodies=(room(), ball, box),
        frames=frames,
        width=160,
        height=120,
    )


def axial() -> Scene:
    """Along the line of sight: the outline hardly moves, but the phase does, and the closed form lags and ripples."""
    frames = 48
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    approach = Body(
        shape=Sphere(radius=0.4),
        texture=Texture(low=0.3, high=0.9, cell=0.12),
        path=Line(position=(-0.55, 0.0, 2.9), velocity=(0.0, 0.0, -4.0), passing_s=middle),
    )
    retreat = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(0.7, 0.2, 2.7), velocity=(0.0, 0.0, 3.0), passing_s=middle),
    )
    return Scene(
        name="axial",
        description="a ball flies towards the camera while a box moves away from it",
        motion="axial",
        bodies=(room(), approach, retreat),
        frames=frames,
        width=160,
        height=120,
    )


def arc() -> Scene:
    """On a circle, turning: sideways and in depth in changing proportion."""
    box = Body(
        shape=Box(size=(0.5, 0.7, 0.5)),
        texture=Texture(low=0.3, high=0.9, cell=0.14),
        path=Arc(centre=(0.0, 0.05, 3.2), radius=0.75, start_deg=-170.0, rate_deg_per_s=400.0),
    )
    picture = still(Plane(size=(0.9, 0.6)), (-1.1, -0.7, 4.1), 0.05, 0.95, 0.15)
    return Scene(
        name="arc",
        description="a box swings on a horizontal circle, towards the camera and away",
        motion="arc",
        bodies=(room(), picture, box),
        frames=48,
        width=160,
        height=120,
    )


SCENES: dict[str, Scene] = {scene.name: scene for scene in (demo(), sliding(), axial(), arc())}
"""All named scenes, the one of ``gftorf demo`` first."""
