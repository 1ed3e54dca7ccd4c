"""Run folders spoiled by a seed: a value of config.json replaced or removed, or a file damaged as
the readers' files are, see damaged_files.py.
"""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from damaged_files import damage

from gftorf_warp.recon.folder import SUM

VALUES = [None, True, -1, 0, 1e300, 10**30, "text", "", [], [1], {}, {"a": 1}]
ANY_FILE = SimpleNamespace(damaged="**/*")


def spoil(run: Path, seed: int) -> str:
    """Change something in a run folder; what it was."""
    random = np.random.default_rng(seed)
    if random.random() < 0.5:
        return _in_config(run / "config.json", random)
    return damage(run, random, ANY_FILE)


def _in_config(path: Path, random: np.random.Generator) -> str:
    """Replace or remove one value, however deep."""
    content = table = without_sum(json.loads(path.read_text()))
    where = [_key_of(table, random)]
    while isinstance(table[where[-1]], dict) and table[where[-1]] and random.random() < 0.8:
        table = table[where[-1]]
        where.append(_key_of(table, random))
    if random.random() < 0.3:
        del table[where[-1]]
        path.write_text(json.dumps(content))
        return f"without {'.'.join(where)}"
    value = VALUES[random.integers(len(VALUES))]
    set_value(path, ".".join(where), value)
    return f"{'.'.join(where)} = {value!r}"


def _key_of(table: dict, random: np.random.Generator) -> str:
    return sorted(table)[random.integers(len(table))]


def set_value(path: Path, name: str, value: object) -> None:
    """Set a value of a JSON file, as somebody who means it; dots join the keys."""
    content = table = without_sum(json.loads(path.read_text()))
    *tables, key = name.split(".")
    for one in tables:
        table = table[one]
    table[key] = value
    path.write_text(json.dumps(content))


def without_sum(config: dict) -> dict:
    """The content of a config.json without the sum that would notice every change."""
    return {name: value for name, value in config.items() if name != SUM}


def copied(run: Path, to: Path) -> Path:
    """A fresh copy of a run to spoil."""
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(run, to)
    return to
