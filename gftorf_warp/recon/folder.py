"""The folder of a run: who may work in it, what it was made with,
and whether a new call may go on there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..data import lock
from ..data.files import json_text, sweep, write_json
from ..data.texts import read_json
from ..errors import InputError, UsageError
from .settings import UNREAD, Method, ReconSettings, plain

CONFIG = "config.json"
SUM = "config_sha256"  # the key in it with the SHA-256 of all others
LOCK = ".lock"
LOG = "run.log"  # a run that failed before its first step leaves this alone
FRESH = (
    "continue with the same settings, choose another --out, or start over with --fresh (the "
    "old run is kept aside)"
)
IDENTITY = ("seed", "data_sha256", "windows")
"""What has to agree for a run to be continued, besides the settings."""


def prepare(
    run: Path, config: dict[str, object], *, fresh: bool, former: str | None = None
) -> bool:
    """Make the folder ready for a run with this config; ``former``: SHA-256 of the same data that
    an older run states.

    Returns:
        True if it already holds this run, which is then continued; False if it is new.

    Raises:
        UsageError: If the folder holds something else, or the same run with other settings.
    """
    if run.exists() and not run.is_dir():
        raise UsageError(
            "not a folder", where=run, why="--out names a file", fix="choose another --out"
        )
    sweep(run / CONFIG)  # a first config that a killed process did not complete
    held = (
        [path for path in run.iterdir() if not _aside(path) and path.name not in (LOCK, LOG)]
        if run.exists()
        else []
    )
    if not held:
        run.mkdir(parents=True, exist_ok=True)
        return False
    if not (run / CONFIG).is_file():
        raise UsageError(
            "the folder is not empty",
            where=run,
            why=f"it holds {len(held)} entries and no {CONFIG}: it is not a run",
            fix="choose another --out",
        )
    if fresh:
        set_aside(run, held)
        return False
    stated = read_config(run)
    if former is not None and stated.get("data_sha256") == former:
        stated["data_sha256"] = config["data_sha256"]
    differing = differences(stated, config)
    if differing:
        raise UsageError(
            "the folder holds a run with other settings",
            where=run,
            why="; ".join(differing[:4]) + ("; ..." if len(differing) > 4 else ""),
            fix=FRESH,
        )
    return True


MAY_GROW = ("schedule.images", "attempts_max")
# the last until 0.1.0
CHANGES_NOTHING = ("render.threads", "schedule.checkpoint_every_s", "graph", "kernels")
REMOVED = {"volume.grid.moving_rate": 1.0}
"""Settings that older runs state, by the value that is what is done now."""


def differences(old: dict[str, object], new: dict[str, object]) -> list[str]:
    """Differences for which a run cannot be continued under a new config. A longer run is the same.

    A setting that a run is too old to know has its default: what it says then is what was always
    done, or as good.
    """
    texts = []
    flat_old, flat_new = (
        {**_flat(c.get("settings", {})), **{k: c.get(k) for k in IDENTITY}} for c in (old, new)
    )
    if "settings" in old:
        flat_old = {**_flat(plain(ReconSettings(preset=""))), **flat_old}
    for key in sorted({*flat_old, *flat_new}):
        before, after = flat_old.get(key), flat_new.get(key, REMOVED.get(key))
        if (
            key in MAY_GROW
            and isinstance(before, int)
            and isinstance(after, int)
            and after >= before
        ):
            continue
        if key in UNREAD and flat_new.get("method", Method.GAUSSIANS) != Method.GAUSSIANS:
            continue
        if before != after and key not in CHANGES_NOTHING:
            texts.append(f"{key} was {_short(before)}, now {_short(after)}")
    return texts


def set_aside(run: Path, held: list[Path]) -> Path:
    """Move an old run into ``RUN/old-<k>``, the first free number."""
    number = 1
    while (run / f"old-{number}").exists():
        number += 1
    aside = run / f"old-{number}"
    aside.mkdir()
    for path in held:
        path.rename(aside / path.name)
    return aside


def read_config(run: Path) -> dict[str, Any]:
    """Content of ``RUN/config.json`` without its sum, which older runs do not have.

    Raises:
        InputError: If it is missing or no JSON object, or its values are not those of its sum.
    """
    path = run / CONFIG
    fix = "name the --out folder of a reconstruction"
    try:
        config = read_json(path)
    except InputError as error:
        why = f"expected a JSON object written by `gftorf reconstruct`: {error.what}: {error.why}"
        raise InputError("not a run", where=path, why=why, fix=fix) from error
    if not isinstance(config, dict):
        raise InputError("not a run", where=path, why="expected a JSON object", fix=fix)
    stated = config.pop(SUM, None)
    try:
        actual = None if stated is None else sum_of(config)
    except ValueError:  # a NaN or an infinity, which is never written
        actual = "not of JSON"
    if stated != actual:
        why = (
            f"the SHA-256 of its values is {str(actual)[:12]}..., {SUM} says {str(stated)[:12]}..."
        )
        fix = f"restore it from a copy; if a value was changed on purpose, remove {SUM} from it"
        raise InputError("damaged config", where=path, why=why, fix=fix)
    return config


def write_config(run: Path, config: dict[str, object]) -> None:
    """Replace ``RUN/config.json``, with a sum by which a changed value is noticed."""
    write_json(run / CONFIG, config | {SUM: sum_of(config)})


def sum_of(config: dict[str, Any]) -> str:
    """SHA-256 of the values of a config, however they are laid out in a file."""
    text = json_text(json.loads(json_text(config)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Hold ``RUN/.lock`` as long as a process works on the run,
    see :func:`gftorf_warp.data.lock.locked`.

    After an exception in a folder that is no run, nothing of ours stays: neither lock, nor log,
    nor folders that were made for them.
    """
    made = [folder for folder in (run, *run.parents) if not folder.exists()]
    ours = [path for path in (run / LOCK, run / LOG) if not path.exists()]
    try:
        with lock.locked(run, LOCK, "run"):
            try:
                yield
            except BaseException:
                for path in ours if not (run / CONFIG).exists() else []:
                    with suppress(OSError):  # an open file on Windows
                        path.unlink()
                raise
    except BaseException:
        for folder in made:
            with suppress(OSError):  # it holds something by now
                folder.rmdir()
        raise


def _aside(path: Path) -> bool:
    return path.name.startswith("old-") and path.is_dir()


def _flat(value: object, prefix: str = "") -> dict[str, object]:
    if not isinstance(value, dict):
        return {prefix.rstrip("."): value}
    return {
        key: leaf
        for name, part in value.items()
        for key, leaf in _flat(part, f"{prefix}{name}.").items()
    }


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 20 else text[:12] + "..."
