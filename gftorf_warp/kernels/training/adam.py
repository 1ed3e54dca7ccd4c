"""Adam over many tensors in one launch, with all that changes between steps in device memory.

    m += (1 - b1) (g - m),   v += (1 - b2) (g^2 - v)
    x -= rate / (1 - b1^t)  m / (sqrt(v / (1 - b2^t)) + eps)

(Kingma and Ba, 2015). Step t and learning rate are per tensor. A tensor of rate 0 is left alone, t
included; so are all tensors if the step is invalid (``step_end.py``).

A table holds the addresses of the tensors; without a gradient (0) it is left alone, too. Up to four
gradients of a tensor, of as many images, are summed in order and scaled first.
"""

import warp as wp

from .. import making

PARAMETER, GRADIENT, FIRST, SECOND, STEP, LENGTH, MORE = range(7)  # columns of the table
GRADIENTS = 4  # of a tensor, which are summed: one at ``GRADIENT``, others from ``MORE`` on
COLUMNS = MORE + GRADIENTS - 1
SIZES = 3  # step size, 1 / sqrt of the bias correction, gradient scale: see ``ADVANCE``

ADVANCE = f"""
    const long long* row = table.data + {COLUMNS} * tensor;
    float* out = sizes.data + {SIZES} * tensor;
    out[0] = 0.0f;
    if (rate == 0.0f || row[{GRADIENT}] == 0) return;
    const double step = reinterpret_cast<float*>(row[{STEP}])[0] + 1.0f;
    out[0] = (float)((double)rate / (1.0 - pow((double)beta1, step)));
    out[1] = (float)(1.0 / sqrt(1.0 - pow((double)beta2, step)));
"""
"""C++ of ``step_end.finish``: the step size of a tensor, 0 if it is left alone."""

COUNT = f"""
    float* out = sizes.data + {SIZES} * tensor;
    if (!valid) out[0] = 0.0f;
    if (out[0] == 0.0f) return;
    reinterpret_cast<float*>(table.data[{COLUMNS} * tensor + {STEP}])[0] += 1.0f;
    out[2] = factor;
"""
"""C++ of ``step_end.finish``, after ``ADVANCE``: count the step of a tensor, if it is valid."""


def _descend(K: int) -> str:
    """C++: one block of K elements; nothing behind the end of a tensor is read or written."""
    kind = f"typedef float F{f' __attribute__((ext_vector_type({K})))' if K > 1 else ''};"
    root = "__builtin_elementwise_sqrt(v)" if K > 1 else "sqrtf(v)"
    at = "F v = 0.0f; __builtin_memcpy(&v, p, bytes); return v;" if K > 1 else "return *p;"
    put = "__builtin_memcpy(p, &v, bytes);" if K > 1 else "*p = v;"
    return f"""
    {kind}
    const long long* row = table.data + {COLUMNS} * tensor;
    const float* sizes_ = sizes.data + {SIZES} * tensor;
    const float size = sizes_[0], root_scale = sizes_[1];
    if (size == 0.0f) return;
    const long long begin = (long long)block * {K}, left = row[{LENGTH}] - begin;
    const unsigned long bytes = (left < {K} ? left : {K}) * sizeof(float);
    auto at = [&](const float* p) -> F {{ {at} }};
    auto put = [&](float* p, F v) {{ {put} }};
    float* x_ = reinterpret_cast<float*>(row[{PARAMETER}]) + begin;
    float* m_ = reinterpret_cast<float*>(row[{FIRST}]) + begin;
    float* v_ = reinterpret_cast<float*>(row[{SECOND}]) + begin;
    F g = at(reinterpret_cast<const float*>(row[{GRADIENT}]) + begin);
    for (int n = {MORE}; n < {COLUMNS} && row[n] != 0; ++n) g +=
        at(reinterpret_cast<const float*>(row[n]) + begin);
    g *= sizes_[2];
    F m = at(m_), v = at(v_);
    m += rest1 * (g - m);
    v += rest2 * (g * g - v);
    put(m_, m);
    put(v_, v);
    put(x_, at(x_) - size * m / ({root} * root_scale + epsilon));
"""


@making.once
def make_adam(K: int):
    """The kernel that works on K elements per thread: 1 on CUDA, 16 on the CPU."""

    @wp.func_native(_descend(K))
    def descend(
        table: wp.array2d[wp.int64],
        tensor: int,
        block: int,
        sizes: wp.array2d[float],
        rest1: float,
        rest2: float,
        epsilon: float,
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def adam(
        # In:
        table: wp.array2d[wp.int64],  # [T, 9] addresses and lengths, see above
        first_block: wp.array[int],  # [T] blocks before those of a tensor [1]
        rest1: float,  # 1 - b1 [1]
        rest2: float,  # 1 - b2 [1]
        epsilon: float,  # added to the root of the second moment [units of the gradient]
        # Out:
        sizes: wp.array2d[float],  # [T, 3] from ``step_end.py``; tensors change in place
    ):
        """One thread per block of K elements; changes parameters and moments where they are."""
        block = wp.tid()
        low = int(0)
        high = int(first_block.shape[0])
        while high - low > 1:  # the last tensor that begins at this block or before
            middle = (low + high) // 2
            if first_block[middle] <= block:
                low = middle
            else:
                high = middle
        descend(table, low, block - first_block[low], sizes, rest1, rest2, epsilon)

    return adam
