"""The sequence that a run was made from: read again, checked by its hash, found elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..data.read import read
from ..data.sequence import Sequence
from ..errors import InputError, UsageError
from . import folder
from .observations import data_hash

LOG = logging.getLogger("gftorf_warp")


def sequence_of(run: Path, config: Mapping[str, Any]) -> Sequence:
    """Read the sequence that the config of a run names.

    Raises:
        InputError: If it was never on disk, is gone, cannot be read, or is another one than it was.
    """
    source = config["sequence"]
    if source is None:
        raise InputError(
            "the sequence is not on disk",
            where=run,
            why="the run was made from a sequence in memory",
            fix="write the sequence with gftorf_warp.data.write.write and reconstruct from the "
            "folder",
        )
    if not Path(source).exists():
        why = f"{run} was made from it, and it is not there"
        fix = "name the folder it is in now with --sequence SEQ"
        raise InputError("the sequence is gone", where=source, why=why, fix=fix)
    return _checked(Path(source), run, config)


def link(run: Path, config: Mapping[str, Any], source: str | Path) -> dict[str, Any]:
    """The config of a run whose sequence is in another folder now, which config.json remembers.

    Raises:
        InputError: If the folder holds no sequence, or another one.
        BusyError: If a process works on the run.
    """
    _checked(Path(source), run, config)
    try:
        with folder.locked(run):
            remember(run, Path(source))
    except (UsageError, OSError) as error:  # of a run that may only be read
        text = "%s keeps the old place of the sequence: %s"
        LOG.warning(text, run / folder.CONFIG, str(error).partition("\n")[0])
    return {**config, "sequence": str(Path(source).resolve())}


def remember(run: Path, source: Path) -> None:
    """Let config.json name the folder of the sequence."""
    config, place = folder.read_config(run), str(source.resolve())
    if config.get("sequence") != place:
        folder.write_config(run, config | {"sequence": place})


def _checked(source: Path, run: Path, config: Mapping[str, Any]) -> Sequence:
    """A sequence with the hash that a config states; runs of before 0.1.0 state none."""
    given = str(config.get("times") or "").startswith("setting")
    sequence = read(source, frame_rate_hz=config["frame_rate_hz"] if given else None)
    wanted = config.get("data_sha256")
    if wanted is not None and (found := data_hash(sequence)) != wanted:
        why = f"{run} was made from data of SHA-256 {wanted[:12]}..., these have {found[:12]}..."
        fix = "name the sequence of the run with --sequence SEQ, or reconstruct this one"
        raise InputError("not the sequence of the run", where=source, why=why, fix=fix)
    camera, size = config["camera"], (sequence.width, sequence.height)
    if (camera["width"], camera["height"]) != size:
        why = f"{run} has {camera['width']}x{camera['height']} pixels, this {size[0]}x{size[1]}"
        fix = "restore config.json from a copy"
        raise InputError("not the sequence of the run", where=source, why=why, fix=fix)
    return sequence
