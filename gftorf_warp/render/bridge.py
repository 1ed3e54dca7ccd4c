"""Where torch renders with Warp: shares memory, follows torch's stream, attaches gradients."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..scene.camera import Camera
from . import launch
from .buffers import Frame, RenderSettings
from .inputs import Images, Inputs, names_of

INPUTS = names_of(Inputs)
IMAGES = names_of(Images)
_VECTORS = {"mean": wp.vec3, "log_scale": wp.vec3, "quaternion": wp.vec4, "colour_sh": wp.vec3}


class Rasterize(torch.autograd.Function):
    """All images of one rendering from all inputs of one; each rendering has arrays of its own."""

    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        shifts: tuple[float, ...],
        settings: RenderSettings,
        screen: Tensor | None,
        *tensors: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Return the images in the order of ``IMAGES``, None where there is none.

        Args:
            ctx: Of autograd.
            camera: Where from.
            shifts: Phase shifts of the quads [rad].
            settings: How.
            screen: [N, 3] that backward fills with the screen gradient and the number of pixels; None: not wanted.
            tensors: In the order of ``INPUTS``, float32, contiguous, None where there is none.
        """
        ctx.set_materialize_grads(False)
        named = dict(zip(INPUTS, tensors, strict=True))
        mean, extra, colour_sh = named["mean"], named["extra"], named["colour_sh"]
        assert mean is not None
        size = camera.height, camera.width
        shapes = {"quads": (len(shifts), *size), "phasor": (3, *size), "distance": size, "opacity": size}
        shapes |= {"distortion": size}
        shapes |= {"colour": (3, *size)} if colour_sh is not None else {}
        shapes |= {"extra": (extra.shape[1], *size)} if extra is not None else {}
        images = {name: mean.new_empty(shapes[name]) for name in IMAGES if name in shapes}
        with stream_of(mean):
            device = wp.device_from_torch(mean.device)
            frame = Frame(len(mean), camera.width, camera.height, settings, device)
            view = launch.view_of(camera, settings)
            launch.forward(_inputs(named), view, shifts, frame, _images(images))
        ctx.save_for_backward(*tensors)
        ctx.state = view, shifts, frame, screen
        return tuple(images.get(name) for name in IMAGES)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        """Launch the adjoints explicitly: no tape, no state outside ``ctx``; gradients into fresh tensors."""
        named = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        view, shifts, frame, screen = ctx.state
        needed = dict(zip(INPUTS, ctx.needs_input_grad[4:], strict=True))
        wanted = {name: torch.zeros_like(named[name]) for name in INPUTS if needed[name]}
        cotangents = {name: g.contiguous() for name, g in zip(IMAGES, grads, strict=True) if g is not None}
        if cotangents and wanted:
            with stream_of(named["mean"]):
                records = launch.backward(_inputs(named), view, shifts, frame, _images(cotangents), _inputs(wanted))
                if screen is not None and len(screen):
                    found = wp.to_torch(records)  # a list of columns would be uploaded as an index
                    screen[:, :2], screen[:, 2] = found[:, :2], found[:, 6]
        return None, None, None, None, *(wanted.get(name) for name in INPUTS)


def _inputs(named: Mapping[str, Tensor | None]) -> Inputs:
    return Inputs(**{name: array_over(named.get(name), _VECTORS.get(name, wp.float32)) for name in INPUTS})


def _images(named: Mapping[str, Tensor]) -> Images:
    return Images(**{name: array_over(named.get(name), wp.float32) for name in IMAGES})


def array_over(tensor: Tensor | None, dtype=wp.float32) -> wp.array | None:
    """A Warp array over the memory of a tensor, without its history."""
    if tensor is None:
        return None
    wp.init()  # from_torch needs the runtime; does nothing after the first call
    if tensor.numel() == 0:  # strides of an empty tensor say nothing, and from_torch believes them
        shape = tensor.shape if dtype is wp.float32 else tensor.shape[:-1]
        return wp.empty(tuple(shape), dtype=dtype, device=wp.device_from_torch(tensor.device))
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def stream_of(tensor: Tensor):
    """Order launches with the torch work around them; on the CPU there is nothing to order."""
    wp.init()
    if tensor.is_cuda:
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)), sync_enter=False)
    return contextlib.nullcontext()
