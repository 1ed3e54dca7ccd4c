"""SIGKILL at random moments: a command that is repeated ends with the bytes of an undisturbed one.

    python benchmarks/kills.py [--kills N] [--seed S] [--commands A,B]

Each command runs in a process of its own, on the CPU at tiny size, and is killed after a random
time up to its usual one; the same command then goes on, until all were killed so often. After every
kill, the newest checkpoint of a run must load. In the end nothing but the clock may differ from the
undisturbed result, and no temporary file may be left. Prints a row per command; the exit code is 1
if anything failed. Commands: simulate, reconstruct, render, export.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

# imported before processes are forked, so that each starts at once
from gftorf_warp.cli import main
from gftorf_warp.evaluate import compare, views  # noqa: F401
from gftorf_warp.recon import checkpoint, train  # noqa: F401
from gftorf_warp.sim import simulate  # noqa: F401

SIZE = ["--size", "32x24", "--frames", "12"]
RECONSTRUCT = "--preset demo --images 96 --set schedule.log_every=8".split()
OFTEN = ["--set", "schedule.checkpoint_every_s=0"]  # changes no result
DEVICE = ["--device", "cpu"]
CLOCKS = ("seconds", "seconds_reconstruct")
LOGS = (".lock", "run.log", "config.json")  # clocks, paths and settings that change no result


@dataclass(frozen=True)
class Killed:
    """A command that is killed."""

    words: Callable[[Path], list[str]]
    """Its arguments, for the folder that it writes."""
    content: Callable[[Path], Any]
    """What has to be the same in the end."""


def run_of(place: Path) -> dict[str, Any]:
    """State and rows of a run, without clocks."""
    stored = checkpoint.last(place)
    assert stored is not None, "a finished run has a checkpoint"
    rows = {
        name: [
            {key: value for key, value in json.loads(line).items() if key not in CLOCKS}
            for line in (place / name).read_text().splitlines()
        ]
        for name in ("metrics.jsonl", "diagnostics.jsonl")
    }
    return {key: value for key, value in stored.items() if key not in CLOCKS} | rows


def files_of(place: Path) -> dict[str, bytes]:
    """Bytes of all files by relative name."""
    return {
        str(path.relative_to(place)): path.read_bytes()
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.name not in LOGS
    }


def same(a: Any, b: Any) -> bool:
    """Whether nested values agree to the bit."""
    if isinstance(a, torch.Tensor):
        return a.shape == b.shape and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def commands(made: Path) -> dict[str, Killed]:
    """What is killed, by name; ``made`` holds a sequence and a run of it."""
    run, sequence = str(made / "run"), str(made / "seq")
    fitted, again = [*RECONSTRUCT, *OFTEN, *DEVICE], ["--fresh", *DEVICE]
    return {
        "simulate": Killed(lambda out: ["simulate", "demo", *SIZE, "--out", str(out)], files_of),
        "reconstruct": Killed(
            lambda out: ["reconstruct", sequence, "--out", str(out), *fitted], run_of
        ),
        "render": Killed(
            lambda out: ["render", run, "--what", "distance,quads", "--out", str(out), *DEVICE],
            files_of,
        ),
        "export": Killed(
            lambda out: ["export", run, "--format", "ply,exr", "--out", str(out), *again],
            lambda out: [files_of(out / name) for name in ("ply", "exr")],
        ),
    }


def started(words: list[str]) -> int:
    """Process id of a command that runs without output."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        code = main([*words, "-q"])
    finally:
        os._exit(code)


def finished(words: list[str]) -> float:
    """Run a command to its end; its seconds.

    Raises:
        RuntimeError: If its exit code is not 0.
    """
    begun = time.monotonic()
    code = os.waitstatus_to_exitcode(os.waitpid(started(words), 0)[1])
    if code:
        raise RuntimeError(f"exit code {code}: gftorf {' '.join(words)}")
    return time.monotonic() - begun


def killed(words: list[str], after: float) -> bool:
    """Kill a command after some seconds; whether it was still running."""
    child = started(words)
    deadline = time.monotonic() + after
    while time.monotonic() < deadline:
        if os.waitpid(child, os.WNOHANG)[0]:
            return False
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def trial(name: str, one: Killed, place: Path, kills: int, chosen: random.Random) -> dict[str, Any]:
    """Kill a command so often, let it finish after each few kills, and compare."""
    usual = finished(one.words(place / "whole"))
    want, out = one.content(place / "whole"), place / "killed"
    count = completions = unreadable = differing = 0
    while count < kills:
        shutil.rmtree(out, ignore_errors=True)
        goal = min(kills, count + chosen.randrange(1, 5))
        while count < goal:
            if not killed(one.words(out), chosen.uniform(0.0, usual)):
                break  # it was finished before
            count += 1
            unreadable += name == "reconstruct" and not _loads(out)
        finished(one.words(out))
        completions += 1
        differing += not same(one.content(out), want)
    strays = [path for path in place.rglob("*") if ".tmp-" in path.name or ".partial" in path.name]
    row = {"command": name, "kills": count, "completed": completions, "unreadable": unreadable}
    return row | {"differing": differing, "strays": len(strays), "usual_s": round(usual, 2)}


def _loads(run: Path) -> bool:
    """Whether a run has no checkpoint yet, or one that loads and no damaged one."""
    paths = sorted((run / "ckpt").glob("*.pt"))
    stored = checkpoint.last(run) if paths else None
    return stored is None or not checkpoint.after(run, stored["images"])


def parsed() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100, help="of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--commands", default="simulate,reconstruct,render,export")
    return parser.parse_args()


if __name__ == "__main__":
    options = parsed()
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder)
        finished(["simulate", "demo", *SIZE, "--out", str(made / "seq")])
        words = ["reconstruct", str(made / "seq"), "--out", str(made / "run")]
        finished([*words, *RECONSTRUCT, *DEVICE])
        known, failed = commands(made), False
        for name in options.commands.split(","):
            place = made / name
            place.mkdir()
            row = trial(name, known[name], place, options.kills, random.Random(options.seed))
            failed |= bool(row["unreadable"] or row["differing"] or row["strays"])
            print(json.dumps(row), flush=True)
    sys.exit(failed)
