"""One job of a sweep, in whichever process: simulate a scene, or reconstruct and score it."""

from __future__ import annotations

import hashlib
import json
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data.files import atomic_path
from ..data.read import read
from ..errors import BusyError, InputError
from ..evaluate.compare import score
from ..evaluate.metrics import scored_frames
from ..evaluate.panels import Comparison, row_to_show
from ..recon.observations import data_hash, former_hash
from ..recon.settings import plain
from ..recon.suitable import check_sequence
from ..recon.train import chosen_settings, reconstruct
from ..render.cuda import forget_peak_memory, peak_memory
from ..sim.simulate import simulate
from ..terminal import as_known_error, start_warp
from .plan import Job, Plan
from .workers import Place, parent_lives

Result = dict[str, Any]
BUSY_S = 60.0  # [s] that a folder may be busy: a lost worker's process may still be ending


@dataclass(frozen=True, kw_only=True)
class Task:
    """A job with everything that its process needs."""

    job: Job
    """What to do."""
    plan: Plan
    """Of which it is a part."""
    out: Path
    """The folder of the sweep, which all processes see."""
    known: str | None = None
    """Key of a stored result of this job, which still counts if it would be the same."""


def sequence_of(job: Job, out: Path) -> Path:
    """The folder of a scene."""
    return job.scene.sequence or out / "scenes" / job.scene.name


def run_of(job: Job, out: Path) -> Path:
    """The folder of a run."""
    return out / "runs" / job.id


def picture_of(job: Job, out: Path) -> Path:
    """The images of a run that the page shows, or of the measurement it was made from."""
    return out / "pictures" / f"{job.id}.npz"


def do(task: Task, place: Place) -> Result:
    """Do a job; if its stored result still counts, return its ``id`` and ``key`` only.

    A mistake of the user, or a failure of the fit, is a result, too: ``error`` says what is wrong.
    """
    _begin(place)
    begun = time.monotonic()
    known = {"id": task.job.id, "scene": task.job.scene.name, "seed": task.job.seed}
    if task.job.row is not None:
        known["row"] = task.job.row.name
    try:
        result = _fitted(task, place) if task.job.row is not None else _simulated(task, place)
    except Exception as error:  # one job never ends the others
        result = _failure(error)
    return {**known, **result, "wall_s": time.monotonic() - begun}


def _failure(error: Exception) -> Result:
    """What a result says of an error."""
    known = as_known_error(error)
    if known is not None:
        text = " ".join(f"{known.what} - {known.where}: {known.why}".split())
        return {"error": text, "exit_code": known.exit_code}
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    return {"error": text, "exit_code": 1}


def _begin(place: Place) -> None:
    """Use as many threads as the place has CPUs; silence Warp."""
    import cv2

    start_warp()
    if place.cpus:
        torch.set_num_threads(len(place.cpus))
        cv2.setNumThreads(len(place.cpus))


def _simulated(task: Task, place: Place) -> Result:
    traced = task.plan.simulate.get("engine") == "mesh"
    given = task.job.scene.name, sequence_of(task.job, task.out)
    device = place.device if traced else "cpu"
    _patiently(lambda: simulate(*given, device=device, **task.plan.simulate))
    return {"key": _hash(dict(task.plan.simulate))}


def _fitted(task: Task, place: Place) -> Result:
    job, plan = task.job, task.plan
    assert job.row is not None
    sequence = read(sequence_of(job, task.out))
    chosen = job.row.arguments(plan.images)
    settings = chosen_settings(sequence, job.row.preset, **chosen)
    kind = torch.device(place.device).type

    def key_of(data: str | None) -> str:
        return _hash(plain(settings), job.seed, data, plan.frames, kind)

    key = key_of(data_hash(sequence))
    if task.known in (key, key_of(former_hash(sequence))):
        return {"key": task.known}
    try:
        check_sequence(sequence, settings)
    except InputError as error:  # the row of a table that has another method's
        return {"key": key, "refused": error.what, "why": error.why}
    scored_frames(sequence, plan.frames)  # before a fit that cannot be scored
    chosen |= {"seed": job.seed, "device": place.device, "progress": _while_parent_lives()}
    folder, preset = run_of(job, task.out), job.row.preset
    forget_peak_memory(place.device)  # of the job before in this process
    run = _patiently(lambda: reconstruct(sequence, folder, preset, **chosen))
    metrics, comparison = score(run, frames=plan.frames)
    _keep_picture(picture_of(job, task.out), comparison)
    memory = peak_memory(place.device)
    about = {"seconds": run.config.get("seconds_reconstruct"), "gaussians": run.gaussians}
    about |= {name: run.config[name] for name in ("assumed",) if name in run.config}
    return {"key": key, "metrics": metrics, **about, "memory_mib": memory and memory / 2**20}


def _patiently(work: Callable[[], Any]) -> Any:
    """Wait a while for a recording or a run that another process works on."""
    end = time.monotonic() + BUSY_S
    while True:
        try:
            return work()
        except BusyError:
            if time.monotonic() > end:
                raise
            time.sleep(1.0)


def _while_parent_lives():
    """A progress callback that stops a job, with a checkpoint, whose parent was killed."""

    def check(*_: object, **__: object) -> None:
        if not parent_lives():
            signal.raise_signal(signal.SIGINT)  # what is fitted is stored before it ends

    return check


def _keep_picture(path: Path, comparison: Comparison) -> None:
    """Distance, truth and closed form of the frame with the most to see, as float16 [m]."""
    s = row_to_show(comparison)
    images = {"d": comparison.views.d[s], "closed_form": comparison.views.closed_form[s]}
    if comparison.judgement is not None:
        images["error"] = np.sqrt(comparison.judgement.errors["d"][s])
        images["closed_form_error"] = np.sqrt(comparison.judgement.errors["closed_form"][s])
        images["truth"] = comparison.judgement.truth[s]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **{k: image.astype(np.float16) for k, image in images.items()})


def _hash(*values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
