"""Engine gaussian: Gaussians that cover the scene, rendered with several rays per pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Complex, Float

from ..render.api import Rendering, rasterize
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField, concatenated
from ..scene.sensor import Sensor
from .exposure import Exposure, pooled
from .gaussian_cover import cover_moving, cover_still
from .readout import mean_quad
from .scene import Scene

OPAQUE = 0.5  # [1] opacity at the outline of a cover


class GaussianEngine:
    """A scene as Gaussians for one camera: a cover per moving body, one for all still ones.

    Still bodies are covered along the rays of the camera, so a camera that moves gets a new cover
    at every instant.

    Args:
        scene: Bodies and their paths.
        camera_at: The camera at a time [s], with a pixel for each ray.
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
        self.camera_at, self.subsamples = camera_at, scene.subsamples
        self._colour, self._camera_moves = colour, scene.camera_moves
        self._still = tuple(body for body in scene.bodies if not body.moves)
        self._static = None if self._camera_moves else self._cover_still(0.0)
        centres = np.array([camera_at(float(time)).centre for time in times])
        moving = (body for body in scene.bodies if body.moves)
        self._moving = [cover_moving(body, camera_at(0.0), times, centres) for body in moving]

    def field_at(self, time: float) -> GaussianField:
        """All Gaussians that face the camera at ``time`` [s]."""
        centre = self.camera_at(time).centre
        static = self._cover_still(time) if self._camera_moves else self._static
        moving = [cover.facing(centre, time, colour=self._colour) for cover in self._moving]
        return concatenated([*([] if static is None else [static]), *moving])

    def _cover_still(self, time: float) -> GaussianField | None:
        if not self._still:
            return None
        camera = self.camera_at(time)
        return cover_still(self._still, camera).facing(camera.centre, 0.0, colour=self._colour)

    def expose(self, n: int, instants: list[float], time: float, sensor: Sensor) -> Exposure:
        """The mean over ``instants`` [s], and the phasor at ``time`` [s], of the first shift."""
        del n  # nothing is random
        images = [self._instant(instant, sensor) for instant in instants]
        still = images[0] if instants == [time] else self._instant(time, sensor)
        several = list(zip(*images, strict=True))[:3]
        quad, amplitude, distance = (np.mean(each, axis=0) for each in several)
        return Exposure(quad, amplitude, distance, still.phasor)

    def _instant(self, time: float, sensor: Sensor) -> Exposure:
        """An instant; each harmonic is rendered separately, exact for mixtures in a pixel."""
        field, camera = self.field_at(time), self.camera_at(time)
        rendering = _rendering(field, camera, sensor)
        f_mod_hz, offset = float(sensor.f_mod_hz), float(sensor.phase_offset)
        at = partial(replace, sensor)
        higher = [at(f_mod_hz=h * f_mod_hz, phase_offset=h * offset) for h in sensor.harmonics[1:]]
        harmonics = [self._phasor(_rendering(field, camera, one)) for one in higher]
        opacity = pooled(rendering.opacity, self.subsamples)
        opacity = np.where(opacity > 0, opacity, np.nan)
        distance = pooled(rendering.distance, self.subsamples) / opacity
        # the third channel of a phasor is 2a
        amplitude = pooled(rendering.phasor[2], self.subsamples) / 2
        first = self._phasor(rendering)
        if not harmonics and sensor.pattern.phase == 0.0:
            return Exposure(pooled(rendering.quads[0], self.subsamples), amplitude, distance, first)
        bare = replace(sensor, phase_offset=0.0, source_intensity=1.0)  # the renderings have both
        quad, amplitude = mean_quad(np.stack([first, *harmonics]), amplitude, bare)
        return Exposure(quad, amplitude, distance, first)

    def _phasor(self, rendering: Rendering) -> Complex[np.ndarray, "H W"]:
        """Light at the modulation frequency, phase offset and source intensity included."""
        re, im = (pooled(channel, self.subsamples) for channel in rendering.phasor[:2])
        return re / 2 + 0.5j * im

    def albedo(self, time: float) -> Float[np.ndarray, "H W 3"]:
        """Mean albedo of every pixel in linear RGB [1]; black where rays meet nothing."""
        rendering = _rendering(self.field_at(time), self.camera_at(time), Sensor())
        assert rendering.colour is not None, "the Gaussians of a colour camera have colour"
        met = torch.where(rendering.opacity > OPAQUE, rendering.colour / rendering.opacity, 0.0)
        return np.moveaxis(pooled(met, self.subsamples), 0, -1)


def _rendering(field: GaussianField, camera: Camera, sensor: Sensor) -> Rendering:
    with torch.no_grad():
        return rasterize(field, camera, sensor)
