"""F-TöRF and TöRF folders as sequences: numbered raw quads or phasors, and calibration in cams/.

A folder of N phasors becomes 4 N raw frames: quartet i has re/2, -re/2, im/2, -im/2 of phasor i,
the canonical shifts, one time and one pose. Their differences are the phasor again, exactly, since
halving a float32 is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import specs
from .calibration import (
    read_calibration,
    read_colour_intrinsics,
    read_shifts,
    read_times,
    subtract_zero,
)
from .folder import empty_quads, first_size, load, numbered, read_field
from .poses import read_colour_poses, read_novel, read_poses
from .problems import Problems
from .sequence import ColourCamera, Flow, Sequence, Truth

ABSENT = (  # without a source unless a folder has them
    # only a capture has these
    *("frequencies_hz", "cycle_length", "distortion", "exposures", "tap_sums", "sensor"),
    *("colour_intrinsics", "colour_from_world", "forward_flow", "backward_flow"),
)


@dataclass(frozen=True, kw_only=True)
class Stored:
    """The images of a folder of this family."""

    root: Path
    """The folder."""
    form: str
    """Its format, ``ftorf`` or ``torf``."""
    files: dict[int, Path]
    """File of each measured image 0, 1, .."""
    field: str
    """Name of the field in data_specs/ that describes these files."""
    counted: str
    """What the images are, for messages."""
    step: int
    """Raw frames of each image: 1 of a raw quad, 4 of a phasor."""
    rate_hz: float
    """Images per second if nothing states a rate."""
    first_id: int = 0
    """Number in the name of image 0."""
    note: str = ""
    """Remark on the source of ``measured``."""

    def size(self, problems: Problems) -> dict[str, int]:
        """Rows H and columns W, see :func:`first_size`."""
        return first_size(self.files, specs.fields(self.form)[self.field], problems)


def read_sequence(
    stored: Stored, frame_rate_hz: float | None, wanted: range | None = None
) -> Sequence:
    """Read the images, calibration, colour, flow and novel views of a folder, never truth or masks.

    ``frame_rate_hz`` are images per second; None: the folder's times, or else the default rate.
    Of the images, those of the ``wanted`` raw frames, which ``quads`` are then; None: all.

    Raises:
        InputError: If a file is not what data_specs/ describes; names all of them at once.
        UsageError: If the rate is not above 0.
        ResourceError: If it does not fit into memory.
    """
    root, form, step, fields = stored.root, stored.form, stored.step, specs.fields(stored.form)
    problems, sources = Problems(), dict.fromkeys(ABSENT, "default none")
    size = stored.size(problems)
    if not (root / "cams").is_dir():
        why = "expected a folder cams with tof_intrinsics, found none"
        problems.add("cams missing", root, why, "complete the folder")
    calibrated = read_calibration(root, form, problems, size.get("W"))
    sources |= calibrated.sources
    count = max(stored.files) + 1
    times = problems.attempt(read_times, root, form, count, frame_rate_hz, stored.rate_hz, sources)
    count = count if times is None else len(times)
    shifts = problems.attempt(read_shifts, root, form, step * count, sources)
    poses = problems.attempt(read_poses, root, form, count, sources)
    wanted = range(step * count) if wanted is None else wanted
    chosen = range(wanted.start // step, wanted.stop // step)
    images: dict[str, dict[int, np.ndarray]] = {"forward_flow": {}, "backward_flow": {}}
    for name in ("colour", *images):
        if name in fields:
            images[name], sources[name] = read_field(
                root, fields[name], chosen, size, problems, stored.first_id
            )
    colour = ColourCamera(images={step * i: image for i, image in images["colour"].items()})
    intrinsics = colour_poses = None
    if colour.size is not None:
        if all((image == image[..., :1]).all() for image in colour.images.values()):
            sources["colour"] += "; its three channels are equal: amplitude, not colour"
        intrinsics = problems.attempt(
            read_colour_intrinsics, root, form, calibrated, size, colour.size, sources
        )
        if poses is not None:
            colour_poses = problems.attempt(read_colour_poses, root, form, poses, sources)
    novel = problems.attempt(read_novel, root, form, sources)
    quads = empty_quads(root, len(wanted), size)
    files = {i: file for i, file in stored.files.items() if i in chosen}
    raw, sources["quads"] = load(root, fields[stored.field], files, size, problems)
    for i, image in raw.items():
        row = step * i - wanted.start
        quads[row : row + step] = image if step == 1 else _quads_of(image)
    problems.raise_if_any(root)
    assert times is not None
    assert shifts is not None
    assert poses is not None
    measured = np.isin(np.arange(count), list(stored.files))
    subtract_zero(
        quads,
        np.repeat(measured, step)[wanted.start : wanted.stop],
        calibrated.calibration.adc_zero,
    )
    sources["measured"] = f"file {len(stored.files)} of {count} {stored.counted}{stored.note}"
    kind = "raw quads" if step == 1 else "phasors"
    sources["from_phasors"] = f"{sources['quads'].partition(',')[0]}: {kind}"
    if colour_poses is not None:
        colour_poses = np.repeat(colour_poses, step, axis=0)
    return Sequence(
        quads=quads,
        measured=np.repeat(measured, step),
        shifts=shifts,
        times=np.repeat(times, step),
        camera_from_world=np.repeat(poses, step, axis=0),
        intrinsics=calibrated.intrinsics,
        calibration=calibrated.calibration,
        from_phasors=step > 1,
        colour=replace(colour, intrinsics=intrinsics, camera_from_world=colour_poses),
        flow=Flow(forward=images["forward_flow"], backward=images["backward_flow"]),
        novel_from_world=novel,
        sources=sources,
        path=root,
    )


def _quads_of(phasor: np.ndarray) -> tuple[np.ndarray, ...]:
    """The four quads of a stored phasor [H, W, 2 or 3]."""
    re, im = np.moveaxis(phasor[..., :2], -1, 0) / np.float32(2.0)
    return re, -re, im, -im


def read_distances(stored: Stored, wanted: range) -> Truth | None:
    """Read the true distances stored with the F ``wanted`` raw frames, each for all raw frames of
    its image; None if there are none.

    They are NaN where the file has NaN or 0, and at frames without a file.

    Raises:
        InputError: If a distance image is not what data_specs/ describes.
    """
    root, step, fields, problems = stored.root, stored.step, specs.fields(stored.form), Problems()
    size = stored.size(problems)
    stacks: dict[str, Any] = {}
    frames, chosen = len(wanted), range(wanted.start // step, wanted.stop // step)
    known = np.zeros(frames, dtype=bool)
    for name in ("distance", "phasor_distance"):
        images, _ = read_field(root, fields[name], chosen, size, problems, stored.first_id)
        stack = np.full((frames, size.get("H", 1), size.get("W", 1)), np.nan, dtype=np.float32)
        for i, image in images.items():
            row = step * i - wanted.start
            frames_of = slice(row, row + step)
            if name == "distance" and (image < 0).any():
                folders = (numbered(root, pattern) for pattern in fields[name].paths)
                file = next(filter(None, folders))[i + stored.first_id]
                least = f"{np.nanmin(image):g}"
                why = f"expected metres along the ray, NaN where unknown, found {least}"
                fix = "store NaN where the distance is unknown"
                problems.add("distance: negative", file, why, fix)
            stack[frames_of] = np.where(image == 0, np.nan, image) if name == "distance" else image
            known[frames_of] |= name == "distance"
        stacks[name] = stack if images else None
    problems.raise_if_any(root)
    if stacks["distance"] is None:
        return None
    return Truth(known=known, **stacks)
