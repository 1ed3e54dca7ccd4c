"""The list of rows that have a gradient, made on the device, so that kernels skip the others.

The list has each key's rows in ascending order, padded with ``NO_ROW`` to a multiple of ``TILE``.
Blocks of rows are counted, then each block writes its rows behind those before it: the order is
fixed, and launch sizes do not depend on the list. A NaN counts as a gradient; a row of zeros is not
read, even if an output of it is infinite.
"""

import warp as wp

from .wgmma import BLOCK, TILE  # as many threads as rows in a block

NO_ROW = -1

_HAS = """auto has = [&](int key, int low) {  // whether a row of a key is there, and has a gradient
        if (low >= count) return false;
        const float* const v = gradient.data + 3ll * ((long long)key * count + low);
        return !(v[0] == 0.0f && v[1] == 0.0f && v[2] == 0.0f);
    };"""


def capacity(keys: int, count: int) -> int:
    """Rows of a list at most."""
    return keys * -(-count // TILE) * TILE


@wp.func_native(f"""
    {_HAS}
    const int blocks = (count + {BLOCK - 1}) / {BLOCK}, key = block / blocks, first = block % blocks
        * {BLOCK};
#if defined(__CUDA_ARCH__)
    const int rows = __syncthreads_count(has(key, first + threadIdx.x));
    if (threadIdx.x == 0) counts.data[block] = rows;
#else
    int rows = 0;
    for (int n = 0; n < {BLOCK}; ++n) rows += has(key, first + n);
    counts.data[block] = rows;
#endif
""")
def count_block(gradient: wp.array2d[float], count: int, block: int, counts: wp.array[wp.int32]):
    """Rows of a block that have a gradient."""


@wp.func_native(f"""
    {_HAS}
    auto whole = [](int rows) {{ return (rows + {TILE - 1}) / {TILE} * {TILE}; }};
    const int blocks = (count + {BLOCK - 1}) / {BLOCK}, key = block / blocks, own = block % blocks;
    int begin = 0, before = 0;  // where the key begins, how many of its rows are in blocks before
#if defined(__CUDA_ARCH__)
    __shared__ int of_warps[{BLOCK // 32}];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    auto over_block = [&](int value) {{  // for all threads
        #pragma unroll
        for (int over = 16; over > 0; over /= 2) value += __shfl_xor_sync(0xffffffffu, value, over);
        __syncthreads();  // no thread reads the previous content any more
        if (lane == 0) of_warps[warp] = value;
        __syncthreads();
        int sum = 0;
        for (int n = 0; n < {BLOCK // 32}; ++n) sum += of_warps[n];
        return sum;
    }};
    for (int other = 0; other <= key; ++other) {{
        int sum = 0;
        for (int n = threadIdx.x; n < (other < key ? blocks : own); n += {BLOCK})
            sum += counts.data[other * blocks + n];
        sum = over_block(sum);
        if (other < key) begin += whole(sum);
        else before = sum;
    }}
    const int low = own * {BLOCK} + (int)threadIdx.x;
    const bool listed_ = has(key, low);
    const unsigned others = __ballot_sync(0xffffffffu, listed_);
    over_block(lane == 0 ? __popc(others) : 0);
    int position = begin + before + __popc(others & ((1u << lane) - 1u));
    for (int n = 0; n < warp; ++n) position += of_warps[n];
    if (listed_) listed.data[position] = key * count + low;
    const bool writes_ends = own == blocks - 1;
    const int thread = threadIdx.x, threads = {BLOCK};
#else
    for (int other = 0; other <= key; ++other) {{
        int sum = 0;
        for (int n = 0; n < (other < key ? blocks : own); ++n) sum +=
            counts.data[other * blocks + n];
        if (other < key) begin += whole(sum);
        else before = sum;
    }}
    int position = begin + before;
    for (int n = own * {BLOCK}; n < (own + 1) * {BLOCK}; ++n)
        if (has(key, n)) listed.data[position++] = key * count + n;
    const bool writes_ends = own == blocks - 1;
    const int thread = 0, threads = 1;
#endif
    if (!writes_ends) return;
    const int rows = before + counts.data[block];
    for (int n = rows + thread; n < whole(rows); n += threads) listed.data[begin + n] = {NO_ROW};
    if (thread > 0) return;
    if (key == 0) begins.data[0] = 0;
    begins.data[key + 1] = begin + whole(rows);
""")
def list_block(
    gradient: wp.array2d[float],
    counts: wp.array[wp.int32],
    count: int,
    block: int,
    listed: wp.array[wp.int32],
    begins: wp.array[wp.int32],
):
    """Write a block's rows that have a gradient in order, then ``NO_ROW`` as padding of a key."""


@wp.kernel(enable_backward=False, grid_stride=False)
def count_rows(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    gradient: wp.array2d[float],  # [k N, 3] of offsets
    count: int,  # N [1]
    # Out:
    counts: wp.array[wp.int32],  # [k blocks] rows with a gradient in ``BLOCK`` rows of a key
):
    """One block of threads for ``BLOCK`` rows of a key."""
    count_block(gradient, count, wp.tid() // threads, counts)


@wp.kernel(enable_backward=False, grid_stride=False)
def list_rows(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    gradient: wp.array2d[float],  # [k N, 3] of offsets
    counts: wp.array[wp.int32],  # [k blocks] of ``count_rows``
    count: int,  # N [1]
    # Out:
    listed: wp.array[wp.int32],  # [``capacity``] rows with a gradient, each key in whole tiles
    begins: wp.array[wp.int32],  # [k + 1] where the part of each key begins, and the end
):
    """One block of threads for ``BLOCK`` rows of a key."""
    list_block(gradient, counts, count, wp.tid() // threads, listed, begins)
