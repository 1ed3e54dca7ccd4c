"""F-TöRF folders of raw quads: their layout, which data_specs/ftorf.toml describes."""

from __future__ import annotations

from pathlib import Path

from ..constants import FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .family import Stored, read_distances, read_sequence
from .folder import SLOT_FOLDERS, format_of, numbered, refuse_absurd_ids
from .ftorf_write import write
from .sequence import Sequence, Truth

__all__ = ["read", "read_truth", "write"]

FORMAT = "ftorf"


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read an F-ToeRF folder, raw frames per second given or not, see :func:`gftorf_warp.data.family.read_sequence`."""
    return read_sequence(_stored(Path(path)), frame_rate_hz)


def read_truth(path: str | Path, *, frames: int) -> Truth | None:
    """Read the true distances of an F-ToeRF folder, see :func:`gftorf_warp.data.family.read_distances`."""
    return read_distances(_stored(Path(path)), frames)


def _stored(root: Path) -> Stored:
    """The measured raw frames of a complete folder of this format; other files of tofType0 .. are warped copies.

    Raises:
        InputError: If the folder has another format, is not complete, or has no raw frame.
    """
    format_of(root)
    missing = [name for name in (*SLOT_FOLDERS, "cams") if not (root / name).is_dir()]
    if missing:
        raise InputError(
            "not an F-ToeRF folder" if len(missing) > 1 else f"{missing[0]} missing",
            where=root,
            why=f"expected an F-ToeRF folder with tofType0 .. tofType3 and cams, found no {', '.join(missing)}",
            fix="complete the folder",
        )
    pattern = specs.fields(FORMAT)["quads"].paths[0]
    measured: dict[int, Path] = {}
    copies = 0
    for slot in range(FRAMES_PER_QUARTET):
        files = numbered(root, pattern.replace("{slot}", str(slot)))
        of_slot = {n: file for n, file in files.items() if n % FRAMES_PER_QUARTET == slot}
        measured |= of_slot
        copies += len(files) - len(of_slot)
    if not measured:
        raise InputError(
            "no raw frames",
            where=root / SLOT_FOLDERS[0],
            why="expected files tofType{id % 4}/{id}.npy with ids of four digits, 0000.npy, 0004.npy, .., found none",
            fix="name each measured quad by its raw frame",
        )
    refuse_absurd_ids(measured)
    return Stored(
        root=root,
        form=FORMAT,
        files=dict(sorted(measured.items())),
        field="quads",
        counted="raw frames",
        step=1,
        rate_hz=FRAME_RATE_HZ,
        note=f"; {copies} files of another slot than their id's are warped copies, ignored" if copies else "",
    )
