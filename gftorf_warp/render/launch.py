"""Which kernels run, in which order, forward and backward. Warp arrays in, Warp arrays filled; knows no torch.

A Warp program renders with

    frame = Frame(count, width, height, extra, settings, device)
    with wp.Tape() as tape:
        render(inputs, view, frame, images)
    tape.backward(grads={images.quads: ...})

and finds gradients added to the ``.grad`` of its inputs. torch programs come through bridge.py.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise

import numpy as np
import warp as wp

from ..kernels import resolve, splat, tiles
from ..kernels.composite import CHANNEL_PLANES, make_composite
from ..kernels.composite_backward import GRAD_LIGHT_PLANES, GRAD_TRANSMITTANCE, finish_moments, make_composite_backward
from ..kernels.geometry import CameraView
from ..kernels.project import make_project
from ..scene.camera import Camera
from .buffers import ClampGradient, Distortion, Frame, RenderSettings, Stop, Support


@dataclass(kw_only=True, eq=False)
class Inputs:
    """Everything a rendering is differentiable in, as Warp arrays of one device; None: absent.

    A gradient set has the same fields: None there means 'not wanted'.
    """

    mean: wp.array | None  # [N] vec3
    log_scale: wp.array | None  # [N] vec3
    quaternion: wp.array | None  # [N] vec4
    opacity_logit: wp.array | None  # [N]
    reflectivity_sh: wp.array | None  # [N, 16]
    colour_sh: wp.array | None = None  # [N, 16] vec3
    calibration: wp.array | None  # [4] phase slope [rad/m], phase offset [rad], source intensity, DC offset
    background_quads: wp.array | None = None  # [Q, H, W]
    background_phasor: wp.array | None = None  # [3, H, W]
    background_colour: wp.array | None = None  # [3, H, W]
    extra: wp.array | None = None  # [N, D]


@dataclass(kw_only=True, eq=False)
class Images:
    """Everything a rendering fills, row-major; a gradient set has the same fields, None meaning zero."""

    quads: wp.array | None  # [Q, H, W]
    phasor: wp.array | None  # [3, H, W]
    colour: wp.array | None = None  # [3, H, W]
    distance: wp.array | None  # [H, W]
    opacity: wp.array | None  # [H, W]
    distortion: wp.array | None  # [H, W]
    extra: wp.array | None = None  # [D, H, W]


def view_of(camera: Camera, settings: RenderSettings) -> CameraView:
    """The camera as kernels see it."""
    view = CameraView()
    pose = camera.camera_from_world
    view.rotation = wp.mat33(pose[:3, :3].astype(np.float32))
    view.translation = wp.vec3(*pose[:3, 3])
    view.centre = wp.vec3(*camera.centre)
    view.fx, view.fy, view.cx, view.cy = camera.fx, camera.fy, camera.cx, camera.cy
    view.width, view.height, view.near, view.far = camera.width, camera.height, settings.near, settings.far
    return view


@cache
def shift_vectors(shifts: tuple[float, ...], device: str) -> wp.array:
    """(cos, sin) of phase shifts [rad], uploaded once."""
    return wp.array([(math.cos(s), math.sin(s)) for s in shifts], dtype=wp.vec2, device=device)


def render(inputs: Inputs, view: CameraView, shifts: tuple[float, ...], frame: Frame, images: Images) -> None:
    """Fill ``images``; on an active ``wp.Tape`` also record the adjoint, which adds to the ``.grad`` of the inputs."""
    forward(inputs, view, shifts, frame, images)
    tape = wp._src.context.runtime.tape  # the public API has no name for the active tape
    if tape is not None:
        arrays = [a for group in (inputs, images) for a in _present(group).values() if a.requires_grad]

        def adjoint():
            cotangents = Images(**dict.fromkeys(_names(Images)) | _gradients(images))
            wanted = Inputs(**dict.fromkeys(_names(Inputs)) | _gradients(inputs))
            backward(inputs, view, shifts, frame, cotangents, wanted)

        tape.record_func(adjoint, arrays)


def forward(inputs: Inputs, view: CameraView, shifts: tuple[float, ...], frame: Frame, images: Images) -> None:
    """Project, sort, composite, resolve."""
    if frame.count:
        project(inputs, view, frame)
        sort_by_depth(frame)
        sort_by_tile(frame)
    else:
        frame.first.zero_()
    groups = _channel_groups(inputs)
    frame.channels = [frame.planes(CHANNEL_PLANES) for _ in groups]
    frame.extra_splats = []
    for number, (name, start) in enumerate(groups or [("", 0)]):
        splats = frame.splats
        if name == "extra" and frame.count:
            if number > 0:
                splats = frame.array(frame.count, splat.Splat)
                frame.extra_splats.append(splats)
            _launch(splat.set_channels, frame.count, [frame.splats, inputs.extra, start], [splats])
        composite(frame, view, splats, number)
    resolve_images(inputs, shifts, frame, images, groups)


def backward(
    inputs: Inputs, view: CameraView, shifts: tuple[float, ...], frame: Frame, cotangents: Images, wanted: Inputs
) -> wp.array:
    """Add to the arrays of ``wanted`` what ``cotangents`` say; leaves the frame as it was.

    Returns:
        [N] gradient records of the splats: slots 0 and 1 are the screen gradient, slot 6 the number of pixels.
    """
    groups = _channel_groups(inputs)
    grad_light, grad_channels = fold_images(inputs, shifts, frame, cotangents, wanted, groups)
    grad_splats = wp.zeros(frame.count, dtype=splat.Splat, device=frame.device)
    if not frame.count:
        return grad_splats
    extra_splats = iter(frame.extra_splats)
    for number, (name, start) in enumerate(groups or [("", 0)]):
        light = number == 0
        if not light and grad_channels[number] is None:
            next(extra_splats)
            continue
        splats = frame.splats if light else next(extra_splats)
        records = grad_splats if light else wp.zeros_like(grad_splats)
        channel = grad_channels[number] if groups else None
        composite_backward(frame, splats, light, grad_light, channel, records)
        if name == "extra" and channel is not None and wanted.extra is not None:
            _launch(splat.take_channels, frame.count, [records, start], [wanted.extra])
        if not light:
            _launch(splat.add_records, frame.count, [records, 1], [grad_splats])
    _launch(finish_moments, frame.count, [frame.splats], [grad_splats])
    project_backward(inputs, view, frame, grad_splats, wanted)
    return grad_splats


# -- stages ------------------------------------------------------------------------------------------------------------

_PROJECTED = ("mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh")


def project(inputs: Inputs, view: CameraView, frame: Frame) -> None:
    """Gaussians to splats, depth keys and image regions."""
    _launch(_project_kernel(inputs, frame), frame.count, _project_inputs(inputs, view, frame), _project_outputs(frame))


def project_backward(inputs: Inputs, view: CameraView, frame: Frame, grad_splats: wp.array, wanted: Inputs) -> None:
    """Gradient records of splats to gradients of Gaussians and calibration: Warp's adjoint of the same kernel."""
    adjoint = [getattr(wanted, name) for name in _PROJECTED]
    if any(array is not None for array in [*adjoint, wanted.calibration]):
        _launch(
            _project_kernel(inputs, frame),
            frame.count,
            _project_inputs(inputs, view, frame),
            _project_outputs(frame),
            adjoint=True,
            adj_inputs=[CameraView(), wanted.calibration, None, *adjoint],
            adj_outputs=[grad_splats, None, None, None],
        )


def _project_kernel(inputs: Inputs, frame: Frame):
    settings = frame.settings
    return make_project(inputs.colour_sh is not None, settings.support == Support.SIGMA3_TILE16)


def _project_inputs(inputs: Inputs, view: CameraView, frame: Frame) -> list:
    colour_sh = inputs.colour_sh if inputs.colour_sh is not None else _nothing(frame, 2, wp.vec3)
    arrays = [getattr(inputs, name) for name in _PROJECTED[:-1]]
    return [view, inputs.calibration, frame.settings.sh_degree, *arrays, colour_sh]


def _project_outputs(frame: Frame) -> list:
    return [frame.splats, frame.square_px, frame.depth_key, frame.order]


def sort_by_depth(frame: Frame) -> None:
    """Order the splats near to far, ties by index."""
    wp.utils.radix_sort_pairs(frame.depth_key, frame.order, frame.count, end_bit=31)


def sort_by_tile(frame: Frame) -> None:
    """Count, emit and sort the (tile, splat) pairs."""
    lists = [frame.order, frame.splats, frame.square_px, frame.tile_width, frame.tile_height]
    lists += [frame.tiles_x, frame.tiles_y]
    _launch(tiles.count_pairs, frame.count, lists, [frame.counts])
    wp.utils.array_scan(frame.counts, frame.offsets, inclusive=False)
    capacity = frame.settings.pair_capacity
    if capacity is None:
        # the declared host synchronisation: how many pairs there are decides how much memory they need
        capacity = int(frame.offsets[-1:].numpy()[0]) + int(frame.counts[-1:].numpy()[0])
        frame.reserve_pairs(capacity)
    else:
        frame.reserve_pairs(capacity)
        frame.keys.fill_(frame.tiles)  # pairs that do not exist sort behind all tiles
    outputs = [frame.keys, frame.ids, frame.total]
    _launch(tiles.emit_pairs, frame.count, [*lists, frame.counts, frame.offsets, capacity], outputs)
    if capacity:
        wp.utils.radix_sort_pairs(frame.keys, frame.ids, capacity, end_bit=frame.tiles.bit_length())
    _launch(tiles.tile_starts, frame.tiles + 1, [frame.keys, capacity], [frame.first])
    if frame.settings.pair_capacity is not None and frame.device.is_cpu:
        frame.check_capacity()


def composite(frame: Frame, view: CameraView, splats: wp.array, number: int) -> None:
    """Blend all tiles: light with the first group of channels, every further group by itself."""
    light, channels = number == 0, bool(frame.channels)
    shape = frame.K, frame.tile_width, frame.tile_height
    metric = frame.settings.distortion == Distortion.PAPER
    kernel = make_composite(*shape, light, channels, frame.settings.stop == Stop.INCLUSIVE, metric)
    channel = frame.channels[number].lanes if channels else _nothing(frame, 3, frame.sums.lanes.dtype)
    edges = _tile_edges(frame, 2 * frame.threads)

    def arguments(tile0: int, _part: int) -> list:
        ids = [frame.first, frame.ids, splats, frame.tiles_x, view.width, view.height, tile0, _mapping(frame)]
        return [*ids, frame.sums.lanes, channel]

    _over_tiles(frame, kernel, edges, arguments)


def composite_backward(frame: Frame, splats, light: bool, grad_light, channel, records) -> None:
    """Add the gradient of one pass to ``records``; CPU threads add to their own, which are then summed in order."""
    shape = frame.K, frame.tile_width, frame.tile_height
    passes = frame.settings.clamp_gradient == ClampGradient.STRAIGHT
    metric = frame.settings.distortion == Distortion.PAPER
    kernel = make_composite_backward(*shape, light, channel is not None, passes, metric)
    grad_channel = channel.lanes if channel is not None else _nothing(frame, 3, frame.sums.lanes.dtype)
    edges = _tile_edges(frame, frame.threads)
    parts = [records] + [wp.zeros_like(records) for _ in range(len(edges) - 2)]

    def arguments(tile0: int, part: int) -> list:
        sums = [frame.sums.lanes, grad_light.lanes, grad_channel]
        return [frame.first, frame.ids, splats, frame.tiles_x, tile0, _mapping(frame), *sums, parts[part]]

    _over_tiles(frame, kernel, edges, arguments)
    for part in parts[1:]:
        _launch(splat.add_records, frame.count, [part, 0], [records])


def resolve_images(inputs: Inputs, shifts, frame: Frame, images: Images, groups: list) -> None:
    """Planes to images."""
    pixels, sums, tiling = (frame.height, frame.width), frame.sums.flat, frame.tiling
    if shifts:
        vectors = shift_vectors(shifts, str(frame.device))
        lit = [sums, tiling, inputs.calibration, vectors, _or_nothing(frame, inputs.background_quads)]
        _launch(resolve.resolve_quads, pixels, lit, [images.quads])
    factor = frame.settings.phasor_factor
    lit = [sums, tiling, factor, _or_nothing(frame, inputs.background_phasor)]
    _launch(resolve.resolve_phasor, pixels, lit, [images.phasor])
    outputs = [images.distance, images.opacity, images.distortion]
    _launch(resolve.resolve_geometry, pixels, [sums, tiling, _distortion_factor(frame)], outputs)
    for (name, start), planes in zip(groups, frame.channels, strict=True):
        background = inputs.background_colour if name == "colour" else None
        rest = [planes.flat, sums, tiling, _or_nothing(frame, background), start]
        _launch(resolve.resolve_channels, pixels, rest, [getattr(images, name)])


def fold_images(inputs: Inputs, shifts, frame: Frame, cotangents: Images, wanted: Inputs, groups: list):
    """Images to planes: the adjoint of :func:`resolve_images`. Channels without a gradient are None."""
    pixels, sums, tiling = (frame.height, frame.width), frame.sums.flat, frame.tiling
    planes = frame.gradient_planes(GRAD_LIGHT_PLANES)
    target = planes.flat
    if cotangents.quads is not None and shifts:
        vectors = shift_vectors(shifts, str(frame.device))
        lit = [sums, tiling, inputs.calibration, vectors, _or_nothing(frame, inputs.background_quads)]
        outputs = [target, _or_nothing(frame, wanted.background_quads)]
        _launch(resolve.fold_quads, pixels, [*lit, cotangents.quads], outputs)
        if wanted.calibration is not None:
            rows = frame.array(frame.height, wp.float64)
            _launch(resolve.fold_dc_offset, frame.height, [sums, tiling, cotangents.quads], [rows])
            _launch(resolve.add_dc_offset, 1, [rows], [wanted.calibration])
    if cotangents.phasor is not None:
        lit = [sums, tiling, frame.settings.phasor_factor, _or_nothing(frame, inputs.background_phasor)]
        outputs = [target, _or_nothing(frame, wanted.background_phasor)]
        _launch(resolve.fold_phasor, pixels, [*lit, cotangents.phasor], outputs)
    for image, factor, plane in (
        (cotangents.distance, 1.0, 3),
        (cotangents.distortion, _distortion_factor(frame), 4),
        (cotangents.opacity, -1.0, GRAD_TRANSMITTANCE),  # opacity = 1 - T_e
    ):
        if image is not None:
            _launch(resolve.fold_plane, pixels, [image, tiling, factor, plane], [target])
    channels = []
    for name, start in groups:
        cotangent = getattr(cotangents, name)
        if cotangent is None:
            channels.append(None)
            continue
        grad = frame.gradient_planes(CHANNEL_PLANES)
        colour = name == "colour"
        background = _or_nothing(frame, inputs.background_colour if colour else None)
        grad_background = _or_nothing(frame, wanted.background_colour if colour else None)
        inputs_ = [sums, tiling, background, start, cotangent]
        _launch(resolve.fold_channels, pixels, inputs_, [grad.flat, target, grad_background])
        channels.append(grad)
    return planes, channels


# -- helpers -----------------------------------------------------------------------------------------------------------


def _channel_groups(inputs: Inputs) -> list[tuple[str, int]]:
    """(image, first channel) of each group of three T-weighted channels; the first rides along with the light."""
    groups = [("colour", 0)] if inputs.colour_sh is not None else []
    if inputs.extra is not None:
        groups += [("extra", start) for start in range(0, inputs.extra.shape[1], 3)]
    return groups


def _distortion_factor(frame: Frame) -> float:
    return 2.0 if frame.settings.distortion == Distortion.PAPER else 1.0


def _mapping(frame: Frame) -> wp.vec2:
    """Coefficients of the released zeta = far / (far - near) (1 - near / distance)."""
    near, far = frame.settings.near, frame.settings.far
    return wp.vec2(far / (far - near), far * near / (far - near))


def _tile_edges(frame: Frame, parts: int) -> list[int]:
    """Edges of at most ``parts`` ranges of tiles with about equally many pairs; one range where one thread works."""
    if frame.threads == 1:
        return [0, frame.tiles]
    first = frame.first.numpy()  # CPU only: a view, not a copy
    work = first[:-1] + np.arange(frame.tiles)  # an empty tile costs about as much as a pair
    targets = [(first[-1] + frame.tiles) * p / parts for p in range(1, parts)]
    return sorted({0, *(int(e) for e in np.searchsorted(work, targets)), frame.tiles})


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gftorf-tiles")


def _over_tiles(frame: Frame, kernel, edges: list[int], arguments) -> None:
    """Launch over ranges of tiles; CPU launches release the interpreter lock, so ranges run side by side."""
    side_by_side = len(edges) > 2
    commands = [
        wp.launch(
            kernel,
            dim=(stop - start, frame.lanes),
            inputs=arguments(start, part),
            device=frame.device,
            block_dim=128,
            record_tape=False,
            record_cmd=side_by_side,
        )
        for part, (start, stop) in enumerate(pairwise(edges))
    ]
    if side_by_side:
        list(_pool(frame.threads).map(lambda command: command.launch(), commands))


def _launch(kernel, dim, inputs: list, outputs: list, **adjoint) -> None:
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=_device_of(outputs), record_tape=False, **adjoint)


def _device_of(arrays: list) -> wp.Device:
    return next(a.device for a in arrays if isinstance(a, wp.array))


@cache
def _empty(device: str, ndim: int, dtype) -> wp.array:
    return wp.empty((0,) * ndim, dtype=dtype, device=device)


def _nothing(frame: Frame, ndim: int, dtype) -> wp.array:
    """An array without elements: 'absent', for kernels."""
    return _empty(str(frame.device), ndim, dtype)


def _or_nothing(frame: Frame, array: wp.array | None) -> wp.array:
    return array if array is not None else _nothing(frame, 3, wp.float32)


def _names(kind) -> list[str]:
    return [f.name for f in fields(kind)]


def _present(group) -> dict[str, wp.array]:
    return {name: getattr(group, name) for name in _names(type(group)) if getattr(group, name) is not None}


def _gradients(group) -> dict[str, wp.array]:
    return {name: array.grad for name, array in _present(group).items() if array.requires_grad}
