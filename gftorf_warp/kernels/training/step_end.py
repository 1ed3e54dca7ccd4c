"""What stands between the gradients of a step and its end, without asking the host: a judgement, and running sums.

A step is sound if its loss and the sum of all squared gradients are finite and no (tile, splat) pair was dropped. One
that is not changes no parameter, no moment, no sum and no statistic; it is counted.
"""

import warp as wp

from .adam import ADVANCE, COLUMNS, GRADIENT, LENGTH, MORE
from .ordered_sums import LANES, OVER_LANES

PART = 256  # elements of a gradient whose squares are added up at once: few, since a warp waits for them one by one
JUDGES = 1024  # threads of the block that judges
IMAGES = 4  # of a step, at most
LOSS, SQUARED, OPACITY, FLOW, DISTORTION, MOTION_SIZE = range(6)  # of an image; all but two are terms of its loss
FOUND = 6
WHOLE, COUNT = FOUND, FOUND + 1  # of the sums, beside what was found: loss and images
SUMS = FOUND + 2

Weights = wp.types.vector(length=FOUND, dtype=float)

_SQUARES = f"""{OVER_LANES}
#if defined(__CUDA_ARCH__)
    const int lane = thread & {LANES - 1}, lanes = {LANES};
#else
    const int lane = 0, lanes = 1;
#endif
    if (slot >= partials.shape[0]) return;
    int low = 0, high = first_part.shape[0];
    while (high - low > 1) {{
        const int middle = (low + high) / 2;
        if (first_part.data[middle] <= slot) low = middle; else high = middle;
    }}
    const long long* row = table.data + {COLUMNS} * low;
    const long long begin = (long long)(slot - first_part.data[low]) * {PART}, left = row[{LENGTH}] - begin;
    const int count = left < {PART} ? (int)left : {PART};
    auto gradient = [&](int column) {{ return reinterpret_cast<const float*>(row[column]); }};
    const float *one = gradient({GRADIENT}), *two = gradient({MORE});
    const float *three = gradient({MORE + 1}), *four = gradient({MORE + 2});
    float s = 0.0f;
    if (one != nullptr) {{
        #pragma unroll 4
        for (int i = lane; i < count; i += lanes) {{
            float g = one[begin + i];
            if (two != nullptr) g += two[begin + i];
            if (three != nullptr) g += three[begin + i];
            if (four != nullptr) g += four[begin + i];
            s += g * g;
        }}
    }}
    s = over_lanes(s);
    if (writes) partials.data[slot] = s;
"""

_JUDGE = f"""
#if defined(__CUDA_ARCH__)
#define SHARED __shared__
#define TOGETHER __syncthreads()
    const int t = threadIdx.x, all = {JUDGES};
#else
#define SHARED
#define TOGETHER
    const int t = 0, all = 1;
#endif
    SHARED double room[2][{JUDGES // LANES}];
    SHARED float control[3], seen[{IMAGES * FOUND}], values[{SUMS}];
    SHARED int most[{IMAGES}];
    double fixed = 0.0, moving = 0.0;
    for (int i = t; i < partials.shape[0]; i += all)
        if (i < motion_part) fixed += (double)partials.data[i]; else moving += (double)partials.data[i];
    for (int i = t; i < {FOUND} * images; i += all) seen[i] = found.data[i];
    for (int n = t; n < images; n += all)
        if (capacity == 0) most[n] = 0;
        else most[n] = *(n == 0 ? pairs0.data : n == 1 ? pairs1.data : n == 2 ? pairs2.data : pairs3.data);
#if defined(__CUDA_ARCH__)
    auto over_lanes = [](double v) -> double {{
        for (int o = {LANES // 2}; o > 0; o >>= 1) v += __shfl_down_sync(0xffffffffu, v, o);
        return v;
    }};
    fixed = over_lanes(fixed);
    moving = over_lanes(moving);
    if (t % {LANES} == 0) {{ room[0][t / {LANES}] = fixed; room[1][t / {LANES}] = moving; }}
    TOGETHER;
    if (t < {LANES}) {{ fixed = over_lanes(room[0][t]); moving = over_lanes(room[1][t]); }}
#endif
    if (t == 0) {{
        const float largest = 3.402823466e38f;
        float loss = 0.0f;
        for (int k = 0; k < {FOUND}; ++k) {{
            float s = 0.0f;  // what has no weight was not found: whatever stands there is of another step
            if (weights[k] != 0.0f) for (int n = 0; n < images; ++n) s += seen[{FOUND} * n + k];
            values[k] = weights[k] * s;
            if (k != {SQUARED} && k != {OPACITY}) loss += values[k];
        }}
        values[{WHOLE}] = loss;
        values[{COUNT}] = (float)images;
        int pairs = 0;
        for (int n = 0; n < images; ++n) pairs = most[n] > pairs ? most[n] : pairs;
        const float norm = (float)(sqrt(fixed + moving) / images), length = (float)(sqrt(moving) / images);
        const bool fits = capacity < 1 || pairs <= capacity;
        const bool sound = fabsf(loss) <= largest && norm <= largest && fits;
        const float left = longest / (length + 1e-6f);
        control[0] = 1.0f / images;
        control[1] = (longest > 0.0f && left < 1.0f ? left : 1.0f) / images;
        control[2] = sound;
        counts.data[0] += !sound;
        counts.data[1] = sound ? 0 : counts.data[1] + 1;
        counts.data[2] = pairs > counts.data[2] ? pairs : counts.data[2];
        counts.data[3] += !fits;
    }}
    TOGETHER;
    const bool sound = control[2] != 0.0f;
    for (int k = t; k < {SUMS}; k += all) if (sound) sums.data[k] += values[k];
    for (int tensor = t; tensor < table.shape[0]; tensor += all) {{
        const float rate = rates.data[tensor], factor = control[tensor < motion_from ? 0 : 1];
        [&]() {{{ADVANCE}}}();
    }}
#undef SHARED
#undef TOGETHER
"""


@wp.func_native(_SQUARES)
def squares_of(table: wp.array2d[wp.int64], first_part: wp.array[int], thread: int, partials: wp.array[float]):
    """Squares of one part of a gradient, summed over the lanes of a warp."""


@wp.func_native(_JUDGE)
def judge_step(
    partials: wp.array[float],
    motion_part: int,
    motion_from: int,
    longest: float,
    found: wp.array2d[float],
    weights: Weights,
    images: int,
    pairs0: wp.array[int],
    pairs1: wp.array[int],
    pairs2: wp.array[int],
    pairs3: wp.array[int],
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
def seen_of(screen: wp.array2d[float], half: wp.vec2, i: int) -> wp.vec3:
    """What one image says of a Gaussian: pixels times screen gradient, pixels, and its weight in them."""
    length = wp.length(wp.vec2(half[0] * screen[i, 0], half[1] * screen[i, 1]))
    return wp.vec3(screen[i, 2] * length, screen[i, 2], screen[i, 3])


@wp.kernel(enable_backward=False)
def observe(
    # In:
    screen0: wp.array2d[float],  # [N, 4] of the first image: derivative by the image position [1/px], pixels, weight
    screen1: wp.array2d[float],  # [N, 4] of the second; any other if there is none
    screen2: wp.array2d[float],  # [N, 4] of the third
    screen3: wp.array2d[float],  # [N, 4] of the fourth
    images: int,  # 1 to 4 [1]
    half: wp.vec2,  # half an image [px]
    counts: wp.array[int],  # [4] the second is 0 if the step is sound [1]
    # Out:
    gradient: wp.array[float],  # [N] sum of pixels times screen gradient, in half image sizes
    pixels: wp.array[float],  # [N] sum of pixels [1]
    weight: wp.array[float],  # [N] sum of weights [px]
):
    """One thread per Gaussian."""
    i = wp.tid()
    if counts[1] == 0:
        seen = seen_of(screen0, half, i)
        if images > 1:
            seen = seen + seen_of(screen1, half, i)
        if images > 2:
            seen = seen + seen_of(screen2, half, i)
        if images > 3:
            seen = seen + seen_of(screen3, half, i)
        gradient[i] = gradient[i] + seen[0]
        pixels[i] = pixels[i] + seen[1]
        weight[i] = weight[i] + seen[2]


@wp.kernel(enable_backward=False, grid_stride=False)
def gradient_squares(
    # In:
    table: wp.array2d[wp.int64],  # [T, 6] of ``adam.py``
    first_part: wp.array[int],  # [T] parts before those of a tensor [1]
    # Out:
    partials: wp.array[float],  # [P] sum of squares of each part
):
    """One warp per part, on the CPU one thread."""
    squares_of(table, first_part, wp.tid(), partials)


@wp.kernel(enable_backward=False, grid_stride=False)
def judge(
    # In:
    partials: wp.array[float],  # [P] from ``gradient_squares``
    motion_part: int,  # parts before those of the motion [1]
    motion_from: int,  # tensors before those of the motion [1]
    longest: float,  # gradient of the motion, a longer one is shortened; 0: none is [1]
    found: wp.array2d[float],  # [images or more, 6] what was found of each image
    weights: Weights,  # of what was found in the loss; of what is no term 1, of what is not there 0 [1]
    images: int,  # of this step, 1 to 4 [1]
    pairs0: wp.array[int],  # [1] (tile, splat) pairs of the first image
    pairs1: wp.array[int],  # [1] of the second; any other if there is none
    pairs2: wp.array[int],  # [1] of the third
    pairs3: wp.array[int],  # [1] of the fourth
    capacity: int,  # pairs that are reserved; -1: not known yet; 0: nobody counts [1]
    table: wp.array2d[wp.int64],  # [T, 6] of ``adam.py``
    rates: wp.array[float],  # [T] learning rates, 0: the tensor rests [1]
    beta1: wp.float64,  # decay of the first moment [1]
    beta2: wp.float64,  # decay of the second moment [1]
    # Out:
    counts: wp.array[int],  # [4] steps that failed, in a row, most pairs of an image so far, steps of too many pairs
    sums: wp.array[float],  # [8] of what was found, times its weight, of the loss and of images
    sizes: wp.array2d[float],  # [T, 3] what Adam's step comes to
):
    """One block, on the CPU one thread."""
    judge_step(
        partials,
        motion_part,
        motion_from,
        longest,
        found,
        weights,
        images,
        pairs0,
        pairs1,
        pairs2,
        pairs3,
        capacity,
        table,
        rates,
        beta1,
        beta2,
        counts,
        sums,
        sizes,
    )
