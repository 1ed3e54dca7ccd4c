"""The end of a training step without reading anything back: validity, running sums, statistics.

A step is valid if its loss and the sum of all squared gradients are finite and no (tile, splat)
pair was dropped. An invalid step changes no parameter, moment, sum or statistic; it is counted.
"""

import warp as wp

from .adam import ADVANCE, COLUMNS, COUNT, GRADIENT, LENGTH, MORE
from .ordered_sums import LANES, OVER_LANES

# elements of a gradient whose squares one warp sums up: few, since it reads them serially
PART = 256
WIDTH = 16  # sums of a part at once on a CPU: one alone would wait for its last addition
THREADS = 1024  # of the block that finishes a step
SCREENS = 4  # images whose statistics one launch adds
RESULTS = 3  # per image and term: the term, its mean squared difference, its mean opacity
COLUMNS_MAX = 32 * RESULTS  # of all terms; shared memory
RENDERINGS_MAX = 64  # of one step; shared memory
TOTALS = 4  # sums besides the terms: squared difference, opacity, loss, number of images

_SQUARES = f"""{OVER_LANES}
#if defined(__CUDA_ARCH__)
    const int lane = thread & {LANES - 1}, lanes = {LANES}, width = 1;
#else
    const int lane = 0, lanes = {WIDTH}, width = {WIDTH};
#endif
    if (slot >= partials.shape[0]) return;
    int low = 0, high = first_part.shape[0];
    while (high - low > 1) {{
        const int middle = (low + high) / 2;
        if (first_part.data[middle] <= slot) low = middle; else high = middle;
    }}
    const long long* row = table.data + {COLUMNS} * low;
    const long long begin = (long long)(slot - first_part.data[low]) * {PART}, left = row[{LENGTH}]
        - begin;
    const int count = left < {PART} ? (int)left : {PART};
    auto gradient = [&](int column) {{ return reinterpret_cast<const float*>(row[column]); }};
    const float *one = gradient({GRADIENT}), *two = gradient({MORE});
    const float *three = gradient({MORE + 1}), *four = gradient({MORE + 2});
    float s = 0.0f;
    if (one != nullptr) {{
        float sums[width] = {{}};
        int i = lane;
        #pragma unroll 4
        for (; i + width <= count; i += lanes) {{
            const long long at = begin + i;
            float g[width];
            for (int k = 0; k < width; ++k) g[k] = one[at + k];
            if (two != nullptr) for (int k = 0; k < width; ++k) g[k] += two[at + k];
            if (three != nullptr) for (int k = 0; k < width; ++k) g[k] += three[at + k];
            if (four != nullptr) for (int k = 0; k < width; ++k) g[k] += four[at + k];
            for (int k = 0; k < width; ++k) sums[k] += g[k] * g[k];
        }}
        for (int k = 0; k < width; ++k) s += sums[k];
#if !defined(__CUDA_ARCH__)
        for (; i < count; ++i) {{  // behind the last whole vector
            float g = one[begin + i];
            if (two != nullptr) g += two[begin + i];
            if (three != nullptr) g += three[begin + i];
            if (four != nullptr) g += four[begin + i];
            s += g * g;
        }}
#endif
    }}
    s = over_lanes(s);
    if (writes) partials.data[slot] = s;
"""

_FINISH = f"""
#if defined(__CUDA_ARCH__)
#define SHARED __shared__
#define SYNCHRONISE __syncthreads()
    const int t = threadIdx.x, threads = {THREADS};
#else
#define SHARED
#define SYNCHRONISE
    const int t = 0, threads = 1;
#endif
    SHARED double warp_sums[2][{THREADS // LANES}];
    SHARED float control[3], totals[{TOTALS}], column[{COLUMNS_MAX}];
    SHARED int used[{RENDERINGS_MAX}];
    const int columns = results.shape[1], terms = columns / {RESULTS};
    double of_field = 0.0, of_motion = 0.0;
    for (int i = t; i < partials.shape[0]; i += threads)
        if (i < motion_part) of_field += (double)partials.data[i]; else of_motion +=
            (double)partials.data[i];
    for (int k = t; k < columns; k += threads) {{
        // a result of weight 0 was not computed: its memory holds that of an earlier step
        float s = 0.0f;
        #pragma unroll 4
        for (int n = 0; n < images; ++n) {{
            const float w = weights.data[columns * n + k], r = results.data[columns * n + k];
            s += w != 0.0f ? w * r : 0.0f;
        }}
        column[k] = s;
    }}
    for (int n = t; n < renderings; n += threads)
        used[n] = *reinterpret_cast<const int*>(pairs.data[n]);
    // before the sums are known: otherwise the device waits for one load after the other
    for (int tensor = t; tensor < table.shape[0]; tensor += threads) {{
        const float rate = rates.data[tensor];
        [&]() {{{ADVANCE}}}();
    }}
    const float images_compared = compared.data[0];
#if defined(__CUDA_ARCH__)
    auto over_lanes = [](double v) -> double {{
        for (int o = {LANES // 2}; o > 0; o >>= 1) v += __shfl_down_sync(0xffffffffu, v, o);
        return v;
    }};
    of_field = over_lanes(of_field);
    of_motion = over_lanes(of_motion);
    if (t % {LANES} == 0) {{ warp_sums[0][t / {LANES}] = of_field; warp_sums[1][t / {LANES}] =
        of_motion; }}
    SYNCHRONISE;
    if (t < {LANES}) {{ of_field = over_lanes(warp_sums[0][t]); of_motion =
        over_lanes(warp_sums[1][t]); }}
#endif
    if (t == 0) {{
        const float largest = 3.402823466e38f;
        float squared = 0.0f, opacity = 0.0f, loss = 0.0f;
        for (int k = 0; k < terms; ++k) {{
            loss += column[{RESULTS} * k];
            squared += column[{RESULTS} * k + 1];
            opacity += column[{RESULTS} * k + 2];
        }}
        totals[0] = squared; totals[1] = opacity; totals[2] = loss; totals[3] = images_compared;
        int most = 0;
        for (int n = 0; n < renderings; ++n) most = used[n] > most ? used[n] : most;
        const float norm = (float)(sqrt(of_field + of_motion) / images), length =
            (float)(sqrt(of_motion) / images);
        const bool fits = !limited || most <= capacity;
        const bool valid = fabsf(loss) <= largest && norm <= largest && fits;
        const float left = gradient_max / (length + 1e-6f);
        control[0] = 1.0f / images;
        control[1] = (clips && left < 1.0f ? left : 1.0f) / images;
        control[2] = valid;
        counts.data[0] += !valid;
        counts.data[1] = valid ? 0 : counts.data[1] + 1;
        counts.data[2] = most > counts.data[2] ? most : counts.data[2];
        counts.data[3] += !fits;
    }}
    SYNCHRONISE;
    const bool valid = control[2] != 0.0f;
    for (int k = t; k < terms + {TOTALS}; k += threads)
        if (valid) sums.data[k] += k < terms ? column[{RESULTS} * k] : totals[k - terms];
    for (int tensor = t; tensor < table.shape[0]; tensor += threads) {{
        const float factor = control[tensor < motion_from ? 0 : 1];
        [&]() {{{COUNT}}}();
    }}
#undef SHARED
#undef SYNCHRONISE
"""


@wp.func_native(_SQUARES)
def squares_of(
    table: wp.array2d[wp.int64], first_part: wp.array[int], thread: int, partials: wp.array[float]
):
    """Squares of one part of a gradient, summed over the lanes of a warp."""


@wp.func_native(_FINISH)
def finish(
    partials: wp.array[float],
    motion_part: int,
    motion_from: int,
    clips: bool,
    gradient_max: float,
    results: wp.array2d[float],
    weights: wp.array2d[float],
    images: int,
    compared: wp.array[float],
    pairs: wp.array[wp.int64],
    renderings: int,
    limited: bool,
    capacity: int,
    table: wp.array2d[wp.int64],
    rates: wp.array[float],
    beta1: wp.float64,
    beta2: wp.float64,
    counts: wp.array[int],
    sums: wp.array[float],
    sizes: wp.array2d[float],
):
    """All threads of one block."""


@wp.func
def statistics_of(screen: wp.array2d[float], half: wp.vec2, i: int) -> wp.vec3:
    """Statistics of a Gaussian in an image: pixels times screen gradient, pixels, weight."""
    length = wp.length(wp.vec2(half[0] * screen[i, 0], half[1] * screen[i, 1]))
    return wp.vec3(screen[i, 2] * length, screen[i, 2], screen[i, 3])


@wp.kernel(enable_backward=False)
def add_statistics(
    # In:
    screen0: wp.array2d[float],  # [N, 4] of the first image: screen gradient [1/px], pixels, weight
    screen1: wp.array2d[float],  # [N, 4] of the second, if there is one
    screen2: wp.array2d[float],  # [N, 4] of the third
    screen3: wp.array2d[float],  # [N, 4] of the fourth
    images: int,  # 1 to 4 [1]
    half: wp.vec2,  # half an image [px]
    counts: wp.array[int],  # [4] the second is 0 if the step is valid [1]
    # Out:
    gradient: wp.array[float],  # [N] sum of pixels times screen gradient, in half image sizes
    pixels: wp.array[float],  # [N] sum of pixels [1]
    weight: wp.array[float],  # [N] sum of weights [px]
):
    """One thread per Gaussian."""
    i = wp.tid()
    if counts[1] == 0:
        total = statistics_of(screen0, half, i)
        if images > 1:
            total = total + statistics_of(screen1, half, i)
        if images > 2:
            total = total + statistics_of(screen2, half, i)
        if images > 3:
            total = total + statistics_of(screen3, half, i)
        gradient[i] = gradient[i] + total[0]
        pixels[i] = pixels[i] + total[1]
        weight[i] = weight[i] + total[2]


@wp.kernel(enable_backward=False, grid_stride=False)
def gradient_squares(
    # In:
    table: wp.array2d[wp.int64],  # [T, 9] of ``adam.py``
    first_part: wp.array[int],  # [T] parts before those of a tensor [1]
    # Out:
    partials: wp.array[float],  # [P] sum of squares of each part
):
    """One warp per part, on the CPU one thread."""
    squares_of(table, first_part, wp.tid(), partials)


@wp.kernel(enable_backward=False, grid_stride=False)
def finish_step(
    # In:
    partials: wp.array[float],  # [P] from ``gradient_squares``
    motion_part: int,  # parts before those of the motion [1]
    motion_from: int,  # tensors before those of the motion [1]
    clips: bool,  # whether the gradient of the motion is clipped [1]
    gradient_max: float,  # its largest norm [1]
    results: wp.array2d[float],  # [B or more, 3 L] results of every image and term, see ``RESULTS``
    weights: wp.array2d[float],  # [B or more, 3 L] weights of these; 0: not computed [1]
    images: int,  # B of this step [1]
    compared: wp.array[float],  # [1] images with any term
    pairs: wp.array[wp.int64],  # [R or more] addresses of the (tile, splat) pairs of renderings
    renderings: int,  # R of this step [1]
    limited: bool,  # whether pairs beyond ``capacity`` were dropped [1]
    capacity: int,  # pairs of one rendering with memory [1]
    table: wp.array2d[wp.int64],  # [T, 9] of ``adam.py``
    rates: wp.array[float],  # [T] learning rates; a tensor of rate 0 is left alone [1]
    beta1: wp.float64,  # decay of the first moment [1]
    beta2: wp.float64,  # decay of the second moment [1]
    # Out:
    counts: wp.array[int],  # [4] steps skipped, in a row; most pairs; steps with too many
    sums: wp.array[float],  # [L + 4] weighted terms, squared difference, opacity, loss, images
    sizes: wp.array2d[float],  # [T, 3] step sizes of Adam
):
    """One block, on the CPU one thread."""
    finish(
        partials, motion_part, motion_from, clips, gradient_max, results, weights, images, compared,
        pairs, renderings, limited, capacity, table, rates, beta1, beta2, counts, sums, sizes,
    )  # fmt: skip
