"""The end of a step, behind its gradients, as a few kernels: whether it counts, Adam, running sums and statistics.

recon/ holds the same in plain torch: torch's Adam is the oracle of this one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..kernels.training.adam import COLUMNS, GRADIENT, GRADIENTS, LENGTH, MORE, SIZES
from ..kernels.training.step_end import FOUND, PART, SUMS
from . import training
from .api import ScreenGradient
from .bridge import array_over
from .cuda import stream_of

FOUND_NAMES = ("quads", "quad_mse", "opacity", "flow", "distortion", "motion_size")
"""What is found of an image, in the order of the kernel."""
SUM_NAMES = (*FOUND_NAMES, "loss", "count")
"""What is summed up over images."""


class AdamTable:
    """Where the tensors of an Adam step lie. Good for as long as they do, so a captured graph may hold one.

    Gradients may lie elsewhere in the next step: :meth:`point` finds them, :meth:`send` tells the device, and may do so
    after a graph that reads the table was captured, and before it is replayed.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        gradients: Sequence[Tensor | None],
        moments: Sequence[tuple[Tensor, Tensor, Tensor]],
    ):
        """Look up where T >= 1 tensors lie; an upload, so not for a stream that is being captured.

        Args:
            parameters: Float32, contiguous, on one device.
            gradients: Of their shapes; None: there is none, the tensor is left alone.
            moments: (step, first moment, second moment) of each; the step is a float32 number on the same device.

        Raises:
            ValueError: If a tensor is not float32, not contiguous, elsewhere, or of another shape than its parameter.
        """
        device = parameters[0].device
        self._parameters, self._moments = list(parameters), list(moments)
        rows = []
        for value, (step, first, second) in zip(parameters, moments, strict=True):
            for tensor in (value, first, second, step):
                _check(tensor, device, None if tensor is step else value.shape)
            none = [0] * (GRADIENTS - 1)
            rows.append([value.data_ptr(), 0, *(t.data_ptr() for t in (first, second, step)), value.numel(), *none])
        self._host = rows
        with stream_of(parameters[0]):
            width = training.adam_block(wp.device_from_torch(device))
        ends = list(itertools.accumulate(-(-row[LENGTH] // width) for row in rows))
        parts = list(itertools.accumulate(-(-row[LENGTH] // PART) for row in rows))
        self.rows = torch.empty(len(rows), COLUMNS, dtype=torch.int64, device=device)
        """[T, 9] addresses and lengths, see ``kernels/training/adam.py``."""
        self.first_block = torch.tensor([0, *ends[:-1]], dtype=torch.int32, device=device)
        """[T] blocks of elements before those of a tensor."""
        self.sizes = torch.empty(len(rows), SIZES, dtype=torch.float32, device=device)
        """[T, 3] scratch: what a step comes to."""
        self.blocks = ends[-1]
        """Blocks in all."""
        self.parts = [0, *parts]
        """Parts of gradients, whose squares are added up at once, before those of a tensor, and in all."""
        self.first_part = torch.tensor(self.parts[:-1], dtype=torch.int32, device=device)
        """The same on the device."""
        self.partials = torch.empty(parts[-1], dtype=torch.float32, device=device)
        """[P] scratch: sums of squares."""
        self.point(gradients)
        self.send()

    def point(self, *gradients: Sequence[Tensor | None]) -> None:
        """Note where gradients lie, without telling the device: one to four lists of them, of which the sums count.

        Raises:
            ValueError: As above.
        """
        self._gradients = []
        for row, value, *found in zip(self._host, self._parameters, *gradients, strict=True):
            present = [gradient for gradient in found if gradient is not None]
            for gradient in present:
                _check(gradient, value.device, value.shape)
            row[GRADIENT], *row[MORE:] = [g.data_ptr() for g in present] + [0] * (GRADIENTS - len(present))
            self._gradients += present  # an address keeps nothing alive

    def send(self) -> None:
        """Tell the device; waits for it."""
        self.rows.copy_(torch.tensor(self._host, dtype=torch.int64))

    def release(self) -> None:
        """Let go of the gradients, whose memory belongs to a graph that was captured."""
        self._gradients = []


def _check(tensor: Tensor, device: torch.device, shape: torch.Size | None) -> None:
    if tensor.dtype != torch.float32 or tensor.device != device or not tensor.is_contiguous():
        raise ValueError(f"{tensor.dtype} on {tensor.device} must be contiguous float32 on {device}")
    if shape is not None and tensor.shape != shape:
        raise ValueError(f"{tuple(tensor.shape)} must be {tuple(shape)}, the shape of the parameter")


@dataclass(frozen=True, kw_only=True, eq=False)
class Ledger:
    """What one run counts and sums up on its device."""

    found: Float[Tensor, "B F"]
    """Of each image of a step, in the order of ``FOUND_NAMES``, without weights."""
    counts: Int[Tensor, "4"]
    """Steps that failed, in a row, and the most pairs of an image."""
    sums: Float[Tensor, "S"]
    """Over images of sound steps, in the order of ``SUM_NAMES``, with weights."""

    @classmethod
    def empty(cls, images: int, device: torch.device) -> Ledger:
        """Nothing happened yet; a step has up to so many images."""
        return cls(
            found=torch.zeros(images, FOUND, device=device),
            counts=torch.zeros(4, dtype=torch.int32, device=device),
            sums=torch.zeros(SUMS, device=device),
        )


def descend(
    table: AdamTable,
    rates: Float[Tensor, "T"],
    ledger: Ledger,
    weights: Sequence[float],
    *,
    motion_from: int,
    motion_gradient_max: float | None,
    pairs: Sequence[Int[Tensor, "1"]],
    capacity: int,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """A step of Adam along the mean gradient of some images, if it is sound; three launches, and nobody waits.

    A step is sound if its loss and all squared gradients are finite and no pair was dropped.

    Args:
        table: Of all tensors; its gradients are sums over images.
        rates: Learning rate of each; 0: the tensor is left alone.
        ledger: Changed.
        weights: Of what was found: of terms their weight, of others 1, of what this step does not find 0.
        motion_from: First tensor of the motion.
        motion_gradient_max: Longest gradient of these tensors, a longer one is shortened; None: any.
        pairs: (tile, splat) pairs of each image, 1 to 4 of them, int32.
        capacity: Pairs that are reserved; -1: not known; 0: nobody counts.
        betas: Decays of the moments.
        epsilon: Added to the root of the second moment.
    """
    with stream_of(rates):
        rows, sizes = array_over(table.rows, wp.int64), array_over(table.sizes)
        counted = [array_over(number, wp.int32) for number in pairs]
        training.judge(
            rows,
            array_over(table.first_part, wp.int32),
            array_over(table.partials),
            (table.parts[motion_from], motion_from),
            motion_gradient_max or 0.0,
            array_over(ledger.found),
            tuple(weights),
            counted,
            capacity,
            array_over(rates),
            betas,
            array_over(ledger.counts, wp.int32),
            array_over(ledger.sums),
            sizes,
        )
        training.adam_step(rows, array_over(table.first_block, wp.int32), table.blocks, betas, epsilon, sizes)


def observe(
    screens: Sequence[ScreenGradient],
    size: tuple[int, int],
    ledger: Ledger,
    gradient: Float[Tensor, "N"],
    pixels: Float[Tensor, "N"],
    weight: Float[Tensor, "N"],
) -> None:
    """Add one to four images to what densification looks at, if the step was sound.

    Args:
        screens: Of one to four images, after the backward pass.
        size: Columns and rows of the images.
        ledger: What says whether the step was sound.
        gradient: Sum of pixels times screen gradient, in half image sizes; changed.
        pixels: Sum of pixels; changed.
        weight: Sum of weights in them; changed.
    """
    if not len(gradient):
        return
    with stream_of(gradient):
        half = 0.5 * size[0], 0.5 * size[1]
        arrays = [array_over(screen.values) for screen in screens]
        counts = array_over(ledger.counts, wp.int32)
        training.observe(arrays, half, counts, [array_over(sums) for sums in (gradient, pixels, weight)])
