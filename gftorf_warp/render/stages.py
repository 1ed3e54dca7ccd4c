"""The stages of a rendering, forward and backward: each a fixed list of launches on Warp arrays."""

from __future__ import annotations

from functools import cache

import warp as wp

from ..kernels.rasterise import (
    depth_bins,
    deterministic_sums,
    planes_to_images,
    splat,
    tile_bitmask,
    tiles,
)
from ..kernels.rasterise.composite import CHANNEL_PLANES, make_composite
from ..kernels.rasterise.composite_backward import (
    GRAD_LIGHT_PLANES,
    GRAD_TRANSMITTANCE,
    finish_moments,
    make_composite_backward,
)
from ..kernels.rasterise.list_segments import PLANES
from ..kernels.rasterise.project import make_project
from .buffers import Buffers, ClampGradient, Distortion, Planes, Stop, Support
from .inputs import Images, Inputs, View
from .side_by_side import over_tiles, tile_edges

_PROJECTED = ("mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh")


def project(inputs: Inputs, view: View, buffers: Buffers) -> None:
    """Gaussians to splats, depth keys and image regions."""
    kernel = _project_kernel(inputs, view, buffers)
    _launch(
        kernel, buffers.count, _project_inputs(inputs, view, buffers), _project_outputs(buffers)
    )


def project_backward(
    inputs: Inputs, view: View, buffers: Buffers, grad_splats: wp.array, wanted: Inputs
) -> None:
    """Gradient records to gradients of Gaussians and calibration, by Warp's adjoint."""
    adjoint = [getattr(wanted, name) for name in _PROJECTED]
    if any(array is not None for array in [*adjoint, wanted.calibration]):
        _launch(
            _project_kernel(inputs, view, buffers),
            buffers.count,
            _project_inputs(inputs, view, buffers),
            _project_outputs(buffers),
            adjoint=True,
            adj_inputs=[None, wanted.calibration, None, None, None, *adjoint],
            adj_outputs=[grad_splats, None, None, None],
        )


def _project_kernel(inputs: Inputs, view: View, buffers: Buffers):
    square = buffers.settings.support == Support.SIGMA3_TILE16
    return make_project(inputs.colour_sh is not None, square, view.lens)


def _project_inputs(inputs: Inputs, view: View, buffers: Buffers) -> list:
    colour_sh = inputs.colour_sh if inputs.colour_sh is not None else _nothing(buffers, 2, wp.vec3)
    arrays = [getattr(inputs, name) for name in _PROJECTED[:-1]]
    settings = buffers.settings
    keys = [buffers.depth_shift, settings.depth_culled]
    return [view.camera, inputs.calibration, settings.sh_degree, *keys, *arrays, colour_sh]


def _project_outputs(buffers: Buffers) -> list:
    return [buffers.splats, buffers.box_px, buffers.depth_key, buffers.order]


def sort_by_depth(buffers: Buffers) -> None:
    """Order splats near to far, equal keys by index, culled ones last in any order."""
    if not buffers.binned:
        wp.utils.radix_sort_pairs(
            buffers.depth_key, buffers.order, buffers.count, end_bit=buffers.settings.depth_bits
        )
        return
    counts, first = (
        buffers.zeros("counts of classes", depth_bins.COUNTS),
        buffers.array("first of classes", depth_bins.COUNTS),
    )
    places, members = (
        buffers.array("places", buffers.count),
        buffers.array("members", buffers.count, wp.int64),
    )
    shift = buffers.settings.depth_bits - (depth_bins.BINS.bit_length() - 1)
    keys = [buffers.depth_key, buffers.settings.depth_culled, shift]
    _launch(depth_bins.count_bins, buffers.count, keys, [counts, places])
    wp.utils.array_scan(counts, first, inclusive=True)
    _launch(depth_bins.fill_bins, buffers.count, [*keys, first, places], [members])
    _launch(
        depth_bins.order_within_bins, buffers.count, [members, *keys[1:], first], [buffers.order]
    )


def sort_by_tile(buffers: Buffers) -> None:
    """List of each tile, near to far, from a bit matrix or by a sort of (tile, splat) pairs."""
    lists = [
        buffers.order,
        buffers.splats,
        buffers.box_px,
        buffers.tile_width,
        buffers.tile_height,
        buffers.lanes_per_splat,
    ]
    if buffers.marks:
        _mark_and_read(buffers, lists)
    else:
        _count_and_sort(buffers, lists)
    if buffers.settings.pair_capacity is not None and buffers.device.is_cpu:
        buffers.check_capacity()


def _mark_and_read(buffers: Buffers, lists: list) -> None:
    """Mark the pairs as bits; count and list those of each tile."""
    marked = buffers.zeros("bits", buffers.matrix, wp.uint32)
    _launch(
        tiles.mark_pairs,
        (buffers.count, buffers.lanes_per_splat),
        [*lists, buffers.tiles_x, buffers.words],
        [marked],
    )
    matrix = [
        marked,
        buffers.words,
        buffers.tiles,
        buffers.parts,
        buffers.part,
        buffers.lanes_per_splat,
    ]
    threads = buffers.matrix // buffers.words * buffers.parts, buffers.lanes_per_splat
    _launch(tile_bitmask.count_bits, threads, matrix, [buffers.counts])
    capacity = _sum_counts(buffers)
    outputs = [buffers.ids, buffers.first, buffers.total]
    _launch(
        tile_bitmask.list_bits, threads, [*matrix, buffers.order, buffers.ends, capacity], outputs
    )


def _count_and_sort(buffers: Buffers, lists: list) -> None:
    """Count, emit and sort the pairs."""
    threads = buffers.count, buffers.lanes_per_splat
    _launch(tiles.count_pairs, threads, lists, [buffers.counts])
    capacity = _sum_counts(buffers)
    inputs = [*lists, buffers.tiles_x, buffers.tiles, buffers.ends, capacity]
    _launch(tiles.emit_pairs, threads, inputs, [buffers.keys, buffers.ids, buffers.total])
    if buffers.ordered and capacity:
        buffers.owners = buffers.array("owners", capacity)
        _launch(
            deterministic_sums.number_pairs,
            capacity,
            [buffers.total, capacity],
            [buffers.ids, buffers.owners],
        )
    if capacity:
        wp.utils.radix_sort_pairs(
            buffers.keys, buffers.ids, capacity, end_bit=buffers.tiles.bit_length()
        )
    starts = buffers.tiles + 1, buffers.lanes_per_splat
    _launch(
        tiles.tile_starts,
        starts,
        [buffers.keys, capacity, buffers.lanes_per_splat],
        [buffers.first],
    )


def _sum_counts(buffers: Buffers) -> int:
    """Prefix sums of the counts of pairs, and memory for them; returns the pair capacity."""
    wp.utils.array_scan(buffers.counts, buffers.ends, inclusive=True)
    capacity = buffers.settings.pair_capacity
    if capacity is None:
        # the documented host synchronisation: memory is allocated for the number of pairs
        capacity = int(buffers.ends[-1:].numpy()[0])
    buffers.reserve_pairs(capacity)
    return capacity


def composite(
    buffers: Buffers, number: int, distortion: bool = True, *, differentiable: bool = True
) -> None:
    """Blend all tiles: light with one or two groups of channels, or one further group."""
    nothing, more = (
        _nothing(buffers, 3, buffers.sums.lanes.dtype),
        number == 0 and buffers.groups_with_light > 1,
    )
    light, channels = number == 0, bool(buffers.channels)
    shape = buffers.K, buffers.tile_width, buffers.tile_height
    metric = _metric(buffers, light and distortion)
    segments = buffers.segments_wanted if light and metric is None and differentiable else 1
    if light:
        buffers.segments = segments
    kernel = make_composite(
        *shape, light, channels, buffers.settings.stop == Stop.INCLUSIVE, metric, more, segments
    )
    channel = buffers.channels[number].lanes if channels else nothing
    splats = _spread(buffers, number)
    more_splats, more_channel = (
        (_spread(buffers, 1), buffers.channels[1].lanes) if more else (splats, nothing)
    )
    lists = [buffers.first, buffers.ids, splats, buffers.tiles_x, buffers.width, buffers.height]

    def arguments(tile0: int, _part: int) -> list:
        outputs = [buffers.sums.lanes, channel, more_channel, _states(buffers, segments)]
        return [*lists, tile0, _mapping(buffers), more_splats, *outputs]

    over_tiles(buffers, kernel, tile_edges(buffers, buffers.threads), arguments)


def composite_backward(
    buffers: Buffers,
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
    """Add the gradient of one pass to ``records``; CPU threads add to their own, which are then
    summed in order.

    Args:
        buffers: After its forward pass.
        number: Of the pass: 0 has the light.
        grad_light: Of the planes of light.
        grad_channel: Of the pass's channels; None: they have no gradient.
        records: [N] added to.
        distortion: Whether it has a gradient.
        fixed: Whether weights are held fixed under the channels.
        grad_more: Of the second group, if this pass takes it along; weights are held fixed under
            it.
        more_records: [N] what it adds to.
    """
    light, channels = number == 0, grad_channel is not None
    shape = buffers.K, buffers.tile_width, buffers.tile_height
    passes = buffers.settings.clamp_gradient == ClampGradient.STRAIGHT
    metric = _metric(buffers, light and distortion)
    segments = buffers.segments if light and metric is None and (fixed or not channels) else 1
    fixed = fixed and channels
    kernel = make_composite_backward(
        *shape, light, channels, passes, metric, fixed, grad_more is not None, segments
    )
    nothing = _nothing(buffers, 3, buffers.sums.lanes.dtype)
    channel = grad_channel.lanes if grad_channel is not None else nothing
    more = grad_more.lanes if grad_more is not None else nothing
    edges = [0, buffers.tiles] if buffers.ordered else tile_edges(buffers, buffers.threads)
    added, more_added = records, more_records
    if buffers.ordered:
        added = buffers.zeros("gradients of pairs", len(buffers.owners), splat.Splat)
        more_added = (
            None
            if more_records is None
            else buffers.zeros("more of pairs", len(buffers.owners), splat.Splat)
        )
    targets = [added] + [
        buffers.zeros(f"records of thread {n}", buffers.count, splat.Splat)
        for n in range(len(edges) - 2)
    ]
    lists = [buffers.first, buffers.ids, _spread(buffers, number, anew=False), buffers.tiles_x]

    def arguments(tile0: int, part: int) -> list:
        return [
            *lists,
            tile0,
            _mapping(buffers),
            buffers.sums.lanes,
            grad_light.lanes,
            channel,
            more,
            _states(buffers, segments),
            targets[part],
            more_added if more_added is not None else added,
        ]

    over_tiles(buffers, kernel, edges, arguments, segments)
    for target in targets[1:]:
        _launch(splat.add_records, buffers.count, [target, 0], [records])
    if buffers.ordered:
        for copies, total in ((added, records), (more_added, more_records)):
            if copies is not None and total is not None:
                of_pairs = [buffers.order, buffers.ends, copies, len(buffers.owners)]
                _launch(deterministic_sums.sum_copies, buffers.count, of_pairs, [total])


def set_channels(buffers: Buffers, inputs: Inputs, start: int, splats: wp.array) -> None:
    """Records of the buffers with three extra channels in place of their own."""
    if buffers.count:
        _launch(splat.set_channels, buffers.count, [buffers.splats, inputs.extra, start], [splats])


def take_channels(records: wp.array, start: int, wanted: Inputs) -> None:
    """Add the channel gradients of records to those of three extra channels."""
    _launch(splat.take_channels, len(records), [records, start], [wanted.extra])


def add_geometry(records: wp.array, total: wp.array) -> None:
    """Add the gradients of centres, conics and opacities of a further pass."""
    _launch(splat.add_records, len(records), [records, 1], [total])


def finish(buffers: Buffers, grad_splats: wp.array) -> None:
    """Turn the moments in gradient records into gradients."""
    _launch(finish_moments, buffers.count, [buffers.splats], [grad_splats])


def resolve_images(
    inputs: Inputs, view: View, buffers: Buffers, images: Images, groups: list
) -> None:
    """Planes to images."""
    pixels, sums, tiling = (buffers.height, buffers.width), buffers.sums.flat, buffers.tiling
    if len(view.shifts) and images.quads is not None:
        lit = [
            sums,
            tiling,
            inputs.calibration,
            view.shifts,
            _or_nothing(buffers, inputs.background_quads),
        ]
        _launch(planes_to_images.resolve_quads, pixels, lit, [images.quads])
    if images.phasor is not None:
        lit = [
            sums,
            tiling,
            buffers.settings.phasor_factor,
            _or_nothing(buffers, inputs.background_phasor),
        ]
        _launch(planes_to_images.resolve_phasor, pixels, lit, [images.phasor])
    outputs = [images.distance, images.opacity, images.distortion]
    if any(image is not None for image in outputs):
        outputs = [_or_nothing(buffers, image, 2) for image in outputs]
        _launch(
            planes_to_images.resolve_geometry,
            pixels,
            [sums, tiling, _distortion_factor(buffers)],
            outputs,
        )
    for (name, start), planes in zip(groups, buffers.channels, strict=True):
        background = inputs.background_colour if name == "colour" else None
        rest = [planes.flat, sums, tiling, _or_nothing(buffers, background), start]
        _launch(planes_to_images.resolve_channels, pixels, rest, [getattr(images, name)])


def fold_images(
    inputs: Inputs, view: View, buffers: Buffers, cotangents: Images, wanted: Inputs, groups: list
):
    """Images to planes: adjoint of :func:`resolve_images`; None for channels without gradient."""
    pixels, sums, tiling = (buffers.height, buffers.width), buffers.sums.flat, buffers.tiling
    planes = buffers.gradient_planes("gradient of light", GRAD_LIGHT_PLANES, added=True)
    target = planes.flat
    if cotangents.quads is not None and len(view.shifts):
        lit = [
            sums,
            tiling,
            inputs.calibration,
            view.shifts,
            _or_nothing(buffers, inputs.background_quads),
        ]
        outputs = [target, _or_nothing(buffers, wanted.background_quads)]
        _launch(planes_to_images.fold_quads, pixels, [*lit, cotangents.quads], outputs)
        if wanted.calibration is not None:
            rows = buffers.array("rows", buffers.height, wp.float64)
            _launch(
                planes_to_images.fold_dc_offset,
                buffers.height,
                [sums, tiling, cotangents.quads],
                [rows],
            )
            _launch(planes_to_images.add_dc_offset, 1, [rows], [wanted.calibration])
    if cotangents.phasor is not None:
        lit = [
            sums,
            tiling,
            buffers.settings.phasor_factor,
            _or_nothing(buffers, inputs.background_phasor),
        ]
        outputs = [target, _or_nothing(buffers, wanted.background_phasor)]
        _launch(planes_to_images.fold_phasor, pixels, [*lit, cotangents.phasor], outputs)
    for image, factor, plane in (
        (cotangents.distance, 1.0, 3),
        (cotangents.distortion, _distortion_factor(buffers), 4),
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
        grad = buffers.gradient_planes(
            f"gradient of channels {number}", CHANNEL_PLANES, added=False
        )
        colour = name == "colour"
        background = _or_nothing(buffers, inputs.background_colour if colour else None)
        grad_background = _or_nothing(buffers, wanted.background_colour if colour else None)
        inputs_ = [sums, tiling, background, start, cotangent]
        _launch(
            planes_to_images.fold_channels, pixels, inputs_, [grad.flat, target, grad_background]
        )
        channels.append(grad)
    return planes, channels or [None]


# -- helpers ---------------------------------------------------------------------------------------


def _metric(buffers: Buffers, wanted: bool) -> bool | None:
    """What distortion is measured on, as compositors have it; None where there is none."""
    return buffers.settings.distortion == Distortion.PAPER if wanted else None


def _distortion_factor(buffers: Buffers) -> float:
    return 2.0 if buffers.settings.distortion == Distortion.PAPER else 1.0


def _spread(buffers: Buffers, number: int, *, anew: bool = True) -> wp.array:
    """Records of a pass: of splats, or, for deterministic sums, a copy per pair."""
    if not buffers.ordered:
        return buffers.records[number]
    copies = buffers.array(f"records of pairs {number}", len(buffers.owners), splat.Splat)
    if anew and len(buffers.owners):
        _launch(
            deterministic_sums.spread_records,
            len(buffers.owners),
            [buffers.records[number], buffers.owners],
            [copies],
        )
    return copies


def _mapping(buffers: Buffers) -> wp.vec2:
    """Coefficients of the released zeta = far / (far - near) (1 - near / distance)."""
    near, far = buffers.settings.near, buffers.settings.far
    return wp.vec2(far / (far - near), far * near / (far - near))


def _states(buffers: Buffers, segments: int) -> wp.array:
    """State of pixels where segments end, see list_segments.py."""
    if segments == 1:
        return _nothing(buffers, 3, buffers.sums.lanes.dtype)
    return buffers.planes(f"ends of {segments} segments", PLANES * (segments - 1)).lanes


def _launch(kernel, dim, inputs: list, outputs: list, **adjoint) -> None:
    wp.launch(
        kernel,
        dim=dim,
        inputs=inputs,
        outputs=outputs,
        device=_device_of(outputs),
        record_tape=False,
        **adjoint,
    )


def _device_of(arrays: list) -> wp.Device:
    return next(a.device for a in arrays if isinstance(a, wp.array))


@cache
def _empty(device: str, ndim: int, dtype) -> wp.array:
    return wp.empty((0,) * ndim, dtype=dtype, device=device)


def _nothing(buffers: Buffers, ndim: int, dtype) -> wp.array:
    """An array without elements: 'absent', for kernels."""
    return _empty(str(buffers.device), ndim, dtype)


def _or_nothing(buffers: Buffers, array: wp.array | None, ndim: int = 3) -> wp.array:
    return array if array is not None else _nothing(buffers, ndim, wp.float32)
