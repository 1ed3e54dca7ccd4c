"""Writing a sequence as a capture: the inverse of :func:`gftorf_warp.data.capture.read`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import __version__
from .capture_json import NAME
from .exr import Parts
from .sequence import Intrinsics, Sequence, Truth
from .specs import layer_field
from .writing import float32, with_zero

VERSION = "1.0"


def files(sequence: Sequence, truth: Truth | None) -> Iterator[tuple[str, bytes | Parts]]:
    """Name and content of every file of a folder.

    Reading it gives the same sequence: images bit by bit in float32, numbers exactly, poses, which
    are stored inverted, to the last digit or two.
    """
    yield NAME, _json(sequence)
    for n in np.flatnonzero(sequence.measured).tolist():
        yield f"tof/{n:06d}.exr", _raw_frame(sequence, n)
    for n, image in sequence.colour.images.items():
        channels = dict(zip("RGB", np.moveaxis(float32(image), -1, 0), strict=True))
        yield f"colour/{n:06d}.exr", {"colour": channels}
    if truth is not None:
        for n in np.flatnonzero(truth.known).tolist():
            yield f"truth/{n:06d}.exr", _truth(truth, n)


def _raw_frame(sequence: Sequence, n: int) -> Parts:
    """Parts of one raw frame."""
    parts: Parts = {"raw": {"q": with_zero(sequence, n)}}
    if n in sequence.tap_sums:
        parts["taps"] = {"sum": float32(sequence.tap_sums[n])}
    flow = {"flow.forward": sequence.flow.forward, "flow.backward": sequence.flow.backward}
    for name, images in flow.items():
        if n in images:
            parts[name] = dict(zip(("dx", "dy"), float32(images[n]), strict=True))
    return parts


def _truth(truth: Truth, n: int) -> Parts:
    """Parts of the ground truth of one raw frame."""
    parts: Parts = {"distance": {"distance": float32(truth.distance[n])}}
    if truth.phasor_distance is not None:
        parts["phasor_distance"] = {"distance": float32(truth.phasor_distance[n])}
    if truth.amplitude is not None:
        parts["amplitude"] = {"amplitude": float32(truth.amplitude[n])}
    if truth.body is not None:
        parts["object"] = {"object": (truth.body[n].astype(np.int64) + 1).astype(np.uint32)}
    for name, images in truth.layers.items():
        parts[name] = dict(zip(layer_field(name).channels, float32(images[n]), strict=True))
    return parts


def _json(sequence: Sequence) -> bytes:
    """Everything but images; one value a line, one raw frame a line."""
    cameras = {"tof": _camera((sequence.height, sequence.width), sequence.intrinsics)}
    if sequence.intrinsics.distortion is not None:
        cameras["tof"]["distortion"] = [float(k) for k in sequence.intrinsics.distortion]
    colour = sequence.colour
    if colour.intrinsics is not None:
        size = colour.size or (sequence.height, sequence.width)
        cameras["colour"] = _camera(size, colour.intrinsics)
    elif colour.size is not None:
        cameras["colour"] = {"size": list(colour.size[::-1])}
    stated = sequence.calibration
    sensor: dict[str, Any] = {
        "phase_offset_rad": float(stated.phase_offset),
        "dc_offset": float(stated.dc_offset),
        "raw_unit": "relative",
    }
    if stated.adc_zero:
        sensor["adc_zero"] = float(stated.adc_zero)
    if stated.quad_scale is not None:
        sensor["raw_scale"] = float(stated.quad_scale)
    if stated.cycle_length is not None:
        sensor["cycle_frames"] = int(stated.cycle_length)
    if stated.settings:
        sensor["settings"] = stated.settings
    head: dict[str, Any] = {
        "schema": "capture",
        "version": VERSION,
        "units": {"length": "m", "time": "s", "angle": "rad"},
        "axes": "opencv",
        "pixel_centre": "half",
        "kind": "phasor" if sequence.from_phasors else "raw",
        "cameras": cameras,
        "sensor": sensor,
        "provenance": {"writer": f"gftorf-warp {__version__}"},
    }
    if sequence.novel_from_world is not None:
        head["novel_to_world"] = inverse(sequence.novel_from_world).tolist()
    lines = [json.dumps(frame, allow_nan=False) for frame in _frames(sequence)]
    rows = [f' "{key}": {json.dumps(value, allow_nan=False)},\n' for key, value in head.items()]
    return ("{\n" + "".join(rows) + ' "frames": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n").encode()


def _frames(sequence: Sequence) -> list[dict[str, Any]]:
    """One table for each raw frame."""
    columns: dict[str, Any] = {
        "id": list(range(sequence.frames)),
        "t": sequence.times.tolist(),
        "f_mod_hz": sequence.frame_frequencies.tolist(),
        "shift_rad": sequence.shifts.tolist(),
        "measured": sequence.measured.tolist(),
        "camera_to_world": inverse(sequence.camera_from_world).tolist(),
    }
    if sequence.exposures is not None:
        columns["exposure"] = sequence.exposures.tolist()
    if sequence.colour.camera_from_world is not None:
        columns["colour_to_world"] = inverse(sequence.colour.camera_from_world).tolist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _camera(size: tuple[int, int], camera: Intrinsics) -> dict[str, Any]:
    """Size as rows and columns; stored are columns and rows."""
    matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return {"size": list(size[::-1]), "K": [[float(x) for x in row] for row in matrix]}


def inverse(poses: Float[np.ndarray, "F 4 4"]) -> Float[np.ndarray, "F 4 4"]:
    """Inverse poses, without negative zeros."""
    return np.linalg.inv(poses) + 0.0
