"""Renders torch tensors with Warp: shares memory, uses torch's stream, attaches gradients."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.geometry import CameraView
from ..scene.camera import Camera
from . import launch, runtime
from .buffers import Buffers, RenderSettings, Workspace
from .control import DeviceCamera
from .cuda import stream_of
from .inputs import Images, Inputs, View, names_of, shapes_of

# A forked process, such as a worker of a DataLoader, has none of the threads that OpenMP would wait
# for; a worker does this itself.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=functools.partial(torch.set_num_threads, 1))

INPUTS = names_of(Inputs)
IMAGES = names_of(Images)
ALIGNED = 64  # [float32] to which parts of one memory are rounded
_VECTORS = {"mean": wp.vec3, "log_scale": wp.vec3, "quaternion": wp.vec4, "colour_sh": wp.vec3}


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """Arguments of a rendering without a derivative."""

    camera: Camera
    """Its size, and whether its lens distorts; without ``control`` all of it."""
    shifts: tuple[float, ...]
    """Phase shifts of the quads [rad]; with ``control`` only their number counts."""
    control: DeviceCamera | None = None
    """Camera and shifts in device memory; None: uploaded from ``camera`` and ``shifts``."""
    settings: RenderSettings
    """How."""
    screen: Tensor | None = None
    """[N, 4] that backward fills with screen gradient, pixels and weight, ``api.ScreenGradient``;
    None: not wanted."""
    images: frozenset[str]
    """Names of what is wanted of quads, phasor, distance, opacity and distortion; colour and extra
    always are."""
    workspace: Workspace | None = None
    """Where; None: in memory of its own."""
    extra_detached: bool = False
    """Whether extra images hold the weights fixed."""


class Rasterize(torch.autograd.Function):
    """All images of a rendering from all its inputs; arrays are new unless there is a workspace."""

    @staticmethod
    def forward(ctx: Any, request: Request, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the images in the order of ``IMAGES``, None where there is none.

        Args:
            ctx: Of autograd.
            request: What and how.
            tensors: In the order of ``INPUTS``, float32, contiguous, None where there is none.
        """
        ctx.set_materialize_grads(False)
        named = dict(zip(INPUTS, tensors, strict=True))
        mean, extra, colour_sh = named["mean"], named["extra"], named["colour_sh"]
        assert mean is not None
        camera, shifts = request.camera, request.shifts
        channels = 0 if extra is None else extra.shape[1]
        shapes = shapes_of(len(shifts), camera.height, camera.width, channels)
        optional = {"colour": colour_sh, "extra": extra}
        made = request.images | {name for name, of in optional.items() if of is not None}
        images = {name: mean.new_empty(shapes[name]) for name in IMAGES if name in made}
        with stream_of(mean):
            device = wp.device_from_torch(mean.device)
            kind = len(mean), camera.width, camera.height, request.settings, device
            buffers = (
                Buffers(*kind) if request.workspace is None else request.workspace.buffers(*kind)
            )
            view = _view(request, device)
            learns = any(ctx.needs_input_grad)  # otherwise these are the launches of a replay
            launch.forward(_inputs(named), view, buffers, _images(images), differentiable=learns)
        ctx.save_for_backward(*tensors)
        ctx.state = request, view, buffers, buffers.renderings
        if "distance_median" in images:
            ctx.mark_non_differentiable(images["distance_median"])
        return tuple(images.get(name) for name in IMAGES)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        """Launch the adjoints explicitly, without tape or global state, into new tensors."""
        named = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        request, view, buffers, rendering = ctx.state
        if buffers.renderings != rendering:
            raise ValueError(
                "its workspace has rendered again since: call backward before the "
                "next rendering with it"
            )
        screen = request.screen
        needed = dict(zip(INPUTS, ctx.needs_input_grad[1:], strict=True))
        wanted = _zeros_like({name: named[name] for name in INPUTS if needed[name]})
        cotangents = {
            name: g.contiguous() for name, g in zip(IMAGES, grads, strict=True) if g is not None
        }
        if cotangents and wanted:
            with stream_of(named["mean"]):
                arrays = _inputs(named), view, buffers, _images(cotangents), _inputs(wanted)
                records = launch.backward(*arrays, extra_detached=request.extra_detached)
                if screen is not None and len(screen):
                    # of slots: the first and the fourth
                    pairs = wp.to_torch(records).unflatten(1, (-1, 2))
                    screen.view(-1, 2, 2).copy_(pairs[:, 0:4:3])
        return None, *(wanted.get(name) for name in INPUTS)


def _view(request: Request, device: wp.Device) -> View:
    """Camera and shifts as kernels read them; arrays of ``control`` are those of its tensors."""
    camera, control = request.camera, request.control
    if control is None:
        return launch.uploaded(camera, request.shifts, request.settings, device)
    pointer = control.view.data_ptr()
    view = wp.array(ptr=pointer, dtype=CameraView, shape=(1,), device=device)
    return View(
        camera=view, shifts=array_over(control.shifts, wp.vec2), lens=bool(camera.distortion)
    )


def _zeros_like(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Zeros of these shapes in one allocation, cleared at once, aligned to cache lines."""
    if not tensors:
        return {}
    sizes = [-(-tensor.numel() // ALIGNED) * ALIGNED for tensor in tensors.values()]
    first = next(iter(tensors.values()))
    parts = first.new_zeros(sum(sizes)).split(sizes)
    return {
        name: part[: t.numel()].view(t.shape)
        for part, (name, t) in zip(parts, tensors.items(), strict=True)
    }


def _inputs(named: Mapping[str, Tensor | None]) -> Inputs:
    return Inputs(
        **{name: array_over(named.get(name), _VECTORS.get(name, wp.float32)) for name in INPUTS}
    )


def _images(named: Mapping[str, Tensor]) -> Images:
    return Images(**{name: array_over(named.get(name), wp.float32) for name in IMAGES})


def left_out(name: str, like: Tensor, height: int, width: int) -> Tensor:
    """An image that was not requested: no elements, on the device of ``like``."""
    return like.new_empty(0, *shapes_of(0, height, width)[name][1:])


def array_over(tensor: Tensor | None, dtype=wp.float32) -> wp.array | None:
    """A Warp array over the memory of a tensor, without its history."""
    if tensor is None:
        return None
    runtime.start()  # from_torch needs the runtime; does nothing after the first call
    # from_torch would use the strides of an empty tensor, which are undefined
    if tensor.numel() == 0:
        shape = tensor.shape[: tensor.ndim - len(getattr(dtype, "_shape_", ()))]
        return wp.empty(tuple(shape), dtype=dtype, device=wp.device_from_torch(tensor.device))
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def pairs_of(workspace: Workspace) -> Tensor:
    """[1] int32 on the device: (tile, splat) pairs of the last rendering; above the capacity if
    some were dropped.

    Raises:
        ValueError: If nothing has been rendered there.
    """
    return wp.to_torch(workspace.last.total)
