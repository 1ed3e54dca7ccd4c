"""Reconstruction: steps until the images are used up, in a folder that survives interruptions."""

from __future__ import annotations

import contextlib
import enum
import functools
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch

from ..data.decode import unambiguous_range
from ..data.estimates import DC_TOLERANCE, dc_offset
from ..data.read import read, read_truth
from ..data.sequence import Sequence, Truth
from ..errors import DivergedError, InputError, UsageError
from ..render.buffers import available_threads
from ..scene.changes import Wording, changed
from . import checkpoint, darkness, dead, folder, presets
from .captured import steps_of
from .config import config_of
from .diagnostics import Watch
from .observations import Observations, input_of, observe
from .record import Metrics, log_to
from .run import Run
from .settings import FlowSource, Input, Method, ReconSettings
from .state import State, begin, from_dict, to_dict
from .step import pool, threads_for

LOG = logging.getLogger("gftorf_warp")
OTHER_SEED = 1_000_003  # between the seeds of one run, far from those that somebody counts up
Progress = Callable[..., None]
Choice = TypeVar("Choice", bound=enum.StrEnum)
CHANGES = Wording(
    option="--set",
    example="init.reflectivity=0.5",
    where="config.json",
    fixed=("preset", "ablation", "method", "cycle"),
)  # these have options of their own, or follow from one


def reconstruct(
    sequence: Sequence | str | Path,
    out: str | Path,
    settings: ReconSettings | str = "demo",
    *,
    images: int | None = None,
    input: Input | str = Input.AUTO,
    ablation: str | None = None,
    flow: FlowSource | str | None = None,
    changes: Iterable[str] = (),
    seed: int = 0,
    device: torch.device | str = "cpu",
    fresh: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Fit moving Gaussians to the raw quads of a sequence.

    Reads quads, calibration, poses, flow and colour. Truth, where a sequence has it, is read only to be written beside
    the run, in diagnostics.jsonl: it changes nothing. A folder that holds the same run goes on where it
    stopped, to the same bytes on a CPU as if it had never stopped; Ctrl-C and SIGTERM finish the step and store it.

    Args:
        sequence: What was recorded, or its folder.
        out: Folder of the run: config.json, metrics.jsonl, diagnostics.jsonl, run.log, ckpt/.
        settings: How, or the name of a preset.
        images: Raw frames to optimise, each as often as its turn comes; None: as the settings say.
        input: What is compared with the sensor: auto, quads or phasor; counts where ``settings`` is a name.
        ablation: Row of the ablation table to apply: nobias, dd, h1, h1h2 or h1h2dd; None: none.
        flow: Where optical flow comes from: auto, file, dis, deepflow or none; None: as the settings say.
        changes: Single settings to change, as texts like ``init.reflectivity=0.5``, after everything else.
        seed: Of everything random.
        device: Where to compute, 'cpu' or a CUDA device.
        fresh: Whether to move what ``out`` holds aside, to ``out/old-<k>``, and start over.
        progress: Called as ``progress(images, images_in_all, loss=, psnr_db=, gaussians=)`` now and then.

    Returns:
        The finished run.

    Raises:
        InputError: If the sequence cannot be read or cannot start a reconstruction.
        UsageError: If ``out`` holds something else or other settings, or a preset or source of flow is unknown.
        BusyError: If another process works on ``out``.
        DivergedError: If loss or gradient stay infinite; the last good checkpoint is kept.
        KeyboardInterrupt: After a signal, when everything is stored.
    """
    begun = time.monotonic()
    if not isinstance(sequence, Sequence):
        sequence = read(sequence)
    if isinstance(settings, str):
        found = input_of(sequence, _choice(Input, input, "--input"))
        recorded = presets.Recorded(input=found, unambiguous_range=unambiguous_range(sequence))
        settings = presets.preset(settings, recorded)
    if ablation is not None:
        settings = presets.ablated(settings, ablation)
    if images is not None and settings.method == Method.GAUSSIANS:
        settings = replace(settings, schedule=replace(settings.schedule, images=images))
    if flow is not None:
        settings = replace(settings, flow=_choice(FlowSource, flow, "--flow"))
    changes = list(changes)
    settings = changed(settings, changes, CHANGES)
    settings = replace(settings, cycle=sequence.cycle)
    out = Path(out)
    config = config_of(sequence, settings, seed=seed, device=device)
    config |= {"flow": None if flow is None else str(flow), "changes": changes}
    with folder.locked(out):
        goes_on = folder.prepare(out, config, fresh=fresh)
        with log_to(out / "run.log"):
            _run(sequence, out, settings, config, seed, device, goes_on, begun, progress)
        return Run.open(out, device)


def _choice(kind: type[Choice], name: str, option: str) -> Choice:
    """The member of an enumeration that a user named.

    Raises:
        UsageError: If there is none.
    """
    known = [str(member) for member in kind]
    if name not in known:
        what = option.lstrip("-")
        why = f"there are {', '.join(known)}"
        raise UsageError(f"unknown {what} {name}", where=option, why=why, fix=f"use {option} {known[0]}")
    return kind(name)


def _run(sequence, out, settings, config, seed, device, goes_on, begun, progress) -> None:
    if settings.method == Method.CTOF:
        scale = {"quad_scale": 1.0, "quad_scale_source": "nothing is scaled", "flow_source": "none"}
        size = {"size_optimised": [sequence.width, sequence.height], "input": str(input_of(sequence, settings.input))}
        folder.write_config(out, config | scale | size | {"seconds_reconstruct": 0.0, "images_optimised": 0})
        LOG.info("%s is finished: the closed form needs no image", out)
        return
    stored = checkpoint.last(out, device) if goes_on else None
    total = settings.schedule.images
    if stored is not None and stored["images"] >= total:
        LOG.info("%s is finished: %d images", out, stored["images"])
        return
    observations = observe(sequence, settings, device)
    _warn_of_constant_part(sequence)
    _warn_of_rows(sequence)
    state = from_dict(stored, device) if stored is not None else begin(observations, settings, seed=seed, device=device)
    earlier = state.seconds
    config |= {
        "quad_scale": observations.quad_scale,
        "quad_scale_source": observations.quad_scale_source,
        "flow_source": observations.flow_source,
        "input": str(Input.PHASOR if observations.phasors else Input.QUADS),
        "colour_scale": observations.colour_scale,
        "size_optimised": [observations.sequence.width, observations.sequence.height],
    }
    folder.write_config(out, config)
    metrics = Metrics(out / "metrics.jsonl")
    watch = Watch(observations, _truth(sequence), out / "diagnostics.jsonl")
    for record in (metrics, watch):
        record.rewind(state.images)
    verb = "goes on at" if stored is not None else "starts at"
    moving = int((state.optimiser.layer > 0).sum()) if state.optimiser.layer is not None else 0
    count = len(state.optimiser.field)
    LOG.info("%s %s image %d of %d, %d Gaussians, %d of them moving", out, verb, state.images, total, count, moving)
    if total <= settings.schedule.warm_up:
        LOG.warning("nothing will move: the warm-up takes %d images, the run %d", settings.schedule.warm_up, total)

    def clock() -> float:
        return earlier + time.monotonic() - begun

    loop = _Loop(observations, settings, seed, out, device, metrics, watch, clock, progress)
    state = loop.until_done(state)
    folder.write_config(
        out,
        config
        | {
            "seconds_reconstruct": state.seconds,
            "images_optimised": state.images,
            "skipped": state.skipped,
            "restarts": state.restarts,
            "revivals": state.revivals,
        },
    )
    LOG.info("%s is finished: %d images, %.1f s", out, state.images, state.seconds)


def _warn_of_constant_part(sequence: Sequence) -> None:
    """Quads that hold more or less constant light than calibration says cannot be fitted (method, mistake 17)."""
    if sequence.from_phasors or not sequence.complete_quartets:
        return
    found = dc_offset(sequence)
    if abs(found - sequence.calibration.dc_offset) > DC_TOLERANCE:
        text = "the quads hold a constant part of %.2f amplitudes, the calibration says %.2f: see `gftorf check`"
        LOG.warning(text, found, sequence.calibration.dc_offset)


def _warn_of_rows(sequence: Sequence) -> None:
    """A rolling shutter is fitted as a global one."""
    delay = float(sequence.calibration.settings.get("row_time_s", 0.0) or 0.0)
    if delay > 0:
        text = "a rolling shutter: the last row is %.3g ms later than the first, and fitted to its time all the same"
        LOG.warning(text, 1e3 * delay * (sequence.height - 1))


def _truth(sequence: Sequence) -> Truth | None:
    """Ground truth for the diagnostics; None if there is none, or none that can be read, which stops no run."""
    try:
        return read_truth(sequence)
    except InputError as error:
        LOG.warning("diagnostics go without truth: %s: %s", error.where, error.what)
        return None


class _Loop:
    """Steps, rows of metrics, checkpoints, and the way back when numbers leave the finite."""

    def __init__(
        self,
        observations: Observations,
        settings: ReconSettings,
        seed: int,
        out: Path,
        device: torch.device | str,
        metrics: Metrics,
        watch: Watch,
        clock: Callable[[], float],
        progress: Progress | None,
    ):
        self.observations, self.seed, self.out, self.device = observations, seed, out, device
        self.settings, self.workers = threads_for(settings, device, available_threads())
        self.metrics, self.watch, self.clock, self.progress = metrics, watch, clock, progress
        self.judged_at = darkness.judged_at(settings)
        self.saved_at = clock()

    def until_done(self, state: State) -> State:
        total = self.settings.schedule.images
        if state.images == 0:
            self.save(state)
            self.watch.look(state, self.settings)
        with _one_torch_thread(self.device), pool(self.workers) as threads, _signals() as stop:
            run_all = threads.map if self.workers > 1 else map
            steps = steps_of(state, self.observations, self.settings, run_all)
            while state.images < total:
                before = state.images
                broken = steps.step()
                if broken is not None:
                    LOG.warning("step at image %d skipped, not finite: %s", state.images, broken)
                elif not (self.is_due(before, state.images) or stop.is_set()):
                    continue
                seen = self.watch.begin(state, self.settings) if self.watch.due(before, state.images, total) else None
                died = seen is not None and state.images < total and dead.is_dead(state, self.settings)
                failures = steps.collect()  # waits for the steps
                if failures >= self.settings.failures_max:
                    state = self.go_back(state, broken)
                    steps = steps_of(state, self.observations, self.settings, run_all)
                    continue
                every = self.settings.schedule.log_every
                if state.images // every > before // every or state.images >= total:
                    self.report(state)
                if self.judged_at is not None and before < self.judged_at <= state.images and self.is_dark(state):
                    state = self.begin_again(state)
                    steps = steps_of(state, self.observations, self.settings, run_all)
                    continue
                if seen is not None:
                    self.watch.finish(seen, state, self.settings)
                    if died:
                        dead.revive(state, self.settings)
                if stop.is_set():
                    self.save(state)
                    LOG.info("interrupted at image %d of %d, stored", state.images, total)
                    raise KeyboardInterrupt
                if self.saving_is_due and not failures:
                    self.save(state)
        self.save(state)
        return state

    def is_due(self, before: int, after: int) -> bool:
        """Whether there is anything to be done besides the next step."""
        every, total = self.settings.schedule.log_every, self.settings.schedule.images
        return after // every > before // every or self.watch.due(before, after, total) or self.saving_is_due

    @property
    def saving_is_due(self) -> bool:
        """Whether the last checkpoint is old."""
        return self.clock() - self.saved_at > self.settings.schedule.checkpoint_every_s

    def save(self, state: State) -> None:
        state.seconds = self.saved_at = self.clock()
        checkpoint.save(self.out, to_dict(state))

    def report(self, state: State) -> None:
        """One row of metrics: means over the images since the last one."""
        read = torch.stack([*state.sums.values()]).tolist() if state.sums else []  # at once
        sums, state.sums = dict(zip(state.sums, read, strict=True)), {}
        count = sums.pop("count", 0.0)
        if not count:
            return
        means = {name: value / count for name, value in sums.items()}
        mse = means.pop("quad_mse")
        psnr = 10.0 * math.log10(self.peak**2 / mse) if mse > 0 else None
        row: dict[str, float | int | None] = {"images": state.images, "seconds": self.clock()}
        row |= {"loss": means.pop("loss"), **means}
        row |= {"gaussians": len(state.optimiser.field), "quad_psnr_db": psnr}
        self.metrics.add(row)
        if self.progress is not None:
            total, shown = self.settings.schedule.images, {"loss": row["loss"], "psnr_db": psnr}
            self.progress(state.images, total, **shown, gaussians=row["gaussians"])

    @functools.cached_property
    def peak(self) -> float:
        """Largest absolute value of what is compared, in the units of the optimisation."""
        shown = self.observations
        measured = {0: shown.quads[torch.as_tensor(shown.sequence.measured)]}
        images = shown.phasors or (measured if self.settings.weights.quads > 0 else shown.colour)
        return max(float(image.abs().max()) for image in images.values())

    def is_dark(self, state: State) -> bool:
        """Whether the run sees nothing and may begin again; if it may not, the log says so."""
        losses = [float(row["quads"] or 0.0) for row in self.metrics.rows()]
        if not darkness.is_dark(losses, self.observations, self.settings):
            return False
        again = state.restarts < self.settings.restarts_max
        then = "begins again with another seed" if again else "goes on all the same"
        LOG.warning("after %d images the loss is still that of black images: %s", state.images, then)
        return again

    def begin_again(self, state: State) -> State:
        """Another random start, with the time and the failures of those before."""
        number = state.restarts + 1
        anew = begin(self.observations, self.settings, seed=self.seed + OTHER_SEED * number, device=self.device)
        anew.restarts, anew.skipped, anew.rollbacks = number, state.skipped, state.rollbacks
        for record in (self.metrics, self.watch):
            record.rewind(-1)
        self.save(anew)
        self.watch.look(anew, self.settings)
        return anew

    def go_back(self, state: State, broken: dict[str, float] | None) -> State:
        """The last good checkpoint, with halved rates.

        Raises:
            DivergedError: If that has been done too often.
        """
        if state.rollbacks >= self.settings.rollbacks_max:
            raise DivergedError(
                "the optimisation diverged",
                where=f"{self.out}, image {state.images}",
                why=f"{self.settings.failures_max} steps in a row were not finite after {state.rollbacks} returns to a "
                f"checkpoint: {broken or 'found late'}, {len(state.optimiser.field)} Gaussians",
                fix="check the sequence with `gftorf check`, or lower the learning rates",
            )
        stored = checkpoint.last(self.out, self.device)
        assert stored is not None, "a checkpoint is written before the first step"
        restored = from_dict(stored, self.device)
        restored.rate_factor = 0.5 * state.rate_factor
        restored.rollbacks, restored.skipped = state.rollbacks + 1, state.skipped
        for record in (self.metrics, self.watch):
            record.rewind(restored.images)
        LOG.warning("back to image %d with rates times %g", restored.images, restored.rate_factor)
        return restored


@contextlib.contextmanager
def _one_torch_thread(device: torch.device | str) -> Iterator[None]:
    """Small tensors are fastest on one thread, and their sums do not depend on the number of cores then."""
    before = torch.get_num_threads()
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _signals() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C or SIGTERM sets; the second one acts at once. Other threads get no signals."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def first(*_) -> None:
        stop.set()
        for number in numbers:
            signal.signal(number, before[number])

    for number in numbers:
        signal.signal(number, first)
    try:
        yield stop
    finally:
        for number in numbers:
            signal.signal(number, before[number])
