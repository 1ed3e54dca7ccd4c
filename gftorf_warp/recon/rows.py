"""Which rows of the parameters a batch is rendered from.

Gaussians that do not exist at the times of a batch are in none of its images and get no gradient.
Where they are many, as with a window per quartet, a rendering without them costs a fraction, and is
the same to the bit. On CUDA all rows are rendered: their number is that of a graph.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..render import descent
from ..render.api import ScreenGradient
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from .densify import Statistics
from .optimiser import field_of
from .padded import PaddedParameters


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedRows:
    """What the images of a batch are rendered from: all rows, or those of Gaussians that exist."""

    values: dict[str, Tensor]
    """The tensors of the field, by name of their group; of all rows the leaves themselves."""
    layer: Int[Tensor, "N"] | None
    """Motion layer of each row."""
    binding: Float[Tensor, "N M"]
    """Attachment of each row to a motion that does not follow the means."""
    mean_weight: Float[Tensor, "N"]
    """Weight of each row in a mean over all Gaussians."""
    rows: Int[Tensor, "N"] | None
    """Which of all rows these are, ascending; None: all of them."""

    @property
    def field(self) -> GaussianField:
        """As a field."""
        return field_of(self.values, self.layer)


def rendered_rows(padded: PaddedParameters, motion: Motion, keys: Int[Tensor, "K"]) -> RenderedRows:
    """The rows that exist at any of these motion keys; without keys, before anything moves, all."""
    present = None
    if len(keys) and not padded.pads:
        present = motion.present(padded.binding, keys)
    rows = None if present is None else present.nonzero()[:, 0]
    return RenderedRows(
        values={name: _chosen(value, rows) for name, value in padded.values.items()},
        layer=None if padded.layer is None else _chosen(padded.layer, rows),
        binding=_chosen(padded.binding, rows),
        mean_weight=_chosen(padded.mean_weight, rows),
        rows=rows,
    )


class AllRows:
    """Gradients of some rows as gradients of all, in memory that the next step overwrites."""

    def __init__(self) -> None:
        self._memory: list[Tensor] = []

    def of(
        self, gradients: Iterable[Tensor | None], padded: PaddedParameters, rows: Int[Tensor, "N"]
    ) -> list[Tensor | None]:
        """Zero but in ``rows``; a gradient that is None stays None."""
        like = [*padded.values.values()]
        if [m.shape for m in self._memory] != [value.shape for value in like]:
            self._memory = [torch.empty_like(value, requires_grad=False) for value in like]
        return [
            None if gradient is None else memory.zero_().index_copy_(0, rows, gradient)
            for memory, gradient in zip(self._memory, gradients, strict=True)
        ]


def add_statistics(
    statistics: Statistics,
    rendered: RenderedRows,
    screens: list[ScreenGradient],
    size: tuple[int, int],
    step: descent.StepResults,
) -> None:
    """Add the images of a step, of this size [px], to the statistics of densification of all rows,
    if the step was valid.
    """
    sums = statistics.gradient, statistics.pixels, statistics.weight
    parts = [_chosen(whole, rendered.rows) for whole in sums]
    descent.add_statistics(screens, size, step, *parts)
    if rendered.rows is not None:
        for whole, part in zip(sums, parts, strict=True):
            whole.index_copy_(0, rendered.rows, part)


def _chosen(tensor: Tensor, rows: Int[Tensor, "N"] | None) -> Tensor:
    """Some rows of a tensor, without a gradient; None: the tensor itself."""
    return tensor if rows is None else tensor.detach().index_select(0, rows)
