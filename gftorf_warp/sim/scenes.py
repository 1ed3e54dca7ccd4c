"""Named scenes: a textured room, something that moves in it, and a sensor that looks on.

All distances stay inside the unambiguous range of 7.5 m. Axes: x right, y down, z forward; a camera that does not move
is at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ..constants import FRAME_RATE_HZ
from ..scene.camera import Camera
from ..scene.sensor import Sensor
from .paths import Arc, Line, Path, Still, Sweep, Vector, Viewpoint, inverse, rigid, rotation_matrix
from .world import Body, Box, Plane, Shape, Sphere, Texture


@dataclass(frozen=True, kw_only=True)
class ColourCamera:
    """A colour camera mounted beside the ToF camera; it takes an image at the start of every quartet.

    Its light comes evenly from everywhere, so a Lambertian surface looks like its albedo from any side and at any
    distance: linear RGB, no shadow, no falloff, black where there is nothing.
    """

    width: int
    """Columns of the image, beside a ToF image of the scene's default size; both scale together."""
    height: int
    """Rows of the image, likewise."""
    horizontal_fov_deg: float = 60.0
    """Horizontal field of view [deg]; pixels are square."""
    position: Vector = (0.0, 0.0, 0.0)
    """Where it sits, in the axes of the ToF camera [m]."""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """How it is turned in those axes, as a rotation vector [deg]."""
    noise: float = 0.0
    """Standard deviation of each value [1]; the values of a white surface are 1."""

    def __post_init__(self):
        if not self.noise >= 0:
            raise ValueError(f"noise must not be negative, got {self.noise}")

    @property
    def colour_from_tof(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the colour camera relative to the ToF camera [m]."""
        return inverse(rigid(rotation_matrix(self.turn_deg), np.asarray(self.position, dtype=np.float64)))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Bodies on their paths, a ToF camera, perhaps a colour camera beside it, and a sensor."""

    name: str
    """What the command line calls it."""
    description: str
    """One line for people."""
    motion: str
    """Kind of motion: 'sliding', 'axial', 'arc', 'sideways and in depth' or 'camera and ball on arcs'."""
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
    camera_path: Path = field(default_factory=Still)
    """How the ToF camera moves; the default is at rest at the origin, looking along +z."""
    emitter: Vector = (0.0, 0.0, 0.0)
    """Where the light is, in the axes of the ToF camera [m]; away from it only engine 'mesh' can see."""
    beam_deg: tuple[float, float] | None = None
    """What the light shines on: full angles across and down about the camera's z axis [deg]; None: all directions."""
    colour: ColourCamera | None = None
    """The colour camera, which moves with the ToF camera; None: there is none."""
    novel_views: tuple[Path, ...] = ()
    """Where nobody looked from: poses, at time 0, of views to be rendered for looking at."""

    @property
    def camera_moves(self) -> bool:
        """Whether the camera path is anything but a pose at rest."""
        return not isinstance(self.camera_path, Still | Viewpoint)

    def camera(self, size: tuple[int, int] | None = None, time: float = 0.0) -> Camera:
        """The ToF camera at (width, height) ``size`` [px], or at the default size, as it is at ``time`` [s]."""
        pose = inverse(self.camera_path.world_from_body(time))
        return Camera.from_fov(*(size or (self.width, self.height)), self.horizontal_fov_deg, camera_from_world=pose)

    def colour_camera(self, size: tuple[int, int] | None = None, time: float = 0.0) -> Camera:
        """The colour camera beside a ToF image of ``size`` [px], or of the default size, as it is at ``time`` [s].

        Raises:
            ValueError: If the scene has none.
        """
        if self.colour is None:
            raise ValueError(f"scene {self.name!r} has no colour camera: its field colour is None")
        width, height = size or (self.width, self.height)
        pose = self.colour.colour_from_tof @ inverse(self.camera_path.world_from_body(time))
        return Camera.from_fov(
            max(1, round(self.colour.width * width / self.width)),
            max(1, round(self.colour.height * height / self.height)),
            self.colour.horizontal_fov_deg,
            camera_from_world=pose,
        )


def room(
    *,
    left: float = -2.1,
    right: float = 2.1,
    top: float = -1.6,
    floor: float = 1.15,
    back: float = 4.2,
    hue: float | None = None,
) -> Body:
    """A textured room around the camera, walls at the given coordinates [m]; the wall behind the camera is at -0.5."""
    front = -0.5
    return Body(
        shape=Box(size=(right - left, floor - top, back - front), inside=True),
        texture=Texture(low=0.3, high=0.75, cell=0.3, hue=hue),
        path=Still(position=((left + right) / 2, (top + floor) / 2, (front + back) / 2)),
    )


def still(
    shape: Shape,
    position: tuple[float, float, float],
    low: float,
    high: float,
    cell: float,
    hue: float | None = None,
) -> Body:
    """A body that stays at ``position`` [m], of reflectance ``low`` to ``high`` [1] in cells of ``cell`` [m]."""
    return Body(shape=shape, texture=Texture(low=low, high=high, cell=cell, hue=hue), path=Still(position=position))


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


def tour() -> Scene:
    """A camera that is carried past a desk, as in recordings of the TöRF family: phasors, colour, a pose per frame."""
    target = (0.0, 0.1, 2.7)
    desk = still(Box(size=(2.2, 0.08, 1.0)), (0.1, 0.62, 2.75), 0.45, 0.7, 0.25, 0.08)
    chest = still(Box(size=(0.5, 0.9, 0.5)), (-1.35, 0.7, 3.6), 0.3, 0.9, 0.15, 0.35)
    crate = still(Box(size=(0.45, 0.36, 0.35)), (0.65, 0.4, 2.75), 0.4, 0.9, 0.12, 0.17)
    globe = still(Sphere(radius=0.2), (-0.6, 0.38, 2.65), 0.5, 0.95, 0.1, 0.75)
    picture = still(Plane(size=(1.3, 0.8)), (0.55, -0.75, 4.15), 0.1, 0.95, 0.16)
    ball = Body(
        shape=Sphere(radius=0.3),
        texture=Texture(low=0.35, high=0.95, cell=0.13, hue=0.98),
        path=Arc(centre=(0.0, -0.2, 2.75), radius=0.55, start_deg=-180.0, rate_deg_per_s=180.0),
    )
    return Scene(
        name="tour",
        description="a camera is carried past a desk over which a ball swings by; with a colour camera",
        motion="camera and ball on arcs",
        bodies=(room(hue=0.55), desk, chest, crate, globe, picture, ball),
        frames=120,
        width=160,
        height=120,
        camera_path=Sweep(middle=(0.0, 0.0, 0.0), target=target, sweep_deg=9.0, period_s=2.0, rise=0.05),
        colour=ColourCamera(width=320, height=240, position=(0.04, 0.0, 0.0), noise=0.004),
        novel_views=tuple(
            Viewpoint(position=position, target=target)
            for position in (
                (-0.45, -0.1, 0.0),
                (-0.2, -0.35, 0.1),
                (0.0, 0.2, 0.0),
                (0.0, 0.0, 0.4),
                (0.2, -0.35, 0.1),
                (0.45, -0.1, 0.0),
            )
        ),
    )


SCENES: dict[str, Scene] = {scene.name: scene for scene in (demo(), sliding(), axial(), arc(), tour())}
"""All named scenes, the one of ``gftorf demo`` first."""
