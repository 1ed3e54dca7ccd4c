"""Scenes at rest whose answers are known: what a sensor is calibrated on.

The closed form is right on them but for noise, so any other error is one of the sensor or of light that took detours.
"""

from __future__ import annotations

import math

from ..scene.sensor import Sensor
from .assembly import Level
from .lookalikes import plain
from .lookalikes_real import FIELD_OF_VIEW_DEG, box
from .paths import Path, Still, Viewpoint
from .scene import Scene
from .world import Body, Sphere

DISTANCE = 2.0  # [m] of what is in the middle of the image
SENSOR = Sensor(f_mod_hz=20e6, noise=True)


def flat_wall() -> Scene:
    """Distance D / cos(angle of the ray), amplitude rho cos^3 / D^2."""
    return _at_rest("flat_wall", "a plain wall, met at right angles", (_level(2, DISTANCE, 0.5),))


def wedge() -> Scene:
    """An edge that points to the camera: two faces met at 45 degrees, a wall far behind."""
    edge = 0.8  # [m] of its square cross-section
    middle = DISTANCE + edge / math.sqrt(2)
    pillar = box((edge, 2.0, edge), (0.0, 0.0, middle), plain(0.5), (0.0, 45.0, 0.0))
    return _at_rest("wedge", "the edge of a square pillar before a wall", (_level(2, 4.0, 0.5), pillar))


def corner() -> Scene:
    """Two bright walls that light each other: camera and light 1 m from one and 2 m from the other."""
    view = Viewpoint(position=(0.0, 0.0, 0.0), target=(-1.0, 0.0, DISTANCE))
    return _at_rest(
        "corner", "two bright walls meet at right angles", (_level(0, -1.0, 0.8), _level(2, DISTANCE, 0.8)), view
    )


def sphere() -> Scene:
    """Every angle of incidence at once."""
    radius = 0.5  # [m]
    ball = Body(shape=Sphere(radius=radius), texture=plain(0.5), path=Still(position=(0.0, 0.0, DISTANCE + radius)))
    return _at_rest("sphere", "a ball before a wall", (_level(2, 4.0, 0.5), ball))


def _level(axis: int, value: float, reflectance: float) -> Body:
    return Body(shape=Level(axis=axis, value=value), texture=plain(reflectance), path=Still())


def _at_rest(name: str, description: str, bodies: tuple[Body, ...], camera_path: Path | None = None) -> Scene:
    return Scene(
        name=name,
        description=description,
        motion="at rest, known in closed form",
        closed_form=0.0,
        bodies=bodies,
        frames=16,
        width=320,
        height=240,
        horizontal_fov_deg=FIELD_OF_VIEW_DEG,
        sensor=SENSOR,
        camera_path=camera_path or Still(),
    )


CALIBRATION = (flat_wall, wedge, corner, sphere)
"""All four."""
