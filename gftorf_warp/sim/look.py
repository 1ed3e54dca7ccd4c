"""What a camera sees of a scene at one instant: the covers that face it, rendered at several rays per pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float

from ..render.api import rasterize
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.sensor import Sensor
from .readout import mean_quad
from .scene import Scene
from .splat import Cover, cover_moving, cover_still, merge

OPAQUE = 0.5  # [1] a ray that covers stop to less than this passes beside them: that is where their outline is


class Splatted:
    """A scene as Gaussians for one camera: a rigid cover per moving body and one for everything that stays.

    What stays is covered along the rays of the camera, so a camera that moves gets a new cover for every instant.

    Args:
        scene: Bodies and their paths.
        camera_at: The camera at a time [s], at the resolution of the rays: pixels times ``scene.subsamples``.
        times: Instants [s] at whose nearest approach the covers are still fine enough.
        colour: Whether the Gaussians have colour.
    """

    def __init__(
        self,
        scene: Scene,
        camera_at: Callable[[float], Camera],
        times: Float[np.ndarray, "F"],
        *,
        colour: bool = False,
    ):
        self.camera_at = camera_at
        self._colour, self._camera_moves = colour, scene.camera_moves
        self._still = tuple(body for body in scene.bodies if not body.moves)
        self._static = None if self._camera_moves else self._cover_still(0.0)
        centres = np.array([camera_at(float(time)).centre for time in times])
        self._moving: list[Cover] = [
            cover_moving(body, camera_at(0.0), times, centres) for body in scene.bodies if body.moves
        ]

    def at(self, time: float) -> GaussianField:
        """All Gaussians that face the camera at ``time`` [s]."""
        centre = self.camera_at(time).centre
        static = self._cover_still(time) if self._camera_moves else self._static
        moving = [cover.seen(centre, time, colour=self._colour) for cover in self._moving]
        return merge([*([] if static is None else [static]), *moving])

    def _cover_still(self, time: float) -> GaussianField | None:
        if not self._still:
            return None
        camera = self.camera_at(time)
        return cover_still(self._still, camera).seen(camera.centre, 0.0, colour=self._colour)


class Look(NamedTuple):
    """What a sensor without noise gets of every pixel in one raw frame, whatever engine made it."""

    quad: Float[np.ndarray, "H W"]
    """Mean quad of the raw frame's shift, DC offset included [relative units]."""
    amplitude: Float[np.ndarray, "H W"]
    """Mean amplitude a, source intensity included [relative units]."""
    distance: Float[np.ndarray, "H W"]
    """As the engine sees it [m]: mean of splats over their opacity, or first hit; NaN where a pixel meets nothing."""
    phasor: Complex[np.ndarray, "H W"]
    """Light at the modulation frequency, the sensor's phase offset included, in any unit; 0 where there is none."""
    ambient: Float[np.ndarray, "H W"] | None = None
    """Share of light from everywhere that comes back, the mean reflectance of a pixel's rays [1]; None: the engine does
    not know it, and every pixel gets all of the sensor's ambient electrons."""
    layers: dict[str, Float[np.ndarray, "C H W"]] | None = None
    """What else the engine knows, by name, see sim/layers.py; None: nothing."""


def look(splatted: Splatted, time: float, sensor: Sensor, subsamples: int) -> Look:
    """What splats show the sensor at an instant, for the first of its shifts.

    A harmonic is a rendering of its own, at that multiple of the modulation frequency: exact for whatever mixes in a
    pixel, where a closed form would know opaque surfaces only.
    """
    field, camera = splatted.at(time), splatted.camera_at(time)
    with torch.no_grad():
        rendering = rasterize(field, camera, sensor)
        harmonics = [_at_harmonic(field, camera, sensor, h, subsamples) for h in sensor.harmonics if h > 1]
    opacity = pooled(rendering.opacity, subsamples)
    distance = pooled(rendering.distance, subsamples) / np.where(opacity > 0, opacity, np.nan)
    amplitude = pooled(rendering.phasor[2], subsamples) / 2  # the third channel of a phasor is 2a
    first = pooled(rendering.phasor[0], subsamples) / 2 + 0.5j * pooled(rendering.phasor[1], subsamples)
    if not harmonics and sensor.pattern.phase == 0.0:
        return Look(pooled(rendering.quads[0], subsamples), amplitude, distance, first)
    seen = replace(sensor, phase_offset=0.0, source_intensity=1.0)  # the renderings have both
    quad, amplitude = mean_quad(np.stack([first, *harmonics]), amplitude, seen)
    return Look(quad, amplitude, distance, first)


def _at_harmonic(
    field: GaussianField, camera: Camera, sensor: Sensor, harmonic: int, subsamples: int
) -> Complex[np.ndarray, "H W"]:
    """Light at a multiple of the modulation frequency, phase offset and source intensity included."""
    multiple = replace(
        sensor, f_mod_hz=harmonic * float(sensor.f_mod_hz), phase_offset=harmonic * float(sensor.phase_offset)
    )
    phasor = rasterize(field, camera, multiple).phasor
    return pooled(phasor[0], subsamples) / 2 + 0.5j * pooled(phasor[1], subsamples)


def look_colour(splatted: Splatted, time: float, subsamples: int) -> Float[np.ndarray, "H W 3"]:
    """Mean albedo of every pixel in linear RGB [1]: colour over opacity where a ray meets anything, else black."""
    with torch.no_grad():
        rendering = rasterize(splatted.at(time), splatted.camera_at(time), Sensor())
    assert rendering.colour is not None, "the splats of a colour camera have colour"
    met = torch.where(rendering.opacity > OPAQUE, rendering.colour / rendering.opacity, 0.0)
    return np.stack([pooled(channel, subsamples) for channel in met], axis=-1)


def pooled(image: torch.Tensor | np.ndarray, subsamples: int) -> Float[np.ndarray, "H W"]:
    """Mean over the rays of each pixel, float64."""
    rows, columns = (length // subsamples for length in image.shape)
    return np.asarray(image, dtype=np.float64).reshape(rows, subsamples, columns, subsamples).mean((1, 3))
