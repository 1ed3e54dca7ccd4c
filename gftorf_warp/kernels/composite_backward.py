"""Adjoint of composite.py, written by hand: back to front with two running scalars per pixel, T and E.

With tau = the gradient of all T-weighted outputs times the values of splat k, sigma = the same for the T^2-weighted
ones, and T_e, E = T_e dL/dT_e behind the last splat (method, section 3.1):

    T <- T / (1 - alpha);   dL/dalpha = tau T + sigma T^2 - E / (1 - alpha);   E <- E + w (tau + 2 sigma T),   w = alpha T

E is what the loss gains from all that lies behind. Walked back to front it keeps its digits; front to back it is a
difference of sums that turns to noise behind a surface. The distortion is quadratic in w: its tau uses the final sums.
The generated adjoint of the forward loop would be wrong without a warning, since dynamic loops are not replayed.
"""

import functools

import warp as wp

from ..constants import ALPHA_MAX, ALPHA_MIN
from .composite import LAST, SUM_ZETA, SUM_ZETA2, TRANSMITTANCE, make_pixels, options
from .lanes import make_lanes, sums_of, warp_any, warp_max
from .splat import Splat, load_splat, row_missed, row_offset

# planes of ``grad_sums``, each [tiles, lanes] of V: gradients of the first five planes of the forward pass, and of T_e
GRAD_TRANSMITTANCE = 5
GRAD_LIGHT_PLANES = 6


def _add_record(K: int, light: bool, channels: bool) -> str:
    """C++ that adds the gradient of one splat from the K pixels of a thread, or of a warp on CUDA, to its record.

    m0, m1, m2 are the sums of dL/dpower / opacity times 1, dx, dx^2. dy is the same for all pixels of a thread, so these
    moments give all six derivatives of the ellipse. On CUDA 16 values of 32 lanes are summed in 16 shuffles: each step
    halves the values a lane carries and doubles the lanes it stands for; then 16 lanes add one 64-byte line.
    """
    vectors = ["m0", "m1", "m2", "count"]
    slots = dict.fromkeys(range(16), "0.0f")
    slots |= {0: "-A * gx - B * gy", 1: "-C * gy - B * gx", 2: "-0.5f * o * s[2]", 3: "-dy * gx"}
    slots |= {4: "-0.5f * dy * gy", 5: "s[0]", 6: "s[3]"}
    wanted = {8: "c0", 9: "c1", 10: "c2"} if channels else {}
    wanted |= {11: "p0", 12: "p1", 13: "p2", 14: "dist", 15: "z"} if light else {}
    for slot, name in wanted.items():
        slots[slot] = f"s[{len(vectors)}]"
        vectors.append(name)
    return f"""{sums_of(K, vectors)}
    const float gx = o * s[1], gy = o * s[0] * dy;
    float v[16] = {{{", ".join(slots[slot] for slot in range(16))}}};
#if defined(__CUDA_ARCH__)
    const unsigned lane = threadIdx.x & 31u;
    #define FOLD(BIT, HALF) {{ const bool up = (lane >> BIT) & 1u; _Pragma("unroll") for (int j = 0; j < HALF; ++j) {{ \\
        const float send = up ? v[j] : v[j + HALF], keep = up ? v[j + HALF] : v[j]; \\
        v[j] = keep + __shfl_xor_sync(0xffffffffu, send, 1 << BIT); }} }}
    FOLD(4, 8) FOLD(3, 4) FOLD(2, 2) FOLD(1, 1)
    #undef FOLD
    v[0] += __shfl_xor_sync(0xffffffffu, v[0], 1);
    if (!(lane & 1u)) atomicAdd(reinterpret_cast<float*>(grads.data + i) + (lane >> 1), v[0]);
#else
    for (int j = 0; j < 16; ++j) grads.data[i].c[j] += v[j];  // not atomic: every CPU thread has its own records
#endif
"""


@functools.cache
def make_composite_backward(K: int, tile_width: int, tile_height: int, light: bool, channels: bool, clamp_passes: bool):
    """The adjoint kernel for one tile shape and one set of outputs; arguments as in ``make_composite``.

    Args:
        K: Pixels per thread.
        tile_width: Columns of a tile [px].
        tile_height: Rows of a tile [px].
        light: Whether light, distance and distortion have gradients.
        channels: Whether the three channels have gradients.
        clamp_passes: Whether a clamped alpha passes its gradient on, as the released code does.
    """
    ops, pixels = make_lanes(K), make_pixels(K, tile_width, tile_height)
    V, fill, affine, mul, axpy, fma, fnma = ops.V, ops.fill, ops.affine, ops.mul, ops.axpy, ops.fma, ops.fnma
    above, keep_between, inverse = ops.above, ops.keep_between, ops.inverse
    response, alpha_of, nonzero, largest_of = ops.response, ops.alpha_of, ops.nonzero, ops.largest_of
    pixel_x, pixel_y = pixels.pixel_x, pixels.pixel_y
    clamped_from = 2.0 if clamp_passes else ALPHA_MAX

    @wp.func_native(_add_record(K, light, channels))
    def add_gradient(
        grads: wp.array[Splat], i: int, A: float, B: float, C: float, o: float, dy: float,
        m0: V, m1: V, m2: V, count: V, c0: V, c1: V, c2: V, p0: V, p1: V, p2: V, dist: V, z: V,
    ): ...  # fmt: skip

    @wp.kernel(**options(K))
    def composite_backward(
        # In:
        first: wp.array[int],  # [tiles + 1] where the list of each tile begins
        ids: wp.array[int],  # [pairs] splats of all tiles, near to far within a tile
        splats: wp.array[Splat],  # [N] records, see splat.py
        tiles_x: int,  # tiles per row [1]
        tile0: int,  # first tile of this launch [index]
        sums: wp.array3d[V],  # [9, tiles, lanes] planes of the forward pass
        grad_sums: wp.array3d[V],  # [6, tiles, lanes] gradients of RE .. DISTORTION and of T_e
        grad_channel: wp.array3d[V],  # [3, tiles, lanes] gradients of the three channels
        # Out:
        grad_splats: wp.array[Splat],  # [N] added to; slot 6 counts pixels
    ):
        """One thread per K pixels of a row; visits exactly the contributors of the forward pass, last one first."""
        t, lane = wp.tid()
        tile = tile0 + t
        x = pixel_x(tile, lane, tiles_x)
        y = pixel_y(tile, lane, tiles_x)
        last = sums[wp.static(LAST), tile, lane]
        T = sums[wp.static(TRANSMITTANCE), tile, lane]
        zero = fill(0.0)
        E = fill(0.0)
        if wp.static(light):
            g_re = grad_sums[0, tile, lane]
            g_im = grad_sums[1, tile, lane]
            g_amplitude = grad_sums[2, tile, lane]
            g_distance = grad_sums[3, tile, lane]
            g_distortion = grad_sums[4, tile, lane]
            E = mul(T, grad_sums[wp.static(GRAD_TRANSMITTANCE), tile, lane])
            sum_zeta = sums[wp.static(SUM_ZETA), tile, lane]
            sum_zeta2 = sums[wp.static(SUM_ZETA2), tile, lane]
            weight = affine(T, -1.0, 1.0)  # A = 1 - T_e
        if wp.static(channels):
            g0 = grad_channel[0, tile, lane]
            g1 = grad_channel[1, tile, lane]
            g2 = grad_channel[2, tile, lane]
        begin = first[tile]
        k = begin + warp_max(int(largest_of(last)))
        zeta0 = float(0.0)
        if begin < k:
            zeta0 = splats[ids[begin]][15]
        while k > begin:
            k -= 1
            i = ids[k]
            dy = row_offset(splats, i, y)
            if row_missed(splats, i, dy):
                continue
            gate = above(last, float(k - begin))  # only what this pixel composited
            q = load_splat(splats, i)
            dx = affine(x, -1.0, q[0])
            g = response(dx, -0.5 * q[2], q[3] * dy, 0.5 * q[4] * dy * dy, -0.5 * q[6])
            alpha = alpha_of(g, gate, q[5], ALPHA_MAX, ALPHA_MIN)
            if not warp_any(nonzero(alpha)):  # uniform: all lanes of a warp reach `add_gradient`, or none
                continue
            restored = inverse(affine(alpha, -1.0, 1.0))
            T = mul(T, restored)
            w = mul(alpha, T)
            tau = zero
            if wp.static(channels):
                tau = axpy(axpy(affine(g0, q[8], 0.0), g1, q[9]), g2, q[10])
            if wp.static(light):
                zeta = q[15] - zeta0
                spread = axpy(affine(weight, zeta, 0.0), sum_zeta, -1.0)  # zeta A - M
                tau = axpy(tau, g_distance, q[14])
                tau = fma(tau, g_distortion, axpy(axpy(sum_zeta2, sum_zeta, -zeta), spread, zeta))
                sigma = axpy(axpy(affine(g_re, q[11], 0.0), g_im, q[12]), g_amplitude, q[13])
                sigma_T = mul(sigma, T)
                grad_alpha = fnma(mul(T, axpy(tau, sigma_T, 1.0)), E, restored)
                E = fma(E, w, axpy(tau, sigma_T, 2.0))
            else:
                grad_alpha = fnma(mul(T, tau), E, restored)
                E = fma(E, w, tau)
            m0 = mul(g, keep_between(grad_alpha, alpha, wp.static(clamped_from)))
            m1 = mul(m0, dx)
            if wp.static(light and channels):
                w2 = mul(w, T)
                add_gradient(grad_splats, i, q[2], q[3], q[4], q[5], dy, m0, m1, mul(m1, dx), above(alpha, 0.0),
                             mul(w, g0), mul(w, g1), mul(w, g2), mul(w2, g_re), mul(w2, g_im), mul(w2, g_amplitude),
                             mul(w, g_distance), mul(affine(w, 2.0, 0.0), mul(g_distortion, spread)))  # fmt: skip
            elif wp.static(light):
                w2 = mul(w, T)
                add_gradient(grad_splats, i, q[2], q[3], q[4], q[5], dy, m0, m1, mul(m1, dx), above(alpha, 0.0),
                             zero, zero, zero, mul(w2, g_re), mul(w2, g_im), mul(w2, g_amplitude),
                             mul(w, g_distance), mul(affine(w, 2.0, 0.0), mul(g_distortion, spread)))  # fmt: skip
            else:
                add_gradient(grad_splats, i, q[2], q[3], q[4], q[5], dy, m0, m1, mul(m1, dx), above(alpha, 0.0),
                             mul(w, g0), mul(w, g1), mul(w, g2), zero, zero, zero, zero, zero)  # fmt: skip

    return composite_backward
