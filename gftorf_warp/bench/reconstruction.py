"""A whole reconstruction in its own process, with an empty kernel cache and then the filled one.

Wall clock of the process, imports and reading of data included, and ``seconds_reconstruct`` of
config.json. N, d and d_ToF are read from metrics.jsonl and diagnostics.jsonl.
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

from ..data.flow import compute_flow
from ..data.read import read, read_truth
from ..data.texts import read_rows
from ..data.write import write
from ..errors import GftorfError, ResourceError
from .timing import Report, lines_of

IMAGES = {"cpu": 4_000, "other": 20_000}
QUICK_IMAGES = 24
POLL_S = 0.2  # [s] interval of progress updates
PACKAGE = Path(__file__).parents[2]  # on the path of the other process
KEYS = ("d_mse_x100", "d_tof_mse_x100", "moving.d_mse_x100", "moving.d_tof_mse_x100")


def with_flow(path: Path, out: Path) -> tuple[Path, float]:
    """A copy of the sequence with its optical flow, and the time [s] of computing it.

    Sequences that have flow, or phasors, are returned as they are.
    """
    sequence = read(path)
    if sequence.flow.forward or sequence.flow.backward or sequence.from_phasors:
        return path, 0.0
    begun = time.perf_counter()
    sequence = replace(sequence, flow=compute_flow(sequence))
    seconds = time.perf_counter() - begun
    return write("ftorf", out, sequence, read_truth(sequence)), seconds


def measure(
    path: Path,
    folder: Path,
    device: str,
    preset: str,
    changes: list[str],
    *,
    quick: bool,
    images: int | None,
    report: Report,
) -> list[dict[str, Any]]:
    """Two rows, cold and warm, with their curves, in an empty folder."""
    total = images or (QUICK_IMAGES if quick else IMAGES["cpu" if device == "cpu" else "other"])
    sequence, flow_s = with_flow(path, folder / "sequence")
    cache = folder / "kernels"
    cache.mkdir()
    rows = []
    for number, name in enumerate(("cold", "warm")):
        out = folder / name
        command = ["reconstruct", str(sequence), "--out", str(out), "--preset", preset]
        command += ["--images", str(total), "--device", device, "--quiet"]
        command += [word for change in changes for word in ("--set", change)]
        begun = time.perf_counter()
        with _running(command, cache) as process:
            while process.poll() is None:
                time.sleep(POLL_S)
                report(number * total + min(_reached(out), total - 1), 2 * total, kernels=name)
        wall = time.perf_counter() - begun
        report((number + 1) * total, 2 * total, kernels=name)
        row = {"kernels": name, "preset": preset, "set": changes, "wall_s": wall, "flow_s": flow_s}
        rows.append(row | results_of(out))
    return rows


def results_of(run: Path) -> dict[str, Any]:
    """Length, size and curves of a finished run."""
    config = json.loads((run / "config.json").read_text())
    metrics, diagnostics = (
        read_rows(run / name) for name in ("metrics.jsonl", "diagnostics.jsonl")
    )
    images, seconds = ([0.0, *(row[key] for row in metrics)] for key in ("images", "seconds"))
    curve = [
        {
            "images": row["images"],
            "seconds": float(np.interp(row["images"], images, seconds)),
            "N": row["gaussians"],
            **{key: row.get(key) for key in KEYS},
        }
        for row in diagnostics
    ]
    last = curve[-1]
    facts = {"images": config["images_optimised"], "seconds": config["seconds_reconstruct"]}
    return facts | {"N": last["N"], "curve": curve} | {key: last[key] for key in KEYS}


@contextmanager
def _running(command: list[str], cache: Path) -> Iterator[subprocess.Popen]:
    """The command in another process with its own kernel cache, terminated after the block.

    Raises:
        GftorfError: If it fails.
    """
    paths = os.pathsep.join(filter(None, [str(PACKAGE), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"WARP_CACHE_PATH": str(cache), "PYTHONPATH": paths}
    with (cache.parent / "errors.txt").open("w+") as errors:
        words = [sys.executable, "-m", "gftorf_warp", *command]
        nothing = subprocess.DEVNULL
        process = subprocess.Popen(words, stdout=nothing, stderr=errors, env=environment)
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        if process.returncode:
            errors.seek(0)
            lines = errors.read().strip().splitlines() or ["no message"]
            failed = f"`gftorf {command[0]}` ended with {process.returncode}: {' '.join(lines[:3])}"
            raise error_of(failed, process.returncode)


def error_of(why: str, code: int) -> GftorfError:
    """The class of error that has the exit code of the other process."""
    kinds = {kind.exit_code: kind for kind in GftorfError.__subclasses__()}
    fix = "run that command by itself, with --debug"
    kind = kinds.get(code, ResourceError)
    return kind("the reconstruction failed", where="gftorf bench", why=why, fix=fix)


def _reached(run: Path) -> int:
    """Optimised images of a run in progress."""
    return max((int(row["images"]) for row in read_rows(run / "metrics.jsonl")), default=0)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Totals, then the warm run over time."""
    errors = ["d", "d_ToF", "moving d", "d_ToF"]
    heads = ["kernel cache", "images", "process [s]", "reconstruct [s]", "N at the end", *errors]
    totals = [
        [row["kernels"], f"{row['images']:,}", f"{row['wall_s']:.2f}", *_end_of(row)]
        for row in rows
    ]
    lines = lines_of(f"reconstruction, preset {rows[0]['preset']}: MSE x100 [m^2]", heads, totals)
    curve = [[f"{row['images']:,}", *_end_of(row)] for row in rows[-1]["curve"]]
    heads = ["images", "seconds", "N", *errors]
    return [*lines, "", *lines_of("warm, over time: MSE x100 [m^2]", heads, curve)]


def _end_of(row: dict[str, Any]) -> list[str]:
    """Cells of seconds, N and errors."""
    errors = ("-" if row[key] is None else f"{row[key]:.4g}" for key in KEYS)
    return [f"{row['seconds']:.2f}", f"{row['N']:,}", *errors]
