"""Arithmetic on the K pixels of a thread: one expression, a clang vector on the CPU, scalars on CUDA.

A compositor thread owns K consecutive pixels of a row. On the CPU K = 16 and every operation below becomes one vector
instruction, because Warp runs CPU threads one after the other and LLVM finds no parallelism by itself. On CUDA K = 1.
Each operation is written once, as a C++ expression over a type ``F``; nothing outside this file asks for the device.
"""

import functools
from types import SimpleNamespace

import warp as wp

# e^x for x <= 0. libm would be called once per lane (3.6 times slower in the forward pass): 2^n times a minimax
# polynomial of 2^f with f in [-1/2, 1/2], relative error 2.4e-7.
_EXP = """
#if defined(__CUDA_ARCH__)
    auto exp_ = [](F x) -> F { return __expf(x); };
#else
    auto exp_ = [](F x) -> F {
        const F y = __builtin_elementwise_max(x, (F)(-87.0f)) * 1.44269504f;
        const F n = __builtin_elementwise_floor(y + 0.5f), f = y - n;
        F p = f * 1.327647199e-3f + 9.675541334e-3f;
        p = p * f + 5.550713273e-2f;
        p = p * f + 2.402211972e-1f;
        p = p * f + 6.931469671e-1f;
        p = p * f + 1.0f;
        return p * (F)((__builtin_convertvector(n, I) + 127) << 23);
    };
#endif
"""

WARP_ANY = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x);
#else
    return x;
#endif
"""

WARP_MAX = """
#if defined(__CUDA_ARCH__)
    return __reduce_max_sync(0xffffffffu, x);
#else
    return x;
#endif
"""


@wp.func_native(WARP_ANY)
def warp_any(x: bool) -> bool: ...
@wp.func_native(WARP_MAX)
def warp_max(x: int) -> int: ...


def types_of(K: int) -> str:
    """C++ that defines ``F``, what an operation works on, and on the CPU ``load``, a Warp vector as an ``F``."""
    return f"""
#if defined(__CUDA_ARCH__)
    typedef float F;
#else
    typedef float F __attribute__((ext_vector_type({K})));
    typedef int I __attribute__((ext_vector_type({K})));
    auto load = [](const wp::vec_t<{K}, float>& v) -> F {{ F x; __builtin_memcpy(&x, &v, sizeof(x)); return x; }};
#endif
"""


def _elementwise(K: int, vectors: str, expression: str, prelude: str = "") -> str:
    """C++ body of an operation; ``vectors`` names its K-wide arguments, other arguments are scalars."""
    names = vectors.split()
    body = expression if "return" in expression else f"return {expression};"
    return f"""{types_of(K)}{prelude}
    auto op = [&]({", ".join("F " + v for v in names)}) -> F {{ {body} }};
    wp::vec_t<{K}, float> result;
#if defined(__CUDA_ARCH__)
    for (int lane = 0; lane < {K}; ++lane) result[lane] = op({", ".join(v + "[lane]" for v in names)});
#else
    const F value = op({", ".join(f"load({v})" for v in names)});
    __builtin_memcpy(&result, &value, sizeof(value));
#endif
    return result;
"""


def _reduction(K: int, cpu: str, start: str, step: str) -> str:
    """C++ body of a reduction of ``a`` to a scalar: ``cpu`` on the vector ``v``, or ``step`` over lanes into ``s``."""
    return f"""{types_of(K)}
#if defined(__CUDA_ARCH__)
    auto s = {start};
    for (int lane = 0; lane < {K}; ++lane) {{ {step} }}
    return s;
#else
    const F v = load(a);
    {cpu}
#endif
"""


@functools.cache
def make_lanes(K: int) -> SimpleNamespace:
    """The operations for K pixels per thread, and their type ``V``.

    Plain Warp arithmetic on 16-vectors is right too, but keeps LLVM busy for a minute and runs slower.
    """
    if K < 1 or K & (K - 1):
        raise ValueError(f"K must be a power of two, got {K}")
    V = wp.types.vector(length=K, dtype=wp.float32)

    @wp.func_native(_elementwise(K, "", "(F)(x)"))
    def fill(x: float) -> V: ...
    @wp.func_native(f"wp::vec_t<{K}, float> r; for (int c = 0; c < {K}; ++c) r[c] = x + (float)c; return r;")
    def ramp(x: float) -> V: ...
    @wp.func_native(_elementwise(K, "a", "a * s + t"))
    def affine(a: V, s: float, t: float) -> V: ...
    @wp.func_native(_elementwise(K, "a b", "a * b"))
    def mul(a: V, b: V) -> V: ...
    @wp.func_native(_elementwise(K, "a b", "a + b * s"))
    def axpy(a: V, b: V, s: float) -> V: ...
    @wp.func_native(_elementwise(K, "a b c", "a + b * c"))
    def fma(a: V, b: V, c: V) -> V: ...
    @wp.func_native(_elementwise(K, "a b c", "a - b * c"))
    def fnma(a: V, b: V, c: V) -> V: ...
    @wp.func_native(_elementwise(K, "a", "1.0f / a"))
    def inverse(a: V) -> V: ...
    @wp.func_native(_elementwise(K, "a", "a > x ? (F)(1.0f) : (F)(0.0f)"))
    def above(a: V, x: float) -> V: ...
    @wp.func_native(_elementwise(K, "a b", "b < x ? (F)(0.0f) : a"))
    def drop_below(a: V, b: V, x: float) -> V: ...
    @wp.func_native(_elementwise(K, "a mask", "mask > 0.0f ? a : (F)(0.0f)"))
    def keep_where(a: V, mask: V) -> V: ...
    @wp.func_native(_elementwise(K, "a mask", "((mask > 0.0f) & (mask < x)) ? a : (F)(0.0f)"))
    def keep_between(a: V, mask: V, x: float) -> V: ...
    @wp.func_native(_elementwise(K, "a mask", "mask > 0.0f ? (F)(x) : a"))
    def set_where(a: V, mask: V, x: float) -> V: ...
    @wp.func_native(  # exp(power) with power = half_a dx^2 - b_dy dx - c_dy; 0 where power is below ``low`` or above 0
        _elementwise(
            K,
            "dx",
            "const F p = half_a * dx * dx - b_dy * dx - c_dy; return ((p >= low) & (p <= 0.0f)) ? exp_(p) : (F)(0.0f);",
            _EXP,
        )
    )
    def response(dx: V, half_a: float, b_dy: float, c_dy: float, low: float) -> V: ...
    @wp.func_native(  # min(largest, o g) where the gate is open and that is at least ``smallest``, else 0
        _elementwise(
            K,
            "g gate",
            "const F x = o * g, a = (x < largest ? x : (F)(largest)) * gate; return a >= smallest ? a : (F)(0.0f);",
        )
    )
    def alpha_of(g: V, gate: V, o: float, largest: float, smallest: float) -> V: ...
    @wp.func_native(_reduction(K, "return __builtin_reduce_or((I)v) != 0;", "false", "s |= a[lane] != 0.0f;"))
    def nonzero(a: V) -> bool: ...
    @wp.func_native(_reduction(K, "return __builtin_reduce_max(v);", "a[0]", "s = a[lane] > s ? a[lane] : s;"))
    def largest_of(a: V) -> float: ...

    operations = {name: value for name, value in locals().items() if isinstance(value, wp.Function)}
    return SimpleNamespace(K=K, V=V, **operations)


def sums_of(K: int, vectors: list[str]) -> str:
    """C++ statements that define ``float s[..]``, the sum of each of ``vectors`` over the K pixels of a thread.

    On the CPU two vectors are folded into one, halves onto halves, until every lane is a finished sum: nine vectors of
    sixteen lanes take 18 shuffles instead of 36 dependent ones.
    """
    steps, names, group = [], [f"load({v})" for v in vectors], K
    while group > 1:
        half = group // 2
        if len(names) % 2:
            names.append("(F)(0.0f)")
        low = ", ".join(str(g + j) for g in range(0, 2 * K, group) for j in range(half))
        high = ", ".join(str(g + half + j) for g in range(0, 2 * K, group) for j in range(half))
        folded = []
        for n, (a, b) in enumerate(zip(names[::2], names[1::2], strict=True)):
            x = f"x{group}_{n}"
            steps.append(
                f"const F a{x} = {a}, b{x} = {b}, {x} = __builtin_shufflevector(a{x}, b{x}, {low})"
                f" + __builtin_shufflevector(a{x}, b{x}, {high});"
            )
            folded.append(x)
        names, group = folded, half
    store = [f"{{ const F r = {x}; __builtin_memcpy(s + {n * K}, &r, sizeof(r)); }}" for n, x in enumerate(names)]
    loops = [f"s[{n}] = 0.0f; for (int c = 0; c < {K}; ++c) s[{n}] += {v}[c];" for n, v in enumerate(vectors)]
    newline = "\n    "
    return f"""{types_of(K)}
    float s[{len(vectors) + 2 * K}];
#if defined(__CUDA_ARCH__)
    {newline.join(loops)}
#else
    {newline.join(steps + store)}
#endif
"""
