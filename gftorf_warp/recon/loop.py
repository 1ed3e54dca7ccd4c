"""The training loop: steps, metrics, diagnostics, checkpoints, restarts.

When losses or gradients are not finite for several steps, it returns to the last checkpoint.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from ..errors import DivergedError
from ..render.buffers import available_threads
from . import checkpoint, collapse
from .diagnostics import Diagnostics, Row
from .interruption import interruption, signals
from .observations import Observations
from .record import Metrics
from .settings import ReconSettings
from .state import State, begin, from_dict, to_dict
from .stepper import Stepper

LOG = logging.getLogger("gftorf_warp")
SEED_STEP = 1_000_003  # between the seeds of restarts, far from seeds that are counted up
Progress = Callable[..., None]
LATE = (
    0.9  # share of a run after which a checkpoint is due: short runs have no other before the end
)
SHOWN = {"loss": "loss", "psnr_db": "quad_psnr_db", "gaussians": "gaussians"}  # as progress


class TrainingLoop:
    """Trains one state to the end of its run, in its folder."""

    def __init__(
        self,
        observations: Observations,
        settings: ReconSettings,
        seed: int,
        out: Path,
        metrics: Metrics,
        diagnostics: Diagnostics,
        clock: Callable[[], float],
        progress: Progress | None,
    ):
        """Store the arguments; :meth:`run` trains.

        Args:
            observations: What is fitted.
            settings: How. On a CPU every image has one thread: no result depends on the number of
                cores.
            seed: Of the run.
            out: Its folder.
            metrics: Rows of metrics.jsonl.
            diagnostics: Rows of diagnostics.jsonl.
            clock: Seconds spent on the run so far.
            progress: Called as ``progress(images, images_in_all, loss=, psnr_db=, gaussians=)``.
        """
        self.observations, self.settings, self.seed, self.out = observations, settings, seed, out
        self.device = observations.quads.device
        self.metrics, self.diagnostics = metrics, diagnostics
        self.clock, self.progress = clock, progress
        self.checked_at = collapse.veil_checked_at(settings)
        self.peak, self.saved_at = peak_of(observations, settings), clock()

    def run(self, state: State) -> State:
        """Train until the images are used up; returns the final state.

        Raises:
            DivergedError: If losses or gradients stay non-finite.
            KeyboardInterrupt: After a signal, when everything is stored.
        """
        total = self.settings.schedule.images
        if state.images == 0:
            self.save(state)
            self.diagnostics.add(state, self.settings)
        with (
            one_torch_thread(self.device),
            image_threads(self.device) as map_images,
            signals() as stop,
        ):
            stepper = self.stepper(state, map_images)
            while state.images < total:
                before = state.images
                stepper.step()
                if not (self.is_due(before, state.images) or stop):
                    continue
                rendered = died = None
                # launched before the device is waited for
                if self.diagnostics.due(before, state.images, total):
                    rendered = self.diagnostics.render(state, self.settings)
                    if state.images < total:
                        died = collapse.has_dead_network(state, self.settings)
                failures = stepper.collect()  # waits
                if failures >= self.settings.failures_max:
                    state = self.go_back(state)
                    stepper = self.stepper(state, map_images)
                    continue
                every = self.settings.schedule.log_every
                if state.images // every > before // every or state.images >= total:
                    self.report(state)
                if (
                    self.checked_at is not None
                    and before < self.checked_at <= state.images
                    and restarts(state, self.metrics, self.observations, self.settings)
                ):
                    state = self.restart(state)
                    stepper = self.stepper(state, map_images)
                    continue
                if rendered is not None:
                    self.diagnostics.write(rendered, state, self.settings)
                    if died:
                        collapse.revive(state, self.settings)
                if stop:
                    self.save(state)
                    LOG.info("interrupted at image %d of %d, stored", state.images, total)
                    raise interruption(stop)
                if self.saving_is_due(before, state.images) and not failures:
                    self.save(state)
        self.save(state)
        return state

    def stepper(self, state: State, map_images: Callable) -> Stepper:
        """Training steps of a state."""
        return Stepper(state, self.observations, self.settings, map_images=map_images)

    def is_due(self, before: int, after: int) -> bool:
        """Whether anything but the next step is due."""
        every, total = self.settings.schedule.log_every, self.settings.schedule.images
        noted = after // every > before // every or self.diagnostics.due(before, after, total)
        return noted or self.saving_is_due(before, after)

    def saving_is_due(self, before: int, after: int) -> bool:
        """Whether the last checkpoint is old, or the run is nearly over."""
        old = self.clock() - self.saved_at > self.settings.schedule.checkpoint_every_s
        return old or is_late(before, after, self.settings.schedule.images)

    def save(self, state: State) -> None:
        """Write a checkpoint."""
        state.seconds = self.saved_at = self.clock()
        checkpoint.save(self.out, to_dict(state))

    def report(self, state: State) -> None:
        """Write one row of metrics: means over the images since the last one."""
        row = row_of_sums(state, self.peak, self.clock())
        if row is not None:
            self.metrics.add(row)
            if self.progress is not None:
                shown = {name: row[key] for name, key in SHOWN.items()}
                self.progress(state.images, self.settings.schedule.images, **shown)

    def restart(self, state: State) -> State:
        """Another random start, which keeps the time and the failures of the one before."""
        number = state.restarts + 1
        seed = self.seed + SEED_STEP * number
        fresh = begin(self.observations, self.settings, seed=seed, device=self.device)
        _begin_again(fresh, state)
        for rows in (self.metrics, self.diagnostics):
            rows.rewind(-1)
        self.save(fresh)
        self.diagnostics.add(fresh, self.settings)
        return fresh

    def go_back(self, state: State) -> State:
        """The last good checkpoint, with halved rates.

        Raises:
            DivergedError: If that has been done too often.
        """
        if state.rollbacks >= self.settings.rollbacks_max:
            raise _diverged(state, self.settings, self.out)
        stored = checkpoint.last(self.out, self.device)
        assert stored is not None, "a checkpoint is written before the first step"
        restored = from_dict(stored, self.device)
        restored.rate_factor = 0.5 * state.rate_factor
        restored.rollbacks, restored.skipped = state.rollbacks + 1, state.skipped
        for rows in (self.metrics, self.diagnostics):
            rows.rewind(restored.images)
        text = "back to the checkpoint at image %d, learning rates times %g"
        LOG.warning(text, restored.images, restored.rate_factor)
        return restored


def is_late(before: int, after: int, total: int) -> bool:
    """Whether a run of so many images is nearly over, from this step on."""
    return before < math.ceil(LATE * total) <= after < total


def restarts(
    state: State, metrics: Metrics, observations: Observations, settings: ReconSettings
) -> bool:
    """Whether the run collapsed to a veil and may restart; if it may not, the log says so."""
    losses = [float(row.get("quads") or 0.0) for row in metrics.rows()]
    if not collapse.is_veiled(losses, observations, settings):
        return False
    again = state.restarts < settings.restarts_max
    then = "restarts with another seed" if again else "continues: it was restarted too often"
    LOG.warning(
        "after %d images the loss is still that of black images: the run %s", state.images, then
    )
    return again


def _begin_again(fresh: State, state: State) -> None:
    """Copy to a new start what is kept of the state that it replaces."""
    fresh.restarts = state.restarts + 1
    for name in ("skipped", "rollbacks", "attempt", "judged", "other"):
        setattr(fresh, name, getattr(state, name))


def row_of_sums(state: State, peak: float, seconds: float) -> Row | None:
    """A row of metrics: means over the images of the sums of a state, which begin again; None if
    there were no images.
    """
    values = torch.stack([*state.sums.values()]).tolist() if state.sums else []  # one transfer
    sums, state.sums = dict(zip(state.sums, values, strict=True)), {}
    count = sums.pop("count", 0.0)
    if not count:
        return None
    means = {name: value / count for name, value in sums.items()}
    mse = means.pop("quad_mse")
    row: Row = {"images": state.images, "seconds": seconds, "loss": means.pop("loss"), **means}
    row |= {} if state.attempt == 1 else {"attempt": state.attempt}
    psnr = 10.0 * math.log10(peak**2 / mse) if mse > 0 else None
    return row | {"gaussians": len(state.optimiser.field), "quad_psnr_db": psnr}


def peak_of(observations: Observations, settings: ReconSettings) -> float:
    """Largest absolute value of what is compared, in the units of the optimisation."""
    images = observations.colour.images
    if settings.weights.quads > 0:
        measured = torch.as_tensor(observations.sequence.measured).to(observations.quads.device)
        phasors = observations.phasors
        images = phasors.images if phasors else observations.quads[measured]
    return float(images.abs().max())


def _diverged(state: State, settings: ReconSettings, out: Path) -> DivergedError:
    return DivergedError(
        "the optimisation diverged",
        where=f"{out}, image {state.images}",
        why=f"loss or gradient of {settings.failures_max} steps in a row were not finite after "
        f"{state.rollbacks} returns to a checkpoint, {len(state.optimiser.field)} Gaussians",
        fix="check the sequence with `gftorf check`, or lower the learning rates",
    )


@contextlib.contextmanager
def image_threads(device: torch.device) -> Iterator[Callable]:
    """``map`` over the images of a batch: on a CPU by a pool of threads."""
    threads = available_threads() if device.type == "cpu" else 1
    if threads == 1:
        yield map
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="gftorf-images") as pool:
        yield pool.map


@contextlib.contextmanager
def one_torch_thread(device: torch.device) -> Iterator[None]:
    """One thread of torch on a CPU: fastest for small tensors,
    and sums do not depend on the machine.
    """
    before = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
