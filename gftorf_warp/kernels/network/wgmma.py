"""The layers of a perceptron on Hopper's tensor cores, as C++ for CUDA, and row by row for the CPU.

A block of threads computes all layers of its rows. Two groups of four warps have tiles of 64 rows
each: while one multiplies, the other adds shifts, masks, rounds and stores. Blocks of 64 inputs of
the weights are copied ahead into a ring in shared memory. Rows stay out of it: a lane reads what it
stored one layer before, so groups wait for each other only before weights are overwritten. To that
end weights are packed so that a lane's share of a row, of inputs and of outputs, is eight
neighbours, 16 bytes (``perceptron.pack``). Sums over the rows of a key, the gradients of biases,
stay in registers until the key ends.

On a CPU one thread does the same row by row, float32 on halves: a reference for tests.
"""

import warp as wp

WIDTH = 256  # outputs of a layer
COLUMNS = 64  # of gamma(x), zeros included: one block of inputs
TILE = 64  # rows that a group multiplies at once
ROUND = 12  # tiles that a block takes through all layers at a time, so that they stay in cache
GROUPS = 2  # of 128 threads
BLOCK = 128 * GROUPS  # threads
HEAD = 8  # columns of the gradient at the head: 16 bytes, of which VALUES are used
VALUES = 3
ARCHITECTURE = 90  # that has these instructions; they are no part of later ones
SLOTS = 6  # of the ring
PART = 64 * WIDTH  # halves of a block of weights
_RING, _SUMS_OF_GROUPS, _BARRIERS = SLOTS * 2 * PART, GROUPS * 4 * WIDTH * 4, 64  # bytes
SHARED = _RING + _SUMS_OF_GROUPS + _BARRIERS + 16 + 1024  # bytes: these, counters, room to align

_SUMS = ", ".join(f"%{n}" for n in range(128))
_OPERANDS = ", ".join(f'"+f"(sums[{n}])' for n in range(128))
_KEPT = " ".join(f'asm volatile("" : "+f"(sums[{n}]) :: "memory");' for n in range(128))


def _multiply(add: int) -> str:
    """C++: 16 inputs of 64 rows times 256 outputs, added to ``sums`` replacing them."""
    return f"""asm volatile("{{ .reg .pred p; setp.ne.b32 p, {add}, 0; "
            "wgmma.mma_async.sync.aligned.m64n256k16.f32.f16.f16 "
            "{{{_SUMS}}}, {{%128, %129, %130, %131}}, %132, p, 1, 1, 0; }}"
            : {_OPERANDS} : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "l"(matrix) : "memory");"""


_CUDA = f"""
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5 & 3;
    // so that the compiler knows it is one per warp
    const int group = __shfl_sync(0xffffffffu, threadIdx.x >> 7, 0);
    const int g = lane >> 2, t = lane & 3;
    SIZES
    const int first = (int)((long long)tiles * blockIdx.x / gridDim.x);
    const int last = (int)((long long)tiles * (blockIdx.x + 1) / gridDim.x);
    const size_t of_layer = (size_t)keys * count * {WIDTH};
    extern __shared__ char memory[];
    const unsigned begins = (unsigned)__cvta_generic_to_shared(memory), base = (begins + 1023u)
        & ~1023u;
    float* const shared_sums = reinterpret_cast<float*>(memory + (base - begins) + {_RING}) + group
        * {4 * WIDTH};
    const unsigned barriers = base + {_RING + _SUMS_OF_GROUPS};
    unsigned* const released =
        reinterpret_cast<unsigned*>(memory + (base - begins)
            + {_RING + _SUMS_OF_GROUPS + _BARRIERS});
    // blocks of 64 inputs: of the layer before, of gamma(x)
    struct Starts {{ enum {{ H = 0, P = 1 }}; }};
    struct Goes {{ enum {{ H = 4, P = 0 }}; }};
    struct Joins {{ enum {{ H = 4, P = 1 }}; }};

    // one thread: number of the block of weights, from 0 on
    auto fill = [&](int number, const wp::half* from) {{
        const unsigned slot = number % {SLOTS}, barrier = barriers + 8 * slot;
        asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" :: "r"(barrier),
            "r"({2 * PART})
                     : "memory");
        asm volatile("cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes "
                     "[%0], [%1], %2, [%3];"
                     :: "r"(base + slot * {2 * PART}), "l"(from), "r"({2 * PART}), "r"(barrier) :
                         "memory");
    }};
    auto filled = [&](int number) {{  // wait for it
        const unsigned barrier = barriers + 8 * (number % {SLOTS}), parity = number / {SLOTS} & 1;
        unsigned there = 0;
        while (!there)
            asm volatile("{{ .reg .pred p; mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2; "
                         "selp.u32 %0, 1, 0, p; }}"
                         : "=r"(there) : "r"(barrier), "r"(parity) : "memory");
    }};
    auto group_waits = [&]() {{ asm volatile("bar.sync %0, 128;" :: "r"(1 + group) : "memory"); }};

    // the weights begin at 16 bytes times the low bits of ``matrix``
    auto begin_sums = [&](auto& sums, const auto& a, unsigned long long matrix) {{
        {_multiply(0)}
    }};
    auto multiply = [&](auto& sums, const auto& a, unsigned long long matrix) {{
        {_multiply(1)}
    }};
    // 16 inputs of rows g and g + 8 of this warp at a time; those of two are eight neighbours of
    // both rows
    auto read = [&](auto kind, const wp::half* before, const wp::half* position_, int tile,
        auto& rows) {{
        constexpr int H = decltype(kind)::H, P = decltype(kind)::P;
        const int key = tile / of_key, low = (tile - key * of_key) * {TILE} + 16 * warp + g;
        const int row = min(low, count - 1), next = min(low + 8, count - 1);
        #pragma unroll
        for (int c = 0; c < 2 * (H + P); ++c) {{
            const wp::half* from = c < 2 * H ? before + (size_t)key * count * {WIDTH} : position_;
            const int width = c < 2 * H ? {WIDTH} : {COLUMNS}, column = 8 * t + 32
                * (c < 2 * H ? c : c - 2 * H);
            const uint4 one = *reinterpret_cast<const uint4*>(from + (size_t)row * width + column);
            const uint4 two = *reinterpret_cast<const uint4*>(from + (size_t)next * width + column);
            auto& low_half = rows[2 * c];
            auto& high_half = rows[2 * c + 1];
            low_half[0] = one.x; low_half[1] = two.x; low_half[2] = one.y; low_half[3] = two.y;
            high_half[0] = one.z; high_half[1] = two.z; high_half[2] = one.w; high_half[3] = two.w;
        }}
    }};
    // all inputs of a tile; block ``number`` of the weights is its first. It runs when this returns
    auto product = [&](auto kind, int number, const auto& rows, auto& sums) {{
        constexpr int C = decltype(kind)::H + decltype(kind)::P;
        #pragma unroll
        for (int c = 0; c < C; ++c) {{
            filled(number + c);
            const unsigned address = base + (number + c) % {SLOTS} * {2 * PART};
            // rows of 128 bytes, pieces of 16 exchanged; 8 rows to the next 1,024 bytes
            const unsigned long long matrix = (address >> 4) | 1ull << 16 | 64ull << 32 | 1ull
                << 62;
            asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
            if (c == 0) begin_sums(sums, rows[0], matrix);
            else multiply(sums, rows[4 * c], matrix);
            multiply(sums, rows[4 * c + 1], matrix + 2);
            multiply(sums, rows[4 * c + 2], matrix + 4);
            multiply(sums, rows[4 * c + 3], matrix + 6);
            asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
        }}
    }};
    auto multiplied = [&](auto& sums) {{
        asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
        {_KEPT}
    }};

    // this group has multiplied by ``blocks`` weights for the last time; the second group to
    // release a layer starts other copies. A group without a tile releases all layers at once, so
    // each has a count, half of a word: what an addition finds in the other half is the only order
    // there is
    int done = 0, layers_done = 0;  // blocks of weights, and layers, that this group needs no more
    auto release = [&](int blocks, const wp::half* packed, int of_round, int all) {{
        const int sent = min(done + {SLOTS}, all);
        done += blocks;
        ++layers_done;
        group_waits();
        if ((threadIdx.x & 127) == 0) {{
            __threadfence_block();
            const unsigned counts = atomicAdd(released, group ? 65536u : 1u);
            const int of_other = group ? counts & 65535u : counts >> 16;
            if (of_other >= layers_done) {{
                __threadfence_block();
                for (int n = sent; n < min(done + {SLOTS}, all); ++n) fill(n, packed
                    + (size_t)(n % of_round) * {PART});
            }}
        }}
    }};

    if (threadIdx.x == 0) *released = 0;
    if (threadIdx.x == 0)
        for (int slot = 0; slot < {SLOTS}; ++slot)
            asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barriers + 8 * slot) :
                "memory");
    asm volatile("fence.proxy.async;" ::: "memory");
    __syncthreads();
"""

_FORWARD = f"""
#if defined(__CUDA_ARCH__)
    {_CUDA}
    const int parts = layers * 4 - 3 + (joined > 0);
    const int all = parts * ((last - first + {ROUND - 1}) / {ROUND});
    int passed = 0;  // tiles of this group in all layers so far: shifts have two buffers
    auto layer = [&](auto kind, int number, int begin, int end) {{
        constexpr int C = decltype(kind)::H + decltype(kind)::P;
        const wp::half* before = outputs.data + (number ? number - 1 : 0) * of_layer;
        wp::half* after = outputs.data + number * of_layer;
        // ``next``: there are registers for the next rows
        auto through = [&](int tile, const auto& rows, auto next) {{
            float sums[128];
            const int key = tile / of_key, row = (tile - key * of_key) * {TILE} + 16 * warp + g;
            const float2 own = __ldg(reinterpret_cast<const float2*>(
                shifts.data + ((size_t)number * keys + key) * {WIDTH}) + (threadIdx.x & 127));
            product(kind, done, rows, sums);
            float* const added = shared_sums + (passed++ & 1) * {WIDTH};
            reinterpret_cast<float2*>(added)[threadIdx.x & 127] = own;
            group_waits();  // also: no lane reads what was added two tiles ago any more
            multiplied(sums);
            if (tile + {GROUPS} >= end) release(C, forth.data, parts, all);
            wp::half* to = after + ((size_t)key * count + row) * {WIDTH} + 8 * t;
            unsigned alive[4] = {{}};
            #pragma unroll
            for (int q = 0; q < 8; ++q) {{
                if (q == 4) next();
                const float4 one = reinterpret_cast<const float4*>(added)[8 * q + 2 * t];
                const float4 two = reinterpret_cast<const float4*>(added)[8 * q + 2 * t + 1];
                const float shift[8] = {{one.x, one.y, one.z, one.w, two.x, two.y, two.z, two.w}};
                #pragma unroll
                for (int half = 0; half < 2; ++half) {{
                    unsigned out[4];
                    #pragma unroll
                    for (int j = 0; j < 4; ++j) {{
                        asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(out[j])
                            : "f"(sums[16 * q + 4 * j + 2 * half + 1] + shift[2 * j + 1]),
                              "f"(sums[16 * q + 4 * j + 2 * half] + shift[2 * j]));
                        alive[2 * half + q / 4] |= (out[j] + 0x7fff7fffu & 0x80008000u) >> (4
                            * (q % 4) + j);
                    }}
                    if (row + 8 * half < count)
                        *reinterpret_cast<uint4*>(to + 8 * half * {WIDTH} + 32 * q) =
                            make_uint4(out[0], out[1], out[2], out[3]);
                }}
            }}
            reinterpret_cast<uint4*>(masks.data)[((size_t)number * tiles + tile) * 128
                + (threadIdx.x & 127)] =
                make_uint4(alive[0], alive[1], alive[2], alive[3]);
        }};
        if (begin + group >= end) release(C, forth.data, parts, all);
        if constexpr (C == 4) {{
            if (begin + group >= end) return;
            unsigned rows[16][4];
            read(kind, before, position.data, begin + group, rows);
            for (int tile = begin + group; tile < end; tile += {GROUPS})
                through(tile, rows, [&]() {{
                    if (tile + {GROUPS} < end) read(kind, before, position.data, tile + {GROUPS},
                        rows);
                }});
        }} else {{
            for (int tile = begin + group; tile < end; tile += {GROUPS}) {{
                unsigned rows[4 * C][4];
                read(kind, before, position.data, tile, rows);
                through(tile, rows, []() {{}});
            }}
        }}
    }};
    if (threadIdx.x == 0)
        for (int n = 0; n < min({SLOTS}, all); ++n) fill(n, forth.data + (size_t)(n % parts)
            * {PART});
    for (int begin = first; begin < last; begin += {ROUND}) {{
        const int end = min(begin + {ROUND}, last);
        for (int number = 0; number < layers; ++number) {{
            if (number == 0) layer(Starts{{}}, number, begin, end);
            else if (number == joined) layer(Joins{{}}, number, begin, end);
            else layer(Goes{{}}, number, begin, end);
        }}
    }}
#else
    INDEX_OF
    const size_t of_layer = (size_t)keys * count * {WIDTH};
    for (int key = 0; key < keys; ++key)
        for (int row = 0; row < count; ++row) {{
            const wp::half* packed = forth.data;
            for (int number = 0; number < layers; ++number) {{
                const int H = number ? {WIDTH} : 0;
                const int K = H + (number == 0 || number == joined ? {COLUMNS} : 0);
                const size_t at = ((size_t)key * count + row) * {WIDTH};
                for (int n = 0; n < {WIDTH}; ++n) {{
                    float sum = shifts.data[((size_t)number * keys + key) * {WIDTH} + n];
                    for (int k = 0; k < K; ++k) {{
                        const wp::half x = k < H ? outputs.data[(number - 1) * of_layer + at + k]
                                                 : position.data[(size_t)row * {COLUMNS} + k - H];
                        sum += wp::half_to_float(x) * wp::half_to_float(packed[index_of(k, n)]);
                    }}
                    outputs.data[number * of_layer + at + n] =
                        wp::float_to_half(sum > 0.0f ? sum : 0.0f);
                }}
                packed += {WIDTH} * K;
            }}
        }}
#endif
"""

_BACKWARD = f"""
#if defined(__CUDA_ARCH__)
    {_CUDA}
    const int parts = 4 * (layers - 1), all = parts * ((last - first + {ROUND - 1}) / {ROUND});
    struct Of64 {{ enum {{ N = 32 }}; }};
    struct Of32 {{ enum {{ N = 16 }}; }};
    struct Of16 {{ enum {{ N = 8 }}; }};
    // eight gradients of a row: mask and store; ``value`` is what was stored, before it was rounded
    auto masked = [&](auto& value, unsigned alive, wp::half* to, bool there) {{
        unsigned out[4];
        #pragma unroll
        for (int j = 0; j < 4; ++j) {{
            value[2 * j] = alive << j & 0x8000u ? value[2 * j] : 0.0f;
            value[2 * j + 1] = alive << j & 0x80000000u ? value[2 * j + 1] : 0.0f;
            asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(out[j]) : "f"(value[2 * j + 1]),
                "f"(value[2 * j]));
        }}
        if (there) *reinterpret_cast<uint4*>(to) = make_uint4(out[0], out[1], out[2], out[3]);
    }};
    auto alive_of = [&](int number, int tile, auto& alive) {{  // 0 where there is no row
        #pragma unroll
        for (int half = 0; half < 2; ++half) {{
            const int row = __ldg(listed.data + tile * {TILE} + 16 * warp + g + 8 * half), key =
                max(row, 0) / of_rows;
            const int low = max(row, 0) - key * of_rows, of = low / {TILE} + key * in_key, own =
                low % {TILE};
            // which wrote it in the forward pass, in which half
            const int thread = own / 16 * 32 + own % 8 * 4 + t;
            const uint2 bits = reinterpret_cast<const uint2*>(masks.data)[
                (((size_t)number * of_key + of) * 128 + thread) * 2 + own % 16 / 8];
            alive[2 * half] = row < 0 ? 0u : bits.x; alive[2 * half + 1] = row < 0 ? 0u : bits.y;
        }}
    }};
    auto halve = [&](auto kind, auto& value) {{
        constexpr int N = decltype(kind)::N;
        const bool upper = lane & N / 2;
        #pragma unroll
        for (int i = 0; i < N; ++i) {{
            const float mine = upper ? value[N + i] : value[i], other = upper ? value[i]
                : value[N + i];
            value[i] = mine + __shfl_xor_sync(0xffffffffu, other, N / 2);
        }}
    }};
    // sums over the 16 rows of this warp: of 64 columns, eight remain with a lane, those from 32 g
    // + 8 t on
    auto fold = [&](auto& value, auto& own) {{
        halve(Of64{{}}, value);
        halve(Of32{{}}, value);
        halve(Of16{{}}, value);
        #pragma unroll
        for (int i = 0; i < 8; ++i) own[i] += value[i];
    }};
    // the sums of a finished key over the warps of this group; other rounds add to them
    auto flush = [&](int number, int key, auto& own) {{
        #pragma unroll
        for (int i = 0; i < 8; ++i) {{
            shared_sums[warp * {WIDTH} + 32 * g + 8 * t + i] = own[i];
            own[i] = 0.0f;
        }}
        group_waits();
        const size_t part = ((size_t)number * of_keys + key) * {GROUPS} * gridDim.x + {GROUPS}
        * blockIdx.x + group;
        float* const to = partials.data + part * {WIDTH};
        const float* const of_warps = shared_sums;
        for (int n = threadIdx.x & 127; n < {WIDTH}; n += 128)
            to[n] += (of_warps[n] + of_warps[{WIDTH} + n])
                + (of_warps[{2 * WIDTH} + n] + of_warps[{3 * WIDTH} + n]);
        group_waits();
    }};
    auto ends_key = [&](int tile, int end) {{  // whether this is the group's last tile of its key
        return tile + {GROUPS} >= end || key_of(tile + {GROUPS}) != key_of(tile);
    }};
    auto top = [&](int begin, int end) {{
        const int number = layers - 1;
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
                        after.data[(size_t)max(__ldg(listed.data + low + 8 * half), 0) * {HEAD}
                            + v]);
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
            if (ends_key(tile, end)) flush(number, key_of(tile), own);
        }}
    }};
    auto layer = [&](int number, int begin, int end) {{
        const wp::half* before = slopes.data + number * of_layer;
        float own[8] = {{}};
        unsigned rows[16][4];
        if (begin + group >= end) release(4, back.data, parts, all);
        else read(Goes{{}}, before, before, begin + group, rows);
        for (int tile = begin + group; tile < end; tile += {GROUPS}) {{
            const int key = tile / of_key, low = (tile - key * of_key) * {TILE} + 16 * warp + g;
            const size_t at = (number - 1) * of_layer + ((size_t)key * count + low) * {WIDTH} + 8
                * t;
            float sums[128];
            unsigned alive[4];
            product(Goes{{}}, done, rows, sums);
            alive_of(number - 1, tile, alive);
            multiplied(sums);
            if (tile + {GROUPS} >= end) release(4, back.data, parts, all);
            float all_[64];
            #pragma unroll
            for (int q = 0; q < 8; ++q) {{
                if (q == 4 && tile + {GROUPS} < end)  // there are registers for the next tile now
                    read(Goes{{}}, before, before, tile + {GROUPS}, rows);
                float value[2][8];
                #pragma unroll
                for (int half = 0; half < 2; ++half) {{
                    #pragma unroll
                    for (int i = 0; i < 8; ++i) value[half][i] =
                        sums[16 * q + i / 2 * 4 + 2 * half + i % 2];
                    masked(value[half], alive[2 * half + q / 4] << 4 * (q % 4),
                           slopes.data + at + 8 * half * {WIDTH} + 32 * q, low + 8 * half < count);
                }}
                #pragma unroll
                for (int i = 0; i < 8; ++i) all_[8 * q + i] = value[0][i] + value[1][i];
            }}
            fold(all_, own);
            if (ends_key(tile, end)) flush(number - 1, key_of(tile), own);
        }}
    }};
    if (threadIdx.x == 0)
        for (int n = 0; n < min({SLOTS}, all); ++n) fill(n, back.data + (size_t)(n % parts)
            * {PART});
    for (int begin = first; begin < last; begin += {ROUND}) {{
        const int end = min(begin + {ROUND}, last);
        top(begin, end);
        for (int number = layers - 1; number > 0; --number) layer(number, begin, end);
    }}
#else
    INDEX_OF
    const size_t of_layer = (size_t)of_keys * ((of_rows + {TILE - 1}) / {TILE}) * {TILE * WIDTH};
    for (int key = 0; key < of_keys; ++key)
        for (int r = starts.data[key]; r < starts.data[key + 1]; ++r) {{
            const int from = wp::max(listed.data[r], 0);
            const bool there = listed.data[r] >= 0;
            for (int number = layers - 1; number >= 0; --number) {{
                const size_t at = number * of_layer + (size_t)r * {WIDTH};
                for (int n = 0; n < {WIDTH}; ++n) {{
                    float sum = 0.0f;
                    if (number == layers - 1)
                        for (int v = 0; v < {VALUES}; ++v)
                            sum += wp::half_to_float(after.data[(size_t){HEAD} * from + v])
                                 * head.data[v * {WIDTH} + n];
                    else
                        for (int k = 0; k < {WIDTH}; ++k)
                            sum += wp::half_to_float(slopes.data[at + of_layer + k])
                                * wp::half_to_float(
                                back.data[(size_t)(layers - 2 - number) * {WIDTH * WIDTH}
                                    + index_of(k, n)]);
                    const size_t is = ((size_t)number * of_keys * of_rows + from) * {WIDTH} + n;
                    if (!there || !(wp::half_to_float(outputs.data[is]) > 0.0f)) sum = 0.0f;
                    partials.data[((size_t)number * of_keys + key) * {GROUPS * WIDTH} + n] += sum;
                    slopes.data[at + n] = wp::float_to_half(sum);
                }}
            }}
        }}
#endif
"""

_INDEX_OF = f"""
    // of a weight among those of its layer: the inverse of what ``pack`` does
    auto index_of = [](int k, int p) {{
        const int n = p / 32 * 32 + p % 8 / 2 * 8 + p % 32 / 8 * 2 + p % 2;
        const int u = k % 64 / 32 * 4 + k % 8 / 4 * 2 + k % 4 / 2;
        return k / 64 * {PART} + n * 64 + (u ^ (n & 7)) * 8 + k % 32 / 8 * 2 + k % 2;
    }};"""

# key by key, in order
_ALL_ROWS = f"""const int of_key = (count + {TILE - 1}) / {TILE}, tiles = keys * of_key;"""

# Listed rows, each key padded to whole tiles. Gradients are in list order, as if there were one key
# with as many rows as a list can have; everything else is in the order of the forward pass
_LISTED_ROWS = f"""const int in_key = (of_rows + {TILE - 1}) / {TILE};
    const int keys = 1, of_key = of_keys * in_key, count = {TILE} * of_key, tiles =
        starts.data[of_keys] / {TILE};
    auto key_of = [&](int tile) {{
        int key = 0;
        while (key + 1 < of_keys && {TILE} * tile >= __ldg(starts.data + key + 1)) ++key;
        return key;
    }};"""


@wp.func_native(_FORWARD.replace("SIZES", _ALL_ROWS).replace("INDEX_OF", _INDEX_OF))
def rows_forward(
    layers: int,
    joined: int,
    keys: int,
    count: int,
    position: wp.array2d[wp.float16],
    forth: wp.array[wp.float16],
    shifts: wp.array3d[float],
    outputs: wp.array3d[wp.float16],
    masks: wp.array[wp.int32],
):
    """All layers of all rows of this block."""


@wp.func_native(_BACKWARD.replace("SIZES", _LISTED_ROWS).replace("INDEX_OF", _INDEX_OF))
def listed_backward(
    layers: int,
    joined: int,
    of_keys: int,
    of_rows: int,
    listed: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    after: wp.array2d[wp.float16],
    head: wp.array2d[float],
    back: wp.array[wp.float16],
    outputs: wp.array3d[wp.float16],
    masks: wp.array[wp.int32],
    slopes: wp.array3d[wp.float16],
    partials: wp.array4d[float],
):
    """Gradients at all layers of this block's listed rows, in list order, and sums per key."""
