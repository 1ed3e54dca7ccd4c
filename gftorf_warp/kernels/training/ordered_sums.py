"""Sums in a fixed order, the same to the bit however threads are scheduled.

Kernels write a partial sum per warp, on the CPU per thread; ``means`` adds them, a block per row.
"""

import warp as wp

LANES = 32  # threads of a CUDA warp
THREADS = 256  # of the block that adds up a row

OVER_LANES = """
#if defined(__CUDA_ARCH__)
    auto over_lanes = [](float v) -> float {
        for (int o = 16; o > 0; o >>= 1) v += __shfl_down_sync(0xffffffffu, v, o);
        return v;
    };
    const int slot = thread / 32;
    const bool writes = (thread & 31) == 0;
#else
    auto over_lanes = [](float v) -> float { return v; };
    const int slot = thread;
    const bool writes = true;
#endif
"""
"""C++: the sum of a value over the lanes of a warp, which lane 0 gets, and where it goes. Every
lane must take part."""

_ROW = f"""
    const float* in = partials.data + row * partials.shape[1];
    const int count = partials.shape[1];
#if defined(__CUDA_ARCH__)
    __shared__ double of_warps[{THREADS // LANES}];
    double s = 0.0;
    for (int i = threadIdx.x; i < count; i += {THREADS}) s += (double)in[i];
    for (int o = 16; o > 0; o >>= 1) s += __shfl_down_sync(0xffffffffu, s, o);
    if ((threadIdx.x & 31) == 0) of_warps[threadIdx.x / 32] = s;
    __syncthreads();
    if (threadIdx.x == 0) {{
        double total = 0.0;
        for (int k = 0; k < {THREADS // LANES}; ++k) total += of_warps[k];
        out.data[row] = (float)(total * (double)scale);
    }}
#else
    double total = 0.0;
    for (int i = 0; i < count; ++i) total += (double)in[i];
    out.data[row] = (float)(total * (double)scale);
#endif
"""


@wp.func_native(_ROW)
def mean_of_row(partials: wp.array2d[float], row: int, scale: float, out: wp.array[float]):
    """Add up one row."""


@wp.kernel(enable_backward=False, grid_stride=False)
def means(
    # In:
    partials: wp.array2d[float],  # [M, P] sums over parts [1]
    threads: int,  # of a row: THREADS on CUDA, 1 on the CPU [1]
    scale: float,  # one over the number of values [1]
    # Out:
    out: wp.array[float],  # [M or more] first M filled
):
    """One block per row."""
    mean_of_row(partials, wp.tid() // threads, scale, out)


@wp.kernel(enable_backward=False)
def add_up(
    # In:
    one: wp.array[float],  # [L] four arrays, of which the first ``count`` are read
    two: wp.array[float],  # [L]
    three: wp.array[float],  # [L]
    four: wp.array[float],  # [L]
    count: int,  # 1 to 4 [1]
    # Out:
    total: wp.array[float],  # [L] their sum, in their order
):
    """A thread per element."""
    i = wp.tid()
    value = one[i]
    if count > 1:
        value += two[i]
    if count > 2:
        value += three[i]
    if count > 3:
        value += four[i]
    total[i] = value
