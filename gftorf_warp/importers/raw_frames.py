"""Raw frames of one or two taps from the images of files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Complex64, Float

from ..errors import InputError
from . import codes, image_order, phasors
from .imported import Notes
from .keys import Key, Settings

QUADS = (("A-B",), ("A",), ("B",), ("A", "B"), ("B", "A"), ("A-B", "A+B"), ("A+B", "A-B"))
TAPS = (*QUADS, *phasors.TAPS)
HALF_TURN = {("B",): math.pi}  # the other tap sees the opposite phase
KEY = Key(
    name="sensor.taps",
    kind=str,
    about="images of each raw frame in their order: A-B; A; B; A and B; A-B and A+B; or of each "
    "phasor: I and Q; amplitude and phase; -Q, -phase if they shrink with distance",
    example=("A-B",),
    default=("A-B",),
    shape=(None,),
    choices=("A-B", "A", "B", "A+B", "I", "Q", "-Q", "amplitude", "phase", "-phase"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RawFrames:
    """Raw frames in the order of time."""

    quads: Float[np.ndarray, "F H W"] | Complex64[np.ndarray, "F H W"]
    """Values, code - zero; 0 in raw frames that were not measured. Complex: of phasors."""
    measured: Bool[np.ndarray, "F"]
    """Whether a raw frame was measured."""
    turned: float
    """Added to the shifts [rad]: that of the tap."""
    files: list[str] | None
    """Name of the file of each; None: a file has several, or some are missing."""


def check_taps(settings: Settings) -> None:
    """Check that the taps are a known pair or one.

    Raises:
        InputError: If not.
    """
    taps = settings[KEY.name]
    if taps not in TAPS:
        why = f"expected one of {'; '.join(', '.join(known) for known in TAPS)}"
        raise settings.wrong(KEY.name, f"{why}, found {', '.join(taps)}", "name one of them")


def raw_frames_of(
    source: Path, patterns: list[list[Path]], settings: Settings, cycle: int, notes: Notes
) -> RawFrames:
    """The raw frames in files.

    Args:
        source: Folder or file, for messages.
        patterns: Files of each pattern.
        settings: Values of ``KEY`` and of the keys of codes and files.
        cycle: Raw frames of a cycle.
        notes: What was understood is added.

    Raises:
        UsageError, InputError: If keys are missing, unusable, or do not fit the files; if a file is
            damaged.
        ResourceError: If h5py is needed.
    """
    decoder = codes.Decoder(settings=settings)
    images = _in_order(patterns, settings, decoder, cycle, notes)
    quads, numbers = _stacked(patterns, settings, images, notes)
    measured = np.zeros(len(quads), dtype=bool)
    measured[numbers] = True
    decoder.describe(notes)
    dark = codes.fill(quads, measured, cycle)
    if dark:
        text = "pixels have no value in some slot and are without light in all"
        notes.uncertain.append(f"{dark} {text}")
    if not np.any(quads):
        why = "all codes equal values.zero, or none is a measurement"
        raise InputError("no light in any pixel", where=source, why=why, fix="correct [values]")
    if len(quads) % cycle:
        notes.uncertain.append(f"the last cycle has {len(quads) % cycle} of {cycle} raw frames")
    files = [path.name for path in patterns[0]]
    one_each = len(patterns) == 1 and len(files) == len(quads)
    return RawFrames(
        quads=quads,
        measured=measured,
        turned=HALF_TURN.get(settings[KEY.name], 0.0),
        files=files if one_each else None,
    )


def _stacked(
    patterns: list[list[Path]],
    settings: Settings,
    images: Iterator[tuple[Path, Float[np.ndarray, "H W"]]],
    notes: Notes,
) -> tuple[Float[np.ndarray, "F H W"], list[int]]:
    """All raw frames in one array, zero where one is missing, and the numbers of the others."""
    stored: list[np.ndarray] = []
    for path, quad in images:
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
    quads = np.zeros((numbers[-1] + 1, *stored[0].shape), stored[0].dtype)
    for number in reversed(numbers):
        quads[number] = stored.pop()  # so that the recording is in memory once
    return quads, numbers


def _in_order(
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
    others = 0 if by_tap else len(patterns) - 1
    given = settings, slots, inside, notes, others
    streams = [_grouped(image_order.read_images(files, *given), inside) for files in patterns]
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
            by_name = dict(zip(taps, (image for _, image in images), strict=True))
            by_name.pop("A+B", None)  # has no phase
            quads = {tap: decoder(image) for tap, image in by_name.items()}
            yield images[0][0], _quad_of(quads, settings)


def _quad_of(taps: dict[str, np.ndarray], settings: Settings) -> np.ndarray:
    """The quad or the phasor of a raw frame from its taps."""
    if phasors.are_stored(settings):
        return phasors.phasor_of(taps, settings)
    return taps["A"] - taps["B"] if {"A", "B"} <= taps.keys() else next(iter(taps.values()))


def _grouped(
    images: Iterator[tuple[Path, np.ndarray]], count: int
) -> Iterator[list[tuple[Path, np.ndarray]]]:
    """Images in groups of ``count``; the last may be shorter."""
    while group := list(itertools.islice(images, count)):
        yield group
