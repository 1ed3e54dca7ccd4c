"""Rounds of a warp: what CUDA executes, by 32 threads of the CPU; and on CUDA,
that rounds change nothing.
"""

import shutil
import subprocess

import pytest

from gftorf_warp.kernels.rasterise import shared_batches, simd, tile_bitmask

COMPILER = shutil.which("c++") or shutil.which("g++")

# a warp of CPU threads: a barrier for every synchronisation, so that shared memory is only as
# ordered as on CUDA
WARP = """
#include <algorithm>
#include <atomic>
#include <barrier>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <random>
#include <string>
#include <thread>
#include <vector>
#define __CUDA_ARCH__ 750
#define __align__(n) __attribute__((aligned(n)))
#define __shared__ static
struct float4 { float x, y, z, w; };
static float4 make_float4(float a, float b, float c, float d) { return {a, b, c, d}; }
static float4 __ldg(const float4* p) { return *p; }
static float __saturatef(float x) { return std::min(std::max(x, 0.0f), 1.0f); }
struct Index { unsigned x; };
static thread_local Index threadIdx;
static std::barrier<> meeting(32);
static int told[32];
static void __syncwarp() { meeting.arrive_and_wait(); }
static int __shfl_sync(unsigned, int x, int lane) {
    told[threadIdx.x] = x; __syncwarp(); const int heard = told[lane]; __syncwarp(); return heard;
}
static int __shfl_up_sync(unsigned all, int x, int by) {
    const int lane = threadIdx.x; return __shfl_sync(all, x, lane < by ? lane : lane - by);
}
static int __popc(unsigned x) { return __builtin_popcount(x); }
static int __ffsll(long long x) { return __builtin_ffsll(x); }
static unsigned __ballot_sync(unsigned all, bool x) {
    unsigned found = 0;
    told[threadIdx.x] = x; __syncwarp();
    for (int n = 0; n < 32; ++n) found |= (unsigned)told[n] << n;
    __syncwarp(); return found;
}
static void atomicAdd(float* to, float x) { std::atomic_ref<float>(*to).fetch_add(x); }
namespace wp {
typedef uint64_t uint64;
template <int N, class T> struct vec_t { T c[N]; T& operator[](int i) { return c[i]; } };
template <> struct vec_t<3, float> { float c[3]; vec_t(float x, float y, float z) : c{x, y, z} {} };
template <class T> struct array_t { T* data; };
}
typedef wp::vec_t<16, float> Splat;
typedef wp::vec_t<1, float> V;
template <class F> static void in_a_warp(F f) {
    std::vector<std::thread> threads;
    for (unsigned n = 0; n < 32; ++n) threads.emplace_back([=] { threadIdx.x = n; f((int)n); });
    for (auto& thread : threads) thread.join();
}
"""

# walk [begin, end) in both directions; print the largest error of a sum, over the sum of magnitudes
WALK = """
static double walk(int begin, int end, int step) {
    std::mt19937 random(end); std::normal_distribution<float> normal;
    std::vector<Splat> splats(200), grads(200, Splat{}), more(200, Splat{});
    std::vector<int> ids(300);
    std::vector<float> values(300 * 32 * 4), derivatives(32 * 10);
    for (auto& q : splats) for (float& x : q.c) x = 10 * normal(random);
    for (float& x : splats[0].c) x = NAN;  // no list has it, so it may be anything
    // another tile's
    for (int k = 0; k < 300; ++k) ids[k] = k >= begin && k < end ? 1 + random() % 199 : 1 << 28;
    for (float& x : values) x = normal(random);
    for (float& x : derivatives) x = normal(random);
    // v, w, w2, g_d: a third of the pixels is missed
    for (size_t n = 0; n < values.size(); n += 4) {
        const float hit = random() % 3 ? 1.0f : 0.0f;
        values[n] *= hit; values[n + 1] = std::fabs(values[n + 1]) * hit; values[n + 2] *= hit;
    }
    const wp::array_t<Splat> S{splats.data()}, G{grads.data()}, M{more.data()};
    const wp::array_t<int> I{ids.data()};
    std::atomic<int> wrong(0);
    const int start = step > 0 ? begin : end - 1, count = end - begin;
    in_a_warp([&](int lane) {
        const wp::uint64 memory = warp_memory();
        const float* d = &derivatives[10 * lane];
        int coming = 0;
        if (count > 0) {
            if (step < 0) store_derivatives(memory, V{d[0]}, V{d[1]}, V{d[2]}, V{d[3]}, V{d[4]},
                V{d[5]}, V{d[6]},
                             V{d[7]}, V{d[8]}, V{d[9]});
            fetch_records(memory, S, entry(I, start, step, 0, count), 0);
            if (step > 0) fetch_more(memory, S, entry(I, start, step, 0, count), 0);
            coming = entry(I, start, step, 16, count);
        }
        for (int at = 0; at < count; at += 16) {
            const int stop = std::min(at + 16, count);
            wait_for_records();
            if (stop < count) {
                fetch_records(memory, S, coming, stop);
                if (step > 0) fetch_more(memory, S, coming, stop);
                coming = entry(I, start, step, stop + 16, count);
            }
            for (int n = at; n < at + 16; ++n) {
                const int k = start + step * n, first = n / 4 * 4;
                const Splat q = record_of(memory, first, n - first, S, I, k, n < count), none{};
                wrong += std::memcmp(&q, n < count ? &splats[ids[k]] : &none, 64) != 0;
                if (step > 0) {
                    const auto m = more_of(memory, n, S, I, k, n < count);
                    wrong += std::memcmp(&m, (n < count ? &splats[ids[k]] : &none)->c + 8, 12) != 0;
                }
                if (n >= count || step > 0) continue;
                const float* u = &values[(k * 32 + lane) * 4];
                store_values(memory, first, n - first, V{u[0]}, V{u[1]}, V{u[2]}, V{(SLOPED ? 1
                    : u[1]) * u[3]});
            }
            if (step < 0)
                accumulate_round(memory, G, M, I, start, at, stop - at, V{40.5f + lane % 8}, V{20.5f
                    + lane / 8});
        }
        wait_for_records();
    });
    if (wrong) return 1e9;
    std::vector<double> want(200 * 32), size(200 * 32);
    for (int k = begin; step < 0 && k < end; ++k) for (int p = 0; p < 32; ++p) {
        const float *u = &values[(k * 32 + p) * 4], *d = &derivatives[10 * p];
        const double dx = splats[ids[k]][0] - (40.5 + p % 8), dy = splats[ids[k]][1]
            - (20.5 + p / 8);
        const double v = GEOMETRY ? u[0] : 0, w = CHANNELS ? u[1] : 0, w2 = LIGHT ? u[2] : 0, wd =
            LIGHT ? u[1] : 0;
        double all[16] = {v * dx, v * dy, v * dx * dx, v * dx * dy, v * dy * dy, v,
            double(GEOMETRY && u[1] > 0),
            GEOMETRY ? u[1] : 0, w * d[0], w * d[1], w * d[2], w2 * d[3], w2 * d[4], w2 * d[5],
            wd * (SPREADS ? u[3] : d[6]), 0};
        if (SLOPED) {  // by the strength, then moments of what is not clamped
            const float* q = splats[ids[k]].c;
            const float offset = std::fabs(q[12] * float(dx) + q[13] * float(dy));
            const double free = offset < q[15] ? u[3] : 0;
            const double own[5] = {u[2], free * dx, free * dy, u[3], free};
            std::copy(own, own + 5, all + 11);
        }
        for (int j = 0; j < 32; ++j) {  // a record, and that of further channels
            const double one = j < 16 ? all[j] : MORE && j >= 24 && j < 27 ? double(u[1])
                * d[j - 17] : 0;
            want[ids[k] * 32 + j] += one; size[ids[k] * 32 + j] += std::fabs(one);
        }
    }
    double worst = 0;
    for (int n = 0; n < 200 * 32; ++n) {
        const double error = std::fabs(want[n] - (n % 32 < 16 ? grads : more)[n / 32][n % 16]);
        worst = std::max(worst, size[n] > 0 ? error / size[n] : error * 1e9);
    }
    return worst;
}
void print_all() {
    const int ends[][2] = {{0, 0}, {5, 6}, {3, 19}, {0, 16}, {7, 40}, {2, 130}, {100, 277}};
    for (auto& e : ends) for (int step : {1, -1}) std::printf("%g\\n", walk(e[0], e[1], step));
}
"""

LANES = """
void print_all() {
    std::atomic<int> wrong(0);
    for (int turn = 0; turn < 20; ++turn) in_a_warp([&](int lane) {
        // rows behind the last are empty
        auto width = [=](int n) { return n < turn ? (n * 7 + turn * 5) % 11 : 0; };
        int before = 0, total = 0;
        for (int n = 0; n < 32; ++n) { before += n < lane ? width(n) : 0; total += width(n); }
        const int sums = sum_of_lanes(width(lane));
        wrong += sums != before + width(lane);
        wrong += of_lane(sums, 31) != total;
        wrong += warp_max((lane * 7 + turn * 5) % 32 - 40) != -9;
        for (int begin = 0; begin < total; begin += 32) {
            int row = 0, behind = width(0);
            while (row < 31 && behind <= begin + lane) behind += width(++row);
            wrong += lane_beyond(sums, begin + lane) != row;
        }
        const int count = 33 * turn;
        for (int wanted : {0, count / 3, count - 1, count}) {
            // the first place not before ``wanted``, as in `tile_starts`
            int low = 0, high = count;
            while (low < high) {
                const int step = (high - low + 33) / 33, place = low + (lane + 1) * step - 1;
                const int steps = lanes_with(place < high && place < wanted);
                high = std::min(high, low + (steps + 1) * step - 1);
                low += steps * step;
            }
            wrong += low != std::max(wanted, 0);
        }
    });
    std::printf("%d\\n", (int)wrong);
}
"""

# a tile's words to its list, as in `list_bits`: of no bits, of few, of all, with and without room
# for them
LISTS = f"""
static int list(int words, int share, int capacity) {{
    std::mt19937 random(words + share); std::vector<unsigned> matrix(words * {tile_bitmask.GROUP},
        ~0u);
    std::vector<int> ranks(32 * words), ids(32 * words + 1, -1), want(32 * words + 1, -1);
    for (int n = 0; n < 32 * words; ++n) ranks[n] = random();
    int total = 0;
    for (int w = 0; w < words; ++w) {{
        unsigned& word = matrix[w * {tile_bitmask.GROUP} + 3] = 0;
        for (int b = 0; b < 32; ++b) if (random() % 100 < share) {{
            word |= 1u << b;
            if (total++ < capacity) want[total - 1] = ranks[32 * w + b];
        }}
    }}
    const wp::array_t<unsigned> M{{matrix.data()}}; const wp::array_t<int> R{{ranks.data()}},
        I{{ids.data()}};
    in_a_warp([&](int lane) {{
        for (int at = 0, word = 0; at < std::min(total, capacity); word += 64) {{
            const int own = word + 2 * lane;
            const wp::uint64 found = own < words ? two_words(M, own * {tile_bitmask.GROUP} + 3) : 0;
            const int count = __builtin_popcountll(found), sums = sum_of_lanes(count);
            const int until = at + of_lane(sums, 31);
            write_ids(found, R, 32 * own, 32 * word, I, at + sums - count, at, until < capacity
                ? until : capacity);
            at = until;
        }}
    }});
    return ids != want;
}}
void print_all() {{
    for (int words : {{2, 64, 66, 256}}) for (int share : {{0, 1, 30, 100}})
        for (int capacity : {{0, 1, 100, 1 << 20}}) std::printf("%d\\n",
            list(words, share, capacity));
}}
"""

SIGNATURES = {
    "entry": "int entry(wp::array_t<int> ids, int start, int step, int at, int count)",
    "fetch_records": "void fetch_records(wp::uint64 memory, wp::array_t<Splat> splats, int i, "
    "int at)",
    "fetch_more": "void fetch_more(wp::uint64 memory, wp::array_t<Splat> records, int i, int at)",
    "more_of": "wp::vec_t<3, float> more_of(wp::uint64 memory, int at, wp::array_t<Splat> records, "
    "wp::array_t<int> ids, int k, bool there)",
    "wait_for_records": "void wait_for_records()",
    "record_of": "Splat record_of(wp::uint64 memory, int first, int n, wp::array_t<Splat> splats, "
    "wp::array_t<int> ids, int k, bool there)",
    "warp_memory": "wp::uint64 warp_memory()",
    "store_derivatives": "void store_derivatives(wp::uint64 memory, V g0, V g1, V g2, V g_re, V "
    "g_im, V g_amplitude, "
    "V g_distance, V g3, V g4, V g5)",
    "store_values": "void store_values(wp::uint64 memory, int first, int n, V v, V w, V w2, V wd)",
    "accumulate_round": "void accumulate_round(wp::uint64 memory, wp::array_t<Splat> grads, "
    "wp::array_t<Splat> more, "
    "wp::array_t<int> ids, int start, int at, int n, V x, V y)",
    "sum_of_lanes": "int sum_of_lanes(int x)",
    "of_lane": "int of_lane(int x, int lane)",
    "warp_max": "int warp_max(int x)",
    "lane_beyond": "int lane_beyond(int sums, int bound)",
    "lanes_with": "int lanes_with(bool x)",
    "two_words": "wp::uint64 two_words(wp::array_t<unsigned> bits, int index)",
    "write_ids": "void write_ids(wp::uint64 set_bits, wp::array_t<int> order, int rank, "
    "int lowest, wp::array_t<int> ids, "
    "int start, int begin, int end)",
}


def signatures_of(functions):
    """Native functions as CUDA would see them."""
    return [
        f"static {SIGNATURES[name]} {{ {function.native_snippet} }}"
        for name, function in functions.items()
    ]


def rounds_of(light, channels, geometry, spreads, more, sloped):
    """A walk over lists, for the outputs that are asked for."""
    asked = light, channels, geometry, spreads, more, sloped
    rounds = shared_batches.make_gradient_rounds(8, *asked)
    rounds = vars(shared_batches) | vars(rounds)
    functions = {name: rounds[name] for name in SIGNATURES if name in rounds}
    names = "LIGHT", "CHANNELS", "GEOMETRY", "SPREADS", "MORE", "SLOPED"
    constants = [
        f"const bool {name} = {int(value)};" for name, value in zip(names, asked, strict=True)
    ]
    return [*signatures_of(functions), *constants, WALK]


ROUNDS = [
    (True, False, True, False, False, False),
    (True, True, True, True, False, False),
    (False, True, False, False, False, False),
    (True, True, True, False, True, False),
    (True, False, True, False, False, True),
    (True, True, True, True, True, True),
]
HOMES = {
    "sum_of_lanes": simd,
    "of_lane": simd,
    "two_words": tile_bitmask,
    "write_ids": tile_bitmask,
}
OF_LANES = "sum_of_lanes", "of_lane", "warp_max", "lane_beyond", "lanes_with"


@pytest.fixture(scope="module")
def numbers_of(tmp_path_factory):
    """What a program prints: one of ROUNDS, "lanes" or "lists". All are compiled at once, since
    the headers take most of the time.
    """
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    programs = {asked: rounds_of(*asked) for asked in ROUNDS}
    functions = {name: getattr(simd, name) for name in OF_LANES}
    programs["lanes"] = [*signatures_of(functions), LANES]
    functions = {name: getattr(home, name) for name, home in HOMES.items()}
    programs["lists"] = [*signatures_of(functions), LISTS]
    parts, calls = [WARP], []
    for number, lines in enumerate(programs.values()):
        parts += [f"namespace program_{number} {{", *lines, "}"]
        calls.append(f"if (number == {number}) program_{number}::print_all();")
    main = "int main(int, char** given) {\n    const int number = std::stoi(given[1]);"
    parts += [main, *calls, "}"]
    folder = tmp_path_factory.mktemp("warp")
    (folder / "warp.cpp").write_text("\n".join(parts))
    command = [COMPILER, "-std=c++20", "-O1", "-w", "-pthread", "warp.cpp", "-o", "warp"]
    subprocess.run(command, cwd=folder, check=True, timeout=300)

    def numbers(name):
        words = [folder / "warp", str([*programs].index(name))]
        done = subprocess.run(words, check=True, timeout=120, capture_output=True, text=True)
        return [float(line) for line in done.stdout.split()]

    return numbers


@pytest.mark.parametrize("asked", ROUNDS)
def test_rounds_read_every_record_and_sum_every_pixel(asked, numbers_of):
    """Lists of no, one, 16 and many entries, in both directions; sums against float64.

    With and without light, channels, geometry, spreads, more channels and slopes.
    """
    errors = numbers_of(asked)
    assert len(errors) == 14
    assert max(errors) < 1e-6
    assert max(errors[-1:]) > 1e-9, "nothing was added"


def test_lanes_find_their_row(numbers_of):
    """Sums and the largest over lanes, the lane that a pair of a row of tiles belongs to,
    and a search by all lanes.
    """
    assert numbers_of("lanes") == [0.0]


def test_lanes_list_bits(numbers_of):
    """A warp writes the ranks of all bits that are set in order,
    and nothing behind what there is room for.
    """
    assert numbers_of("lists") == [0.0] * 64
