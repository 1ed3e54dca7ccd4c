"""A volume fitted to the observations of a run, new or where a checkpoint was written."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from ...data.sequence import Sequence
from ...data.temporal import camera_rests
from ...errors import InputError
from .. import checkpoint
from ..observations import Observations
from ..record import Metrics
from ..settings import Method, ReconSettings
from .loop import VolumeLoop, VolumeState, begin, from_dict
from .models import VOLUMES
from .settings import PUBLISHED_STEPS
from .targets import Targets

LOG = logging.getLogger("gftorf_warp")


def check_volume(sequence: Sequence, method: Method) -> None:
    """Refuse what cannot be fitted by a volume.

    Raises:
        InputError: If no quartet is complete, or for another method than ``torf`` the camera
            moves or delivered phasors.
    """
    where, fix = sequence.path or "sequence", "use --preset torf, or best"
    if not sequence.complete_quartets:
        why = "expected all raw frames of a cycle in a row, at least once"
        fix = "check the sequence with `gftorf check`, or record longer"
        raise InputError("no complete quartet", where=where, why=why, fix=fix)
    if method == Method.TORF:
        return
    if sequence.from_phasors:
        why = f"the camera delivered phasors, and {method} compares raw frames at their own times"
        raise InputError("no raw frames", where=where, why=why, fix=fix)
    if not camera_rests(sequence):
        why = "the samples of all raw frames of a cycle are on the rays of one pose, as published"
        raise InputError("the camera moves", where=where, why=why, fix=fix)


def describe(settings: ReconSettings, changes: Iterable[str]) -> dict[str, Any]:
    """What is as published and what is not, for the log and config.json.

    Args:
        settings: How is fitted.
        changes: Settings that were changed by name, which makes them differ from published ones.
    """
    kind, steps = VOLUMES[settings.method], settings.schedule.images
    shortened = bool(kind.faithful) and steps != PUBLISHED_STEPS
    changed = list(changes) + ([f"{steps} steps"] if shortened else [])
    assumed = list(kind.assumed) + ([f"changed: {', '.join(changed)}"] if changed else [])
    for sentence in kind.faithful:
        LOG.info("%s, as published: %s", settings.method, sentence)
    for sentence in assumed:
        LOG.info("%s, assumed or different: %s", settings.method, sentence)
    return {"faithful": list(kind.faithful), "assumed": assumed}


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
        DivergedError: If the loss is not finite; the last checkpoint is kept.
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
    return VolumeLoop(targets, settings, out, metrics, clock, progress).run(state)
