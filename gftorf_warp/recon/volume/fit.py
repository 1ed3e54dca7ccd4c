"""A volume fitted to the observations of a run, new or where a checkpoint was written."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ...errors import DivergedError
from .. import checkpoint
from ..loop import SEED_STEP
from ..observations import Observations
from ..record import Metrics
from ..settings import ReconSettings
from .loop import EmptyVolumeError, VolumeLoop
from .state import VolumeState, begin, from_dict
from .step import VolumeStep
from .targets import Targets

LOG = logging.getLogger("gftorf_warp")


def fit(
    observations: Observations,
    settings: ReconSettings,
    out: Path,
    stored: dict[str, Any] | None,
    *,
    seed: int,
    clock: Callable[[], float],
    progress: Callable[..., None] | None,
) -> VolumeState:
    """Train until the steps of the settings are used up.

    Args:
        observations: What is fitted.
        settings: How.
        out: Folder of the run.
        stored: Its last checkpoint; None: a new run.
        seed: Of everything random.
        clock: Seconds spent on the run so far.
        progress: Called as ``progress(steps, steps_in_all, loss=, psnr_db=)``.

    Raises:
        DivergedError: If the loss is not finite, or the volume stays empty; the last checkpoint is
            kept.
        KeyboardInterrupt: After a signal, when everything is stored.
    """
    targets, device = Targets(observations), torch.device(observations.quads.device)
    if stored is None:
        state = begin(settings, targets, seed, device)
    else:
        with checkpoint.rebuilding(out):
            state = from_dict(out, settings, stored, device)
    metrics = Metrics(out / "metrics.jsonl")
    metrics.rewind(state.images)
    near, far = state.volume.box.bounds
    count = sum(p.numel() for p in state.volume.parameters())
    verb = "starts at" if stored is None else "goes on at"
    text = "%s %s step %d of %d, %d parameters, rays from %.3g to %.3g m"
    LOG.info(text, out, verb, state.images, settings.schedule.images, count, near, far)
    while True:
        step = VolumeStep(state, targets, settings)
        try:
            return VolumeLoop(step, out, metrics, clock, progress).run()
        except EmptyVolumeError:
            state = _begun_again(state, settings, targets, out, seed)
            metrics.rewind(-1)


def _begun_again(
    state: VolumeState, settings: ReconSettings, targets: Targets, out: Path, seed: int
) -> VolumeState:
    """Another start instead of a volume in which nothing can be learnt any more.

    Raises:
        DivergedError: If the run began again too often.
    """
    number = state.restarts + 1
    if number > settings.restarts_max:
        raise DivergedError(
            "the volume is empty",
            where=f"{out}, step {state.images}",
            why=f"hardly any ray meets anything, so hardly anything has a gradient; the run began "
            f"again {state.restarts} times",
            fix="lower the learning rate by --set volume.rate=1e-4, or start over with another "
            "--seed and --fresh",
        )
    text = "after %d steps hardly any ray meets anything: the run begins again with another seed"
    LOG.warning(text, state.images)
    again = begin(settings, targets, seed + SEED_STEP * number, state.volume.device)
    again.restarts = number
    return again
