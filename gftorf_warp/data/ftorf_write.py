"""Writing a sequence as an F-TöRF folder: the inverse of :func:`gftorf_warp.data.ftorf.read`."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import UsageError
from .calibration import DEPTH_RANGES_M, FOCAL_MIN, rigid
from .files import atomic_folder, write_through
from .sequence import Sequence, Truth

SHIFT_TOLERANCE = 1e-6  # [rad] a shift is stored as one of four names; what differs by more is another shift


def write(path: str | Path, sequence: Sequence, truth: Truth | None = None, *, readme: str | None = None) -> Path:
    """Write a sequence, and its truth if there is any, as an F-ToeRF folder that appears only when it is complete.

    Reading it again gives the same sequence: images bit by bit in float32, calibration in float64; only a frequency
    that was not read from such a folder may change in its last bit, since its inverse is stored.

    Args:
        path: New or empty folder.
        sequence: What to write; every slot needs one of the four canonical shifts, each slot another.
        truth: True distances [m] of the raw frames.
        readme: Text of a README.md in the folder.

    Returns:
        The folder.

    Raises:
        UsageError: If the format cannot express the sequence, or the folder cannot be created.
        ResourceError: If the disk is full.
        ValueError: If shapes of the sequence or the truth contradict each other.
    """
    _validate(sequence, truth)
    _refuse_inexpressible(sequence, truth)
    permutation = _permutation(sequence)
    with atomic_folder(path) as folder:
        for slot in range(FRAMES_PER_QUARTET):  # one without frames still belongs to the layout
            (folder / f"tofType{slot}").mkdir()
        for name, content in _files(sequence, truth, permutation, readme):
            (folder / name).parent.mkdir(exist_ok=True)
            write_through(folder / name, content)
    return Path(path)


def _files(
    sequence: Sequence, truth: Truth | None, permutation: np.ndarray, readme: str | None
) -> Iterator[tuple[str, bytes]]:
    """Every file of the folder, by relative name."""
    intrinsics = np.array(
        [[sequence.fx, 0, sequence.cx - 0.5], [0, sequence.fy, sequence.cy - 0.5], [0, 0, 1]], dtype=np.float64
    )
    yield "tof_permutation.npy", _npy(permutation)
    yield "cams/tof_intrinsics.npy", _npy(intrinsics)
    yield "cams/pixel_centre.json", _json({"pixel_centre": "integer"})
    yield "cams/tof_extrinsics.npy", _npy(sequence.camera_from_world.astype(np.float64))
    yield "cams/poses.json", _json({"poses": "camera_from_world"})
    yield "cams/color_intrinsics.npy", _npy(_colour_intrinsics(sequence))
    yield "cams/color_extrinsics.npy", _npy(sequence.camera_from_world.astype(np.float64))
    yield "cams/frame_times.npy", _npy(sequence.times.astype(np.float64))
    yield "cams/depth_range.npy", _npy(np.float64(SPEED_OF_LIGHT / sequence.f_mod_hz))
    yield "cams/phase_offset.npy", _npy(np.float64(sequence.phase_offset))
    yield "cams/dc_offset.npy", _npy(np.float64(sequence.dc_offset))
    if sequence.quad_scale is not None:
        yield "cams/quad_values_scale_factor.npy", _npy(np.float64(sequence.quad_scale))
    for n in np.flatnonzero(sequence.measured).tolist():
        yield f"tofType{n % FRAMES_PER_QUARTET}/{n:04d}.npy", _npy(_float32(sequence.quads[n]))
    for n, image in sequence.colour.items():
        yield f"color/{n:04d}.npy", _npy(_shortest(_float32(image)))
    for direction, images in (("forward", sequence.forward_flow), ("backward", sequence.backward_flow)):
        for n, image in images.items():
            yield f"{direction}_flow_2/flow_{n:04d}.npy", _npy(_float32(image))
    if truth is not None:
        for n in np.flatnonzero(truth.known).tolist():
            yield f"synthetic_depth/{n:04d}.npy", _npy(_float32(truth.distance[n]))
    if readme is not None:
        yield "README.md", readme.encode()


def _permutation(sequence: Sequence) -> np.ndarray:
    """The permutation with canonical = raw[permutation], from the shift of every slot.

    Raises:
        UsageError: If the slots do not have the four canonical shifts, one each.
    """
    gap = np.abs(sequence.shifts[:, None] - np.array(CANONICAL_SHIFTS))
    gap = np.minimum(gap % (2 * math.pi), -gap % (2 * math.pi))
    channel = gap.argmin(axis=1)
    slots = [set(channel[slot::FRAMES_PER_QUARTET].tolist()) for slot in range(FRAMES_PER_QUARTET)]
    used = [next(iter(slot)) for slot in slots if len(slot) == 1]
    if gap.min(axis=1).max() > SHIFT_TOLERANCE or any(len(slot) > 1 for slot in slots) or len(set(used)) < len(used):
        raise _inexpressible(
            "phase shifts",
            "each of the four slots to have its own of the shifts 0, pi, pi/2, 3 pi/2 in every quartet",
            f"{np.round(sequence.shifts[:8], 6).tolist()} .. over {sequence.frames} frames",
        )
    unused = iter(sorted(set(range(FRAMES_PER_QUARTET)) - set(used)))  # of a recording shorter than a quartet
    return np.argsort([next(iter(slot)) if slot else next(unused) for slot in slots])


def _colour_intrinsics(sequence: Sequence) -> np.ndarray:
    """Pinhole matrix of the colour images, which are seen from the same place, for integer pixel centres."""
    height, width = next((image.shape[:2] for image in sequence.colour.values()), (sequence.height, sequence.width))
    sx, sy = width / sequence.width, height / sequence.height
    return np.array(
        [[sequence.fx * sx, 0, sequence.cx * sx - 0.5], [0, sequence.fy * sy, sequence.cy * sy - 0.5], [0, 0, 1]],
        dtype=np.float64,
    )


def _validate(sequence: Sequence, truth: Truth | None) -> None:
    """Whether the parts of a sequence fit together: if not, that is a programming mistake."""
    frames, shape = sequence.frames, (sequence.frames, sequence.height, sequence.width)
    lengths = {
        "quads": (sequence.quads.shape, shape),
        "shifts": (sequence.shifts.shape, (frames,)),
        "times": (sequence.times.shape, (frames,)),
        "camera_from_world": (sequence.camera_from_world.shape, (frames, 4, 4)),
    }
    for name in ("forward_flow", "backward_flow"):
        lengths |= {f"{name}[{n}]": (flow.shape, (2, *shape[1:])) for n, flow in getattr(sequence, name).items()}
    first = next((image.shape[:2] for image in sequence.colour.values()), ())
    lengths |= {f"colour[{n}]": (image.shape, (*first, 3)) for n, image in sequence.colour.items()}
    if truth is not None:
        lengths |= {"truth.distance": (truth.distance.shape, shape), "truth.known": (truth.known.shape, (frames,))}
    for name, (found, expected) in lengths.items():
        if found != expected:
            raise ValueError(f"{name} {found} must have shape {expected}")
    for name in ("colour", "forward_flow", "backward_flow"):
        outside = [n for n in getattr(sequence, name) if not 0 <= n < frames]
        if outside:
            raise ValueError(f"{name}: raw frames {outside} are not in 0..{frames - 1}")


def _refuse_inexpressible(sequence: Sequence, truth: Truth | None) -> None:
    """Whether the reader would accept what is written: its limits are those of the format.

    Raises:
        UsageError: If not.
    """
    flows = [*sequence.forward_flow.values(), *sequence.backward_flow.values()]
    times = sequence.times
    distance = np.ones(1) if truth is None else truth.distance[truth.known]
    numbers = (sequence.f_mod_hz, sequence.phase_offset, sequence.dc_offset, sequence.quad_scale or 1.0)
    focal = sequence.fx, sequence.fy
    rules = {  # what: (whether it holds, expected, found)
        "an empty sequence": (sequence.measured.any(), "at least one measured raw frame", "none"),
        "quads": (np.isfinite(sequence.quads[sequence.measured]).all(), "finite numbers", "NaN or infinity"),
        "times": (
            np.isfinite(times).all() and times[0] == 0 and (np.diff(times) >= 0).all(),
            "seconds since the first raw frame, never decreasing",
            f"{times[:8].tolist()} ..",
        ),
        "calibration": (np.isfinite(numbers).all(), "finite numbers", str(numbers)),
        "f_mod_hz": (
            DEPTH_RANGES_M[0] <= SPEED_OF_LIGHT / sequence.f_mod_hz <= DEPTH_RANGES_M[1],
            f"speed of light / frequency between {DEPTH_RANGES_M[0]} and {DEPTH_RANGES_M[1]} m",
            f"{sequence.f_mod_hz} Hz",
        ),
        "quad_scale": (sequence.quad_scale is None or sequence.quad_scale > 0, "above 0", str(sequence.quad_scale)),
        "focal length": (
            min(focal) >= FOCAL_MIN * sequence.width,
            f"pixels, at least {FOCAL_MIN} of the width {sequence.width}",
            str(focal),
        ),
        "camera_from_world": (rigid(sequence.camera_from_world).all(), "rotations and translations", "other matrices"),
        "colour": (all(np.isfinite(i).all() for i in sequence.colour.values()), "finite numbers", "NaN or infinity"),
        "flow": (not any(np.isinf(flow).any() for flow in flows), "pixels, or NaN for unknown", "infinity"),
        "truth": (
            ((distance > 0) & (distance < np.inf) | np.isnan(distance)).all(),
            "distances above 0 m, or NaN for unknown",
            "zero, negative or infinite distances",
        ),
    }
    for what, (holds, expected, found) in rules.items():
        if not holds:
            raise _inexpressible(what, expected, found)


def _inexpressible(what: str, expected: str, found: str) -> UsageError:
    return UsageError(
        f"{what}: the ftorf format cannot hold this",
        where="format ftorf",
        why=f"expected {expected}, found {found}",
        fix="change the sensor or the sequence",
    )


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)


def _shortest(array: np.ndarray) -> np.ndarray:
    """The array as float16 if every number survives that, else as it is."""
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), array) else array


def _npy(array: np.ndarray | np.floating) -> bytes:
    """Bytes of a .npy file, little endian."""
    buffer = io.BytesIO()
    array = np.asarray(array)
    np.lib.format.write_array(buffer, array.astype(array.dtype.newbyteorder("<")), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def _json(content: dict[str, str]) -> bytes:
    return (json.dumps(content) + "\n").encode()
