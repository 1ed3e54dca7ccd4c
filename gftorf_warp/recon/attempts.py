"""Attempts: a fit that fails by its own residuals is fitted once more from another start, and the
better one stays.

Whether a fit failed, and which one is better, is what residuals.py says of the quads; no truth is
read. The state of the second attempt holds the end of the first (``State.other``), so one
checkpoint has everything, and an interrupted run goes on wherever it was stopped.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..data.files import atomic_write
from ..scene.initialise import Init
from ..scene.motion import MotionSettings, Nodes
from . import checkpoint, folder
from .residuals import Residuals, failures, warn
from .settings import ReconSettings
from .state import State, from_dict, to_dict

LOG = logging.getLogger("gftorf_warp")
SEED_STEP = 7_000_003  # between the seeds of attempts, beyond those of collapsed random starts
JUDGED_FROM = 1000  # [images] a shorter run has not converged, whatever it started from
ROWS = ("metrics.jsonl", "diagnostics.jsonl")
Judged = dict[str, Any]


def settings_of(settings: ReconSettings, number: int) -> ReconSettings:
    """The settings of attempt ``number``, from 1: another initialisation than that of the first.

    Nodes that follow tracks instead of windows; nodes that start at rest instead of tracks. Random
    starts differ by their seed alone.
    """
    motion = settings.motion
    if number == 1 or settings.init.kind == Init.RANDOM:
        return settings
    if settings.init.kind == Init.QUARTETS:
        nodes = replace(motion, kind=Nodes.kind, nodes=MotionSettings().nodes)
        return replace(settings, init=replace(settings.init, kind=Init.PHASE), motion=nodes)
    return replace(settings, motion=replace(motion, from_tracks=not motion.from_tracks))


def seed_of(seed: int, number: int) -> int:
    """The seed of attempt ``number``, from 1."""
    return seed + SEED_STEP * (number - 1)


def run(
    state: State,
    settings: ReconSettings,
    out: Path,
    *,
    train: Callable[[State], State],
    begin: Callable[[int], State],
    judge: Callable[[], Residuals | None],
) -> tuple[State, Residuals | None]:
    """Train, judge, and where that failed and the settings allow it, train from another start.

    Args:
        state: Where the run is.
        settings: Of the run.
        out: Its folder.
        train: Trains a state to the end of its attempt, and stores it.
        begin: The start of an attempt, by its number.
        judge: Residuals of what is stored in the folder.

    Returns:
        The state that stays, and its residuals.
    """
    while True:
        state = train(state)
        residuals = judge()
        if state.other is not None:
            if not _keep_better(state, _judged(state.attempt, residuals, settings), out):
                return state, residuals
            return _restored(state, out), judge()
        why = failures(residuals.as_json() if residuals else None)
        if not why or len(state.judged) + 1 >= settings.attempts_max:
            return state, residuals
        if settings.schedule.images < JUDGED_FROM:
            return state, residuals
        ended, judged = state, _judged(state.attempt, residuals, settings)
        state = begin(ended.attempt + 1)
        state.attempt = ended.attempt + 1
        state.other = {"stored": to_dict(ended), "rows": _rows(out)}
        state.judged = [*ended.judged, judged]
        LOG.warning(
            "attempt %d failed (%s): the run begins again with %s",
            ended.attempt,
            "; ".join(why),
            _start(settings, state.attempt),
        )
        checkpoint.save(out, to_dict(state))


def are_over(stored: dict[str, Any], settings: ReconSettings, out: Path) -> bool:
    """Whether nothing is left to train: all images are used up, and no other attempt may follow."""
    if stored["images"] < settings.schedule.images:
        return False
    return settings.attempts_max == 1 or "explained" in folder.read_config(out)


def conclude(
    out: Path,
    config: dict[str, Any],
    state: Mapping[str, Any],
    residuals: Residuals | None,
) -> None:
    """Write what config.json says of a finished run, by its state and residuals at the end."""
    config |= {"seconds_reconstruct": state["seconds"], "images_optimised": state["images"]}
    config |= {name: state[name] for name in ("skipped", "restarts", "revivals") if name in state}
    if state.get("judged"):
        config["attempts"] = _as_json(state["judged"], state["attempt"])
    warn(residuals)
    folder.write_config(out, config | {"explained": residuals and residuals.as_json()})


def _as_json(judged: list[Judged], kept: int) -> list[Judged]:
    """All attempts of a run for config.json; none if there was one alone."""
    return [{**one, "kept": one["attempt"] == kept} for one in judged]


def _judged(number: int, residuals: Residuals | None, settings: ReconSettings) -> Judged:
    """An attempt that ended, and what its residuals say."""
    explained = residuals.as_json() if residuals else {}
    names = ("unexplained_share", "changing_unexplained_share", "contradicted_share")
    shares = {name: explained.get(name) for name in names}
    chi_square = float(residuals.chi_square.mean(dtype=float)) if residuals else math.inf
    known = chi_square if math.isfinite(chi_square) else None
    start = _start(settings, number)
    return {"attempt": number, "start": start, "mean_chi_square": known, **shares}


def _start(settings: ReconSettings, number: int) -> str:
    chosen = settings_of(settings, number)
    tracked = chosen.motion.kind == Nodes.kind and chosen.init.kind == Init.PHASE
    at_rest = " at rest" if tracked and not chosen.motion.from_tracks else ""
    return f"init.kind {chosen.init.kind}, motion.kind {chosen.motion.kind}{at_rest}"


def _keep_better(state: State, judged: Judged, out: Path) -> bool:
    """Record the end of the second attempt; True if the one before it was better."""
    before = state.judged[-1]
    state.judged = [*state.judged, judged]
    worse = not _chi_square(judged) < _chi_square(before)
    kept = before if worse else judged
    text = "mean chi-square %.4g of attempt %d, %.4g of attempt %d: attempt %d stays"
    pair = (value for one in (before, judged) for value in (_chi_square(one), one["attempt"]))
    LOG.warning(text, *pair, kept["attempt"])
    if not worse:
        state.other = None
        checkpoint.save(out, to_dict(state))
    return worse


def _chi_square(judged: Mapping[str, Any]) -> float:
    known = judged["mean_chi_square"]
    return math.inf if known is None else known


def _rows(out: Path) -> dict[str, str]:
    """Metrics and diagnostics of the attempt that ended."""
    return {name: (out / name).read_text() for name in ROWS if (out / name).exists()}


def _restored(state: State, out: Path) -> State:
    """The end of the first attempt, with its rows and the time of both."""
    assert state.other is not None
    device = state.optimiser.field.device
    first = from_dict(state.other["stored"], device)
    first.judged, first.seconds = state.judged, state.seconds
    for name, text in state.other["rows"].items():
        atomic_write(out / name, text.encode())
    checkpoint.save(out, to_dict(first))
    return first
