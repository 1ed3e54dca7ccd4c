"""The yardstick: one thread per pixel, plain Warp, on the same splats and tile lists as the
compositor.

Correct and obvious, with the same hand-written adjoint; what a first version of these kernels looks
like.
"""

import warp as wp

from gftorf_warp.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from gftorf_warp.kernels.rasterise.splat import Splat

_OPTIONS = {"enable_backward": False}


@wp.func
def alpha_at(q: Splat, x: float, y: float) -> wp.vec2:
    """(alpha, Gaussian value) of a splat at a pixel centre;
    alpha is 0 where the splat is too faint.
    """
    dx = q[0] - x
    dy = q[1] - y
    power = q[2] * dx * dx + q[3] * dx * dy + q[4] * dy * dy
    g = float(0.0)
    if power <= 0.0:
        g = wp.exp(power)
    alpha = wp.min(ALPHA_MAX, q[5] * g)
    if alpha < ALPHA_MIN:
        alpha = 0.0
    return wp.vec2(alpha, g)


@wp.kernel(**_OPTIONS)
def forward(
    # In:
    first: wp.array[int],  # [tiles + 1]
    ids: wp.array[int],  # [pairs]
    splats: wp.array[Splat],  # [N]
    tile_width: int,  # [px]
    tile_height: int,  # [px]
    tiles_x: int,  # [1]
    # Out:
    sums: wp.array3d[float],  # [12, H, W] colour 3, light 3, distance, distortion, M, V, T, last
):
    """One thread per pixel."""
    i, j = wp.tid()
    tile = (i // tile_height) * tiles_x + j // tile_width
    T = float(1.0)
    last = int(0)
    begin = first[tile]
    for c in range(12):
        sums[c, i, j] = 0.0
    for k in range(begin, first[tile + 1]):
        q = splats[ids[k]]
        alpha = alpha_at(q, float(j) + 0.5, float(i) + 0.5)[0]
        if alpha > 0.0:
            w = alpha * T
            for c in range(3):
                sums[c, i, j] = sums[c, i, j] + w * q[8 + c]
                sums[3 + c, i, j] = sums[3 + c, i, j] + w * T * q[11 + c]
            sums[6, i, j] = sums[6, i, j] + w * q[14]
            z = q[15]
            spread = z * z * (1.0 - T) - 2.0 * z * sums[8, i, j] + sums[9, i, j]
            sums[7, i, j] = sums[7, i, j] + w * spread
            sums[8, i, j] = sums[8, i, j] + w * z
            sums[9, i, j] = sums[9, i, j] + w * z * z
            T = T * (1.0 - alpha)
            last = k + 1 - begin
            if T < TRANSMITTANCE_MIN:
                break
    sums[10, i, j] = T
    sums[11, i, j] = float(last)


@wp.kernel(**_OPTIONS)
def backward(
    # In:
    first: wp.array[int],  # [tiles + 1]
    ids: wp.array[int],  # [pairs]
    splats: wp.array[Splat],  # [N]
    tile_width: int,  # [px]
    tile_height: int,  # [px]
    tiles_x: int,  # [1]
    sums: wp.array3d[float],  # [12, H, W]
    grad: wp.array3d[float],  # [9, H, W] gradients of the first eight planes and of T
    # Out:
    grad_splats: wp.array[Splat],  # [N] added to
):
    """One thread per pixel, back to front; sixteen atomics per contributor."""
    i, j = wp.tid()
    tile = (i // tile_height) * tiles_x + j // tile_width
    begin = first[tile]
    T = sums[10, i, j]
    E = T * grad[8, i, j]
    A = 1.0 - T
    M = sums[8, i, j]
    V = sums[9, i, j]
    k = begin + int(sums[11, i, j])
    while k > begin:
        k -= 1
        n = ids[k]
        q = splats[n]
        pair = alpha_at(q, float(j) + 0.5, float(i) + 0.5)
        alpha = pair[0]
        if alpha > 0.0:
            T = T / (1.0 - alpha)
            w = alpha * T
            z = q[15]
            spread = z * A - M
            tau = grad[6, i, j] * q[14] + grad[7, i, j] * (V - z * M + z * spread)
            sigma = float(0.0)
            record = Splat()
            for c in range(3):
                tau += grad[c, i, j] * q[8 + c]
                sigma += grad[3 + c, i, j] * q[11 + c]
                record[8 + c] = w * grad[c, i, j]
                record[11 + c] = w * T * grad[3 + c, i, j]
            grad_alpha = tau * T + sigma * T * T - E / (1.0 - alpha)
            E += w * (tau + 2.0 * sigma * T)
            if alpha == ALPHA_MAX:
                grad_alpha = 0.0
            dx = q[0] - float(j) - 0.5
            dy = q[1] - float(i) - 0.5
            g_power = q[5] * pair[1] * grad_alpha
            record[0] = g_power * (2.0 * q[2] * dx + q[3] * dy)
            record[1] = g_power * (2.0 * q[4] * dy + q[3] * dx)
            record[2] = g_power * dx * dx
            record[3] = g_power * dx * dy
            record[4] = g_power * dy * dy
            record[5] = pair[1] * grad_alpha
            record[6] = 1.0
            record[14] = w * grad[6, i, j]
            record[15] = 2.0 * w * grad[7, i, j] * spread
            wp.atomic_add(grad_splats, n, record)
