"""Loss scaling before the backward pass: gradients of offsets become halves; and reductions.

One partial result per warp, on the CPU per row, is added up in a fixed order by the next kernel.
"""

import warp as wp

from .wgmma import WIDTH

COLUMNS = 32  # that one block of threads adds up
BLOCK = 256  # threads
SLICES = BLOCK // COLUMNS


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float* const v = gradient.data + 3ll * (row < count ? row : 0);
    float4 own = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    if (row < count) own = make_float4(v[0], v[1], v[2],
        fmaxf(fabsf(v[0]), fmaxf(fabsf(v[1]), fabsf(v[2]))));
    #pragma unroll
    for (int over = 16; over > 0; over /= 2) {
        own.x += __shfl_xor_sync(0xffffffffu, own.x, over);
        own.y += __shfl_xor_sync(0xffffffffu, own.y, over);
        own.z += __shfl_xor_sync(0xffffffffu, own.z, over);
        own.w = fmaxf(own.w, __shfl_xor_sync(0xffffffffu, own.w, over));
    }
    if ((threadIdx.x & 31) == 0) reinterpret_cast<float4*>(partials.data)[row >> 5] = own;
#else
    float* const to = partials.data + 4ll * row;
    to[3] = 0.0f;
    for (int i = 0; i < 3; ++i) {
        to[i] = gradient.data[3ll * row + i];
        to[3] = wp::max(to[3], wp::abs(to[i]));
    }
#endif
""")
def reduce_warp(gradient: wp.array2d[float], count: int, row: int, partials: wp.array2d[float]):
    """Sums over the rows of this warp, and the largest magnitude."""


@wp.kernel(enable_backward=False, grid_stride=False)
def measure_rows(
    # In:
    gradient: wp.array2d[float],  # [rows, 3] of offsets
    # Out:
    partials: wp.array2d[float],  # [warps, 4] sums over rows of a warp, and their largest magnitude
):
    """One thread per row, a whole number of warps."""
    reduce_warp(gradient, gradient.shape[0], wp.tid(), partials)


@wp.func_native("""
    const int parts = partials.shape[0];
    const float* const from = partials.data;
    float sums[4] = {};
#if defined(__CUDA_ARCH__)
    __shared__ float shared[8][4];
    for (int n = threadIdx.x; n < parts; n += 256) {
        const float4 one = reinterpret_cast<const float4*>(from)[n];
        sums[0] += one.x; sums[1] += one.y; sums[2] += one.z; sums[3] = fmaxf(sums[3], one.w);
    }
    #pragma unroll
    for (int over = 16; over > 0; over /= 2)
        for (int i = 0; i < 4; ++i) {
            const float other = __shfl_xor_sync(0xffffffffu, sums[i], over);
            sums[i] = i < 3 ? sums[i] + other : fmaxf(sums[i], other);
        }
    if ((threadIdx.x & 31) == 0) for (int i = 0; i < 4; ++i) shared[threadIdx.x >> 5][i] = sums[i];
    __syncthreads();
    for (int i = 0; i < 4; ++i) {
        sums[i] = shared[0][i];
        for (int warp = 1; warp < 8; ++warp)
            sums[i] = i < 3 ? sums[i] + shared[warp][i] : fmaxf(sums[i], shared[warp][i]);
    }
    const bool first = blockIdx.x == 0 && threadIdx.x == 0;
#else
    for (int n = 0; n < parts; ++n) {
        for (int i = 0; i < 3; ++i) sums[i] += from[4 * n + i];
        sums[3] = wp::max(sums[3], from[4 * n + 3]);
    }
    const bool first = row == 0;
#endif
    const float one = wp::max(sums[3], smallest) / largest;
    if (first) {
        unit.data[0] = one;
        for (int i = 0; i < 3; ++i) total.data[i] = sums[i];
    }
    if (row < gradient.shape[0])
        for (int i = 0; i < 8; ++i)
            after.data[8ll * row + i] = wp::float_to_half(i < 3 ? gradient.data[3ll * row + i] / one
                : 0.0f);
""")
def scale_row(
    gradient: wp.array2d[float],
    partials: wp.array2d[float],
    smallest: float,
    largest: float,
    row: int,
    after: wp.array2d[wp.float16],
    unit: wp.array[float],
    total: wp.array[float],
):
    """One row; every block of threads computes the unit."""


@wp.kernel(enable_backward=False, grid_stride=False)
def scale_rows(
    # In:
    gradient: wp.array2d[float],  # [rows, 3] of offsets
    partials: wp.array2d[float],  # [warps, 4] of ``measure_rows``
    smallest: float,  # what the largest magnitude is at least [1]
    largest: float,  # what it becomes [1]
    # Out:
    after: wp.array2d[wp.float16],  # [rows, 8] gradients over ``unit``, zeros behind them
    unit: wp.array[float],  # [1] the largest magnitude over ``largest``
    total: wp.array[float],  # [3] sum over rows, not scaled
):
    """One thread per row; whole blocks, at least one."""
    scale_row(gradient, partials, smallest, largest, wp.tid(), after, unit, total)


@wp.func_native(f"""
    const int parts = partials.shape[2], of = block / {WIDTH // COLUMNS};
#if defined(__CUDA_ARCH__)
    __shared__ float shared[{SLICES}][{COLUMNS}];
    const int slice = threadIdx.x / {COLUMNS}, lane = threadIdx.x % {COLUMNS};
    const int column = block % {WIDTH // COLUMNS} * {COLUMNS} + lane;
    const float* from = partials.data + (size_t)of * parts * {WIDTH} + column;
    float sum = 0.0f;
    #pragma unroll 8
    for (int n = slice; n < parts; n += {SLICES}) sum += from[(size_t)n * {WIDTH}];
    shared[slice][lane] = sum;
    __syncthreads();
    if (slice > 0) return;
    for (int other = 1; other < {SLICES}; ++other) sum += shared[other][lane];
    sums.data[of * {WIDTH} + column] = sum;
#else
    for (int n = 0; n < {COLUMNS}; ++n) {{
        const int column = block % {WIDTH // COLUMNS} * {COLUMNS} + n;
        float sum = 0.0f;
        for (int part = 0; part < parts; ++part) sum +=
            partials.data[((size_t)of * parts + part) * {WIDTH} + column];
        sums.data[of * {WIDTH} + column] = sum;
    }}
#endif
""")
def add_columns(partials: wp.array4d[float], block: int, sums: wp.array3d[float]):
    """32 columns of one layer and key."""


@wp.kernel(enable_backward=False, grid_stride=False)
def add_partials(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    partials: wp.array4d[float],  # [layers, k, parts, WIDTH]
    # Out:
    sums: wp.array3d[float],  # [layers, k, WIDTH]
):
    """One block for 32 columns of a layer and key."""
    add_columns(partials, wp.tid() // threads, sums)
