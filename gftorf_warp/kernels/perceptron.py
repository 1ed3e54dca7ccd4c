"""All layers of a perceptron in one launch, forward and backward, on Hopper's tensor cores; scene/perceptron.py has the
formulas.

Rows are independent, so a block of threads takes its rows through all layers and waits for nobody. Two groups of four
warps take tiles of 64 rows in turns: while one multiplies, the other adds shifts, masks, rounds and stores. Weights come
in blocks of 64 inputs into a ring in shared memory, copied as they lie in global memory, ahead of the layer that needs
them. Rows never meet shared memory: what a lane stores of a row is what it reads of it one layer later.

That works because the order of a sum over inputs is free, and that of outputs too: ``packed`` weights are arranged so
that a lane's share of a row, of inputs and of outputs, is eight neighbours, 16 bytes. Sums over the rows of a key, which
gradients of biases are, stay in registers until the key has passed.

On a CPU one thread does the same row by row, float32 on halves: to compare with, not to be fast.
"""

import warp as wp

WIDTH = 256  # outputs of a layer
COLUMNS = 64  # of gamma(x), zeros included: one block of inputs
TILE = 64  # rows that a group multiplies at once
ROUND = 12  # tiles that a block takes through all layers before it goes on to others: so they are still in cache
GROUPS = 2  # of 128 threads
BLOCK = 128 * GROUPS  # threads
UNIT = wp.constant(8)  # halves of 16 bytes
HEAD = 8  # columns of the gradient at the head: 16 bytes, of which VALUES are used
VALUES = 3
ARCHITECTURE = 90  # that has these instructions; they are no part of later ones
SLOTS = 6  # of the ring
import os
TURNS = os.environ.get("GF_TURNS", "1") == "1"
AHEAD = os.environ.get("GF_AHEAD", "0") == "1"
_PART = 64 * WIDTH  # halves of a block of weights
_SHARED = SLOTS * 2 * _PART + GROUPS * 4 * WIDTH * 4 + 64 + 16 + 1024  # bytes: ring, sums, barriers, counters, to align
_FOURS = wp.constant(_SHARED // 16)


def mask_words(layers: int, keys: int, count: int) -> int:
    """Words of 32 bits for what is above 0: a thread has four of a tile."""
    return layers * keys * -(-count // TILE) * 128 * 4


@wp.struct
class Layers:
    """Sizes of a perceptron, and where its parameters lie in one array: weight and bias of every layer, in order."""

    layers: int  # without the head
    joined: int  # number of the layer that gamma(x) and gamma(t) enter again; -1: none
    place: int  # values of gamma(x)
    moment: int  # values of gamma(t)


@wp.func
def enters(form: Layers, number: int) -> bool:
    """Whether gamma(x) and gamma(t) enter a layer."""
    return number == 0 or number == form.joined


@wp.func
def inputs_of(form: Layers, number: int) -> int:
    """Inputs of a layer."""
    inputs = WIDTH
    if number == 0:
        inputs = 0
    if enters(form, number):
        inputs += form.place + form.moment
    return inputs


@wp.func
def weight_of(form: Layers, number: int) -> int:
    """Where the weight of a layer begins."""
    at = number * (WIDTH * WIDTH + WIDTH)
    if number > 0:
        at += WIDTH * (form.place + form.moment - WIDTH)
    if form.joined >= 0 and number > form.joined:
        at += WIDTH * (form.place + form.moment)
    return at


@wp.kernel(enable_backward=False)
def add_moments(
    form: Layers,
    parameters: wp.array[float],
    moment: wp.array2d[float],  # [k, t] gamma(t)
    shifts: wp.array3d[float],  # [layers, k, WIDTH] filled
):
    """What is added to every row of a key in a layer: its bias, and what gamma(t) makes of the weight."""
    number, key, n = wp.tid()
    inputs = inputs_of(form, number)
    at = weight_of(form, number)
    total = parameters[at + inputs * WIDTH + n]
    if enters(form, number):
        row = at + (n + 1) * inputs - form.moment
        for k in range(form.moment):
            total += parameters[row + k] * moment[key, k]
    shifts[number, key, n] = total


@wp.kernel(enable_backward=False)
def pack(
    form: Layers,
    parameters: wp.array[float],
    forth: wp.array[wp.float16],  # of all layers, filled
    back: wp.array[wp.float16],  # of all but the first, the last one first, transposed, without gamma(x); filled
    head: wp.array[wp.float16],  # [HEAD WIDTH] of the head, row by row, zeros below; filled
):
    """Round weights to halves, in the order in which tensor cores read them; a thread per 16 bytes.

    A block of 64 inputs has a row of 128 bytes for every output, pieces of 16 bytes exchanged by the last three bits of
    its number. Outputs and inputs are numbered as the products number them; ``p`` and ``k`` are what they stand for.
    """
    at = wp.tid() * UNIT
    if at >= forth.shape[0] + back.shape[0]:
        at -= forth.shape[0] + back.shape[0]
        begin = weight_of(form, form.layers)
        for i in range(UNIT):
            value = float(0.0)
            if at + i < wp.static(VALUES * WIDTH):
                value = parameters[begin + at + i]
            head[at + i] = wp.float16(value)
        return
    backward = at >= forth.shape[0]
    if backward:
        at -= forth.shape[0]
    part = at // _PART
    n = at % _PART // 64
    u = (at % 64 // UNIT) ^ (n & 7)
    p = n // 32 * 32 + n % 8 // 2 * 8 + n % 32 // 8 * 2 + n % 2
    k = u // 4 * 32 + u // 2 % 2 * 4 + u % 2 * 2
    if backward:
        number = form.layers - 1 - part // 4
        k += part % 4 * 64
    else:
        number = int(0)
        while number + 1 < form.layers and first_part(form, number + 1) <= part:
            number += 1
        k += (part - first_part(form, number)) * 64
    begin = weight_of(form, number)
    stride = inputs_of(form, number)
    for i in range(UNIT):
        input = k + i // 2 * 8 + i % 2
        if backward:
            back[at + i] = wp.float16(parameters[begin + input * stride + p])
        else:
            forth[at + i] = wp.float16(parameters[begin + p * stride + input])


@wp.func
def first_part(form: Layers, number: int) -> int:
    """Blocks of weights before those of a layer."""
    parts = 4 * number
    if number > 0:
        parts -= 3
    if form.joined >= 0 and number > form.joined:
        parts += 1
    return parts


_SUMS = ", ".join(f"%{n}" for n in range(128))
_OPERANDS = ", ".join(f'"+f"(sums[{n}])' for n in range(128))
_KEPT = " ".join(f'asm volatile("" : "+f"(sums[{n}]) :: "memory");' for n in range(128))


def _multiply(add: int) -> str:
    """C++: 16 inputs of 64 rows times 256 outputs, added to ``sums`` or in their place."""
    return f"""asm volatile("{{ .reg .pred p; setp.ne.b32 p, {add}, 0; wgmma.mma_async.sync.aligned.m64n256k16.f32.f16.f16 "
            "{{{_SUMS}}}, {{%128, %129, %130, %131}}, %132, p, 1, 1, 0; }}"
            : {_OPERANDS} : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "l"(matrix) : "memory");"""


_CUDA = f"""
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5 & 3;
    const int group = __shfl_sync(0xffffffffu, threadIdx.x >> 7, 0);  // so that the compiler knows it is one per warp
    const int g = lane >> 2, t = lane & 3;
    const int of_key = (count + {TILE - 1}) / {TILE}, tiles = keys * of_key;
    const int first = (int)((long long)tiles * blockIdx.x / gridDim.x);
    const int last = (int)((long long)tiles * (blockIdx.x + 1) / gridDim.x);
    const size_t of_layer = (size_t)keys * count * {WIDTH};
    extern __shared__ char memory[];
    const unsigned begins = (unsigned)__cvta_generic_to_shared(memory), base = (begins + 1023u) & ~1023u;
    const unsigned barriers = base + {SLOTS * 2 * _PART + GROUPS * 4 * WIDTH * 4};
    int* const released = reinterpret_cast<int*>(memory + (base - begins) + {SLOTS * 2 * _PART + GROUPS * 4 * WIDTH * 4 + 64});
    struct Starts {{ enum {{ H = 0, P = 1 }}; }};  // blocks of 64 inputs: of the layer before, of gamma(x)
    struct Goes {{ enum {{ H = 4, P = 0 }}; }};
    struct Joins {{ enum {{ H = 4, P = 1 }}; }};

    auto fill = [&](int number, const wp::half* from) {{  // one thread: number of the block of weights, from 0 on
        const unsigned slot = number % {SLOTS}, barrier = barriers + 8 * slot;
        asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" :: "r"(barrier), "r"({2 * _PART})
                     : "memory");
        asm volatile("cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];"
                     :: "r"(base + slot * {2 * _PART}), "l"(from), "r"({2 * _PART}), "r"(barrier) : "memory");
    }};
    auto filled = [&](int number) {{  // wait for it
        const unsigned barrier = barriers + 8 * (number % {SLOTS}), parity = number / {SLOTS} & 1;
        unsigned there = 0;
        while (!there)
            asm volatile("{{ .reg .pred p; mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2; selp.u32 %0, 1, 0, p; }}"
                         : "=r"(there) : "r"(barrier), "r"(parity) : "memory");
    }};
    auto turn = [&](int of) {{ if ({int(TURNS)}) asm volatile("bar.sync %0, {BLOCK};" :: "r"(1 + of) : "memory"); }};
    auto pass_on = [&](int to) {{ if ({int(TURNS)}) asm volatile("bar.arrive %0, {BLOCK};" :: "r"(1 + to) : "memory"); }};
    auto group_waits = [&]() {{ asm volatile("bar.sync %0, 128;" :: "r"(3 + group) : "memory"); }};

    // the weights begin at 16 bytes times the low bits of ``matrix``
    auto begin_sums = [&](auto& sums, const auto& a, unsigned long long matrix) {{
        {_multiply(0)}
    }};
    auto multiply = [&](auto& sums, const auto& a, unsigned long long matrix) {{
        {_multiply(1)}
    }};
    // 16 inputs of rows g and g + 8 of this warp at a time; those of two are eight neighbours of both rows
    auto read = [&](auto kind, const wp::half* before, const wp::half* place_, int tile, auto& rows) {{
        constexpr int H = decltype(kind)::H, P = decltype(kind)::P;
        const int key = tile / of_key, low = (tile - key * of_key) * {TILE} + 16 * warp + g;
        const int row = min(low, count - 1), next = min(low + 8, count - 1);
        #pragma unroll
        for (int c = 0; c < 2 * (H + P); ++c) {{
            const wp::half* from = c < 2 * H ? before + (size_t)key * count * {WIDTH} : place_;
            const int width = c < 2 * H ? {WIDTH} : {COLUMNS}, column = 8 * t + 32 * (c < 2 * H ? c : c - 2 * H);
            const uint4 one = *reinterpret_cast<const uint4*>(from + (size_t)row * width + column);
            const uint4 two = *reinterpret_cast<const uint4*>(from + (size_t)next * width + column);
            rows[2 * c][0] = one.x; rows[2 * c][1] = two.x; rows[2 * c][2] = one.y; rows[2 * c][3] = two.y;
            rows[2 * c + 1][0] = one.z; rows[2 * c + 1][1] = two.z; rows[2 * c + 1][2] = one.w; rows[2 * c + 1][3] = two.w;
        }}
    }};
    // all inputs of a tile; block ``number`` of the weights is its first. The last block runs when it returns
    auto product = [&](auto kind, int number, const auto& rows, auto& sums) {{
        constexpr int C = decltype(kind)::H + decltype(kind)::P;
        #pragma unroll
        for (int c = 0; c < C; ++c) {{
            filled(number + c);
            const unsigned address = base + (number + c) % {SLOTS} * {2 * _PART};
            const unsigned long long matrix = (unsigned long long)(address >> 4) | 1ull << 16 | 64ull << 32 | 1ull << 62;
            asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
            if (c == 0) begin_sums(sums, rows[0], matrix);
            else multiply(sums, rows[4 * c], matrix);
            multiply(sums, rows[4 * c + 1], matrix + 2);
            multiply(sums, rows[4 * c + 2], matrix + 4);
            multiply(sums, rows[4 * c + 3], matrix + 6);
            asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
        }}
        if (C > 1) asm volatile("wgmma.wait_group.sync.aligned 1;" ::: "memory");
    }};
    auto multiplied = [&](auto& sums) {{
        asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
        {_KEPT}
    }};

    // this group has multiplied by ``blocks`` weights for the last time; the second group to say so sends for others
    int done = 0, layers_done = 0;  // blocks of weights, and layers, that this group needs no more
    auto release = [&](int blocks, const wp::half* packed, int of_round, int all) {{
        const int sent = min(done + {SLOTS}, all);
        done += blocks;
        group_waits();
        if ((threadIdx.x & 127) == 0) {{
            __threadfence_block();
            if (atomicAdd(released + (layers_done & 3), 1) & 1) {{
                __threadfence_block();
                for (int n = sent; n < min(done + {SLOTS}, all); ++n) fill(n, packed + (size_t)(n % of_round) * {_PART});
            }}
        }}
        ++layers_done;
    }};

    if (threadIdx.x < 4) released[threadIdx.x] = 0;
    if (threadIdx.x == 0)
        for (int slot = 0; slot < {SLOTS}; ++slot)
            asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barriers + 8 * slot) : "memory");
    asm volatile("fence.proxy.async;" ::: "memory");
    __syncthreads();
    if (group == 1) pass_on(0);
"""

_FORWARD = f"""
#if defined(__CUDA_ARCH__)
    {_CUDA}
    const int parts = form.layers * 4 - 3 + (form.joined >= 0);
    const int all = parts * ((last - first + {ROUND - 1}) / {ROUND});
    auto layer = [&](auto kind, int number, int begin, int end) {{
        constexpr int C = decltype(kind)::H + decltype(kind)::P;
        const wp::half* before = outputs.data + (number ? number - 1 : 0) * of_layer;
        wp::half* after = outputs.data + number * of_layer;
        unsigned rows[4 * C][4];
        if ({int(AHEAD)} && begin + group < end) read(kind, before, place.data, begin + group, rows);
        for (int tile = begin + group; tile < end + group; tile += {GROUPS}) {{
            if (tile >= end) {{
                turn(group);
                pass_on(1 - group);
                if (tile == begin + group) release(C, forth.data, parts, all);
                break;
            }}
            float sums[128];
            if (!{int(AHEAD)}) read(kind, before, place.data, tile, rows);
            turn(group);
            product(kind, done, rows, sums);
            pass_on(1 - group);
            multiplied(sums);
            if (tile + {GROUPS} >= end) release(C, forth.data, parts, all);
            else if ({int(AHEAD)}) read(kind, before, place.data, tile + {GROUPS}, rows);
            const int key = tile / of_key, row = (tile - key * of_key) * {TILE} + 16 * warp + g;
            const float4* from = reinterpret_cast<const float4*>(shifts.data + ((size_t)number * keys + key) * {WIDTH});
            wp::half* to = after + ((size_t)key * count + row) * {WIDTH} + 8 * t;
            unsigned alive[4] = {{}};
            #pragma unroll
            for (int q = 0; q < 8; ++q) {{
                const float4 one = __ldg(from + 8 * q + 2 * t), two = __ldg(from + 8 * q + 2 * t + 1);
                const float shift[8] = {{one.x, one.y, one.z, one.w, two.x, two.y, two.z, two.w}};
                #pragma unroll
                for (int half = 0; half < 2; ++half) {{
                    unsigned out[4];
                    #pragma unroll
                    for (int j = 0; j < 4; ++j) {{
                        asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(out[j])
                            : "f"(sums[16 * q + 4 * j + 2 * half + 1] + shift[2 * j + 1]),
                              "f"(sums[16 * q + 4 * j + 2 * half] + shift[2 * j]));
                        alive[2 * half + q / 4] |= (out[j] + 0x7fff7fffu & 0x80008000u) >> (4 * (q % 4) + j);
                    }}
                    if (row + 8 * half < count)
                        *reinterpret_cast<uint4*>(to + 8 * half * {WIDTH} + 32 * q) =
                            make_uint4(out[0], out[1], out[2], out[3]);
                }}
            }}
            reinterpret_cast<uint4*>(masks.data)[((size_t)number * tiles + tile) * 128 + (threadIdx.x & 127)] =
                make_uint4(alive[0], alive[1], alive[2], alive[3]);
        }}
    }};
    if (threadIdx.x == 0)
        for (int n = 0; n < min({SLOTS}, all); ++n) fill(n, forth.data + (size_t)(n % parts) * {_PART});
    for (int begin = first; begin < last; begin += {ROUND}) {{
        const int end = min(begin + {ROUND}, last);
        for (int number = 0; number < form.layers; ++number) {{
            if (number == 0) layer(Starts{{}}, number, begin, end);
            else if (number == form.joined) layer(Joins{{}}, number, begin, end);
            else layer(Goes{{}}, number, begin, end);
        }}
    }}
    if (group == 0) turn(0);  // the last turn that was passed on
#else
    PLACE_OF
    const size_t of_layer = (size_t)keys * count * {WIDTH};
    for (int key = 0; key < keys; ++key)
        for (int row = 0; row < count; ++row) {{
            const wp::half* packed = forth.data;
            for (int number = 0; number < form.layers; ++number) {{
                const int H = number ? {WIDTH} : 0;
                const int K = H + (number == 0 || number == form.joined ? {COLUMNS} : 0);
                const size_t at = ((size_t)key * count + row) * {WIDTH};
                for (int n = 0; n < {WIDTH}; ++n) {{
                    float sum = shifts.data[((size_t)number * keys + key) * {WIDTH} + n];
                    for (int k = 0; k < K; ++k) {{
                        const wp::half x = k < H ? outputs.data[(number - 1) * of_layer + at + k]
                                                 : place.data[(size_t)row * {COLUMNS} + k - H];
                        sum += wp::half_to_float(x) * wp::half_to_float(packed[place_of(k, n)]);
                    }}
                    outputs.data[number * of_layer + at + n] = wp::float_to_half(sum > 0.0f ? sum : 0.0f);
                }}
                packed += {WIDTH} * K;
            }}
        }}
#endif
"""

_BACKWARD = f"""
#if defined(__CUDA_ARCH__)
    {_CUDA}
    const int parts = 4 * (form.layers - 1), all = parts * ((last - first + {ROUND - 1}) / {ROUND});
    float* const shared_sums = reinterpret_cast<float*>(memory + (base - begins) + {SLOTS * 2 * _PART})
                               + group * {4 * WIDTH};
    struct Of64 {{ enum {{ N = 32 }}; }};
    struct Of32 {{ enum {{ N = 16 }}; }};
    struct Of16 {{ enum {{ N = 8 }}; }};
    // eight slopes of a row: the mask, the store; ``value`` is what was stored, before it was rounded
    auto masked = [&](auto& value, unsigned alive, wp::half* to, bool there) {{
        unsigned out[4];
        #pragma unroll
        for (int j = 0; j < 4; ++j) {{
            value[2 * j] = alive << j & 0x8000u ? value[2 * j] : 0.0f;
            value[2 * j + 1] = alive << j & 0x80000000u ? value[2 * j + 1] : 0.0f;
            asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(out[j]) : "f"(value[2 * j + 1]), "f"(value[2 * j]));
        }}
        if (there) *reinterpret_cast<uint4*>(to) = make_uint4(out[0], out[1], out[2], out[3]);
    }};
    auto alive_of = [&](int number, int tile, auto& alive) {{  // nobody is where there is no row
        const uint4 bits = reinterpret_cast<const uint4*>(masks.data)[
            ((size_t)number * tiles + tile) * 128 + (threadIdx.x & 127)];
        const int low = tile % of_key * {TILE} + 16 * warp + g;
        alive[0] = low < count ? bits.x : 0u; alive[1] = low < count ? bits.y : 0u;
        alive[2] = low + 8 < count ? bits.z : 0u; alive[3] = low + 8 < count ? bits.w : 0u;
    }};
    auto halve = [&](auto kind, auto& value) {{
        constexpr int N = decltype(kind)::N;
        const bool upper = lane & N / 2;
        #pragma unroll
        for (int i = 0; i < N; ++i) {{
            const float mine = upper ? value[N + i] : value[i], other = upper ? value[i] : value[N + i];
            value[i] = mine + __shfl_xor_sync(0xffffffffu, other, N / 2);
        }}
    }};
    // sums over the 16 rows of this warp: of 64 columns, eight remain with a lane, those from 32 g + 8 t on
    auto fold = [&](auto& value, auto& own) {{
        halve(Of64{{}}, value);
        halve(Of32{{}}, value);
        halve(Of16{{}}, value);
        #pragma unroll
        for (int i = 0; i < 8; ++i) own[i] += value[i];
    }};
    // the sums of a key that has passed, over the warps of this group; another round adds to them
    auto flush = [&](int number, int key, auto& own) {{
        #pragma unroll
        for (int i = 0; i < 8; ++i) {{
            shared_sums[warp * {WIDTH} + 32 * g + 8 * t + i] = own[i];
            own[i] = 0.0f;
        }}
        group_waits();
        float* to = partials.data + (((size_t)number * keys + key) * {GROUPS} * gridDim.x + {GROUPS} * blockIdx.x + group)
                    * {WIDTH};
        for (int n = threadIdx.x & 127; n < {WIDTH}; n += 128)
            to[n] += (shared_sums[n] + shared_sums[{WIDTH} + n]) + (shared_sums[{2 * WIDTH} + n] + shared_sums[{3 * WIDTH} + n]);
        group_waits();
    }};
    auto passes = [&](int tile, int end) {{  // whether this is the group's last tile of its key
        return tile + {GROUPS} >= end || (tile + {GROUPS}) / of_key != tile / of_key;
    }};
    auto top = [&](int begin, int end) {{
        const int number = form.layers - 1;
        float own[8] = {{}};
        for (int tile = begin + group; tile < end; tile += {GROUPS}) {{
            const int key = tile / of_key, low = (tile - key * of_key) * {TILE} + 16 * warp + g;
            const size_t at = number * of_layer + ((size_t)key * count + low) * {WIDTH} + 8 * t;
            float all_[64], a[2][{VALUES}];
            unsigned alive[4];
            alive_of(number, tile, alive);
            #pragma unroll
            for (int half = 0; half < 2; ++half)
                #pragma unroll
                for (int v = 0; v < {VALUES}; ++v)
                    a[half][v] = wp::half_to_float(
                        after.data[((size_t)key * count + min(low + 8 * half, count - 1)) * {HEAD} + v]);
            #pragma unroll
            for (int q = 0; q < 8; ++q) {{
                float value[2][8] = {{}};
                #pragma unroll
                for (int v = 0; v < {VALUES}; ++v)
                    #pragma unroll
                    for (int i = 0; i < 8; ++i) {{
                        const float factor = __ldg(head.data + v * {WIDTH} + 32 * q + 8 * t + i);
                        value[0][i] += a[0][v] * factor;
                        value[1][i] += a[1][v] * factor;
                    }}
                #pragma unroll
                for (int half = 0; half < 2; ++half)
                    masked(value[half], alive[2 * half + q / 4] << 4 * (q % 4),
                           slopes.data + at + 8 * half * {WIDTH} + 32 * q, low + 8 * half < count);
                #pragma unroll
                for (int i = 0; i < 8; ++i) all_[8 * q + i] = value[0][i] + value[1][i];
            }}
            fold(all_, own);
            if (passes(tile, end)) flush(number, key, own);
        }}
    }};
    auto layer = [&](int number, int begin, int end) {{
        const wp::half* before = slopes.data + number * of_layer;
        float own[8] = {{}};
        unsigned rows[16][4];
        if ({int(AHEAD)} && begin + group < end) read(Goes{{}}, before, before, begin + group, rows);
        for (int tile = begin + group; tile < end + group; tile += {GROUPS}) {{
            if (tile >= end) {{
                turn(group);
                pass_on(1 - group);
                if (tile == begin + group) release(4, back.data, parts, all);
                break;
            }}
            const int key = tile / of_key, low = (tile - key * of_key) * {TILE} + 16 * warp + g;
            const size_t at = (number - 1) * of_layer + ((size_t)key * count + low) * {WIDTH} + 8 * t;
            float sums[128];
            unsigned alive[4];
            if (!{int(AHEAD)}) read(Goes{{}}, before, before, tile, rows);
            turn(group);
            product(Goes{{}}, done, rows, sums);
            pass_on(1 - group);
            alive_of(number - 1, tile, alive);
            multiplied(sums);
            if (tile + {GROUPS} >= end) release(4, back.data, parts, all);
            else if ({int(AHEAD)}) read(Goes{{}}, before, before, tile + {GROUPS}, rows);
            float all_[64];
            #pragma unroll
            for (int q = 0; q < 8; ++q) {{
                float value[2][8];
                #pragma unroll
                for (int half = 0; half < 2; ++half) {{
                    #pragma unroll
                    for (int i = 0; i < 8; ++i) value[half][i] = sums[16 * q + i / 2 * 4 + 2 * half + i % 2];
                    masked(value[half], alive[2 * half + q / 4] << 4 * (q % 4),
                           slopes.data + at + 8 * half * {WIDTH} + 32 * q, low + 8 * half < count);
                }}
                #pragma unroll
                for (int i = 0; i < 8; ++i) all_[8 * q + i] = value[0][i] + value[1][i];
            }}
            fold(all_, own);
            if (passes(tile, end)) flush(number - 1, key, own);
        }}
    }};
    if (threadIdx.x == 0)
        for (int n = 0; n < min({SLOTS}, all); ++n) fill(n, back.data + (size_t)(n % parts) * {_PART});
    for (int begin = first; begin < last; begin += {ROUND}) {{
        const int end = min(begin + {ROUND}, last);
        top(begin, end);
        for (int number = form.layers - 1; number > 0; --number) layer(number, begin, end);
    }}
    if (group == 0) turn(0);  // the last turn that was passed on
#else
    PLACE_OF
    const size_t of_layer = (size_t)keys * count * {WIDTH};
    for (int key = 0; key < keys; ++key)
        for (int row = 0; row < count; ++row)
            for (int number = form.layers - 1; number >= 0; --number) {{
                const size_t r = (size_t)key * count + row, at = number * of_layer + r * {WIDTH};
                for (int n = 0; n < {WIDTH}; ++n) {{
                    float sum = 0.0f;
                    if (number == form.layers - 1)
                        for (int v = 0; v < {VALUES}; ++v)
                            sum += wp::half_to_float(after.data[{HEAD} * r + v]) * head.data[v * {WIDTH} + n];
                    else
                        for (int k = 0; k < {WIDTH}; ++k)
                            sum += wp::half_to_float(slopes.data[at + of_layer + k]) * wp::half_to_float(
                                back.data[(size_t)(form.layers - 2 - number) * {WIDTH * WIDTH} + place_of(k, n)]);
                    if (!(wp::half_to_float(outputs.data[at + n]) > 0.0f)) sum = 0.0f;
                    partials.data[((size_t)number * keys + key) * {GROUPS * WIDTH} + n] += sum;
                    slopes.data[at + n] = wp::float_to_half(sum);
                }}
            }}
#endif
"""

_PLACE_OF = f"""
    auto place_of = [](int k, int p) {{  // of a weight among those of its layer: the inverse of what ``pack`` does
        const int n = p / 32 * 32 + p % 8 / 2 * 8 + p % 32 / 8 * 2 + p % 2;
        const int u = k % 64 / 32 * 4 + k % 8 / 4 * 2 + k % 4 / 2;
        return k / 64 * {_PART} + n * 64 + (u ^ (n & 7)) * 8 + k % 32 / 8 * 2 + k % 2;
    }};"""


@wp.func_native(_FORWARD.replace("PLACE_OF", _PLACE_OF))
def rows_forward(
    form: Layers,
    keys: int,
    count: int,
    place: wp.array2d[wp.float16],
    forth: wp.array[wp.float16],
    shifts: wp.array3d[float],
    outputs: wp.array3d[wp.float16],
    masks: wp.array[wp.int32],
):
    """All layers of all rows of this block."""


@wp.func_native(_BACKWARD.replace("PLACE_OF", _PLACE_OF))
def rows_backward(
    form: Layers,
    keys: int,
    count: int,
    after: wp.array2d[wp.float16],
    head: wp.array2d[float],
    back: wp.array[wp.float16],
    outputs: wp.array3d[wp.float16],
    masks: wp.array[wp.int32],
    slopes: wp.array3d[wp.float16],
    partials: wp.array4d[float],
):
    """Slopes at all layers of all rows of this block, and their sums over the rows of each key."""


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 1), module="unique")
def forward(
    form: Layers,
    keys: int,
    place: wp.array2d[wp.float16],  # [N, COLUMNS] gamma(x)
    forth: wp.array[wp.float16],
    shifts: wp.array3d[float],  # [layers, k, WIDTH]
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH] of every layer, filled
    masks: wp.array[wp.int32],  # bits of what is above 0, as lanes have it; ``mask_words``; filled on CUDA
):
    """From gamma(x) to the output of the last layer, at all keys."""
    wp.tile_zeros(shape=(_FOURS,), dtype=wp.vec4, storage="shared")  # how Warp is told of shared memory
    rows_forward(form, keys, place.shape[0], place, forth, shifts, outputs, masks)


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 1), module="unique")
def backward(
    form: Layers,
    keys: int,
    after: wp.array2d[wp.float16],  # [k N, HEAD] gradient at the head
    head: wp.array2d[float],  # [VALUES, WIDTH]
    back: wp.array[wp.float16],
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH]
    masks: wp.array[wp.int32],
    slopes: wp.array3d[wp.float16],  # [layers, k N, WIDTH] gradient before every ReLU, filled
    partials: wp.array4d[float],  # [layers, k, GROUPS blocks, WIDTH] added to: sums of slopes over rows
):
    """From the gradient at the head to those of all layers."""
    wp.tile_zeros(shape=(_FOURS,), dtype=wp.vec4, storage="shared")
    rows_backward(form, keys, outputs.shape[1] // keys, after, head, back, outputs, masks, slopes, partials)
