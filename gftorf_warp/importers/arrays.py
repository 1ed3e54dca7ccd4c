"""Kind ``arrays``: raw quads as arrays or pictures of any layout that a dozen keys describe."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ..data.sequence import Sequence
from ..errors import InputError, ResourceError
from . import camera_keys, codes, image_order, sensor_keys, stacks, timing
from .imported import Imported, Notes
from .keys import Key, Settings

TAPS = (("A-B",), ("A",), ("B",), ("A", "B"), ("B", "A"), ("A-B", "A+B"), ("A+B", "A-B"))
HALF_TURN = {("B",): math.pi}  # the other tap sees the opposite phase
KEYS = (
    *image_order.KEYS,
    *stacks.KEYS,
    *codes.KEYS,
    *sensor_keys.KEYS,
    Key(
        name="sensor.taps",
        kind=str,
        about="images of each raw frame in their order: A-B; A; B; A and B; A-B and A+B",
        example=("A-B",),
        default=("A-B",),
        shape=(None,),
        choices=("A-B", "A", "B", "A+B"),
    ),
    *timing.KEYS,
    *camera_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """A folder or file of images as a sequence.

    Raises:
        UsageError, InputError: If keys are missing, unusable, or do not fit the files; if a file is
            damaged.
        ResourceError: If the recording does not fit into memory, or h5py is needed.
    """
    notes = Notes()
    patterns = image_order.patterns_of(source, settings)
    modulation = sensor_keys.modulation_of(settings, notes)
    taps, cycle = settings["sensor.taps"], len(modulation.shifts)
    if taps not in TAPS:
        why = f"expected one of {'; '.join(', '.join(known) for known in TAPS)}"
        raise settings.wrong("sensor.taps", f"{why}, found {', '.join(taps)}", "name one of them")
    decoder = codes.Decoder(settings=settings)
    try:
        frames_read = _raw_frames(patterns, settings, decoder, cycle, notes)
        quads, measured = _collected(patterns, settings, frames_read, notes)
    except MemoryError as error:
        why, fix = "the recording does not fit", "import a part of it, by source.files"
        raise ResourceError("not enough memory", where=source, why=why, fix=fix) from error
    frames, height, width = quads.shape
    decoder.describe(notes, int(measured.sum()) * len(taps), height * width)
    dark = codes.fill(quads, measured, cycle)
    if dark:
        notes.uncertain.append(
            f"{dark} pixels have no value in some slot and are without light in all"
        )
    if not np.any(quads):
        why = "all codes equal values.zero, or none is a measurement"
        raise InputError("no light in any pixel", where=source, why=why, fix="correct [values]")
    if frames % cycle:
        notes.uncertain.append(f"the last cycle has {frames % cycle} of {cycle} raw frames")
    notes.understood.append("poses: the camera stands still (default)")
    several = len(set(modulation.frequencies_hz.tolist())) > 1
    return Imported(
        sequence=Sequence(
            quads=quads,
            measured=measured,
            shifts=np.resize(modulation.shifts + HALF_TURN.get(taps, 0.0), frames),
            times=timing.times_of(settings, source, notes, frames, cycle),
            frequencies_hz=np.resize(modulation.frequencies_hz, frames) if several else None,
            exposures=timing.exposures_of(settings, frames),
            camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
            intrinsics=camera_keys.intrinsics_of(settings, notes, width),
            calibration=modulation.calibration,
        ),
        understood=tuple(notes.understood),
        uncertain=tuple(notes.uncertain),
    )


def _collected(
    patterns: list[list[Path]],
    settings: Settings,
    frames: Iterator[tuple[Path, Float[np.ndarray, "H W"]]],
    notes: Notes,
) -> tuple[Float[np.ndarray, "F H W"], Bool[np.ndarray, "F"]]:
    """All raw frames in one array, zero where one is missing, and which exist."""
    stored: list[np.ndarray] = []
    for path, quad in frames:
        if stored and quad.shape != stored[0].shape:
            why = f"expected {stored[0].shape} as in the first, found {quad.shape}"
            fix = "export all images in one size, or name the right ones by source.files"
            raise InputError("another size", where=path, why=why, fix=fix)
        stored.append(quad)
    count = len(stored)
    numbers = list(range(count))
    if len(patterns) == 1 and len(patterns[0]) == count:
        numbers = image_order.frame_numbers(patterns[0], settings, notes) or numbers
    elif settings["source.numbered"]:
        why = f"expected one file for each raw frame, found {count} raw frames in "
        why += f"{sum(map(len, patterns))} files"
        raise settings.wrong("source.numbered", why, "leave it out")
    quads = np.zeros((numbers[-1] + 1, *stored[0].shape), np.float32)
    measured = np.zeros(len(quads), dtype=bool)
    measured[numbers] = True
    for number in reversed(numbers):
        quads[number] = stored.pop()  # so that the recording is in memory once
    return quads, measured


def _raw_frames(
    patterns: list[list[Path]],
    settings: Settings,
    decoder: codes.Decoder,
    cycle: int,
    notes: Notes,
) -> Iterator[tuple[Path, Float[np.ndarray, "H W"]]]:
    """File and quad of each raw frame in the order of time, NaN where a pixel was not measured.

    A pattern holds all images, those of one slot, or those of one tap.
    """
    taps = settings["sensor.taps"]
    by_tap = len(patterns) == len(taps) > 1
    if not by_tap and len(patterns) not in (1, cycle):
        why = f"expected one pattern, or one for each of {cycle} slots"
        why += f" or {len(taps)} taps" if len(taps) > 1 else ""
        raise settings.wrong("source.files", f"{why}, found {len(patterns)}", "list as many")
    inside, slots = (1 if by_tap else len(taps)), (cycle if by_tap or len(patterns) == 1 else 1)
    streams = [
        _grouped(image_order.read_images(files, settings, slots, inside, notes), inside)
        for files in patterns
    ]
    ended = False
    for groups in itertools.zip_longest(*streams):
        present = [group for group in groups if group is not None]
        if ended or None in groups[: len(present)] or (by_tap and len(present) < len(groups)):
            why = "one pattern has fewer images than the one before it"
            raise settings.wrong("source.files", why, "complete the files")
        ended = len(present) < len(groups)
        for images in [list(itertools.chain(*present))] if by_tap else present:
            if len(images) < len(taps):
                why = f"the images end within a raw frame of {len(taps)} taps"
                raise settings.wrong("sensor.taps", why, "complete the files, or correct the taps")
            quads = {tap: decoder(image) for tap, (_, image) in zip(taps, images, strict=True)}
            quad = quads.get("A-B", next(iter(quads.values())))
            yield images[0][0], quads["A"] - quads["B"] if {"A", "B"} <= quads.keys() else quad


def _grouped(
    images: Iterator[tuple[Path, np.ndarray]], count: int
) -> Iterator[list[tuple[Path, np.ndarray]]]:
    """Images in groups of ``count``; the last may be shorter."""
    while group := list(itertools.islice(images, count)):
        yield group
