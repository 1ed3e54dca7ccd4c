"""The gradient in front of a ReLU, in place, and its sums over rows, in one pass: d = 0 where h <= 0, s = sum of d.

A part of the rows belongs to a block of threads. A thread owns 16 bytes of a row and every so manieth row of the part,
loads several rows before it needs the first, and sums in float32; the block adds up its threads in shared memory, in a
fixed order. On the CPU one thread does a part.
"""

import functools

import warp as wp

THREADS = 256  # of a block
BYTES = 16  # of a row that one thread loads at once
AHEAD = 8  # rows that a thread loads before it needs the first

# Two halves at once: all bits of a half are set where it is above 0 or no number
_MASK_HALF = """
        unsigned int alive;
        asm("set.gtu.u32.f16x2 %0, %1, %2;" : "=r"(alive) : "r"(h), "r"(0u));
        const unsigned int kept = d & alive;
        float low, high;
        asm("{ .reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b; }"
            : "=f"(low), "=f"(high) : "r"(kept));
        sums[2 * word] += low;
        sums[2 * word + 1] += high;
"""
_MASK_FLOAT = """
        const unsigned int kept = __uint_as_float(h) <= 0.0f ? 0u : d;
        sums[word] += __uint_as_float(kept);
"""


def _part(values: int, mask: str) -> str:
    """C++ of one part, for ``values`` in 16 bytes; ``mask`` makes ``kept`` of the words ``d`` and ``h``."""
    return f"""
    const int width = slope.shape[1], count = slope.shape[0], parts = out.shape[0];
    const int each = (count + parts - 1) / parts, first = part * each;
    const int end = first + each < count ? first + each : count;
    float* const to = out.data + (size_t)part * width;
#if defined(__CUDA_ARCH__)
    __shared__ float room[{THREADS * values}];
    const int thread = threadIdx.x, groups = width / {values}, lanes = {THREADS} / groups;
    const int lane = thread / groups, group = thread % groups;
    auto masked = [](float* sums, int word, unsigned int d, unsigned int h) -> unsigned int {{
        {mask}
        return kept;
    }};
    if (lane < lanes) {{
        float sums[{values}] = {{}};
        uint4* const slopes = reinterpret_cast<uint4*>(slope.data) + group;
        const uint4* const values = reinterpret_cast<const uint4*>(before.data) + group;
        for (int row = first + lane; row < end; row += {AHEAD} * lanes) {{
            uint4 d[{AHEAD}], h[{AHEAD}];
            #pragma unroll
            for (int n = 0; n < {AHEAD}; ++n) {{
                const size_t at = (size_t)(row + n * lanes) * groups;
                const bool exists = row + n * lanes < end;
                d[n] = exists ? slopes[at] : make_uint4(0u, 0u, 0u, 0u);
                h[n] = exists ? __ldg(values + at) : make_uint4(0u, 0u, 0u, 0u);
            }}
            #pragma unroll
            for (int n = 0; n < {AHEAD}; ++n) {{
                d[n].x = masked(sums, 0, d[n].x, h[n].x);
                d[n].y = masked(sums, 1, d[n].y, h[n].y);
                d[n].z = masked(sums, 2, d[n].z, h[n].z);
                d[n].w = masked(sums, 3, d[n].w, h[n].w);
                if (row + n * lanes < end) slopes[(size_t)(row + n * lanes) * groups] = d[n];
            }}
        }}
        #pragma unroll
        for (int k = 0; k < {values}; ++k) room[lane * width + group * {values} + k] = sums[k];
    }}
    __syncthreads();
    for (int column = thread; column < width; column += {THREADS}) {{
        float sum = 0.0f;
        for (int n = 0; n < lanes; ++n) sum += room[n * width + column];
        to[column] = sum;
    }}
#else
    for (int column = 0; column < width; ++column) to[column] = 0.0f;
    for (int row = first; row < end; ++row) {{
        auto* const slopes = slope.data + (size_t)row * width;
        const auto* const values = before.data + (size_t)row * width;
        for (int column = 0; column < width; ++column) {{
            if ((float)values[column] <= 0.0f) slopes[column] = 0.0f;
            to[column] += (float)slopes[column];
        }}
    }}
#endif
"""


@functools.cache
def make_mask(dtype: type):
    """The kernel for rows of ``wp.float16`` or ``wp.float32``: whole 16 bytes, at most THREADS times that."""
    half = dtype is wp.float16

    @wp.func_native(_part(BYTES // (2 if half else 4), _MASK_HALF if half else _MASK_FLOAT))
    def mask_part(slope: wp.array2d[dtype], before: wp.array2d[dtype], part: int, out: wp.array2d[float]): ...

    @wp.kernel(enable_backward=False, grid_stride=False, module="unique")
    def mask_and_sum(
        # In:
        before: wp.array2d[dtype],  # [rows, width] h, what the ReLU left; no gap between rows, here and below [1]
        threads: int,  # of a part: THREADS on CUDA, 1 on the CPU [1]
        # Out:
        slope: wp.array2d[dtype],  # [rows, width] d, gradient behind the ReLU, and then in front of it
        out: wp.array2d[float],  # [parts, width] sums of d over the rows of a part; of a part without rows zero
    ):
        """One block of threads per part."""
        mask_part(slope, before, wp.tid() // threads, out)

    return mask_and_sum
