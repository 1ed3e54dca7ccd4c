"""Checks of a sequence that is to be written, and files that formats share."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import UsageError
from .calibration import DEPTH_RANGES_M, FOCAL_MIN
from .poses import rigid
from .sequence import Intrinsics, Sequence, Truth
from .specs import layer_field


def calibration_files(
    sequence: Sequence, times: np.ndarray, camera_from_world: np.ndarray
) -> Iterator[tuple[str, bytes]]:
    """The files that both formats have, by relative name,
    for frames of these times [s] and poses.
    """
    yield "cams/tof_intrinsics.npy", npy(_pinhole(sequence.intrinsics))
    yield "cams/color_intrinsics.npy", npy(_pinhole(_colour_intrinsics(sequence)))
    yield "cams/pixel_centre.json", json_bytes({"pixel_centre": "integer"})
    yield "cams/tof_extrinsics.npy", npy(camera_from_world.astype(np.float64))
    yield "cams/frame_times.npy", npy(times.astype(np.float64))
    yield "cams/depth_range.npy", npy(np.float64(SPEED_OF_LIGHT / sequence.calibration.f_mod_hz))
    yield "cams/phase_offset.npy", npy(np.float64(sequence.calibration.phase_offset))
    if sequence.calibration.quad_scale is not None:
        yield "cams/quad_values_scale_factor.npy", npy(np.float64(sequence.calibration.quad_scale))
    if sequence.novel_from_world is not None:
        yield "test_poses.npy", npy(sequence.novel_from_world.astype(np.float64))


def validate(sequence: Sequence, truth: Truth | None) -> None:
    """Check that the parts of a sequence fit together.

    Raises:
        ValueError: If not, which is a programming mistake.
    """
    frames, shape = sequence.frames, (sequence.frames, sequence.height, sequence.width)
    lengths = {
        "quads": (sequence.quads.shape, shape),
        "shifts": (sequence.shifts.shape, (frames,)),
        "times": (sequence.times.shape, (frames,)),
        "frequencies_hz": (sequence.frame_frequencies.shape, (frames,)),
        "camera_from_world": (sequence.camera_from_world.shape, (frames, 4, 4)),
    }
    if sequence.colour.camera_from_world is not None:
        lengths["colour_from_world"] = (sequence.colour.camera_from_world.shape, (frames, 4, 4))
    if sequence.novel_from_world is not None:
        views = sequence.novel_from_world
        lengths["novel_from_world"] = (views.shape, (max(1, len(views)), 4, 4))
    images = {"forward_flow": sequence.flow.forward, "backward_flow": sequence.flow.backward}
    for name, flows in images.items():
        lengths |= {f"{name}[{n}]": (flow.shape, (2, *shape[1:])) for n, flow in flows.items()}
    images["colour"] = sequence.colour.images
    size = sequence.colour.size or ()
    lengths |= {
        f"colour[{n}]": (image.shape, (*size, 3)) for n, image in sequence.colour.images.items()
    }
    if truth is not None:
        lengths |= {
            "truth.distance": (truth.distance.shape, shape),
            "truth.known": (truth.known.shape, (frames,)),
        }
        more = {name: getattr(truth, name) for name in ("phasor_distance", "amplitude", "body")}
        lengths |= {
            f"truth.{name}": (image.shape, shape)
            for name, image in more.items()
            if image is not None
        }
        for name, layer in truth.layers.items():
            lengths[f"truth.layers[{name}]"] = (
                layer.shape,
                (frames, len(layer_field(name).channels), *shape[1:]),
            )
    for name, (found, expected) in lengths.items():
        if found != expected:
            raise ValueError(f"{name} {found} must have shape {expected}")
    for name, by_frame in images.items():
        outside = [n for n in by_frame if not 0 <= n < frames]
        if outside:
            raise ValueError(f"{name}: raw frames {outside} are not in 0..{frames - 1}")
    if sequence.from_phasors:
        _validate_phasors(sequence)


def _validate_phasors(sequence: Sequence) -> None:
    """Check that raw frames of phasors have their form."""
    step = FRAMES_PER_QUARTET
    if sequence.frames % step:
        raise ValueError(f"from_phasors: {sequence.frames} raw frames must be a multiple of {step}")
    quads = sequence.quads.reshape(-1, step, sequence.height, sequence.width)
    rules = {
        "shifts": np.array_equal(sequence.shifts, np.tile(CANONICAL_SHIFTS, len(quads))),
        "quads": np.array_equal(quads[:, 0], -quads[:, 1])
        and np.array_equal(quads[:, 2], -quads[:, 3]),
        "dc_offset": sequence.calibration.dc_offset == 0,
    }
    per_frame = {
        "measured": sequence.measured,
        "times": sequence.times,
        "camera_from_world": sequence.camera_from_world,
        "colour_from_world": sequence.colour.camera_from_world,
    }
    for name, values in per_frame.items():
        rules[name] = values is None or np.array_equal(
            values, np.repeat(values[::step], step, axis=0)
        )
    for name, holds in rules.items():
        if not holds:
            raise ValueError(
                f"from_phasors: {name} must be those of re/2, -re/2, im/2, -im/2 at one instant"
            )


def refuse_inexpressible(form: str, sequence: Sequence, truth: Truth | None) -> None:
    """Check that the reader will accept the folder: its limits are those of the format.

    Raises:
        UsageError: If not.
    """
    flows = [*sequence.flow.forward.values(), *sequence.flow.backward.values()]
    times = sequence.times
    distance = np.ones(1) if truth is None else truth.distance[truth.known]
    static = (
        np.zeros(1)
        if truth is None or truth.phasor_distance is None
        else truth.phasor_distance[truth.known]
    )
    stated, tof = sequence.calibration, sequence.intrinsics
    numbers = (stated.f_mod_hz, stated.phase_offset, stated.dc_offset, stated.quad_scale or 1.0)
    focal = tof.fx, tof.fy
    colour, colour_width = _colour_intrinsics(sequence), _colour_size(sequence)[1]
    family = form in ("ftorf", "torf")  # these state one depth range and one matrix
    rules = {  # what: (whether it holds, expected, found)
        "frequencies_hz": (
            not family or sequence.frequencies_hz is None,
            "one modulation frequency",
            f"{sequence.frequencies_hz}",
        ),
        "shifts": (
            not family or sequence.cycle == FRAMES_PER_QUARTET,
            f"cycles of {FRAMES_PER_QUARTET} raw frames",
            f"of {sequence.cycle}",
        ),
        "distortion": (
            not family or tof.distortion is None,
            "a pinhole",
            f"a lens with {tof.distortion}",
        ),
        "an empty sequence": (sequence.measured.any(), "at least one measured raw frame", "none"),
        "quads": (
            np.isfinite(sequence.quads[sequence.measured]).all(),
            "finite numbers",
            "NaN or infinity",
        ),
        "times": (
            np.isfinite(times).all() and times[0] == 0 and (np.diff(times) >= 0).all(),
            "seconds since the first raw frame, never decreasing",
            f"{times[:8].tolist()} ..",
        ),
        "calibration": (np.isfinite(numbers).all(), "finite numbers", str(numbers)),
        "f_mod_hz": (
            DEPTH_RANGES_M[0] <= SPEED_OF_LIGHT / stated.f_mod_hz <= DEPTH_RANGES_M[1],
            f"speed of light / frequency between {DEPTH_RANGES_M[0]} and {DEPTH_RANGES_M[1]} m",
            f"{stated.f_mod_hz} Hz",
        ),
        "quad_scale": (
            stated.quad_scale is None or stated.quad_scale > 0,
            "above 0",
            str(stated.quad_scale),
        ),
        "focal length": (
            min(focal) >= FOCAL_MIN * sequence.width,
            f"pixels, at least {FOCAL_MIN} of the width {sequence.width}",
            str(focal),
        ),
        "colour_intrinsics": (
            np.isfinite([colour.fx, colour.fy, colour.cx, colour.cy]).all()
            and min(colour.fx, colour.fy) >= FOCAL_MIN * colour_width,
            f"pixels, at least {FOCAL_MIN} of the width {colour_width}",
            str(colour),
        ),
        "colour": (
            all(np.isfinite(i).all() for i in sequence.colour.images.values()),
            "finite numbers",
            "NaN or infinity",
        ),
        "phasor_distance": (
            ((static >= 0) & (static < np.inf) | np.isnan(static)).all(),
            "metres or NaN",
            "others",
        ),
        "layers": (
            truth is None or not any(np.isinf(images).any() for images in truth.layers.values()),
            "numbers, or NaN for unknown",
            "infinity",
        ),
        "flow": (
            not any(np.isinf(flow).any() for flow in flows),
            "pixels, or NaN for unknown",
            "infinity",
        ),
        "truth": (
            ((distance > 0) & (distance < np.inf) | np.isnan(distance)).all(),
            "distances above 0 m, or NaN for unknown",
            "zero, negative or infinite distances",
        ),
    }
    poses = {
        "colour_from_world": sequence.colour.camera_from_world,
        "novel_from_world": sequence.novel_from_world,
        "camera_from_world": sequence.camera_from_world,
    }
    for what, matrices in poses.items():
        holds = matrices is None or rigid(matrices).all()
        rules[what] = (holds, "rotations and translations", "other matrices")
    for what, (holds, expected, found) in rules.items():
        if not holds:
            raise inexpressible(form, what, expected, found)


def inexpressible(form: str, what: str, expected: str, found: str) -> UsageError:
    """The error for values that a format cannot store."""
    return UsageError(
        f"{what}: the {form} format cannot hold this",
        where=f"format {form}",
        why=f"expected {expected}, found {found}",
        fix="change the sensor or the sequence",
    )


def _colour_size(sequence: Sequence) -> tuple[int, int]:
    """Rows and columns of the colour images; without any, those of the quads."""
    return sequence.colour.size or (sequence.height, sequence.width)


def _colour_intrinsics(sequence: Sequence) -> Intrinsics:
    """Those of the colour camera; public loaders require one, so without any,
    those of the ToF camera, scaled.
    """
    if sequence.colour.intrinsics is not None:
        return sequence.colour.intrinsics
    height, width = _colour_size(sequence)
    return sequence.intrinsics.scaled(width / sequence.width, height / sequence.height)


def _pinhole(camera: Intrinsics) -> np.ndarray:
    """Matrix for integer pixel centres, 3x3."""
    rows = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
    return np.array(rows, dtype=np.float64)


def float32(array: np.ndarray) -> np.ndarray:
    """The array as contiguous float32."""
    return np.ascontiguousarray(array, dtype=np.float32)


def shortest(array: np.ndarray) -> np.ndarray:
    """The array as float16 if that is exact, else unchanged."""
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), array) else array


def npy(array: np.ndarray | np.floating) -> bytes:
    """Bytes of a .npy file, little endian."""
    buffer = io.BytesIO()
    array = np.asarray(array)
    np.lib.format.write_array(
        buffer, array.astype(array.dtype.newbyteorder("<")), version=(1, 0), allow_pickle=False
    )
    return buffer.getvalue()


def json_bytes(content: dict[str, str]) -> bytes:
    """One line of JSON."""
    return (json.dumps(content) + "\n").encode()
