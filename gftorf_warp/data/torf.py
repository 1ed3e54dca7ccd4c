"""TöRF folders of phasors: their layout, which data_specs/torf.toml describes."""

from __future__ import annotations

from pathlib import Path

from ..constants import FRAME_RATE_HZ, FRAMES_PER_QUARTET
from ..errors import InputError
from . import specs
from .arrays import read_shape
from .family import Stored, read_distances, read_sequence
from .folder import SLOT_FOLDERS, format_of, numbered, refuse_absurd_ids
from .problems import Problems
from .sequence import Sequence, Truth
from .torf_write import write

__all__ = ["read", "read_truth", "stored_phasors", "write"]

FORMAT = "torf"
PHASOR_RATE_HZ = FRAME_RATE_HZ / FRAMES_PER_QUARTET  # [Hz] the sensor is that of the F-ToeRF recordings


def read(path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
    """Read a ToeRF folder, phasors per second given or not, see :func:`gftorf_warp.data.family.read_sequence`."""
    return read_sequence(stored_phasors(Path(path)), frame_rate_hz)


def read_truth(path: str | Path, *, frames: int) -> Truth | None:
    """Read the true distances of a ToeRF folder, see :func:`gftorf_warp.data.family.read_distances`."""
    return read_distances(stored_phasors(Path(path)), frames)


def stored_phasors(root: Path) -> Stored:
    """The measured phasors of a folder of this format.

    Ids count from 0, or from the smallest id of tof/ and color/, 0001 in the original recordings; where the times
    of the folder outnumber its largest id, they count from 0.

    Raises:
        InputError: If the folder has another format, there are no phasors, or an id is absurd.
    """
    if format_of(root) != FORMAT:
        raise InputError(
            "an F-ToeRF folder, which holds raw quads",
            where=root,
            why=f"expected a ToeRF folder with tof and cams, found {', '.join(SLOT_FOLDERS)} or some of them",
            fix="read it as a sequence of raw quads",
        )
    fields = specs.fields(FORMAT)
    files = numbered(root, fields["phasor"].paths[0])
    if not files:
        raise InputError(
            "no phasors",
            where=root / "tof",
            why="expected files tof/{id}.npy with ids of four digits, 0000.npy or 0001.npy and so on, found none",
            fix="name each phasor by its number",
        )
    refuse_absurd_ids(files)
    first_id = min([*files, *numbered(root, fields["colour"].paths[0])])
    times = root / fields["frame_times"].paths[0]
    stated = Problems().attempt(read_shape, times, fields["frame_times"]) if times.exists() else None
    if stated is not None and stated[0] > max(files):
        first_id = 0
    return Stored(
        root=root,
        form=FORMAT,
        files={n - first_id: file for n, file in files.items()},
        field="phasor",
        counted="phasors",
        step=FRAMES_PER_QUARTET,
        rate_hz=PHASOR_RATE_HZ,
        first_id=first_id,
        note=f", ids from {first_id:04d}",
    )
