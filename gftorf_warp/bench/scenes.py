"""Two families of scenes for timing the renderer, as Warp arrays."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from jaxtyping import Float

from ..constants import SH_BIAS, SH_COEFFICIENTS, SH_Y0
from ..render.inputs import Inputs
from ..scene.camera import Camera

WIDTH, HEIGHT, FOCAL = 320, 240, 280.0
NEAR, FAR = 0.135, 7.425  # [m]
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2)
# phase slope of depth_range 15 m [rad/m], offsets, intensity
CALIBRATION = (4 * math.pi / 15, 0.0, 1.0, 0.0)
# kind, scale [m], opacity
FAMILIES = (("surface", 0.015, 0.6), ("surface", 0.03, 0.6), ("volume", 0.03, 0.1))


def surface(count: int, scale: float, opacity: float) -> dict[str, np.ndarray]:
    """Gaussians of one size [m] and opacity on a wavy surface 1-5 m away."""
    rng = np.random.default_rng(0)
    u = rng.random((count, 3))
    z = 3 + 2 * np.sin(6 * u[:, 0]) * np.cos(5 * u[:, 1]) + 0.02 * u[:, 2]
    quaternion = rng.normal(size=(count, 4))
    return {
        "mean": _in_view(u, z),
        "log_scale": np.full((count, 3), math.log(scale)),
        "quaternion": quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        "opacity_logit": np.full(count, math.log(opacity / (1 - opacity))),
        "colour": rng.random((count, 3)),
        "reflectivity": 0.5 + 0.1 * rng.random(count),
    }


def volume(count: int, scale: float, opacity: float) -> dict[str, np.ndarray]:
    """Gaussians of one size [m] and opacity that fill the frustum evenly."""
    scene = surface(count, scale, opacity)
    u = np.random.default_rng(0).random((count, 3))
    z = NEAR + (FAR - NEAR) * u[:, 2] ** (1 / 3)
    scene["mean"] = _in_view(u, z)
    return scene


def _in_view(u: Float[np.ndarray, "N 3"], z: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
    """Points at z [m] on the rays of the image positions u [1]."""
    x, y = (u[:, 0] - 0.5) * WIDTH / FOCAL * z, (u[:, 1] - 0.5) * HEIGHT / FOCAL * z
    return np.stack([x, y, z], 1)


def scene_of(kind: str, count: int, scale: float, opacity: float) -> dict[str, np.ndarray]:
    """A scene of the family "surface" or "volume", of one scale [m] and peak opacity [1]."""
    return {"surface": surface, "volume": volume}[kind](count, scale, opacity)


def inputs_of(
    scene: dict[str, np.ndarray], device: str | wp.Device, *, colour: bool = True
) -> Inputs:
    """The scene as Warp arrays, with the calibration of a sensor with depth_range 15 m."""
    rgb = None
    if colour:
        rgb = array_of(_constant(scene["colour"].T).transpose(1, 2, 0), device, wp.vec3)
    return Inputs(
        mean=array_of(scene["mean"], device, wp.vec3),
        log_scale=array_of(scene["log_scale"], device, wp.vec3),
        quaternion=array_of(scene["quaternion"], device, wp.vec4),
        opacity_logit=array_of(scene["opacity_logit"], device),
        reflectivity_sh=array_of(_constant(scene["reflectivity"]), device),
        colour_sh=rgb,
        calibration=array_of(CALIBRATION, device),
    )


def array_of(value, device: str | wp.Device, dtype=float) -> wp.array:
    """A float32 array on the device."""
    return wp.array(np.ascontiguousarray(value, np.float32), dtype=dtype, device=device)


def _constant(value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 16"]:
    """Spherical harmonics that are ``value`` in every direction."""
    coefficients = np.zeros((*value.shape, SH_COEFFICIENTS), dtype=np.float32)
    coefficients[..., 0] = (value.astype(np.float32) - SH_BIAS) / SH_Y0
    return coefficients
