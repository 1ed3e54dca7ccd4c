"""Gradients of one batch of rays, captured as a CUDA graph per key and run eagerly on a CPU.

What a graph reads and writes keeps its address: parameters, their gradients, the numbers of the
step, the scale of the loss, sums of the terms, the grid of what is occupied. The first step of a
key runs eagerly, since it allocates gradients and sums and loads kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ...render.cuda import CapturedGraph, graph_pool
from ..settings import ReconSettings
from .choice import Given, Inputs
from .state import VolumeState
from .targets import Targets
from .volume import NOTED

Replayed = Callable[[Callable[[], object]], object]
"""Runs a function, the same in all calls, or replays what it did."""


class _Known(NamedTuple):
    """What remains of the first step of a key."""

    inputs: Inputs
    names: list[str]
    """Sums that it adds to."""
    run: Replayed


class VolumeStep:
    """Adds the gradients of batches of rays to those of a state."""

    def __init__(
        self,
        state: VolumeState,
        targets: Targets,
        settings: ReconSettings,
        *,
        replayed: Callable[[], Replayed] | None = None,
    ):
        """Take over a state.

        Args:
            state: Its gradients, sums and random numbers are advanced in place.
            targets: What is compared.
            settings: How.
            replayed: Makes what runs all steps of a key but the first; None: a CUDA graph on CUDA,
                unless the setting ``graph`` is off.
        """
        assert settings.volume is not None, "presets of volumes have it"
        self.state, self.targets, self.settings = state, targets, settings
        self._parameters = [*state.volume.parameters()]
        self._accumulated = settings.volume.accumulated
        device = state.volume.device
        chosen: Callable[[], Replayed] = _eager
        if settings.graph and device.type != "cpu":
            chosen = partial(graph_of, state, graph_pool(device))
        self._replayed = replayed or chosen
        self._known: dict[Hashable, _Known] = {}

    def run(self, step: int) -> None:
        """Add the gradients of one batch."""
        state = self.state
        choice = state.volume.choice(self.targets, step, self.settings, state.draw)
        known = self._known.get(choice.key)
        if known is None:
            inputs = Inputs(choice.numbers, state.volume.device)
            inputs.send(choice.numbers)
            names = self._add_gradients(choice.key, inputs.given)
            known = self._known[choice.key] = _Known(inputs, names, self._replayed())
        else:
            known.inputs.send(choice.numbers)
            known.run(partial(self._add_gradients, choice.key, known.inputs.given))
        for name in known.names:
            state.counts[name] = state.counts.get(name, 0) + 1
        state.volume.after(step)

    def _add_gradients(self, key: Hashable, given: Given) -> list[str]:
        """Differentiate the loss, and add terms to sums; returns their names."""
        state, volume = self.state, self.state.volume
        # the outer context keeps weights in half precision for all products of the step
        with volume.precision(), torch.autocast(volume.device.type, enabled=False):
            terms = volume.terms(self.targets, key, given, self.settings, state.draw)
        noted = {name: terms.pop(name) for name in NOTED if name in terms}
        loss = torch.stack([*terms.values()]).sum()
        scaled = state.scaler.scale(loss / self._accumulated)
        gradients = torch.autograd.grad(scaled, self._parameters, allow_unused=True)
        noted |= {"loss": loss, **terms}
        with torch.no_grad():
            self._add_to_parameters(gradients)
            for name in noted:
                if name not in state.sums:
                    state.sums[name] = torch.zeros_like(loss)
            torch._foreach_add_([state.sums[name] for name in noted], [*noted.values()])
        return [*noted]

    def _add_to_parameters(self, gradients: tuple[Tensor | None, ...]) -> None:
        """Accumulate gradients; a parameter that never had one keeps None, and Adam leaves it."""
        sums, added = [], []
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            if gradient is None:
                continue
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            sums.append(parameter.grad)
            added.append(gradient)
        torch._foreach_add_(sums, added)


def graph_of(state: VolumeState, pool: object) -> CapturedGraph:
    """A CUDA graph that draws from the random numbers of a state, to be captured."""
    return CapturedGraph(pool=pool, generators=[state.draw.device])


def _eager() -> Replayed:
    return lambda work: work()
