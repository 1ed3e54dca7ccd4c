"""Parameters with padding rows: addresses stay the same while Gaussians are added and removed.

Padding rows behind the last Gaussian have an opacity of zero, so they are culled and get no
gradient, and their moments are zero, so Adam leaves them unchanged. Their positions are finite.

On a CPU, where nothing depends on addresses, there are none.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..render.descent import AdamTable
from ..scene.gaussians import GaussianField
from .densify import STATISTICS, Statistics
from .optimiser import Moments, field_of
from .state import State

# rows are allocated in multiples, for so many times the Gaussians, while these grow
BUCKET, SPARE = 4096, 1.25
LAST_BUCKET = 256  # afterwards
# cost of other addresses: a step without a graph, and a capture (benchmarks/results)
CAPTURE_S = 0.06
PADDING_ROW_S = 5e-9  # cost of an unnecessary row per step
PADDING_LOGIT = -30.0  # opacity logit of a padding row


class PaddedParameters:
    """Parameters, moments and statistics of one state, with padding rows.

    :meth:`attach` moves a state here. Its tensors are then views of the first N rows, so
    densification, checkpoints and diagnostics do not depend on the padding.
    """

    def __init__(self, *, pads: bool):
        """Allocate nothing yet.

        Args:
            pads: Whether there are padding rows; otherwise every change of N changes addresses.
        """
        self.pads = pads
        self.rows = 0
        self._unnecessary = 0  # rows, summed over steps
        self.values: dict[str, Tensor] = {}
        """All rows of the tensors of the field, by name of their group."""
        self.moments: dict[str, Moments] = {}
        """Moments of all rows, by name as well."""
        self._views: dict[str, Tensor] = {}
        self.motion: list[Tensor] = []
        """Parameters of the motion."""
        self._motion_moments: list[Moments] = []

    @property
    def leaves(self) -> list[Tensor]:
        """Everything that is optimised: the tensors of the field, then the motion."""
        return [*self.values.values(), *self.motion]

    @property
    def field(self) -> GaussianField:
        """All rows, padding included."""
        return field_of(self.values, self.layer)

    def table(self) -> AdamTable:
        """Addresses of all tensors, without gradients."""
        values = [leaf.detach() for leaf in self.leaves]
        return AdamTable(values, [*self.moments.values(), *self._motion_moments])

    def holds(self, state: State) -> bool:
        """Whether the tensors of a state are still views of these."""
        return all(
            self._views.get(name) is tensor for name, tensor in state.optimiser.tensors.items()
        )

    def attach(
        self, state: State, *, steps: int = 0, free: bool = False, grows: bool = True
    ) -> bool:
        """Move a state here, values unchanged.

        Args:
            state: Its tensors become views.
            steps: Number of steps since the last call: unnecessary rows are released once they have
                cost as much as a capture.
            free: Whether new addresses cost nothing, since no graph will be used again.
            grows: Whether Gaussians will still be added.

        Returns:
            Whether addresses changed, which invalidates captured graphs.
        """
        tensors = state.optimiser.tensors
        count = len(tensors["mean"])
        rows = self._rows_for(count, grows=grows)
        self._unnecessary += steps * max(self.rows - rows, 0)
        moved = set(tensors) != set(self.values) or count > self.rows
        moved = moved or ((free or not self.pads) and rows != self.rows)
        moved = moved or self._unnecessary * PADDING_ROW_S > CAPTURE_S
        moved = moved or any(
            a is not b for a, b in zip(self.motion, state.optimiser.motion, strict=False)
        )
        if moved:
            self._allocate(state, rows)
        pairs = [
            pair for name, tensor in tensors.items() for pair in self._take(state, name, tensor)
        ]
        pairs += [
            (getattr(self.statistics, name), getattr(state.statistics, name)) for name in STATISTICS
        ]
        _copy(pairs, count)
        moments = [moment for _, *both in self.moments.values() for moment in both]
        torch._foreach_zero_([rows[count:] for rows in (*moments, *vars(self.statistics).values())])
        self.values["opacity_logit"].detach()[count:] = PADDING_LOGIT
        self.mean_weight[:count] = 1.0 / max(count, 1)
        self.mean_weight[count:] = 0.0
        if self.layer is not None and state.optimiser.layer is not None:
            _copy([(self.layer, state.optimiser.layer)], count)
        if not state.motion.follows_means:  # otherwise it is evaluated in every step
            _copy([(self.binding, state.binding)], count)
        views = {name: getattr(self.statistics, name)[:count] for name in STATISTICS}
        state.statistics = Statistics(**views)
        return moved

    def _rows_for(self, count: int, *, grows: bool) -> int:
        if not self.pads:
            return count
        if grows:
            return (int(SPARE * count) // BUCKET + 1) * BUCKET
        return (count // LAST_BUCKET + 1) * LAST_BUCKET

    def _allocate(self, state: State, rows: int) -> None:
        def like(tensor: Tensor) -> Tensor:
            return tensor.new_zeros(rows, *tensor.shape[1:])

        optimiser, self.rows, self._unnecessary, self._views = state.optimiser, rows, 0, {}
        tensors = {name: tensor.detach() for name, tensor in optimiser.tensors.items()}
        self.values = {name: like(tensor) for name, tensor in tensors.items()}
        for name, value in self.values.items():
            value[:] = tensors[name][:1]
            value.requires_grad_()
        self.moments = {
            name: (tensor.new_zeros(()), like(tensor), like(tensor))
            for name, tensor in tensors.items()
        }
        self.motion = list(optimiser.motion)
        self.layer = None if optimiser.layer is None else like(optimiser.layer)
        self.binding = like(state.binding.detach())
        """Attachment of all rows to a motion that does not follow the means."""
        self.statistics = Statistics(
            **{name: like(tensors["opacity_logit"]) for name in STATISTICS}
        )
        """Statistics of densification of all rows."""
        self.mean_weight = like(tensors["opacity_logit"])
        """Weight of each row in a mean over Gaussians."""
        self._motion_moments = [optimiser.moments_of(leaf) for leaf in self.motion]

    def _take(self, state: State, name: str, tensor: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Make one tensor of a state and its moments views; returns what to copy where."""
        value, (step, first, second) = self.values[name].detach(), self.moments[name]
        known, count = state.optimiser.moments_of(tensor), len(tensor)
        copies: list[tuple[Tensor, Tensor]] = []
        if self._views.get(name) is not tensor:
            copies = [(value, tensor.detach()), (first, known[1]), (second, known[2])]
            if known[0] is not step:
                step.copy_(known[0])
        view = value[:count].requires_grad_()
        self._views[name] = view
        state.optimiser.put(name, view, (step, first[:count], second[:count]))
        return copies


def _copy(pairs: list[tuple[Tensor, Tensor]], count: int) -> None:
    """Copy to the first rows of tensors of one type, in one call,
    but for rows that are there already.
    """
    moved = [(to[:count], rows) for to, rows in pairs if to.data_ptr() != rows.data_ptr()]
    if moved:
        torch._foreach_copy_([to for to, _ in moved], [rows for _, rows in moved])
