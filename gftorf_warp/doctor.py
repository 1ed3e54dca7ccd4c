"""``gftorf doctor``: versions, devices, and a test of the renderer against a closed form."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import shutil
import time
from pathlib import Path

from . import __version__, terminal

PACKAGES = ("torch", "warp-lang", "numpy", "opencv-contrib-python-headless", "OpenEXR")
# [m] of the Gaussian that is tested; in the first unambiguous range, where 1 cm is 8 mrad
DISTANCE = 2.0
REFLECTIVITY = 0.7
OPACITY = 0.8  # below the clamp of 0.99, and far from 1/255
# [relative] float32 rounds to 6e-8; phase, exponential and falloff take some tens of operations
TOLERANCE = 1e-5


def doctor(device: str) -> tuple[bool, list[str]]:
    """Whether the renderer passes the test on a device, and lines on this installation."""
    import torch
    import warp as wp

    cache = terminal.kernel_cache()
    seconds = compile_kernels(device)
    error = self_test_error(device)
    passed = error <= TOLERANCE
    verdict = "ok" if passed else "FAILED"
    versions = [f"{name} {_version(name)}" for name in PACKAGES]
    driver = wp.get_cuda_driver_version()
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    free = shutil.disk_usage(cache if cache.exists() else Path.home()).free
    writable = (
        "writable" if os.access(cache, os.W_OK) else "NOT WRITABLE: every start compiles again"
    )
    tested = f"one Gaussian on {device} against the formula, quads, phasor, distance, opacity"
    largest = f"largest relative error {error:.1e}, allowed {TOLERANCE:.0e}"
    rows = {
        "gftorf_warp": f"{__version__} in {terminal.home_as_tilde(Path(__file__).parent)}",
        "python": f"{platform.python_version()} on {platform.platform()}",
        "packages": ", ".join(versions[:4]),
        "": ", ".join(versions[4:]),
        "CUDA driver": "none found" if driver is None else ".".join(map(str, driver)),
        "GPUs": ", ".join(gpus) or "none: computing on the CPU, which is slower",
        "CPU threads": f"{torch.get_num_threads()} of {os.cpu_count()}",
        "kernel cache": f"{terminal.home_as_tilde(cache)} ({writable}; kernels ready after "
        f"{seconds:.1f} s)",
        "free disk": f"{free / 1e9:.1f} GB on the disk of the cache",
        "self-test": f"{verdict}: {tested}; {largest}",
    }
    return passed, [f"{name:<14}{text}" for name, text in rows.items()]


def self_test_error(device: str) -> float:
    """Largest relative error of one rendered Gaussian against the closed form at its centre pixel.

    At a pixel centre onto which the Gaussian's centre projects, alpha = o exactly, so the quad of
    shift theta is o a (cos(psi - theta) + b), the distance o d, and the opacity o.
    """
    field, camera, sensor = single_gaussian(device)
    from .render.api import rasterize

    rendering = rasterize(field, camera, sensor)
    y, x = camera.height // 2, camera.width // 2
    amplitude = OPACITY * REFLECTIVITY / DISTANCE**2
    psi = float(sensor.phase_slope) * DISTANCE + float(sensor.phase_offset)
    offset = float(sensor.dc_offset)
    want = [amplitude * (math.cos(psi - shift) + offset) for shift in sensor.shifts]
    want += [2 * amplitude * math.cos(psi), 2 * amplitude * math.sin(psi), 2 * amplitude]
    got = [float(value) for value in (*rendering.quads[:, y, x], *rendering.phasor[:, y, x])]
    errors = [abs(g - w) / (2 * amplitude) for g, w in zip(got, want, strict=True)]
    errors.append(abs(float(rendering.distance[y, x]) / (OPACITY * DISTANCE) - 1))
    errors.append(abs(float(rendering.opacity[y, x]) / OPACITY - 1))
    return max(error if math.isfinite(error) else math.inf for error in errors)


def compile_kernels(device: str) -> float:
    """Compile the kernels by rendering one Gaussian forward and backward; returns the time [s]."""
    from dataclasses import replace

    from .render.api import rasterize

    begun = time.monotonic()
    field, camera, sensor = single_gaussian(device)
    rendering = rasterize(replace(field, mean=field.mean.requires_grad_()), camera, sensor)
    rendering.quads.sum().backward()
    return time.monotonic() - begun


def single_gaussian(device: str):
    """An isotropic Gaussian on the middle pixel's ray, its camera, and a sensor with offsets."""
    import torch

    from .scene.camera import Camera
    from .scene.gaussians import GaussianField, constant_sh
    from .scene.sensor import Sensor

    camera = Camera(width=17, height=13, fx=20.0, fy=20.0, cx=8.5, cy=6.5)
    field = GaussianField(
        mean=torch.tensor([[0.0, 0.0, DISTANCE]]),
        log_scale=torch.full((1, 3), math.log(0.1)),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.tensor([math.log(OPACITY / (1 - OPACITY))]),
        reflectivity_sh=constant_sh(torch.tensor([REFLECTIVITY])),
    )
    sensor = Sensor(f_mod_hz=30e6, phase_offset=0.3, dc_offset=0.25)
    return field.map(lambda tensor: tensor.to(device)), camera, sensor


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
