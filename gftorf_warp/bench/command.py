"""``gftorf bench``: parts by name, what they share, tables for eyes and JSON for everything else."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..data.files import write_json
from ..data.read import read
from ..errors import UsageError
from . import motion, reconstruction, renderer, rendering, states, step
from .timing import Report, quietly

RUNS, QUICK_RUNS = 30, 5
PRESETS = {"cpu": "demo", "other": "released"}  # of whole reconstructions; a step is always of the second
Rows = list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What was typed."""

    device: str
    """Where to compute."""
    quick: bool = False
    """Small sizes and few runs: whether it works, not what it costs."""
    sequence: Path | None = None
    """Of the parts that need one; None: a simulated scene."""
    run: Path | None = None
    """The run whose state is timed by ``step`` and ``render``; None: one made from measured phase."""
    images: int | None = None
    """Length of what is counted in images; None: the part's own."""
    preset: str | None = None
    """Of step and reconstruction; None: their own."""
    changes: tuple[str, ...] = ()
    """Single settings."""


class Shared:
    """What several parts need, made when the first of them asks."""

    def __init__(self, wanted: Wanted, folder: Path):
        self.wanted, self.folder = wanted, folder

    @property
    def runs(self) -> int:
        """How often short things are done."""
        return QUICK_RUNS if self.wanted.quick else RUNS

    @functools.cached_property
    def path(self) -> Path:
        """The folder of the sequence."""
        return self.wanted.sequence or states.simulated(self.folder / "sequence", quick=self.wanted.quick)

    @functools.cached_property
    def fitted(self) -> states.Fitted:
        """The state of a reconstruction in its middle."""
        wanted, sequence = self.wanted, read(self.path)
        settings = states.settings_of(sequence, wanted.preset or PRESETS["other"], list(wanted.changes), wanted.device)
        if wanted.run is not None:
            return states.from_run(wanted.run, sequence, settings, wanted.device)
        return states.from_phase(sequence, settings, wanted.device, quick=wanted.quick)

    @functools.cached_property
    def run_folder(self) -> Path:
        """A run that can be rendered."""
        return self.wanted.run or states.as_run(self.fitted, self.folder / "run", self.wanted.device)


def _renderer(shared: Shared, report: Report) -> Rows:
    wanted = shared.wanted
    return renderer.measure(wanted.device, quick=wanted.quick, runs=shared.runs, report=report)


def _motion(shared: Shared, report: Report) -> Rows:
    wanted = shared.wanted
    return motion.measure(wanted.device, quick=wanted.quick, runs=shared.runs, report=report)


def _step(shared: Shared, report: Report) -> Rows:
    wanted = shared.wanted
    chosen: dict[str, Any] = {"changes": list(wanted.changes), "quick": wanted.quick, "images": wanted.images}
    return step.measure(shared.fitted, wanted.device, **chosen, report=report)


def _reconstruction(shared: Shared, report: Report) -> Rows:
    wanted = shared.wanted
    folder = shared.folder / "reconstruction"
    folder.mkdir()
    kind = "cpu" if wanted.quick or wanted.device == "cpu" else "other"
    chosen: dict[str, Any] = {"preset": wanted.preset or PRESETS[kind], "changes": list(wanted.changes)}
    chosen |= {"quick": wanted.quick, "images": wanted.images}
    return reconstruction.measure(shared.path, folder, wanted.device, **chosen, report=report)


def _render(shared: Shared, report: Report) -> Rows:
    wanted = shared.wanted
    chosen: dict[str, Any] = {"quick": wanted.quick, "images": wanted.images}
    return rendering.measure(shared.run_folder, shared.folder / "images", wanted.device, **chosen, report=report)


PARTS: dict[str, tuple[Callable[[Shared, Report], Rows], Callable[[Rows], list[str]]]] = {
    "renderer": (_renderer, renderer.table),
    "motion": (_motion, motion.table),
    "step": (_step, step.table),
    "reconstruction": (_reconstruction, reconstruction.table),
    "render": (_render, rendering.table),
}


def bench(
    parts: list[str],
    wanted: Wanted,
    *,
    json: str | Path | None = None,
    progress: Callable[[str], Report] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measure parts one after the other.

    Args:
        parts: Names out of ``PARTS``; none: all.
        wanted: How and on what.
        json: File for everything, written anew after every part, so that an interruption keeps what was measured.
        progress: Called with the name of a part; returns what that part calls with (done, total).
        say: Called with every line of every table.

    Returns:
        What the file holds: machine and versions, and rows by part.

    Raises:
        UsageError: If a part is unknown, a folder is missing, or the file cannot be written.
    """
    chosen = checked(parts)
    _check_folders(wanted)
    found: dict[str, Any] = {
        **about(wanted.device),
        "quick": wanted.quick,
        "command": _words(chosen, wanted),
        "parts": {},
    }
    if json is not None:
        _check_file(Path(json))
    if wanted.device != "cpu":  # events and graphs are those of the current device
        torch.get_device_module(torch.device(wanted.device)).set_device(wanted.device)
    say(" - ".join(str(found[name]) for name in ("device", "driver", "warp", "torch", "commit")))
    with _folder() as folder:
        shared = Shared(wanted, folder)
        for name in chosen:
            measure, table = PARTS[name]
            begun = time.perf_counter()
            rows = measure(shared, quietly if progress is None else progress(name))
            found["parts"][name] = {"seconds": time.perf_counter() - begun, "rows": rows}
            if json is not None:
                write_json(json, found)
            for line in ["", *table(rows)]:
                say(line)
    return found


def checked(parts: list[str]) -> list[str]:
    """The parts that are meant, each once, in the order of the table.

    Raises:
        UsageError: If one is unknown.
    """
    unknown = [name for name in parts if name not in PARTS]
    if unknown:
        why = f"there are {', '.join(PARTS)}"
        fix = "leave PART out for all of them"
        raise UsageError(f"unknown part {', '.join(unknown)}", where="gftorf bench", why=why, fix=fix)
    return [name for name in PARTS if name in parts or not parts]


def _version_of(package: str) -> str:
    """As installed; a folder on the path may have none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


def about(device: str) -> dict[str, Any]:
    """The machine and the versions, as every result states them."""
    on_cpu = device == "cpu"
    name = platform.processor() or platform.machine()
    return {
        "device": f"cpu, {name}" if on_cpu else torch.get_device_module(torch.device(device)).get_device_name(device),
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "driver": "no driver" if on_cpu else f"driver {_driver()}",
        "python": platform.python_version(),
        "warp": f"Warp {_version_of('warp-lang')}",
        "torch": f"torch {torch.__version__}",
        "gftorf_warp": __version__,
        "commit": _commit(),
    }


def _driver() -> str:
    """Version of the GPU's driver, as its own tool says it."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return said.splitlines()[0].strip() if said.strip() else "unknown"


def _commit() -> str | None:
    """Commit of the checkout that the package lies in, marked if files of it were changed; None without one."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    try:
        words = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
        return subprocess.run(words, check=True, capture_output=True, text=True, timeout=30).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _words(parts: list[str], wanted: Wanted) -> str:
    """The command, as it could be typed again; folders by their names only."""
    words = ["gftorf bench", *parts, "--device", wanted.device] + ["--quick"] * wanted.quick
    for option, value in (("sequence", wanted.sequence), ("run", wanted.run)):
        words += [] if value is None else [f"--{option}", value.name]
    words += [] if wanted.images is None else ["--images", str(wanted.images)]
    words += [] if wanted.preset is None else ["--preset", wanted.preset]
    return " ".join([*words, *(f"--set {change}" for change in wanted.changes)])


def _check_folders(wanted: Wanted) -> None:
    """Whether what was named is there, before anything is measured."""
    for option, path in (("--sequence", wanted.sequence), ("--run", wanted.run)):
        if path is not None and not path.is_dir():
            why = f"{path} is no folder"
            raise UsageError(
                "no such folder", where=option, why=why, fix=f"name an existing one, or leave {option} out"
            )
    if wanted.sequence is not None:
        read(wanted.sequence)  # its own errors are the right ones


def _check_file(path: Path) -> None:
    """Whether the JSON can be written, before anything is measured; what is there stays as it is."""
    fix = "choose another --json"
    if path.is_dir():
        raise UsageError("not a file", where=path, why="--json names a folder", fix=fix)
    if not path.absolute().parent.is_dir() or not os.access(path.absolute().parent, os.W_OK):
        why = "its folder does not exist, or nothing may be written there"
        raise UsageError("cannot write", where=path, why=why, fix=fix)


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="gftorf-bench-") as folder:
        yield Path(folder)
