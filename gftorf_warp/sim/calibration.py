"""Static scenes with known solutions, for the calibration of a sensor.

The closed form is exact on them but for noise, so any other error is one of the sensor or of
indirect light.
"""

from __future__ import annotations

import math

from ..scene.sensor import Sensor
from .bodies import ball, box, level, plain
from .lookalikes import look_alike
from .lookalikes_real import FIELD_OF_VIEW_DEG
from .paths import Path, Still, Viewpoint
from .scene import Scene
from .world import Body

DISTANCE = 2.0  # [m] of the surface in the middle of the image
SENSOR = Sensor(f_mod_hz=20e6, noise=True)


def flat_wall() -> Scene:
    """Distance D / cos(angle of the ray), amplitude rho cos^3 / D^2."""
    return _at_rest(
        "flat_wall", "a plain wall, met at right angles", (level(2, DISTANCE, plain(0.5)),)
    )


def wedge() -> Scene:
    """An edge that points to the camera: two faces met at 45 degrees, a wall far behind."""
    edge = 0.8  # [m] of its square cross-section
    middle = DISTANCE + edge / math.sqrt(2)
    turned = Still(position=(0.0, 0.0, middle), turn_deg=(0.0, 45.0, 0.0))
    pillar = box((edge, 2.0, edge), turned, plain(0.5))
    return _at_rest(
        "wedge", "the edge of a square pillar before a wall", (level(2, 4.0, plain(0.5)), pillar)
    )


def corner() -> Scene:
    """Two bright walls that light each other, 1 m and 2 m from camera and light."""
    view = Viewpoint(position=(0.0, 0.0, 0.0), target=(-1.0, 0.0, DISTANCE))
    return _at_rest(
        "corner",
        "two bright walls meet at right angles",
        (level(0, -1.0, plain(0.8)), level(2, DISTANCE, plain(0.8))),
        view,
    )


def sphere() -> Scene:
    """Every angle of incidence at once."""
    radius = 0.5  # [m]
    middle = (0.0, 0.0, DISTANCE + radius)
    return _at_rest(
        "sphere",
        "a ball before a wall",
        (level(2, 4.0, plain(0.5)), ball(radius, middle, plain(0.5))),
    )


def _at_rest(
    name: str, description: str, bodies: tuple[Body, ...], camera_path: Path | None = None
) -> Scene:
    return look_alike(
        name,
        description,
        "at rest, known in closed form",
        0.0,
        bodies,
        frames=16,
        horizontal_fov_deg=FIELD_OF_VIEW_DEG,
        sensor=SENSOR,
        camera_path=camera_path or Still(),
    )


CALIBRATION = (flat_wall, wedge, corner, sphere)
"""All four."""
