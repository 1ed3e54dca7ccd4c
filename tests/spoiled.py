"""Run folders spoiled in one place, chosen by a seed: what a crash, a bad disk, an editor or a
stranger leaves.
"""

import copy
import json
import os
import random
import shutil
from pathlib import Path

VALUES = [None, True, -1, 0, 1e300, 10**30, "text", "", [], [1], {}, {"a": 1}]
TEXTS = [
    b"",
    b" \n",
    b"{}",
    b"[]",
    b"null",
    b"{",
    b"\xff\xfe\x00 no text",
    5000 * b"[",
    b'{"images": "four"}\n',
    b"garbage\n",
]


def spoil(run: Path, seed: int) -> str:
    """Change one thing in a run folder; what it was."""
    chosen = random.Random(seed)
    files = sorted(path for path in run.rglob("*") if path.is_file())
    path = chosen.choice([run / "config.json", chosen.choice(files)])
    name = path.relative_to(run)
    ways = ["folder", "gone", "pipe", "link", "text", "cut", "flip"]
    if path.suffix == ".json":
        ways += 5 * ["value", "key"]
    if path.suffix == ".jsonl":
        ways += 3 * ["row"]
    way = chosen.choice(ways)
    data = path.read_bytes()
    if way in ("value", "key"):
        return f"{name}: {_in_json(path, way, chosen)}"
    if way == "row":
        rows = data.splitlines(keepends=True)
        rows.insert(chosen.randrange(len(rows) + 1), chosen.choice(TEXTS) + b"\n")
        path.write_bytes(b"".join(rows))
    elif way == "text":
        path.write_bytes(chosen.choice(TEXTS))
    elif way == "cut":
        path.write_bytes(data[: chosen.randrange(len(data) + 1)])
    elif way == "flip":
        flipped = bytearray(data)
        for at in [chosen.randrange(len(data)) for _ in range(3)] if data else []:
            flipped[at] ^= 1 << chosen.randrange(8)
        path.write_bytes(flipped)
    else:
        path.unlink()
        if way == "folder":
            path.mkdir()
        elif way == "pipe":
            os.mkfifo(path)
        elif way == "link":
            path.symlink_to("/dev/null" if chosen.random() < 0.5 else "/nowhere")
    return f"{name}: {way}"


def _in_json(path: Path, way: str, chosen: random.Random) -> str:
    """Replace or remove one value of a JSON file, however deep."""
    content = json.loads(path.read_text())
    table, key = content, chosen.choice(sorted(content))
    where = key
    while isinstance(table[key], dict) and table[key] and chosen.random() < 0.8:
        table = table[key]
        key = chosen.choice(sorted(table))
        where += f".{key}"
    if way == "key":
        del table[key]
        path.write_text(json.dumps(content))
        return f"without {where}"
    table[key] = copy.deepcopy(chosen.choice(VALUES))
    path.write_text(json.dumps(content))
    return f"{where} = {table[key]!r}"[:80]


def set_value(path: Path, name: str, value: object) -> None:
    """Set a value of a JSON file; dots join the keys."""
    content = table = json.loads(path.read_text())
    *tables, key = name.split(".")
    for one in tables:
        table = table[one]
    table[key] = value
    path.write_text(json.dumps(content))


def copied(run: Path, to: Path) -> Path:
    """A fresh copy of a run to spoil."""
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(run, to)
    return to
