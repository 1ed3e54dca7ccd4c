"""The end of a training step as three launches: validity, Adam, running sums and statistics.

torch's Adam is the oracle of this one (tests/test_fused.py).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..kernels.training import step_end
from ..kernels.training.adam import COLUMNS, GRADIENT, GRADIENTS, LENGTH, MORE, SIZES, make_adam
from ..kernels.training.ordered_sums import LANES
from ..kernels.training.step_end import COLUMNS_MAX, PART, RENDERINGS_MAX, RESULTS, TOTALS
from .api import ScreenGradient
from .fused import BLOCK, launch

TOTAL_NAMES = ("quad_mse", "opacity", "loss", "count")
"""Names of the sums besides those of the terms, in the order of the kernel."""


class AdamTable:
    """Addresses of what the end of a step reads: parameters, moments, gradients, pair counts.

    Valid as long as these tensors live. Gradients and counts may have other addresses in the next
    step: :meth:`point` notes them, :meth:`send` uploads them. A CUDA graph may read the table: it
    is captured between the two, and replayed after both.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        moments: Sequence[tuple[Tensor, Tensor, Tensor]],
    ):
        """Collect the addresses of T >= 1 tensors; uploads, so not while a stream is captured.

        Args:
            parameters: Float32, contiguous, on one device.
            moments: (step, first moment, second moment) of each; the step is a float32 number
                there.

        Raises:
            ValueError: If a tensor has another type, shape or device, or is not contiguous.
        """
        device = parameters[0].device
        self._parameters, self._moments = list(parameters), list(moments)
        self._host = []
        for value, (step, first, second) in zip(parameters, moments, strict=True):
            for tensor in (value, first, second, step):
                _check(tensor, device, None if tensor is step else value.shape)
            state = [tensor.data_ptr() for tensor in (first, second, step)]
            self._host.append([value.data_ptr(), 0, *state, value.numel(), *[0] * (GRADIENTS - 1)])
        width = _adam_block(parameters[0])
        ends = list(itertools.accumulate(-(-row[LENGTH] // width) for row in self._host))
        parts = list(itertools.accumulate(-(-row[LENGTH] // PART) for row in self._host))
        count = len(self._host)
        self.rows = torch.empty(count, COLUMNS, dtype=torch.int64, device=device)
        """[T, 9] addresses and lengths, see ``kernels/training/adam.py``."""
        self.first_block = torch.tensor([0, *ends[:-1]], dtype=torch.int32, device=device)
        """[T] number of Adam's blocks before those of a tensor."""
        self.sizes = torch.empty(count, SIZES, dtype=torch.float32, device=device)
        """[T, 3] scratch: step sizes."""
        self.blocks = ends[-1]
        """Number of Adam's blocks."""
        self.parts = [0, *parts]
        """Number of parts of gradients before those of a tensor, and in all."""
        self.first_part = torch.tensor(self.parts[:-1], dtype=torch.int32, device=device)
        """The same on the device."""
        self.partials = torch.empty(parts[-1], dtype=torch.float32, device=device)
        """[P] scratch: sums of squares."""
        self.pairs = torch.zeros(RENDERINGS_MAX, dtype=torch.int64, device=device)
        """[R or more] addresses of the numbers of (tile, splat) pairs of renderings."""
        self.renderings = 0
        """Number R of renderings."""
        self._pairs_host: list[int] = []
        self._gradients: list[Tensor] = []
        self.send()

    def point(
        self,
        gradients: Sequence[Sequence[Tensor | None]],
        pairs: Sequence[Int[Tensor, "1"]] = (),
    ) -> None:
        """Note where gradients and pair counts are, without an upload.

        Args:
            gradients: One to four lists with a gradient of every tensor, or None; they are summed.
            pairs: (tile, splat) pairs of every rendering of the step, int32; their memory must
                stay.

        Raises:
            ValueError: As above, or if there are more renderings than the kernel has memory for.
        """
        if len(pairs) > RENDERINGS_MAX:
            raise ValueError(f"{len(pairs)} renderings, at most {RENDERINGS_MAX} per step")
        self.renderings, self._pairs_host = len(pairs), [count.data_ptr() for count in pairs]
        self._gradients = []
        for row, value, *given in zip(self._host, self._parameters, *gradients, strict=True):
            present = [gradient for gradient in given if gradient is not None]
            for gradient in present:
                _check(gradient, value.device, value.shape)
            addresses = [gradient.data_ptr() for gradient in present]
            row[GRADIENT], *row[MORE:] = addresses + [0] * (GRADIENTS - len(present))
            self._gradients += present  # an address keeps no memory alive

    def send(self) -> None:
        """Upload the addresses; waits for the device."""
        self.rows.copy_(torch.tensor(self._host, dtype=torch.int64))
        if self.renderings:
            counts = torch.tensor(self._pairs_host, dtype=torch.int64)
            self.pairs[: self.renderings].copy_(counts)

    def release(self) -> None:
        """Drop the references to gradients, whose memory belongs to a captured graph."""
        self._gradients = []


def _check(tensor: Tensor, device: torch.device, shape: torch.Size | None) -> None:
    if tensor.dtype != torch.float32 or tensor.device != device or not tensor.is_contiguous():
        raise ValueError(
            f"{tensor.dtype} on {tensor.device} must be contiguous float32 on {device}"
        )
    if shape is not None and tensor.shape != shape:
        raise ValueError(
            f"{tuple(tensor.shape)} must be {tuple(shape)}, the shape of the parameter"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StepResults:
    """What the steps of one run count and sum up on the device."""

    results: Float[Tensor, "B L3"]
    """Unweighted results of the latest step: of every image and term the term, its mean squared
    difference, its mean opacity."""
    counts: Int[Tensor, "4"]
    """Skipped steps, skipped steps in a row, most pairs of a rendering, steps with too many
    pairs."""
    sums: Float[Tensor, "S"]
    """Weighted terms over the images of valid steps, then those of ``TOTAL_NAMES``."""

    @classmethod
    def empty(cls, images: int, terms: int, device: torch.device) -> StepResults:
        """Before the first step, for at most so many images and terms.

        Raises:
            ValueError: If the kernel has no memory for so many.
        """
        if RESULTS * terms > COLUMNS_MAX:
            raise ValueError(f"{terms} terms, at most {COLUMNS_MAX // RESULTS} per step")
        return cls(
            results=torch.zeros(images, RESULTS * terms, device=device),
            counts=torch.zeros(4, dtype=torch.int32, device=device),
            sums=torch.zeros(terms + TOTALS, device=device),
        )


def descend(
    table: AdamTable,
    rates: Float[Tensor, "T"],
    step: StepResults,
    weights: Float[Tensor, "B L3"],
    compared: Float[Tensor, "1"],
    *,
    images: int,
    motion_from: int,
    motion_gradient_max: float | None,
    capacity: int | None,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Adam along the mean gradient of some images, if the step is valid; nothing is read back.

    A step is valid if its loss and all squared gradients are finite and no pair was dropped.

    Args:
        table: All tensors; its gradients are summed over images. With pairs of all renderings.
        rates: Learning rate of each tensor; one of rate 0 is left alone.
        step: Results of this step, and the sums that it adds to.
        weights: Of the results; 0 for those that were not computed.
        compared: Number of images with any term.
        images: Number of images B.
        motion_from: First tensor of the motion.
        motion_gradient_max: Largest gradient norm of these tensors, longer ones are clipped; None:
            any.
        capacity: Pairs with memory in a rendering, the others were dropped; None: as many as there
            are.
        betas: Decays of the moments.
        epsilon: Added to the root of the second moment.
    """
    lanes = LANES if rates.is_cuda else 1
    launch(
        step_end.gradient_squares,
        len(table.partials) * lanes,
        [table.rows, table.first_part],
        [table.partials],
    )
    inputs = [table.partials, table.parts[motion_from], motion_from]
    inputs += [motion_gradient_max is not None, motion_gradient_max or 0.0]
    inputs += [step.results, weights, images, compared, table.pairs, table.renderings]
    inputs += [capacity is not None, capacity or 0, table.rows, rates, *map(wp.float64, betas)]
    threads, outputs = (
        (step_end.THREADS if rates.is_cuda else 1),
        [step.counts, step.sums, table.sizes],
    )
    launch(step_end.finish_step, threads, inputs, outputs, block_dim=step_end.THREADS)
    inputs = [table.rows, table.first_block, *(1.0 - beta for beta in betas), epsilon]
    launch(make_adam(_adam_block(rates)), table.blocks, inputs, [table.sizes])


def _adam_block(like: Tensor) -> int:
    """Elements of a tensor per thread of Adam."""
    return 1 if like.is_cuda else BLOCK


def add_statistics(
    screens: Sequence[ScreenGradient],
    size: tuple[int, int],
    step: StepResults,
    gradient: Float[Tensor, "N"],
    pixels: Float[Tensor, "N"],
    weight: Float[Tensor, "N"],
) -> None:
    """Add the images of a step to the statistics of densification, if the step was valid.

    Args:
        screens: Of the images, after the backward pass.
        size: Columns and rows of the images.
        step: Tells on the device whether the step was valid.
        gradient: Sum of pixels times screen gradient, in half image sizes; changed.
        pixels: Sum of pixels; changed.
        weight: Sum of weights in them; changed.
    """
    if not len(gradient):
        return
    half, sums = wp.vec2(0.5 * size[0], 0.5 * size[1]), [gradient, pixels, weight]
    for begin in range(0, len(screens), step_end.SCREENS):
        values = [screen.values for screen in screens[begin : begin + step_end.SCREENS]]
        values += values[:1] * (step_end.SCREENS - len(values))
        count = min(len(screens) - begin, step_end.SCREENS)
        launch(step_end.add_statistics, len(gradient), [*values, count, half, step.counts], sums)
