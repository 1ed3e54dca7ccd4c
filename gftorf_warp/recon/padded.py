"""Tensors with room for more rows than the optimiser sees: addresses stay the same while Gaussians come and go.

The rows behind the last Gaussian are dead: so faint that no pixel sees them, so they get no gradient, and Adam, whose
moments of them are zero, leaves them where they are: at a finite place, that of the first Gaussian or of one that was
there before.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..render import descent
from ..scene.gaussians import GaussianField
from .densify import STATISTICS, Statistics
from .state import State

BUCKET, SPARE = 4096, 1.25  # rows are made in such numbers while Gaussians are added, for so many as there are
LAST_BUCKET = 256  # afterwards
CAPTURE_S = 0.06  # what other rooms cost: a step without a graph, and its graph (design/whole-run.md)
DEAD_ROW_S = 5e-9  # what a row that nobody needs costs a step
DEAD = -30.0  # opacity logit of a row that nobody sees


class Padded:
    """Room for the Gaussians of one state, their moments and statistics.

    :meth:`adopt` moves a state here; what the state holds then are views of the first N rows, so that densification,
    checkpoints and diagnostics know nothing of the room.
    """

    def __init__(self) -> None:
        self.rows = 0
        self._wasted = 0  # superfluous rows, summed over steps
        self.values: dict[str, Tensor] = {}
        self._moments: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        self._views: dict[str, Tensor] = {}
        self._motion: list[Tensor] = []
        self._motion_moments: list[tuple[Tensor, Tensor, Tensor]] = []

    @property
    def leaves(self) -> list[Tensor]:
        """Everything that is optimised: the tensors of the field, then the motion."""
        return [*self.values.values(), *self._motion]

    @property
    def field(self) -> GaussianField:
        """All rows, the dead ones as well."""
        return GaussianField(**self.values, layer=self.layer)

    def table(self) -> descent.AdamTable:
        """Where all of these lie, for one step that is captured; there are no gradients yet."""
        values = [leaf.detach() for leaf in self.leaves]
        return descent.AdamTable(values, [None] * len(values), [*self._moments.values(), *self._motion_moments])

    def holds(self, state: State) -> bool:
        """Whether the tensors of a state are still those of this room."""
        return all(self._views.get(name) is tensor for name, tensor in state.optimiser.tensors.items())

    def adopt(self, state: State, *, steps: int = 0, free: bool = False, grows: bool = True) -> bool:
        """Move a state here; nothing of its values changes.

        Args:
            state: Its tensors become views.
            steps: That were made since the last time: superfluous rows go once they have cost as much as a capture.
            free: Whether other rooms cost nothing, since everything that was captured is forgotten anyway.
            grows: Whether Gaussians will still be added.

        Returns:
            Whether addresses changed, so that nothing that was captured with the old ones may run again.
        """
        tensors = state.optimiser.tensors
        count = len(tensors["mean"])
        rows = (int(SPARE * count) // BUCKET + 1) * BUCKET if grows else (count // LAST_BUCKET + 1) * LAST_BUCKET
        self._wasted += steps * max(self.rows - rows, 0)
        anew = set(tensors) != set(self.values) or count > self.rows or (free and rows != self.rows)
        anew = anew or self._wasted * DEAD_ROW_S > CAPTURE_S
        anew = anew or any(a is not b for a, b in zip(self._motion, state.optimiser.motion, strict=False))
        if anew:
            self._reserve(state, rows)
        pairs = [pair for name, tensor in tensors.items() for pair in self._take(state, name, tensor, count)]
        pairs += [(getattr(self.statistics, name), getattr(state.statistics, name)) for name in STATISTICS]
        _copy(pairs, count)
        torch._foreach_zero_([room[count:] for room in (*self._moment_rooms, *vars(self.statistics).values())])
        self.values["opacity_logit"].detach()[count:] = DEAD
        self.share[:count] = 1.0 / max(count, 1)
        self.share[count:] = 0.0
        if self.layer is not None and state.optimiser.layer is not None:
            _copy([(self.layer, state.optimiser.layer)], count)
        if not state.motion.follows_means:  # others are asked in every step
            _copy([(self.attachment, state.attachment)], count)
        state.statistics = Statistics(**{name: getattr(self.statistics, name)[:count] for name in STATISTICS})
        return anew

    def _reserve(self, state: State, rows: int) -> None:
        """Memory for ``rows`` Gaussians."""

        def like(tensor: Tensor) -> Tensor:
            return tensor.new_zeros(rows, *tensor.shape[1:])

        optimiser, self.rows, self._wasted, self._views = state.optimiser, rows, 0, {}
        tensors = {name: tensor.detach() for name, tensor in optimiser.tensors.items()}
        self.values = {name: like(tensor) for name, tensor in tensors.items()}
        for name, value in self.values.items():
            value[:] = tensors[name][:1]
            value.requires_grad_()
        self._moments = {name: (tensor.new_zeros(()), like(tensor), like(tensor)) for name, tensor in tensors.items()}
        self._motion = list(optimiser.motion)
        self.layer = None if optimiser.layer is None else like(optimiser.layer)
        self.attachment = like(state.attachment)
        self.statistics = Statistics(**{name: like(tensors["opacity_logit"]) for name in STATISTICS})
        self.share = like(tensors["opacity_logit"])  # of each row in a mean over Gaussians
        self._motion_moments = [optimiser.moments_of(leaf) for leaf in self._motion]

    @property
    def _moment_rooms(self) -> list[Tensor]:
        return [room for _, first, second in self._moments.values() for room in (first, second)]

    def _take(self, state: State, name: str, tensor: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
        """Let the state see one tensor of the field and its moments here; returns rooms, and what belongs there."""
        value, (step, first, second) = self.values[name].detach(), self._moments[name]
        known = state.optimiser.moments_of(tensor)
        found: list[tuple[Tensor, Tensor]] = []
        if self._views.get(name) is not tensor:
            found = [(value, tensor.detach()), (first, known[1]), (second, known[2])]
            if known[0] is not step:
                step.copy_(known[0])
        view = value[:count].requires_grad_()
        self._views[name] = view
        state.optimiser.settle(name, view, (step, first[:count], second[:count]))
        return found


def _copy(pairs: list[tuple[Tensor, Tensor]], count: int) -> None:
    """To the first rows of rooms of one type, at once; nothing is copied onto itself."""
    moved = [(room[:count], rows) for room, rows in pairs if room.data_ptr() != rows.data_ptr()]
    if moved:
        torch._foreach_copy_([room for room, _ in moved], [rows for _, rows in moved])
