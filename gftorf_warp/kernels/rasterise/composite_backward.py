"""Adjoint of composite.py, written by hand: back to front with two running scalars per pixel, T and
E.

With tau = the gradient of all T-weighted outputs times the values of splat k, sigma = the same for
the T^2-weighted ones, and T_e, E = T_e dL/dT_e behind the last splat (method, section 3.1):

    T <- T / (1 - alpha);  dL/dalpha = tau T + sigma T^2 - E / (1 - alpha);  E <- E + w (tau + 2
    sigma T),  w = alpha T

Of sloped splats (splat_distance.py) the values are those of the pixel, sigma too, and the
derivative by its inverse distance 1/d is

    w d (2 sigma T - d (dtau/dd + kappa T dsigma/dpsi)),
    dsigma/dpsi = a (g_im cos psi - g_re sin psi)

E is the gradient of everything behind; front to back it would be a difference of sums, noise behind
a surface. The distortion is quadratic in w: its tau uses the final sums. Warp's adjoint of the
forward loop would be silently wrong, since dynamic loops are not replayed.
"""

import warp as wp

from ...constants import ALPHA_MAX, ALPHA_MIN
from .. import making
from ..correlation import PHASE_OFFSET, PHASE_SLOPE
from .composite import (
    FARTHEST,
    LAST,
    NEAREST,
    SUM_ZETA,
    SUM_ZETA2,
    TRANSMITTANCE,
    TURN,
    make_distance,
    make_pixels,
    make_zeta,
    options,
)
from .list_segments import PLANES, segment_length
from .shared_batches import (
    GROUP,
    ROUND,
    entry,
    fetch_records,
    make_gradient_rounds,
    record_of,
    wait_for_records,
)
from .simd import make_lanes, sums_of, types_of, warp_max
from .splat import AHEAD, Splat, block_missed, load_splat, prefetch
from .splat_distance import make_slopes

# planes of ``grad_sums``: gradients of the first five planes of the forward pass, and of T_e
GRAD_TRANSMITTANCE = 5
GRAD_LIGHT_PLANES = 6
V1 = make_lanes(1).V


def _add_moments(K: int, light: bool, channels: bool, geometry: bool, sloped: bool = False) -> str:
    """C++ that adds sums over the K pixels of a CPU thread to a gradient record, permuted."""
    names = "v dx dy alpha w w2 g0 g1 g2 g_re g_im g_amplitude g_distance"
    if sloped:
        names = "v dx dy alpha w lit of_d free g0 g1 g2"
    loads = " ".join(f"const F {name}_ = load({name});" for name in names.split())
    values = {}
    if geometry:
        values |= {"v": "v_", "dx": "v_ * dx_", "dx2": "v_ * dx_ * dx_", "dxdy": "v_ * dx_ * dy_"}
        values |= {"dy": "v_ * dy_", "dy2": "v_ * dy_ * dy_"}
        values |= {"count": "alpha_ > 0.0f ? (F)(1.0f) : (F)(0.0f)", "weight": "w_"}
    if channels:
        values |= {"c0": "w_ * g0_", "c1": "w_ * g1_", "c2": "w_ * g2_"}
    slots = [*"dx dy dx2 dxdy dy2 v count weight c0 c1 c2 re im amplitude distance".split(), ""]
    if light and not sloped:
        values |= {"re": "w2_ * g_re_", "im": "w2_ * g_im_", "amplitude": "w2_ * g_amplitude_"}
        values |= {"distance": "w_ * g_distance_"}
    if sloped:
        values |= {"strength": "lit_", "gx": "free_ * dx_", "gy": "free_ * dy_"}
        values |= {"distance": "of_d_", "free": "free_"}
        slots[11:] = "strength gx gy distance free".split()
    sums, lanes = sums_of(K, values)
    if K == 1:
        entries = [f"s[{lanes.index(of)}]" if of in lanes else "0.0f" for of in slots]
        return f"""
#if !defined(__CUDA_ARCH__)
    {types_of(K)}
    {loads}
    {sums}
    const float record[16] = {{{", ".join(entries)}}};
    for (int j = 0; j < 16; ++j) grads.data[i].c[j] += record[j];
#endif
"""
    # 16: a zero
    order = ", ".join(str(lanes.index(of)) if of in lanes and of else "16" for of in slots)
    return f"""{types_of(K)}
    {loads}
    {sums}
    F record;  // not atomic: every CPU thread has records of its own
    __builtin_memcpy(&record, &grads.data[i], sizeof(record));
    record += __builtin_shufflevector(total, (F)(0.0f), {order});
    __builtin_memcpy(&grads.data[i], &record, sizeof(record));
"""


@wp.kernel(enable_backward=False)
def finish_moments(
    # In:
    splats: wp.array[Splat],  # [N] records, see splat.py
    # Out:
    grad_splats: wp.array[Splat],  # [N] moments in slots 0-5, replaced by gradients
):
    """One thread per splat: with v = dL/dpower, moments of v to gradients of centre and opacity."""
    n = wp.tid()
    q = splats[n]
    g = grad_splats[n]
    if g[6] > 0.0:  # a record that no pixel reached is zero, and its splat may be undefined
        x = g[0]
        y = g[1]
        g[0] = 2.0 * q[2] * x + q[3] * y
        g[1] = 2.0 * q[4] * y + q[3] * x
        g[5] = g[5] / q[5]
        grad_splats[n] = g


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const wp::vec_t<1, float> gradients[3] = {g3, g4, g5};
    for (int c = 0; c < 3; ++c) grads.data[i][8 + c] += w[0] * gradients[c][0];
#endif
""")
def add_more(grads: wp.array[Splat], i: int, w: V1, g3: V1, g4: V1, g5: V1):
    """Add the gradient of further channels; CPU only, on CUDA ``accumulate_round`` does it."""


@making.once
def make_composite_backward(
    K: int,
    tile_width: int,
    tile_height: int,
    light: bool,
    channels: bool,
    clamp_straight: bool,
    metric: bool | None,
    fixed: bool = False,
    more: bool = False,
    segments: int = 1,
    sloped: bool = False,
    calibrated: bool = False,
):
    """The adjoint kernel for one tile shape and one set of outputs; arguments as in
    ``make_composite``.

    Args:
        K: Pixels per thread.
        tile_width: Columns of a tile [px].
        tile_height: Rows of a tile [px].
        light: Whether light, distance and distortion have gradients.
        channels: Whether the three channels have gradients.
        clamp_straight: Whether the gradient ignores the clamp of alpha, as in the released code.
        metric: As in ``make_composite``; None: the distortion has no gradient.
        fixed: Whether weights are held fixed under the channels.
        more: Whether three further channels, with weights held fixed, have a gradient.
        segments: Warps per tile, as in the forward pass; > 1 only with weights held fixed.
        sloped: Whether the distance varies inside a splat.
        calibrated: Whether the phases of sloped splats have gradients.
    """
    cooperative, split = K == 1, segments > 1
    if split and not (cooperative and light and metric is None and (fixed or not channels)):
        raise ValueError("segments need light, no distortion, fixed weights, and a warp per tile")
    ops, pixels = make_lanes(K), make_pixels(K, tile_width, tile_height)
    V, fill, affine, mul = ops.V, ops.fill, ops.affine, ops.mul
    axpy, fma, fnma = ops.axpy, ops.fma, ops.fnma
    add, scaled, exceeds, keep_below = ops.add, ops.scaled, ops.exceeds, ops.keep_below
    inverse, at_least = ops.inverse, ops.at_least
    power_of, hits, response, alpha_of = ops.power_of, ops.hits, ops.response, ops.alpha_of
    nonzero, largest_of = ops.nonzero, ops.largest_of
    block_x, block_y, columns, rows = pixels.block_x, pixels.block_y, ops.columns, ops.rows
    half, zeta_of = 0.5 * (pixels.side - 1), make_zeta(bool(metric))
    distance_of = make_distance(sloped)
    spreads = light and metric is not None
    slopes = make_slopes(K)
    offset_of, where_free = slopes.offset_of, slopes.where_free
    cos_of, sin_of = slopes.cos_of, slopes.sin_of

    @wp.func_native(_add_moments(K, light, channels, light or not fixed))
    def add_moments(
        grads: wp.array[Splat], i: int, v: V, dx: V, dy: V, alpha: V, w: V, w2: V,
        g0: V, g1: V, g2: V, g_re: V, g_im: V, g_amplitude: V, g_distance: V,
    ): ...  # fmt: skip

    @wp.func_native(_add_moments(K, light, channels, light or not fixed, sloped=True))
    def add_sloped_moments(
        grads: wp.array[Splat], i: int, v: V, dx: V, dy: V, alpha: V, w: V, lit: V, of_d: V,
        free: V, g0: V, g1: V, g2: V,
    ): ...  # fmt: skip

    if cooperative:
        rounds = make_gradient_rounds(
            tile_width, light, channels, light or not fixed, spreads, more, sloped
        )
        warp_memory, store_derivatives = rounds.warp_memory, rounds.store_derivatives
        store_values, accumulate_round = rounds.store_values, rounds.accumulate_round

    @wp.kernel(**options(K))
    def composite_backward(
        # In:
        first: wp.array[int],  # [tiles + 1] where the list of each tile begins
        ids: wp.array[int],  # [pairs] splats of all tiles, near to far within a tile
        splats: wp.array[Splat],  # [N] records, see splat.py
        tiles_x: int,  # tiles per row [1]
        tile0: int,  # first tile of this launch [index]
        mapping: wp.vec2,  # released zeta = mapping[0] - mapping[1] / distance [1, m]
        sums: wp.array3d[V],  # [10, tiles, lanes] planes of the forward pass
        grad_sums: wp.array3d[V],  # [6, tiles, lanes] gradients of RE .. DISTORTION and of T_e
        grad_channel: wp.array3d[V],  # [3, tiles, lanes] gradients of the three channels
        grad_more: wp.array3d[V],  # [3, tiles, lanes] gradients of the further channels
        states: wp.array3d[V],  # [5 (segments - 1), tiles, lanes] see list_segments.py
        calibration: wp.array[float],  # [4] phase slope [rad/m] and offset [rad]; of sloped splats
        # Out:
        grad_splats: wp.array[Splat],  # [N] added to: moments, pixels, weights, gradients
        more_splats: wp.array[Splat],  # [N] added to: slots 8-10, gradients of the further channels
        phases: wp.array3d[V],  # [2 segments, tiles, lanes] gradients of phase offset and slope
    ):
        """One thread per block of K pixels, back to front; a warp per segment of a list."""
        t, lane = wp.tid()
        tile = tile0 + t // wp.static(segments)
        x0 = block_x(tile, lane, tiles_x)
        y0 = block_y(tile, lane, tiles_x)
        x = columns(x0)
        y = rows(y0)
        last = sums[wp.static(LAST), tile, lane]
        T = sums[wp.static(TRANSMITTANCE), tile, lane]
        zero = fill(0.0)
        E = fill(0.0)
        if wp.static(not channels):
            g0 = zero
            g1 = zero
            g2 = zero
        if wp.static(not light):
            g_re = zero
            g_im = zero
            g_amplitude = zero
            g_distance = zero
        if wp.static(light):
            g_re = grad_sums[0, tile, lane]
            g_im = grad_sums[1, tile, lane]
            g_amplitude = grad_sums[2, tile, lane]
            g_distance = grad_sums[3, tile, lane]
            E = mul(T, grad_sums[wp.static(GRAD_TRANSMITTANCE), tile, lane])
        if wp.static(light and sloped):
            phase_slope = calibration[wp.static(PHASE_SLOPE)]
            turns_per_metre = phase_slope * wp.static(1.0 / TURN)
            turns = calibration[wp.static(PHASE_OFFSET)] * wp.static(1.0 / TURN)
            by_offset = fill(0.0)
            by_slope = fill(0.0)
        if wp.static(spreads):
            g_distortion = grad_sums[4, tile, lane]
            twice_g_distortion = add(g_distortion, g_distortion)
            minus_sum = scaled(sums[wp.static(SUM_ZETA), tile, lane], -1.0)
            sum_zeta2 = sums[wp.static(SUM_ZETA2), tile, lane]
            weight = affine(T, -1.0, 1.0)  # A = 1 - T_e
        if wp.static(channels):
            g0 = grad_channel[0, tile, lane]
            g1 = grad_channel[1, tile, lane]
            g2 = grad_channel[2, tile, lane]
        g3 = zero
        g4 = zero
        g5 = zero
        if wp.static(more):
            g3 = grad_more[0, tile, lane]
            g4 = grad_more[1, tile, lane]
            g5 = grad_more[2, tile, lane]
        begin = first[tile]
        k = begin + warp_max(int(largest_of(last)))
        position = fill(float(k - begin))
        if wp.static(split):
            segment = t % wp.static(segments)
            length = segment_length(first[tile + 1] - begin, wp.static(segments))
            stop_of_segment = wp.min(k, begin + (segment + 1) * length)
            position = fill(float(stop_of_segment - begin))
            begin += segment * length
            k = wp.max(stop_of_segment, begin)
            # what later segments have added, the last one first
            for m in range(wp.static(segments - 1)):
                end_of = wp.static(segments - 2) - m
                if end_of >= segment:
                    plane = end_of * wp.static(PLANES)
                    lit = mul(g_re, states[plane + 1, tile, lane])
                    lit = fma(lit, g_im, states[plane + 2, tile, lane])
                    lit = fma(lit, g_amplitude, states[plane + 3, tile, lane])
                    E = add(E, fma(add(lit, lit), g_distance, states[plane + 4, tile, lane]))
                    T = states[plane, tile, lane]
        zeta0 = float(0.0)
        if wp.static(spreads):
            if begin < k:
                zeta0 = zeta_of(distance_of(splats[ids[begin]]), mapping)
        if wp.static(cooperative):
            memory = warp_memory()
            top = k - 1
            count = k - begin
            coming = int(0)
            if begin < k:
                store_derivatives(
                    memory, g0, g1, g2, g_re, g_im, g_amplitude, g_distance, g3, g4, g5
                )
                fetch_records(memory, splats, entry(ids, top, -1, 0, count), 0)
                coming = entry(ids, top, -1, wp.static(ROUND), count)
        while k > begin:
            stop = begin
            if wp.static(cooperative):
                stop = k - ROUND  # behind the last one are padding records without effect
                at = top + 1 - k  # entries behind us
                wait_for_records()
                if stop > begin:
                    fetch_records(memory, splats, coming, at + wp.static(ROUND))
                    coming = entry(ids, top, -1, at + wp.static(2 * ROUND), count)
            while k > stop:
                length_of_group = k - stop
                if wp.static(cooperative):
                    length_of_group = GROUP
                    behind = top + 1 - k
                n = int(0)
                while n < length_of_group:
                    n += 1
                    k -= 1
                    position = affine(position, 1.0, -1.0)
                    if wp.static(K > 1):
                        i = ids[k]
                        ahead = ids[wp.max(k - AHEAD, begin)]
                        prefetch(splats, ahead)
                        prefetch(grad_splats, ahead)
                        if block_missed(splats, i, x0 + wp.static(half), y0 + wp.static(half)):
                            continue
                        q = load_splat(splats, i)
                    else:
                        q = record_of(memory, behind, n - 1, splats, ids, k, k >= begin)
                    gate = exceeds(last, position)  # only what this pixel composited
                    dx = affine(x, -1.0, q[0])
                    dy = affine(y, -1.0, q[1])
                    power = power_of(dx, dy, q[2], q[3], q[4])
                    hit = hits(power, gate, q[6])
                    alpha = alpha_of(power, hit, q[5], ALPHA_MAX)
                    if wp.static(not cooperative):
                        if not nonzero(alpha):
                            continue
                    restored = inverse(affine(alpha, -1.0, 1.0))
                    T = mul(T, restored)
                    w = mul(alpha, T)
                    tau = zero
                    if wp.static(channels and not fixed):
                        tau = axpy(axpy(scaled(g0, q[8]), g1, q[9]), g2, q[10])
                    sigma_T = zero
                    w2 = zero
                    g_d = zero
                    if wp.static(light and sloped):
                        offset = offset_of(dx, dy, q[12], q[13], q[15])
                        near = at_least(affine(offset, 1.0, q[14]), wp.static(FARTHEST))
                        d = inverse(near)
                        phase = affine(d, turns_per_metre, turns)
                        cosine = cos_of(phase)
                        sine = sin_of(phase)
                        tau = fma(tau, g_distance, d)
                        fall = mul(near, near)
                        # derivative by the strength, then by the phase, over T^2
                        lit = mul(fall, fma(fma(g_amplitude, g_re, cosine), g_im, sine))
                        turned = scaled(mul(fall, fnma(mul(g_im, cosine), g_re, sine)), q[11])
                        sigma_T = scaled(mul(lit, T), q[11])
                        g_d = fma(g_distance, T, scaled(turned, phase_slope))
                        w2 = mul(w, T)
                        lit = mul(w2, lit)
                        if wp.static(calibrated):
                            turned = mul(w2, turned)
                            by_offset = add(by_offset, turned)
                            by_slope = fma(by_slope, turned, d)
                    if wp.static(light and not sloped):
                        tau = axpy(tau, g_distance, q[14])
                        sigma = axpy(axpy(scaled(g_re, q[11]), g_im, q[12]), g_amplitude, q[13])
                        sigma_T = mul(sigma, T)
                        g_d = g_distance
                        w2 = mul(w, T)
                    if wp.static(spreads and sloped):
                        if wp.static(bool(metric)):
                            z = affine(d, 1.0, -zeta0)
                        else:
                            z = affine(near, -mapping[1], mapping[0] - zeta0)
                        spread = fma(minus_sum, weight, z)  # zeta A - M
                        tau = fma(tau, g_distortion, fma(sum_zeta2, add(spread, minus_sum), z))
                        spread = mul(twice_g_distortion, spread)
                        if wp.static(not metric):
                            spread = scaled(mul(spread, fall), mapping[1])
                        g_d = add(g_d, spread)
                    if wp.static(spreads and not sloped):
                        zeta = zeta_of(q[14], mapping) - zeta0
                        spread = axpy(minus_sum, weight, zeta)  # zeta A - M
                        tau = fma(tau, g_distortion, axpy(sum_zeta2, add(spread, minus_sum), zeta))
                        if wp.static(bool(metric)):
                            g_d = fma(g_distance, twice_g_distortion, spread)
                        else:  # zeta changes with the distance by mapping[1] / distance^2
                            far = wp.max(q[14], wp.static(NEAREST))
                            slope = scaled(twice_g_distortion, mapping[1] / (far * far))
                            g_d = fma(g_distance, slope, spread)
                    tau = add(tau, sigma_T)
                    v = fnma(mul(w, tau), E, mul(alpha, restored))  # alpha dL/dalpha
                    E = fma(E, w, add(tau, sigma_T))
                    if wp.static(clamp_straight):
                        raw = scaled(response(power, hit), q[5])
                        # o G / alpha
                        v = fma(zero, v, mul(raw, inverse(at_least(alpha, ALPHA_MIN))))
                    else:
                        v = keep_below(v, alpha, ALPHA_MAX)
                    if wp.static(light and sloped):
                        g_d = mul(d, fnma(add(sigma_T, sigma_T), d, g_d))  # by the inverse distance
                        w2 = lit
                    of_d = mul(w, g_d)
                    if wp.static(cooperative):
                        i = ids[wp.max(k, begin)]  # read on the CPU only
                        store_values(memory, behind, n - 1, v, w, w2, of_d)
                        if wp.static(more):
                            add_more(more_splats, i, w, g3, g4, g5)
                    if wp.static(light and sloped):
                        free = where_free(of_d, offset, q[15])
                        add_sloped_moments(
                            grad_splats, i, v, dx, dy, alpha, w, lit, of_d, free, g0, g1, g2
                        )
                    else:
                        add_moments(
                            grad_splats, i, v, dx, dy, alpha, w, w2, g0, g1, g2,
                            g_re, g_im, g_amplitude, g_d,
                        )  # fmt: skip
            if wp.static(cooperative):
                accumulate_round(
                    memory, grad_splats, more_splats, ids, top, at, wp.min(count - at, ROUND), x, y
                )

        if wp.static(calibrated):
            phases[2 * (t % wp.static(segments)), tile, lane] = by_offset
            phases[2 * (t % wp.static(segments)) + 1, tile, lane] = by_slope

    return composite_backward
