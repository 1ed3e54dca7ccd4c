"""The training steps of a run: batches, CUDA graphs, densification and opacity resets, pair
capacity.

On a GPU the host runs ahead of the device: it uploads a control block, replays a graph, and learns
later whether steps were valid and how many (tile, splat) pairs there were.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..render import descent
from ..render.cuda import CapturedGraph, graph_pool
from ..scene.motion import Still
from . import densify
from .control import ControlBlock
from .counts import StepCounts
from .keys import GraphKey
from .observations import Observations
from .optimiser import frozen, rates_at
from .padded import PaddedParameters
from .settings import DensifySettings, ReconSettings
from .state import State
from .step import Map, Step
from .terms import TERMS, Term, render_settings_at

Send = Callable[[], None]


def draw(state: State, observations: Observations, settings: ReconSettings) -> list[int]:
    """Raw frames of the next step, without replacement within an epoch;
    the last batch may be cut short.
    """
    if not state.queue:
        order = torch.randperm(len(observations.batches), generator=state.generator)
        state.queue = order.tolist()
    batch = observations.batches[state.queue.pop()]
    return batch[: settings.schedule.images - state.images]


class Stepper:
    """Advances one state.

    Between two steps the state is complete but for sums and counts, see :meth:`collect`.
    """

    def __init__(
        self,
        state: State,
        observations: Observations,
        settings: ReconSettings,
        *,
        terms: Sequence[Term] = TERMS,
        map_images: Map = map,
    ):
        """Take over a state.

        Args:
            state: Advanced in place.
            observations: What it is fitted to.
            settings: How.
            terms: The terms of the loss.
            map_images: ``map``, or that of a thread pool for the images of a batch on a CPU.
        """
        self.state, self.observations, self.settings = state, observations, settings
        device = observations.quads.device
        self._map_images = map_images
        self._padded = PaddedParameters(pads=device.type != "cpu")
        groups = state.optimiser.groups
        self._control = ControlBlock(observations, settings, terms, state.motion, groups)
        betas = state.optimiser.betas
        self._step = Step(observations, settings, terms, self._control, self._padded, betas)
        self._summed: set[str] = {*descent.TOTAL_NAMES}  # names of sums that any step has added to
        self._counts = StepCounts(
            self._step.output.counts,
            limited=self._padded.pads,
            waits=settings.render.deterministic,
        )
        self._graphs: dict[GraphKey, tuple[descent.AdamTable, CapturedGraph | None]] = {}
        self._key: GraphKey | None = None  # of the last step
        self._steps = 0  # since the last :meth:`_attach`
        self._pool = graph_pool(device)
        self._attach()

    def step(self) -> None:
        """Advance the state by one batch, and densify or reset opacities where that is due."""
        state, settings = self.state, self.settings
        frames = draw(state, self.observations, settings)
        before, state.images = state.images, state.images + len(frames)
        weights = tuple(term.weight(settings, before) for term in self._step.terms)
        moves = before >= settings.schedule.warm_up and not isinstance(state.motion, Still)
        degree, rests = render_settings_at(settings, before).sh_degree, frozen(settings, before)
        key = self._control.graph_keys.of(
            frames, weights, moves=moves, frozen=rests, sh_degree=degree
        )
        self._enter(key)
        due = densify.densification_is_due(
            before, state.images, settings.densify, settings.schedule
        )
        rates = rates_of(state, before, settings, densifies=due)
        self._control.write(key, frames, before, state.noise_seed, weights, rates)
        self._run(key)
        self._steps += 1
        densify_after(state, self.observations, before, settings)
        if due or not self._padded.holds(state):
            self._read_counts()
            self._attach()

    def collect(self) -> int:
        """Add the sums and counts of the steps so far to the state; waits for the device.

        Returns:
            Number of skipped steps in a row, up to the last step.
        """
        names = [*(term.name for term in self._step.terms), *descent.TOTAL_NAMES]
        add_sums(self.state, self._step.output.sums, names, self._summed)
        return self._read_counts()

    def _run(self, key: GraphKey) -> None:
        """Launch a step; the first one of a key is not captured, since it loads modules."""
        if key in self._graphs:
            table, graph = self._graphs[key]
            if graph is None:
                self._launch(key, table, table.send, self._map_images)
            else:
                graph(lambda: self._launch(key, table, None, map))
            if self._counts.is_nearly_full():
                self._read_counts()
            return
        self._summed |= {name for image in key.images for name in image.terms}
        table = self._padded.table()
        self._launch(key, table, table.send, map)  # one thread: kernels are compiled now
        if not self._counts.has_capacity:
            self._read_counts()
        captured = self._padded.pads and self.settings.graph
        self._graphs[key] = table, graph_of(table, self._pool) if captured else None

    def _launch(
        self, key: GraphKey, table: descent.AdamTable, send: Send | None, map_images: Map
    ) -> None:
        render = replace(
            self.settings.render, sh_degree=key.sh_degree, pair_capacity=self._counts.capacity
        )
        self._step.run(key, self.state.motion, render, table, send, map_images)

    def _enter(self, key: GraphKey) -> None:
        """Release the graphs of a stage that is over; prepare the one that begins."""
        last, self._key = self._key, key
        if last is not None and last.stage == key.stage:
            return
        if self._graphs:
            self._read_counts()  # waits: graphs must have run before their memory is released
            self._release_graphs()
        if last is None or last.terms != key.terms:
            self._counts.forget()
        self._attach(free=True)

    def _attach(self, *, free: bool = False) -> None:
        """Move the state to the padded parameters, whose number of rows may change."""
        state, settings = self.state, self.settings
        grows = densify.densification_remains(state.images, settings.densify, settings.schedule)
        if self._padded.attach(state, steps=self._steps, free=free, grows=grows):
            self._release_graphs()
        self._steps = 0
        if self._key is not None and self._key.frozen and state.motion.follows_means:
            field = self._padded.field.map(torch.Tensor.detach)  # evaluated here, not in every step
            self._padded.binding.copy_(state.motion.bind(field))

    def _release_graphs(self) -> None:
        """Release all graphs; the memory that they share goes with the last one."""
        self._graphs.clear()
        self._pool = graph_pool(self.observations.quads.device)

    def _read_counts(self) -> int:
        """Number of skipped steps in a row; waits for the device."""
        is_sorted = self._step.renderer.sorts_pairs
        in_a_row, changed = self._counts.read(self.state, is_sorted=is_sorted)
        if changed:
            self._release_graphs()
        return in_a_row


def graph_of(table: descent.AdamTable, pool: Any) -> CapturedGraph:
    """The graph of a step whose parameters are in ``table``, to be captured."""

    def ready() -> None:  # gradients have the addresses that the capture gave them
        table.send()
        table.release()

    return CapturedGraph(ready, pool)


def rates_of(
    state: State, before: int, settings: ReconSettings, *, densifies: bool
) -> dict[str, float]:
    """Learning rates of a step after ``before`` images; one that ends with a densification may
    leave the field alone.
    """
    rates = rates_at(
        settings,
        before,
        state.rate_factor,
        reset_at=state.reset_at,
        revived_at=state.revived_at,
    )
    if densifies and settings.densify.loses_step:
        rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
    return rates


def add_sums(state: State, sums: Tensor, names: Sequence[str], added: Collection[str]) -> None:
    """Add the sums of these ``names`` on the device to those of a state, of names that any step
    has added to, and set them to zero.
    """
    for name, value in zip(names, sums.clone(), strict=True):
        if name in added:
            state.sums[name] = state.sums[name] + value if name in state.sums else value
    sums.zero_()


def densify_after(
    state: State, observations: Observations, before: int, settings: ReconSettings
) -> None:
    """Densification and opacity reset that are due after a step that began after ``before``
    images.
    """
    options, schedule = settings.densify, settings.schedule
    if densify.densification_is_due(before, state.images, options, schedule):
        weight = options.unseen_weight * (state.images - state.unseen_at)
        prunes = visibility_pruning_is_due(state, observations, options)
        _, state.statistics = densify.densify(
            state.optimiser,
            state.statistics,
            options,
            state.generator,
            prunes_scale=state.images > options.scale_from,
            unseen_weight=weight if prunes else None,
        )
        if prunes:
            state.unseen_at = state.images
        if not state.motion.follows_means:  # otherwise it is evaluated in every step
            state.binding = state.motion.bind(state.optimiser.field)
    if densify.reset_is_due(before, state.images, options, schedule):
        densify.reset_opacity(state.optimiser, options)
        state.reset_at = state.images


def visibility_pruning_is_due(
    state: State, observations: Observations, options: DensifySettings
) -> bool:
    """Whether this densification also prunes by visibility: two epochs contain every raw frame."""
    frames = sum(len(batch) for batch in observations.batches)
    begins = options.unseen_from
    return begins is not None and state.images >= max(begins, state.unseen_at + 2 * frames)
