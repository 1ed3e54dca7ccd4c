"""Some raw frames of a recording as a sequence of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .sequence import Flow, Sequence

Image = TypeVar("Image")


def excerpt(
    sequence: Sequence, frames: range, *, quads: Float[np.ndarray, "f H W"] | None = None
) -> Sequence:
    """What the sequence would be if only these raw frames had been recorded: the first of them is
    raw frame 0, at time 0.

    Nothing of it refers to the memory of the sequence, images aside. Optical flow to raw frames
    outside is left out.

    Args:
        sequence: Of F raw frames.
        frames: Whole quartets of it.
        quads: Their quads, if those of the sequence were not read; None: those of the sequence.

    Raises:
        InputError: If the sequence does not have so many raw frames.
        ValueError: If they do not begin with a quartet.
    """
    check_frames(sequence, frames)
    first, cycle = frames.start, sequence.cycle
    if first % cycle:
        raise ValueError(f"an excerpt begins with a quartet of {cycle} raw frames, got {first}")

    def rows(array: Any) -> Any:
        return None if array is None else array[first : frames.stop].copy()

    def images(by_frame: dict[int, Image], other: int = 0) -> dict[int, Image]:
        """Images of the raw frames, and to raw frames ``other`` later among them."""
        wanted = (n for n in by_frame if n in frames and n + other in frames)
        return {n - first: by_frame[n] for n in wanted}

    colour, times = sequence.colour, sequence.times[first : frames.stop]
    return replace(
        sequence,
        quads=sequence.quads[first : frames.stop] if quads is None else quads,
        measured=rows(sequence.measured),
        shifts=rows(sequence.shifts),
        times=times - times[0],
        frequencies_hz=rows(sequence.frequencies_hz),
        exposures=rows(sequence.exposures),
        camera_from_world=rows(sequence.camera_from_world),
        # a few raw frames alone need not show the period
        calibration=replace(sequence.calibration, cycle_length=cycle),
        tap_sums=images(sequence.tap_sums),
        colour=replace(
            colour, images=images(colour.images), camera_from_world=rows(colour.camera_from_world)
        ),
        flow=Flow(
            forward=images(sequence.flow.forward, cycle),
            backward=images(sequence.flow.backward, -cycle),
        ),
        excerpt=frames,
    )


def check_frames(sequence: Sequence, frames: range) -> None:
    """Check that a sequence has some raw frames.

    Raises:
        InputError: If not.
    """
    if not (0 <= frames.start < frames.stop <= sequence.frames and frames.step == 1):
        why = f"expected 0 .. {sequence.frames - 1}, asked for {frames.start} .. {frames.stop - 1}"
        fix = "restore the recording, or reconstruct it again into another folder"
        where = sequence.path or "sequence"
        raise InputError("no such raw frames", where=where, why=why, fix=fix)
