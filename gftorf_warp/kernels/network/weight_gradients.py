"""Weight gradients dW = d^T h over listed rows, d in list order, h in that of the forward pass.

A block of 256 threads has 128 outputs of a layer times all its inputs, 256 of the layer before or
64 of gamma(x), and a part of the list; a warp has 64 of the outputs and a quarter of the inputs in
registers. ``STAGES`` tiles of 64 rows are copied to shared memory ahead, swizzled in units of 16
bytes by the last three bits of the row. ``ldmatrix`` transposes both factors for ``mma.sync`` (PTX,
m16n8k16). parameter_gradients.py adds the parts in a fixed order. On a CPU one thread does the same
row by row in float32.
"""

import warp as wp

from .gradient_rows import NO_ROW
from .wgmma import BLOCK, COLUMNS, TILE, WIDTH

HALF = 128  # outputs of a block
HALVES = WIDTH // HALF
ALIGNED = 128  # bytes at multiples of which shared memory is used: all banks
STAGES = 4  # tiles in shared memory: one is multiplied, the others come


def shared(columns: int) -> int:
    """Bytes of shared memory for so many inputs."""
    return STAGES * TILE * 2 * (HALF + columns) + ALIGNED


def parts(multiprocessors: int, layers: int, entries: int) -> tuple[int, int, int]:
    """(parts for outputs, parts for gamma(x), multiprocessors left for these), by bytes read."""
    jobs, others = HALVES * (layers - 1), HALVES * entries
    read, also = jobs * (HALF + WIDTH), others * (HALF + COLUMNS)
    output_parts = max(multiprocessors * read // ((read + also) * jobs), 1) if jobs else 1
    left = max(multiprocessors - output_parts * jobs, 1)
    return output_parts, max(2 * left // others, 1), left


def _snippet(columns: int, layer: str, first: str, row: str) -> str:
    """C++ of a product: layer of a job, offset of its inputs, and input row of a listed row."""
    warp_inputs = columns // 4
    pieces = columns // 8  # of 16 bytes in a row
    abreast = 32 // pieces  # rows that a warp copies at once
    stage = TILE * 2 * (HALF + columns)  # bytes of a tile
    return f"""
    const int job = block % jobs, part = block / jobs, layer = {layer};
    const int tiles = begins.data[keys] / {TILE};
    const int begin = (int)((long long)tiles * part / parts), end =
        (int)((long long)tiles * (part + 1) / parts);
    const wp::half* const left = slopes.data + (size_t)layer * capacity * {WIDTH} + job % {HALVES}
    * {HALF};
    const wp::half* const right = inputs.data + (size_t){first};
    float* const to = partials.data + (size_t)block * {HALF * columns};
#if defined(__CUDA_ARCH__)
    extern __shared__ char memory[];
    const unsigned start = (unsigned)__cvta_generic_to_shared(memory), base =
        (start + {ALIGNED - 1}) & ~{ALIGNED - 1}u;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    // zeros behind ``bytes`` of 16
    auto copy = [&](unsigned to, const wp::half* from, int bytes) {{
        asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" :: "r"(to), "l"(from),
            "r"(bytes) : "memory");
    }};
    auto commit = [&]() {{ asm volatile("cp.async.commit_group;" ::: "memory"); }};
    // a warp reads rows of its number, and that plus 8, 16, ..: every lane knows one of them, of
    // four tiles
    auto rows_from = [&](int first) {{
        const int tile = first + lane / 8;
        const int row = tile < end ? __ldg(listed.data + tile * {TILE} + warp + 8 * (lane & 7))
            : {NO_ROW};
        return row < 0 ? {NO_ROW} : {row};
    }};
    // asked for long before it is needed
    int known = rows_from(begin), next = rows_from(begin + 4);
    auto fetch = [&](int tile) {{
        const int at = (tile - begin) % 4 * 8;
        if (tile > begin && at == 0) {{
            known = next;
            next = rows_from(tile + 4);
        }}
        const unsigned stage = base + tile % {STAGES} * {stage};
        #pragma unroll
        for (int i = 0; i < {TILE * HALF // 8 // BLOCK}; ++i) {{
            const int n = i * {BLOCK} + (int)threadIdx.x, k = n / {HALF // 8}, piece =
                n % {HALF // 8};
            const wp::half* const from = left + ((size_t)tile * {TILE} + k) * {WIDTH} + piece * 8;
            copy(stage + k * {2 * HALF} + (piece ^ k & 7) * 16, from, 16);
        }}
        #pragma unroll
        for (int i = 0; i < 8; i += {abreast}) {{
            const int own = i + lane / {pieces}, piece = lane % {pieces}, k = 8 * own + warp;
            const int row = __shfl_sync(0xffffffffu, known, at + own);
            const wp::half* const from = right + (size_t)max(row, 0) * {columns} + piece * 8;
            copy(stage + {TILE * 2 * HALF} + k * {2 * columns} + (piece ^ k & 7) * 16, from, row < 0
                ? 0 : 16);
        }}
    }};
    // four blocks of 8 x 8 halves whose rows begin at what lanes 0 to 7, 8 to 15, .. say, turned
    // over
    auto turned = [&](auto& four, unsigned row) {{
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {{%0, %1, %2, %3}}, [%4];"
                     : "=r"(four[0]), "=r"(four[1]), "=r"(four[2]), "=r"(four[3]) : "r"(row) :
                         "memory");
    }};
    auto multiply = [&](auto& sums, const auto& a, unsigned low, unsigned high) {{
        asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
                     "{{%0, %1, %2, %3}}, {{%4, %5, %6, %7}}, "
                     "{{%8, %9}}, {{%0, %1, %2, %3}};"
                     : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
                     : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(low), "r"(high));
    }};
    const int m = warp / 4 * 64, n = warp % 4 * {warp_inputs};  // outputs and inputs of this warp
    float sums[4][{warp_inputs // 8}][4] = {{}};
    __syncthreads();  // the last readers of this memory
    for (int tile = begin; tile < begin + {STAGES - 1}; ++tile) {{
        if (tile < end) fetch(tile);
        commit();  // also where nothing was asked for: groups are counted
    }}
    for (int tile = begin; tile < end; ++tile) {{
        asm volatile("cp.async.wait_group {STAGES - 2};" ::: "memory");
        // all copies have arrived, and no warp reads the previous tile any more
        __syncthreads();
        if (tile + {STAGES - 1} < end) fetch(tile + {STAGES - 1});
        commit();
        const unsigned stage = base + tile % {STAGES} * {stage};
        #pragma unroll
        for (int k = 0; k < {TILE}; k += 16) {{
            unsigned a[4][4], b[{warp_inputs // 16}][4];
            #pragma unroll
            // 8 rows, the next 8 of the outputs, both again 8 rows on
            for (int i = 0; i < 4; ++i) {{
                const int row = k + lane / 16 * 8 + lane % 8, piece = m / 8 + 2 * i + lane / 8 % 2;
                turned(a[i], stage + row * {2 * HALF} + (piece ^ row & 7) * 16);
            }}
            #pragma unroll
            // 8 rows, 8 rows on, both again 8 inputs on
            for (int j = 0; j < {warp_inputs // 16}; ++j) {{
                const int row = k + lane / 8 % 2 * 8 + lane % 8, piece = n / 8 + 2 * j + lane / 16;
                turned(b[j], stage + {TILE * 2 * HALF} + row * {2 * columns} + (piece ^ row & 7)
                    * 16);
            }}
            #pragma unroll
            for (int i = 0; i < 4; ++i)
                #pragma unroll
                for (int j = 0; j < {warp_inputs // 8}; ++j)
                    multiply(sums[i][j], a[i], b[j / 2][j % 2 * 2], b[j / 2][j % 2 * 2 + 1]);
        }}
    }}
    #pragma unroll
    for (int i = 0; i < 4; ++i)
        #pragma unroll
        for (int j = 0; j < {warp_inputs // 8}; ++j) {{
            float* const at = to + (m + 16 * i + lane / 4) * {columns} + n + 8 * j + lane % 4 * 2;
            *reinterpret_cast<float2*>(at) = make_float2(sums[i][j][0], sums[i][j][1]);
            *reinterpret_cast<float2*>(at + {8 * columns}) =
                make_float2(sums[i][j][2], sums[i][j][3]);
        }}
#else
    for (int n = 0; n < {HALF * columns}; ++n) to[n] = 0.0f;
    for (int at = begin * {TILE}; at < end * {TILE}; ++at) {{
        const int row = listed.data[at];
        if (row < 0) continue;
        float h[{columns}];
        for (int n = 0; n < {columns}; ++n) h[n] =
            wp::half_to_float(right[(size_t)({row}) * {columns} + n]);
        for (int m = 0; m < {HALF}; ++m) {{
            const float d = wp::half_to_float(left[(size_t)at * {WIDTH} + m]);
            for (int n = 0; n < {columns}; ++n) to[m * {columns} + n] += d * h[n];
        }}
    }}
#endif
"""


@wp.func_native(
    _snippet(WIDTH, f"1 + job / {HALVES}", f"(job / {HALVES}) * count * {WIDTH}", "row")
)
def by_outputs(
    block: int,
    jobs: int,
    parts: int,
    keys: int,
    count: int,
    capacity: int,
    listed: wp.array[wp.int32],
    begins: wp.array[wp.int32],
    slopes: wp.array3d[wp.float16],
    inputs: wp.array3d[wp.float16],
    partials: wp.array3d[float],
):
    """Slopes of half a layer times outputs of the layer before, over a part of the rows."""


@wp.func_native(_snippet(COLUMNS, f"job / {HALVES} ? joined : 0", "0", "row % count"))
def by_positions(
    block: int,
    jobs: int,
    parts: int,
    keys: int,
    count: int,
    capacity: int,
    joined: int,
    listed: wp.array[wp.int32],
    begins: wp.array[wp.int32],
    slopes: wp.array3d[wp.float16],
    inputs: wp.array2d[wp.float16],
    partials: wp.array3d[float],
):
    """Slopes of half a layer that gamma(x) enters times gamma(x), over a part of the rows."""


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 1), module="unique")
def multiply_outputs(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    keys: int,  # how many [1]
    listed: wp.array[wp.int32],  # [capacity] of ``rows.list_rows``
    begins: wp.array[wp.int32],  # [k + 1] the same
    slopes: wp.array3d[wp.float16],  # [layers, capacity, WIDTH] of listed rows
    outputs: wp.array3d[wp.float16],  # [layers, k N, WIDTH] of all rows
    # Out:
    partials: wp.array3d[float],  # [parts, (layers - 1) HALVES, HALF WIDTH] gradients by parts
):
    """One block of threads for half a layer and a part of the list."""
    # so Warp knows of it
    wp.tile_zeros(shape=(wp.static(shared(WIDTH) // 16),), dtype=wp.vec4, storage="shared")
    jobs = partials.shape[1]
    block = wp.tid() // threads
    count = outputs.shape[1]
    by_outputs(
        block,
        jobs,
        partials.shape[0],
        keys,
        count,
        slopes.shape[1],
        listed,
        begins,
        slopes,
        outputs,
        partials,
    )


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK, 2), module="unique")
def multiply_positions(
    # In:
    threads: int,  # of a block; one on a CPU [1]
    keys: int,  # how many [1]
    listed: wp.array[wp.int32],  # [capacity] of ``rows.list_rows``
    begins: wp.array[wp.int32],  # [k + 1] the same
    joined: int,  # number of the layer that gamma(x) enters again [1]
    slopes: wp.array3d[wp.float16],  # [layers, capacity, WIDTH] of listed rows
    position: wp.array2d[wp.float16],  # [N, COLUMNS] gamma(x)
    # Out:
    partials: wp.array3d[float],  # [parts, entries HALVES, HALF COLUMNS] gradients by parts
):
    """One block of threads for half a layer that gamma(x) enters and a part of the list."""
    wp.tile_zeros(shape=(wp.static(shared(COLUMNS) // 16),), dtype=wp.vec4, storage="shared")
    jobs = partials.shape[1]
    block = wp.tid() // threads
    count = position.shape[0]
    by_positions(
        block,
        jobs,
        partials.shape[0],
        keys,
        count,
        slopes.shape[1],
        joined,
        listed,
        begins,
        slopes,
        position,
        partials,
    )
