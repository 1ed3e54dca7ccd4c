"""Front to back through the splats of a tile: T-weighted distance and channels, T^2-weighted light.

Splat k with alpha_k = min(0.99, o_k G_k) leaves T_{k+1} = T_k (1 - alpha_k), T_0 = 1, and adds to
its pixel

    w_k = alpha_k T_k   times   distance d, three channels c; and to the distortion, half of the
                                double sum
    w_k T_k             times   light (a cos psi, a sin psi, a), which passes every splat twice

(paper, equations 3-5; method, sections 2.5 and 2.7). The background is linear in the
transmittance T_e that remains, and added in planes_to_images.py. The adjoint is
composite_backward.py. Distance and light are those of the splat's centre, or, of sloped splats, of
the pixel (splat_distance.py).
"""

from types import SimpleNamespace

import warp as wp

from ...constants import ALPHA_MAX, TRANSMITTANCE_MIN
from .. import making
from ..correlation import PHASE_OFFSET, PHASE_SLOPE
from .list_segments import PLANES, segment_length
from .shared_batches import (
    GROUP,
    ROUND,
    entry,
    fetch_more,
    fetch_records,
    make_warp_memory,
    more_of,
    record_of,
    wait_for_records,
)
from .simd import contracted, make_lanes, warp_any
from .splat import AHEAD, Splat, block_missed, load_splat, prefetch
from .splat_distance import make_slopes

# planes of ``light``, each [tiles, lanes] of V
RE, IM, AMPLITUDE, DISTANCE, DISTORTION, SUM_ZETA, SUM_ZETA2, TRANSMITTANCE, LAST = range(9)
MEDIAN = 9
LIGHT_PLANES = 10
NEAREST = 1e-6  # [m] of a splat: padding records have distance 0 and weight 0
FARTHEST = 1e-6  # [1/m] likewise of an inverse distance
TURN = 6.283185307179586  # [rad]
CHANNEL_PLANES = 3  # planes of ``channel``


def options(K: int) -> dict:
    """Kernel options of a compositor: contraction to FMAs on the CPU, fast math on CUDA."""
    module_options: dict = {"fast_math": True} | (contracted() if K > 1 else {})
    return {
        "enable_backward": False,
        "module": "unique",
        "launch_bounds": 256,
        "grid_stride": False,
        "module_options": module_options,
    }


@making.once
def make_pixels(K: int, tile_width: int, tile_height: int) -> SimpleNamespace:
    """Position of a lane's block of K pixels in a tile of ``tile_width`` x ``tile_height`` [px]."""
    side = make_lanes(K).side
    if tile_width % side or tile_height % side:
        raise ValueError(
            f"blocks of {side} x {side} pixels must fill a tile, got {tile_width} x {tile_height}"
        )
    lanes_x = tile_width // side

    @wp.func
    def block_x(tile: int, lane: int, tiles_x: int) -> float:
        """Centre of the first pixel of a block, x [px]."""
        first = (tile % tiles_x) * wp.static(tile_width)
        return float(first + (lane % wp.static(lanes_x)) * wp.static(side)) + 0.5

    @wp.func
    def block_y(tile: int, lane: int, tiles_x: int) -> float:
        """Centre of the first pixel of a block, y [px]."""
        first = (tile // tiles_x) * wp.static(tile_height)
        return float(first + (lane // wp.static(lanes_x)) * wp.static(side)) + 0.5

    return SimpleNamespace(
        block_x=block_x, block_y=block_y, lanes=lanes_x * (tile_height // side), side=side
    )


@making.once
def make_zeta(metric: bool):
    """What distortion is measured on: the distance [m], or the released mapping of it to [0, 1]."""

    @wp.func
    def zeta_of(distance: float, mapping: wp.vec2) -> float:
        if wp.static(metric):
            return distance
        return mapping[0] - mapping[1] / wp.max(distance, wp.static(NEAREST))

    return zeta_of


@making.once
def make_distance(sloped: bool):
    """The distance [m] of a splat's centre, from its record."""

    @wp.func
    def distance_of(q: Splat) -> float:
        if wp.static(sloped):
            return 1.0 / q[14]
        return q[14]

    return distance_of


@making.once
def make_composite(
    K: int,
    tile_width: int,
    tile_height: int,
    light: bool,
    channels: bool,
    inclusive: bool,
    metric: bool | None,
    more: bool = False,
    segments: int = 1,
    sloped: bool = False,
    median: bool = False,
):
    """The kernel for one tile shape and one set of outputs.

    Args:
        K: Pixels per thread: 16, or 1 on CUDA.
        tile_width: Columns of a tile [px].
        tile_height: Rows of a tile [px]; on CUDA a tile has 32 pixels, one warp per tile.
        light: Whether light and distance are summed.
        channels: Whether the three channels are summed.
        inclusive: Whether the splat that ends a pixel is still added.
        metric: Whether distortion is of the distance or of its released mapping; None: neither.
        more: Whether three further channels are summed in the same pass; K must be 1.
        segments: Of a list in the backward pass; > 1 only with K = 1, light and no distortion.
        sloped: Whether the distance varies inside a splat.
        median: Whether the distance is kept at which T falls below one half; with light.
    """
    # the lanes of a warp fetch records for each other, see shared_batches.py
    cooperative, split = K == 1, segments > 1
    if split and not (cooperative and light and metric is None):
        raise ValueError("segments need light, no distortion, and a warp per tile")
    ops, pixels = make_lanes(K), make_pixels(K, tile_width, tile_height)
    V, fill, affine, mul = ops.V, ops.fill, ops.affine, ops.mul
    axpy, fma, fnma = ops.axpy, ops.fma, ops.fnma
    above, add, reaches, scaled = ops.above, ops.add, ops.reaches, ops.scaled
    drop_below, set_where, where_crossed = ops.drop_below, ops.set_where, ops.where_crossed
    power_of, hits, alpha_of, nonzero = ops.power_of, ops.hits, ops.alpha_of, ops.nonzero
    block_x, block_y, columns, rows = pixels.block_x, pixels.block_y, ops.columns, ops.rows
    half = 0.5 * (pixels.side - 1)  # from the first to the middle of a block [px]

    inverse, at_least, slopes = ops.inverse, ops.at_least, make_slopes(K)
    offset_of, cos_of, sin_of = slopes.offset_of, slopes.cos_of, slopes.sin_of
    zeta_of, distance_of = make_zeta(bool(metric)), make_distance(sloped)
    spreads = light and metric is not None
    warp_memory = make_warp_memory(more=more)

    @wp.func
    def goes_on(live: V) -> bool:
        """Whether a pixel is still alive; within a round of a warp all entries are processed."""
        if wp.static(cooperative):
            return True
        return warp_any(nonzero(live))

    @wp.func
    def store_state(
        states: wp.array3d[V],
        segment: int,
        tile: int,
        lane: int,
        T: V,
        re: V,
        im: V,
        amplitude: V,
        distance: V,
    ):
        """State at a segment's end: T, except of the last; sums added, except of the first."""
        if segment < wp.static(segments - 1):
            states[segment * wp.static(PLANES), tile, lane] = T
        if segment > 0:
            plane = (segment - 1) * wp.static(PLANES)
            states[plane + 1, tile, lane] = re
            states[plane + 2, tile, lane] = im
            states[plane + 3, tile, lane] = amplitude
            states[plane + 4, tile, lane] = distance

    @wp.kernel(**options(K))
    def composite(
        # In:
        first: wp.array[int],  # [tiles + 1] where the list of each tile begins
        ids: wp.array[int],  # [pairs] splats of all tiles, near to far within a tile
        splats: wp.array[Splat],  # [N] records, see splat.py
        tiles_x: int,  # tiles per row [1]
        width: int,  # columns of the image [px]
        height: int,  # rows of the image [px]
        tile0: int,  # first tile of this launch [index]
        mapping: wp.vec2,  # released zeta = mapping[0] - mapping[1] / distance [1, m]
        more_splats: wp.array[Splat],  # [N] records whose slots 8-10 are further channels
        calibration: wp.array[float],  # [4] phase slope [rad/m] and offset [rad]; of sloped splats
        # Out:
        sums: wp.array3d[V],  # [10, tiles, lanes] planes RE .. MEDIAN of ``light``
        channel: wp.array3d[V],  # [3, tiles, lanes] the three channels
        more_channel: wp.array3d[V],  # [3, tiles, lanes] the further channels
        states: wp.array3d[V],  # [5 (segments - 1), tiles, lanes] see list_segments.py
    ):
        """One thread per block of K pixels; on CUDA a warp per tile, with uniform control flow."""
        t, lane = wp.tid()
        tile = tile0 + t
        x0 = block_x(tile, lane, tiles_x)
        y0 = block_y(tile, lane, tiles_x)
        x = columns(x0)
        y = rows(y0)
        # pixels right of or below the image never start
        live = mul(
            above(affine(x, -1.0, float(width)), 0.0), above(affine(y, -1.0, float(height)), 0.0)
        )
        T = fill(1.0)
        if wp.static(inclusive):
            # is 0 for pixels outside the image; a copy, since Warp aliases variables
            T = add(live, fill(0.0))
        last = fill(0.0)
        if wp.static(light):
            re = fill(0.0)
            im = fill(0.0)
            amplitude = fill(0.0)
            distance = fill(0.0)
        if wp.static(median):
            middle = fill(0.0)
        if wp.static(split):  # sums of the segments before this one
            re_before = fill(0.0)
            im_before = fill(0.0)
            amplitude_before = fill(0.0)
            distance_before = fill(0.0)
        if wp.static(spreads):
            distortion = fill(0.0)
            sum_zeta = fill(0.0)
            sum_zeta2 = fill(0.0)
        if wp.static(channels):
            c0 = fill(0.0)
            c1 = fill(0.0)
            c2 = fill(0.0)
        if wp.static(more):
            c3 = fill(0.0)
            c4 = fill(0.0)
            c5 = fill(0.0)
        if wp.static(light and sloped):
            turns_per_metre = calibration[wp.static(PHASE_SLOPE)] * wp.static(1.0 / TURN)
            turns = calibration[wp.static(PHASE_OFFSET)] * wp.static(1.0 / TURN)
        begin = first[tile]
        end = first[tile + 1]
        segment = int(0)
        length = int(0)
        if wp.static(split):
            length = segment_length(end - begin, wp.static(segments))
        # distortion is blind to a common shift; near the surface its sums keep their digits
        zeta0 = float(0.0)
        if wp.static(spreads):
            if begin < end:
                zeta0 = zeta_of(distance_of(splats[ids[begin]]), mapping)
        k = int(begin)
        if wp.static(cooperative):
            memory = warp_memory()
            count = end - begin
            coming = int(0)
            if begin < end:
                coming = entry(ids, begin, 1, 0, count)
                fetch_records(memory, splats, coming, 0)
                if wp.static(more):
                    fetch_more(memory, more_splats, coming, 0)
                coming = entry(ids, begin, 1, wp.static(ROUND), count)
        # `continue` instead of nested `if`s: after an `if` Warp selects between the old and the new
        # value of everything assigned inside, here a dozen vectors per splat
        while k < end and warp_any(nonzero(live)):
            stop = end
            if wp.static(split):
                # a segment begins, since it is whole rounds
                if k - begin == (segment + 1) * length:
                    store_state(states, segment, tile, lane, T, re, im, amplitude, distance)
                    segment += 1
                    re_before = add(re_before, re)
                    im_before = add(im_before, im)
                    amplitude_before = add(amplitude_before, amplitude)
                    distance_before = add(distance_before, distance)
                    re = fill(0.0)
                    im = fill(0.0)
                    amplitude = fill(0.0)
                    distance = fill(0.0)
            if wp.static(cooperative):
                stop = k + ROUND  # behind the end of the list are padding records without effect
                wait_for_records()
                if stop < end:
                    fetch_records(memory, splats, coming, stop - begin)
                    if wp.static(more):
                        fetch_more(memory, more_splats, coming, stop - begin)
                    coming = entry(ids, begin, 1, stop - begin + wp.static(ROUND), count)
            while k < stop and goes_on(live):
                group = stop
                if wp.static(cooperative):
                    group = k + GROUP
                    start = int(k)
                while k < group and goes_on(live):  # the same trip count for all lanes of a warp
                    k += 1
                    if wp.static(K > 1):
                        i = ids[k - 1]
                        prefetch(splats, ids[wp.min(k + AHEAD, end - 1)])
                        if block_missed(splats, i, x0 + wp.static(half), y0 + wp.static(half)):
                            continue
                        q = load_splat(splats, i)
                    else:
                        q = record_of(
                            memory, start - begin, k - 1 - start, splats, ids, k - 1, k <= end
                        )
                    dx = affine(x, -1.0, q[0])
                    dy = affine(y, -1.0, q[1])
                    power = power_of(dx, dy, q[2], q[3], q[4])
                    hit = hits(power, live, q[6])
                    alpha = alpha_of(power, hit, q[5], ALPHA_MAX)
                    # with records in shared memory a miss costs less than a branch
                    if wp.static(not cooperative):
                        if not nonzero(alpha):
                            continue
                    if wp.static(not inclusive):
                        live = drop_below(live, fnma(T, T, alpha), TRANSMITTANCE_MIN)
                        alpha = mul(alpha, live)
                        hit = alpha
                    w = mul(alpha, T)
                    if wp.static(light and sloped):
                        near = affine(offset_of(dx, dy, q[12], q[13], q[15]), 1.0, q[14])
                        near = at_least(near, wp.static(FARTHEST))
                        d = inverse(near)
                        phase = affine(d, turns_per_metre, turns)
                        lit = mul(mul(scaled(w, q[11]), T), mul(near, near))
                        re = fma(re, lit, cos_of(phase))
                        im = fma(im, lit, sin_of(phase))
                        amplitude = add(amplitude, lit)
                        distance = fma(distance, w, d)
                    if wp.static(light and not sloped):
                        w2 = mul(w, T)
                        re = axpy(re, w2, q[11])
                        im = axpy(im, w2, q[12])
                        amplitude = axpy(amplitude, w2, q[13])
                        distance = axpy(distance, w, q[14])
                    if wp.static(spreads and sloped):
                        if wp.static(bool(metric)):
                            z = affine(d, 1.0, -zeta0)
                        else:
                            z = affine(near, -mapping[1], mapping[0] - zeta0)
                        zz = mul(z, z)
                        spread = fnma(add(fnma(zz, zz, T), sum_zeta2), add(z, z), sum_zeta)
                        distortion = fma(distortion, w, spread)
                        sum_zeta = fma(sum_zeta, w, z)
                        sum_zeta2 = fma(sum_zeta2, w, zz)
                    if wp.static(spreads and not sloped):
                        zeta = zeta_of(q[14], mapping) - zeta0
                        # w (zeta^2 A - 2 zeta M + V), with the weight so far A = 1 - T
                        spread = affine(T, -zeta * zeta, zeta * zeta)
                        spread = axpy(axpy(spread, sum_zeta, -2.0 * zeta), sum_zeta2, 1.0)
                        distortion = fma(distortion, w, spread)
                        sum_zeta = axpy(sum_zeta, w, zeta)
                        sum_zeta2 = axpy(sum_zeta2, w, zeta * zeta)
                    if wp.static(channels):
                        c0 = axpy(c0, w, q[8])
                        c1 = axpy(c1, w, q[9])
                        c2 = axpy(c2, w, q[10])
                    if wp.static(more):
                        m = more_of(memory, k - 1 - begin, more_splats, ids, k - 1, k <= end)
                        c3 = axpy(c3, w, m[0])
                        c4 = axpy(c4, w, m[1])
                        c5 = axpy(c5, w, m[2])
                    if wp.static(median):
                        if wp.static(not sloped):
                            d = fill(q[14])
                        middle = where_crossed(middle, T, fnma(T, T, alpha), d, 0.5)
                    T = fnma(T, T, alpha)
                    if wp.static(light):
                        last = set_where(last, hit, float(k - begin))
                    if wp.static(inclusive):
                        live = reaches(T, TRANSMITTANCE_MIN)
            if wp.static(not cooperative):
                k = end  # one round was all
        if wp.static(cooperative):
            wait_for_records()  # records that are not needed may still be in flight
        if wp.static(split):
            store_state(states, segment, tile, lane, T, re, im, amplitude, distance)
            nothing = fill(0.0)
            for later in range(segment + 1, wp.static(segments)):  # segments that no pixel reached
                store_state(states, later, tile, lane, T, nothing, nothing, nothing, nothing)
            re = add(re, re_before)
            im = add(im, im_before)
            amplitude = add(amplitude, amplitude_before)
            distance = add(distance, distance_before)
        if wp.static(light):
            sums[wp.static(RE), tile, lane] = re
            sums[wp.static(IM), tile, lane] = im
            sums[wp.static(AMPLITUDE), tile, lane] = amplitude
            sums[wp.static(DISTANCE), tile, lane] = distance
            sums[wp.static(TRANSMITTANCE), tile, lane] = T
            sums[wp.static(LAST), tile, lane] = last
        if wp.static(median):
            sums[wp.static(MEDIAN), tile, lane] = middle
        if wp.static(spreads):
            sums[wp.static(DISTORTION), tile, lane] = distortion
            sums[wp.static(SUM_ZETA), tile, lane] = sum_zeta
            sums[wp.static(SUM_ZETA2), tile, lane] = sum_zeta2
        if wp.static(channels):
            channel[0, tile, lane] = c0
            channel[1, tile, lane] = c1
            channel[2, tile, lane] = c2
        if wp.static(more):
            more_channel[0, tile, lane] = c3
            more_channel[1, tile, lane] = c4
            more_channel[2, tile, lane] = c5

    return composite
