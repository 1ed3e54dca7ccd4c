"""Calibration of a folder: scalars, intrinsics, shifts and times, each with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError, UsageError
from . import specs
from .arrays import read_choice, read_stored
from .problems import Problems
from .sequence import DEPTH_RANGES_M, Calibration, Intrinsics

# of the image width: a view of 168 degrees; a shorter one is in image widths or millimetres
FOCAL_MIN = 0.05
FIX_DEPTH_RANGE = "store speed of light / modulation frequency in metres, 15 for 20 MHz"
# the error is among the problems
UNREAD = Intrinsics(fx=math.nan, fy=math.nan, cx=math.nan, cy=math.nan)


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """Calibration of the ToF camera in cams/."""

    calibration: Calibration
    """Constants of the sensor."""
    intrinsics: Intrinsics
    """Intrinsics, pixel centres at i + 0.5."""
    half: float
    """Added to the stored cx and cy [px]: 0.5 if stored pixel centres are at integers, else 0."""
    sources: dict[str, str]
    """Source of each value by name."""


def read_calibration(root: Path, form: str, problems: Problems, width: int | None) -> Calibrated:
    """Read everything in cams/ that does not depend on the number of frames or on colour.

    ``width`` is that of the images; None if unknown: intrinsics are then not compared with it.
    """
    fields = specs.fields(form)
    none = "default 0: a phasor has no constant part"
    sources = {"dc_offset": none, "adc_zero": none}

    def scalar(name: str, key: str) -> float | None:
        return problems.attempt(_scalar, root, fields[name], sources, key)

    depth_range = scalar("depth_range", "f_mod_hz")
    if depth_range is not None:
        sources["f_mod_hz"] += f", depth_range {depth_range:.9g} m"
    raw = "dc_offset" in fields  # not of phasors
    calibration = Calibration(
        f_mod_hz=math.nan if depth_range is None else SPEED_OF_LIGHT / depth_range,
        phase_offset=scalar("phase_offset", "phase_offset") or 0.0,
        dc_offset=(scalar("dc_offset", "dc_offset") or 0.0) if raw else 0.0,
        adc_zero=(scalar("adc_zero", "adc_zero") or 0.0) if raw else 0.0,
        quad_scale=scalar("quad_values_scale_factor", "quad_scale"),
    )
    lens = problems.attempt(_tof_intrinsics, root, fields, sources, width)
    intrinsics, half = lens or (UNREAD, 0.0)
    return Calibrated(calibration=calibration, intrinsics=intrinsics, half=half, sources=sources)


def subtract_zero(quads: Float[np.ndarray, "F H W"], measured: np.ndarray, zero: float) -> None:
    """Subtract ``Calibration.adc_zero`` from the measured raw frames, in place.

    In float64, so that codes of 24 bits and a zero that is a whole number stay exact.
    """
    for n in np.flatnonzero(measured).tolist() if zero else []:
        quads[n] = quads[n].astype(np.float64) - zero


def read_colour_intrinsics(
    root: Path,
    form: str,
    tof: Calibrated,
    tof_size: dict[str, int],
    size: tuple[int, int],
    sources: dict[str, str],
) -> Intrinsics:
    """Intrinsics of colour images of ``size`` (rows, columns): the file's, in the pixel centres of
    the ToF camera, or those of the ToF camera, scaled.

    Raises:
        InputError: If the file is not what data_specs/ describes.
    """
    spec = specs.fields(form)["color_intrinsics"]
    stored = _pinhole(root, spec, size[1])
    if stored is not None:
        intrinsics, path = stored
        integer = f"integer pixel centres (cx, cy + {tof.half})"
        centres = integer if tof.half else "half pixel centres (kept)"
        sources["colour_intrinsics"] = f"file {path}, {centres} as for the ToF camera"
        return replace(intrinsics, cx=intrinsics.cx + tof.half, cy=intrinsics.cy + tof.half)
    sources["colour_intrinsics"] = f"inferred from tof_intrinsics, scaled (no {spec.paths[0]})"
    sx, sy = size[1] / tof_size.get("W", 1), size[0] / tof_size.get("H", 1)
    return tof.intrinsics.scaled(sx, sy)


def read_shifts(root: Path, form: str, frames: int, sources: dict[str, str]) -> np.ndarray:
    """Shift of each raw frame [F] [rad]; slot k of an F-ToeRF folder has canonical channel
    argsort(permutation)[k].

    Raises:
        InputError: If the permutation is not one.
    """
    if form == "torf":
        sources["shifts"] = "file tof: phasors, as four simultaneous quads 0, pi, pi/2, 3 pi/2"
        return np.resize(CANONICAL_SHIFTS, frames)
    spec = specs.fields("ftorf")["permutation"]
    stored = read_stored(root, spec)
    if stored is not None:
        values, name = stored
        if sorted(values.tolist()) != [0, 1, 2, 3]:
            why = f"expected the numbers 0, 1, 2, 3 in some order, found {values.tolist()}"
            fix = "store the order with canonical = raw[permutation], canonical being +cos, -cos, "
            fix += "+sin, -sin"
            raise InputError("unknown permutation", where=root / name, why=why, fix=fix)
        sources["shifts"] = f"file {name}: {[int(v) for v in values]}"
    else:
        values = np.array(spec.default)
        sources["shifts"] = "default order +cos, -cos, +sin, -sin (no tof_permutation.npy)"
    channel_of_slot = np.argsort(values)
    return np.array(CANONICAL_SHIFTS)[channel_of_slot[np.arange(frames) % FRAMES_PER_QUARTET]]


def read_times(
    root: Path,
    form: str,
    frames: int,
    frame_rate_hz: float | None,
    default_hz: float,
    sources: dict[str, str],
) -> np.ndarray:
    """Time of each of at least ``frames`` raw frames (F-ToeRF) or phasors (ToeRF) [s]; more if the
    file has more: the last were not measured.

    ``frame_rate_hz`` overrides the file; ``default_hz`` is used if nothing states a rate.

    Raises:
        UsageError: If the given rate is not above 0.
        InputError: If the file has too few times, or they decrease.
    """
    stored = read_stored(root, specs.fields(form)["frame_times"])
    times = None if stored is None else stored[0].astype(np.float64)
    if stored is not None and times is not None:
        if len(times) < frames or times[0] != 0.0 or (np.diff(times) < 0).any():
            steps = np.flatnonzero(np.diff(times) < 0)
            why = f"expected {frames} or more times in seconds that start at 0 and never decrease, "
            why += f"found {len(times)} from {times[0]:g} to {times[-1]:g}"
            why += f", decreasing after frame {steps[0]}" if len(steps) else ""
            fix = "correct the order and subtract the first time, or remove the file for "
            fix += f"{default_hz:g} Hz"
            raise InputError("frame_times", where=root / stored[1], why=why, fix=fix)
        frames = len(times)
        sources["times"] = f"file {stored[1]}"
    if frame_rate_hz is not None:
        if not (math.isfinite(frame_rate_hz) and frame_rate_hz > 0):
            why = f"expected more than 0, found {frame_rate_hz}"
            raise UsageError("frame rate", where="frame_rate_hz", why=why, fix="give Hz")
        sources["times"] = f"setting {frame_rate_hz:g} Hz"
        return np.arange(frames) / frame_rate_hz
    if times is not None:
        return times
    sources["times"] = f"default {default_hz:g} Hz"
    return np.arange(frames) / default_hz


def _scalar(root: Path, spec: specs.Field, sources: dict[str, str], key: str) -> float | None:
    """One number and its source; None if it has neither file nor default."""
    stored = read_stored(root, spec)
    if stored is None:
        given = spec.default is not None
        sources[key] = f"default {spec.default} (no {spec.paths[0]})" if given else "default none"
        return spec.default if isinstance(spec.default, float) else None
    value, path = float(stored[0].reshape(())), stored[1]
    low, high = DEPTH_RANGES_M
    holds, bounds, fix = {
        "depth_range": (low <= value <= high, f"{low:g} to {high:g}", FIX_DEPTH_RANGE),
        "quad_values_scale_factor": (value > 0, "above 0", "store the factor, or remove the file"),
    }.get(spec.name, (True, "", ""))
    if not holds:
        why = f"expected {spec.name} in {spec.unit}, {bounds}, found {value:g}"
        raise InputError(f"implausible {spec.name}", where=root / path, why=why, fix=fix)
    sources[key] = f"file {path}"
    return value


def _tof_intrinsics(
    root: Path, fields: dict[str, specs.Field], sources: dict[str, str], width: int | None
) -> tuple[Intrinsics, float]:
    """Intrinsics with pixel centres at i + 0.5, and the offset [px] that was added to cx, cy."""
    spec, centre = fields["tof_intrinsics"], fields["pixel_centre"]
    stored = _pinhole(root, spec, width)
    if stored is None:
        why = f"expected {' or '.join(spec.paths)}, found neither"
        fix = "store the 3x3 pinhole matrix of the ToF camera in pixels"
        raise InputError("tof_intrinsics missing", where=root / spec.paths[0], why=why, fix=fix)
    intrinsics, path = stored
    if (root / centre.paths[0]).exists():
        convention = read_choice(root / centre.paths[0], centre)
        source = f"file {centre.paths[0]}"
    else:
        convention = "half" if width is not None and intrinsics.cx == width / 2 else "integer"
        source = f"inferred from cx = {intrinsics.cx:g} at width {width}"
    half = 0.5 if convention == "integer" else 0.0
    sources |= dict.fromkeys(("fx", "fy"), f"file {path}")
    added = "cx, cy + 0.5" if half else "kept"
    of_centre = f"file {path}, {convention} pixel centres ({added}), {source}"
    sources |= dict.fromkeys(("cx", "cy"), of_centre)
    sources["pixel_centre"] = f"{source}: {convention}"
    return replace(intrinsics, cx=intrinsics.cx + half, cy=intrinsics.cy + half), half


def _pinhole(root: Path, spec: specs.Field, width: int | None) -> tuple[Intrinsics, str] | None:
    """Intrinsics as stored, and the file; None if there is none."""
    stored = read_stored(root, spec)
    if stored is None:
        return None
    matrix, path = stored[0].astype(np.float64), stored[1]
    (fx, fy), (cx, cy) = matrix.diagonal()[:2].tolist(), matrix[:2, 2].tolist()
    pinhole = np.eye(len(matrix))
    pinhole[:2, :3] = [fx, 0, cx], [0, fy, cy]
    plausible = min(fx, fy) > 0 and min(fx, fy) >= FOCAL_MIN * (width or 0)
    if not (plausible and np.allclose(matrix, pinhole, atol=1e-6)):
        why = "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy at least "
        why += f"{FOCAL_MIN} of the width ({width or 'unknown'}), found {matrix.tolist()}"
        fix = "store pixels, not fractions of the width or millimetres; no skew, not transposed"
        raise InputError("implausible intrinsics", where=root / path, why=why, fix=fix)
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy), path
