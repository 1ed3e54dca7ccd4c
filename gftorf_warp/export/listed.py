"""``export.json`` of an export folder: what each format in it was made of, so that a command that
was killed finishes when it is repeated, and nothing else is taken for its result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..data.files import as_errors, sweep, write_json
from ..data.texts import read_json
from ..errors import InputError, UsageError
from ..recon.folder import set_aside
from ..recon.run import Run
from .moments import Moments

LIST = "export.json"
SUMS = ("ckpt/*.sha256", "windows/*/ckpt/*.sha256")  # of a run in windows, those of all
DECISIVE = ("seed", "data_sha256", "settings", "images_optimised")
Description = Mapping[str, Any]


def described(moments: Moments, colour: str | None) -> Description:
    """What a format is made of: run, its state, times [s], and colour if the format has any."""
    run = moments.run
    known = {"run": str(run.path), "state_sha256": state(run), "times_s": moments.times}
    return known | ({} if colour is None else {"colour": colour})


def state(run: Run) -> str:
    """SHA-256 of what decides the images of a run: Gaussians, checkpoints, settings, data."""
    digest = hashlib.sha256()
    for name, tensor in (run.field.tensors() | {"binding": run.binding}).items():
        array = tensor.detach().cpu().contiguous().numpy()
        digest.update(f"{name} {array.shape} {array.dtype}".encode() + array.tobytes())
    for path in sorted(path for pattern in SUMS for path in run.path.glob(pattern)):
        digest.update(path.name.encode() + path.read_bytes())
    decisive = {name: run.config.get(name) for name in DECISIVE}
    digest.update(json.dumps(decisive, sort_keys=True, default=str).encode())
    return digest.hexdigest()


def remaining(out: Path, descriptions: Mapping[Path, Description], *, fresh: bool) -> list[Path]:
    """Those of some targets in ``out`` that have to be made.

    Args:
        out: The folder of the export, which need not exist.
        descriptions: What each target would be made of.
        fresh: Whether to move targets that exist to ``out/old-<k>``, the same ones too.

    Raises:
        UsageError: If one exists that was made of something else, and ``fresh`` is not set.
    """
    held = [target for target in descriptions if target.exists()]
    with as_errors(out):
        sweep(out / LIST)
        if fresh:
            if held:
                set_aside(out, held)
            return [*descriptions]
    known = entries(out)
    others = [target for target in held if known.get(target.name) != descriptions[target]]
    if others:
        why = "an earlier export wrote it, of another state of the run, other times or colours"
        fix = "choose another --out, or --fresh, which moves it aside"
        raise UsageError("nothing is overwritten", where=others[0], why=why, fix=fix)
    return [target for target in descriptions if target not in held]


def record(target: Path, description: Description) -> None:
    """Note what a target is made of, just before it appears in its folder, which exists."""
    out = target.parent
    there = {name: entry for name, entry in entries(out).items() if (out / name).exists()}
    write_json(out / LIST, there | {target.name: description})


def entries(out: Path) -> dict[str, Any]:
    """What is noted, by name of the target; nothing if the list is missing or damaged."""
    try:
        content = read_json(out / LIST)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}
