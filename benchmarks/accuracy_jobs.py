"""The jobs of benchmarks/accuracy.py and the processes that do them.

A job prepares a scene (simulates it if its folder lacks it, and computes its edge floor) or fits a
row of the table to it with one seed and scores the fit. Jobs that differ only in what is done after
a fit are one task, with one fit. The result of a job is a dictionary for one line of JSON. Every
worker is a process that imports everything once; if a job raises, its result is the error, and so
it is for all jobs of a task that kills its process.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import time
import traceback
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import warp as wp

from gftorf_warp import Sequence, compare, reconstruct, simulate
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.flow import compute_flow
from gftorf_warp.data.read import read, read_truth
from gftorf_warp.data.texts import read_rows
from gftorf_warp.data.truth import known_distance, moving_and_static
from gftorf_warp.errors import GftorfError
from gftorf_warp.evaluate import pictures
from gftorf_warp.evaluate.metrics import ERROR_UNIT, pooled, scored_frames, squared_error
from gftorf_warp.evaluate.views import camera_at
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import data_hash, input_of
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Input, Method, ReconSettings, plain
from gftorf_warp.recon.train import CHANGES
from gftorf_warp.render.cuda import forget_peak_memory, peak_memory
from gftorf_warp.scene.changes import changed
from gftorf_warp.sim.exposure import pooled as averaged
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.random_scene import random_scene
from gftorf_warp.sweep.workers import Place

Result = dict[str, Any]
RAYS = 4  # per pixel and axis, of the edge floor
AFTER_FIT = ("fallback", "outlines")  # settings of the finished run, which change no fit
CAPTION, PANEL = 16, 240  # [px] height of the text above a picture, least width of each of its four


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of the table: a preset with changes, ``NAME=PRESET[,SETTING=VALUE...]``."""

    name: str
    """Its name in the table."""
    preset: str
    """Name of the preset."""
    changes: tuple[str, ...] = ()
    """Single settings, as ``--set`` takes them."""

    @property
    def fit(self) -> tuple[str, ...]:
        """What its fits depend on: rows of equal ones share them."""
        mine = (one for one in self.changes if one.partition("=")[0].strip() not in AFTER_FIT)
        return self.preset, *mine

    @classmethod
    def of(cls, text: str) -> Row:
        """The row of an option; ``PRESET`` alone is named after it."""
        first, *changes = text.split(",")
        name, _, preset = first.partition("=")
        if (preset or name) not in presets.PRESETS:
            known = ", ".join(presets.PRESETS)
            raise argparse.ArgumentTypeError(f"{text!r} names none of the presets {known}")
        return cls(name=name, preset=preset or name, changes=tuple(changes))


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What all jobs share."""

    out: Path
    """Folder of the benchmark."""
    size: tuple[int, int]
    """(width, height) of simulated images [px]."""
    frames: int
    """Number of simulated raw frames."""
    images: int | None
    """Length of every fit, of presets that are shortened to it; None: the presets' own."""
    device: str
    """Where to trace and to fit."""
    keep: bool = False
    """Whether the folders of runs are kept."""
    flow: bool = False
    """Whether the optical flow of simulated scenes is computed with them, once for all fits."""
    finer: Path | None = None
    """Folder with given sequences of the same names at a multiple of their size, for their edge
    floor; None: they have none."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One scene to prepare, or to fit."""

    scene: str
    """``random-N``, or the path of a sequence."""
    row: Row | None = None
    """What to fit; None: the scene is prepared."""
    seed: int = 0
    """Seed of the fit."""

    def id(self, setup: Setup) -> str:
        """What identifies its line among results: the last line of an id counts."""
        width, height = setup.size
        what = "given" if self.given else f"{width}x{height}x{setup.frames}"
        if self.row is None:
            return f"{self.title}@{what}"
        return f"{self.row.name}/{self.title}@{what}/{setup.images or 'all'}/{self.seed}"

    @property
    def given(self) -> bool:
        """Whether the scene is a folder that others made."""
        return not self.scene.startswith("random-")

    @property
    def title(self) -> str:
        """Name of the scene in tables; those of a given folder differ from ours."""
        return f"shared/{Path(self.scene).name}" if self.given else self.scene

    def folder(self, setup: Setup) -> Path:
        """Folder of the sequence."""
        if self.given:
            return Path(self.scene)
        width, height = setup.size
        drawn = _hash(repr(random_scene(self.number)))[:8]  # another if the drawing changes
        return setup.out / "scenes" / f"{self.scene}-{width}x{height}x{setup.frames}-{drawn}"

    @property
    def number(self) -> int:
        """Number of a random scene."""
        return int(self.scene.partition("-")[2])


Task = tuple[tuple[Job, str | None], ...]


class Fits:
    """Runs of the jobs of one task, whose folders :meth:`clear` removes unless they are kept."""

    def __init__(self, setup: Setup):
        self.setup = setup
        self._runs: dict[ReconSettings, Run] = {}

    def run(self, job: Job, sequence: Sequence, settings: ReconSettings) -> Run:
        """The run of a job with its settings; its fit is one from before, if there is an equal."""
        alike = replace(settings, **dict.fromkeys(AFTER_FIT, False))
        if alike not in self._runs:
            folder = self.setup.out / "runs" / job.id(self.setup).replace("/", "_")
            shutil.rmtree(folder, ignore_errors=True)
            forget_peak_memory(self.setup.device)
            given = {"seed": job.seed, "device": self.setup.device}
            self._runs[alike] = reconstruct(sequence, folder, settings, **given)
        run = self._runs[alike]
        return replace(run, config={**run.config, "settings": plain(settings)})

    def clear(self) -> None:
        """Remove the folders."""
        for run in self._runs.values() if not self.setup.keep else ():
            shutil.rmtree(run.path, ignore_errors=True)
        self._runs.clear()


def settings_of(sequence: Sequence, row: Row, images: int | None) -> ReconSettings:
    """The settings of a row for a sequence: its preset, shortened to ``images``, then changed."""
    kind = input_of(sequence, Input.AUTO)
    settings = presets.preset(row.preset, presets.Recorded.of(sequence, kind))
    if images is not None and settings.method == Method.GAUSSIANS:
        settings = presets.shortened(settings, images)
    schedule = replace(settings.schedule, checkpoint_every_s=1e9)
    settings = replace(settings, schedule=schedule, cycle=sequence.cycle)
    return changed(settings, row.changes, CHANGES)


def result_of(job: Job, setup: Setup, known: str | None, fits: Fits | None = None) -> Result | None:
    """Do a job; None if its result, of key ``known``, is still that of these settings and data."""
    begun = time.monotonic()
    if job.row is None:
        result = _prepared(job, setup, known)
    else:
        result = _fitted(job, setup, known, fits or Fits(setup))
    if result is None:
        return None
    return {"id": job.id(setup), "scene": job.title, "seed": job.seed, **result} | {
        "wall_s": time.monotonic() - begun
    }


def _prepared(job: Job, setup: Setup, known: str | None) -> Result | None:
    """Simulate; the edge floor, and the share of pixels that move."""
    folder, floor, about = job.folder(setup), None, ""
    if not job.given:
        scene = random_scene(job.number)
        how = {"size": setup.size, "frames": setup.frames, "engine": "mesh", "seed": job.number}
        simulate(scene, folder, device=setup.device, **how)
        if setup.flow:
            _store_flow(folder)
        about = f"{scene.motion}; {scene.description}"
    sequence = _sequence(folder)
    finer = None if setup.finer is None else setup.finer / folder.name
    key = _hash("scene", data_hash(sequence), RAYS, job.given and finer)
    if key == known:
        return None
    frames = scored_frames(sequence)[:: sequence.cycle]
    truth = _true_distance(folder)
    moving, static = moving_and_static(truth, frames, cycle=sequence.cycle)
    masks = {"all": np.ones_like(moving), "moving": moving, "static": static}
    mixed = None
    if not job.given:
        mixed = _mixed(scene, setup, sequence.times[frames])
    elif finer is not None:
        fine = _true_distance(finer)[frames]
        mixed = averaged(fine, fine.shape[1] // truth.shape[1])
    if mixed is not None:
        error = squared_error(mixed, truth[frames])
        floor = {name: _x100(pooled(error, mask)) for name, mask in masks.items()}
    return {"key": key, "floor": floor, "about": about, "moving_share": float(moving.mean())}


def _store_flow(folder: Path) -> None:
    """The flow that a fit would compute, in its sequence: the same for sizes that it keeps."""
    sequence = _sequence(folder)
    if sequence.flow.forward or sequence.flow.backward:
        return
    flow = compute_flow(sequence)
    for images, name in ((flow.backward, "backward_flow_2"), (flow.forward, "forward_flow_2")):
        (folder / name).mkdir(exist_ok=True)
        for n, image in images.items():
            np.save(folder / name / f"flow_{n:04d}.npy", image)
    _sequence.cache_clear()


def _mixed(scene: Any, setup: Setup, times: np.ndarray) -> np.ndarray:
    """True distance as the mean over a pixel's area [m]: what no sharper image than ours has."""

    def camera_at(seconds: float):
        return scene.camera(setup.size, seconds).finer(RAYS)

    engine = MeshEngine(scene, camera_at, device=setup.device)
    hits = (engine.first_hits(float(seconds)).distance for seconds in times)
    return np.stack([averaged(distance, RAYS) for distance in hits])


def _fitted(job: Job, setup: Setup, known: str | None, fits: Fits) -> Result | None:
    """Fit and score."""
    assert job.row is not None
    sequence = _sequence(job.folder(setup))
    settings = settings_of(sequence, job.row, setup.images)
    kind = torch.device(setup.device).type
    key = _hash(plain(settings), job.seed, data_hash(sequence), kind)
    if key == known:
        return None
    run = fits.run(job, sequence, settings)
    scores = compare(run, report=False)
    _draw(job, setup, run, sequence, scores)
    peak = peak_memory(setup.device)
    result = {
        "row": job.row.name,
        "key": key,
        "scores": scores,
        "seconds": run.config["seconds_reconstruct"],
        "gaussians": run.gaussians,
        "rise": _rise(run.path),
        "attempts": len(run.config.get("attempts", [1])),
        "memory_mib": peak and peak / 2**20,
    }
    return result


def _rise(folder: Path) -> float | None:
    """Error of d at the end of a run over the least along it [1]; None without diagnostics."""
    rows = read_rows(folder / "diagnostics.jsonl")
    errors = [error for row in rows if (error := row.get("d_mse_x100"))]
    return errors[-1] / min(errors) if errors else None


def _draw(job: Job, setup: Setup, run: Run, sequence: Sequence, scores: Result) -> None:
    """A picture of the raw frame in the middle: truth, closed form, d and the error of d."""
    frames = scored_frames(sequence)
    n = frames[len(frames) // 2]
    seconds = float(sequence.times[n])
    rendering = run.renderer(("distance", "opacity"))(seconds, camera_at(run, sequence, seconds))
    d, closed = (
        rendering.distance.cpu().numpy(),
        closed_form_distance(sequence, n // sequence.cycle),
    )
    truth = _true_distance(job.folder(setup))[n]
    error = np.abs(d - truth)
    scale, errors = pictures.distance_scale([truth]), pictures.error_scale([np.abs(closed - truth)])
    panels = [pictures.colour_mapped(image, scale) for image in (truth, closed, d)]
    panels.append(pictures.colour_mapped(error, errors))
    times = max(1, round(PANEL / truth.shape[1]))
    panels = [panel.repeat(times, 0).repeat(times, 1) for panel in panels]
    strip = cv2.cvtColor(pictures.side_by_side(panels), cv2.COLOR_RGB2BGR)
    strip = cv2.copyMakeBorder(strip, CAPTION, 0, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    ratio = scores["d_mse_x100"] / scores["closed_form_mse_x100"]
    assert job.row is not None
    text = f"{job.row.name} {job.title} seed {job.seed}: d / closed form {ratio:.3f}; truth, "
    text += (
        f"closed form, d ({scale.low:.1f} to {scale.high:.1f} m), |error| to {errors.high:.2f} m"
    )
    cv2.putText(strip, text, (2, CAPTION - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1)
    path = picture_of(job.id(setup), setup.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), strip)


def picture_of(id: str, out: Path) -> Path:
    """Path of the picture of a fit."""
    return out / "pictures" / f"{id.replace('/', '_')}.png"


@lru_cache(maxsize=1)
def _sequence(folder: Path) -> Sequence:
    return read(folder)


@lru_cache(maxsize=1)
def _true_distance(folder: Path) -> np.ndarray:
    """[F, H, W] true distance [m]."""
    truth = read_truth(_sequence(folder))
    if truth is None:
        raise ValueError(f"{folder} holds no true distance")
    return known_distance(truth)


def _x100(error: float | None) -> float | None:
    return None if error is None else ERROR_UNIT * error


def _hash(*values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Work:
    """What a process does with a task: (job, key of its known result) of jobs that share a fit."""

    setup: Setup
    """Of all jobs."""

    def __call__(self, task: Task, place: Place) -> list[Result | None]:
        """Do the jobs: a result each, None if there is nothing to do, the error if one fails."""
        torch.set_num_threads(max(len(place.cpus), 1))
        cv2.setNumThreads(max(len(place.cpus), 1))
        wp.config.log_level = wp.LOG_ERROR
        setup = replace(self.setup, device=place.device)
        fits = Fits(setup)
        try:
            return [self._result(job, setup, known, fits) for job, known in task]
        finally:
            fits.clear()

    def _result(self, job: Job, setup: Setup, known: str | None, fits: Fits) -> Result | None:
        try:
            return result_of(job, setup, known, fits)
        except GftorfError as error:
            why = " ".join(f"{type(error).__name__}: {error}".split())
        except Exception as error:  # a job never ends the benchmark
            where = traceback.extract_tb(error.__traceback__)[-1]
            why = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        return failure(job, self.setup, why)


def failure(job: Job, setup: Setup, why: str) -> Result:
    """The result of a job that failed."""
    row = {} if job.row is None else {"row": job.row.name}
    return {"id": job.id(setup), "scene": job.title, "seed": job.seed, **row, "error": why}
