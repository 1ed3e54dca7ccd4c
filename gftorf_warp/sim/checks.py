"""Checks of a scene and its settings, before anything is written."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from ..data.cycles import QUADS_MIN
from ..data.sequence import DEPTH_RANGES_M
from ..data.untrusted import FRAMES_MAX, SIDE_MAX
from ..errors import UsageError
from .assembly import has_mesh
from .gaussian_cover import clearance
from .readout import why_impossible
from .scene import Scene
from .settings import ResolvedSettings, refuse, require

# [m] nearer bodies fill the image, and a cover of them would need millions of splats
CLEARANCE = 0.5
NUMBER_MAX = 1e15  # of any quantity of a scene; its squares are far within float64
UNLIMITED = "sensor.full_well_electrons"
CAPTURE = "--format capture"
ROLLING = "a rolling shutter cannot be simulated so", "sensor.row_time_s"


def check_numbers(scene: Scene) -> None:
    """Raise a UsageError if a number of the scene is of no quantity that exists."""
    for name, value in _numbers(scene):
        good = abs(value) <= NUMBER_MAX or (name == UNLIMITED and value == math.inf)
        require(good, name, f"{value:g}", f"at most {NUMBER_MAX:g}")
    for frequency in (scene.sensor.f_mod_hz, *scene.sensor.further_hz):
        least, most = (SPEED_OF_LIGHT / depth_range for depth_range in DEPTH_RANGES_M[::-1])
        wanted = f"{least:.3g} to {most:.3g} Hz, 20e6 for 20 MHz"
        good = least <= float(frequency) <= most
        require(good, "sensor.f_mod_hz", f"{float(frequency):g}", wanted)
    cutoff = scene.sensor.contrast_cutoff_hz
    require(cutoff is None or cutoff >= 1, "sensor.contrast_cutoff_hz", f"{cutoff}", "at least 1")


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of nested dataclasses and tuples, with their names."""
    if isinstance(value, (int, float)):
        yield name, value
    elif isinstance(value, tuple):
        for i, part in enumerate(value):
            yield from _numbers(part, f"{name}.{i}")
    elif is_dataclass(value):
        for f in fields(value):
            yield from _numbers(getattr(value, f.name), f"{name}.{f.name}".removeprefix("."))


def check_engine(scene: Scene, settings: ResolvedSettings, device: str = "cpu") -> None:
    """Raise a UsageError if the engine cannot simulate the scene, or not on this device."""
    if settings.engine == "mesh":
        return
    bodies = any(
        body.texture.gloss > 0 or (body.moves and has_mesh(body.shape)) for body in scene.bodies
    )
    needed = bodies or any(scene.emitter) or scene.beam_deg is not None or settings.bounces > 0
    engine = repr(settings.engine)
    effects = "the light is beside the camera, has a beam or bounces, or a body is glossy or a mesh"
    require(not needed, "--engine", engine, f"mesh: {effects} that moves")
    require(device == "cpu", "--device", f"{device} and engine {engine}", "cpu, or --engine mesh")
    why = "engine gaussian renders all rows of an image at one time"
    refuse(scene.sensor.row_time_s > 0, ROLLING, why, "--engine mesh")


def check_format(scene: Scene, settings: ResolvedSettings) -> None:
    """Raise a UsageError if the sensor is contradictory, or the layout cannot store it."""
    sensor, lens, capture = scene.sensor, scene.lens, settings.format == "capture"
    turns = sorted(round(math.degrees(shift), 4) % 360.0 for shift in sensor.shifts)
    few = capture and len(set(turns)) < QUADS_MIN
    why = f"a phase needs {QUADS_MIN} different shifts, found {turns} deg"
    phaseless = "this sensor cannot measure a phase", "sensor.shifts"
    refuse(few, phaseless, why, "give it more of them")
    why, fix = "this sensor has one tap, see sensor.unipolar", "leave --taps out"
    alone = settings.taps and sensor.unipolar
    refuse(alone, ("there is no sum of taps", "--taps"), why, fix)
    impossible = why_impossible(sensor) if sensor.noise or settings.taps else None
    negative = "a tap of this sensor would hold negative light", "sensor.dc_offset"
    fix = "lower the contrast or the DC offset, or make the sensor unipolar"
    refuse(impossible is not None, negative, str(impossible), fix)
    if not capture:
        what = "an F-ToeRF folder cannot express this"
        others = turns != sorted(math.degrees(shift) for shift in CANONICAL_SHIFTS)
        why = f"it holds the four shifts 0, 90, 180 and 270 deg in some order, not {turns} deg"
        fix = f"use those four shifts, or {CAPTURE}"
        refuse(others, (f"{what} sensor", "sensor.shifts"), why, fix)
        why = f"it has one modulation frequency, not {1 + len(sensor.further_hz)}"
        fix = f"leave sensor.further_hz out, or {CAPTURE}"
        refuse(bool(sensor.further_hz), (f"{what} sensor", "sensor.further_hz"), why, fix)
        refuse(sensor.row_time_s > 0, ROLLING, "an F-ToeRF folder has no times of rows", CAPTURE)
        why = f"it holds the matrix of a pinhole, not {lens.distortion}"
        fix = f"leave lens.distortion out, or {CAPTURE}"
        refuse(bool(lens.distortion), (f"{what} lens", "lens.distortion"), why, fix)
    why = "flow is from one time to another, and each row has its own time"
    refuse(sensor.row_time_s > 0 and settings.flow, ROLLING, why, "leave --flow out")
    try:
        _ = lens.distortion and scene.camera(settings.size)
    except ValueError as error:
        what = "this lens cannot be undone over the whole image"
        fix = "make its coefficients or horizontal_fov_deg smaller, or the image less high"
        raise UsageError(what, where="lens.distortion", why=str(error), fix=fix) from error


def check_cameras(scene: Scene, times: Float[np.ndarray, "F"]) -> None:
    """Raise a UsageError if the camera at one of ``times`` [s], or a novel view, has no level
    axis.
    """
    novel = ((f"novel_views.{i}", view, 0.0) for i, view in enumerate(scene.novel_views))
    taken = (("camera_path", scene.camera_path, float(time)) for time in times)
    for where, path, time in (*novel, *taken):
        try:
            path.world_from_body(time)
        except ValueError as error:
            what, fix = "a camera that cannot be placed", "choose another position or target"
            raise UsageError(what, where=where, why=str(error), fix=fix) from error


def check_size(scene: Scene, settings: ResolvedSettings) -> None:
    """Raise a UsageError if no reader would accept as large images, or as many."""
    colour = scene.colour and scene.colour_camera(settings.size)
    sides = settings.size if colour is None else (*settings.size, colour.width, colour.height)
    got, few = "x".join(map(str, settings.size)), settings.frames < FRAMES_MAX
    within = f"at most {SIDE_MAX} pixels a side, those of the colour camera too"
    require(max(sides) <= SIDE_MAX, "--size", got, within)
    require(few, "--frames", f"{settings.frames}", f"fewer than {FRAMES_MAX}")


def check_clearance(scene: Scene, times: Float[np.ndarray, "F"]) -> None:
    """Raise a UsageError if a body comes too near to the camera at one of ``times`` [s]."""
    centres = np.array([scene.camera(time=float(time)).centre for time in times])
    what = f"a body comes nearer to the camera than {CLEARANCE} m"
    for body in (body for body in scene.bodies if body.moves):
        near = np.flatnonzero(clearance(body, centres, times) < CLEARANCE)
        first = near[0] if len(near) else 0
        made = f"scene {scene.name} is made for {scene.frames} raw frames"
        why = f"{made}, and it happens at frame {first}"
        refuse(len(near) > 0, (what, "--frames"), why, f"simulate at most {first} raw frames")
