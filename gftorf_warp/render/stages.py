"""The stages of a rendering, forward and backward: each a fixed list of launches on Warp arrays."""

from __future__ import annotations

from functools import cache

import warp as wp

from ..kernels.rasterise import (
    depth_bins,
    deterministic_sums,
    planes_to_images,
    splat,
    splat_distance,
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
from . import runtime
from .buffers import Buffers, ClampGradient, Distortion, Planes, Stop, Support
from .inputs import Images, Inputs, View
from .side_by_side import over_tiles, tile_edges

_PROJECTED = ("mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh")


def project(inputs: Inputs, view: View, buffers: Buffers) -> None:
    """Gaussians to splats, depth keys and image regions."""
    given, outputs = _project_inputs(inputs, view, buffers), _project_outputs(buffers)
    _launch(_project_kernel(inputs, view, buffers), buffers.count, given, outputs)


def project_backward(
    inputs: Inputs, view: View, buffers: Buffers, grad_splats: wp.array, wanted: Inputs
) -> None:
    """Gradient records to gradients of Gaussians and calibration, by Warp's adjoint."""
    adjoint = [getattr(wanted, name) for name in _PROJECTED]
    if any(array is not None for array in [*adjoint, wanted.calibration]):
        _launch(
            _project_kernel(inputs, view, buffers, adjoint=True),
            buffers.count,
            _project_inputs(inputs, view, buffers),
            _project_outputs(buffers),
            adjoint=True,
            adj_inputs=[None, wanted.calibration, None, None, None, *adjoint],
            adj_outputs=[grad_splats, None, None, None],
        )


def _project_kernel(inputs: Inputs, view: View, buffers: Buffers, *, adjoint: bool = False):
    square = not adjoint and buffers.settings.support == Support.SIGMA3_TILE16
    return make_project(inputs.colour_sh is not None, square, view.lens, buffers.sloped, adjoint)


def _project_inputs(inputs: Inputs, view: View, buffers: Buffers) -> list:
    colour_sh = inputs.colour_sh if inputs.colour_sh is not None else _nothing(buffers, 2, wp.vec3)
    arrays = [getattr(inputs, name) for name in _PROJECTED[:-1]]
    keys = [buffers.settings.sh_degree, buffers.depth_shift, buffers.settings.depth_culled]
    return [view.camera, inputs.calibration, *keys, *arrays, colour_sh]


def _project_outputs(buffers: Buffers) -> list:
    return [buffers.splats, buffers.box_px, buffers.depth_key, buffers.order]


def sort_by_depth(buffers: Buffers) -> None:
    """Order splats near to far, equal keys by index, culled ones last in any order."""
    if not buffers.binned:
        wp.utils.radix_sort_pairs(
            buffers.depth_key, buffers.order, buffers.count, end_bit=buffers.settings.depth_bits
        )
        return
    counts = buffers.zeros("counts of bins", depth_bins.COUNTS)
    first = buffers.array("first of bins", depth_bins.COUNTS)
    places = buffers.array("places", buffers.count)
    members = buffers.array("members", buffers.count, wp.int64)
    shift = buffers.settings.depth_bits - (depth_bins.BINS.bit_length() - 1)
    keys = [buffers.depth_key, buffers.settings.depth_culled, shift]
    _launch(depth_bins.count_bins, buffers.count, keys, [counts, places])
    wp.utils.array_scan(counts, first, inclusive=True)
    _launch(depth_bins.fill_bins, buffers.count, [*keys, first, places], [members])
    inputs = [members, *keys[1:], first]
    _launch(depth_bins.order_within_bins, buffers.count, inputs, [buffers.order])


def sort_by_tile(buffers: Buffers) -> None:
    """List of each tile, near to far, from a bit matrix or by a sort of (tile, splat) pairs."""
    lists = [buffers.order, buffers.splats, buffers.box_px]
    lists += [buffers.tile_width, buffers.tile_height, buffers.lanes_per_splat]
    if buffers.marks:
        _mark_and_read(buffers, lists)
    else:
        _count_and_sort(buffers, lists)
    if buffers.settings.pair_capacity is not None and buffers.device.is_cpu:
        buffers.check_capacity()


def _mark_and_read(buffers: Buffers, lists: list) -> None:
    """Mark the pairs as bits; count and list those of each tile."""
    marked = buffers.zeros("bits", buffers.matrix, wp.uint32)
    threads = buffers.count, buffers.lanes_per_splat
    _launch(tiles.mark_pairs, threads, [*lists, buffers.tiles_x, buffers.words], [marked])
    matrix = [marked, buffers.words, buffers.tiles, buffers.parts, buffers.part]
    matrix.append(buffers.lanes_per_splat)
    threads = buffers.matrix // buffers.words * buffers.parts, buffers.lanes_per_splat
    _launch(tile_bitmask.count_bits, threads, matrix, [buffers.counts])
    capacity = _sum_counts(buffers)
    inputs, outputs = [buffers.order, buffers.ends], [buffers.ids, buffers.first, buffers.total]
    _launch(tile_bitmask.list_bits, threads, [*matrix, *inputs, capacity], outputs)


def _count_and_sort(buffers: Buffers, lists: list) -> None:
    """Count, emit and sort the pairs."""
    threads = buffers.count, buffers.lanes_per_splat
    _launch(tiles.count_pairs, threads, lists, [buffers.counts])
    capacity = _sum_counts(buffers)
    inputs = [*lists, buffers.tiles_x, buffers.tiles, buffers.ends, capacity]
    _launch(tiles.emit_pairs, threads, inputs, [buffers.keys, buffers.ids, buffers.total])
    if buffers.ordered and capacity:
        buffers.owners = buffers.array("owners", capacity)
        inputs, outputs = [buffers.total, capacity], [buffers.ids, buffers.owners]
        _launch(deterministic_sums.number_pairs, capacity, inputs, outputs)
    if capacity:
        end_bit = buffers.tiles.bit_length()
        wp.utils.radix_sort_pairs(buffers.keys, buffers.ids, capacity, end_bit=end_bit)
    threads, inputs = (buffers.tiles + 1, threads[1]), [buffers.keys, capacity, threads[1]]
    _launch(tiles.tile_starts, threads, inputs, [buffers.first])


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
    inputs: Inputs,
    buffers: Buffers,
    number: int,
    distortion: bool = True,
    *,
    median: bool = False,
    differentiable: bool = True,
) -> None:
    """Blend all tiles: light with one or two groups of channels, or one further group."""
    light, channels = number == 0, bool(buffers.channels)
    more = light and buffers.groups_with_light > 1
    shape = buffers.K, buffers.tile_width, buffers.tile_height
    metric = _metric(buffers, light and distortion)
    segments = buffers.segments_wanted if light and metric is None and differentiable else 1
    if light:
        buffers.segments = segments
    inclusive = buffers.settings.stop == Stop.INCLUSIVE
    kernel = make_composite(
        *shape, light, channels, inclusive, metric, more, segments, light and buffers.sloped,
        light and median,
    )  # fmt: skip
    channel = _lanes(buffers, buffers.channels[number] if channels else None)
    more_channel = _lanes(buffers, buffers.channels[1] if more else None)
    splats = _spread(buffers, number)
    more_splats = _spread(buffers, 1) if more else splats
    lists = [buffers.first, buffers.ids, splats, buffers.tiles_x, buffers.width, buffers.height]

    def arguments(tile0: int, _part: int) -> list:
        outputs = [buffers.sums.lanes, channel, more_channel, _states(buffers, segments)]
        return [*lists, tile0, _mapping(buffers), more_splats, inputs.calibration, *outputs]

    over_tiles(buffers, kernel, tile_edges(buffers, buffers.threads), arguments)


def composite_backward(
    inputs: Inputs,
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
    grad_calibration: wp.array | None = None,
) -> None:
    """Add the gradient of one pass to ``records`` [N]; those of CPU threads are summed in order.

    Args:
        inputs: For the calibration.
        buffers: After its forward pass.
        number: Of the pass: 0 has the light.
        grad_light: Of the planes of light.
        grad_channel: Of the pass's channels; None: they have no gradient.
        records: [N] added to.
        distortion: Whether it has a gradient.
        fixed: Whether weights are held fixed under the channels.
        grad_more: Of a second group of channels, under which weights are held fixed.
        more_records: [N] added to for the second group.
        grad_calibration: [4] added to for phases of sloped splats; None: not wanted.
    """
    light, channels = number == 0, grad_channel is not None
    shape = buffers.K, buffers.tile_width, buffers.tile_height
    passes = buffers.settings.clamp_gradient == ClampGradient.STRAIGHT
    metric = _metric(buffers, light and distortion)
    segments = buffers.segments if light and metric is None and (fixed or not channels) else 1
    fixed = fixed and channels
    more, sloped = grad_more is not None, light and buffers.sloped
    calibrated = sloped and grad_calibration is not None
    kernel = make_composite_backward(
        *shape, light, channels, passes, metric, fixed, more, segments, sloped, calibrated
    )
    phases = buffers.planes(f"phases in {segments} segments", 2 * segments) if calibrated else None
    gradients = [grad_light.lanes, _lanes(buffers, grad_channel), _lanes(buffers, grad_more)]
    edges = [0, buffers.tiles] if buffers.ordered else tile_edges(buffers, buffers.threads)
    added, more_added = records, more_records
    if buffers.ordered:
        added = buffers.zeros("gradients of pairs", len(buffers.owners), splat.Splat)
        if more_records is not None:
            more_added = buffers.zeros("more of pairs", len(buffers.owners), splat.Splat)
    targets = [added] + [
        buffers.zeros(f"records of thread {n}", buffers.count, splat.Splat)
        for n in range(len(edges) - 2)
    ]
    lists = [buffers.first, buffers.ids, _spread(buffers, number, anew=False), buffers.tiles_x]

    def arguments(tile0: int, part: int) -> list:
        given = [*lists, tile0, _mapping(buffers), buffers.sums.lanes, *gradients]
        outputs = [targets[part], more_added if more_added is not None else added]
        given += [_states(buffers, segments), inputs.calibration]
        return [*given, *outputs, _lanes(buffers, phases)]

    over_tiles(buffers, kernel, edges, arguments, segments)
    if phases is not None:
        of_tiles = buffers.array("phases of tiles", (2, buffers.tiles), wp.float64)
        given = [phases.flat, buffers.lanes * buffers.K]
        _launch(splat_distance.sum_phases, buffers.tiles, given, [of_tiles])
        _launch(splat_distance.add_phases, 1, [of_tiles], [grad_calibration])
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
    if buffers.sloped:
        _launch(splat_distance.finish_slopes, buffers.count, [buffers.splats], [grad_splats])


def resolve_images(
    inputs: Inputs, view: View, buffers: Buffers, images: Images, groups: list
) -> None:
    """Planes to images."""
    pixels, sums, tiling = (buffers.height, buffers.width), buffers.sums.flat, buffers.tiling
    if len(view.shifts) and images.quads is not None:
        lit = _quad_inputs(inputs, view, buffers)
        _launch(planes_to_images.resolve_quads, pixels, lit, [images.quads])
    if images.phasor is not None:
        lit = _phasor_inputs(inputs, buffers)
        _launch(planes_to_images.resolve_phasor, pixels, lit, [images.phasor])
    outputs = [images.distance, images.opacity, images.distortion, images.distance_median]
    if any(image is not None for image in outputs):
        outputs = [_or_nothing(buffers, image, 2) for image in outputs]
        factors = [sums, tiling, _distortion_factor(buffers)]
        _launch(planes_to_images.resolve_geometry, pixels, factors, outputs)
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
        lit = [*_quad_inputs(inputs, view, buffers), cotangents.quads]
        outputs = [target, _or_nothing(buffers, wanted.background_quads)]
        _launch(planes_to_images.fold_quads, pixels, lit, outputs)
        if wanted.calibration is not None:
            rows, lit = buffers.array("rows", pixels[0], wp.float64), [sums, tiling, lit[-1]]
            _launch(planes_to_images.fold_dc_offset, pixels[0], lit, [rows])
            _launch(planes_to_images.add_dc_offset, 1, [rows], [wanted.calibration])
    if cotangents.phasor is not None:
        lit = [*_phasor_inputs(inputs, buffers), cotangents.phasor]
        outputs = [target, _or_nothing(buffers, wanted.background_phasor)]
        _launch(planes_to_images.fold_phasor, pixels, lit, outputs)
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
        label, colour = f"gradient of channels {number}", name == "colour"
        grad = buffers.gradient_planes(label, CHANNEL_PLANES, added=False)
        background = _or_nothing(buffers, inputs.background_colour if colour else None)
        grad_background = _or_nothing(buffers, wanted.background_colour if colour else None)
        lit, outputs = [sums, tiling, background, start, cotangent], [grad.flat, target]
        _launch(planes_to_images.fold_channels, pixels, lit, [*outputs, grad_background])
        channels.append(grad)
    return planes, channels or [None]


def _quad_inputs(inputs: Inputs, view: View, buffers: Buffers) -> list:
    background = _or_nothing(buffers, inputs.background_quads)
    return [buffers.sums.flat, buffers.tiling, inputs.calibration, view.shifts, background]


def _phasor_inputs(inputs: Inputs, buffers: Buffers) -> list:
    background, factor = inputs.background_phasor, buffers.settings.phasor_factor
    return [buffers.sums.flat, buffers.tiling, factor, _or_nothing(buffers, background)]


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
        inputs = [buffers.records[number], buffers.owners]
        _launch(deterministic_sums.spread_records, len(buffers.owners), inputs, [copies])
    return copies


def _mapping(buffers: Buffers) -> wp.vec2:
    """Coefficients of the released zeta = far / (far - near) (1 - near / distance)."""
    near, far = buffers.settings.near, buffers.settings.far
    return wp.vec2(far / (far - near), far * near / (far - near))


def _states(buffers: Buffers, segments: int) -> wp.array:
    """State of pixels where segments end, see list_segments.py."""
    if segments == 1:
        return _lanes(buffers, None)
    return buffers.planes(f"ends of {segments} segments", PLANES * (segments - 1)).lanes


def _lanes(buffers: Buffers, planes: Planes | None) -> wp.array:
    """Planes for the compositor, without elements if there are none."""
    return _nothing(buffers, 3, buffers.sums.lanes.dtype) if planes is None else planes.lanes


def _launch(kernel, dim, inputs: list, outputs: list, **adjoint) -> None:
    where = {"device": next(a.device for a in outputs if isinstance(a, wp.array))}
    runtime.launch(kernel, dim, inputs, outputs, **where, **adjoint)


@cache
def _empty(device: str, ndim: int, dtype) -> wp.array:
    return wp.empty((0,) * ndim, dtype=dtype, device=device)


def _nothing(buffers: Buffers, ndim: int, dtype) -> wp.array:
    """An array without elements: 'absent', for kernels."""
    return _empty(str(buffers.device), ndim, dtype)


def _or_nothing(buffers: Buffers, array: wp.array | None, ndim: int = 3) -> wp.array:
    return array if array is not None else _nothing(buffers, ndim, wp.float32)
