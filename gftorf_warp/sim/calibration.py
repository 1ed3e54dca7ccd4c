"""Static scenes with known solutions, for the calibration of a sensor.

The closed form is exact on them but for noise, so any other error is one of the sensor or of
indirect light.
"""

from __future__ import annotations

import math
from functools import partial

from ..scene.sensor import Sensor
from .bodies import ball, box, level, plain
from .lookalikes import look_alike
from .lookalikes_real import FIELD_OF_VIEW_DEG
from .paths import Still, Viewpoint
from .world import Body

DISTANCE = 2.0  # [m] of the surface in the middle of the image
SENSOR = Sensor(f_mod_hz=20e6, noise=True)
_at_rest = partial(
    look_alike,
    motion="at rest, known in closed form",
    closed_form=0.0,
    frames=16,
    horizontal_fov_deg=FIELD_OF_VIEW_DEG,
    sensor=SENSOR,
)


@_at_rest("a plain wall, met at right angles")
def flat_wall() -> tuple[Body, ...]:
    """Distance D / cos(angle of the ray), amplitude rho cos^3 / D^2."""
    return (level(2, DISTANCE, plain(0.5)),)


@_at_rest("the edge of a square pillar before a wall")
def wedge() -> tuple[Body, ...]:
    """An edge that points to the camera: two faces met at 45 degrees, a wall far behind."""
    edge = 0.8  # [m] of its square cross-section
    middle = DISTANCE + edge / math.sqrt(2)
    turned = Still(position=(0.0, 0.0, middle), turn_deg=(0.0, 45.0, 0.0))
    return level(2, 4.0, plain(0.5)), box((edge, 2.0, edge), turned, plain(0.5))


@_at_rest(
    "two bright walls meet at right angles",
    camera_path=Viewpoint(position=(0.0, 0.0, 0.0), target=(-1.0, 0.0, DISTANCE)),
)
def corner() -> tuple[Body, ...]:
    """Two bright walls that light each other, 1 m and 2 m from camera and light."""
    return level(0, -1.0, plain(0.8)), level(2, DISTANCE, plain(0.8))


@_at_rest("a ball before a wall")
def sphere() -> tuple[Body, ...]:
    """Every angle of incidence at once."""
    radius = 0.5  # [m]
    middle = (0.0, 0.0, DISTANCE + radius)
    return level(2, 4.0, plain(0.5)), ball(radius, middle, plain(0.5))


CALIBRATION = (flat_wall, wedge, corner, sphere)
