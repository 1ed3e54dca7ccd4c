"""What a scene is: bodies on their paths, a ToF camera, perhaps a colour camera beside it, and a sensor.

Axes: x right, y down, z forward; a camera that does not move is at the origin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ..scene.camera import Camera
from ..scene.changes import Wording, changed
from ..scene.optics import Lens
from ..scene.sensor import Sensor
from .paths import Path, Still, Vector, Viewpoint, inverse, rigid, rotation_matrix
from .sensors import SENSORS
from .world import Body

OVERRIDES = Wording(
    option="--override",
    example="sensor.f_mod_hz=30e6",
    where="the fields of gftorf_warp.sim.scene.Scene",
    fixed=("name", "closed_form", "overrides"),
    named={"sensor": SENSORS},
)


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
    """What moves how, in a few words: what the scene is hard for."""
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
    """The sensor; raw frame n is the one of number n in its cycle. By name, too: see sim/sensors.py."""
    lens: Lens = field(default_factory=Lens)
    """The lens of the ToF camera, and the beam of its light; the default is a pinhole, lit evenly."""
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
    closed_form: float | None = None
    """Error of the closed form on ideal quads [m^2 x 100], one ray per pixel; None: not measured."""
    overrides: tuple[str, ...] = ()
    """How it differs from the named scene, as texts ``name=value``; for the data card only."""

    def __post_init__(self):
        if not self.bodies:
            raise ValueError("a scene needs at least one body")
        for name in ("frames", "width", "height", "subsamples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.horizontal_fov_deg < 180:
            raise ValueError(f"horizontal_fov_deg must be between 0 and 180, got {self.horizontal_fov_deg}")
        if not np.isfinite(self.emitter).all():
            raise ValueError(f"emitter must be finite, got {self.emitter}")
        if self.beam_deg is not None and not all(0 < angle < 180 for angle in self.beam_deg):
            raise ValueError(f"beam_deg must be between 0 and 180, got {self.beam_deg}")
        if self.lens.distortion:  # it must be one that can be undone
            self.camera()

    @property
    def camera_moves(self) -> bool:
        """Whether the camera path is anything but a pose at rest."""
        return not isinstance(self.camera_path, Still | Viewpoint)

    def camera(self, size: tuple[int, int] | None = None, time: float = 0.0) -> Camera:
        """The ToF camera at (width, height) ``size`` [px], or at the default size, as it is at ``time`` [s]."""
        pose = inverse(self.camera_path.world_from_body(time))
        camera = Camera.from_fov(*(size or (self.width, self.height)), self.horizontal_fov_deg, camera_from_world=pose)
        return replace(camera, distortion=self.lens.distortion) if self.lens.distortion else camera

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


def overridden(scene: Scene, overrides: Iterable[str]) -> Scene:
    """A scene with single settings changed; it keeps its name and says on its data card what was changed.

    Raises:
        UsageError: If a name is unknown or a value cannot be meant.
    """
    texts = tuple(overrides)
    if not texts:
        return scene
    other = changed(scene, texts, OVERRIDES)
    return replace(other, closed_form=None, overrides=(*scene.overrides, *texts))
