"""Parameter gradients over listed rows: the head's weight, and all of them from partial sums.

The head has three outputs: a lane has eight of 256 inputs times three outputs in registers.
``collect`` adds parts of all weights in their order, takes biases and weights of gamma(t) from sums
over rows, and removes the scale: a thread per parameter, ordered as in ``perceptron.Layers``.
"""

import warp as wp

from .gradient_rows import NO_ROW
from .perceptron import Layers, inputs_of, weight_of
from .weight_gradients import HALF, HALVES
from .wgmma import BLOCK, COLUMNS, HEAD, TILE, VALUES, WIDTH

WARPS = BLOCK // 32
HEAD_BLOCKS = 2  # that a multiprocessor holds at once, with 128 registers a thread


@wp.func_native(f"""
    const int tiles = begins.data[keys] / {TILE};
    const int begin = (int)((long long)tiles * part / parts), end =
        (int)((long long)tiles * (part + 1) / parts);
    const wp::half* const last = outputs.data + (size_t)(layers - 1) * rows * {WIDTH};
    float* const to = partials.data + (size_t)part * {VALUES * WIDTH};
#if defined(__CUDA_ARCH__)
    __shared__ float of_warps[{WARPS}][{VALUES * WIDTH}];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    // a warp has eight rows of a tile, which follow each other; a lane knows one
    auto rows_of = [&](int tile) {{
        return tile < end ? __ldg(listed.data + tile * {TILE} + 8 * warp + (lane & 7)) : {NO_ROW};
    }};
    float sums[{VALUES}][8] = {{}};
    int known = rows_of(begin);
    for (int tile = begin; tile < end; ++tile) {{
        const int next = rows_of(tile + 1);
        uint4 h[8], d[8];  // eight halves each: of the output, and the gradient at the head
        #pragma unroll
        for (int i = 0; i < 8; ++i) {{
            const int row = __shfl_sync(0xffffffffu, known, i);
            h[i] = d[i] = make_uint4(0, 0, 0, 0);
            if (row >= 0) {{
                h[i] = __ldg(reinterpret_cast<const uint4*>(last + (size_t)row * {WIDTH} + lane
                    * 8));
                d[i] = __ldg(reinterpret_cast<const uint4*>(after.data + (size_t)row * {HEAD}));
            }}
        }}
        #pragma unroll
        for (int i = 0; i < 8; ++i) {{
            auto half_of = [](const uint4& eight, int n) {{
                const unsigned two = n < 2 ? eight.x : n < 4 ? eight.y : n < 6 ? eight.z : eight.w;
                wp::half value;
                value.u = (unsigned short)(n % 2 ? two >> 16 : two);
                return wp::half_to_float(value);
            }};
            #pragma unroll
            for (int n = 0; n < 8; ++n)
                #pragma unroll
                for (int v = 0; v < {VALUES}; ++v) sums[v][n] += half_of(d[i], v)
                    * half_of(h[i], n);
        }}
        known = next;
    }}
    #pragma unroll
    for (int v = 0; v < {VALUES}; ++v)
        #pragma unroll
        for (int n = 0; n < 8; ++n) of_warps[warp][v * {WIDTH} + lane * 8 + n] = sums[v][n];
    __syncthreads();
    for (int n = threadIdx.x; n < {VALUES * WIDTH}; n += {BLOCK}) {{
        float sum = of_warps[0][n];
        for (int other = 1; other < {WARPS}; ++other) sum += of_warps[other][n];
        to[n] = sum;
    }}
#else
    for (int n = 0; n < {VALUES * WIDTH}; ++n) to[n] = 0.0f;
    for (int at = begin * {TILE}; at < end * {TILE}; ++at) {{
        const int row = listed.data[at];
        if (row < 0) continue;
        for (int v = 0; v < {VALUES}; ++v) {{
            const float d = wp::half_to_float(after.data[(size_t)row * {HEAD} + v]);
            for (int n = 0; n < {WIDTH}; ++n)
                to[v * {WIDTH} + n] += d * wp::half_to_float(last[(size_t)row * {WIDTH} + n]);
        }}
    }}
#endif
""")
def by_head(
    part: int,
    parts: int,
    keys: int,
    layers: int,
    rows: int,
    listed: wp.array[wp.int32],
    begins: wp.array[wp.int32],
    after: wp.array2d[wp.float16],
    outputs: wp.array3d[wp.float16],
    partials: wp.array3d[float],
):
    """Gradients at the head times outputs of the last layer, over a part of the rows."""


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, HEAD_BLOCKS))
def multiply_head(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    keys: int,  # how many [1]
    listed: wp.array[wp.int32],  # [capacity] of ``rows.list_rows``
    begins: wp.array[wp.int32],  # [k + 1] the same
    after: wp.array2d[wp.float16],  # [k N, HEAD] gradient at the head
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH] of all rows
    # Out:
    partials: wp.array3d[float],  # [parts, 1, VALUES WIDTH] gradients of the head by parts
):
    """One block of threads for a part of the list."""
    part = wp.tid() // threads
    layers, rows = outputs.shape[0], outputs.shape[1]
    by_head(part, partials.shape[0], keys, layers, rows, listed, begins, after, outputs, partials)


@wp.func
def total_of(partials: wp.array3d[float], job: int, at: int) -> float:
    """A value of all parts, in their order."""
    total = float(0.0)
    for part in range(partials.shape[0]):
        total += partials[part, job, at]
    return total


@wp.kernel(enable_backward=False)
def collect(
    # In:
    form: Layers,  # sizes [1]
    unit: wp.array[float],  # [1] what everything but the bias of the head is in
    sums: wp.array3d[float],  # [layers, k, WIDTH] of slopes over rows
    head_sum: wp.array[float],  # [VALUES] of gradients at the head
    time: wp.array2d[float],  # [k, t] gamma(t)
    of_outputs: wp.array3d[float],  # [parts, jobs, HALF WIDTH] of ``multiply_outputs``
    of_places: wp.array3d[float],  # [parts, jobs, HALF COLUMNS] of ``multiply_positions``
    of_head: wp.array3d[float],  # [parts, 1, VALUES WIDTH] of ``multiply_head``
    # Out:
    gradients: wp.array[float],  # [P] of all layers and the head
):
    """A thread per output of every layer and the head, and input; one input more is the bias."""
    row, input = wp.tid()
    number = row // WIDTH
    n = row % WIDTH
    inputs = inputs_of(form, number)
    begin = weight_of(form, number)
    if input > inputs:
        return
    if input == inputs and number == form.layers:
        gradients[begin + VALUES * WIDTH + n] = head_sum[n]
        return
    at = begin + n * inputs + input
    encoded = input  # index among the encodings, which follow the outputs of the layer before
    if number > 0:
        encoded -= WIDTH
    total = float(0.0)
    if input == inputs:
        at = begin + WIDTH * inputs + n
        for key in range(sums.shape[1]):
            total += sums[number, key, n]
    elif number == form.layers:
        total = total_of(of_head, 0, n * WIDTH + input)
    elif encoded < 0:
        total = total_of(of_outputs, (number - 1) * HALVES + n // HALF, n % HALF * WIDTH + input)
    elif encoded < form.position:
        job = n // HALF
        if number > 0:
            job += HALVES
        total = total_of(of_places, job, n % HALF * COLUMNS + encoded)
    else:
        for key in range(sums.shape[1]):
            total += sums[number, key, n] * time[key, encoded - form.position]
    gradients[at] = total * unit[0]
