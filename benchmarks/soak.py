"""Simulate, check, reconstruct, render, compare and export in a loop in one process: what grows?

    python benchmarks/soak.py [--hours H] [--rounds N] [--out FILE.csv]
    GLIBC_TUNABLES=glibc.malloc.tcache_count=0 python benchmarks/soak.py --hours 0.3

Every round does all of it at tiny size on the CPU, with another seed, and deletes its folder. The
process has a folder of its own for temporary files (TMPDIR) and another one to work in. After each
round and a garbage collection, a line of the CSV file states resident and anonymous memory, what
the C library has handed out, open file descriptors, threads, and files in TMPDIR, in the working
folder and in ~/.cache/gftorf_warp.

At the end the slopes of memory over the second half are printed, by least squares, with their
standard errors. Pages that an allocator keeps make resident memory noisy by megabytes; what it has
handed out is exact once its caches per thread are off, as in the second line. The exit code is 1 if
memory or a number of something grew, see ``grown``.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import ctypes
import gc
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch

from gftorf_warp import compare, reconstruct, simulate
from gftorf_warp.data.check import check
from gftorf_warp.evaluate.views import render_to_folder
from gftorf_warp.export.command import export
from gftorf_warp.terminal import start_warp

SIZE = {"size": (32, 24), "frames": 8}
IMAGES = 24  # of a run
PRESETS = ("best", "demo", "temporal")
CACHE = Path.home() / ".cache" / "gftorf_warp"
MIB = 1 << 20
ERRORS = 3.0  # a slope is no noise beyond so many standard errors
MEMORY_MIB = 1.0  # [MiB] over the second half; an allocator's pages come and go by less
MEMORY = ("resident_mib", "anonymous_mib", "allocated_mib")
NUMBERS = ("descriptors", "threads", "temporary", "working", "cached")


@dataclass(frozen=True)
class State:
    """What the process has after a round."""

    round: int
    """Number of the round, from 1."""
    hours: float
    """Since the first one began [h]."""
    resident_mib: float
    """Resident memory [MiB]."""
    anonymous_mib: float
    """Of it what maps no file [MiB]."""
    allocated_mib: float
    """Handed out by the C library [MiB]; 0 where it is not glibc 2.33 or newer."""
    descriptors: int
    """Open file descriptors."""
    threads: int
    """Threads."""
    temporary: int
    """Files in TMPDIR."""
    working: int
    """Files in the working folder."""
    cached: int
    """Files in ~/.cache/gftorf_warp."""

    @classmethod
    def now(cls, number: int, begun: float, folders: Sequence[Path]) -> State:
        """After a round; ``folders`` are that of temporary files and the working folder."""
        gc.collect()
        status = dict(
            line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines()
        )
        memory = [int(status[name].split()[0]) / 1024 for name in ("VmRSS", "RssAnon")]
        opened = [len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task")]
        return cls(
            number,
            (time.monotonic() - begun) / 3600,
            *memory,
            allocated() / MIB,
            opened[0] - 1,  # without that of the listing
            opened[1],
            *(files_in(folder) for folder in (*folders, CACHE)),
        )


class Allocations(ctypes.Structure):
    """glibc's ``struct mallinfo2``, from malloc.h."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks "
        "keepcost".split()
    ]


def allocated() -> int:
    """Bytes that the C library has handed out, in all arenas and by mmap."""
    if not hasattr(libc := ctypes.CDLL(None), "mallinfo2"):
        return 0
    libc.mallinfo2.restype = Allocations
    found = libc.mallinfo2()
    return found.uordblks + found.hblkhd


def files_in(folder: Path) -> int:
    """Number of files and folders below a folder."""
    return sum(1 for _ in folder.rglob("*")) if folder.exists() else 0


def work(place: Path, seed: int) -> None:
    """One round, in a new folder."""
    sequence = simulate("demo", place / "seq", seed=seed, **SIZE)
    simulate("demo", place / "traced", seed=seed, engine="mesh", format="capture", **SIZE)
    check(sequence, place / "sheet.png")
    for preset in PRESETS:
        run = reconstruct(sequence, place / preset, preset, images=IMAGES, seed=seed)
        render_to_folder(run, place / "images" / preset, ("distance", "quads"))
        compare(run)
        formats = "ply,npz" if run.gaussians else "npz"
        export(run, place / "exported" / preset, formats)


def slope(hours: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Slope of values over time [1/h] by least squares, and its standard error.

    Args:
        hours: At least three times [h].
        values: As many values.
    """
    x = np.asarray(hours, np.float64) - np.mean(hours)
    y = np.asarray(values, np.float64) - np.mean(values)
    found = float(x @ y / (x @ x))
    residuals = y - found * x
    error = float(np.sqrt(residuals @ residuals / (len(x) - 2) / (x @ x)))
    return found, error


def grown(states: Sequence[State]) -> list[str]:
    """What grew in the second half: memory whose slope is beyond its noise and whose least value in
    the last tenth is a MiB above that in the first one, since pages that the C library returns and
    takes again make resident memory hop; and numbers whose least value in the last tenth is above
    the largest one before.
    """
    hours, found = [state.hours for state in states], []
    last = max(1, len(states) // 10)
    for name in MEMORY:
        values = [getattr(state, name) for state in states]
        steep, error = slope(hours, values)
        if steep > ERRORS * error and min(values[-last:]) - min(values[:last]) > MEMORY_MIB:
            found.append(name)
    for name in NUMBERS:
        values = [getattr(state, name) for state in states]
        if min(values[-last:]) > max(values[:-last]):
            found.append(name)
    return found


def summary(states: Sequence[State]) -> list[str]:
    """Lines about the second half."""
    hours, (first, last) = [state.hours for state in states], (states[0], states[-1])
    lines = [f"rounds {first.round} to {last.round}, {hours[-1] - hours[0]:.3f} h"]
    for name in MEMORY:
        values = [getattr(state, name) for state in states]
        steep, error = slope(hours, values)
        between = f"between {min(values):.1f} and {max(values):.1f}"
        lines.append(f"{name}: slope {steep:+.3f} +- {error:.3f} MiB/h, {between} MiB")
    for name in NUMBERS:
        values = [getattr(state, name) for state in states]
        lines.append(f"{name}: {min(values)} to {max(values)}, at the end {values[-1]}")
    return lines


def rounds(hours: float, count: int, table: Path) -> list[State]:
    """Work until the time is over or so many rounds are done; each is a line of ``table``."""
    states: list[State] = []
    with tempfile.TemporaryDirectory(prefix="gftorf-soak-") as made:
        place = Path(made)
        folders = [place / "temporary", place / "working"]
        for folder in folders:
            folder.mkdir()
        os.environ["TMPDIR"] = tempfile.tempdir = str(folders[0])
        begun = time.monotonic()
        with contextlib.chdir(folders[1]), table.open("w", newline="", encoding="utf-8") as file:
            rows = csv.DictWriter(file, [field.name for field in fields(State)])
            rows.writeheader()
            while len(states) < count and time.monotonic() - begun < hours * 3600:
                work(place / "round", len(states))
                shutil.rmtree(place / "round")
                states.append(State.now(len(states) + 1, begun, folders))
                rows.writerow(asdict(states[-1]))
                file.flush()
    return states


def main() -> int:
    """All rounds; 1 if something grew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--hours", type=float, default=2.0, help="begin no round after so long")
    parser.add_argument("--rounds", type=int, default=sys.maxsize, help="at most so many, >= 6")
    parser.add_argument("--out", type=Path, default=Path("soak.csv"), help="CSV file to write")
    options = parser.parse_args()
    torch.set_num_threads(1)
    start_warp()
    logging.getLogger("gftorf_warp").setLevel(logging.ERROR)
    states = rounds(options.hours, options.rounds, options.out.resolve())
    half = states[len(states) // 2 :]
    if len(half) < 3:
        print(f"{len(states)} rounds are too few for a slope")
        return 1
    print("\n".join(summary(half)))
    found = grown(half)
    print(f"grown: {', '.join(found)}" if found else "nothing grew")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
