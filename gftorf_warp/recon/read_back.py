"""config.json of a run, read back and checked: camera, sensor and renderer that it describes."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..constants import CANONICAL_SHIFTS
from ..data.sequence import Calibration
from ..errors import InputError
from ..render.buffers import ClampGradient, Distortion, RenderSettings, SplatDistance, Stop, Support
from ..scene.camera import Camera
from ..scene.distortion import Distortion as Lens
from ..scene.sensor import Sensor
from .folder import CONFIG, read_config
from .joined import Window
from .settings import FlowSource, Method
from .volume.settings import settings_of

NUMBER = int | float
KINDS: dict[str, Any] = {
    "settings": dict,
    "camera": dict,
    "sensor": dict,
    "sequence": str | None,
    "quad_scale": NUMBER,
    "size_optimised": list,
    "images": int,
    "images_optimised": int | None,
    "seconds_reconstruct": NUMBER | None,
}
"""What a run needs to be opened, by key."""
OPTIONAL: dict[str, Any] = {
    "colour_scale": NUMBER | None,
    "data_sha256": str | None,
    "edited_from": str | None,
    "excerpt": list | None,
    "windows": list | None,
    "window_s": NUMBER,
    "overlap_s": NUMBER | None,
    "gaussians": int | None,
    "frame_rate_hz": NUMBER | None,
    "times": str | None,
    "changes": list | None,
    "unfilled_share": NUMBER | None,
}
"""What older versions or other methods left out."""
ENUMS: dict[str, type[enum.Enum]] = {
    "support": Support,
    "stop": Stop,
    "clamp_gradient": ClampGradient,
    "distortion": Distortion,
    "splat_distance": SplatDistance,
}
"""Kinds of settings of the renderer that are stored as texts."""
SIDE_MAX = 1 << 15  # [px] of an image: what OpenCV and EXR can write


@dataclass(frozen=True)
class ReadBack:
    """Content of ``config.json``, and what it describes."""

    config: dict[str, Any]
    """The content."""
    camera: Camera
    """The camera of raw frame 0 at the sequence's own resolution."""
    sensor: Sensor
    """The sensor, with the four canonical shifts, at all its frequencies."""


def read_back(run: Path) -> ReadBack:
    """Read ``RUN/config.json``.

    Raises:
        InputError: If it is missing, or a value is not of its kind.
    """
    config = read_config(run)
    for name, kind in KINDS.items():
        if name not in config:
            raise _wrong(run, f"there is no {name}")
        _check_kind(run, config, name, kind)
    for name in OPTIONAL.keys() & config.keys():
        _check_kind(run, config, name, OPTIONAL[name])
    if not (math.isfinite(config["quad_scale"]) and config["quad_scale"] > 0):
        raise _wrong(run, f"quad_scale must be above 0, found {config['quad_scale']}")
    _check_size(run, config["size_optimised"], "size_optimised")
    try:
        camera, sensor = _camera(config["camera"]), _sensor(config["sensor"])
        render_settings(config)
        for stored in config.get("windows") or ():
            Window.of(stored)
        if config.get("excerpt"):
            range(*config["excerpt"])
        FlowSource(config["settings"].get("flow", FlowSource.AUTO))
        if Method(config["settings"].get("method", Method.GAUSSIANS)).is_volume:
            settings_of(config["settings"]["volume"])
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise _wrong(run, f"{type(error).__name__}: {error}") from error
    _check_size(run, [camera.width, camera.height], "camera")
    return ReadBack(config, camera, sensor)


def render_settings(config: dict[str, Any]) -> RenderSettings:
    """The settings of the renderer in the content of ``config.json``."""
    stored = config["settings"]["render"]
    named = {name: kind(stored[name]) for name, kind in ENUMS.items() if name in stored}
    return RenderSettings(**stored | named)


def _camera(stored: dict[str, Any]) -> Camera:
    lens = Lens(**stored.get("distortion", {}))
    pose = np.array(stored["camera_from_world"], dtype=np.float64)
    return Camera(**stored | {"camera_from_world": pose, "distortion": lens})


def _sensor(stored: dict[str, Any]) -> Sensor:
    further = tuple(stored.get("further_hz", ()))
    sensor = Sensor(**stored | {"further_hz": further}, shifts=CANONICAL_SHIFTS)
    numbers = [value for name, value in stored.items() if name != "further_hz"]
    if not all(isinstance(value, NUMBER) for value in [*numbers, *further]):
        raise ValueError(f"sensor must hold numbers, found {stored}")
    Calibration(f_mod_hz=float(stored["f_mod_hz"]))  # raises a ValueError if it is not in hertz
    return sensor


def _check_kind(run: Path, config: dict[str, Any], name: str, kind: Any) -> None:
    if not isinstance(config[name], kind):
        raise _wrong(run, f"{name} is {str(config[name])[:40]!r}")


def _check_size(run: Path, size: list[Any], name: str) -> None:
    if len(size) != 2 or not all(type(n) is int and 1 <= n <= SIDE_MAX for n in size):
        why = f"{name} must be two sides of an image of 1 to {SIDE_MAX} pixels, found {size}"
        raise _wrong(run, why[:160])


def _wrong(run: Path, why: str) -> InputError:
    fix = "restore config.json from a copy, or reconstruct again into another folder"
    return InputError("not the config of a run", where=run / CONFIG, why=why, fix=fix)
