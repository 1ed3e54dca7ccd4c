"""SIMD arithmetic on the K pixels of a thread: one expression, a clang vector on the CPU, scalars
on CUDA.

A compositor thread owns a block of K pixels: on the CPU K = 16, a block of 4 x 4, and an operation
is one vector instruction; on CUDA K = 1. Each operation is one C++ expression over a type ``F``.
"""

import math
from types import SimpleNamespace

import warp as wp

from .. import making

# e^x for -87 < x <= 0 without libm's call per lane (3.6 times slower): 2^n times a minimax
# polynomial of 2^f, f in [-1/2, 1/2], error 2.4e-7. Adding 1.5 * 2^23 rounds to an integer.
_EXP = """
    auto exp_ = [](F x) -> F {
        const F y = x * 1.44269504f, shifted = y + 12582912.0f, f = y - (shifted - 12582912.0f);
        F p = f * 1.327647199e-3f + 9.675541334e-3f;
        p = p * f + 5.550713273e-2f;
        p = p * f + 2.402211972e-1f;
        p = p * f + 6.931469671e-1f;
        p = p * f + 1.0f;
        I bits, n;
        __builtin_memcpy(&bits, &p, sizeof(p));
        __builtin_memcpy(&n, &shifted, sizeof(p));
        bits += n << 23;
        __builtin_memcpy(&p, &bits, sizeof(p));
        return p;
    };
"""

# 1 / x by the processor's 14-bit estimate and one Newton step, 2 ulp; a 16-lane division takes four
# times as long
_INVERSE = """
#if defined(__AVX512F__)
    auto inverse_ = [](F x) -> F {
        F r = (F)__builtin_ia32_rcp14ps512_mask(x, (F)(0.0f), (unsigned short)-1);
        return r * (2.0f - x * r);
    };
#else
    auto inverse_ = [](F x) -> F { return 1.0f / x; };
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
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, x);
#else
    for (int half = 16; half > 0; half /= 2) {
        const int other = __shfl_sync(0xffffffffu, x, (int)(threadIdx.x & 31u) ^ half);
        if (other > x) x = other;
    }
#endif
#endif
    return x;
"""


@wp.func_native(WARP_ANY)
def warp_any(x: bool) -> bool:
    """Whether ``x`` holds for any lane of the warp; on the CPU a thread is alone."""


@wp.func_native(WARP_MAX)
def warp_max(x: int) -> int:
    """Largest ``x`` of the lanes of the warp; on the CPU a thread is alone."""


_SUM_OF_LANES = """
#if defined(__CUDA_ARCH__)
    for (int distance = 1; distance < 32; distance *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, x, distance);
        if ((int)(threadIdx.x & 31u) >= distance) x += other;
    }
#endif
    return x;
"""

_OF_LANE = """
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, lane);
#else
    return x;
#endif
"""

_LANES_WITH = """
#if defined(__CUDA_ARCH__)
    return __popc(__ballot_sync(0xffffffffu, x));
#else
    return x;
#endif
"""

_LANE_BEYOND = """
    int low = 0;
#if defined(__CUDA_ARCH__)
    for (int half = 16; half > 0; half /= 2)
        if (__shfl_sync(0xffffffffu, sums, low + half - 1) <= bound) low += half;
#endif
    return low;
"""


@wp.func_native(_SUM_OF_LANES)
def sum_of_lanes(x: int) -> int:
    """Sum of ``x`` of this lane and of all before it; on the CPU a thread is alone."""


@wp.func_native(_LANES_WITH)
def lanes_with(x: bool) -> int:
    """Number of lanes of the warp for which ``x`` holds; on the CPU a thread is alone."""


@wp.func_native(_OF_LANE)
def of_lane(x: int, lane: int) -> int:
    """What ``x`` is in another lane."""


@wp.func_native(_LANE_BEYOND)
def lane_beyond(sums: int, bound: int) -> int:
    """First lane whose ``sums``, ascending with the lane, exceeds ``bound``; else the last lane."""


def types_of(K: int) -> str:
    """C++ that defines the type ``F``, and ``load`` and ``store`` from and to a Warp vector."""
    if K == 1:
        return """
    typedef float F;
    auto load = [](const wp::vec_t<1, float>& v) -> F { return v[0]; };
    auto store = [](F x) { wp::vec_t<1, float> v; v[0] = x; return v; };"""
    return f"""
    typedef float F __attribute__((ext_vector_type({K})));
    typedef int I __attribute__((ext_vector_type({K})));
    auto load = [](const wp::vec_t<{K}, float>& v) -> F {{ F x; __builtin_memcpy(&x, &v, sizeof(x));
    return x; }};
    auto store = [](F x) {{ wp::vec_t<{K}, float> v; __builtin_memcpy(&v, &x, sizeof(x)); return v;
    }};"""


def elementwise(K: int, vectors: str, expression: str, prelude: str = "") -> str:
    """C++ body of an operation; ``vectors`` names its K-wide arguments, the others are scalars."""
    names = vectors.split()
    body = expression if "return" in expression else f"return {expression};"
    return f"""{types_of(K)}{prelude}
    auto op = [&]({", ".join("F " + v for v in names)}) -> F {{ {body} }};
    return store(op({", ".join(f"load({v})" for v in names)}));
"""


def _reduction(K: int, scalar: str, vector: str) -> str:
    """C++ body of a reduction of ``a``: of its only value ``v``, or of the clang vector ``v``."""
    return f"""{types_of(K)}
    const F v = load(a);
    {scalar if K == 1 else vector}
"""


def contracted() -> dict:
    """Module options: contraction to fused multiply-adds on the CPU, 10-20 % faster."""
    flags = wp.config.cpu_compiler_flags
    flags = "-march=native" if flags is None else flags
    return {"cpu_compiler_flags": flags + " -ffp-contract=fast"}


@making.once
def make_lanes(K: int) -> SimpleNamespace:
    """Operations on K pixels and their type ``V``; Warp's 16-vectors compile for a minute."""
    if K not in (1, 16):
        raise ValueError(f"K must be 1 (CUDA) or 16 (CPU), got {K}")
    V, side = wp.types.vector(length=K, dtype=wp.float32), math.isqrt(K)
    exp = "auto exp_ = [](F x) -> F { return expf(x); };" if K == 1 else _EXP

    @wp.func_native(elementwise(K, "", "(F)(x)"))
    def fill(x: float) -> V: ...
    @wp.func_native(
        f"wp::vec_t<{K}, float> r; for (int c = 0; c < {K}; ++c) r[c] = x + "
        f"(float)(c % {side}); return r;"
    )
    def columns(x: float) -> V: ...
    @wp.func_native(
        f"wp::vec_t<{K}, float> r; for (int c = 0; c < {K}; ++c) r[c] = y + "
        f"(float)(c / {side}); return r;"
    )
    def rows(y: float) -> V: ...
    @wp.func_native(elementwise(K, "a", "a * s + t"))
    def affine(a: V, s: float, t: float) -> V: ...
    @wp.func_native(elementwise(K, "a", "a * s"))
    def scaled(a: V, s: float) -> V: ...
    @wp.func_native(elementwise(K, "a b", "b < a ? (F)(1.0f) : (F)(0.0f)"))
    def exceeds(a: V, b: V) -> V: ...
    @wp.func_native(elementwise(K, "a b", "a * b"))
    def mul(a: V, b: V) -> V: ...
    @wp.func_native(elementwise(K, "a b", "a + b"))
    def add(a: V, b: V) -> V: ...
    @wp.func_native(elementwise(K, "a", "a < x ? (F)(x) : a"))
    def at_least(a: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "a b", "a + b * s"))
    def axpy(a: V, b: V, s: float) -> V: ...
    @wp.func_native(elementwise(K, "a b c", "a + b * c"))
    def fma(a: V, b: V, c: V) -> V: ...
    @wp.func_native(elementwise(K, "a b c", "a - b * c"))
    def fnma(a: V, b: V, c: V) -> V: ...
    @wp.func_native(
        elementwise(K, "a", "1.0f / a" if K == 1 else "inverse_(a)", "" if K == 1 else _INVERSE)
    )
    def inverse(a: V) -> V: ...
    @wp.func_native(elementwise(K, "a", "a > x ? (F)(1.0f) : (F)(0.0f)"))
    def above(a: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "a b", "b < x ? (F)(0.0f) : a"))
    def drop_below(a: V, b: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "a b", "b < x ? a : (F)(0.0f)"))
    def keep_below(a: V, b: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "a", "a >= x ? (F)(1.0f) : (F)(0.0f)"))
    def reaches(a: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "a mask", "mask > 0.0f ? (F)(x) : a"))
    def set_where(a: V, mask: V, x: float) -> V: ...
    @wp.func_native(elementwise(K, "dx dy", "(dx * p + dy * q) * dx + (dy * r) * dy"))
    def power_of(dx: V, dy: V, p: float, q: float, r: float) -> V: ...
    @wp.func_native(
        elementwise(K, "power gate", "((power > low) & (gate > 0.0f)) ? (F)(1.0f) : (F)(0.0f)")
    )
    def hits(power: V, gate: V, low: float) -> V: ...
    @wp.func_native(elementwise(K, "power hit", "hit > 0.0f ? exp_(power) : (F)(0.0f)", exp))
    def response(power: V, hit: V) -> V: ...
    @wp.func_native(  # min(largest, o e^power) where it hits, else 0
        elementwise(
            K,
            "power hit",
            "const F x = o * exp_(power), a = x < largest ? x : (F)(largest); return hit > 0.0f "
            "? a : (F)(0.0f);",
            exp,
        )
    )
    def alpha_of(power: V, hit: V, o: float, largest: float) -> V: ...
    @wp.func_native(elementwise(K, "a before after b", "((before >= x) & (after < x)) ? b : a"))
    def where_crossed(a: V, before: V, after: V, b: V, x: float) -> V: ...
    @wp.func_native(_reduction(K, "return v != 0.0f;", "return __builtin_reduce_or((I)v) != 0;"))
    def nonzero(a: V) -> bool: ...
    @wp.func_native(_reduction(K, "return v;", "return __builtin_reduce_max(v);"))
    def largest_of(a: V) -> float: ...

    operations = {name: value for name, value in locals().items() if isinstance(value, wp.Function)}
    return SimpleNamespace(K=K, V=V, side=side, **operations)


def sums_of(K: int, values: dict[str, str]) -> tuple[str, list[str]]:
    """C++ that sums ``values``, expressions of type ``F`` by name, over the K pixels; their order.

    On CUDA sums are ``float s[..]``. On the CPU they are the lanes of ``F total``, '' an empty one:
    vectors are folded in pairs, halves onto halves, evaluated just before to stay in registers.
    """
    if K == 1:
        return f"const float s[{len(values)}] = {{{', '.join(values.values())}}};", list(values)
    if len(values) > K:
        raise ValueError(f"{len(values)} sums do not fit into {K} lanes")
    names, owners = list(values.values()), [[name] * K for name in values]

    def fold(
        a: str, b: str, owner_a: list[str], owner_b: list[str], group: int
    ) -> tuple[str, list[str], str]:
        """The statement that folds two vectors, the lanes of the result, and its name."""
        half = group // 2
        stay = [lane if lane % group < half else K + lane for lane in range(K)]
        move = [lane + half if lane % group < half else K + lane - half for lane in range(K)]
        name = f"x{len(lines)}"
        parts = [
            f"__builtin_shufflevector(a{name}, b{name}, {', '.join(map(str, way))})"
            for way in (stay, move)
        ]
        statement = f"const F a{name} = {a}, b{name} = {b}, {name} = {parts[0]} + {parts[1]};"
        return (
            statement,
            [owner_a[lane] if lane % group < half else owner_b[lane] for lane in range(K)],
            name,
        )

    lines: list[str] = []
    # group size -> a vector that waits for its partner
    waiting: dict[int, tuple[str, list[str]]] = {}

    def push(name: str, owner: list[str], group: int) -> None:
        """Fold a vector with the one waiting at its level, and the result one level up."""
        if group > 1 and group not in waiting:
            waiting[group] = name, owner
        elif group > 1:
            other, other_owner = waiting.pop(group)
            statement, lanes, folded = fold(other, name, other_owner, owner, group)
            lines.append(statement)
            push(folded, lanes, group // 2)
        else:
            waiting[1] = name, owner

    for name, owner in zip(names, owners, strict=True):
        push(name, owner, K)
    while list(waiting) != [1]:
        push("(F)(0.0f)", [""] * K, max(group for group in waiting if group > 1))
    total, lanes = waiting[1]
    return "\n    ".join([*lines, f"const F total = {total};"]), lanes
