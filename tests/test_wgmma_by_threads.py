"""What wgmma.py has for CUDA, executed by 256 fibres of the CPU: a block, its barriers and its
tensor cores.

Instructions of PTX are replaced by functions that do what they say; all else is the code that a GPU
gets. A product sees fragments and swizzled weights as wgmma does (PTX, m64n256k16), copies arrive
late, and barriers are barriers. A fibre runs until it waits, those of a warp in random order, and a
warp may rest for a while: what lacks a barrier reads what is not yet written, in the same way in
every run.
"""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from test_perceptron import half, network, positions

from gftorf_warp.kernels.network import wgmma
from gftorf_warp.render.tensor_cores import FusedLayers, packed
from gftorf_warp.scene.motion import MotionSettings

COMPILER = shutil.which("c++") or shutil.which("g++")
BLOCKS = 2
WIDTH = wgmma.WIDTH

# <algorithm>, <random> and <string> would double the time of a compilation
DEVICE = """
#include <cmath>
#include <csetjmp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ucontext.h>
#include <vector>
#define __CUDA_ARCH__ 900
#define __shared__ static
using std::max, std::min;
struct float2 { float x, y; };
struct uint2 { unsigned x, y; };
static float2 make_float2(float x, float y) { return {x, y}; }
struct alignas(16) float4 { float x, y, z, w; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
static uint4 make_uint4(unsigned a, unsigned b, unsigned c, unsigned d) { return {a, b, c, d}; }
template <class T> static T __ldg(const T* p) { return *p; }
struct Index { unsigned x; };
static Index threadIdx, blockIdx, gridDim;
// fibres: one runs until it waits for others; turns in which nothing happened are counted
static const unsigned FIBRES = 256;
static jmp_buf scheduler, fibres[FIBRES];
static ucontext_t beginnings[FIBRES];
static unsigned turns, idle;
// swapcontext would save the signal mask, two system calls for every turn
static void next_fibre() { if (!_setjmp(fibres[threadIdx.x])) _longjmp(scheduler, 1); }
static void go_on(bool begun) {
    if (_setjmp(scheduler)) return;
    if (begun) _longjmp(fibres[threadIdx.x], 1);
    setcontext(&beginnings[threadIdx.x]);
}
struct Barrier {
    unsigned size, arrived = 0, round = 0;
    void arrive_and_wait() {
        const unsigned mine = round;
        if (++arrived == size) { arrived = 0; ++round; idle = 0; }
        while (round == mine) next_fibre();
    }
};
alignas(1024) static char block_memory[MEMORY];
static size_t __cvta_generic_to_shared(const void*) { return 0; }
static Barrier whole{256}, group_barrier[2]{{128}, {128}}, of_warp[8]{{32}, {32}, {32}, {32}, {32},
    {32}, {32}, {32}};
static float told[256]; static unsigned words[256], fragments[256][4];
static void __syncthreads() { whole.arrive_and_wait(); }
static int __syncthreads_count(bool one) {
    static int sum;
    if (threadIdx.x == 0) sum = 0;
    __syncthreads(); sum += one; __syncthreads();
    const int found = sum;
    __syncthreads(); return found;
}
static void named(int number) { group_barrier[number - 1].arrive_and_wait(); }
static void meet() { of_warp[threadIdx.x >> 5].arrive_and_wait(); }
static void __threadfence_block() {}
static unsigned atomicAdd(unsigned* to, unsigned x) { const unsigned old = *to; *to += x;
return old; }
static unsigned __shfl_sync(unsigned, unsigned x, int from) {
    words[threadIdx.x] = x; meet(); const unsigned heard = words[threadIdx.x / 32 * 32 + from];
    meet(); return heard;
}
static int __shfl_xor_sync(unsigned all, int x, int by) {
    return __shfl_sync(all, x, threadIdx.x % 32 ^ by); }
static unsigned __ballot_sync(unsigned, bool one) {
    words[threadIdx.x] = one; meet();
    unsigned found = 0;
    for (unsigned n = 0; n < 32; ++n) found |= words[threadIdx.x / 32 * 32 + n] << n;
    meet(); return found;
}
static int __popc(unsigned x) { return __builtin_popcount(x); }
static float __shfl_xor_sync(unsigned, float x, int by) {
    told[threadIdx.x] = x; meet(); const float heard = told[threadIdx.x ^ by]; meet(); return heard;
}
namespace wp {
struct half { unsigned short u; };
static float of_bits(unsigned short u) {
    const unsigned e = u >> 10 & 31, m = u & 1023;
    const float finite = e ? std::ldexp(1024.0f + m, (int)e - 25) : std::ldexp((float)m, -24);
    const float size = e < 31 ? finite : m ? NAN : INFINITY;
    return u & 0x8000 ? -size : size;
}
static const std::vector<float> halves = [] {
    std::vector<float> all(1 << 16);
    for (unsigned u = 0; u < all.size(); ++u) all[u] = of_bits(u);
    return all;
}();
static float half_to_float(half h) { return halves[h.u]; }
static half float_to_half(float x) {
    const unsigned short sign = std::signbit(x) ? 0x8000 : 0;
    const float size = std::fabs(x);
    if (std::isnan(x)) return {0x7fff};
    if (size >= 65520.0f) return {(unsigned short)(sign | 0x7c00)};
    int e; std::frexp(size, &e);
    e = std::max(e, -13);
    // may round up to the next power of two
    const unsigned m = (unsigned)std::nearbyint(std::ldexp(size, 11 - e));
    return {(unsigned short)(sign | (m < 1024 ? m : ((e + 14) << 10) + (m - 1024)))};
}
template <class T> struct array_t { T* data; };
}
static unsigned packed(float high, float low) {
    return (unsigned)wp::float_to_half(high).u << 16 | wp::float_to_half(low).u;
}
static unsigned packed_relu(float high, float low) {
    return packed(high > 0 ? high : 0, low > 0 ? low : 0); }

struct Phase { unsigned done = 0, awaited = 0; };
static Phase phases[SLOTS];
struct Late { unsigned turn, to; const void* from; unsigned bytes, barrier; };
static std::vector<Late> late;
static Phase& phase_at(unsigned address) { return phases[(address - BARRIERS) / 8]; }
static void start_phases(unsigned address) { phase_at(address) = {}; }
static void expect(unsigned address, unsigned bytes) {
    if (phase_at(address).awaited) { std::puts("a slot is filled twice"); std::_Exit(1); }
    phase_at(address).awaited = bytes;
}
static void copy_late(unsigned to, const void* from, unsigned bytes, unsigned barrier) {
    static unsigned number = 0;
    late.push_back({turns + number++ * 7919 % 97, to, from, bytes, barrier});
}
static void copies_arrive() {
    for (size_t n = 0; n < late.size();) {
        const Late copy = late[n];
        if (copy.turn > turns) { ++n; continue; }
        std::memcpy(block_memory + copy.to, copy.from, copy.bytes);
        phase_at(copy.barrier).awaited = 0;
        ++phase_at(copy.barrier).done;
        late.erase(late.begin() + n);
        idle = 0;
    }
}
static unsigned is_done(unsigned barrier, unsigned parity) {
    if ((phase_at(barrier).done & 1) != parity) return 1;
    next_fibre();
    return 0;
}
// D[16 w + g (+ 8)][8 j + 2 t (+ 1)] of a group's 64 x 256, A 16 inputs of its rows, B at a
// descriptor of 128-byte rows
template <class Sums, class A> static void tensor(Sums& sums, const A& a, unsigned long long matrix,
    bool add) {
    for (int n = 0; n < 4; ++n) fragments[threadIdx.x][n] = a[n];
    meet();
    const unsigned lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3, first = threadIdx.x - lane;
    const unsigned begin = (matrix & 0x3fff) << 4, rows = begin & ~1023u, offset = begin & 127u;
    if (matrix >> 62 != 1 || (matrix >> 32 & 0x3fff) != 64) { std::puts("another layout");
    std::_Exit(1); }
    auto of = [](unsigned two, int which) {
        return wp::half_to_float({(unsigned short)(which ? two >> 16 : two)}); };
    float A_[2][16];
    for (int k = 0; k < 16; ++k) for (int half = 0; half < 2; ++half)
        A_[half][k] = of(fragments[first + 4 * g + k % 8 / 2][half + 2 * (k / 8)], k % 2);
    for (int j = 0; j < 32; ++j) for (int e = 0; e < 2; ++e) {
        const unsigned n = 8 * j + 2 * t + e;
        float low = 0, high = 0;
        for (int k = 0; k < 16; ++k) {
            const unsigned byte = offset + 2 * k, piece = (byte >> 4) ^ (n & 7);
            wp::half b;
            std::memcpy(&b, block_memory + rows + 128 * n + 16 * piece + byte % 16, 2);
            const float weight = wp::half_to_float(b);
            low += A_[0][k] * weight; high += A_[1][k] * weight;
        }
        sums[4 * j + e] = (add ? sums[4 * j + e] : 0) + low;
        sums[4 * j + 2 + e] = (add ? sums[4 * j + 2 + e] : 0) + high;
    }
    meet();
}
// copies of 16 bytes, zeros behind those asked for: some arrive at once, the others when somebody
// waits for their group
struct Copy { unsigned to; const void* from; int bytes; };
static std::vector<std::vector<Copy>> groups_of[FIBRES];  // the last one is open
static void arrive(const Copy& copy) {
    std::memset(block_memory + copy.to, 0, 16);
    std::memcpy(block_memory + copy.to, copy.from, copy.bytes);
}
static void copy_16(unsigned to, const void* from, int bytes) {
    if (to % 16 || (size_t)from % 16) { std::puts("not at 16 bytes"); std::_Exit(1); }
    if (to / 16 * 2654435761u >> 31) arrive({to, from, bytes});
    else groups_of[threadIdx.x].back().push_back({to, from, bytes});
}
static void commit_copies() { groups_of[threadIdx.x].emplace_back(); }
static void wait_copies(unsigned pending) {
    auto& groups = groups_of[threadIdx.x];
    for (; groups.size() > pending + 1; groups.erase(groups.begin()))
        for (const Copy& copy : groups.front()) arrive(copy);
}
// ldmatrix .m8n8.x4.trans: lane 8 i + r says where row r of matrix i begins; of each, a lane has
// column lane / 4, rows 2 (lane % 4) and the one behind it
static void load_turned(unsigned& a, unsigned& b, unsigned& c, unsigned& d, unsigned row) {
    if (row % 16) { std::puts("a row not at 16 bytes"); std::_Exit(1); }
    words[threadIdx.x] = row; meet();
    const unsigned lane = threadIdx.x % 32;
    unsigned* const to[4] = {&a, &b, &c, &d};
    for (int i = 0; i < 4; ++i) {
        unsigned short two[2];
        for (int e = 0; e < 2; ++e) {
            const unsigned begin = words[threadIdx.x - lane + 8 * i + 2 * (lane % 4) + e];
            std::memcpy(&two[e], block_memory + begin + 2 * (lane / 4), 2);
        }
        *to[i] = (unsigned)two[1] << 16 | two[0];
    }
    meet();
}
// mma.m16n8k16 .row.col, g = lane / 4, t = lane % 4: A has rows g, g + 8, g, g + 8 at inputs 2 t, 2
// t, 2 t + 8 and 2 t + 8, each with the next one, B inputs 2 t and 2 t + 8 of column g, D rows g
// and g + 8 of columns 2 t and 2 t + 1
static void mma_16816(float& c0, float& c1, float& c2, float& c3, unsigned a0, unsigned a1,
    unsigned a2, unsigned a3,
                      unsigned b0, unsigned b1) {
    static unsigned fragments_b[256][2];
    const unsigned own[4] = {a0, a1, a2, a3}, lane = threadIdx.x % 32, first = threadIdx.x - lane;
    for (int n = 0; n < 4; ++n) fragments[threadIdx.x][n] = own[n];
    fragments_b[threadIdx.x][0] = b0; fragments_b[threadIdx.x][1] = b1;
    meet();
    auto of = [](unsigned two, int which) {
        return wp::half_to_float({(unsigned short)(which ? two >> 16 : two)}); };
    float* const c[2][2] = {{&c0, &c1}, {&c2, &c3}};
    for (int half = 0; half < 2; ++half) for (int e = 0; e < 2; ++e) for (int k = 0; k < 16; ++k) {
        const unsigned t = k % 8 / 2, column = 2 * (lane % 4) + e;
        *c[half][e] += of(fragments[first + lane / 4 * 4 + t][half + 2 * (k / 8)], k % 2)
                     * of(fragments_b[first + 4 * column + t][k / 8], k % 2);
    }
    meet();
}
template <class T> static std::vector<T> loaded(const char* name) {
    std::FILE* file = std::fopen(name, "rb");
    std::fseek(file, 0, SEEK_END); std::vector<T> found(std::ftell(file) / sizeof(T));
    std::rewind(file);
    if (std::fread(found.data(), sizeof(T), found.size(), file) != found.size()) std::_Exit(2);
    std::fclose(file); return found;
}
template <class T> static void stored(const char* name, const std::vector<T>& what) {
    std::FILE* file = std::fopen(name, "wb");
    std::fwrite(what.data(), sizeof(T), what.size(), file); std::fclose(file);
}
template <class F> static void on_blocks(unsigned blocks, F f) {
    static F* code; static bool done[FIBRES];
    static std::vector<char> stacks((size_t)FIBRES << 18);
    srand48(blocks);
    auto random = [] { return (unsigned)mrand48(); };
    code = &f; gridDim.x = blocks;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) {
        unsigned left = FIBRES, order[FIBRES], rest[FIBRES / 32] = {};
        bool begun[FIBRES] = {};
        for (unsigned n = 0; n < FIBRES; ++n) {
            order[n] = n; done[n] = false; groups_of[n].assign(1, {});
            getcontext(&beginnings[n]);
            auto& stack = beginnings[n].uc_stack;
            stack.ss_sp = &stacks[(size_t)n << 18]; stack.ss_size = 1 << 18;
            makecontext(&beginnings[n], (void (*)())+[] { (*code)(); done[threadIdx.x] = true;
                idle = 0; _longjmp(scheduler, 1); }, 0);
        }
        for (idle = 0; left; ++turns, ++idle) {
            if (idle > 10000) { std::puts("everybody waits"); std::_Exit(1); }
            copies_arrive();
            for (unsigned& turn : rest) turn = turn ? turn - 1 : random() % 8 ? 0 : random() % 8;
            for (unsigned n = FIBRES - 1; n; --n) std::swap(order[n], order[random() % (n + 1)]);
            for (unsigned n : order) if (!done[n] && !rest[n / 32]) {
                threadIdx.x = n; go_on(begun[n]); begun[n] = true; left -= done[n];
            }
        }
    }
    while (!late.empty()) { ++turns; copies_arrive(); }
}
"""

FORWARD = """
static void rows_forward(int layers, int joined, int keys, int count,
    wp::array_t<wp::half> position,
                         wp::array_t<wp::half> forth, wp::array_t<float> shifts,
                             wp::array_t<wp::half> outputs,
                         wp::array_t<int> masks) { CODE }
int main(int, char** given) {
    const int layers = std::atoi(given[1]), joined = std::atoi(given[2]), keys =
        std::atoi(given[3]);
    const int count = std::atoi(given[4]);
    auto place = loaded<wp::half>("place"), forth = loaded<wp::half>("forth"); auto shifts =
        loaded<float>("shifts");
    std::vector<wp::half> outputs((size_t)layers * keys * count * 256);
    std::vector<int> masks((size_t)layers * keys * ((count + 63) / 64) * 512);
    on_blocks(BLOCKS, [&] {
        rows_forward(layers, joined, keys, count, {place.data()}, {forth.data()}, {shifts.data()},
            {outputs.data()},
                     {masks.data()});
    });
    stored("outputs", outputs); stored("masks", masks);
}
"""

BACKWARD = """
static void backward(int layers, int joined, int of_keys, int of_rows, wp::array_t<int> listed,
                     wp::array_t<int> starts, wp::array_t<wp::half> after, wp::array_t<float> head,
                     wp::array_t<wp::half> back, wp::array_t<wp::half> outputs,
                         wp::array_t<int> masks,
                     wp::array_t<wp::half> slopes, wp::array_t<float> partials) { CODE }
int main(int, char** given) {
    const int layers = std::atoi(given[1]), joined = std::atoi(given[2]), keys =
        std::atoi(given[3]);
    const int count = std::atoi(given[4]);
    auto after = loaded<wp::half>("after"), back = loaded<wp::half>("back"), outputs =
        loaded<wp::half>("outputs");
    auto head = loaded<float>("head");
    auto masks = loaded<int>("masks"), listed = loaded<int>("listed"), starts =
        loaded<int>("starts");
    std::vector<wp::half> slopes((size_t)layers * listed.size() * 256, wp::half{0x7e00});
    std::vector<float> partials((size_t)layers * keys * BLOCKS * 512);
    on_blocks(BLOCKS, [&] {
        backward(layers, joined, keys, count, {listed.data()}, {starts.data()}, {after.data()},
            {head.data()},
                 {back.data()}, {outputs.data()}, {masks.data()}, {slopes.data()},
                     {partials.data()});
    });
    stored("slopes", slopes); stored("partials", partials);
}
"""


def operands(statement):
    """The C++ expressions of an asm statement, in order."""
    found = []
    for start in re.finditer(r'"[=+]?[rfl]"\(', statement):
        depth, at = 1, start.end()
        while depth:
            depth += {"(": 1, ")": -1}.get(statement[at], 0)
            at += 1
        found.append(statement[start.end() : at - 1])
    return found


def for_threads(snippet):
    """The snippet with functions in place of PTX."""

    def function(match):
        text = match.group(0)
        given = operands(text)
        if "wgmma.mma_async" in text:
            add = re.search(r"setp\.ne\.b32 p, (\d), 0", text).group(1)
            return f"tensor(sums, a, matrix, {add});"
        if "cp.async.wait_group" in text:
            return f"wait_copies({re.search('wait_group ([0-9]+);', text).group(1)});"
        for instruction, call in (
            ("mbarrier.arrive.expect_tx", "expect({0}, {1});"),
            ("cp.async.bulk", "copy_late({0}, {1}, {2}, {3});"),
            ("mbarrier.try_wait", "{0} = is_done({1}, {2});"),
            ("mbarrier.init", "start_phases({0});"),
            ("bar.sync", "named({0});"),
            ("cp.async.cg", "copy_16({0}, {1}, {2});"),
            ("cp.async.commit_group", "commit_copies();"),
            ("ldmatrix.sync.aligned.m8n8.x4.trans", "load_turned({0}, {1}, {2}, {3}, {4});"),
            (
                "mma.sync.aligned.m16n8k16.row.col",
                f"mma_16816({', '.join(f'{{{n}}}' for n in range(10))});",
            ),
            ("cvt.rn.relu.f16x2", "{0} = packed_relu({1}, {2});"),
            ("cvt.rn.f16x2", "{0} = packed({1}, {2});"),
        ):
            if instruction in text:
                return call.format(*given)
        assert re.search(r'asm volatile\("(wgmma\.(fence|commit|wait)|fence\.proxy|")', text), text
        return ";"

    code = re.sub(r"asm(?: volatile)?\(.*?\);", function, snippet, flags=re.DOTALL)
    assert "asm" not in code
    return code.replace("extern __shared__ char memory[];", "char* const memory = block_memory;")


def run(folder, program, function, *numbers):
    """Compile a snippet into a program of threads and run it in its folder."""
    constants = {
        "MEMORY": wgmma.SHARED,
        "SLOTS": wgmma.SLOTS,
        "BARRIERS": wgmma._RING + wgmma._SUMS_OF_GROUPS,
    }
    defined = "".join(
        f"#define {name} {value}\n" for name, value in {**constants, "BLOCKS": BLOCKS}.items()
    )
    (folder / "block.cpp").write_text(
        defined + DEVICE + program.replace("CODE", for_threads(function.native_snippet))
    )
    subprocess.run([compiled(folder), *map(str, numbers)], cwd=folder, check=True, timeout=300)


def compiled(folder):
    """The program of a folder's block.cpp, which all tests and workers of a session compile
    once.
    """
    session = folder.parent.parent if "PYTEST_XDIST_WORKER" in os.environ else folder.parent
    program = (
        session / f"block-{hashlib.sha256((folder / 'block.cpp').read_bytes()).hexdigest()[:16]}"
    )
    with (session / f"{program.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            # a checked longjmp takes another stack for a mistake
            command = [COMPILER, "-std=c++17", "-O1", "-w", "-U_FORTIFY_SOURCE"]
            command += ["block.cpp", "-o", "block"]
            subprocess.run(command, cwd=folder, check=True, timeout=300)
            (folder / "block").rename(program)
    return program


def stored(folder, **arrays):
    """Write arrays for a program."""
    for name, array in arrays.items():
        np.ascontiguousarray(array).tofile(folder / name)


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(
    ("layers", "skip_after", "count", "keys"),
    [(8, 5, 33, 1), (3, 1, 70, 3), (6, 3, 64 * 2 * wgmma.ROUND + 65, 1)],
    ids=["a tile", "tiles of several keys", "a tile more than a round"],
)
def test_a_block_of_threads_is_row_by_row(layers, skip_after, count, keys, tmp_path):
    """Outputs of two blocks are those of the CPU's own way; nobody waits for ever. Masks:
    see test_listed_rows.py.
    """
    settings = MotionSettings(layers=layers, skip_after=skip_after)
    made = network(half(settings))
    form, place = made.backend.form, made.bind(positions(count))
    moment = made.time_encodings[:keys].float()
    both = [(layer.weight.detach(), layer.bias.detach()) for layer in [*made.layers, made.head]]
    weights, biases = (tuple(values) for values in zip(*both, strict=True))
    outputs, _, _ = FusedLayers().forward(form, place, moment, weights, biases)
    forth, _, _, shifts = packed(form, moment, weights, biases)
    numbers = layers, form.entries[-1], keys, count
    stored(tmp_path, place=place.numpy(), forth=forth.numpy(), shifts=shifts.numpy())
    run(tmp_path, FORWARD, wgmma.rows_forward, *numbers)
    found = torch.from_numpy(np.fromfile(tmp_path / "outputs", np.float16)).view_as(outputs)
    assert float(((found > 0) != (outputs > 0)).float().mean()) < 1e-3
    torch.testing.assert_close(found, outputs, rtol=2e-3, atol=2e-3)
