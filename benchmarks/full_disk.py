"""Commands on a disk that fills up: each ends with exit code 5, loses nothing, and can be repeated.

    mount -t tmpfs -o size=256m tmpfs DISK
    python benchmarks/full_disk.py DISK [--size WxH] [--frames N] [--commands A;B]

Every command writes ten times to DISK, a small file system of its own, on which a file leaves free
5, 15, .. 95 % of the space that the command takes; a part is refused by estimates, the rest fails
while something is written. Then it runs once more with enough space. Prints a row per command: the
exit codes, and the temporary files that were left. The exit code of the script is 1 if there was
another one than 0 and 5, if a checkpoint does not load, if anything temporary is left in the end,
or if the last run fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tiny_commands import Command, commands, quiet

SHARES = tuple((k + 0.5) / 10 for k in range(10))


def free(disk: Path) -> int:
    """Bytes that may still be written there."""
    return shutil.disk_usage(disk).free


@contextlib.contextmanager
def filled(disk: Path, left: int) -> Iterator[None]:
    """Leave so many bytes free there."""
    ballast = disk / "ballast"
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(free(disk) - left, 1))
    try:
        yield
    finally:
        ballast.unlink()


def strays(place: Path) -> list[str]:
    """Files that no reader knows."""
    return [path.name for path in place.rglob("*") if ".tmp-" in path.name]


def trial(command: Command, disk: Path, place: Path) -> dict[str, object]:
    """Ten times too little space, then enough."""
    command.reset()
    before = free(disk)
    assert quiet(command.words) == 0, command.words
    taken, codes, loads, left = before - free(disk), [], True, 0
    for share in SHARES:
        command.reset()
        with filled(disk, round(share * taken)):
            codes.append(quiet(command.words))
            left += len(strays(place))
            loads &= command.loads()
    again = quiet(command.words)
    row = {"taken": taken, "exit_codes": codes, "loads": loads, "temporary": left, "again": again}
    return row | {"strays": strays(place)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("disk", type=Path)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--commands", help="some of them, separated by semicolons")
    options, failed = parser.parse_args(), False
    with tempfile.TemporaryDirectory() as folder:
        place = options.disk / "outputs"
        known = commands(Path(folder), place, options.size, options.frames)
        writing = [name for name in known if known[name].written is not None]
        for name in options.commands.split(";") if options.commands else writing:
            row = trial(known[name], options.disk, place)
            failed |= not {*row["exit_codes"]} <= {0, 5} or not row["loads"]
            failed |= bool(row["again"] or row["strays"])
            print(json.dumps({"command": name} | row), flush=True)
            shutil.rmtree(place, ignore_errors=True)
    sys.exit(failed)
