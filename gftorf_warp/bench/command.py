"""``gftorf bench``: parts by name, the scenes and states that they share, tables and JSON."""

from __future__ import annotations

import functools
import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..data.files import write_json
from ..data.read import read
from ..errors import UsageError
from ..evaluate.provenance import version_of
from . import motion, reconstruction, renderer, rendering, states, step
from .timing import Report, quietly

RUNS, QUICK_RUNS = 30, 5
# of whole reconstructions; steps always have the second
PRESETS = {"cpu": "demo", "other": "released"}
Rows = list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Options of the command."""

    device: str
    """"cpu" or a CUDA device."""
    quick: bool = False
    """Small sizes and few runs, as a test of the benchmark itself."""
    sequence: Path | None = None
    """Sequence of ``step``, ``reconstruction`` and ``render``; None: a simulated scene."""
    run: Path | None = None
    """Run whose state is used by ``step`` and ``render``; None: a state initialised from measured
    phase."""
    images: int | None = None
    """Number of images of ``step``, ``reconstruction`` and ``render``; None: their defaults."""
    preset: str | None = None
    """Preset of ``step`` and ``reconstruction``; None: their defaults."""
    changes: tuple[str, ...] = ()
    """Changes of single settings."""


class Shared:
    """Sequence, state and run that several parts use, made on first access."""

    def __init__(self, wanted: Wanted, folder: Path):
        self.wanted, self.folder = wanted, folder
        self.device, self.quick = wanted.device, wanted.quick
        self.runs = QUICK_RUNS if wanted.quick else RUNS

    @functools.cached_property
    def path(self) -> Path:
        """The folder of the sequence."""
        return self.wanted.sequence or states.simulated(self.folder / "sequence", quick=self.quick)

    @functools.cached_property
    def fitted(self) -> states.Fitted:
        """State of a reconstruction in progress."""
        wanted, sequence = self.wanted, read(self.path)
        preset = wanted.preset or PRESETS["other"]
        settings = states.settings_of(sequence, preset, list(wanted.changes), wanted.device)
        if wanted.run is not None:
            return states.from_run(wanted.run, sequence, settings, wanted.device)
        return states.from_phase(sequence, settings, wanted.device, quick=wanted.quick)

    @functools.cached_property
    def run_folder(self) -> Path:
        """A run that can be rendered."""
        run = self.wanted.run
        return run or states.as_run(self.fitted, self.folder / "run", self.wanted.device)

    @property
    def length(self) -> dict[str, Any]:
        """Arguments on the number of images."""
        return {"quick": self.quick, "images": self.wanted.images}


def _renderer(shared: Shared, report: Report) -> Rows:
    return renderer.measure(shared.device, quick=shared.quick, runs=shared.runs, report=report)


def _motion(shared: Shared, report: Report) -> Rows:
    return motion.measure(shared.device, quick=shared.quick, runs=shared.runs, report=report)


def _step(shared: Shared, report: Report) -> Rows:
    changes = list(shared.wanted.changes)
    return step.measure(
        shared.fitted, shared.device, changes=changes, **shared.length, report=report
    )


def _reconstruction(shared: Shared, report: Report) -> Rows:
    folder = shared.folder / "reconstruction"
    folder.mkdir()
    usual = PRESETS["cpu" if shared.quick or shared.device == "cpu" else "other"]
    settings = shared.wanted.preset or usual, list(shared.wanted.changes)
    given = shared.path, folder, shared.device
    return reconstruction.measure(*given, *settings, **shared.length, report=report)


def _render(shared: Shared, report: Report) -> Rows:
    given = shared.run_folder, shared.folder / "images", shared.device
    return rendering.measure(*given, **shared.length, report=report)


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
    """Measure parts in turn.

    Args:
        parts: Names out of ``PARTS``; none: all.
        wanted: Options.
        json: File of all results, written after every part.
        progress: Called with the name of a part; returns the progress callback of that part.
        say: Called with every line of the tables.

    Returns:
        The content of the file: machine and versions, and rows by part.

    Raises:
        UsageError: If a part is unknown, a folder is missing, or the file cannot be written.
    """
    chosen = checked(parts)
    _check_folders(wanted)
    results = about(wanted.device)
    results |= {"quick": wanted.quick, "command": _words(chosen, wanted), "parts": {}}
    if json is not None:
        _check_file(Path(json))
    if wanted.device != "cpu":  # events and graphs are those of the current device
        torch.get_device_module(torch.device(wanted.device)).set_device(wanted.device)
    say(" - ".join(str(results[name]) for name in ("device", "driver", "warp", "torch", "commit")))
    with tempfile.TemporaryDirectory(prefix="gftorf-bench-") as folder:
        shared = Shared(wanted, Path(folder))
        for name in chosen:
            measure, table = PARTS[name]
            begun = time.perf_counter()
            rows = measure(shared, quietly if progress is None else progress(name))
            results["parts"][name] = {"seconds": time.perf_counter() - begun, "rows": rows}
            if json is not None:
                write_json(json, results)
            for line in ["", *table(rows)]:
                say(line)
    return results


def checked(parts: list[str]) -> list[str]:
    """The chosen parts without repetition, in the order of ``PARTS``.

    Raises:
        UsageError: If one is unknown.
    """
    unknown = [name for name in parts if name not in PARTS]
    if unknown:
        what, why = f"unknown part {', '.join(unknown)}", f"there are {', '.join(PARTS)}"
        fix = "leave PART out for all of them"
        raise UsageError(what, where="gftorf bench", why=why, fix=fix)
    return [name for name in PARTS if name in parts or not parts]


def about(device: str) -> dict[str, Any]:
    """Machine and versions, for the JSON of every benchmark."""
    on_cpu, cpus = device == "cpu", os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        cpus = len(os.sched_getaffinity(0))
    if on_cpu:
        name = f"cpu, {platform.processor() or platform.machine()}"
    else:
        name = torch.get_device_module(torch.device(device)).get_device_name(device)
    return {
        "device": name,
        "cpus": cpus,
        "driver": "no driver" if on_cpu else f"driver {_driver()}",
        "python": platform.python_version(),
        "warp": f"Warp {version_of('warp-lang')}",
        "torch": f"torch {torch.__version__}",
        "gftorf_warp": __version__,
        "commit": _commit(),
    }


def _driver() -> str:
    """Version of the NVIDIA driver, by nvidia-smi."""
    output = _output_of("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return output.splitlines()[0].strip() if output else "unknown"


def _commit() -> str | None:
    """Commit of the package's checkout, with "-dirty" if files were changed; None: no checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    options = "--always", "--dirty", "--abbrev=12", "--exclude=*"
    return _output_of("git", "-C", str(root), "describe", *options)


def _output_of(*words: str) -> str | None:
    """Output of a command; None if it fails."""
    try:
        return subprocess.check_output(
            words, stderr=subprocess.DEVNULL, text=True, timeout=30
        ).strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _words(parts: list[str], wanted: Wanted) -> str:
    """The command line; folders by their names only."""
    words = ["gftorf bench", *parts, "--device", wanted.device] + ["--quick"] * wanted.quick
    for option, value in (("sequence", wanted.sequence), ("run", wanted.run)):
        words += [] if value is None else [f"--{option}", value.name]
    words += [] if wanted.images is None else ["--images", str(wanted.images)]
    words += [] if wanted.preset is None else ["--preset", wanted.preset]
    return " ".join([*words, *(f"--set {change}" for change in wanted.changes)])


def _check_folders(wanted: Wanted) -> None:
    """Check that the named folders exist and the sequence can be read."""
    for option, path in (("--sequence", wanted.sequence), ("--run", wanted.run)):
        if path is not None and not path.is_dir():
            fix = f"name an existing one, or leave {option} out"
            raise UsageError("no such folder", where=option, why=f"{path} is no folder", fix=fix)
    if wanted.sequence is not None:
        read(wanted.sequence)  # raises its own errors


def _check_file(path: Path) -> None:
    """Check that the JSON can be written, without changing an existing file."""
    fix = "choose another --json"
    if path.is_dir():
        raise UsageError("not a file", where=path, why="--json names a folder", fix=fix)
    if not path.absolute().parent.is_dir() or not os.access(path.absolute().parent, os.W_OK):
        why = "its folder does not exist, or nothing may be written there"
        raise UsageError("cannot write", where=path, why=why, fix=fix)
