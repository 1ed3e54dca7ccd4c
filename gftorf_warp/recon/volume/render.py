"""Renderings of a finished volume, at any time and from any camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...render.api import Rendering
from ...scene.camera import Camera
from ...scene.sensor import Sensor
from . import composite
from .composite import Samples
from .rays import Views
from .volume import Volume

CHUNK = 1 << 18  # samples at a time: 0.3 GB of values of a layer of 256


@torch.no_grad()
def rendering_of(
    volume: Volume,
    time: float,
    camera: Camera,
    sensor: Sensor,
    *,
    quad_scale: float,
    colour_scale: float,
) -> Rendering:
    """All images of a volume, see :meth:`gftorf_warp.recon.run.Run.render`.

    Args:
        volume: What is seen.
        time: Seconds since raw frame 0.
        camera: Where from.
        sensor: Frequency and shifts of the quads.
        quad_scale: Units of the result times this are those of the optimisation.
        colour_scale: The same for colour.
    """
    box, count = volume.box, volume.settings.samples
    views = Views([camera], np.array(box.volume_from_world), volume.device)
    rays, size = views.rays(0), (camera.height, camera.width)
    rows: list[dict[str, Tensor]] = []
    for first in range(0, views.pixels, step := max(1, CHUNK // count)):
        some = rays.part(slice(first, first + step))
        samples = volume.samples_at(time, some, volume.depths(some))
        rows.append(_images(samples, sensor, colour=box.colour))
    images = {
        name: torch.cat([row[name] for row in rows], dim=-1).unflatten(-1, size) for name in rows[0]
    }
    rendering = Rendering(**{"colour": None} | images, extra=None, screen=None)
    return replace(
        rendering,
        quads=rendering.quads / quad_scale,
        phasor=rendering.phasor / quad_scale,
        colour=None if rendering.colour is None else rendering.colour / colour_scale,
    )


def _images(samples: Samples, sensor: Sensor, *, colour: bool) -> dict[str, Float[Tensor, "*c R"]]:
    """Every image of some rays, by the names of ``Rendering``."""
    transmittance = samples.transmittance
    images = {
        "quads": composite.quads(samples, sensor, transmittance),
        "phasor": composite.phasor(samples, sensor, transmittance),
        "distance": composite.expected(samples, transmittance, samples.distance),
        "opacity": composite.opacity(samples, transmittance),
        "distortion": composite.distortion(samples, transmittance),
        "distance_median": composite.median_distance(samples, transmittance),
    }
    return images | ({"colour": composite.colour(samples, transmittance)} if colour else {})
