"""Planes in tile order to row-major images, with quads and background; and the adjoint.

    quad_q = light . (cos theta_q, sin theta_q, b) + T_e background
    phasor = eta light + T_e background
    colour = channels + T_e background,   opacity = 1 - T_e,   distortion = factor * (half sum)

(method, section 2.6), all linear in light and T_e. Each output has a pair of kernels; the adjoints
add up.
"""

import warp as wp

from ..correlation import DC_OFFSET, quad_of
from .composite import AMPLITUDE, DISTANCE, DISTORTION, IM, MEDIAN, RE, TRANSMITTANCE
from .composite_backward import GRAD_TRANSMITTANCE

_RE, _IM, _AMPLITUDE = wp.constant(RE), wp.constant(IM), wp.constant(AMPLITUDE)
_DISTANCE, _DISTORTION = wp.constant(DISTANCE), wp.constant(DISTORTION)
_TRANSMITTANCE, _GRAD_T = wp.constant(TRANSMITTANCE), wp.constant(GRAD_TRANSMITTANCE)
_DC, _MEDIAN = wp.constant(DC_OFFSET), wp.constant(MEDIAN)


@wp.struct
class Tiling:
    """Layout of planes that are stored by (tile, block, row, column); sides are powers of two."""

    width_log2: int  # columns of a tile
    height_log2: int  # rows of a tile
    side_log2: int  # columns and rows of a block
    count_x: int  # tiles per row of the image


@wp.func
def slot(x: int, y: int, tiling: Tiling) -> int:
    """Place of pixel [y, x] in a plane."""
    tile = (y >> tiling.height_log2) * tiling.count_x + (x >> tiling.width_log2)
    in_x = x & ((1 << tiling.width_log2) - 1)
    in_y = y & ((1 << tiling.height_log2) - 1)
    side = tiling.side_log2
    block = ((in_y >> side) << (tiling.width_log2 - side)) + (in_x >> side)
    mask = (1 << side) - 1
    return (
        (tile << (tiling.width_log2 + tiling.height_log2))
        + (((block << side) + (in_y & mask)) << side)
        + (in_x & mask)
    )


@wp.func
def light_at(sums: wp.array2d[float], k: int) -> wp.vec3:
    """Light of a pixel, before any background."""
    return wp.vec3(sums[_RE, k], sums[_IM, k], sums[_AMPLITUDE, k])


@wp.kernel(enable_backward=False)
def resolve_quads(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    calibration: wp.array[float],  # [4] phase slope, phase offset, source intensity, DC offset [1]
    shifts: wp.array[wp.vec2],  # [Q] (cos, sin) of the phase shifts [1]
    background: wp.array3d[float],  # [Q, H, W], or [0, 0, 0]: black
    # Out:
    quads: wp.array3d[float],  # [Q, H, W]
):
    """One thread per pixel, all quads of it."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    light = light_at(sums, k)
    for q in range(quads.shape[0]):
        value = quad_of(light, shifts[q], calibration[_DC])
        if background.shape[0] > 0:
            value += sums[_TRANSMITTANCE, k] * background[q, y, x]
        quads[q, y, x] = value


@wp.kernel(enable_backward=False)
def fold_quads(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    calibration: wp.array[float],  # [4] phase slope, phase offset, source intensity, DC offset [1]
    shifts: wp.array[wp.vec2],  # [Q] (cos, sin) of the phase shifts [1]
    background: wp.array3d[float],  # [Q, H, W], or [0, 0, 0]: black
    grad_quads: wp.array3d[float],  # [Q, H, W]
    # Out:
    grad_sums: wp.array2d[float],  # [6, pixels] added to
    grad_background: wp.array3d[float],  # [Q, H, W] added to, or [0, 0, 0]: not wanted
):
    """Adjoint of :func:`resolve_quads`; one thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    g_light = wp.vec3(0.0, 0.0, 0.0)
    g_T = float(0.0)
    for q in range(grad_quads.shape[0]):
        g = grad_quads[q, y, x]
        g_light += g * wp.vec3(shifts[q][0], shifts[q][1], calibration[_DC])
        if background.shape[0] > 0:
            g_T += g * background[q, y, x]
        if grad_background.shape[0] > 0:
            grad_background[q, y, x] = grad_background[q, y, x] + g * sums[_TRANSMITTANCE, k]
    for c in range(3):
        grad_sums[c, k] = grad_sums[c, k] + g_light[c]
    grad_sums[_GRAD_T, k] = grad_sums[_GRAD_T, k] + g_T


@wp.kernel(enable_backward=False)
def fold_dc_offset(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    grad_quads: wp.array3d[float],  # [Q, H, W]
    # Out:
    grad_rows: wp.array[wp.float64],  # [H] derivative by the DC offset, contribution of each row
):
    """One thread per row: sum of amplitude times gradient, in double precision."""
    y = wp.tid()
    total = wp.float64(0.0)
    for x in range(grad_quads.shape[2]):
        g = float(0.0)
        for q in range(grad_quads.shape[0]):
            g += grad_quads[q, y, x]
        total += wp.float64(g * sums[_AMPLITUDE, slot(x, y, tiling)])
    grad_rows[y] = total


@wp.kernel(enable_backward=False)
def add_dc_offset(
    # In:
    grad_rows: wp.array[wp.float64],  # [H] see :func:`fold_dc_offset`
    # Out:
    grad_calibration: wp.array[float],  # [4] its last entry is added to
):
    """One thread in all: rows are summed in order, so that the result is deterministic."""
    total = wp.float64(0.0)
    for y in range(grad_rows.shape[0]):
        total += grad_rows[y]
    grad_calibration[_DC] = grad_calibration[_DC] + float(total)


@wp.kernel(enable_backward=False)
def resolve_phasor(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    factor: float,  # eta, length of a phasor over the amplitude [1]
    background: wp.array3d[float],  # [3, H, W], or [0, 0, 0]: black
    # Out:
    phasor: wp.array3d[float],  # [3, H, W] re, im, amplitude
):
    """One thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    for c in range(3):
        value = factor * sums[c, k]
        if background.shape[0] > 0:
            value += sums[_TRANSMITTANCE, k] * background[c, y, x]
        phasor[c, y, x] = value


@wp.kernel(enable_backward=False)
def fold_phasor(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    factor: float,  # eta, length of a phasor over the amplitude [1]
    background: wp.array3d[float],  # [3, H, W], or [0, 0, 0]: black
    grad_phasor: wp.array3d[float],  # [3, H, W]
    # Out:
    grad_sums: wp.array2d[float],  # [6, pixels] added to
    grad_background: wp.array3d[float],  # [3, H, W] added to, or [0, 0, 0]: not wanted
):
    """Adjoint of :func:`resolve_phasor`; one thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    g_T = float(0.0)
    for c in range(3):
        g = grad_phasor[c, y, x]
        grad_sums[c, k] = grad_sums[c, k] + factor * g
        if background.shape[0] > 0:
            g_T += g * background[c, y, x]
        if grad_background.shape[0] > 0:
            grad_background[c, y, x] = grad_background[c, y, x] + g * sums[_TRANSMITTANCE, k]
    grad_sums[_GRAD_T, k] = grad_sums[_GRAD_T, k] + g_T


@wp.kernel(enable_backward=False)
def resolve_geometry(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of the compositor
    tiling: Tiling,  # order of the pixels [px]
    factor: float,  # 2: double sum of the distortion, 1: half sum [1]
    # Out:
    distance: wp.array2d[float],  # [H, W] not divided by the opacity [m]
    opacity: wp.array2d[float],  # [H, W]
    distortion: wp.array2d[float],  # [H, W]
    median: wp.array2d[float],  # [H, W] distance at which T falls below one half, else 0 [m]
):
    """One thread per pixel; each image is [0, 0] where it is not wanted."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    if distance.shape[0] > 0:
        distance[y, x] = sums[_DISTANCE, k]
    if opacity.shape[0] > 0:
        opacity[y, x] = 1.0 - sums[_TRANSMITTANCE, k]
    if distortion.shape[0] > 0:
        distortion[y, x] = factor * sums[_DISTORTION, k]
    if median.shape[0] > 0:
        median[y, x] = sums[_MEDIAN, k]


@wp.kernel(enable_backward=False)
def fold_plane(
    # In:
    grad_image: wp.array2d[float],  # [H, W] gradient of distance, opacity or distortion
    tiling: Tiling,  # order of the pixels [px]
    factor: float,  # derivative of the image by its plane [1]
    plane: int,  # plane of ``grad_sums`` [index]
    # Out:
    grad_sums: wp.array2d[float],  # [6, pixels] added to
):
    """Adjoint of one image of :func:`resolve_geometry`; one thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    grad_sums[plane, k] = grad_sums[plane, k] + factor * grad_image[y, x]


@wp.kernel(enable_backward=False)
def resolve_channels(
    # In:
    channel: wp.array2d[float],  # [3, pixels] planes of the compositor
    sums: wp.array2d[float],  # [10, pixels] its planes of light, for T_e
    tiling: Tiling,  # order of the pixels [px]
    background: wp.array3d[float],  # [3, H, W], or [0, 0, 0]: black
    start: int,  # first image to write [index]
    # Out:
    image: wp.array3d[float],  # [C, H, W] at most three channels from ``start`` on
):
    """One thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    for c in range(3):
        if start + c < image.shape[0]:
            value = channel[c, k]
            if background.shape[0] > 0:
                value += sums[_TRANSMITTANCE, k] * background[c, y, x]
            image[start + c, y, x] = value


@wp.kernel(enable_backward=False)
def fold_channels(
    # In:
    sums: wp.array2d[float],  # [10, pixels] planes of light, for T_e
    tiling: Tiling,  # order of the pixels [px]
    background: wp.array3d[float],  # [3, H, W], or [0, 0, 0]: black
    start: int,  # first image to read [index]
    grad_image: wp.array3d[float],  # [C, H, W]
    # Out:
    grad_channel: wp.array2d[float],  # [3, pixels] written
    grad_sums: wp.array2d[float],  # [6, pixels] the plane of T_e is added to
    grad_background: wp.array3d[float],  # [3, H, W] added to, or [0, 0, 0]: not wanted
):
    """Adjoint of :func:`resolve_channels`; one thread per pixel."""
    y, x = wp.tid()
    k = slot(x, y, tiling)
    g_T = float(0.0)
    for c in range(3):
        g = float(0.0)
        if start + c < grad_image.shape[0]:
            g = grad_image[start + c, y, x]
        grad_channel[c, k] = g
        if background.shape[0] > 0:
            g_T += g * background[c, y, x]
        if grad_background.shape[0] > 0:
            grad_background[c, y, x] = grad_background[c, y, x] + g * sums[_TRANSMITTANCE, k]
    grad_sums[_GRAD_T, k] = grad_sums[_GRAD_T, k] + g_T
