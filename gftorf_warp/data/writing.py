"""Checks of a sequence that is to be written, and files that formats share."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import UsageError
from .calibration import FOCAL_MIN
from .poses import rigid
from .sequence import Intrinsics, Sequence, Truth
from .specs import layer_field
from .untrusted import FRAMES_MAX, SIDE_MAX


def calibration_files(
    sequence: Sequence, times: np.ndarray, camera_from_world: np.ndarray
) -> Iterator[tuple[str, bytes]]:
    """Files of both formats by relative name, for frames of these times [s] and poses."""
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
    frames, colour, novel = sequence.frames, sequence.colour, sequence.novel_from_world
    one, poses, pixels = (frames,), (frames, 4, 4), (sequence.height, sequence.width)
    by_frame = {
        "forward_flow": (sequence.flow.forward, (2, *pixels)),
        "backward_flow": (sequence.flow.backward, (2, *pixels)),
        "colour": (colour.images, (*(colour.size or ()), 3)),
    }
    arrays: dict[str, tuple[np.ndarray | None, tuple[int, ...]]] = {
        "quads": (sequence.quads, (frames, *pixels)),
        "shifts": (sequence.shifts, one),
        "times": (sequence.times, one),
        "frequencies_hz": (sequence.frame_frequencies, one),
        "camera_from_world": (sequence.camera_from_world, poses),
        "colour_from_world": (colour.camera_from_world, poses),
        "novel_from_world": (novel, (1 if novel is None else max(1, len(novel)), 4, 4)),
    }
    for name, (images, shape) in by_frame.items():
        arrays |= {f"{name}[{n}]": (image, shape) for n, image in images.items()}
    if truth is not None:
        arrays["truth.known"] = (truth.known, one)
        for name in ("distance", "phasor_distance", "amplitude", "body"):
            arrays[f"truth.{name}"] = (getattr(truth, name), (frames, *pixels))
        for name, layer in truth.layers.items():
            channels = len(layer_field(name).channels)
            arrays[f"truth.layers[{name}]"] = (layer, (frames, channels, *pixels))
    for name, (array, shape) in arrays.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} {array.shape} must have shape {shape}")
    for name, (images, _) in by_frame.items():
        outside = [n for n in images if not 0 <= n < frames]
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
        "quads": np.array_equal(quads[:, ::2], -quads[:, 1::2]),
        "dc_offset": sequence.calibration.dc_offset == 0,
        "adc_zero": sequence.calibration.adc_zero == 0,
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

    def require(holds: object, what: str, expected: str, actual: object) -> None:
        if not holds:
            raise inexpressible(form, what, expected, str(actual))

    stated, tof, times = sequence.calibration, sequence.intrinsics, sequence.times
    if form in ("ftorf", "torf"):  # these state one depth range and one matrix
        several = sequence.frequencies_hz
        require(several is None, "frequencies_hz", "one modulation frequency", several)
        expected = f"cycles of {FRAMES_PER_QUARTET} raw frames"
        cycle = sequence.cycle
        require(cycle == FRAMES_PER_QUARTET, "shifts", expected, f"of {cycle}")
        lens = tof.distortion
        require(lens is None, "distortion", "a pinhole", f"a lens with {lens}")
    sides = (sequence.width, sequence.height, *_colour_size(sequence)[::-1])
    require(max(sides) <= SIDE_MAX, "size", f"at most {SIDE_MAX} pixels a side", sides)
    few = sequence.frames < FRAMES_MAX
    require(few, "raw frames", f"fewer than {FRAMES_MAX}", sequence.frames)
    measured = sequence.measured
    require(measured.any(), "an empty sequence", "at least one measured raw frame", "none")
    finite, infinite = "finite numbers", "NaN or infinity"
    require(np.isfinite(sequence.quads[measured]).all(), "quads", finite, infinite)
    expected = "seconds since the first raw frame, never decreasing"
    holds = np.isfinite(times).all() and times[0] == 0 and (np.diff(times) >= 0).all()
    require(holds, "times", expected, f"{times[:8].tolist()} ..")
    exposures = sequence.exposures
    holds = exposures is None or (np.isfinite(exposures) & (exposures > 0)).all()
    require(holds, "exposures", "seconds above 0, or None where they are unknown", exposures)
    scale = stated.quad_scale
    constant = (stated.dc_offset, stated.adc_zero)
    constants = (stated.f_mod_hz, stated.phase_offset, *constant, scale or 1.0)
    require(np.isfinite(constants).all(), "calibration", finite, constants)
    require(scale is None or scale > 0, "quad_scale", "above 0", scale)
    colour = _colour_intrinsics(sequence)
    numbers = (colour.fx, colour.fy, colour.cx, colour.cy)
    for what, camera, width, actual, known in (
        ("focal length", tof, sequence.width, (tof.fx, tof.fy), True),
        (
            "colour_intrinsics",
            colour,
            _colour_size(sequence)[1],
            colour,
            np.isfinite(numbers).all(),
        ),
    ):
        holds = known and min(camera.fx, camera.fy) >= FOCAL_MIN * width
        require(holds, what, f"pixels, at least {FOCAL_MIN} of the width {width}", actual)
    images = sequence.colour.images.values()
    require(all(np.isfinite(image).all() for image in images), "colour", finite, infinite)
    flows = [*sequence.flow.forward.values(), *sequence.flow.backward.values()]
    holds = not any(np.isinf(flow).any() for flow in flows)
    require(holds, "flow", "pixels, or NaN for unknown", "infinity")
    if form == "capture":
        sums = [image for n, image in sequence.tap_sums.items() if measured[n]]
        require(all(np.isfinite(image).all() for image in sums), "tap_sums", finite, infinite)
    if truth is not None:
        if truth.amplitude is not None and form == "capture":
            light = truth.amplitude[truth.known]
            holds = ((light >= 0) & (light < np.inf)).all()
            require(holds, "amplitude", "finite numbers of 0 or more", "others")
        if truth.phasor_distance is not None:
            static = truth.phasor_distance[truth.known]
            holds = ((static >= 0) & (static < np.inf) | np.isnan(static)).all()
            require(holds, "phasor_distance", "metres or NaN", "others")
        holds = not any(np.isinf(images).any() for images in truth.layers.values())
        require(holds, "layers", "numbers, or NaN for unknown", "infinity")
        distance = truth.distance[truth.known]
        holds = ((distance > 0) & (distance < np.inf) | np.isnan(distance)).all()
        expected = "distances above 0 m, or NaN for unknown"
        require(holds, "truth", expected, "zero, negative or infinite distances")
    for what, matrices in (
        ("colour_from_world", sequence.colour.camera_from_world),
        ("novel_from_world", sequence.novel_from_world),
        ("camera_from_world", sequence.camera_from_world),
    ):
        holds = matrices is None or rigid(matrices).all()
        require(holds, what, "rotations and translations", "other matrices")


def inexpressible(form: str, what: str, expected: str, actual: str) -> UsageError:
    """The error for values that a format cannot store."""
    return UsageError(
        f"{what}: the {form} format cannot hold this",
        where=f"format {form}",
        why=f"expected {expected}, found {actual}",
        fix="change the sensor or the sequence",
    )


def _colour_size(sequence: Sequence) -> tuple[int, int]:
    """Rows and columns of the colour images; without any, those of the quads."""
    return sequence.colour.size or (sequence.height, sequence.width)


def _colour_intrinsics(sequence: Sequence) -> Intrinsics:
    """Those of the colour camera; loaders require one: without any, the ToF camera's, scaled."""
    if sequence.colour.intrinsics is not None:
        return sequence.colour.intrinsics
    height, width = _colour_size(sequence)
    return sequence.intrinsics.scaled(width / sequence.width, height / sequence.height)


def _pinhole(camera: Intrinsics) -> np.ndarray:
    """Matrix for integer pixel centres, 3x3."""
    rows = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
    return np.array(rows, dtype=np.float64)


def with_zero(sequence: Sequence, n: int) -> Float[np.ndarray, "H W"]:
    """Raw frame n as it is stored: quad + ``adc_zero``, float32.

    Reading subtracts the zero: exactly where the sum needs 24 bits or fewer, as codes of a camera
    do, otherwise to half a float32 step of the sum.
    """
    zero = sequence.calibration.adc_zero
    return float32(sequence.quads[n].astype(np.float64) + zero if zero else sequence.quads[n])


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
