"""Squared difference of rendered and measured optical flow, and its gradient.

A pixel at x sees the point P = d r of its camera, r the unit vector through it. After the
composited displacement D it is at Q = M P + m + R D of the later camera, with [M m] from one camera
to the other and R from the world to it:

    F = f Q_xy / Q_z + c - x,   e = |F - F_measured|^2,   dF/dQ = f / Q_z (1, 0, -Q_x / Q_z), ..

(method, section 5). A lens that distorts is undone to get the ray, and images Q_xy / Q_z elsewhere,
with a derivative of its own (scene/distortion.py); a pinhole does not come that way. The distance
has no derivative. A measured flow that is not finite is unknown: no error there.
"""

import warp as wp

from .ordered_sums import OVER_LANES

NUMBERS = 29  # of two cameras: f and c of the first and of the later one, M, m, R
LENSES = 11  # more with a lens: k1, k2, p1, p2, k3 of both cameras, radius of the later one
STEPS = 20  # of Newton; a lens that the host could undo needs a handful
NEAREST = 1e-6  # [m] of a surface

_LENS = """
    // and what the lens does to small steps there
    auto image = [](const float* c, float a, float b, float* at) {
        const float r2 = a * a + b * b, radial = 1.0f + r2 * (c[0] + r2 * (c[1] + r2 * c[4]));
        const float bend = 2.0f * (c[0] + r2 * (2.0f * c[1] + 3.0f * c[4] * r2));
        at[0] = a * radial + 2.0f * c[2] * a * b + c[3] * (r2 + 2.0f * a * a);
        at[1] = b * radial + c[2] * (r2 + 2.0f * b * b) + 2.0f * c[3] * a * b;
        at[2] = radial + bend * a * a + 2.0f * c[2] * b + 6.0f * c[3] * a;
        at[3] = bend * a * b + 2.0f * c[2] * a + 2.0f * c[3] * b;
        at[4] = radial + bend * b * b + 6.0f * c[2] * b + 2.0f * c[3] * a;
    };
    // of a tangent far out
    auto turn = [](const float* c, float a, float b, float p, float q, float by, float* J) {
        // derivatives along (p, q) of those above
        const float r2 = a * a + b * b, more = 2.0f * (a * p + b * q);
        const float bend = 2.0f * (c[0] + r2 * (2.0f * c[1] + 3.0f * c[4] * r2));
        const float bent = 2.0f * (2.0f * c[1] + 6.0f * c[4] * r2) * more, both = 0.5f * bend
            * more;
        const float xx = both + bent * a * a + 2.0f * bend * a * p + 2.0f * c[2] * q + 6.0f * c[3]
            * p;
        const float xy = bent * a * b + bend * (p * b + a * q) + 2.0f * c[2] * p + 2.0f * c[3] * q;
        const float yy = both + bent * b * b + 2.0f * bend * b * q + 6.0f * c[2] * q + 2.0f * c[3]
            * p;
        const float to_x = by * (xy * p - xx * q), to_y = by * (yy * p - xy * q);
        J[0] -= to_x * q; J[1] += to_x * p; J[2] -= to_y * q; J[3] += to_y * p;
    };
"""

_PIXEL = f"""{_LENS}
    const bool lens = views.shape[1] > {NUMBERS};
    const float* k = views.data + flow * views.shape[1];
    const int width = distance.shape[1], plane = distance.shape[0] * width;
    const float x = (float)(pixel % width) + 0.5f, y = (float)(pixel / width) + 0.5f;
    float u = (x - k[2]) / k[0], v = (y - k[3]) / k[1], at[5] = {{0.0f, 0.0f, 1.0f, 0.0f, 1.0f}};
    if (lens) {{
        const float u_ = u, v_ = v;
        float missing = 1.0f;
        for (int n = 0; n < {STEPS} && missing > 1e-7f; ++n) {{
            image(k + {NUMBERS}, u, v, at);
            const float du = u_ - at[0], dv = v_ - at[1], area = at[2] * at[4] - at[3] * at[3];
            u += (du * at[4] - dv * at[3]) / area;
            v += (dv * at[2] - du * at[3]) / area;
            missing = fabsf(du) > fabsf(dv) ? fabsf(du) : fabsf(dv);
        }}
    }}
    const float seen = distance.data[pixel], d = (seen < {NEAREST}f ? {NEAREST}f : seen)
        / sqrtf(u * u + v * v + 1.0f);
    const float* D = displacement.data + 3 * flow * plane + pixel;
    const float* F = measured.data + ((long long)row * views.shape[0] + flow) * 2 * plane + pixel;
    const float dx = D[0], dy = D[plane], dz = D[2 * plane], fx = F[0], fy = F[plane];
    const float qx = d * (k[8] * u + k[9] * v + k[10]) + k[17]
        + (k[20] * dx + k[21] * dy + k[22] * dz);
    const float qy = d * (k[11] * u + k[12] * v + k[13]) + k[18]
        + (k[23] * dx + k[24] * dy + k[25] * dz);
    const float qz = d * (k[14] * u + k[15] * v + k[16]) + k[19]
        + (k[26] * dx + k[27] * dy + k[28] * dz);
    const float a = qx / qz, b = qy / qz, largest = 3.402823466e38f;
    const bool known = fabsf(fx) <= largest && fabsf(fy) <= largest;
    float a_ = a, b_ = b, J[4] = {{1.0f, 0.0f, 0.0f, 1.0f}};
    if (lens) {{
        const float* c = k + {NUMBERS} + 5;
        const float r = sqrtf(a * a + b * b), edge = r > c[5] ? c[5] / r : 1.0f;
        const float na = edge * a, nb = edge * b, da = a - na, db = b - nb;
        image(c, na, nb, at);
        a_ = at[0] + (at[2] * da + at[3] * db);
        b_ = at[1] + (at[3] * da + at[4] * db);
        J[0] = at[2]; J[1] = J[2] = at[3]; J[3] = at[4];
        if (edge < 1.0f) turn(c, na, nb, a / r, b / r, (r - c[5]) * edge, J);
    }}
    const float ex = known ? k[4] * a_ + (k[6] - x) - fx : 0.0f, ey = known ? k[5] * b_ + (k[7] - y)
        - fy : 0.0f;
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
        float bx = 2.0f * scale * ex * k[4] / qz, by = 2.0f * scale * ey * k[5] / qz;
        if (lens) {{
            const float cx = bx, cy = by;
            bx = cx * J[0] + cy * J[2];
            by = cx * J[1] + cy * J[3];
        }}
        const float bz = -(bx * a + by * b);
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
    views: wp.array2d[float],  # [F, 29] f, c, later f, c, M, m, R [px, 1, m]; [F, 40] lenses, too
    # Out:
    partials: wp.array2d[float],  # [1, P] partial sums of squared differences [px^2]
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
    gradient_of(
        distance, displacement, measured, row[0], views, factor * cotangent[0], flow, pixel, grad
    )
