"""The record of a projected Gaussian, its memory access, and its gradient.

Sixteen floats, one 64-byte line, the same slots for values and for gradients:

    0 x   1 y        image position of the centre [px]
    2 P   3 Q   4 R  power = P dx^2 + Q dx dy + R dy^2, the logarithm of the Gaussian; minus half
                     the conic [1/px^2]
    5 opacity        at the peak [1]
    6 low            -ln(255 opacity): where the power is below it, alpha < 1/255; of a gradient:
                     pixels reached
    7 limit          the power at the middle of a block is below it: the splat misses the block; of
                     a gradient: weights w, summed over pixels
    8 9 10           three channels weighed by T, for example colour
    11 12 13         a cos psi, a sin psi, a: what quads and phasor are made of, weighed by T^2
    14 distance      along the ray [m]
    15               free

Of a sloped splat (splat_distance.py), in which every pixel has a distance of its own:

    11 strength      s r, what the amplitude is times distance^2
    12 gx   13 gy    change of the inverse distance along x and y [1/(m px)]
    14 nearness      inverse distance at the centre [1/m]
    15 bound         how far a pixel's inverse distance may be from it [1/m]; of a gradient: the
                     moment of order 0 of the derivatives by a pixel's inverse distance
"""

import warp as wp

Splat = wp.types.vector(length=16, dtype=wp.float32)
CHANNEL = wp.constant(8)  # first slot of the T-weighted channels
# records that a CPU thread prefetches: they are scattered in memory, and cache misses cost a tenth
AHEAD = wp.constant(4)

_LOAD = """
// component-wise reads would be sixteen; a record is aligned, so four of 16 bytes do
#if defined(__CUDA_ARCH__)
    const float4* line = reinterpret_cast<const float4*>(splats.data + i);
    wp::vec_t<16, float> record;
    for (int part = 0; part < 4; ++part) {
        const float4 four = __ldg(line + part);
        record[4 * part] = four.x; record[4 * part + 1] = four.y;
        record[4 * part + 2] = four.z; record[4 * part + 3] = four.w;
    }
    return record;
#else
    return splats.data[i];
#endif
"""

# a warp owns all pixels of a tile, for which the test would hardly ever hold
_BLOCK_MISSED = """
#if defined(__CUDA_ARCH__)
    return false;
#else
    const float* q = &splats.data[i].c[0];
    const float dx = q[0] - x, dy = q[1] - y;
    return (q[2] * dx + q[3] * dy) * dx + q[4] * dy * dy < q[7];
#endif
"""


@wp.func_native(_LOAD)
def load_splat(splats: wp.array[Splat], i: int) -> Splat:
    """Record ``i``, in four loads."""


@wp.func_native(_BLOCK_MISSED)
def block_missed(splats: wp.array[Splat], i: int, x: float, y: float) -> bool:
    """Whether splat ``i`` surely misses the block of 4 x 4 pixels around (x, y) [px]."""


@wp.func_native("__builtin_prefetch(splats.data + i, 0, 3);")
def prefetch(splats: wp.array[Splat], i: int):
    """Prefetch record ``i``; on a CPU."""


@wp.kernel(enable_backward=False)
def set_channels(
    # In:
    source: wp.array[Splat],  # [N] records of the main pass
    values: wp.array2d[float],  # [N, D] extra channels
    start: int,  # first of the three channels to take [index]
    # Out:
    target: wp.array[Splat],  # [N] the same records with slots 8-10 replaced; may be ``source``
):
    """One thread per Gaussian; channels past D are zero."""
    n = wp.tid()
    record = source[n]
    for c in range(3):
        value = float(0.0)
        if start + c < values.shape[1]:
            value = values[n, start + c]
        record[CHANNEL + c] = value
    target[n] = record


@wp.kernel(enable_backward=False)
def take_channels(
    # In:
    grad_splats: wp.array[Splat],  # [N] gradient records whose slots 8-10 belong to extra channels
    start: int,  # first of the three channels [index]
    # Out:
    grad_values: wp.array2d[float],  # [N, D] added to
):
    """Adjoint of :func:`set_channels`; one thread per Gaussian."""
    n = wp.tid()
    for c in range(3):
        if start + c < grad_values.shape[1]:
            grad_values[n, start + c] = grad_values[n, start + c] + grad_splats[n][CHANNEL + c]


@wp.kernel(enable_backward=False)
def add_records(
    # In:
    part: wp.array[Splat],  # [N] gradient records of one CPU thread or one pass
    geometry_only: int,  # 1: only slots 0-5, which further passes share [flag]
    # Out:
    total: wp.array[Splat],  # [N] added to
):
    """One thread per Gaussian."""
    n = wp.tid()
    if geometry_only == 1:
        record = total[n]
        other = part[n]
        for slot in range(6):
            record[slot] = record[slot] + other[slot]
        total[n] = record
    else:
        total[n] = total[n] + part[n]
