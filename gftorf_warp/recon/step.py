"""One step of the optimiser: draw a batch, render, compare, descend; and what follows a step now and then."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import torch
from torch import Tensor

from ..losses.tof import quad_error
from ..render.api import Rendering
from . import densify
from .objective import terms, weights_at
from .observations import Observations
from .optimiser import rates_at
from .settings import ReconSettings
from .state import State

Map = Callable[[Callable, Iterable], Iterable]


def draw(state: State, observations: Observations, settings: ReconSettings) -> list[int]:
    """Raw frames of the next step, without replacement within an epoch; the last batch of a run may be cut short."""
    if not state.queue:
        state.queue = torch.randperm(len(observations.batches), generator=state.generator).tolist()
    batch = observations.batches[state.queue.pop()]
    return batch[: settings.schedule.images - state.images]


def step(
    state: State, observations: Observations, settings: ReconSettings, run_all: Map = map
) -> dict[str, float] | None:
    """Advance a state by one batch.

    The images of a batch are independent until their gradients are averaged, in the order of the frames. So ``run_all``
    may work on several at once without changing a bit.

    Args:
        state: Changed in place.
        observations: What was measured.
        settings: How.
        run_all: ``map`` or the ``map`` of a pool of threads.

    Returns:
        None, or, if the loss or the gradient was not finite, the terms of the loss [1]: the step was skipped then.
    """
    frames = draw(state, observations, settings)
    field, leaves = state.optimiser.field, state.optimiser.leaves
    weights = weights_at(settings, state.images)
    backgrounds = [_background(state, observations, settings) for _ in frames]

    def one(frame: int, background: Tensor | None) -> tuple[dict[str, Tensor], Rendering, list[Tensor | None]]:
        found, rendering = terms(
            field, state.motion, state.attachment, observations, frame, settings, weights, background
        )
        gradients = torch.autograd.grad(torch.stack([*found.values()]).sum(), leaves, allow_unused=True)
        return {name: value.detach() for name, value in found.items()}, rendering, list(gradients)

    results = list(run_all(lambda pair: one(*pair), zip(frames, backgrounds, strict=True)))
    gradients = [_mean([gradients[n] for _, _, gradients in results]) for n in range(len(leaves))]
    before, state.images = state.images, state.images + len(frames)
    checked = [value for found, _, _ in results for value in found.values()]
    checked += [gradient.square().sum() for gradient in gradients if gradient is not None]
    if not bool(torch.stack(checked).sum().isfinite()):
        return {name: float(sum(found.get(name, 0.0) for found, _, _ in results)) for name in results[0][0]}
    for frame, (found, rendering, _) in zip(frames, results, strict=True):
        _account(state, observations, frame, found, rendering)
    rates = rates_at(settings, before, state.rate_factor)
    state.optimiser.step(gradients, rates, settings.motion_gradient_max)
    _densify(state, before, settings)
    return None


def threads_for(settings: ReconSettings, device: torch.device | str, available: int) -> tuple[ReconSettings, int]:
    """Settings and number of images worked on at once.

    On a CPU every image has one thread, so that the result depends on no number of cores.
    """
    if torch.device(device).type != "cpu":
        return settings, 1
    one = replace(settings, render=replace(settings.render, threads=1))
    return one, available


def pool(workers: int) -> ThreadPoolExecutor:
    """Threads that work on the images of a batch."""
    return ThreadPoolExecutor(workers, thread_name_prefix="gftorf-images")


def _background(state: State, observations: Observations, settings: ReconSettings) -> Tensor | None:
    """Uniform in [-B, B] per pixel."""
    if settings.background == 0.0:
        return None
    shape = (1, *observations.quads.shape[1:])
    uniform = torch.rand(shape, generator=state.noise, device=observations.quads.device)
    return settings.background * (2.0 * uniform - 1.0)


def _mean(gradients: list[Tensor | None]) -> Tensor | None:
    """Mean over the images of a batch; an image without a gradient counts as zero."""
    present = [gradient for gradient in gradients if gradient is not None]
    return torch.stack(present).sum(dim=0) / len(gradients) if present else None


def _account(state: State, observations: Observations, frame: int, found: dict[str, Tensor], rendering: Rendering):
    """Add an image to the sums of the log and to the statistics of densification."""
    with torch.no_grad():
        squared = quad_error(rendering.quads.detach(), observations.quads[frame][None]).mean()
        values = {**found, "loss": torch.stack([*found.values()]).sum(), "quad_mse": squared}
        values["opacity"] = rendering.opacity.detach().mean()
        values["count"] = torch.ones_like(squared)
        for name, value in values.items():
            state.sums[name] = state.sums[name] + value if name in state.sums else value.clone()
        if rendering.screen is not None:
            state.statistics = densify.observe(state.statistics, rendering.screen, observations.cameras[frame])


def _densify(state: State, before: int, settings: ReconSettings) -> None:
    """Rounds and resets that are due after a step."""
    options, schedule = settings.densify, settings.schedule
    if densify.round_is_due(before, state.images, options, schedule):
        judge = options.reset_every is None or state.resets > 0
        densify.round_of(state.optimiser, state.statistics, options, state.generator, judge_scale=judge)
        field = state.optimiser.field
        state.attachment = state.motion.attach(field)
        state.statistics = densify.start(field)
    if densify.reset_is_due(before, state.images, options, schedule):
        densify.reset_opacity(state.optimiser, options)
        state.resets += 1
