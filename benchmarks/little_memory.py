"""Commands under a limit on address space: each ends with its result, or with exit code 5.

    python benchmarks/little_memory.py [--size WxH] [--frames N] [--commands A;B]

Every command runs ten times in this process, with 0.5 to 128 MB more than it has mapped already, on
the CPU; a sweep, whose work is done by a process of its own, with limits between the peaks of the
two. Prints a row per command: the exit code at each limit, and of a sweep that of the same command
without one. The exit code of the script is 1 if there was another one than 0 and 5, if a repeated
sweep failed, or if the checkpoint of a run does not load.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from tiny_commands import Command, commands, quiet

EXTRA_MB = (0.5, 2, 4, 8, 12, 16, 24, 32, 64, 128)
SHARES = tuple((k + 0.5) / 10 for k in range(10))
GFTORF = (sys.executable, "-m", "gftorf_warp")
PEAK = re.compile(r"VmPeak:\s+(\d+)")
POLL_S = 0.05
LONG_S = 600.0  # a sweep that hangs is no result
Row = dict[str, Any]


def mapped() -> int:
    """Bytes of address space that this process has."""
    return 1024 * int(re.findall(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[0])


def limited(words: list[str], extra_mb: float) -> int:
    """Exit code of a command that may map so much more."""
    limit = mapped() + round(1e6 * extra_mb)
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        return quiet(words)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)


def trial(command: Command) -> Row:
    """One command in this process, ten times."""
    codes, loads = [], True
    command.reset()
    assert quiet(command.words) == 0, command.words  # what it imports and compiles is loaded
    for extra in EXTRA_MB:
        command.reset()
        codes.append(limited(command.words, extra))
        loads &= command.loads()
    return {"extra_mb": EXTRA_MB, "exit_codes": codes, "loads": loads}


def peaks(words: list[str]) -> list[int]:
    """Largest address spaces [bytes] of the processes of a command, which ends with 0."""
    most: dict[int, int] = {}
    command = subprocess.Popen([*GFTORF, *words], stdout=subprocess.DEVNULL)
    while command.poll() is None:
        for pid in (command.pid, *children(command.pid)):
            with contextlib.suppress(OSError, IndexError):  # it has ended meanwhile
                most[pid] = 1024 * int(PEAK.findall(Path(f"/proc/{pid}/status").read_text())[0])
        time.sleep(POLL_S)
    assert command.returncode == 0, words
    return sorted(most.values())


def children(pid: int) -> list[int]:
    """Processes that a process started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/status"):
        with contextlib.suppress(OSError):
            if f"PPid:\t{pid}\n" in path.read_text():
                found.append(int(path.parent.name))
    return found


def trial_of_processes(command: Command) -> Row:
    """A command that starts processes, ten times in a process of its own, and after each once more
    without a limit. The limits lie between the peaks of the two largest of its processes: the
    command itself, and one that works for it.
    """
    command.reset()
    *_, less, most = peaks(command.words)
    limits = [round(less + share * (most - less)) for share in SHARES]
    codes, again, loads = [], [], True
    for limit in limits:
        command.reset()
        room = partial(resource.setrlimit, resource.RLIMIT_AS, (limit, limit))
        given = {"preexec_fn": room, "timeout": LONG_S, "capture_output": True}
        codes.append(subprocess.run([*GFTORF, *command.words], check=False, **given).returncode)
        loads &= command.loads()
        again.append(quiet(command.words))
        loads &= command.loads()
    mb = [round(limit / 1e6) for limit in limits]
    return {"limit_mb": mb, "exit_codes": codes, "again": again, "loads": loads}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--commands", help="some of them, separated by semicolons")
    options, failed = parser.parse_args(), False
    with tempfile.TemporaryDirectory() as folder:
        inputs, place = Path(folder) / "inputs", Path(folder) / "outputs"
        inputs.mkdir()
        known = commands(inputs, place, options.size, options.frames)
        names = options.commands.split(";") if options.commands else [*known]
        for name in names:
            row = (trial_of_processes if name == "sweep" else trial)(known[name])
            failed |= not {*row["exit_codes"]} <= {0, 5} or not row["loads"]
            failed |= any(row.get("again", ()))
            print(json.dumps({"command": name} | row), flush=True)
    sys.exit(failed)
