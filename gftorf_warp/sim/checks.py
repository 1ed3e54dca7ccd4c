"""Mistakes of users in what is to be simulated: each is refused by a named error before anything is written."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS
from ..data.contact_sheet import SHIFTS_MIN
from ..errors import UsageError
from .assembly import has_mesh
from .gaussian_cover import clearance
from .readout import why_impossible
from .scene import Scene
from .settings import SimSettings, require

CLEARANCE = 0.5  # [m] nearer bodies fill the image, and a cover of them would need millions of splats


def check_engine(scene: Scene, settings: SimSettings, device: str = "cpu") -> None:
    """Raise a UsageError if the engine cannot simulate the scene, or not on this device."""
    if settings.engine == "mesh":
        return
    bodies = any(body.texture.gloss > 0 or (body.moves and has_mesh(body.shape)) for body in scene.bodies)
    needed = bodies or any(scene.emitter) or scene.beam_deg is not None or settings.bounces > 0
    effects = "the light is beside the camera, has a beam or bounces, or a body is glossy or a mesh that moves"
    require(not needed, "--engine", repr(settings.engine), f"mesh: {effects}")
    require(device == "cpu", "--device", f"{device} and engine {settings.engine!r}", "cpu, or --engine mesh")
    if scene.sensor.row_time_s > 0:
        raise _rolling("engine gaussian renders all rows of an image at one time", "--engine mesh")


def check_format(scene: Scene, settings: SimSettings) -> None:
    """Raise a UsageError if the sensor contradicts itself, or the layout on disk cannot store sensor or lens."""
    sensor, capture = scene.sensor, settings.format == "capture"
    turns = sorted(round(math.degrees(shift), 4) % 360.0 for shift in sensor.shifts)
    if capture and len(set(turns)) < SHIFTS_MIN:
        raise UsageError(
            "this sensor cannot measure a phase",
            where="sensor.shifts",
            why=f"a phase needs {SHIFTS_MIN} different shifts, found {turns} deg",
            fix="give it more of them",
        )
    if not capture and turns != sorted(math.degrees(shift) for shift in CANONICAL_SHIFTS):
        why = f"it holds the four shifts 0, 90, 180 and 270 deg in some order, not {turns} deg"
        raise _inexpressible("sensor", "sensor.shifts", why, "use those four shifts")
    if not capture and sensor.further_hz:
        why = f"it has one modulation frequency, not {1 + len(sensor.further_hz)}"
        raise _inexpressible("sensor", "sensor.further_hz", why, "leave sensor.further_hz out")
    impossible = why_impossible(sensor) if sensor.noise else None
    if impossible is not None:
        raise UsageError(
            "a tap of this sensor would hold negative light",
            where="sensor.dc_offset",
            why=impossible,
            fix="lower the contrast or the DC offset, or make the sensor unipolar",
        )
    if sensor.row_time_s > 0 and not capture:
        raise _rolling("an F-ToeRF folder has no times of rows", "--format capture")
    if sensor.row_time_s > 0 and settings.flow:
        raise _rolling("flow is from one time to another, and each row has its own time", "leave --flow out")
    if scene.lens.distortion and not capture:
        why = f"it holds the matrix of a pinhole, not {scene.lens.distortion}"
        raise _inexpressible("lens", "lens.distortion", why, "leave lens.distortion out")
    try:
        _ = scene.lens.distortion and scene.camera(settings.size)
    except ValueError as error:
        raise UsageError(
            "this lens cannot be undone over the whole image",
            where="lens.distortion",
            why=str(error),
            fix="make its coefficients or horizontal_fov_deg smaller, or the image less high",
        ) from error


def check_clearance(scene: Scene, times: Float[np.ndarray, "F"]) -> None:
    """Raise a UsageError if a body comes too near to the camera at one of ``times`` [s]: paths have no end."""
    centres = np.array([scene.camera(time=float(time)).centre for time in times])
    for body in (body for body in scene.bodies if body.moves):
        near = np.flatnonzero(clearance(body, centres, times) < CLEARANCE)
        if len(near):
            raise UsageError(
                f"a body comes nearer to the camera than {CLEARANCE} m",
                where="--frames",
                why=f"scene {scene.name} is made for {scene.frames} raw frames, and it happens at frame {near[0]}",
                fix=f"simulate at most {near[0]} raw frames",
            )


def _rolling(why: str, fix: str) -> UsageError:
    return UsageError("a rolling shutter cannot be simulated so", where="sensor.row_time_s", why=why, fix=fix)


def _inexpressible(what: str, where: str, why: str, fix: str) -> UsageError:
    what = f"an F-ToeRF folder cannot express this {what}"
    return UsageError(what, where=where, why=why, fix=f"{fix}, or --format capture")
