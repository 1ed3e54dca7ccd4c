"""One step of the optimiser: draw a batch, render, compare, descend; and what follows a step now and then."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import torch
from torch import Tensor

from ..render import fused
from . import densify
from .objective import Seen, render_settings_at, terms, weights_at
from .observations import Observations
from .optimiser import frozen, rates_at
from .settings import DensifySettings, Kernels, ReconSettings, Weights
from .state import State

Map = Callable[[Callable, Iterable], Iterable]
SEED_MASK = 0x7FFFFFFF  # a seed as a positive int32, for kernels


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
    leaves = state.optimiser.leaves
    moves = state.images >= settings.schedule.warm_up
    if state.motion.follows_means:
        state.attachment = state.motion.attach(state.optimiser.field)
    weights, render = weights_at(settings, state.images), render_settings_at(settings, state.images)
    rests = frozen(settings, state.images)
    first = len(state.optimiser.tensors) if rests else 0  # of the leaves that learn; those of the motion come last
    numbers = range(state.images, state.images + len(frames))
    pairs = zip(numbers, frames, strict=True)
    backgrounds = [_backgrounds(state, observations, frame, settings, weights, number) for number, frame in pairs]

    def one(frame: int, lights: dict[str, Tensor]) -> tuple[dict[str, Tensor], Seen, list[Tensor | None]]:
        field = state.optimiser.field
        found, seen = terms(
            field.map(torch.Tensor.detach) if rests else field,
            state.motion if moves else None,
            state.attachment,
            observations,
            frame,
            settings,
            weights,
            lights,
            render,
        )
        gradients: list[Tensor | None] = [None] * len(leaves)
        loss = torch.stack([*found.values()]).sum() if found else None
        if loss is not None and loss.requires_grad:
            gradients[first:] = torch.autograd.grad(loss, leaves[first:], allow_unused=True)
        return {name: value.detach() for name, value in found.items()}, seen, gradients

    results = list(run_all(lambda pair: one(*pair), zip(frames, backgrounds, strict=True)))
    gradients = [_mean([gradients[n] for _, _, gradients in results]) for n in range(len(leaves))]
    before, state.images = state.images, state.images + len(frames)
    checked = [value for found, _, _ in results for value in found.values()]
    present = [gradient for gradient in gradients if gradient is not None]
    checked += [torch.nn.utils.get_total_norm(present)] if present else []
    rates = rates_at(settings, before, state.rate_factor, reset_at=state.reset_at, revived_at=state.revived_at)
    options = settings.densify
    due = densify.round_is_due(before, state.images, options, settings.schedule)
    if due and options.loses_step:
        rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
    sound = torch.stack(checked).sum().isfinite() if checked else None
    if sound is not None and not bool(sound):
        return {name: float(sum(found.get(name, 0.0) for found, _, _ in results)) for name in results[0][0]}
    for frame, (found, seen, _) in zip(frames, results, strict=True):
        _account(state, observations, frame, found, seen)
    state.optimiser.step(gradients, rates, settings.motion_gradient_max)
    densify_after(state, observations, before, settings)
    return None


class Singles:
    """The steps of one run, one after the other."""

    def __init__(self, state: State, observations: Observations, settings: ReconSettings, run_all: Map = map):
        self._state, self._observations, self._settings = state, observations, settings
        self._run_all, self._first, self._failures = run_all, True, 0

    def step(self) -> dict[str, float] | None:
        """One step; what it returns is that of :func:`step`."""
        run_all = map if self._first else self._run_all  # the first one compiles kernels: one thread at a time
        broken, self._first = step(self._state, self._observations, self._settings, run_all), False
        self._failures = 0 if broken is None else self._failures + 1
        self._state.skipped += broken is not None
        return broken

    def collect(self) -> int:
        """How many steps in a row, up to the last one, changed nothing because something was not finite."""
        return self._failures


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


def _backgrounds(
    state: State, observations: Observations, frame: int, settings: ReconSettings, weights: Weights, number: int
) -> dict[str, Tensor]:
    """Uniform in [-B, B] per pixel and channel, for every image that will be compared; ``number`` counts images."""
    if settings.background == 0.0:
        return {}
    size = observations.quads.shape[1:]
    shapes: dict[str, tuple[int, ...]] = {}
    if weights.quads > 0:
        shapes = {"phasor": (3, *size)} if observations.phasors else {"quads": (1, *size)}
    if weights.colour > 0 and frame in observations.colour:
        shapes["colour"] = tuple(observations.colour[frame].shape)

    device = observations.quads.device
    if settings.kernels == Kernels.STEP:
        seed = state.noise.initial_seed() & SEED_MASK
        origin = torch.tensor([seed, number], dtype=torch.int32, device=device)
        streams = enumerate(shapes.items())
        return {name: fused.uniform(shape, origin, settings.background, stream=n) for n, (name, shape) in streams}

    def uniform(shape: tuple[int, ...]) -> Tensor:
        drawn = torch.rand(shape, generator=state.noise, device=device)
        return settings.background * (2.0 * drawn - 1.0)

    return {name: uniform(shape) for name, shape in shapes.items()}


def _mean(gradients: list[Tensor | None]) -> Tensor | None:
    """Mean over the images of a batch; an image without a gradient counts as zero."""
    present = [gradient for gradient in gradients if gradient is not None]
    if len(gradients) == 1:
        return gradients[0]
    return torch.stack(present).sum(dim=0) / len(gradients) if present else None


def _account(state: State, observations: Observations, frame: int, found: dict[str, Tensor], seen: Seen) -> None:
    """Add an image to the sums of the log and to the statistics of densification."""
    rendering = seen.tof or seen.colour
    if rendering is None:  # nothing of this frame is compared
        return
    with torch.no_grad():
        values = {**found, "loss": torch.stack([*found.values()]).sum(), "quad_mse": seen.squared}
        values["opacity"] = rendering.opacity.detach().mean()
        values["count"] = torch.ones_like(seen.squared)
        for name, value in values.items():
            state.sums[name] = state.sums[name] + value if name in state.sums else value.clone()
        if rendering.screen is not None:
            camera = (observations.cameras if seen.tof else observations.colour_cameras)[frame]
            state.statistics = densify.observe(state.statistics, rendering.screen, camera)


def densify_after(state: State, observations: Observations, before: int, settings: ReconSettings) -> None:
    """Rounds and resets that are due after a step that began after ``before`` images."""
    options, schedule = settings.densify, settings.schedule
    if densify.round_is_due(before, state.images, options, schedule):
        unseen = options.unseen_weight * (state.images - state.unseen_at)
        looks = unseen_are_due(state, observations, options)
        _, state.statistics = densify.round_of(
            state.optimiser,
            state.statistics,
            options,
            state.generator,
            judge_scale=state.images > options.scale_from,
            unseen_weight=unseen if looks else None,
        )
        if looks:
            state.unseen_at = state.images
        if not state.motion.follows_means:  # others are asked in every step
            state.attachment = state.motion.attach(state.optimiser.field)
    if densify.reset_is_due(before, state.images, options, schedule):
        densify.reset_opacity(state.optimiser, options)
        state.reset_at = state.images


def unseen_are_due(state: State, observations: Observations, options: DensifySettings) -> bool:
    """Whether a round removes who was not seen: two epochs since the last time contain every raw frame."""
    frames = sum(len(batch) for batch in observations.batches)
    return options.unseen_from is not None and state.images >= max(options.unseen_from, state.unseen_at + 2 * frames)
