"""The stages of a rendering, forward and backward: each a fixed list of launches on Warp arrays."""

from __future__ import annotations

from functools import cache

import warp as wp

from ..kernels.rasterise import depth_bins, deterministic_sums, planes_to_images, splat, tile_bitmask, tiles
from ..kernels.rasterise.composite import CHANNEL_PLANES, make_composite
from ..kernels.rasterise.composite_backward import (
    GRAD_LIGHT_PLANES,
    GRAD_TRANSMITTANCE,
    finish_moments,
    make_composite_backward,
)
from ..kernels.rasterise.list_segments import PLANES
from ..kernels.rasterise.project import make_project
from .buffers import ClampGradient, Distortion, Frame, Planes, Stop, Support
from .inputs import Images, Inputs, View
from .side_by_side import over_tiles, tile_edges

_PROJECTED = ("mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh")


def project(inputs: Inputs, view: View, frame: Frame) -> None:
    """Gaussians to splats, depth keys and image regions."""
    kernel = _project_kernel(inputs, view, frame)
    _launch(kernel, frame.count, _project_inputs(inputs, view, frame), _project_outputs(frame))


def project_backward(inputs: Inputs, view: View, frame: Frame, grad_splats: wp.array, wanted: Inputs) -> None:
    """Gradient records of splats to gradients of Gaussians and calibration: Warp's adjoint of the same kernel."""
    adjoint = [getattr(wanted, name) for name in _PROJECTED]
    if any(array is not None for array in [*adjoint, wanted.calibration]):
        _launch(
            _project_kernel(inputs, view, frame),
            frame.count,
            _project_inputs(inputs, view, frame),
            _project_outputs(frame),
            adjoint=True,
            adj_inputs=[None, wanted.calibration, None, None, None, *adjoint],
            adj_outputs=[grad_splats, None, None, None],
        )


def _project_kernel(inputs: Inputs, view: View, frame: Frame):
    square = frame.settings.support == Support.SIGMA3_TILE16
    return make_project(inputs.colour_sh is not None, square, view.lens)


def _project_inputs(inputs: Inputs, view: View, frame: Frame) -> list:
    colour_sh = inputs.colour_sh if inputs.colour_sh is not None else _nothing(frame, 2, wp.vec3)
    arrays = [getattr(inputs, name) for name in _PROJECTED[:-1]]
    settings = frame.settings
    keys = [frame.depth_shift, settings.depth_culled]
    return [view.camera, inputs.calibration, settings.sh_degree, *keys, *arrays, colour_sh]


def _project_outputs(frame: Frame) -> list:
    return [frame.splats, frame.box_px, frame.depth_key, frame.order]


def sort_by_depth(frame: Frame) -> None:
    """Order the splats near to far, those of one key by index; what is culled comes last, in any order."""
    if not frame.ranks:
        wp.utils.radix_sort_pairs(frame.depth_key, frame.order, frame.count, end_bit=frame.settings.depth_bits)
        return
    counts, first = (
        frame.zeros("counts of classes", depth_bins.COUNTS),
        frame.array("first of classes", depth_bins.COUNTS),
    )
    places, members = frame.array("places", frame.count), frame.array("members", frame.count, wp.int64)
    shift = frame.settings.depth_bits - (depth_bins.CLASSES.bit_length() - 1)
    keys = [frame.depth_key, frame.settings.depth_culled, shift]
    _launch(depth_bins.count_classes, frame.count, keys, [counts, places])
    wp.utils.array_scan(counts, first, inclusive=True)
    _launch(depth_bins.fill_classes, frame.count, [*keys, first, places], [members])
    _launch(depth_bins.order_classes, frame.count, [members, *keys[1:], first], [frame.order])


def sort_by_tile(frame: Frame) -> None:
    """The list of each tile, near to far: read from a matrix of bits, or by a sort of (tile, splat) pairs."""
    lists = [frame.order, frame.splats, frame.box_px, frame.tile_width, frame.tile_height, frame.lanes_per_splat]
    if frame.marks:
        _mark_and_read(frame, lists)
    else:
        _count_and_sort(frame, lists)
    if frame.settings.pair_capacity is not None and frame.device.is_cpu:
        frame.check_capacity()


def _mark_and_read(frame: Frame, lists: list) -> None:
    """Mark the pairs as bits; count and list those of each tile."""
    marked = frame.zeros("bits", frame.matrix, wp.uint32)
    _launch(tiles.mark_pairs, (frame.count, frame.lanes_per_splat), [*lists, frame.tiles_x, frame.words], [marked])
    matrix = [marked, frame.words, frame.tiles, frame.parts, frame.part, frame.lanes_per_splat]
    threads = frame.matrix // frame.words * frame.parts, frame.lanes_per_splat
    _launch(tile_bitmask.count_bits, threads, matrix, [frame.counts])
    capacity = _sum_counts(frame)
    outputs = [frame.ids, frame.first, frame.total]
    _launch(tile_bitmask.list_bits, threads, [*matrix, frame.order, frame.ends, capacity], outputs)


def _count_and_sort(frame: Frame, lists: list) -> None:
    """Count, emit and sort the pairs."""
    threads = frame.count, frame.lanes_per_splat
    _launch(tiles.count_pairs, threads, lists, [frame.counts])
    capacity = _sum_counts(frame)
    inputs = [*lists, frame.tiles_x, frame.tiles, frame.ends, capacity]
    _launch(tiles.emit_pairs, threads, inputs, [frame.keys, frame.ids, frame.total])
    if frame.ordered and capacity:
        frame.owners = frame.array("owners", capacity)
        _launch(deterministic_sums.number_pairs, capacity, [frame.total, capacity], [frame.ids, frame.owners])
    if capacity:
        wp.utils.radix_sort_pairs(frame.keys, frame.ids, capacity, end_bit=frame.tiles.bit_length())
    starts = frame.tiles + 1, frame.lanes_per_splat
    _launch(tiles.tile_starts, starts, [frame.keys, capacity, frame.lanes_per_splat], [frame.first])


def _sum_counts(frame: Frame) -> int:
    """Counts of pairs to where those of each end, and room for them; returns how many fit."""
    wp.utils.array_scan(frame.counts, frame.ends, inclusive=True)
    capacity = frame.settings.pair_capacity
    if capacity is None:
        # the declared host synchronisation: how many pairs there are decides how much memory they need
        capacity = int(frame.ends[-1:].numpy()[0])
    frame.reserve_pairs(capacity)
    return capacity


def composite(frame: Frame, number: int, distortion: bool = True, *, differentiable: bool = True) -> None:
    """Blend all tiles: light with the first group of channels, or the first two, every further group by itself."""
    nothing, more = _nothing(frame, 3, frame.sums.lanes.dtype), number == 0 and frame.groups_with_light > 1
    light, channels = number == 0, bool(frame.channels)
    shape = frame.K, frame.tile_width, frame.tile_height
    metric = _metric(frame, light and distortion)
    segments = frame.segments_wanted if light and metric is None and differentiable else 1
    if light:
        frame.segments = segments
    kernel = make_composite(*shape, light, channels, frame.settings.stop == Stop.INCLUSIVE, metric, more, segments)
    channel = frame.channels[number].lanes if channels else nothing
    splats = _spread(frame, number)
    more_splats, more_channel = (_spread(frame, 1), frame.channels[1].lanes) if more else (splats, nothing)
    lists = [frame.first, frame.ids, splats, frame.tiles_x, frame.width, frame.height]

    def arguments(tile0: int, _part: int) -> list:
        outputs = [frame.sums.lanes, channel, more_channel, _states(frame, segments)]
        return [*lists, tile0, _mapping(frame), more_splats, *outputs]

    over_tiles(frame, kernel, tile_edges(frame, frame.threads), arguments)


def composite_backward(
    frame: Frame,
    number: int,
    grad_light: Planes,
    grad_channel: Planes | None,
    records: wp.array,
    *,
    distortion: bool = True,
    fixed: bool = False,
    grad_more: Planes | None = None,
    more_records: wp.array | None = None,
) -> None:
    """Add the gradient of one pass to ``records``; CPU threads add to their own, which are then summed in order.

    Args:
        frame: After its forward pass.
        number: Of the pass: 0 has the light.
        grad_light: Of the planes of light.
        grad_channel: Of the pass's channels; None: they have no gradient.
        records: [N] added to.
        distortion: Whether it has a gradient.
        fixed: Whether weights are held fixed under the channels.
        grad_more: Of the second group, if this pass takes it along; weights are held fixed under it.
        more_records: [N] what it adds to.
    """
    light, channels = number == 0, grad_channel is not None
    shape = frame.K, frame.tile_width, frame.tile_height
    passes = frame.settings.clamp_gradient == ClampGradient.STRAIGHT
    metric = _metric(frame, light and distortion)
    segments = frame.segments if light and metric is None and (fixed or not channels) else 1
    fixed = fixed and channels
    kernel = make_composite_backward(*shape, light, channels, passes, metric, fixed, grad_more is not None, segments)
    nothing = _nothing(frame, 3, frame.sums.lanes.dtype)
    channel = grad_channel.lanes if grad_channel is not None else nothing
    more = grad_more.lanes if grad_more is not None else nothing
    edges = [0, frame.tiles] if frame.ordered else tile_edges(frame, frame.threads)
    added, more_added = records, more_records
    if frame.ordered:
        added = frame.zeros("gradients of pairs", len(frame.owners), splat.Splat)
        more_added = None if more_records is None else frame.zeros("more of pairs", len(frame.owners), splat.Splat)
    targets = [added] + [frame.zeros(f"records of thread {n}", frame.count, splat.Splat) for n in range(len(edges) - 2)]
    lists = [frame.first, frame.ids, _spread(frame, number, anew=False), frame.tiles_x]

    def arguments(tile0: int, part: int) -> list:
        return [
            *lists,
            tile0,
            _mapping(frame),
            frame.sums.lanes,
            grad_light.lanes,
            channel,
            more,
            _states(frame, segments),
            targets[part],
            more_added if more_added is not None else added,
        ]

    over_tiles(frame, kernel, edges, arguments, segments)
    for target in targets[1:]:
        _launch(splat.add_records, frame.count, [target, 0], [records])
    if frame.ordered:
        for copies, total in ((added, records), (more_added, more_records)):
            if copies is not None and total is not None:
                of_pairs = [frame.order, frame.ends, copies, len(frame.owners)]
                _launch(deterministic_sums.sum_copies, frame.count, of_pairs, [total])


def set_channels(frame: Frame, inputs: Inputs, start: int, splats: wp.array) -> None:
    """Fill ``splats`` with the records of the frame, their channels replaced by three extra ones."""
    if frame.count:
        _launch(splat.set_channels, frame.count, [frame.splats, inputs.extra, start], [splats])


def take_channels(records: wp.array, start: int, wanted: Inputs) -> None:
    """Add the channel gradients of records to those of three extra channels."""
    _launch(splat.take_channels, len(records), [records, start], [wanted.extra])


def add_geometry(records: wp.array, total: wp.array) -> None:
    """Add what a further pass says about centres, conics and opacities."""
    _launch(splat.add_records, len(records), [records, 1], [total])


def finish(frame: Frame, grad_splats: wp.array) -> None:
    """Turn the moments in gradient records into gradients."""
    _launch(finish_moments, frame.count, [frame.splats], [grad_splats])


def resolve_images(inputs: Inputs, view: View, frame: Frame, images: Images, groups: list) -> None:
    """Planes to images."""
    pixels, sums, tiling = (frame.height, frame.width), frame.sums.flat, frame.tiling
    if len(view.shifts) and images.quads is not None:
        lit = [sums, tiling, inputs.calibration, view.shifts, _or_nothing(frame, inputs.background_quads)]
        _launch(planes_to_images.resolve_quads, pixels, lit, [images.quads])
    if images.phasor is not None:
        lit = [sums, tiling, frame.settings.phasor_factor, _or_nothing(frame, inputs.background_phasor)]
        _launch(planes_to_images.resolve_phasor, pixels, lit, [images.phasor])
    outputs = [images.distance, images.opacity, images.distortion]
    if any(image is not None for image in outputs):
        outputs = [_or_nothing(frame, image, 2) for image in outputs]
        _launch(planes_to_images.resolve_geometry, pixels, [sums, tiling, _distortion_factor(frame)], outputs)
    for (name, start), planes in zip(groups, frame.channels, strict=True):
        background = inputs.background_colour if name == "colour" else None
        rest = [planes.flat, sums, tiling, _or_nothing(frame, background), start]
        _launch(planes_to_images.resolve_channels, pixels, rest, [getattr(images, name)])


def fold_images(inputs: Inputs, view: View, frame: Frame, cotangents: Images, wanted: Inputs, groups: list):
    """Images to planes: the adjoint of :func:`resolve_images`. Channels without a gradient are None."""
    pixels, sums, tiling = (frame.height, frame.width), frame.sums.flat, frame.tiling
    planes = frame.gradient_planes("gradient of light", GRAD_LIGHT_PLANES, added=True)
    target = planes.flat
    if cotangents.quads is not None and len(view.shifts):
        lit = [sums, tiling, inputs.calibration, view.shifts, _or_nothing(frame, inputs.background_quads)]
        outputs = [target, _or_nothing(frame, wanted.background_quads)]
        _launch(planes_to_images.fold_quads, pixels, [*lit, cotangents.quads], outputs)
        if wanted.calibration is not None:
            rows = frame.array("rows", frame.height, wp.float64)
            _launch(planes_to_images.fold_dc_offset, frame.height, [sums, tiling, cotangents.quads], [rows])
            _launch(planes_to_images.add_dc_offset, 1, [rows], [wanted.calibration])
    if cotangents.phasor is not None:
        lit = [sums, tiling, frame.settings.phasor_factor, _or_nothing(frame, inputs.background_phasor)]
        outputs = [target, _or_nothing(frame, wanted.background_phasor)]
        _launch(planes_to_images.fold_phasor, pixels, [*lit, cotangents.phasor], outputs)
    for image, factor, plane in (
        (cotangents.distance, 1.0, 3),
        (cotangents.distortion, _distortion_factor(frame), 4),
        (cotangents.opacity, -1.0, GRAD_TRANSMITTANCE),  # opacity = 1 - T_e
    ):
        if image is not None:
            _launch(planes_to_images.fold_plane, pixels, [image, tiling, factor, plane], [target])
    channels: list[Planes | None] = []
    for number, (name, start) in enumerate(groups):
        cotangent = getattr(cotangents, name)
        if cotangent is None:
            channels.append(None)
            continue
        grad = frame.gradient_planes(f"gradient of channels {number}", CHANNEL_PLANES, added=False)
        colour = name == "colour"
        background = _or_nothing(frame, inputs.background_colour if colour else None)
        grad_background = _or_nothing(frame, wanted.background_colour if colour else None)
        inputs_ = [sums, tiling, background, start, cotangent]
        _launch(planes_to_images.fold_channels, pixels, inputs_, [grad.flat, target, grad_background])
        channels.append(grad)
    return planes, channels or [None]


# -- helpers -----------------------------------------------------------------------------------------------------------


def _metric(frame: Frame, wanted: bool) -> bool | None:
    """What distortion is measured on, as compositors have it; None where there is none."""
    return frame.settings.distortion == Distortion.PAPER if wanted else None


def _distortion_factor(frame: Frame) -> float:
    return 2.0 if frame.settings.distortion == Distortion.PAPER else 1.0


def _spread(frame: Frame, number: int, *, anew: bool = True) -> wp.array:
    """Records of a pass as the compositor reads them: of splats, or, where order matters, a copy for each pair."""
    if not frame.ordered:
        return frame.records[number]
    copies = frame.array(f"records of pairs {number}", len(frame.owners), splat.Splat)
    if anew and len(frame.owners):
        _launch(deterministic_sums.spread_records, len(frame.owners), [frame.records[number], frame.owners], [copies])
    return copies


def _mapping(frame: Frame) -> wp.vec2:
    """Coefficients of the released zeta = far / (far - near) (1 - near / distance)."""
    near, far = frame.settings.near, frame.settings.far
    return wp.vec2(far / (far - near), far * near / (far - near))


def _states(frame: Frame, segments: int) -> wp.array:
    """State of pixels where segments end, see list_segments.py."""
    if segments == 1:
        return _nothing(frame, 3, frame.sums.lanes.dtype)
    return frame.planes(f"ends of {segments} segments", PLANES * (segments - 1)).lanes


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


def _or_nothing(frame: Frame, array: wp.array | None, ndim: int = 3) -> wp.array:
    return array if array is not None else _nothing(frame, ndim, wp.float32)
