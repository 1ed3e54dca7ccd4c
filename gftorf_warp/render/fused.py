"""What a training step does beside rendering, as a few kernels behind torch functions: the second file that knows both.

losses/ and recon/ hold the same in plain torch, in any precision: the oracle of these functions, and what runs where
settings do not ask for kernels.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.similarity import MAPS, MOMENTS, REACH, SLOPES
from . import training
from .bridge import array_over, stream_of


def image_loss(
    rendered: Float[Tensor, "C H W"], measured: Float[Tensor, "C H W"], ssim: float, *, absolute: bool = False
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """(1 - ssim) times the mean squared or absolute difference + ssim (1 - SSIM), and the mean squared difference.

    Differentiable once, in ``rendered`` and through the first result only. Float32: where a window is nearly constant
    its variance is a difference of close numbers, as it is in losses/image.py.

    Raises:
        ValueError: If the shapes differ or an image is not float32.
    """
    if rendered.shape != measured.shape:
        raise ValueError(f"rendered {tuple(rendered.shape)} and measured {tuple(measured.shape)} must have one shape")
    for name, image in (("rendered", rendered), ("measured", measured)):
        if image.dtype != torch.float32 or image.device != rendered.device:
            want = f"float32 on {rendered.device}"
            raise ValueError(f"{name} is {image.dtype} on {image.device}, must be {want}")
    return _ImageLoss.apply(rendered.contiguous(), measured.detach().contiguous(), float(ssim), absolute)


class _ImageLoss(torch.autograd.Function):
    """Two launches forward, two backward; the mean is torch's, whose order of summation is fixed."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, measured: Tensor, ssim: float, absolute: bool) -> tuple[Tensor, Tensor]:
        maps = rendered.new_empty(MAPS, *rendered.shape)
        columns, slopes = (_margined(rendered, planes) for planes in (MOMENTS, SLOPES))
        with stream_of(rendered):
            images = array_over(rendered), array_over(measured)
            training.image_loss(*images, ssim, absolute, array_over(columns), array_over(maps), array_over(slopes))
        loss, squared = maps.flatten(1).mean(dim=1)
        ctx.save_for_backward(rendered, measured, slopes)
        ctx.options = ssim, absolute
        ctx.mark_non_differentiable(squared)
        return loss, squared

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        rendered, measured, slopes = ctx.saved_tensors
        grad, columns = torch.empty_like(rendered), _margined(rendered, SLOPES)
        ssim, absolute = ctx.options
        with stream_of(rendered):
            images = array_over(rendered), array_over(measured)
            rest = array_over(slopes), array_over(grad_loss.reshape(1)), array_over(columns), array_over(grad)
            training.image_loss_backward(*images, ssim, absolute, *rest)
        return grad, None, None, None


def _margined(image: Tensor, planes: int) -> Tensor:
    """Zeroed planes of the size of an image and a margin at both ends of its rows."""
    channels, height, width = image.shape
    return image.new_zeros(planes, channels, height, width + 2 * REACH)


def uniform(
    shape: tuple[int, ...], origin: Int[Tensor, "2"], amplitude: float, *, stream: int = 0
) -> Float[Tensor, "C H W"]:
    """Random light, evenly in (-amplitude, amplitude), that is a function of its arguments and of nothing else.

    Args:
        shape: (C, H, W).
        origin: Seed and number of the image, int32, where the light is wanted; read when the kernel runs.
        amplitude: Largest absolute value [quad units].
        stream: Tells several images of one number apart.
    """
    image = torch.empty(shape, dtype=torch.float32, device=origin.device)
    with stream_of(origin):
        training.uniform(array_over(origin, wp.int32), stream, amplitude, array_over(image.flatten(1)))
    return image


@dataclass(frozen=True, kw_only=True, eq=False)
class AdamTable:
    """Where the tensors of an Adam step lie. Good for as long as they do, so a captured graph may hold one."""

    rows: Int[Tensor, "T 6"]
    """Addresses and lengths, see ``kernels/adam.py``."""
    first_block: Int[Tensor, "T"]
    """Blocks of elements before those of a tensor."""
    sizes: Float[Tensor, "T 2"]
    """Scratch: what a step comes to."""
    blocks: int
    """Blocks in all."""
    kept: tuple[Tensor, ...]
    """The tensors themselves: an address keeps nothing alive."""


def adam_table(
    parameters: Sequence[Tensor], gradients: Sequence[Tensor], moments: Sequence[tuple[Tensor, Tensor, Tensor]]
) -> AdamTable:
    """Look up where T >= 1 tensors lie; an upload, so not for a stream that is being captured.

    Args:
        parameters: Float32, contiguous, on one device.
        gradients: Of their shapes.
        moments: (step, first moment, second moment) of each; the step is a float32 number on the same device.

    Raises:
        ValueError: If a tensor is not float32, not contiguous, elsewhere, or of another shape than its parameter.
    """
    device, rows = parameters[0].device, []
    kept: list[Tensor] = []
    for value, gradient, (step, first, second) in zip(parameters, gradients, moments, strict=True):
        named = value, gradient, first, second, step
        for tensor in named:
            if tensor.dtype != torch.float32 or tensor.device != device or not tensor.is_contiguous():
                raise ValueError(f"{tensor.dtype} on {tensor.device} must be contiguous float32 on {device}")
            if tensor is not step and tensor.shape != value.shape:
                raise ValueError(f"{tuple(tensor.shape)} must be {tuple(value.shape)}, the shape of the parameter")
        rows.append([*(tensor.data_ptr() for tensor in named), value.numel()])
        kept += named
    with stream_of(parameters[0]):
        width = training.adam_block(wp.device_from_torch(device))
    ends = list(itertools.accumulate(-(-row[-1] // width) for row in rows))
    return AdamTable(
        rows=torch.tensor(rows, dtype=torch.int64, device=device),
        first_block=torch.tensor([0, *ends[:-1]], dtype=torch.int32, device=device),
        sizes=torch.empty(len(rows), 2, dtype=torch.float32, device=device),
        blocks=ends[-1],
        kept=tuple(kept),
    )


def adam_step(
    table: AdamTable,
    rates: Float[Tensor, "T"],
    sound: Int[Tensor, "1"],
    *,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """One step of Adam over all tensors of a table, in place.

    Args:
        table: Which.
        rates: Learning rate of each; 0: the tensor is left alone, moments and step included.
        sound: int32; 0: nothing changes. Read when the kernel runs, as the rates are.
        betas: Decays of the moments.
        epsilon: Added to the root of the second moment.
    """
    with stream_of(rates):
        arrays = array_over(table.rows, wp.int64), array_over(table.first_block, wp.int32), table.blocks
        head = array_over(rates), array_over(sound, wp.int32)
        training.adam_step(*arrays, *head, betas, epsilon, array_over(table.sizes))
