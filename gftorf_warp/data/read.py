"""Reading a sequence and its ground truth from a folder of any of the formats of data_specs/."""

from __future__ import annotations

from pathlib import Path

from . import capture, ftorf, torf
from .folder import format_of
from .sequence import Sequence, Truth

READERS = {"capture": capture, "ftorf": ftorf, "torf": torf}


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read a sequence from a folder.

    Args:
        path: A capture, an F-ToeRF folder of raw quads, or a ToeRF folder of phasors.
        frame_rate_hz: Raw frames per second, or phasors per second of a ToeRF folder; overrides the times of the
            folder and the default of 120, or 30. Not allowed for a capture, which states every time.

    Raises:
        InputError: If the folder or a file in it does not conform to data_specs/.
    """
    return READERS[format_of(Path(path))].read(path, frame_rate_hz=frame_rate_hz)


def read_truth(sequence: Sequence) -> Truth | None:
    """Read the ground truth stored with a sequence; None if there is none.

    Raises:
        InputError: If a file of it does not conform to data_specs/.
    """
    path = sequence.path
    return None if path is None else READERS[format_of(path)].read_truth(path, frames=sequence.frames)


# methods of the public class; sequence.py does not import the readers, which import it
Sequence.open = staticmethod(read)  # type: ignore[attr-defined]
Sequence.truth = read_truth  # type: ignore[attr-defined]
