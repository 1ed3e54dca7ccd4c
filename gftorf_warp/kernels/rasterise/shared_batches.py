"""Splat records, and gradients of them, through shared memory: sixteen entries of a tile's list at
a time.

While a warp computes a round of ``ROUND`` entries, the records of the next one are copied to shared
memory asynchronously (cp.async), two lanes per record; every lane then reads the same record. In
the backward pass each lane stores the contributions of its pixel; for the sums over pixels, a lane
has one record and one half of the tile, a fifth of the cost of a warp reduction per record.

On a CPU records are read directly, and the other functions do nothing. All 32 lanes of a warp must
call each function together.
"""

from types import SimpleNamespace

import warp as wp

from .. import making
from .simd import make_lanes
from .splat import Splat

# entries of a list that are fetched, and whose gradients are summed, together
ROUND = wp.constant(16)
GROUP = wp.constant(4)  # of a round that are unrolled together, so that their instructions overlap
STRIDE = 36  # floats from entry to entry: 4-float reads of 8 lanes meet all 32 banks
OUT_STRIDE = 20  # the same for gradient records
PIXELS = 32  # of a tile
HIT = 1.0e30  # times the smallest weight of a pixel that is reached, 4e-9, it is far above 1

_RECORDS = 2 * ROUND * 16  # two buffers of records [floats]
_MORE = 2 * ROUND * 4  # two buffers of further channels [floats]
# adds four floats where any is not zero; slot 11 of further channels gets 0.0
_ADD4 = """auto add4 = [](float* to, float4 v, bool wanted) {
        if (!wanted || (v.x == 0.0f && v.y == 0.0f && v.z == 0.0f && v.w == 0.0f)) return;
#if __CUDA_ARCH__ >= 900
        asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
                     :: "l"(to), "f"(v.x), "f"(v.y), "f"(v.z), "f"(v.w) : "memory");
#else
        atomicAdd(to, v.x); atomicAdd(to + 1, v.y); atomicAdd(to + 2, v.z); atomicAdd(to + 3, v.w);
#endif
    };"""
_CHECK = (
    f'static_assert({ROUND} == 16 && {PIXELS} == 32, "two lanes per record, two halves of a tile");'
)


def shared_floats(values: int, derivatives: int) -> int:
    """Floats of shared memory of a warp: two buffers of records, and, in the backward pass, some
    ``values`` per pixel and entry of a round, and groups of four ``derivatives`` per pixel.
    """
    kept = max(values * ROUND * STRIDE, 2 * ROUND * OUT_STRIDE) if values else 0
    return _RECORDS + 4 * PIXELS * derivatives + kept


@making.once
def make_warp_memory(values: int = 0, derivatives: int = 0, more: bool = False) -> wp.Function:
    """Function for the start of a warp's shared memory: :func:`shared_floats`, further channels."""
    floats = shared_floats(values, derivatives) + _MORE * more

    memory_snippet = f"""
#if defined(__CUDA_ARCH__)
    {_CHECK}
    __shared__ __align__(16) float memory[{floats}];
    // the only warp: 0, but not to the register allocator
    return (wp::uint64)(memory + (threadIdx.x >> 5) * {floats});
#else
    return 0;
#endif
"""

    @wp.func_native(memory_snippet)
    def warp_memory() -> wp.uint64:
        """Where the shared memory of this warp begins."""

    return warp_memory


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int n = at + (int)((threadIdx.x & 31u) >> 1);
    return n < count ? ids.data[start + step * n] : -1;
#else
    return 0;
#endif
""")
def entry(ids: wp.array[int], start: int, step: int, at: int, count: int) -> int:
    """Splat that this lane fetches for the round from entry ``at`` of ``count`` on; -1: none."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const unsigned lane = threadIdx.x & 31u;  // a pair of lanes fetches a record, 32 bytes each
    const float4* from = reinterpret_cast<const float4*>(splats.data + (i < 0 ? 0 : i)) + 2
        * (lane & 1u);
    float4* to = reinterpret_cast<float4*>(memory) + (at / {ROUND} & 1) * {4 * ROUND} + 2 * lane;
#if __CUDA_ARCH__ >= 800
    const unsigned target = (unsigned)__cvta_generic_to_shared(to), bytes = i < 0 ? 0u : 16u;
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" :: "r"(target), "l"(from),
        "r"(bytes) : "memory");
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;"
                 :: "r"(target + 16), "l"(from + 1), "r"(bytes) : "memory");
#else
    const float4 none = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    to[0] = i < 0 ? none : __ldg(from);
    to[1] = i < 0 ? none : __ldg(from + 1);
#endif
#endif
""")
def fetch_records(memory: wp.uint64, splats: wp.array[Splat], i: int, at: int):
    """Start copying this lane's record ``i`` of the round at entry ``at``; -1: harmless zeros."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const unsigned lane = threadIdx.x & 31u;
    if (lane & 1u) return;  // 16 bytes of a record, the channels, are one lane's work
    const float4* from = reinterpret_cast<const float4*>(records.data + (i < 0 ? 0 : i)) + 2;
    float4* to = reinterpret_cast<float4*>(memory) + {_RECORDS // 4} + (at & {2 * ROUND - 1})
        + (lane >> 1);
#if __CUDA_ARCH__ >= 800
    const unsigned target = (unsigned)__cvta_generic_to_shared(to), bytes = i < 0 ? 0u : 16u;
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" :: "r"(target), "l"(from),
        "r"(bytes) : "memory");
#else
    to[0] = i < 0 ? make_float4(0.0f, 0.0f, 0.0f, 0.0f) : __ldg(from);
#endif
#endif
""")
def fetch_more(memory: wp.uint64, records: wp.array[Splat], i: int, at: int):
    """As :func:`fetch_records`, slots 8-10 of other records; zeros, since NaN times 0 is NaN."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_all;" ::: "memory");
#endif
    // the records of all lanes have arrived, and no lane reads the previous round any more
    __syncwarp();
#endif
""")
def wait_for_records():
    """Wait for the records that are being copied."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const float4* line = reinterpret_cast<const float4*>(memory) + (first & {2 * ROUND - 1}) * 4 + n
        * 4;
    wp::vec_t<16, float> record;
    for (int part = 0; part < 4; ++part) {{
        const float4 four = line[part];
        record[4 * part] = four.x; record[4 * part + 1] = four.y;
        record[4 * part + 2] = four.z; record[4 * part + 3] = four.w;
    }}
    return record;
#else
    return there ? splats.data[ids.data[k]] : wp::vec_t<16, float>(0.0f);
#endif
""")
def record_of(
    memory: wp.uint64,
    first: int,
    n: int,
    splats: wp.array[Splat],
    ids: wp.array[int],
    k: int,
    there: bool,
) -> Splat:
    """Record of entry ``n`` of the group from entry ``first`` on; on the CPU that of pair ``k``."""


@wp.func_native(
    f"""
#if defined(__CUDA_ARCH__)
    const float4 four = (reinterpret_cast<const float4*>(memory) + {_RECORDS // 4})[at
        & {2 * ROUND - 1}];
    return wp::vec_t<3, float>(four.x, four.y, four.z);
#else
    if (!there) return wp::vec_t<3, float>(0.0f);
    const Splat& q = records.data[ids.data[k]];
    return wp::vec_t<3, float>(q[8], q[9], q[10]);
#endif
""".replace("Splat&", "wp::vec_t<16, float>&")
)
def more_of(
    memory: wp.uint64, at: int, records: wp.array[Splat], ids: wp.array[int], k: int, there: bool
) -> wp.vec3:
    """The further channels of entry ``at``, which is number ``k`` of the pairs."""


@making.once
def make_gradient_rounds(
    tile_width: int,
    light: bool,
    channels: bool,
    geometry: bool,
    spreads: bool,
    more: bool = False,
    sloped: bool = False,
) -> SimpleNamespace:
    """Functions that sum the gradients of a round over the 32 pixels of a tile, one per lane.

    Args:
        tile_width: Columns of a tile [px]; each half of its 32 pixels is whole rows.
        light: Whether the light has gradients.
        channels: Whether the three channels have.
        geometry: Whether centre, conic and opacity have.
        spreads: Whether the distortion has, and with it the distance one per entry.
        more: Whether three further channels have gradients, in other records.
        sloped: Whether each pixel of a splat has its own distance, and with it its own light:
            then ``w2`` is the derivative by the strength, ``wd`` that by the distance.
    """
    half = PIXELS // 2
    if half % tile_width:
        raise ValueError(f"half of a tile must be whole rows, got {tile_width} columns")
    V = make_lanes(1).V
    # values per pixel and entry
    sloped = sloped and light
    kept = ["w"] + ["v"] * geometry + ["w2"] * light + ["wd"] * (spreads or sloped)
    by_pixel = light and not sloped  # whether the light's derivatives are those of the pixel
    derivatives = by_pixel + channels + more
    floats = shared_floats(len(kept), derivatives)
    kept_at = _RECORDS + 4 * PIXELS * derivatives
    places = f"""
    float* const mine = reinterpret_cast<float*>(memory);
    float* const kept = mine + {kept_at};
    const int lane = (int)(threadIdx.x & 31u);"""

    derivatives_snippet = f"""
#if defined(__CUDA_ARCH__)
    float4* const to = reinterpret_cast<float4*>(memory) + {_RECORDS // 4} + (threadIdx.x & 31u);
    {"to[0] = make_float4(g_re[0], g_im[0], g_amplitude[0], g_distance[0]);" if by_pixel else ""}
    {f"to[{PIXELS * by_pixel}] = make_float4(g0[0], g1[0], g2[0], 0.0f);" if channels else ""}
    {f"to[{PIXELS * (derivatives - 1)}] = make_float4(g3[0], g4[0], g5[0], 0.0f);" if more else ""}
#endif
"""

    @wp.func_native(derivatives_snippet)
    def store_derivatives(
        memory: wp.uint64,
        g0: V,
        g1: V,
        g2: V,
        g_re: V,
        g_im: V,
        g_amplitude: V,
        g_distance: V,
        g3: V,
        g4: V,
        g5: V,
    ):
        """Store the derivatives by this lane's pixel; read after the next barrier."""

    stores = [f"to[{n * ROUND * STRIDE}] = {name}[0];" for n, name in enumerate(kept)]

    values_snippet = f"""
#if defined(__CUDA_ARCH__)
    float* const kept = reinterpret_cast<float*>(memory) + {kept_at};
    float* const to = kept + ((first & {ROUND - 1}) + n) * {STRIDE} + (threadIdx.x & 31u);
    {" ".join(stores)}
#endif
"""

    @wp.func_native(values_snippet)
    def store_values(memory: wp.uint64, first: int, n: int, v: V, w: V, w2: V, wd: V):
        """Store this pixel's values for entry ``n`` of the group from entry ``first`` on."""

    take = "\n        ".join(
        f"const float4 {name}4 = from[{(n * ROUND * STRIDE) // 4} + part];"
        f" const float {name}_[4] = {{{name}4.x, {name}4.y, {name}4.z, {name}4.w}};"
        for n, name in enumerate(kept)
    )
    moments = f"""
            const float vx = v_[j] * dx[c]; row0 += v_[j]; row1 += vx; row2 += vx * dx[c];
            if (c == {tile_width - 1}) {{
                sums[0] += row1; sums[1] += row0 * dy; sums[2] += row2; sums[3] += row1 * dy;
                sums[4] += row0 * dy * dy; sums[5] += row0; row0 = row1 = row2 = 0.0f; dy -= 1.0f;
            }}
            sums[6] += __saturatef(w_[j] * {HIT}f); sums[7] += w_[j];"""
    lit = f"""
            const float4 g = pixel[4 * part + j];
            sums[11] += w2_[j] * g.x; sums[12] += w2_[j] * g.y; sums[13] += w2_[j] * g.z;
            sums[14] += {"wd_[j]" if spreads else "w_[j] * g.w"};"""
    # before the moments, which change dy
    by_distance = """
            const float free = fabsf(q[12] * dx[c] + q[13] * dy) < q[15] ? wd_[j] : 0.0f;
            sums[11] += w2_[j]; sums[12] += free * dx[c]; sums[13] += free * dy;
            sums[14] += wd_[j]; sums[15] += free;"""
    coloured = f"""
            const float4 h = pixel[{PIXELS * by_pixel} + 4 * part + j];
            sums[8] += w_[j] * h.x; sums[9] += w_[j] * h.y; sums[10] += w_[j] * h.z;"""
    further = f"""
            const float4 m = pixel[{PIXELS * (derivatives - 1)} + 4 * part + j];
            more0 += w_[j] * m.x; more1 += w_[j] * m.y; more2 += w_[j] * m.z;"""
    terms = by_distance * sloped
    terms += moments * geometry + coloured * channels + further * more + lit * by_pixel
    add_more = f"""
    const float4 m0 = *reinterpret_cast<const float4*>(kept + s * {OUT_STRIDE} + 16);
    const float4 m1 = *reinterpret_cast<const float4*>(kept + s * {OUT_STRIDE} + 16
        + {ROUND * OUT_STRIDE});
    add4(reinterpret_cast<float*>(more.data + i) + 8,
         make_float4(m0.x + m1.x, m0.y + m1.y, m0.z + m1.z, 0.0f), upper == 0 && s < n);
"""
    round_snippet = f"""
#if defined(__CUDA_ARCH__)
    {places}
    {_ADD4}
    // this lane sums entry s of the round over one half of the tile
    const int s = lane & 15, upper = lane >> 4;
    const int i = ids.data[start - at - (s < n ? s : n - 1)];
    __syncwarp();  // the values of all lanes are stored
    const float* const q = mine + ((at + s) & {2 * ROUND - 1}) * 16;
    float dx[{tile_width}];
    for (int c = 0; c < {tile_width}; ++c)
        dx[c] = q[0] - (x[0] - (float)(lane % {tile_width}) + (float)c);
    float dy = q[1] - (y[0] - (float)(lane / {tile_width}) + (float)(upper * {half // tile_width}));
    float sums[16] = {{}}, row0 = 0.0f, row1 = 0.0f, row2 = 0.0f, more0 = 0.0f, more1 = 0.0f,
        more2 = 0.0f;
    const float4* const from = reinterpret_cast<const float4*>(kept + s * {STRIDE} + upper
        * {half});
    const float4* const pixel = reinterpret_cast<const float4*>(mine) + {_RECORDS // 4} + upper
        * {half};
    #pragma unroll
    for (int part = 0; part < {half // 4}; ++part) {{
        {take}
        #pragma unroll
        for (int j = 0; j < 4; ++j) {{
            const int c = (4 * part + j) % {tile_width};{terms}
        }}
    }}
    __syncwarp();  // all values have been read: the sums of both halves overwrite them
    float4* const out = reinterpret_cast<float4*>(kept + (upper * {ROUND} + s) * {OUT_STRIDE});
    #pragma unroll
    for (int part = 0; part < 4; ++part)
        out[part] = make_float4(sums[4 * part], sums[4 * part + 1], sums[4 * part + 2],
            sums[4 * part + 3]);
    {"out[4] = make_float4(more0, more1, more2, 0.0f);" if more else ""}
    __syncwarp();  // all sums are there; four lanes add one 64-byte line
    #pragma unroll
    for (int eighth = 0; eighth < 2; ++eighth) {{
        const int of = 8 * eighth + (lane >> 2), quarter = lane & 3, to =
            __shfl_sync(0xffffffffu, i, of);
        const float4* const both = reinterpret_cast<const float4*>(kept + of * {OUT_STRIDE})
            + quarter;
        const float4 a = both[0], b = both[{ROUND * OUT_STRIDE // 4}];
        add4(reinterpret_cast<float*>(grads.data + to) + 4 * quarter,
             make_float4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w), of < n);
    }}
    {add_more if more else ""}
    __syncwarp();  // the next round may store its values
#endif
"""

    @wp.func_native(round_snippet)
    def accumulate_round(
        memory: wp.uint64, grads: wp.array[Splat], more: wp.array[Splat], ids: wp.array[int],
        start: int, at: int, n: int, x: V, y: V,
    ):  # fmt: skip
        """Add the ``n`` entries of the round from entry ``at`` on, summed over pixels."""

    return SimpleNamespace(
        warp_memory=make_warp_memory(len(kept), derivatives),
        store_derivatives=store_derivatives,
        store_values=store_values,
        accumulate_round=accumulate_round,
        floats=floats,
    )
