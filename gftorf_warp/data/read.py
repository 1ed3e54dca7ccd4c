"""Reading a sequence and its ground truth from a folder of any of the formats of data_specs/."""

from __future__ import annotations

from pathlib import Path

from . import capture, ftorf, torf
from .excerpt import excerpt
from .family import read_distances, read_sequence
from .folder import format_of
from .sequence import Sequence, Truth
from .untrusted import check_links

STORED = {"ftorf": ftorf.stored, "torf": torf.stored}


def read(
    path: str | Path, *, frame_rate_hz: float | None = None, frames: range | None = None
) -> Sequence:
    """Read a capture, an F-ToeRF folder of raw quads, or a ToeRF folder of phasors.

    ``frame_rate_hz`` are raw frames, or phasors of a ToeRF folder, per second; it overrides the
    times of the folder and the default of 120, or 30. A capture, which states every time, has none.

    Of ``frames``, whole quartets in a row, alone are images read, see :func:`excerpt`; None: of all
    raw frames.

    Raises:
        InputError: If the folder or a file in it does not conform to data_specs/, or there are no
            such raw frames.
    """
    sequence = _read(Path(path), frame_rate_hz, frames)
    return sequence if frames is None else excerpt(sequence, frames, quads=sequence.quads)


def read_without_images(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """:func:`read`, with no image in memory: ``quads`` have the shape [0, H, W]."""
    return _read(Path(path), frame_rate_hz, range(0))


def _read(root: Path, frame_rate_hz: float | None, frames: range | None) -> Sequence:
    """A sequence whose images, ``quads`` included, are those of some raw frames; None: of all."""
    form = format_of(root)
    check_links(root)
    if form == capture.FORMAT:
        return capture.read(root, frame_rate_hz, frames)
    return read_sequence(STORED[form](root), frame_rate_hz, frames)


def read_truth(sequence: Sequence) -> Truth | None:
    """Read the ground truth stored with a sequence; None if there is none.

    Raises:
        InputError: If a file of it does not conform to data_specs/.
    """
    root = sequence.path
    if root is None:
        return None
    form = format_of(root)
    check_links(root)
    frames = range(sequence.frames) if sequence.excerpt is None else sequence.excerpt
    if form == capture.FORMAT:
        return capture.read_truth(root, frames)
    return read_distances(STORED[form](root), frames)


# methods of the public class; sequence.py does not import the readers, which import it
Sequence.open = staticmethod(read)  # type: ignore[attr-defined]
Sequence.truth = read_truth  # type: ignore[attr-defined]
