"""Damage files of every format that is read, and read them: the long form of
tests/test_damaged_files.py.

    python benchmarks/fuzz.py [--cases N] [--first SEED] [--only READER ..]

Prints a table of outcomes. `read` and `refused` are what should happen: a file of which the damage
does not matter, or that is still whole for its format, and an error that says what is wrong. All
else is listed with the seed that repeats it: `changed` is other content than what a hash protects,
`slow` takes more than ten seconds, `died` ends the process, all others are exceptions. A reader may
take 2 GB of memory.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from damaged_files import READERS, attempt, whole

LONG_S = 10.0
MEMORY_MAX = 2 << 30  # [bytes] beyond what the process has
FINE = ("read", "refused")


def run(name: str, seeds: range, place: Path, sender: Connection) -> None:
    """Send the outcome of each seed; in a process of its own."""
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY_MAX
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries say about damage
    logging.disable()
    for seed in seeds:
        folder = place / str(seed)
        sender.send(attempt(name, seed, folder / "files"))
        shutil.rmtree(folder)


def outcomes(name: str, seeds: range, place: Path) -> Iterator[tuple[int, str, str]]:
    """Seed, damage and outcome, one after the other; a process that is lost is replaced."""
    context = multiprocessing.get_context("fork")
    while seeds:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=run, args=(name, seeds, place, sender))
        process.start()
        sender.close()
        for seed in seeds:
            seeds = seeds[1:]
            try:
                if not receiver.poll(LONG_S):
                    process.kill()
                    yield seed, "", "slow"
                    break
                yield seed, *receiver.recv()
            except EOFError:
                yield seed, "", "died"
                break
        process.join()


def main() -> int:
    """Damage, read and count; 1 if anything else happened than what should."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--cases", type=int, default=10_000, help="of all readers together")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", nargs="+", choices=READERS, default=list(READERS))
    options = parser.parse_args()
    each = -(-options.cases // len(options.only))
    found = []
    print("| files | damaged | read | refused | else | s |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        for name in options.only:
            whole(name)  # before the fork
            begun, counts = time.monotonic(), Counter()
            seeds = range(options.first, options.first + each)
            for seed, damage, outcome in outcomes(name, seeds, Path(place)):
                counts[outcome] += 1
                if outcome not in FINE:
                    found.append(f"{name}, seed {seed}: {outcome} after {damage or 'its damage'}")
            fine = [counts[outcome] for outcome in FINE]
            row = [name, each, *fine, each - sum(fine), f"{time.monotonic() - begun:.0f}"]
            print("|", " | ".join(map(str, row)), "|", flush=True)
    print("\n".join(found))
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
