"""A rolling shutter: each row is exposed later than the one above."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from jaxtyping import Float

from ..scene.camera import Camera
from ..scene.sensor import Sensor
from .exposure import Exposure
from .world import Body, Hits, first_hit


def row_delays(sensor: Sensor, height: int) -> Float[np.ndarray, "H"]:
    """Delay of each row after the first one [s], at the time of the raw frame."""
    return sensor.row_time_s * np.arange(height)


def join_rows(rows: list[Exposure]) -> Exposure:
    """One raw frame of exposures of one row each, of engine mesh."""
    *images, layers = zip(*rows, strict=True)
    quad, amplitude, distance, phasor, ambient = (np.concatenate(image) for image in images)
    joined = None
    if layers[0] is not None:
        joined = {name: np.concatenate([row[name] for row in layers], axis=1) for name in layers[0]}
    return Exposure(quad, amplitude, distance, phasor, ambient, joined)


def rolling_hits(
    bodies: tuple[Body, ...],
    camera_at: Callable[[float], Camera],
    time: float,
    sensor: Sensor,
    height: int,
) -> Hits:
    """First hit of every pixel's centre ray, each row when it is exposed, the first at ``time``."""
    if sensor.row_time_s == 0:
        return first_hit(bodies, camera_at(time), time)
    times = (time + row_delays(sensor, height)).tolist()
    rows = [first_hit(bodies, camera_at(late).row(n), late) for n, late in enumerate(times)]
    names = [f.name for f in fields(Hits)]
    return Hits(**{name: np.concatenate([getattr(row, name) for row in rows]) for name in names})
