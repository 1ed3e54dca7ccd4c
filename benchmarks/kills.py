"""SIGKILL at random moments: a command that is repeated ends with the bytes of an undisturbed one.

    python benchmarks/kills.py [--kills N] [--seed S] [--commands A,B]

Each command runs in a process of its own, on the CPU at tiny size, and is killed after a random
time up to its usual one; the same command then goes on, until all were killed so often. After every
kill, the newest checkpoint of a run must load. In the end nothing but the clock may differ from the
undisturbed result, and no temporary file may be left. Prints a row per command; the exit code is 1
if anything failed. Commands: simulate, import, reconstruct, render, export, compare, sweep; half of
the kills also end the processes that a command started.
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
from gftorf_warp.export import command as export_command  # noqa: F401
from gftorf_warp.importers import command as import_command  # noqa: F401
from gftorf_warp.recon import checkpoint, train  # noqa: F401
from gftorf_warp.sim import simulate  # noqa: F401

SIZE = ["--size", "32x24", "--frames", "12"]
RECONSTRUCT = "--preset demo --images 96 --set schedule.log_every=8".split()
OFTEN = ["--set", "schedule.checkpoint_every_s=0"]  # changes no result
DEVICE = ["--device", "cpu"]
FORMATS = ("ply", "exr", "npz", "tum", "html", "gif")
OF_A_RUN = {"render", "export", "compare"}  # need a finished one
PLAN = """
scenes = ["random-1"]
presets = ["demo", "ctof"]
images = 48
[simulate]
size = [32, 24]
frames = 8
"""
# clocks, and sums of files that hold some
CLOCKS = ("seconds", "seconds_reconstruct", "wall_s", "checkpoint_sha256", "config_sha256")
LOGS = (".lock", ".sweep.lock", "run.log")  # clocks and processes
TEXTS = (".json", ".jsonl", ".html")


@dataclass(frozen=True)
class Killed:
    """A command that is killed."""

    words: Callable[[Path], list[str]]
    """Its arguments, for the folder that it writes."""
    content: Callable[[Path], Any]
    """What has to be the same in the end."""


def run_of(place: Path) -> dict[str, Any]:
    """State, rows and config of a run, without clocks."""
    stored = checkpoint.last(place)
    assert stored is not None, "a finished run has a checkpoint"
    rows = {
        name: [timeless(json.loads(line), place) for line in (place / name).open()]
        for name in ("metrics.jsonl", "diagnostics.jsonl")
    }
    config = timeless(json.loads((place / "config.json").read_text()), place)
    return timeless(stored, place) | rows | {"config": config}


def timeless(value: Any, place: Path) -> Any:
    """A nested value without clocks and without the folder that it was written to."""
    if isinstance(value, dict):
        kept = {key: one for key, one in value.items() if key not in CLOCKS}
        return {key: timeless(one, place) for key, one in kept.items()}
    if isinstance(value, (list, tuple)):
        return [timeless(one, place) for one in value]
    return value.replace(str(place), "OUT") if isinstance(value, str) else value


def files_of(place: Path) -> dict[str, bytes]:
    """Bytes of all files by relative name; in texts without the name of the folder."""
    contents = {
        str(path.relative_to(place)): path.read_bytes()
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.name not in LOGS
    }
    named = str(place).encode()
    return {
        name: data.replace(named, b"OUT") if name.endswith(TEXTS) else data
        for name, data in contents.items()
    }


def report_of(run: Path) -> Any:
    """What ``compare`` says of a run."""
    return timeless(json.loads((run / "metrics.json").read_text()), run)


def sweep_of(place: Path) -> Any:
    """Scenes, pictures and runs of a sweep, and its results without clocks."""
    results = timeless(json.loads((place / "sweep.json").read_text()), place)
    folders = [path.parent for path in sorted(place.glob("runs/*/*/ckpt"))]
    runs = {str(run.relative_to(place)): timeless(run_of(run), place) for run in folders}
    assert runs, "a sweep has runs"
    return [results, runs, files_of(place / "scenes"), files_of(place / "pictures")]


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Where nested values differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        pairs = [(f"{where}/{key}", a.get(key), b.get(key)) for key in sorted({*a, *b}, key=str)]
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        pairs = [(f"{where}/{n}", x, y) for n, (x, y) in enumerate(zip(a, b, strict=True))]
    else:
        if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
            return [] if a.shape == b.shape and torch.equal(a, b) else [where]
        return [] if type(a) is type(b) and a == b else [where]
    return [found for name, x, y in pairs for found in differences(x, y, name)]


def commands(made: Path) -> dict[str, Killed]:
    """What is killed, by name; ``made`` holds a sequence and a run of it."""
    run, sequence, plan = str(made / "run"), str(made / "seq"), made / "plan.toml"
    plan.write_text(PLAN)
    fitted = [*RECONSTRUCT, *OFTEN, *DEVICE]

    def compared(out: Path) -> list[str]:
        if not out.exists():
            shutil.copytree(run, out)
        return ["compare", str(out), *DEVICE]

    words: dict[str, tuple[list[str], Callable[[Path], Any]]] = {
        "simulate": (["simulate", "demo", *SIZE], files_of),
        "import": (["import", "ftorf", sequence], files_of),
        "reconstruct": (["reconstruct", sequence, *fitted], run_of),
        "render": (["render", run, "--what", "distance,quads", *DEVICE], files_of),
        "export": (["export", run, "--format", ",".join(FORMATS), *DEVICE], files_of),
        "sweep": (["sweep", str(plan), *DEVICE, "--workers", "1"], sweep_of),
    }
    known = {
        name: Killed(lambda out, given=given: [*given, "--out", str(out)], content)
        for name, (given, content) in words.items()
    }
    return known | {"compare": Killed(compared, report_of)}


def started(words: list[str]) -> int:
    """Process id of a command that runs without output."""
    child = os.fork()
    if child:
        os.setpgid(child, child)
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


def killed(words: list[str], after: float, *, alone: bool) -> bool:
    """Kill a command after some seconds, ``alone`` or with its processes; whether it still ran."""
    child = started(words)
    deadline = time.monotonic() + after
    while time.monotonic() < deadline:
        if os.waitpid(child, os.WNOHANG)[0]:
            return False
        time.sleep(0.002)
    (os.kill if alone else os.killpg)(child, signal.SIGKILL)
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
            after, alone = chosen.uniform(0.0, usual), chosen.random() < 0.5
            if not killed(one.words(out), after, alone=alone):
                break  # it was finished before
            count += 1
            unreadable += name == "reconstruct" and not _loads(out)
        usual = min(usual, finished(one.words(out)))  # other processes may have slowed it down
        completions += 1
        apart = differences(one.content(out), want)
        differing += bool(apart)
        if apart:
            print(f"{name} differs in {apart[:8]}", file=sys.stderr)
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
    parser.add_argument("--commands", default="simulate,import,reconstruct,render,export,compare")
    return parser.parse_args()


if __name__ == "__main__":
    options = parsed()
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder)
        finished(["simulate", "demo", *SIZE, "--out", str(made / "seq")])
        known, failed = commands(made), False
        names = options.commands.split(",")
        if not OF_A_RUN.isdisjoint(names):
            words = ["reconstruct", str(made / "seq"), "--out", str(made / "run")]
            finished([*words, *RECONSTRUCT, *DEVICE])
        for name in names:
            place = made / name
            place.mkdir()
            row = trial(name, known[name], place, options.kills, random.Random(options.seed))
            failed |= bool(row["unreadable"] or row["differing"] or row["strays"])
            print(json.dumps(row), flush=True)
    sys.exit(failed)
