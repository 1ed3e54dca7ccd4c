"""Reading captures, our own format, which data_specs/capture.toml describes."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..constants import FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError, UsageError
from . import specs
from .calibration import FOCAL_MIN, subtract_zero
from .capture_json import FORMAT, MANIFEST, NAME, json_fields, read_values
from .capture_write import inverse
from .cycles import QUADS_MIN
from .exr import Parts, read_parts
from .folder import empty_quads, numbered
from .poses import rigid
from .problems import Problems
from .sequence import DEPTH_RANGES_M, Calibration, ColourCamera, Flow, Intrinsics, Sequence, Truth
from .untrusted import FRAMES_MAX, SIDE_MAX, read_bytes, read_text

T = TypeVar("T")


def read(root: Path, frame_rate_hz: float | None, wanted: range | None = None) -> Sequence:
    """Read a capture: raw frames, calibration, colour, flow and novel views, never truth.

    Of the images, those of the ``wanted`` raw frames, which ``quads`` are then; None: all.

    Raises:
        InputError: If a file is not what data_specs/capture.toml describes; lists all problems.
        UsageError: If a frame rate is given: a capture states the time of every raw frame.
        ResourceError: If it does not fit into memory.
    """
    if frame_rate_hz is not None:
        why = "a capture states the time of every raw frame"
        raise UsageError("frame rate", where="frame_rate_hz", why=why, fix="leave it out")
    values, problems = read_values(root), Problems()
    _judge(root / NAME, values, problems)
    problems.raise_if_any(root)
    digests = _manifest(root)
    width, height = (int(n) for n in values["size"])
    measured, frames = values["measured"], len(values["id"])
    wanted = range(frames) if wanted is None else wanted
    files = _files(root, "tof", frames, digests, problems, wanted)
    for n in sorted({*np.flatnonzero(measured).tolist()} & {*wanted} - files.keys()):
        why = f"expected a file for every measured raw frame, found none for {n}"
        fix = "complete the folder, or set measured to false"
        problems.add("quads: no such file", root / "tof", why, fix)
    quads = empty_quads(root, len(wanted), {"H": height, "W": width})
    images: dict[str, Any] = {"forward_flow": {}, "backward_flow": {}, "tap_sums": {}, "colour": {}}
    for n, file, parts in _read(root, files, digests, problems):
        if not measured[n]:
            continue
        quad = problems.attempt(_image, file, parts, "quads", (height, width))
        if quad is not None:
            quads[n - wanted.start] = quad
        for name in ("forward_flow", "backward_flow", "tap_sums"):
            image = problems.attempt(_image, file, parts, name, (height, width))
            if image is not None:
                images[name][n] = image
    colour_size = tuple(values["colour_size"][::-1].tolist()) if "colour_size" in values else None
    coloured = _files(root, "colour", frames, digests, problems, wanted)
    for n, file, parts in _read(root, coloured, digests, problems):
        image = problems.attempt(_image, file, parts, "colour", colour_size)
        if image is not None:
            images["colour"][n] = image
    problems.raise_if_any(root)
    zero = float(values.get("adc_zero", 0.0))
    subtract_zero(quads, measured[wanted.start : wanted.stop], zero)
    frequencies = values["f_mod_hz"]
    lens = tuple(values["distortion"].tolist()) if "distortion" in values else None

    def optional(name: str, convert: Callable[[Any], T]) -> T | None:
        return convert(values[name]) if name in values else None

    return Sequence(
        quads=quads,
        measured=measured,
        shifts=values["shift"],
        times=values["time"],
        frequencies_hz=frequencies if len(set(frequencies.tolist())) > 1 else None,
        exposures=values.get("exposure"),
        camera_from_world=inverse(values["pose"]),
        intrinsics=replace(_intrinsics(values["intrinsics"]), distortion=lens),
        calibration=Calibration(
            f_mod_hz=float(frequencies[0]),
            phase_offset=float(values["phase_offset"]),
            dc_offset=float(values["dc_offset"]),
            adc_zero=zero,
            quad_scale=optional("raw_scale", float),
            cycle_length=optional("cycle", int),
            settings=values.get("sensor_settings", {}),
        ),
        from_phasors=values["kind"] == "phasor",
        tap_sums=images["tap_sums"],
        colour=ColourCamera(
            images=images["colour"],
            intrinsics=optional("colour_intrinsics", _intrinsics),
            camera_from_world=optional("colour_pose", inverse),
        ),
        flow=Flow(forward=images["forward_flow"], backward=images["backward_flow"]),
        novel_from_world=optional("novel", inverse),
        sources=_sources(values, images, int(measured.sum())),
        path=root,
    )


def read_truth(root: Path, wanted: range) -> Truth | None:
    """Read the ground truth: both distances, amplitude, objects and layers; None if there is none.

    A layer is NaN in raw frames without it; parts that data_specs/capture.toml does not describe
    are ignored. ``wanted`` are the F raw frames of the sequence.

    Raises:
        InputError: If an image is not what data_specs/capture.toml describes.
    """
    problems = Problems()
    digests = _manifest(root)
    values = read_values(root)
    files = _files(root, "truth", len(values["id"]), digests, problems, wanted)
    problems.raise_if_any(root)
    if not files:
        return None
    frames = len(wanted)
    width, height = (int(n) for n in values["size"])
    stacks: dict[str, np.ndarray] = {}
    layers: dict[str, np.ndarray] = {}
    known = np.zeros(frames, dtype=bool)
    for n, file, parts in _read(root, files, digests, problems):
        for name in ("distance", "phasor_distance", "amplitude", "object"):
            image = problems.attempt(_image, file, parts, name, (height, width))
            if image is None:
                continue
            if name not in stacks:
                empty = 0 if name == "object" else np.nan
                stacks[name] = np.full((frames, height, width), empty, dtype=image.dtype)
            if name != "object" and (image < 0).any():
                why = f"expected 0 or more, or NaN where unknown, found {np.nanmin(image):g}"
                problems.add(f"{name}: negative", file, why, "store NaN where it is unknown")
            stacks[name][n - wanted.start] = image
            known[n - wanted.start] |= name == "distance"
        for name in parts:
            image = problems.attempt(_layer, file, parts, name, (height, width))
            if image is not None:
                empty_layer = np.full((frames, *image.shape), np.nan, dtype=np.float32)
                layers.setdefault(name, empty_layer)[n - wanted.start] = image
    problems.raise_if_any(root)
    if "distance" not in stacks:
        return None
    distance = np.where(stacks["distance"] == 0, np.float32(np.nan), stacks["distance"])
    return Truth(
        distance=distance,
        known=known,
        phasor_distance=stacks.get("phasor_distance"),
        amplitude=stacks.get("amplitude"),
        body=(stacks["object"].astype(np.int64) - 1).astype(np.int32)
        if "object" in stacks
        else None,
        layers=layers,
    )


def _files(
    root: Path,
    folder: str,
    frames: int,
    digests: dict[str, str],
    problems: Problems,
    wanted: range,
) -> dict[int, Path]:
    """Files of the wanted raw frames in a folder; ids of none of all ``frames`` are errors, and so
    is a missing file that the manifest names, unless the whole folder is gone.
    """
    files = numbered(root, f"{folder}/{{id}}.exr")
    for n, file in files.items():
        if n >= frames:
            why = f"expected files of raw frames below {frames}; found {n}"
            problems.add("no raw frame", file, why, "remove it")
    for name in digests if (root / folder).is_dir() else ():
        if name.startswith(f"{folder}/") and not os.path.lexists(root / name):
            why, fix = f"{MANIFEST} names it", f"restore it, or remove {MANIFEST}"
            problems.add("no such file", root / name, why, fix)
    return {n: file for n, file in files.items() if n in wanted}


def _manifest(root: Path) -> dict[str, str]:
    """SHA-256 by relative name; empty if the folder has no manifest."""
    path = root / MANIFEST
    if not os.path.lexists(path):
        return {}
    digests = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        match = re.fullmatch(r"([0-9a-f]{64})  (\S+)", line)
        if match is None:
            why = "expected 64 hexadecimal digits, two blanks and a name, found "
            why += f"{line[:80]!r} in line {number}"
            raise InputError("no manifest", where=path, why=why, fix="copy it again, or remove it")
        digests[match[2]] = match[1]
    _verify(root, root / NAME, digests)
    return digests


def _verify(root: Path, file: Path, digests: dict[str, str]) -> None:
    """Compare a file with the manifest, if there is one."""
    name = file.relative_to(root).as_posix()
    if digests and hashlib.sha256(read_bytes(file)).hexdigest() != digests.get(name):
        other = f"its SHA-256 is not that of {MANIFEST}"
        why = other if name in digests else f"{MANIFEST} does not name it"
        fix = f"restore it, or remove {MANIFEST} if the change was yours"
        raise InputError("content changed", where=file, why=why, fix=fix)


def _read(
    root: Path, files: dict[int, Path], digests: dict[str, str], problems: Problems
) -> Iterator[tuple[int, Path, Parts]]:
    """Number, file and parts of every verified and readable file."""
    for n, file in files.items():
        errors = len(problems.errors)
        problems.attempt(_verify, root, file, digests)
        parts = problems.attempt(read_parts, file) if len(problems.errors) == errors else None
        if parts is not None:
            yield n, file, parts


def _layer(file: Path, parts: Parts, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """One layer of the truth, channels first; None if the part is not a layer."""
    try:
        field = specs.layer_field(name)
    except ValueError:
        return None
    return np.stack(_channels(file, parts[name], name, field, shape))


def _image(file: Path, parts: Parts, name: str, shape: tuple[int, ...] | None) -> np.ndarray | None:
    """One field of a file, channels first, of colour last; None if it is optional and absent."""
    field = specs.fields(FORMAT)[name]
    if field.key not in parts:
        if not field.required:
            return None
        why = f"expected a part {field.key!r}, found {', '.join(parts)}"
        raise InputError(f"{name}: no such part", where=file, why=why, fix="export the file again")
    images = _channels(file, parts[field.key], name, field, shape)
    return images[0] if len(images) == 1 else np.stack(images, axis=-1 if name == "colour" else 0)


def _channels(
    file: Path,
    channels: dict[str, np.ndarray],
    name: str,
    field: specs.Field,
    shape: tuple[int, ...] | None,
) -> list[np.ndarray]:
    """The channels of a part in the order of its description, checked."""
    images = [channels[channel] for channel in field.channels if channel in channels]
    kinds, again = {image.dtype.kind for image in images}, "export the file again"
    if not len(images) == len(channels) == len(field.channels) or kinds != {field.dtypes}:
        why = f"expected channels {', '.join(field.channels)}, found {', '.join(channels)} of "
        why += f"kinds {kinds}"
        raise InputError(f"{name}: wrong channels", where=file, why=why, fix=again)
    if shape is None or images[0].shape != shape:
        why = f"expected rows x columns {shape}, found {images[0].shape}"
        fix = f"export that size, or correct {NAME}"
        raise InputError(f"{name}: wrong shape", where=file, why=why, fix=fix)
    for image in images if field.dtypes == "f" else []:
        if np.isinf(image).any() or (field.nan == "error" and np.isnan(image).any()):
            unknown = " or NaN for unknown" if field.nan == "unknown" else ""
            why = f"expected finite numbers{unknown}, found others"
            raise InputError(f"{name}: not finite", where=file, why=why, fix=again)
    return images


def _judge(path: Path, values: dict[str, Any], problems: Problems) -> None:
    """Bounds of the values of capture.json, and their consistency."""

    def require(name: str, holds: object, expected: str) -> None:
        if not holds:
            key = json_fields()[name].key
            problems.add(f"{key}: implausible", path, f"expected {expected}", "correct the file")

    frames, size = len(values["id"]), values["size"]
    require("size", ((size >= 1) & (size <= SIDE_MAX)).all(), f"1 to {SIDE_MAX} pixels")
    holds = np.array_equal(values["id"], np.arange(frames)) and frames < FRAMES_MAX
    require("id", holds, "0, 1, 2 and so on, one for each raw frame")
    times, frequencies = values["time"], values["f_mod_hz"]
    holds = times[0] == 0 and (np.diff(times) >= 0).all()
    require("time", holds, "seconds from 0 that never decrease")
    low, high = DEPTH_RANGES_M
    holds = ((frequencies * low <= SPEED_OF_LIGHT) & (frequencies * high >= SPEED_OF_LIGHT)).all()
    require("f_mod_hz", holds, f"{SPEED_OF_LIGHT / high:.3g} to {SPEED_OF_LIGHT / low:.3g} Hz")
    require("exposure", (values.get("exposure", np.ones(1)) > 0).all(), "seconds above 0")
    require("measured", values["measured"].any(), "at least one measured raw frame")
    pinhole = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
    require("intrinsics", _is_pinhole(values["intrinsics"], float(size[0])), pinhole)
    holds = "colour_intrinsics" not in values or (
        "colour_size" in values
        and _is_pinhole(values["colour_intrinsics"], float(values["colour_size"][0]))
    )
    require("colour_intrinsics", holds, f"{pinhole}, and a size")
    expected = "raw frames of a cycle: three or more shifts at each of its frequencies"
    require("cycle", _is_cycle(values), expected)
    require("raw_scale", values.get("raw_scale", 1.0) > 0, "more than 0")
    poses = [values[name] for name in ("pose", "colour_pose", "novel") if name in values]
    holds = all(rigid(matrices).all() for matrices in poses)
    require("pose", holds, "rotations and translations, camera to world")


def _is_cycle(values: dict[str, Any]) -> bool:
    """Whether a stated cycle has three raw frames or more at each frequency, where recorded."""
    if "cycle" not in values:
        return True
    length, frequencies = int(values["cycle"]), values["f_mod_hz"]
    if length < QUADS_MIN or (values["kind"] == "phasor" and length != FRAMES_PER_QUARTET):
        return False
    return (
        length > len(frequencies)
        or int(np.unique(frequencies[:length], return_counts=True)[1].min()) >= QUADS_MIN
    )


def _is_pinhole(matrix: np.ndarray, width: float) -> bool:
    expected = np.eye(3)
    expected[0, 0], expected[1, 1], expected[:2, 2] = matrix[0, 0], matrix[1, 1], matrix[:2, 2]
    return np.array_equal(matrix, expected) and min(matrix[0, 0], matrix[1, 1]) >= FOCAL_MIN * width


def _intrinsics(matrix: np.ndarray) -> Intrinsics:
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)


def _sources(
    values: dict[str, Any], images: dict[str, dict[int, np.ndarray]], measured: int
) -> dict[str, str]:
    """Source of each value of the sequence."""
    sources = {}
    for field in specs.fields(FORMAT).values():
        for name in field.fills:
            there = field.name in values if field.kind == "json" else bool(images.get(name, True))
            folder = field.paths[0].partition("/")[0]
            file = f"{NAME} {field.key}" if field.kind == "json" else folder
            if field.role != "truth":
                sources[name] = f"file {file}" if there else "default none"
    for name, by_frame in images.items():
        sources[name] += f", {len(by_frame)} images" if by_frame else ""
    sources["measured"] += f": {measured} of {len(values['id'])} raw frames"
    sources["pixel_centre"] = f"file {NAME} pixel_centre: half"
    return sources
