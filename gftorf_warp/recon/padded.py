"""Tensors with room for more rows than the optimiser sees: addresses stay the same while Gaussians come and go.

The rows behind the last Gaussian are dead: so faint that no pixel sees them, so they get no gradient, and Adam, whose
moments of them are zero, leaves them where they are.
"""

from __future__ import annotations

from torch import Tensor

from ..render import descent
from ..scene.gaussians import GaussianField
from .densify import STATISTICS, Statistics
from .state import State

BUCKET = 2048  # rows are added and taken away in such numbers
DEAD = -30.0  # opacity logit of a row that nobody sees


class Padded:
    """Room for the Gaussians of one state, their moments and statistics.

    :meth:`adopt` moves a state here; what the state holds then are views of the first N rows, so that densification,
    checkpoints and diagnostics know nothing of the room.
    """

    def __init__(self) -> None:
        self.rows = 0
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

    def adopt(self, state: State) -> bool:
        """Move a state here; nothing of its values changes.

        Returns:
            Whether addresses changed, so that nothing that was captured with the old ones may run again.
        """
        tensors = state.optimiser.tensors
        count = len(tensors["mean"])
        anew = set(tensors) != set(self.values) or not 0 <= self.rows - count <= 2 * BUCKET
        anew = anew or any(a is not b for a, b in zip(self._motion, state.optimiser.motion, strict=False))
        if anew:
            self._reserve(state, (count // BUCKET + 1) * BUCKET)
        for name, tensor in tensors.items():
            self._take(state, name, tensor, count)
        if self.layer is not None and state.optimiser.layer is not None:
            self._fill(self.layer, state.optimiser.layer)
        self._fill(self.attachment, state.attachment)
        for name in STATISTICS:
            self._fill(getattr(self.statistics, name), getattr(state.statistics, name))
        state.statistics = Statistics(**{name: getattr(self.statistics, name)[:count] for name in STATISTICS})
        return anew

    def _reserve(self, state: State, rows: int) -> None:
        """Memory for ``rows`` Gaussians."""

        def like(tensor: Tensor) -> Tensor:
            return tensor.new_zeros(rows, *tensor.shape[1:])

        optimiser, self.rows, self._views = state.optimiser, rows, {}
        tensors = {name: tensor.detach() for name, tensor in optimiser.tensors.items()}
        self.values = {name: like(tensor).requires_grad_() for name, tensor in tensors.items()}
        self._moments = {name: (tensor.new_zeros(()), like(tensor), like(tensor)) for name, tensor in tensors.items()}
        self._motion = list(optimiser.motion)
        self.layer = None if optimiser.layer is None else like(optimiser.layer)
        self.attachment = like(state.attachment)
        self.statistics = Statistics(**{name: like(tensors["opacity_logit"]) for name in STATISTICS})
        self._motion_moments = [optimiser.moments_of(leaf) for leaf in self._motion]

    def _take(self, state: State, name: str, tensor: Tensor, count: int) -> None:
        """One tensor of the field and its moments."""
        value, (step, first, second) = self.values[name].detach(), self._moments[name]
        known = state.optimiser.moments_of(tensor)
        if self._views.get(name) is not tensor:
            self._fill(value, tensor.detach())
            value[count:] = DEAD if name == "opacity_logit" else value[:1]  # any finite place in front of the camera
            step.copy_(known[0])
            for moment, found in zip((first, second), known[1:], strict=True):
                self._fill(moment, found)
        view = value[:count].requires_grad_()
        self._views[name] = view
        state.optimiser.settle(name, view, (step, first[:count], second[:count]))

    @staticmethod
    def _fill(room: Tensor, rows: Tensor) -> None:
        """The first rows, and zeros behind them; nothing is copied onto itself."""
        if room.data_ptr() != rows.data_ptr():
            room[: len(rows)] = rows
        room[len(rows) :] = 0
