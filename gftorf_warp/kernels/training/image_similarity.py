"""Loss of an image and its gradient by the rendered one, with a separable similarity window.

With means over a window W of 11 x 11 pixels, zeros beyond the border, of rendered r and measured m

    mu = W r, nu = W m,   a = W r^2,   b = W m^2,   c = W r m
    S  = (2 mu nu + C1) (2 (c - mu nu) + C2) / ((mu^2 + nu^2 + C1) (a - mu^2 + b - nu^2 + C2))
    L  = (1 - s) |r - m|^p + s (1 - S),   p = 1 or 2

the derivative needs three planes of dS: W is symmetric, so

    dL/dr = (1 - s) d|r - m|^p - s (W dS/dmu + 2 r W dS/da + m W dS/dc)

(method, section 5). Columns first: blocks of K pixels of a row need borders above and below only.
Planes in between have margins of zeros at both ends of a row.
"""

import math
from types import SimpleNamespace

import warp as wp

from ...constants import STABILISE_MEAN, STABILISE_SPREAD, WINDOW, WINDOW_SIGMA
from .. import making
from ..rasterise.simd import contracted
from .ordered_sums import OVER_LANES

REACH = WINDOW // 2  # [px] margin of the planes in between, left and right
MOMENTS = 5  # planes of window means: r, m, r^2, m^2, r m
SLOPES = 3  # planes of derivatives of S: by the means of r, r^2 and r m
SUMS = 3  # that come out: loss, squared difference, another image


def _prelude(K: int) -> str:
    """C++ of the block type ``F``, of ``at`` and ``put``, its memory access, and of the weights."""
    weights = [math.exp(-0.5 * (k / WINDOW_SIGMA) ** 2) for k in range(-REACH, REACH + 1)]
    taps = ", ".join(f"{weight / sum(weights):.9e}f" for weight in weights)
    kind = "typedef float F;"
    at, put = "return *p;", "*p = v;"
    if K > 1:
        kind = f"typedef float F __attribute__((ext_vector_type({K})));"
        at, put = (
            "F v; __builtin_memcpy(&v, p, sizeof(v)); return v;",
            "__builtin_memcpy(p, &v, sizeof(v));",
        )
    return f"""
    {kind}
    auto at = [](const float* p) -> F {{ {at} }};
    auto put = [](float* p, F v) {{ {put} }};
    constexpr float taps[{WINDOW}] = {{{taps}}};
"""


def _sums(count: int, value: str) -> str:
    """C++ that defines ``count`` vectors ``s0``, ``s1``, .. of the same initial value."""
    return f"F {', '.join(f's{n} = {value}' for n in range(count))};"


def _columns_of_products(K: int) -> str:
    """C++: windows along columns of r, m and their products."""
    return f"""{_prelude(K)}
    const int height = rendered.shape[1], width = rendered.shape[2], stride = width + {2 * REACH};
    const float* r_ = rendered.data + (c * height + y) * width + x;
    const float* m_ = measured.data + ((row * rendered.shape[0] + c) * height + y) * width + x;
    {_sums(MOMENTS, "(F)(0.0f)")}
    #pragma unroll
    for (int k = -{REACH}; k <= {REACH}; ++k) {{
        if (y + k < 0 || y + k >= height) continue;
        const float w = taps[k + {REACH}];
        const F r = at(r_ + k * width), m = at(m_ + k * width), wr = w * r, wm = w * m;
        s0 += wr; s1 += wm; s2 += wr * r; s3 += wm * m; s4 += wr * m;
    }}
    const int plane = rendered.shape[0] * height * stride;
    float* out = columns.data + (c * height + y) * stride + x + {REACH};
    put(out, s0); put(out + plane, s1); put(out + 2 * plane, s2); put(out + 3 * plane, s3);
    put(out + 4 * plane, s4);
"""


def _rows(count: int, source: str) -> str:
    """C++: windows along rows of ``count`` planes, which end up in ``s0``, ``s1``, .."""
    terms = " ".join(f"s{n} += w * at(in + {n} * plane + k);" for n in range(count))
    return f"""
    const int height = rendered.shape[1], width = rendered.shape[2], stride = width + {2 * REACH};
    const int plane = rendered.shape[0] * height * stride, pixel = (c * height + y) * width + x;
    const float* in = {source}.data + (c * height + y) * stride + x;
    const F r = at(rendered.data + pixel);
    const F m = at(measured.data + row * rendered.shape[0] * height * width + pixel), d = r - m;
    {_sums(count, "(F)(0.0f)")}
    #pragma unroll
    for (int k = 0; k < {WINDOW}; ++k) {{ const float w = taps[k]; {terms} }}
"""


def _compare(K: int) -> str:
    """C++: sums of loss, squared difference and another image; derivatives of S by the means."""
    each = "" if K == 1 else "[n]"
    return f"""{_prelude(K)}
    const int across = (rendered.shape[2] + {K - 1}) / {K}, block = thread % across, line = thread
        / across;
    const int y = line % rendered.shape[1], c = line / rendered.shape[1], end = rendered.shape[2]
        - {K};
    const int x = block * {K} < end ? block * {K} : end, again = block * {K} - x;
    float loss = 0.0f, square = 0.0f, other = 0.0f;
    if (c < rendered.shape[0]) {{{_rows(MOMENTS, "columns")}
        const F cross = s0 * s1, own = s0 * s0 + s1 * s1;
        const F means = 2.0f * cross + {STABILISE_MEAN}f, spreads = 2.0f * (s4 - cross)
            + {STABILISE_SPREAD}f;
        const F mean_scale = 1.0f / (own + {STABILISE_MEAN}f);
        const F spread_scale = 1.0f / (s2 + s3 - own + {STABILISE_SPREAD}f);
        const F luminance = means * mean_scale, structure = spreads * spread_scale, similarity =
            luminance * structure;
        const F by_mean = 2.0f * (s1 * mean_scale * structure - s1 * luminance * spread_scale
                                  - s0 * similarity * mean_scale + s0 * similarity * spread_scale);
        const F squared = d * d, difference = absolute ? (d < 0.0f ? -d : d) : squared;
        const F map = (1.0f - share) * difference + share * (1.0f - similarity);
        float* out = slopes.data + (c * height + y) * stride + x + {REACH};
        put(out, by_mean); put(out + plane, -similarity * spread_scale);
        put(out + 2 * plane, 2.0f * luminance * spread_scale);
        for (int n = again; n < {K}; ++n) {{ loss += map{each}; square += squared{each}; }}
        if (pixel + {K} <= also.shape[0]) for (int n = again; n < {K}; ++n) other +=
            also.data[pixel + n];
    }}{OVER_LANES}
    loss = over_lanes(loss); square = over_lanes(square); other = over_lanes(other);
    if (writes) {{
        const int parts = partials.shape[1];
        partials.data[slot] = loss; partials.data[parts + slot] = square;
        partials.data[2 * parts + slot] = other;
    }}
"""


def _columns_of_slopes(K: int) -> str:
    """C++: windows along columns of the derivatives."""
    return f"""{_prelude(K)}
    const int height = slopes.shape[2], stride = slopes.shape[3], plane = slopes.shape[1] * height
        * stride;
    const int at_ = (c * height + y) * stride + x + {REACH};
    {_sums(SLOPES, "(F)(0.0f)")}
    #pragma unroll
    for (int k = -{REACH}; k <= {REACH}; ++k) {{
        if (y + k < 0 || y + k >= height) continue;
        const float w = taps[k + {REACH}];
        const float* in = slopes.data + at_ + k * stride;
        s0 += w * at(in); s1 += w * at(in + plane); s2 += w * at(in + 2 * plane);
    }}
    float* out = columns.data + at_;
    put(out, s0); put(out + plane, s1); put(out + 2 * plane, s2);
"""


def _gradient(K: int) -> str:
    """C++: windows along rows, and everything that depends on the rendered image."""
    return f"""{_prelude(K)}{_rows(SLOPES, "columns")}
    const F sign = d > 0.0f ? (F)(1.0f) : (d < 0.0f ? (F)(-1.0f) : (F)(0.0f));
    const F own = absolute ? sign : 2.0f * d;
    put(grad.data + pixel, scale * ((1.0f - share) * own - share * (s0 + 2.0f * r * s1 + m * s2)));
"""


@making.once
def make_similarity(K: int) -> SimpleNamespace:
    """Four kernels for blocks of K pixels of a row; a last block begins earlier to fit."""
    options = {"enable_backward": False, "module": "unique", "grid_stride": False}
    options |= {"module_options": contracted() if K > 1 else {}}

    @wp.func_native(_columns_of_products(K))
    def products_of(
        rendered: wp.array3d[float],
        measured: wp.array3d[float],
        row: int,
        c: int,
        y: int,
        x: int,
        columns: wp.array4d[float],
    ): ...
    @wp.func_native(_compare(K))
    def compare(
        columns: wp.array4d[float],
        rendered: wp.array3d[float],
        measured: wp.array3d[float],
        row: int,
        also: wp.array[float],
        share: float,
        absolute: bool,
        thread: int,
        partials: wp.array2d[float],
        slopes: wp.array4d[float],
    ): ...
    @wp.func_native(_columns_of_slopes(K))
    def slopes_of(
        slopes: wp.array4d[float], c: int, y: int, x: int, columns: wp.array4d[float]
    ): ...
    @wp.func_native(_gradient(K))
    def gradient_of(
        columns: wp.array4d[float],
        rendered: wp.array3d[float],
        measured: wp.array3d[float],
        row: int,
        share: float,
        absolute: bool,
        scale: float,
        c: int,
        y: int,
        x: int,
        grad: wp.array3d[float],
    ): ...

    @wp.func
    def begin(block: int, width: int) -> int:
        """First column of a block."""
        return wp.min(block * wp.static(K), width - wp.static(K))

    @wp.kernel(**options)
    def columns_of_products(
        # In:
        rendered: wp.array3d[float],  # [C, H, W]
        measured: wp.array3d[float],  # [R C, H, W]
        row: wp.array[int],  # [1] which C of ``measured`` [index]
        # Out:
        columns: wp.array4d[float],  # [5, C, H, W + 10] sums along columns: r, m, r^2, m^2, r m
    ):
        """One thread per block of K pixels."""
        c, y, block = wp.tid()
        products_of(rendered, measured, row[0], c, y, begin(block, rendered.shape[2]), columns)

    @wp.kernel(**options)
    def compare_images(
        # In:
        columns: wp.array4d[float],  # [5, C, H, W + 10] from ``columns_of_products``, margins zero
        rendered: wp.array3d[float],  # [C, H, W]
        measured: wp.array3d[float],  # [R C, H, W]
        row: wp.array[int],  # [1] which C of ``measured`` [index]
        also: wp.array[float],  # [H W] another image that is summed up, or nothing
        share: float,  # of the similarity, 0..1 [1]
        absolute: bool,  # whether p is 1 [flag]
        # Out:
        partials: wp.array2d[float],  # [3, P] partial sums: loss, squared difference, other image
        slopes: wp.array4d[float],  # [3, C, H, W + 10] derivatives of S by the means of r, r^2, r m
    ):
        """One thread per block of K pixels; on CUDA as many as fill the last warp."""
        compare(
            columns, rendered, measured, row[0], also, share, absolute, wp.tid(), partials, slopes
        )

    @wp.kernel(**options)
    def columns_of_slopes(
        # In:
        slopes: wp.array4d[float],  # [3, C, H, W + 10] from ``compare_images``
        # Out:
        columns: wp.array4d[float],  # [3, C, H, W + 10] their window sums along columns
    ):
        """One thread per block of K pixels."""
        c, y, block = wp.tid()
        slopes_of(slopes, c, y, begin(block, slopes.shape[3] - wp.static(2 * REACH)), columns)

    @wp.kernel(**options)
    def gradient_of_image(
        # In:
        columns: wp.array4d[float],  # [3, C, H, W + 10] from ``columns_of_slopes``, margins zero
        rendered: wp.array3d[float],  # [C, H, W]
        measured: wp.array3d[float],  # [R C, H, W]
        row: wp.array[int],  # [1] which C of ``measured`` [index]
        share: float,  # of the similarity, 0..1 [1]
        absolute: bool,  # whether p is 1 [flag]
        factor: float,  # multiplies everything, for example one over the number of values [1]
        cotangent: wp.array[float],  # [1] of the loss; multiplies everything, too
        # Out:
        grad: wp.array3d[float],  # [C, H, W] by the rendered image
    ):
        """One thread per block of K pixels."""
        c, y, block = wp.tid()
        scale = factor * cotangent[0]
        x = begin(block, rendered.shape[2])
        gradient_of(columns, rendered, measured, row[0], share, absolute, scale, c, y, x, grad)

    return SimpleNamespace(
        K=K,
        columns_of_products=columns_of_products,
        compare_images=compare_images,
        columns_of_slopes=columns_of_slopes,
        gradient_of_image=gradient_of_image,
    )
