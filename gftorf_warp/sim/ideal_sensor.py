"""Ideal quads without a renderer: analytic first hits, read by an ideal sensor.

Without noise, blur and indirect light, the remaining errors of the closed form are those of motion,
and of mixtures of surfaces in a pixel if it has more than one ray. Closed-form errors of named
scenes refer to these quads. Light and sensor are separate, so that light can be read by several
sensors of the same modulation frequencies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..data.sequence import Sequence, Truth
from ..scene.sensor import Sensor
from ..scene.unwrap import frequencies_of
from .record import frame_times, sequence_fields
from .scene import Scene
from .world import first_hit


class Light(NamedTuple):
    """Light of one raw frame, of any shift."""

    amplitude: Float[np.ndarray, "H W"]
    """Mean amplitude a of each pixel, source intensity 1 [relative units]; 0: nothing hit."""
    phasor: Complex[np.ndarray, "H W"]
    """Mean of a exp(i kappa d), likewise."""
    distance: Float[np.ndarray, "H W"]
    """True distance along the ray through the pixel's centre [m]; NaN where nothing is hit."""


def light_of(scene: Scene, time: float, *, rays: int = 1, f_mod_hz: float | None = None) -> Light:
    """Light of a scene at its own size at ``time`` [s], the mean over ``rays`` per pixel and axis.

    The modulation frequency [Hz] is ``f_mod_hz``; None: the first of the scene's sensor.

    Raises:
        ValueError: If ``rays`` is below 1.
    """
    if rays < 1:
        raise ValueError(f"rays must be at least 1, got {rays}")
    camera = scene.camera(time=time)
    hit = first_hit(scene.bodies, camera.finer(rays), time)
    sensor = scene.sensor if f_mod_hz is None else replace(scene.sensor, f_mod_hz=f_mod_hz)
    phase = float(sensor.phase_slope) * np.where(hit.body < 0, 0.0, hit.distance)
    amplitude, phasor = (
        image.reshape(camera.height, rays, camera.width, rays).mean((1, 3))
        for image in (hit.amplitude, hit.amplitude * np.exp(1j * phase))
    )
    true = hit.distance if rays == 1 else first_hit(scene.bodies, camera, time).distance
    return Light(amplitude, phasor, true)


def ideal_recording(
    scene: Scene, lights: Mapping[int, Light] | None = None, sensor: Sensor | None = None
) -> tuple[Sequence, Truth]:
    """The ideal recording of a scene at its own size, frames and times, and the true distance.

    Args:
        scene: The scene.
        lights: Light by raw frame; without it a frame is not measured, nor its truth known. None:
            that of all frames.
        sensor: Instead of the scene's; noise is ignored. None: the scene's.

    Raises:
        ValueError: If the modulation frequencies differ.
    """
    sensor = replace(scene.sensor if sensor is None else sensor, noise=False)
    lit, read = frequencies_of(scene.sensor), frequencies_of(sensor)
    if lit != read:
        listed, other = (", ".join(map(str, each)) for each in (lit, read))
        raise ValueError(f"light of {listed} Hz, read by a sensor of {other} Hz")
    cycle = [sensor.at_frame(n) for n in range(len(sensor.cycle))]
    shots = [cycle[n % len(cycle)] for n in range(scene.frames)]
    frequencies = np.array([float(shot.f_mod_hz) for shot in shots])
    times = frame_times(sensor, scene.frames, sync=False)
    if lights is None:
        pairs = enumerate(zip(times.tolist(), frequencies.tolist(), strict=True))
        lights = {n: light_of(scene, time, f_mod_hz=f) for n, (time, f) in pairs}
    shifts = np.array([shot.shifts[0] for shot in shots])
    quads = np.zeros((scene.frames, scene.height, scene.width), dtype=np.float32)
    distance = np.full(quads.shape, np.nan, dtype=np.float32)
    known = np.zeros(scene.frames, dtype=bool)
    for n, light in lights.items():
        turned = np.exp(1j * (float(sensor.phase_offset) - shifts[n]))
        quad = (light.phasor * turned).real + float(sensor.dc_offset) * light.amplitude
        quads[n] = float(sensor.source_intensity) * quad
        distance[n], known[n] = light.distance, True
    if scene.camera_moves:
        cameras = [scene.camera(time=float(time)) for time in times]
    else:
        cameras = [scene.camera()] * scene.frames
    sequence = Sequence(quads=quads, measured=known, **sequence_fields(sensor, times, cameras))
    return sequence, Truth(distance=distance, known=known)
