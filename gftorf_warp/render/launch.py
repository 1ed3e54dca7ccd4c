"""Which kernels run, in which order, forward and backward. Warp arrays only, no torch.

A Warp program renders with

    buffers = Buffers(count, width, height, settings, device)
    with wp.Tape() as tape:
        render(inputs, uploaded(camera, shifts, settings, device), buffers, images)
    tape.backward(grads={images.quads: ...})

and finds gradients added to the ``.grad`` of its inputs. torch programs come through bridge.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ..kernels.geometry import CameraView
from ..kernels.rasterise import splat
from ..kernels.rasterise.composite import CHANNEL_PLANES
from ..scene.camera import Camera
from . import stages
from .buffers import Buffers, RenderSettings
from .inputs import Images, Inputs, View, channel_groups, gradients_in, names_of, present_in

__all__ = ["Images", "Inputs", "backward", "forward", "render", "uploaded", "view_bits", "view_of"]

VIEW_DTYPE = np.dtype(CameraView.numpy_dtype())
UPLOADED_MAX = 1024  # cameras that are kept on devices, some 150 bytes each


def view_of(camera: Camera, settings: RenderSettings) -> CameraView:
    """The camera as kernels read it."""
    view = CameraView()
    pose = camera.camera_from_world
    view.rotation = wp.mat33(pose[:3, :3].astype(np.float32))
    view.translation = wp.vec3(*pose[:3, 3])
    view.centre = wp.vec3(*camera.centre)
    view.fx, view.fy, view.cx, view.cy = camera.fx, camera.fy, camera.cx, camera.cy
    view.width, view.height = camera.width, camera.height
    view.near, view.far, view.low_pass = settings.near, settings.far, settings.low_pass
    if camera.distortion:
        view.guard_x, view.guard_y, view.radius = camera.guard
        view.k1, view.k2, view.p1, view.p2, view.k3 = astuple(camera.distortion)
    return view


def view_bits(camera: Camera, settings: RenderSettings) -> np.ndarray:
    """[1] the same as a record of NumPy, laid out as on a device."""
    return np.array([view_of(camera, settings).numpy_value()], dtype=VIEW_DTYPE)


def uploaded(
    camera: Camera, shifts: Sequence[float], settings: RenderSettings, device: wp.Device
) -> View:
    """Camera and shifts [rad] in device memory; copied once, however often they are rendered."""
    return _uploaded(
        view_bits(camera, settings).tobytes(), tuple(shifts), bool(camera.distortion), str(device)
    )


@lru_cache(maxsize=UPLOADED_MAX)
def _uploaded(bits: bytes, shifts: tuple[float, ...], lens: bool, device: str) -> View:
    camera = np.frombuffer(bits, dtype=VIEW_DTYPE)
    vectors = np.array([(math.cos(shift), math.sin(shift)) for shift in shifts], np.float32)
    return View(
        camera=wp.array(camera, dtype=CameraView, device=device),
        shifts=wp.array(vectors.reshape(-1, 2), dtype=wp.vec2, device=device),
        lens=lens,
    )


def render(inputs: Inputs, view: View, buffers: Buffers, images: Images) -> None:
    """Fill the images that are not None; an active ``wp.Tape`` records the adjoint."""
    forward(inputs, view, buffers, images)
    tape = wp._src.context.runtime.tape  # the public API has no name for the active tape
    if tape is not None:
        both = [*present_in(inputs).values(), *present_in(images).values()]
        arrays = [array for array in both if array.requires_grad]

        def adjoint():
            cotangents = Images(**dict.fromkeys(names_of(Images)) | gradients_in(images))
            wanted = Inputs(**dict.fromkeys(names_of(Inputs)) | gradients_in(inputs))
            backward(inputs, view, buffers, cotangents, wanted)

        tape.record_func(adjoint, arrays)


def forward(
    inputs: Inputs, view: View, buffers: Buffers, images: Images, *, differentiable: bool = True
) -> None:
    """Project, sort, composite, resolve; images that are None are not computed."""
    buffers.renderings += 1
    groups = channel_groups(inputs)
    buffers.channels = [
        buffers.planes(f"channels {number}", CHANNEL_PLANES) for number in range(len(groups))
    ]
    buffers.records = [buffers.splats]
    if buffers.count:
        stages.project(inputs, view, buffers)
    for number, (name, start) in enumerate(groups):  # before lists are made: that has few threads
        if number > 0:
            buffers.records.append(buffers.array(f"records {number}", buffers.count, splat.Splat))
        if name == "extra":
            stages.set_channels(buffers, inputs, start, buffers.records[number])
    if buffers.count:
        stages.sort_by_depth(buffers)
        stages.sort_by_tile(buffers)
    else:
        buffers.first.zero_()
    for number in [0, *range(max(1, buffers.groups_with_light), len(buffers.records))]:
        stages.composite(
            inputs,
            buffers,
            number,
            images.distortion is not None,
            median=images.distance_median is not None,
            differentiable=differentiable,
        )
    stages.resolve_images(inputs, view, buffers, images, groups)


def backward(
    inputs: Inputs,
    view: View,
    buffers: Buffers,
    cotangents: Images,
    wanted: Inputs,
    *,
    extra_detached: bool = False,
) -> wp.array:
    """Add the gradients for ``cotangents`` to the arrays of ``wanted``.

    With ``extra_detached`` weights are held fixed under the extra images.

    Returns:
        [N] gradient records of the splats, which belong to the buffers: slots 0 and 1 are the
        screen gradient, 6 the number of pixels, 7 the weight.
    """
    groups = channel_groups(inputs)
    grad_light, grad_channels = stages.fold_images(
        inputs, view, buffers, cotangents, wanted, groups
    )
    grad_splats = buffers.zeros("gradient records", buffers.count, splat.Splat)
    if not buffers.count:
        return grad_splats
    fixed = [name == "extra" and extra_detached for name, _ in groups]
    first: dict[str, Any] = {"distortion": cotangents.distortion is not None}
    first["fixed"] = bool(groups) and fixed[0]
    together = buffers.groups_with_light > 1 and fixed[1] and grad_channels[1] is not None
    if together:
        label = "gradient records of the second group"
        first["grad_more"] = grad_channels[1]
        first["more_records"] = buffers.zeros(label, buffers.count, splat.Splat)
    first["grad_calibration"] = wanted.calibration
    given = inputs, buffers
    stages.composite_backward(*given, 0, grad_light, grad_channels[0], grad_splats, **first)
    for number, (name, start) in enumerate(groups):
        if grad_channels[number] is None:
            continue
        records = grad_splats
        if number == 1 and together:
            records = first["more_records"]
        elif number > 0:  # a further pass shares centres, conics and opacities with the first
            label = "gradient records of a further pass"
            records = buffers.zeros(label, buffers.count, splat.Splat)
            stages.composite_backward(
                *given, number, grad_light, grad_channels[number], records, fixed=fixed[number]
            )
            if not fixed[number]:
                stages.add_geometry(records, grad_splats)
        if name == "extra" and wanted.extra is not None:
            stages.take_channels(records, start, wanted)
    stages.finish(buffers, grad_splats)
    stages.project_backward(inputs, view, buffers, grad_splats, wanted)
    return grad_splats
