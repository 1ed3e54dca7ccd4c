"""A rolling shutter: each row is exposed later than the one above, so an image is one row of each of many images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from jaxtyping import Float

from ..scene.camera import Camera
from ..scene.sensor import Sensor
from .look import Look
from .world import Body, Hits, first_hit

TakeRow = Callable[[int, list[float], float, Sensor, int], Look]
"""What takes one row of a raw frame: its number, the instants it averages, its time [s], the sensor, and the row."""


def row_delays(sensor: Sensor, height: int) -> Float[np.ndarray, "H"]:
    """How much later than the first row each row is exposed [s]; the time of a raw frame is that of its first row."""
    return sensor.row_time_s * np.arange(height)


def take_rolling(take: TakeRow, n: int, instants: list[float], time: float, sensor: Sensor, height: int) -> Look:
    """A raw frame, row by row, each at its own time.

    Args:
        take: Takes one row.
        n: Number of the raw frame.
        instants: Times that the first row averages [s].
        time: Of the first row [s].
        sensor: As it is set for this raw frame.
        height: Rows.
    """
    looks = [
        take(n, [instant + delay for instant in instants], time + delay, sensor, row)
        for row, delay in enumerate(row_delays(sensor, height).tolist())
    ]
    ambient = [row.ambient for row in looks if row.ambient is not None]
    return Look(
        quad=np.concatenate([row.quad for row in looks]),
        amplitude=np.concatenate([row.amplitude for row in looks]),
        distance=np.concatenate([row.distance for row in looks]),
        phasor=np.concatenate([row.phasor for row in looks]),
        ambient=np.concatenate(ambient) if ambient else None,
        layers=_joined([row.layers for row in looks if row.layers is not None]),
    )


def _joined(rows: list[dict[str, Float[np.ndarray, "C 1 W"]]]) -> dict[str, Float[np.ndarray, "C H W"]] | None:
    """Layers of all rows; None if no row has any."""
    return {name: np.concatenate([row[name] for row in rows], axis=1) for name in rows[0]} if rows else None


def rolling_hits(
    bodies: tuple[Body, ...], camera_at: Callable[[float], Camera], time: float, sensor: Sensor, height: int
) -> Hits:
    """First hit of every pixel's centre ray, each row when it is exposed.

    Args:
        bodies: What there is.
        camera_at: The whole camera at a time [s].
        time: Of the first row [s].
        sensor: Its rows.
        height: How many there are.
    """
    moments = [time + delay for delay in row_delays(sensor, height).tolist()]
    rows = [first_hit(bodies, camera_at(moment).row(n), moment) for n, moment in enumerate(moments)]
    return Hits(**{f.name: np.concatenate([getattr(row, f.name) for row in rows]) for f in fields(Hits)})
