"""A scene: bodies on paths, a ToF camera with a sensor, and optionally a colour camera beside it.

Axes: x right, y down, z forward; a camera that does not move is at the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any

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
    """A colour camera beside the ToF camera; it takes an image at each quartet start.

    Illumination is uniform from all directions, so that a pixel is the albedo of a Lambertian
    surface: linear RGB, no shadows, no falloff, black where there is no surface.
    """

    width: int
    """Columns of the image at the scene's default size of the ToF image; both scale together."""
    height: int
    """Rows of the image, likewise."""
    horizontal_fov_deg: float = 60.0
    """Horizontal field of view [deg]; pixels are square."""
    position: Vector = (0.0, 0.0, 0.0)
    """Position in the axes of the ToF camera [m]."""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """Orientation in those axes, as a rotation vector [deg]."""
    noise: float = 0.0
    """Standard deviation of the noise [1]; a white surface has the value 1."""

    def __post_init__(self):
        if not self.noise >= 0:
            raise ValueError(f"noise must not be negative, got {self.noise}")
        for name in ("width", "height"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.horizontal_fov_deg < 180:
            wrong = self.horizontal_fov_deg
            raise ValueError(f"horizontal_fov_deg must be between 0 and 180, got {wrong}")

    @property
    def colour_from_tof(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the colour camera relative to the ToF camera [m]."""
        position = np.asarray(self.position, dtype=np.float64)
        return inverse(rigid(rotation_matrix(self.turn_deg), position))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Bodies on paths, a ToF camera with a sensor, and optionally a colour camera beside it."""

    name: str
    """Name on the command line."""
    description: str
    """Description in one line."""
    motion: str
    """Kind of motion, in a few words."""
    bodies: tuple[Body, ...]
    """All bodies; those whose path is ``Still`` are static."""
    frames: int
    """Default number of raw frames."""
    width: int
    """Default columns of the image."""
    height: int
    """Default rows of the image."""
    horizontal_fov_deg: float = 60.0
    """Horizontal field of view [deg]; pixels are square."""
    subsamples: int = 2
    """Rays per pixel and axis that a quad averages: pixels at outlines mix surfaces."""
    sensor: Sensor = field(default_factory=lambda: Sensor(noise=True))
    """The sensor, with its cycle of raw frames; also by name, see sim/sensors.py."""
    lens: Lens = field(default_factory=Lens)
    """Lens of the ToF camera and beam of its emitter; default: a pinhole, an isotropic emitter."""
    camera_path: Path = field(default_factory=Still)
    """Path of the ToF camera; the default is at rest at the origin, looking along +z."""
    emitter: Vector = (0.0, 0.0, 0.0)
    """Position of the emitter in camera axes [m]; engine 'mesh' only unless at the origin."""
    beam_deg: tuple[float, float] | None = None
    """Limits of the light: full angles across and down about the z axis [deg]; None: no limits."""
    colour: ColourCamera | None = None
    """The colour camera, which moves with the ToF camera; None: there is none."""
    novel_views: tuple[Path, ...] = ()
    """Poses, at time 0, of views without images, to be rendered after a reconstruction."""
    closed_form: float | None = None
    """Error of the closed form on ideal quads [m^2 x 100], one ray per pixel; None: unknown."""
    overrides: tuple[str, ...] = ()
    """Differences from the named scene, as texts ``name=value``; for the data card."""

    def __post_init__(self):
        if not self.bodies:
            raise ValueError("a scene needs at least one body")
        for name in ("frames", "width", "height", "subsamples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.horizontal_fov_deg < 180:
            wrong = self.horizontal_fov_deg
            raise ValueError(f"horizontal_fov_deg must be between 0 and 180, got {wrong}")
        if not np.isfinite(self.emitter).all():
            raise ValueError(f"emitter must be finite, got {self.emitter}")
        if self.beam_deg is not None and not all(0 < angle < 180 for angle in self.beam_deg):
            raise ValueError(f"beam_deg must be between 0 and 180, got {self.beam_deg}")
        if self.lens.distortion:
            self.camera()  # raises ValueError if the distortion cannot be inverted

    @property
    def camera_moves(self) -> bool:
        """Whether the camera path is not a static pose."""
        return not isinstance(self.camera_path, Still | Viewpoint)

    def camera(self, size: tuple[int, int] | None = None, time: float = 0.0) -> Camera:
        """The ToF camera at ``time`` [s], of (width, height) ``size`` [px] or the default size."""
        pose = inverse(self.camera_path.world_from_body(time))
        width, height = size or (self.width, self.height)
        camera = Camera.from_fov(width, height, self.horizontal_fov_deg, camera_from_world=pose)
        return replace(camera, distortion=self.lens.distortion) if self.lens.distortion else camera

    def colour_camera(self, size: tuple[int, int] | None = None, time: float = 0.0) -> Camera:
        """The colour camera at ``time`` [s], for a ToF image of ``size`` [px] or the default.

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


Recipe = Callable[[Callable[[], tuple[Body, ...]]], Callable[[], Scene]]


def recipe(description: str, motion: str, closed_form: float, **others: Any) -> Recipe:
    """Decorator: the scene of these bodies, with the name of the function, and ``others``."""
    texts = {"description": description, "motion": motion, "closed_form": closed_form}

    def decorated(bodies: Callable[[], tuple[Body, ...]]) -> Callable[[], Scene]:
        @wraps(bodies)
        def scene() -> Scene:
            return Scene(name=bodies.__name__, bodies=bodies(), **{**texts, **others})

        return scene

    return decorated


def overridden(scene: Scene, overrides: Iterable[str]) -> Scene:
    """A scene with single settings changed; it keeps its name, and its data card lists the changes.

    Raises:
        UsageError: If a name is unknown or a value cannot be meant.
    """
    texts = tuple(overrides)
    if not texts:
        return scene
    other = changed(scene, texts, OVERRIDES)
    return replace(other, closed_form=None, overrides=(*scene.overrides, *texts))
