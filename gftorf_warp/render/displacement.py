"""Displaced Gaussians: a motion at K keys, interpolated to the time of an image by one kernel
(kernels/motion).
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.motion.displace import make_displace
from ..scene.motion import KeyMotion
from . import runtime
from .bridge import array_over
from .cuda import stream_of


def displaced(
    mean: Float[Tensor, "N 3"],
    quaternion: Float[Tensor, "N 4"],
    motion: KeyMotion,
    weights: Float[Tensor, "R K"],
    *,
    channels: bool,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"], Float[Tensor, "N C"] | None]:
    """Centres and orientations at one time, and displacements between pairs of times.

    Differentiable once, in ``mean``, ``quaternion`` and both parts of ``motion``.

    Args:
        mean: Undisplaced centres [m].
        quaternion: Undisplaced orientations wxyz, of any length but zero.
        motion: Displacements [m] and rotations at K keys.
        weights: R = 1 + D rows over the keys, read when the kernel runs: interpolation weights of
            the time; then, for each channel, the weights of the end of a flow minus those of its
            start.
        channels: Whether the third result is computed, C = 3 D.

    Returns:
        Centres; orientations, which are ``quaternion`` itself if the motion has no rotations;
        channels.

    Raises:
        ValueError: If the numbers of keys disagree or something is not float32.
    """
    offset, rotation = motion
    if weights.ndim != 2 or weights.shape[1] != len(offset):
        raise ValueError(
            f"weights {tuple(weights.shape)} must be (1 + D, {len(offset)}) for {len(offset)} keys"
        )
    tensors = (mean, quaternion, offset, rotation, weights)
    wrong = [t.dtype for t in tensors if t is not None and t.dtype != mean.dtype]
    if wrong or mean.dtype != torch.float32:
        raise ValueError(
            f"mean, quaternion, motion and weights must be float32, got {mean.dtype} and {wrong}"
        )
    turning = None if rotation is None else quaternion
    given = [t if t is None else t.contiguous() for t in (mean, offset, turning, rotation)]
    moved, turned, ways = _Displaced.apply(*given, weights, channels)
    return moved, quaternion if turned is None else turned, ways


class _Displaced(torch.autograd.Function):
    """One launch forward, one backward."""

    @staticmethod
    def forward(
        ctx: Any,
        mean: Tensor,
        offset: Tensor,
        quaternion: Tensor | None,
        rotation: Tensor | None,
        weights: Tensor,
        channels: bool,
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        ctx.set_materialize_grads(False)
        moved = torch.empty_like(mean)
        turned = None if quaternion is None else torch.empty_like(quaternion)
        ways = mean.new_empty(len(mean), 3 * (len(weights) - 1)) if channels else None
        inputs = [*_vectors(mean, quaternion, offset, rotation), array_over(weights)]
        _launch("displace", offset, inputs, [*_vectors(moved, turned), _triples(ways)])
        ctx.save_for_backward(offset, quaternion, rotation, weights)
        return moved, turned, ways

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_moved: Tensor | None, by_turned: Tensor | None, by_ways: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        offset, quaternion, rotation, weights = ctx.saved_tensors
        _, of_offset, of_quaternion, of_rotation, *_ = ctx.needs_input_grad
        of_offset = of_offset and not (by_moved is None and by_ways is None)
        turned = by_turned is not None
        wanted = of_offset, of_rotation and turned, of_quaternion and turned
        grads = [
            torch.empty_like(tensor) if needed else None
            for tensor, needed in zip((offset, rotation, quaternion), wanted, strict=True)
        ]
        if any(wanted):
            moved, turns, ways = (
                None if cotangent is None else cotangent.contiguous()
                for cotangent in (by_moved, by_turned, by_ways)
            )
            inputs = [*_vectors(quaternion, rotation), array_over(weights)]
            inputs += [*_vectors(moved, turns), _triples(ways)]
            _launch("displace_backward", offset, inputs, _vectors(*grads))
        grad_offset, grad_rotation, grad_quaternion = grads
        return by_moved, grad_offset, grad_quaternion, grad_rotation, None, None


def _vectors(*tensors: Tensor | None) -> list[wp.array | None]:
    """Warp arrays of the vectors in the last dimension, three or four numbers each."""
    kinds = {3: wp.vec3, 4: wp.vec4}
    return [
        None if tensor is None else array_over(tensor, kinds[tensor.shape[-1]])
        for tensor in tensors
    ]


def _triples(channels: Float[Tensor, "N C"] | None) -> wp.array | None:
    """Channels as [N, D] vectors."""
    return None if channels is None else array_over(channels.unflatten(1, (-1, 3)), wp.vec3)


def _launch(kernel: str, offset: Float[Tensor, "K N 3"], inputs: list, outputs: list) -> None:
    """One thread per Gaussian, on torch's stream."""
    keys, count, _ = offset.shape
    with stream_of(offset):
        device = wp.device_from_torch(offset.device)
        runtime.launch(getattr(make_displace(keys), kernel), count, inputs, outputs, device=device)
