"""Reconstruction of long recordings: windows of whole quartets, each a run of its own in a folder
``RUN/windows/000``, ``001``, .. Only the raw frames of one window are in memory at a time.
"""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ..data.read import read, read_without_images
from ..data.sequence import Sequence
from ..errors import UsageError
from . import folder
from .config import config_of
from .joined import Window, folder_of
from .loop import Progress
from .record import log_to
from .run import Run
from .settings import ReconSettings
from .suitable import faithfulness
from .train import chosen_settings, reconstruct

LOG = logging.getLogger("gftorf_warp")
OVERLAP_QUARTETS = 2  # a seam then lies a quartet from the ends of both windows: design/long.md
ROUNDING = 1e-6  # [quartets] of seconds given in decimals


def reconstruct_in_windows(
    sequence: str | Path,
    out: str | Path,
    settings: ReconSettings | str = "best",
    *,
    window_s: float,
    overlap_s: float | None = None,
    frame_rate_hz: float | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    fresh: bool = False,
    progress: Progress | None = None,
    **chosen: Any,
) -> Run:
    """:func:`gftorf_warp.reconstruct` of a long recording, window after window.

    A folder that holds the same windows is resumed: what is finished is skipped.

    Args:
        sequence: The folder of the recording.
        out: Folder of the run: config.json, windows/.
        settings: How each window is reconstructed, or the name of a preset.
        window_s: Longest duration of a window [s].
        overlap_s: Least duration that neighbours share [s]; None: two quartets.
        frame_rate_hz: Raw frames, or phasors, per second; None: as the folder says.
        seed: Of every window.
        device: Where to compute.
        fresh: Whether to move what ``out`` holds aside and start over.
        progress: Called as ``progress(images, images_in_all, window=, ...)``, over all windows.
        chosen: ``images`` (of each window), ``input``, ``ablation``, ``flow`` and ``changes`` of
            :func:`gftorf_warp.reconstruct`.

    Returns:
        The finished run, which renders any time of the recording.

    Raises:
        UsageError: If window and overlap do not fit, and whatever else ``reconstruct`` raises.
    """
    timing = read_without_images(sequence, frame_rate_hz=frame_rate_hz)
    windows = plan(timing, window_s, overlap_s)
    out, count = Path(out), len(windows)

    def part(number: int) -> Sequence:
        return read(sequence, frame_rate_hz=frame_rate_hz, frames=windows[number].frames)

    config = _config(part(0), settings, windows, timing, seed=seed, device=device, **chosen)
    config |= {"window_s": window_s, "overlap_s": overlap_s}
    with folder.locked(out):
        if not folder.prepare(out, config, fresh=fresh):
            folder.write_config(out, config)
        with log_to(out / "run.log"):
            text = "%s: %d windows of %d raw frames"
            LOG.info(text, out, count, len(windows[0].frames))
            gaussians = 0
            for number in range(count):
                run = reconstruct(
                    part(number),
                    folder_of(out, number),
                    settings,
                    seed=seed,
                    device=device,
                    progress=progress and _of_all(progress, number, count),
                    **chosen,
                )
                gaussians += run.gaussians
                del run
                gc.collect()  # a run and its sequence refer to each other: frees memory
            folder.write_config(out, config | _finished(out, count) | {"gaussians": gaussians})
    return Run.open(out, device)


def plan(timing: Sequence, window_s: float, overlap_s: float | None = None) -> list[Window]:
    """Windows of equal length that cover all whole quartets of a recording: as few as possible,
    none longer than ``window_s``, neighbours with at least ``overlap_s`` in common [s].

    Raises:
        UsageError: If a window is shorter than a quartet, or the overlap is not shorter than it.
    """
    starts = _quartet_times(timing)
    quartets = len(starts) - 1
    asked, shared = _in_quartets(window_s, overlap_s, float(starts[-1] - starts[0]) / quartets)
    length = min(asked, quartets)
    count = 1 if length == quartets else math.ceil((quartets - shared) / (length - shared))
    firsts = np.linspace(0, quartets - length, count).round().astype(int).tolist()
    return [
        Window(
            frames=range(timing.cycle * first, timing.cycle * (first + length)),
            start=float(starts[first]),
            end=float(starts[first + length]),
        )
        for first in firsts
    ]


def _in_quartets(window_s: float, overlap_s: float | None, period: float) -> tuple[int, int]:
    """Whole quartets in a window and in an overlap, from seconds and those of a quartet.

    Raises:
        UsageError: See :func:`plan`.
    """
    for name, seconds in (("--window", window_s), ("--overlap", overlap_s)):
        if seconds is not None and not (math.isfinite(seconds) and seconds >= 0):
            why, fix = f"expected seconds, found {seconds:g}", f"for example {name} {4 * period:g}"
            raise UsageError("no duration", where=name, why=why, fix=fix)
    length = math.floor(window_s / period + ROUNDING)
    if length < 1:
        why = f"a quartet takes {period:g} s, the window {window_s:g} s"
        fix = f"use --window {period:g} or more"
        raise UsageError("a window without a quartet", where="--window", why=why, fix=fix)
    if overlap_s is None:
        return length, min(OVERLAP_QUARTETS, length - 1)
    shared = math.ceil(overlap_s / period - ROUNDING)
    if shared >= length:
        why = f"windows of {length} quartets cannot have {shared} in common with the next one"
        fix = f"use --overlap {(length - 1) * period:g} or less, or a longer --window"
        raise UsageError("the overlap leaves no window", where="--overlap", why=why, fix=fix)
    return length, shared


def _quartet_times(timing: Sequence) -> Float[np.ndarray, "n"]:
    """Time of the first raw frame of each whole quartet, and when the one after the last would
    begin [s].

    Raises:
        UsageError: If no quartet is whole, or all are of one time.
    """
    cycle, quartets = timing.cycle, timing.frames // timing.cycle
    starts = timing.times[: quartets * cycle : cycle]
    if quartets < 2 or not starts[-1] > starts[0]:
        why = f"{timing.frames} raw frames are {quartets} whole quartets"
        where = timing.path or "sequence"
        fix = "leave --window out"
        raise UsageError("too short for windows", where=where, why=why, fix=fix)
    return np.append(starts, starts[-1] + (starts[-1] - starts[0]) / (quartets - 1))


def _config(
    first: Sequence,
    settings: ReconSettings | str,
    windows: list[Window],
    timing: Sequence,
    *,
    seed: int,
    device: torch.device | str,
    images: int | None = None,
    input: str = "auto",
    ablation: str | None = None,
    flow: str | None = None,
    changes: Any = (),
) -> dict[str, Any]:
    """config.json before the first step: that of the first window, but for what windows add."""
    changes = list(changes)
    known = chosen_settings(first, settings, images, input, ablation, flow, changes)
    stated = config_of(first, known, seed=seed, device=device) | faithfulness(known, changes)
    return stated | {
        "flow": None if flow is None else str(flow),
        "changes": changes,
        "quad_scale": 1.0,  # images of windows are in the units of the sequence
        "size_optimised": [first.width, first.height],
        "excerpt": None,
        "data_sha256": None,  # each window has its own
        "frames": timing.frames,
        "windows": [window.stored for window in windows],
    }


def _finished(out: Path, count: int) -> dict[str, Any]:
    """What config.json says when all windows are finished: sums, and what all have in common."""
    configs = [folder.read_config(folder_of(out, number)) for number in range(count)]
    sums = ("images", "images_optimised", "seconds_reconstruct")
    shared = ("size_optimised", "flow_source", "input", "colour_scale")
    return {name: sum(config[name] for config in configs) for name in sums} | {
        name: configs[0][name] for name in shared if name in configs[0]
    }


def _of_all(progress: Progress, number: int, count: int) -> Callable[..., None]:
    """Progress of one window as progress over all of them."""

    def show(done: int, total: int, **values: Any) -> None:
        progress(number * total + done, count * total, window=number, **values)

    return show
