"""A whole reconstruction in a process of its own, twice: with an empty kernel cache and with the one that left.

What a person waits for: from the start of the process to its end, start-up of libraries and loading of data included,
and what config.json calls ``seconds_reconstruct``. N, d and d_ToF are read from metrics.jsonl and diagnostics.jsonl.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data import ftorf
from ..data.flow import compute_flow
from ..data.read import read, read_truth
from ..errors import GftorfError, ResourceError
from .timing import Report, lines_of

IMAGES = {"cpu": 4_000, "other": 20_000}
QUICK_IMAGES = 24
POLL_S = 0.2  # [s] between two looks at how far the process is
PACKAGE = Path(__file__).parents[2]  # where the package lies, installed or not
KEYS = ("d_mse_x100", "d_tof_mse_x100", "moving.d_mse_x100", "moving.d_tof_mse_x100")


def with_flow(path: Path, out: Path) -> tuple[Path, float]:
    """The sequence with its optical flow in its folder, and the seconds that computing it took.

    Sequences that have flow, or cannot (phasors), stay where they are.
    """
    sequence = read(path)
    if sequence.flow.forward or sequence.flow.backward or sequence.from_phasors:
        return path, 0.0
    begun = time.perf_counter()
    flow = compute_flow(sequence)
    seconds = time.perf_counter() - begun
    found = replace(sequence, flow=flow)
    return ftorf.write(out, found, read_truth(sequence)), seconds


def measure(
    path: Path,
    folder: Path,
    device: str,
    *,
    preset: str,
    changes: list[str],
    quick: bool,
    images: int | None,
    report: Report,
) -> list[dict[str, Any]]:
    """Two rows, cold and warm, with their curves.

    Args:
        path: Folder of the sequence.
        folder: An empty one to work in.
        device: Where.
        preset: Name of the preset.
        changes: Single settings.
        quick: A few images only.
        images: Length of the runs; None: 20,000, on a CPU 4,000.
        report: Called with (images done in both runs, images in both).
    """
    total = images or (QUICK_IMAGES if quick else IMAGES["cpu" if device == "cpu" else "other"])
    sequence, flow_s = with_flow(path, folder / "sequence")
    cache = folder / "kernels"
    cache.mkdir()
    rows = []
    for number, name in enumerate(("cold", "warm")):
        out = folder / name
        command = ["reconstruct", str(sequence), "--out", str(out), "--preset", preset, "--images", str(total)]
        command += ["--device", device, "--quiet", *(word for change in changes for word in ("--set", change))]
        begun = time.perf_counter()
        with _running(command, cache) as process:
            while process.poll() is None:
                time.sleep(POLL_S)
                report(number * total + min(_reached(out), total - 1), 2 * total, kernels=name)
        wall = time.perf_counter() - begun
        report((number + 1) * total, 2 * total, kernels=name)
        rows.append(
            {"kernels": name, "preset": preset, "set": changes, "wall_s": wall, "flow_s": flow_s, **found_in(out)}
        )
    return rows


def found_in(run: Path) -> dict[str, Any]:
    """Length, size and curves of a finished run."""
    config = json.loads((run / "config.json").read_text())
    metrics, looks = (_lines(run / name) for name in ("metrics.jsonl", "diagnostics.jsonl"))
    images, seconds = [0, *(row["images"] for row in metrics)], [0.0, *(row["seconds"] for row in metrics)]
    curve = [
        {
            "images": look["images"],
            "seconds": float(np.interp(look["images"], images, seconds)),
            "N": look["gaussians"],
            **{key: look.get(key) for key in KEYS},
        }
        for look in looks
    ]
    last = curve[-1]
    facts = {"images": config["images_optimised"], "seconds": config["seconds_reconstruct"], "N": last["N"]}
    return facts | {key: last[key] for key in KEYS} | {"curve": curve}


@contextmanager
def _running(command: list[str], cache: Path) -> Iterator[subprocess.Popen]:
    """The command in a process of its own, with a kernel cache of its own; it does not outlive this block.

    Raises:
        ResourceError: If it fails.
    """
    paths = os.pathsep.join(filter(None, [str(PACKAGE), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"WARP_CACHE_PATH": str(cache), "PYTHONPATH": paths}
    with (cache.parent / "errors.txt").open("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "gftorf_warp", *command], stdout=subprocess.DEVNULL, stderr=errors, env=environment
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        if process.returncode:
            errors.seek(0)
            said = errors.read().strip().splitlines() or ["nothing"]
            failed = f"`gftorf {command[0]}` ended with {process.returncode} and said: {' '.join(said[:3])}"
            raise error_of(failed, process.returncode)


def error_of(why: str, code: int) -> GftorfError:
    """The error of the other process, with its exit code."""
    kinds = {kind.exit_code: kind for kind in GftorfError.__subclasses__()}
    fix = "run that command by itself, with --debug"
    return kinds.get(code, ResourceError)("the reconstruction failed", where="gftorf bench", why=why, fix=fix)


def _reached(run: Path) -> int:
    """Images of a run that is under way."""
    path = run / "metrics.jsonl"
    return max((row["images"] for row in _lines(path)), default=0) if path.exists() else 0


def _lines(path: Path) -> list[dict[str, Any]]:
    """The complete rows of a file of JSON lines."""
    return [json.loads(line) for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Totals, then the warm run over time."""
    heads = [
        "kernel cache",
        "images",
        "process [s]",
        "reconstruct [s]",
        "N at the end",
        "d",
        "d_ToF",
        "moving d",
        "d_ToF",
    ]
    totals = [
        [row["kernels"], f"{row['images']:,}", f"{row['wall_s']:.2f}", f"{row['seconds']:.2f}", f"{row['N']:,}"]
        + [_number(row[key]) for key in KEYS]
        for row in rows
    ]
    lines = lines_of(f"reconstruction, preset {rows[0]['preset']}: MSE x100 [m^2]", heads, totals)
    curve = [
        [f"{look['images']:,}", f"{look['seconds']:.2f}", f"{look['N']:,}", *(_number(look[key]) for key in KEYS)]
        for look in rows[-1]["curve"]
    ]
    heads = ["images", "seconds", "N", "d", "d_ToF", "moving d", "d_ToF"]
    return [*lines, "", *lines_of("warm, over time: MSE x100 [m^2]", heads, curve)]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
