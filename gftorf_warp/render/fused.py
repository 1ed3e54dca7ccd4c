"""Losses, random backgrounds and sums of a training step as kernels behind torch functions.

losses/ has the oracles of the losses in plain torch. The end of a step is descent.py.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.training import image_similarity, noise, optical_flow, ordered_sums
from ..scene.camera import Camera
from . import runtime
from .bridge import array_over
from .cuda import stream_of

RADIUS_MAX = 1e18  # of a lens without distortion: its square is a float32, too
BLOCK = 16  # pixels of a row, or elements of a tensor, per CPU thread
DTYPES = {torch.float16: wp.float16, torch.float32: wp.float32}
DTYPES |= {torch.int32: wp.int32, torch.int64: wp.int64}


def launch(
    kernel: Any, dim: Any, inputs: Sequence[Any], outputs: Sequence[Tensor], block_dim: int = 256
) -> None:
    """Launch a kernel over the memory of tensors, on torch's current stream;
    other inputs are passed on.
    """

    def argument(value: Any) -> Any:
        return array_over(value, DTYPES[value.dtype]) if isinstance(value, Tensor) else value

    with stream_of(outputs[0]):
        device = wp.device_from_torch(outputs[0].device)
        arrays = [argument(value) for value in inputs], [argument(value) for value in outputs]
        runtime.launch(kernel, dim, *arrays, device=device, block_dim=block_dim)


class Scratch:
    """Memory for image losses of one size; the backward pass of one precedes the next.

    Margins are zero and never written. Without it every loss allocates and clears its own.
    """

    def __init__(self) -> None:
        self._planes: dict[str, Tensor] = {}

    def planes(self, name: str, image: Tensor, count: int) -> Tensor:
        """[count, C, H, W + 10] zeroed when they are made."""
        channels, height, width = image.shape
        shape = count, channels, height, width + 2 * image_similarity.REACH
        planes = self._planes.get(name)
        if planes is None or planes.shape != shape or planes.device != image.device:
            self._planes[name] = planes = image.new_zeros(shape)
        return planes


def image_loss(
    rendered: Float[Tensor, "C H W"],
    measured: Float[Tensor, "#R C H W"],
    ssim: float,
    *,
    absolute: bool = False,
    row: Int[Tensor, "1"] | None = None,
    opacity: Float[Tensor, "H W"] | None = None,
    scratch: Scratch | None = None,
    out: Float[Tensor, "3"] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
    """(1 - ssim) times the mean squared or absolute difference + ssim (1 - SSIM), and the mean
    squared difference.

    Differentiable once, in ``rendered`` and through the first result only. Float32: where a window
    is nearly constant its variance is a difference of close numbers, as it is in losses/image.py.

    Args:
        rendered: What gradients reach.
        measured: What they do not reach; [R, C, H, W] or, without ``row``, [C, H, W].
        ssim: Share of the similarity.
        absolute: Whether the difference is its absolute value, not its square.
        row: int32, which image of ``measured``; read when the kernels run. None: the first.
        opacity: Of which the sum over C H W comes along, without a derivative; None: zero.
        scratch: Where to work; None: in memory of its own.
        out: Where results go; None: into memory of their own.

    Returns:
        The loss, the mean squared difference, and the sum of the opacity over C H W.

    Raises:
        ValueError: If the shapes differ or an image is not float32.
    """
    if rendered.shape != measured.shape[measured.ndim - 3 :]:
        shape = tuple(measured.shape[measured.ndim - 3 :])
        raise ValueError(
            f"rendered {tuple(rendered.shape)} and measured {shape} must have one shape"
        )
    for name, image in (("rendered", rendered), ("measured", measured)):
        if image.dtype != torch.float32 or image.device != rendered.device:
            want = f"float32 on {rendered.device}"
            raise ValueError(f"{name} is {image.dtype} on {image.device}, must be {want}")
    rows = measured.detach().contiguous().flatten(0, measured.ndim - 3)
    also = rendered.new_empty(0) if opacity is None else opacity.detach().contiguous().flatten()
    row = _first(rendered.device) if row is None else row
    out = rendered.new_empty(image_similarity.SUMS) if out is None else out
    return _ImageLoss.apply(
        rendered.contiguous(), rows, row, also, float(ssim), absolute, scratch or Scratch(), out
    )


@functools.cache
@torch.inference_mode(False)  # shared with later calls
def _first(device: torch.device) -> Tensor:
    """Row 0: an upload makes a GPU wait."""
    return torch.zeros(1, dtype=torch.int32, device=device)


class _ImageLoss(torch.autograd.Function):
    """Three launches forward, two backward; the order of all sums is fixed."""

    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        measured: Tensor,
        row: Tensor,
        also: Tensor,
        ssim: float,
        absolute: bool,
        scratch: Scratch,
        out: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        kernels, dim = _similarity_of(rendered)
        columns = scratch.planes("columns", rendered, image_similarity.MOMENTS)
        slopes = scratch.planes("slopes", rendered, image_similarity.SLOPES)
        threads, parts = _threads(dim[0] * dim[1] * dim[2], rendered)
        partials = rendered.new_empty(image_similarity.SUMS, parts)
        launch(kernels.columns_of_products, dim, [rendered, measured, row], [columns])
        inputs = [columns, rendered, measured, row, also, ssim, absolute]
        launch(kernels.compare_images, threads, inputs, [partials, slopes])
        _means(partials, 1.0 / rendered.numel(), out)
        loss, squared, other = out.unbind()
        ctx.save_for_backward(rendered, measured, row)
        ctx.options = ssim, absolute, slopes, columns[: image_similarity.SLOPES]
        ctx.mark_non_differentiable(squared, other)
        return loss, squared, other

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_loss: Tensor | None, *_: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        rendered, measured, row = ctx.saved_tensors
        if grad_loss is None:
            return (None,) * 8
        ssim, absolute, slopes, columns = ctx.options
        kernels, dim = _similarity_of(rendered)
        grad = torch.empty_like(rendered)
        launch(kernels.columns_of_slopes, dim, [slopes], [columns])
        scale = 1.0 / rendered.numel()
        inputs = [columns, rendered, measured, row, ssim, absolute, scale, grad_loss.reshape(1)]
        launch(kernels.gradient_of_image, dim, inputs, [grad])
        return grad, *[None] * 7


def _similarity_of(image: Float[Tensor, "C H W"]) -> tuple[Any, tuple[int, int, int]]:
    """Kernels for an image, and their number of threads."""
    channels, height, width = image.shape
    block = BLOCK if not image.is_cuda and width >= BLOCK else 1
    return image_similarity.make_similarity(block), (channels, height, -(-width // block))


def _threads(count: int, like: Tensor) -> tuple[int, int]:
    """Threads for so many elements, and their partial sums: one per warp of CUDA,
    per thread of a CPU.
    """
    if not like.is_cuda:
        return count, count
    parts = -(-count // ordered_sums.LANES)
    return parts * ordered_sums.LANES, parts


def _means(partials: Tensor, scale: float, out: Tensor) -> None:
    """Rows of partial sums, added up and scaled."""
    threads = ordered_sums.THREADS if partials.is_cuda else 1
    dim = len(partials) * threads
    launch(
        ordered_sums.means, dim, [partials, threads, scale], [out], block_dim=ordered_sums.THREADS
    )


def flow_loss(
    distance: Float[Tensor, "H W"],
    displacement: Float[Tensor, "D H W"],
    measured: Float[Tensor, "R F 2 H W"],
    cameras: Float[Tensor, "F V"],
    *,
    row: Int[Tensor, "1"] | None = None,
    out: Float[Tensor, "1"] | None = None,
) -> Float[Tensor, ""]:
    """Sum over F flows of the mean squared difference [px^2] to the flow of composited
    displacements.

    Differentiable once, in ``displacement``. The mean is over all pixels and both components;
    unknown ones count zero. losses/prior.py has the oracle.

    Args:
        distance: Of the surface [m], at least a micrometre where there is none.
        displacement: To the end of each flow [m], D = 3F channels in world axes.
        measured: The flows [px]; NaN: unknown.
        cameras: :func:`flow_cameras`; read when the kernels run.
        row: int32, which F flows; read when the kernels run. None: the first.
        out: Memory of the result; None: its own.

    Raises:
        ValueError: If shapes do not fit or a tensor is not float32.
    """
    flows, size = len(cameras), tuple(distance.shape)
    if tuple(displacement.shape) != (3 * flows, *size) or tuple(measured.shape[1:]) != (
        flows,
        2,
        *size,
    ):
        shapes = f"displacement {tuple(displacement.shape)} and measured {tuple(measured.shape)}"
        want = f"{(3 * flows, *size)} and (R, {flows}, 2, H, W) for {flows} flows of {size}"
        raise ValueError(f"{shapes} must be {want}")
    tensors = distance, displacement, measured, cameras
    if any(tensor.dtype != torch.float32 or tensor.device != distance.device for tensor in tensors):
        want = f"float32 on {distance.device}"
        raise ValueError(f"distance, displacement, measured and cameras must be {want}")
    row = _first(distance.device) if row is None else row
    out = distance.new_empty(1) if out is None else out
    flat = measured.detach().contiguous().flatten(0, 1)
    known = distance.detach().contiguous(), flat, row, cameras.contiguous()
    return _FlowLoss.apply(displacement.contiguous(), *known, out)


class _FlowLoss(torch.autograd.Function):
    """Two launches forward, one backward."""

    @staticmethod
    def forward(
        ctx: Any,
        displacement: Tensor,
        distance: Tensor,
        measured: Tensor,
        row: Tensor,
        cameras: Tensor,
        out: Tensor,
    ) -> Tensor:
        threads, parts = _threads(distance.numel(), distance)
        partials = distance.new_empty(1, parts)
        inputs = [distance, displacement, measured, row, cameras]
        launch(optical_flow.flow_errors, threads, inputs, [partials])
        _means(partials, 0.5 / distance.numel(), out)
        ctx.save_for_backward(*inputs)
        return out[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:
        distance, displacement, *_, cameras = ctx.saved_tensors
        grad, scale = torch.empty_like(displacement), 0.5 / distance.numel()
        inputs = [*ctx.saved_tensors, scale, grad_loss.reshape(1)]
        launch(optical_flow.flow_gradient, (len(cameras), distance.numel()), inputs, [grad])
        return grad, *[None] * 5


def flow_cameras(camera: Camera, later: Sequence[Camera]) -> Float[np.ndarray, "F V"]:
    """Rows of kernels/training/optical_flow.py: the camera at the start and at the end of F flows.

    V is 29, or 40 where any of them distorts.
    """
    lens = any(one.distortion for one in (camera, *later))
    here, rows = camera.camera_from_world, []
    for then in later:
        there = then.camera_from_world
        between = there @ np.linalg.inv(here)
        pinholes = [camera.fx, camera.fy, camera.cx, camera.cy, then.fx, then.fy, then.cx, then.cy]
        rows.append(
            [*pinholes, *between[:3, :3].flatten(), *between[:3, 3], *there[:3, :3].flatten()]
        )
        if lens:
            radius = min(then.guard.radius, RADIUS_MAX)
            rows[-1] += [*astuple(camera.distortion), *astuple(then.distortion), radius]
    return np.array(rows, dtype=np.float32)


def uniform(
    shape: tuple[int, ...], origin: Int[Tensor, "2"], amplitude: float, *, stream: int = 0
) -> Float[Tensor, "C H W"]:
    """Random light, evenly in (-amplitude, amplitude), that is a function of its arguments and of
    nothing else.

    Args:
        shape: (C, H, W).
        origin: Seed and number of the image, int32, where the light is wanted; read when the kernel
            runs.
        amplitude: Largest absolute value [quad units].
        stream: Tells several images of one number apart.
    """
    image = torch.empty(shape, dtype=torch.float32, device=origin.device)
    pixels = image.flatten(1)
    dim = len(pixels), -(-pixels.shape[1] // noise.PER_THREAD)
    launch(noise.uniform_noise, dim, [origin, stream, amplitude], [pixels])
    return image


def sum_for_gradients(weights: Sequence[Tensor], terms: Sequence[Tensor]) -> Float[Tensor, ""]:
    """A sum of terms times weights of which only gradients are wanted: they cost nothing, and it
    has no value.

    Terms are numbers or of any shape, each with a weight of its own shape.

    ``autograd.grad(terms, grad_outputs=weights)`` is equivalent, but torch checks the shapes of
    given gradients by sympy, whose import takes longer than the first thousand steps.
    """
    return _Sum.apply(list(weights), *terms)


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: list[Tensor], *terms: Tensor) -> Tensor:
        ctx.weights = weights
        return terms[0].new_empty(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        return None, *ctx.weights


def added(tensors: Sequence[Tensor | None]) -> Tensor | None:
    """The sum of tensors of one shape in their order, four per launch; None counts as zero.

    Without a derivative. The sum of one tensor is that tensor.
    """
    present = [tensor.detach().contiguous() for tensor in tensors if tensor is not None]
    while len(present) > 1:
        total, flat = torch.empty_like(present[0]), [tensor.flatten() for tensor in present[:4]]
        arrays = flat + flat[:1] * (4 - len(flat))
        launch(ordered_sums.add_up, total.numel(), [*arrays, len(flat)], [total.flatten()])
        present = [total, *present[4:]]
    return present[0] if present else None
