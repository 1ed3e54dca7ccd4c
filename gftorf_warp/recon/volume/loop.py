"""Training of a volume in the folder of its run: steps, metrics, checkpoints."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path

import torch

from ...errors import DivergedError
from .. import checkpoint
from ..interruption import interruption, signals
from ..loop import is_late, peak_of
from ..record import Metrics
from .state import VolumeState
from .step import VolumeStep

LOG = logging.getLogger("gftorf_warp")


EMPTY = 0.01  # [1] mean opacity of a volume below which it is empty


class EmptyVolumeError(Exception):
    """Hardly any ray met anything since the last row of metrics, noise on the densities included:
    so hardly anything has a gradient. What is closed behind is opaque elsewhere.
    """


class VolumeLoop:
    """Trains a volume until its steps are used up."""

    def __init__(
        self,
        step: VolumeStep,
        out: Path,
        metrics: Metrics,
        clock: Callable[[], float],
        progress: Callable[..., None] | None,
    ):
        """Take note of everything; :meth:`run` trains.

        Args:
            step: Of the state that is trained, with what is fitted and how.
            out: Folder of the run.
            metrics: Rows of metrics.jsonl.
            clock: Seconds spent on the run so far.
            progress: Called as ``progress(steps, steps_in_all, loss=, psnr_db=)``.
        """
        settings = step.settings
        assert settings.volume is not None, "presets of volumes have it"
        self.state, self.settings, self.options, self.out = (
            step.state,
            settings,
            settings.volume,
            out,
        )
        self._step = step
        self.metrics, self.clock, self.progress = metrics, clock, progress
        self.peak, self.saved_at = peak_of(step.targets.observations, settings), clock()

    def run(self) -> VolumeState:
        """Train the state to its end.

        Raises:
            DivergedError: If the loss is not finite; the last checkpoint is kept.
            EmptyVolumeError: If nothing can be learnt any more.
            KeyboardInterrupt: After a signal, when everything is stored.
        """
        state, schedule = self.state, self.settings.schedule
        if state.images == 0:
            self.save()
        with signals() as stop:
            while state.images < schedule.images:
                before = state.images
                self.step()
                whole = state.images % self.options.accumulated == 0
                ended = state.images >= schedule.images
                if state.images % schedule.log_every == 0 or ended:
                    self.report()
                if not (whole or ended):  # a checkpoint holds no gradients
                    continue
                if stop:
                    self.save()
                    text = "interrupted at step %d of %d, stored"
                    LOG.info(text, state.images, schedule.images)
                    raise interruption(stop)
                old = self.clock() - self.saved_at > schedule.checkpoint_every_s
                late = is_late(before, state.images, schedule.images)
                if ended or old or late:
                    self.save()
        return state

    def step(self) -> None:
        """Gradients of one batch of rays; every few of them, an update."""
        state = self.state
        self._step.run(state.images)
        state.images += 1
        if state.images % self.options.accumulated == 0 or (
            state.images >= self.settings.schedule.images
        ):
            self.update()

    def update(self) -> None:
        """One step of Adam."""
        state = self.state
        passed = state.images / self.options.rate_tenth_after
        for group in state.optimiser.param_groups:
            group["lr"] = self.options.rate * 0.1**passed
        state.scaler.unscale_(state.optimiser)
        if self.options.gradient_max is not None:
            torch.nn.utils.clip_grad_value_(state.volume.parameters(), self.options.gradient_max)
        state.scaler.step(state.optimiser)
        state.scaler.update()
        state.optimiser.zero_grad(set_to_none=False)  # graphs add to the same memory

    def report(self) -> None:
        """One row of metrics: means over the steps since the last one that had each term.

        Raises:
            DivergedError: If the loss is not finite.
            EmptyVolumeError: If nothing can be learnt any more.
        """
        state = self.state
        sums = [state.sums[name] for name in state.counts]
        values = torch.stack(sums).tolist()  # one transfer
        counted = zip(state.counts.items(), values, strict=True)
        means = {name: value / count for (name, count), value in counted}
        torch._foreach_zero_(sums)
        state.counts.clear()
        if not math.isfinite(means["loss"]):
            raise self._diverged("the loss is not finite")
        if means.get("opacity", 1.0) < EMPTY:
            raise EmptyVolumeError
        mse = means.pop("quad_mse", 0.0)
        psnr = 10.0 * math.log10(self.peak**2 / mse) if mse > 0 else None
        row = {"images": state.images, "seconds": self.clock(), **means, "quad_psnr_db": psnr}
        self.metrics.add(row)
        if self.progress is not None:
            total = self.settings.schedule.images
            self.progress(state.images, total, loss=row["loss"], psnr_db=psnr)

    def save(self) -> None:
        """Write a checkpoint.

        Raises:
            DivergedError: If a parameter is not finite, before a row of metrics tells.
        """
        state = self.state
        if not all(bool(value.isfinite().all()) for value in state.volume.parameters()):
            raise self._diverged("a parameter is not finite")
        state.seconds = self.saved_at = self.clock()
        checkpoint.save(self.out, state.to_dict())

    def _diverged(self, why: str) -> DivergedError:
        return DivergedError(
            "the optimisation diverged",
            where=f"{self.out}, step {self.state.images}",
            why=f"{why}; the last checkpoint is kept",
            fix="lower the learning rate by --set volume.rate=1e-4 and start over with --fresh",
        )
