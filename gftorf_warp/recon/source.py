"""The sequence that a run was made from: read again and checked by its hash."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..data.excerpt import excerpt
from ..data.read import read
from ..data.sequence import Sequence
from ..errors import InputError, UsageError
from . import folder
from .joined import Window, folder_of
from .observations import data_hash, former_hash

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
    """The config of a run whose sequence was moved to another folder; updates config.json.

    Raises:
        InputError: If the folder holds no sequence, or another one.
        BusyError: If a process works on the run.
    """
    _checked(Path(source), run, config)
    try:
        with folder.locked(run):
            store_folder(run, Path(source))
    except (UsageError, OSError) as error:  # of a run that may only be read
        text = "%s keeps the old folder of the sequence: %s"
        LOG.warning(text, run / folder.CONFIG, str(error).partition("\n")[0])
    return {**config, "sequence": str(Path(source).resolve())}


def store_folder(run: Path, source: Path) -> None:
    """Store the folder of the sequence in config.json."""
    config, path = folder.read_config(run), str(source.resolve())
    if config.get("sequence") != path:
        folder.write_config(run, config | {"sequence": path})


def _checked(source: Path, run: Path, config: Mapping[str, Any]) -> Sequence:
    """A sequence with the hash that a config states, or the configs of all its windows; runs of
    before 0.1.0 state none.
    """
    given = str(config.get("times") or "").startswith("setting")
    frames = range(*config["excerpt"]) if config.get("excerpt") else None
    rate = config["frame_rate_hz"] if given else None
    sequence = read(source, frame_rate_hz=rate, frames=frames)
    _check_hash(source, run, config, sequence)
    for number, stored in enumerate(config.get("windows") or ()):
        window_run, part = folder_of(run, number), excerpt(sequence, Window.of(stored).frames)
        _check_hash(source, window_run, folder.read_config(window_run), part)
    camera, size = config["camera"], (sequence.width, sequence.height)
    if (camera["width"], camera["height"]) != size:
        why = f"{run} has {camera['width']}x{camera['height']} pixels, this {size[0]}x{size[1]}"
        fix = "restore config.json from a copy"
        raise InputError("not the sequence of the run", where=source, why=why, fix=fix)
    return sequence


def _check_hash(source: Path, run: Path, config: Mapping[str, Any], sequence: Sequence) -> None:
    """Raise an InputError if a sequence has another hash than the config of a run states."""
    wanted = config.get("data_sha256")
    if wanted is None or wanted == (actual := data_hash(sequence)):
        return
    if wanted != former_hash(sequence):
        why = f"{run} was made from data of SHA-256 {wanted[:12]}..., these have {actual[:12]}..."
        fix = "name the sequence of the run with --sequence SEQ, or reconstruct this one"
        raise InputError("not the sequence of the run", where=source, why=why, fix=fix)


def check_windows(run: Path, config: Mapping[str, Any]) -> None:
    """Check that all windows of a run are finished.

    Raises:
        InputError: If not.
    """
    count = len(config["windows"])
    windows = [folder_of(run, number) for number in range(count)]
    for done, path in enumerate([*windows, run]):
        there = (path / folder.CONFIG).is_file()
        if not there or folder.read_config(path).get("images_optimised") is None:
            why = f"the first {done} of {count} windows are finished"
            fix = "repeat its `gftorf reconstruct`, which goes on there"
            raise InputError("the run is not finished", where=path, why=why, fix=fix)
