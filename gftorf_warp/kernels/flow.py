"""Squared difference of the optical flow that moving surfaces cause to the one that was measured, and its gradient.

A pixel at x sees the point P = d r of its camera, r the unit vector through it. After the composited displacement D it
is at Q = M P + m + R D of the later camera, with [M m] from one camera to the other and R from the world to it:

    F = f Q_xy / Q_z + c - x,   e = |F - F_measured|^2,   dF/dQ = f / Q_z (1, 0, -Q_x / Q_z), ..

(method, section 5). The distance has no derivative. A measured flow that is not finite is unknown: no error there.
"""

import warp as wp

from .sums import OVER_LANES

NUMBERS = 29  # of two cameras: f and c of the first and of the later one, M, m, R
NEAREST = 1e-6  # [m] of a surface

_PIXEL = f"""
    const float* k = views.data + flow * {NUMBERS};
    const int width = distance.shape[1], plane = distance.shape[0] * width;
    const float x = (float)(pixel % width) + 0.5f, y = (float)(pixel / width) + 0.5f;
    const float u = (x - k[2]) / k[0], v = (y - k[3]) / k[1];
    const float seen = distance.data[pixel], d = (seen < {NEAREST}f ? {NEAREST}f : seen) / sqrtf(u * u + v * v + 1.0f);
    const float* D = displacement.data + 3 * flow * plane + pixel;
    const float* F = measured.data + ((long long)row * views.shape[0] + flow) * 2 * plane + pixel;
    const float dx = D[0], dy = D[plane], dz = D[2 * plane], fx = F[0], fy = F[plane];
    const float qx = d * (k[8] * u + k[9] * v + k[10]) + k[17] + (k[20] * dx + k[21] * dy + k[22] * dz);
    const float qy = d * (k[11] * u + k[12] * v + k[13]) + k[18] + (k[23] * dx + k[24] * dy + k[25] * dz);
    const float qz = d * (k[14] * u + k[15] * v + k[16]) + k[19] + (k[26] * dx + k[27] * dy + k[28] * dz);
    const float a = qx / qz, b = qy / qz, largest = 3.402823466e38f;
    const bool known = fabsf(fx) <= largest && fabsf(fy) <= largest;
    const float ex = known ? k[4] * a + (k[6] - x) - fx : 0.0f, ey = known ? k[5] * b + (k[7] - y) - fy : 0.0f;
"""

_ERROR = f"""
    float error = 0.0f;
    if (pixel < distance.shape[0] * distance.shape[1]) {{
        for (int flow = 0; flow < views.shape[0]; ++flow) {{{_PIXEL}
            error += ex * ex + ey * ey;
        }}
    }}
    const int thread = pixel;{OVER_LANES}
    error = over_lanes(error);
    if (writes) partials.data[slot] = error;
"""

_GRADIENT = f"""{_PIXEL}
    float gx = 0.0f, gy = 0.0f, gz = 0.0f;
    if (known) {{
        const float bx = 2.0f * scale * ex * k[4] / qz, by = 2.0f * scale * ey * k[5] / qz, bz = -(bx * a + by * b);
        gx = k[20] * bx + k[23] * by + k[26] * bz;
        gy = k[21] * bx + k[24] * by + k[27] * bz;
        gz = k[22] * bx + k[25] * by + k[28] * bz;
    }}
    float* out = grad.data + 3 * flow * plane + pixel;
    out[0] = gx; out[plane] = gy; out[2 * plane] = gz;
"""


@wp.func_native(_ERROR)
def error_of(
    distance: wp.array2d[float],
    displacement: wp.array3d[float],
    measured: wp.array4d[float],
    row: int,
    views: wp.array2d[float],
    pixel: int,
    partials: wp.array2d[float],
):
    """All flows of one pixel, summed over the lanes of a warp."""


@wp.func_native(_GRADIENT)
def gradient_of(
    distance: wp.array2d[float],
    displacement: wp.array3d[float],
    measured: wp.array4d[float],
    row: int,
    views: wp.array2d[float],
    scale: float,
    flow: int,
    pixel: int,
    grad: wp.array3d[float],
):
    """One flow of one pixel."""


@wp.kernel(enable_backward=False, grid_stride=False)
def flow_errors(
    # In:
    distance: wp.array2d[float],  # [H, W] of the surface, not divided by the opacity [m]
    displacement: wp.array3d[float],  # [3F, H, W] to the end of each flow, world axes [m]
    measured: wp.array4d[float],  # [R F, 2, H, W] flows, NaN: unknown [px]
    row: wp.array[int],  # [1] which F of ``measured`` [index]
    views: wp.array2d[float],  # [F, 29] f, c, later f, c, M, m, R [px, 1, m]
    # Out:
    partials: wp.array2d[float],  # [1, P] sums of squared differences over parts of the image [px^2]
):
    """One thread per pixel; on CUDA as many as fill the last warp."""
    error_of(distance, displacement, measured, row[0], views, wp.tid(), partials)


@wp.kernel(enable_backward=False)
def flow_gradient(
    # In:
    distance: wp.array2d[float],  # [H, W] as above [m]
    displacement: wp.array3d[float],  # [3F, H, W] as above [m]
    measured: wp.array4d[float],  # [R F, 2, H, W] as above [px]
    row: wp.array[int],  # [1] which F of ``measured`` [index]
    views: wp.array2d[float],  # [F, 29] as above
    factor: float,  # multiplies everything, for example one over the number of values [1]
    cotangent: wp.array[float],  # [1] of the loss; multiplies everything, too
    # Out:
    grad: wp.array3d[float],  # [3F, H, W] by ``displacement`` [1/m]
):
    """One thread per flow and pixel."""
    flow, pixel = wp.tid()
    gradient_of(distance, displacement, measured, row[0], views, factor * cotangent[0], flow, pixel, grad)
