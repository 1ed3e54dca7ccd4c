"""Writing a sequence and its ground truth as a folder of any of the formats of data_specs/."""

from __future__ import annotations

import hashlib
from pathlib import Path

from . import capture_write, ftorf, torf
from .capture_json import FORMAT as CAPTURE
from .capture_json import MANIFEST
from .exr import write_parts
from .files import atomic_folder, write_through
from .folder import SLOT_FOLDERS
from .sequence import Sequence, Truth
from .writing import refuse_inexpressible, validate

FILES = {"capture": capture_write.files, "ftorf": ftorf.files, "torf": torf.files}
SHEET = "contact_sheet.png"  # in every simulated folder; no reader opens it


def write(
    form: str,
    path: str | Path,
    sequence: Sequence,
    truth: Truth | None = None,
    *,
    readme: str | None = None,
    sheet: bytes | None = None,
) -> Path:
    """Write a sequence and its ground truth as a new or empty folder, atomically; returns its path.

    Args:
        form: Name of the format: ``capture``, ``ftorf`` or ``torf``.
        path: New or empty folder.
        sequence: The sequence.
        truth: Its ground truth, if known.
        readme: Text of a README.md in the folder.
        sheet: A contact sheet, as PNG.

    Raises:
        UsageError: If the format cannot express the sequence, or the folder cannot be created.
        InputError: If phasors are to be written and shifts do not determine a phase.
        ResourceError: If the disk is full.
        ValueError: If shapes of the sequence or the truth contradict each other.
    """
    validate(sequence, truth)
    refuse_inexpressible(form, sequence, truth)
    with atomic_folder(path) as folder:
        # they belong to the layout, frames or not
        for name in SLOT_FOLDERS if form == ftorf.FORMAT else ():
            (folder / name).mkdir()
        for name, content in FILES[form](sequence, truth):
            (folder / name).parent.mkdir(exist_ok=True)
            if isinstance(content, bytes):
                write_through(folder / name, content)
            else:
                write_parts(folder / name, content)
        files = filter(Path.is_file, folder.rglob("*"))
        names = sorted(file.relative_to(folder).as_posix() for file in files)
        others = {"README.md": None if readme is None else readme.encode(), SHEET: sheet}
        if form == CAPTURE:
            digests = {n: hashlib.sha256((folder / n).read_bytes()).hexdigest() for n in names}
            lines = [f"{digest}  {name}\n" for name, digest in digests.items()]
            others[MANIFEST] = "".join(lines).encode()
        for name, data in others.items():
            if data is not None:
                write_through(folder / name, data)
    return Path(path)
