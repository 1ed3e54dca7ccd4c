"""Training of a volume in the folder of its run: steps, metrics, checkpoints."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...errors import DivergedError
from ...scene.motion import Products
from .. import checkpoint
from ..interruption import interruption, signals
from ..loop import is_late, peak_of
from ..record import Metrics
from ..settings import ReconSettings
from ..state import FORMAT
from .models import new_volume, volume_from_dict
from .settings import VolumeSettings
from .targets import Draw, Targets
from .volume import Volume

LOG = logging.getLogger("gftorf_warp")


class VolumeState:
    """A volume, its optimiser and the random numbers between two steps."""

    def __init__(self, volume: Volume, settings: VolumeSettings, seed: int):
        """Begin at step 0."""
        self.volume, self.images, self.seconds = volume, 0, 0.0
        self.optimiser = torch.optim.Adam(
            volume.parameters(), lr=settings.rate, eps=settings.epsilon, fused=True
        )
        half = settings.products == Products.HALF
        self.scaler = torch.amp.GradScaler(volume.device.type, enabled=half)
        self.draw = Draw(seed, volume.device)
        self.sums: dict[str, Tensor] = {}
        """Terms summed over the steps since the last logged row."""
        self.counts: dict[str, int] = {}
        """In how many of them each term was."""

    def to_dict(self) -> dict[str, Any]:
        """Tensors and plain values, for a checkpoint."""
        return {
            "format": FORMAT,
            "images": self.images,
            "seconds": self.seconds,
            "volume": self.volume.to_dict(),
            "adam": self.optimiser.state_dict(),
            "scaler": self.scaler.state_dict(),
            "draw": self.draw.states(),
            "sums": dict(self.sums),
            "counts": dict(self.counts),
        }


def begin(
    settings: ReconSettings, targets: Targets, seed: int, device: torch.device
) -> VolumeState:
    """A run before its first step."""
    assert settings.volume is not None, "presets of volumes have it"
    volume = new_volume(settings.method, settings.volume, targets, seed, device)
    return VolumeState(volume, settings.volume, seed)


def from_dict(
    run: Path, settings: ReconSettings, stored: dict[str, Any], device: torch.device
) -> VolumeState:
    """A run as :meth:`VolumeState.to_dict` stored it; on a CPU it continues to the same bits.

    Raises:
        InputError: If the checkpoint does not fit the settings, or is not finite.
    """
    assert settings.volume is not None, "presets of volumes have it"
    volume = volume_from_dict(run, settings.method, settings.volume, stored, device)
    state = VolumeState(volume, settings.volume, seed=0)
    state.optimiser.load_state_dict(stored["adam"])
    state.scaler.load_state_dict(stored["scaler"])
    state.draw.restore(stored["draw"])
    state.images, state.seconds = stored["images"], stored["seconds"]
    state.counts = dict(stored["counts"])
    state.sums = {name: value.to(volume.device) for name, value in stored["sums"].items()}
    return state


class VolumeLoop:
    """Trains a volume until its steps are used up."""

    def __init__(
        self,
        targets: Targets,
        settings: ReconSettings,
        out: Path,
        metrics: Metrics,
        clock: Callable[[], float],
        progress: Callable[..., None] | None,
    ):
        """Take note of everything; :meth:`run` trains.

        Args:
            targets: What is fitted.
            settings: How.
            out: Folder of the run.
            metrics: Rows of metrics.jsonl.
            clock: Seconds spent on the run so far.
            progress: Called as ``progress(steps, steps_in_all, loss=, psnr_db=)``.
        """
        assert settings.volume is not None, "presets of volumes have it"
        self.targets, self.settings, self.options, self.out = (
            targets,
            settings,
            settings.volume,
            out,
        )
        self.metrics, self.clock, self.progress = metrics, clock, progress
        self.peak, self.saved_at = peak_of(targets.observations, settings), clock()

    def run(self, state: VolumeState) -> VolumeState:
        """Train a state to its end.

        Raises:
            DivergedError: If the loss is not finite; the last checkpoint is kept.
            KeyboardInterrupt: After a signal, when everything is stored.
        """
        schedule = self.settings.schedule
        if state.images == 0:
            self.save(state)
        with signals() as stop:
            while state.images < schedule.images:
                before = state.images
                self.step(state)
                whole = state.images % self.options.accumulated == 0
                ended = state.images >= schedule.images
                if state.images % schedule.log_every == 0 or ended:
                    self.report(state)
                if not (whole or ended):  # a checkpoint holds no gradients
                    continue
                if stop:
                    self.save(state)
                    text = "interrupted at step %d of %d, stored"
                    LOG.info(text, state.images, schedule.images)
                    raise interruption(stop)
                old = self.clock() - self.saved_at > schedule.checkpoint_every_s
                late = is_late(before, state.images, schedule.images)
                if ended or old or late:
                    self.save(state)
        return state

    def step(self, state: VolumeState) -> None:
        """Gradients of one batch of rays; every few of them, an update."""
        volume = state.volume
        # the outer context keeps weights in half precision for all products of the step
        with volume.precision(), torch.autocast(volume.device.type, enabled=False):
            terms = volume.terms(self.targets, state.images, self.settings, state.draw)
        mse = terms.pop("quad_mse", None)
        loss = torch.stack([*terms.values()]).sum()
        state.scaler.scale(loss / self.options.accumulated).backward()
        noted = {"loss": loss, **terms} | ({} if mse is None else {"quad_mse": mse})
        for name, value in noted.items():
            state.sums[name] = state.sums.get(name, 0.0) + value.detach()
            state.counts[name] = state.counts.get(name, 0) + 1
        state.images += 1
        if state.images % self.options.accumulated == 0 or (
            state.images >= self.settings.schedule.images
        ):
            self.update(state)

    def update(self, state: VolumeState) -> None:
        """One step of Adam."""
        passed = state.images / self.options.rate_tenth_after
        for group in state.optimiser.param_groups:
            group["lr"] = self.options.rate * 0.1**passed
        state.scaler.unscale_(state.optimiser)
        if self.options.gradient_max is not None:
            torch.nn.utils.clip_grad_value_(state.volume.parameters(), self.options.gradient_max)
        state.scaler.step(state.optimiser)
        state.scaler.update()
        state.optimiser.zero_grad(set_to_none=True)

    def report(self, state: VolumeState) -> None:
        """One row of metrics: means over the steps since the last one that had each term.

        Raises:
            DivergedError: If the loss is not finite.
        """
        values = torch.stack([*state.sums.values()]).tolist()  # one transfer
        found = zip(state.sums, values, strict=True)
        means = {name: value / state.counts[name] for name, value in found}
        state.sums, state.counts = {}, {}
        if not math.isfinite(means["loss"]):
            raise DivergedError(
                "the optimisation diverged",
                where=f"{self.out}, step {state.images}",
                why="the loss is not finite; the last checkpoint is kept",
                fix="lower the learning rate by --set volume.rate=1e-4 and start over with --fresh",
            )
        mse = means.pop("quad_mse", 0.0)
        psnr = 10.0 * math.log10(self.peak**2 / mse) if mse > 0 else None
        row = {"images": state.images, "seconds": self.clock(), **means, "quad_psnr_db": psnr}
        self.metrics.add(row)
        if self.progress is not None:
            total = self.settings.schedule.images
            self.progress(state.images, total, loss=row["loss"], psnr_db=psnr)

    def save(self, state: VolumeState) -> None:
        """Write a checkpoint."""
        state.seconds = self.saved_at = self.clock()
        checkpoint.save(self.out, state.to_dict())
