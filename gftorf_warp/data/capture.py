"""Reading captures, our own format, which data_specs/capture.toml describes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..constants import FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError, UsageError
from . import specs
from .arrays import SIDE_MAX
from .calibration import DEPTH_RANGES_M, FOCAL_MIN
from .capture_json import FORMAT, MANIFEST, NAME, json_fields, read_values
from .capture_write import inverse
from .cycles import QUADS_MIN
from .exr import Parts, read_parts
from .folder import FRAMES_MAX, empty_quads, numbered
from .poses import rigid
from .problems import Problems
from .sequence import Calibration, ColourCamera, Flow, Intrinsics, Sequence, Truth


def read(root: Path, frame_rate_hz: float | None) -> Sequence:
    """Read a capture: raw frames, calibration, colour, flow and novel views, never truth.

    Args:
        root: The folder.
        frame_rate_hz: Must be None: a capture states the time of every raw frame.

    Raises:
        InputError: If the folder or a file in it is not what data_specs/capture.toml describes;
            names all of it.
        UsageError: If a frame rate is given.
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
    files = _files(root, "tof", frames, problems)
    for n in np.flatnonzero(measured).tolist():
        if n not in files:
            why = f"expected a file for every measured raw frame, found none for {n}"
            fix = "complete the folder, or set measured to false"
            problems.errors.append(
                InputError("quads: no such file", where=root / "tof", why=why, fix=fix)
            )
    quads = empty_quads(root, frames, {"H": height, "W": width})
    images: dict[str, Any] = {"forward_flow": {}, "backward_flow": {}, "colour": {}}
    for n, file, parts in _read(root, files, digests, problems):
        if not measured[n]:
            continue
        quad = problems.attempt(_image, file, parts, "quads", (height, width))
        if quad is not None:
            quads[n] = quad
        for name in ("forward_flow", "backward_flow"):
            flow = problems.attempt(_image, file, parts, name, (height, width))
            if flow is not None:
                images[name][n] = flow
    colour_size = (
        tuple(int(n) for n in values["colour_size"][::-1]) if "colour_size" in values else None
    )
    for n, file, parts in _read(root, _files(root, "colour", frames, problems), digests, problems):
        image = problems.attempt(_image, file, parts, "colour", colour_size)
        if image is not None:
            images["colour"][n] = image
    problems.raise_if_any(root)
    frequencies = values["f_mod_hz"]
    lens = tuple(values["distortion"].tolist()) if "distortion" in values else None
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
            quad_scale=float(values["raw_scale"]) if "raw_scale" in values else None,
            cycle_length=int(values["cycle"]) if "cycle" in values else None,
            settings=values.get("sensor_settings", {}),
        ),
        from_phasors=values["kind"] == "phasor",
        colour=ColourCamera(
            images=images["colour"],
            intrinsics=_intrinsics(values["colour_intrinsics"])
            if "colour_intrinsics" in values
            else None,
            camera_from_world=inverse(values["colour_pose"]) if "colour_pose" in values else None,
        ),
        flow=Flow(forward=images["forward_flow"], backward=images["backward_flow"]),
        novel_from_world=inverse(values["novel"]) if "novel" in values else None,
        sources=_sources(values, images, int(measured.sum())),
        path=root,
    )


def read_truth(root: Path, frames: int) -> Truth | None:
    """Read the ground truth: both distances, amplitude, objects and layers; None if there is none.

    A layer is NaN in raw frames without it. Parts that data_specs/capture.toml does not describe
    are ignored.

    Args:
        root: The folder.
        frames: Number F of raw frames of the sequence.

    Raises:
        InputError: If an image is not what data_specs/capture.toml describes.
    """
    problems = Problems()
    files = _files(root, "truth", frames, problems)
    problems.raise_if_any(root)
    if not files:
        return None
    digests, values = _manifest(root), read_values(root)
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
                stacks[name] = np.full(
                    (frames, height, width), 0 if name == "object" else np.nan, dtype=image.dtype
                )
            if name != "object" and (image < 0).any():
                why = f"expected 0 or more, or NaN where unknown, found {np.nanmin(image):g}"
                fix = "store NaN where it is unknown"
                problems.errors.append(
                    InputError(f"{name}: negative", where=file, why=why, fix=fix)
                )
            stacks[name][n] = image
            known[n] |= name == "distance"
        for name in parts:
            image = problems.attempt(_layer, file, parts, name, (height, width))
            if image is not None:
                layers.setdefault(name, np.full((frames, *image.shape), np.nan, dtype=np.float32))[
                    n
                ] = image
    problems.raise_if_any(root)
    if "distance" not in stacks:
        return None
    distance = np.where(stacks["distance"] == 0, np.float32(np.nan), stacks["distance"])
    body = stacks["object"].astype(np.int64) - 1 if "object" in stacks else None
    more = {name: stacks.get(name) for name in ("phasor_distance", "amplitude")}
    return Truth(
        distance=distance,
        known=known,
        body=None if body is None else body.astype(np.int32),
        layers=layers,
        **more,
    )


def _files(root: Path, folder: str, frames: int, problems: Problems) -> dict[int, Path]:
    """Files of raw frames in a folder; other ids and links out of the folder are errors."""
    found = numbered(root, f"{folder}/{{id}}.exr")
    for n, file in found.items():
        if n >= frames or not file.resolve().is_relative_to(root.resolve()):
            why = f"expected files of raw frames below {frames}, in this folder; found {n}"
            problems.errors.append(InputError("no raw frame", where=file, why=why, fix="remove it"))
    return {n: file for n, file in found.items() if n < frames}


def _manifest(root: Path) -> dict[str, str]:
    """SHA-256 by relative name; empty if the folder has no manifest."""
    path = root / MANIFEST
    if not path.is_file():
        return {}
    digests = {}
    for number, line in enumerate(
        path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1
    ):
        match = re.fullmatch(r"([0-9a-f]{64})  (\S+)", line)
        if match is None:
            why = (
                f"expected 64 hexadecimal digits, two blanks and a name, found {line[:80]!r} "
                f"in line {number}"
            )
            raise InputError("no manifest", where=path, why=why, fix="copy it again, or remove it")
        digests[match[2]] = match[1]
    _verify(root, root / NAME, digests)
    return digests


def _verify(root: Path, file: Path, digests: dict[str, str]) -> None:
    """Compare a file with the manifest, if there is one."""
    name = file.relative_to(root).as_posix()
    if digests and hashlib.sha256(file.read_bytes()).hexdigest() != digests.get(name):
        why = (
            f"its SHA-256 is not that of {MANIFEST}"
            if name in digests
            else f"{MANIFEST} does not name it"
        )
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
    """One field of a file, channels first if there are several, last of colour;
    None if an optional one is absent.
    """
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
    kinds = {image.dtype.kind for image in images}
    if (
        len(images) != len(channels)
        or len(images) != len(field.channels)
        or kinds != {field.dtypes}
    ):
        why = (
            f"expected channels {', '.join(field.channels)}, found {', '.join(channels)} of "
            f"kinds {kinds}"
        )
        raise InputError(
            f"{name}: wrong channels", where=file, why=why, fix="export the file again"
        )
    if shape is None or images[0].shape != shape:
        why = f"expected rows x columns {shape}, found {images[0].shape}"
        raise InputError(
            f"{name}: wrong shape", where=file, why=why, fix=f"export that size, or correct {NAME}"
        )
    for image in images if field.dtypes == "f" else []:
        if np.isinf(image).any() or (field.nan == "error" and np.isnan(image).any()):
            why = (
                f"expected finite "
                f"numbers{' or NaN for unknown' if field.nan == 'unknown' else ''}, found "
                f"others"
            )
            raise InputError(
                f"{name}: not finite", where=file, why=why, fix="export the file again"
            )
    return images


def _judge(path: Path, values: dict[str, Any], problems: Problems) -> None:
    """Bounds of the values of capture.json, and their consistency."""
    frames, width = len(values["id"]), float(values["size"][0])
    times, frequencies = values["time"], values["f_mod_hz"]
    poses = [values[name] for name in ("pose", "colour_pose", "novel") if name in values]
    rules = {  # field: (whether it holds, what is expected)
        "size": (
            ((values["size"] >= 1) & (values["size"] <= SIDE_MAX)).all(),
            f"1 to {SIDE_MAX} pixels",
        ),
        "id": (
            np.array_equal(values["id"], np.arange(frames)) and frames < FRAMES_MAX,
            "0, 1, 2 and so on, one for each raw frame",
        ),
        "time": (
            times[0] == 0 and (np.diff(times) >= 0).all(),
            "seconds from 0 that never decrease",
        ),
        "f_mod_hz": (
            ((frequencies > 0) & (frequencies * DEPTH_RANGES_M[0] <= SPEED_OF_LIGHT)).all()
            and (frequencies * DEPTH_RANGES_M[1] >= SPEED_OF_LIGHT).all(),
            f"{SPEED_OF_LIGHT / DEPTH_RANGES_M[1]:.3g} to "
            f"{SPEED_OF_LIGHT / DEPTH_RANGES_M[0]:.3g} Hz",
        ),
        "exposure": ("exposure" not in values or (values["exposure"] > 0).all(), "seconds above 0"),
        "measured": (values["measured"].any(), "at least one measured raw frame"),
        "intrinsics": (
            _is_pinhole(values["intrinsics"], width),
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels",
        ),
        "colour_intrinsics": (
            "colour_intrinsics" not in values
            or (
                "colour_size" in values
                and _is_pinhole(values["colour_intrinsics"], float(values["colour_size"][0]))
            ),
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, and a size",
        ),
        "cycle": (
            _is_cycle(values),
            "raw frames of a cycle: three or more shifts at each of its frequencies",
        ),
        "raw_scale": ("raw_scale" not in values or values["raw_scale"] > 0, "more than 0"),
        "pose": (
            all(rigid(matrices).all() for matrices in poses),
            "rotations and translations, camera to world",
        ),
    }
    for name, (holds, expected) in rules.items():
        if not holds:
            key = json_fields()[name].key
            error = InputError(
                f"{key}: implausible",
                where=path,
                why=f"expected {expected}",
                fix="correct the file",
            )
            problems.errors.append(error)


def _is_cycle(values: dict[str, Any]) -> bool:
    """Whether a stated cycle, as far as it was recorded,
    has three raw frames or more at each of its frequencies.
    """
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
            place = (
                f"{NAME} {field.key}" if field.kind == "json" else field.paths[0].partition("/")[0]
            )
            if field.role != "truth":
                sources[name] = f"file {place}" if there else "default none"
    for name, found in images.items():
        sources[name] += f", {len(found)} images" if found else ""
    sources["measured"] += f": {measured} of {len(values['id'])} raw frames"
    sources["pixel_centre"] = f"file {NAME} pixel_centre: half"
    return sources
