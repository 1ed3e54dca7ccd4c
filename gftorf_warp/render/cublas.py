"""The layers of the motion network by cuBLAS, for GPUs without kernels of ours,
and for the CPU as their reference.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from .cuda import side_stream
from .layers import ALIGNED, LARGEST, SMALLEST, Form, LayerGradients, Layers

# rows of a product at most: two full waves of 128 x 160 results on 132 multiprocessors
PIECE = 21_120
FOLD = 64  # rows side by side in a sum over rows, if their number is a multiple
BLOCKS = 8  # into which a weight is cut to be rounded


class CublasLayers(Layers):
    """Layer by layer, by torch's matrix products."""

    def forward(
        self,
        form: Form,
        position: Tensor,
        time: Tensor,
        weights: tuple[Tensor, ...],
        biases: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """As the base class says."""
        factors, shifts = _rounded(form, weights, biases)
        keys, count, layers = len(time), len(position), len(weights) - 1
        with_time = _of_times(form, time, weights, biases)
        outputs = position.new_empty(layers, keys * count, form.width)
        again = None if form.joined is None else _joined_input(form, position, keys)
        for key, begin, end in _pieces(keys, count):
            rows = slice(key * count + begin, key * count + end)
            hidden = position[begin:end]
            for number in range(layers):
                if again is not None and number == form.joined:
                    _copy(again[rows, : form.width], hidden)
                    hidden = again[rows]
                shift = with_time[number][key] if number in with_time else shifts[number]
                out = outputs[number][rows]
                torch._addmm_activation(shift, hidden, factors[number].T, use_gelu=False, out=out)
                hidden = out
        return outputs, factors[-1], tuple(factors)

    def backward(
        self, form: Form, keys: int, gradient: Tensor, outputs: Tensor, saved: tuple[Tensor, ...]
    ) -> LayerGradients:
        """As the base class says."""
        unit = _largest(gradient).clamp_min(SMALLEST) / LARGEST
        head = outputs.new_zeros(len(gradient), len(saved[-1]))
        torch.div(gradient, unit, out=head[:, : gradient.shape[1]])
        gradients, after = torch.empty_like(outputs), head
        for number in reversed(range(len(outputs))):
            factor = saved[number + 1][:, : form.width]
            slope, before = gradients[number], outputs[number]
            for key, begin, end in _pieces(keys, len(after) // keys):
                rows = slice(key * len(after) // keys + begin, key * len(after) // keys + end)
                torch.mm(after[rows], factor, out=slope[rows])
                torch.ops.aten.threshold_backward.grad_input(
                    slope[rows], before[rows], 0.0, grad_input=slope[rows]
                )
            after = slope
        return LayerGradients(
            unit, head, gradients, _sums(gradients, keys, gradient.dtype), _sum_rows(gradient)
        )

    def parameter_gradients(
        self, form: Form, position: Tensor, time: Tensor, gradients: LayerGradients, outputs: Tensor
    ) -> list[Tensor]:
        """As the base class says."""
        keys, of_parameters = len(time), _ParameterGradients(form, time, len(outputs), gradients)
        side = side_stream(position.device)
        with side.fork():  # small products, while the last blocks of the large one finish
            of_parameters.head_bias.copy_(gradients.head_sum)
            product(gradients.head.T, outputs[-1], time.dtype, out=of_parameters.weights[-1])
            torch.sum(gradients.sums, 1, out=of_parameters.biases)
            positions = position.new_empty(keys, len(position), form.columns)
            _copy(positions, position.expand(keys, -1, -1))
            for number, weight in zip(form.entries, of_parameters.of_positions(form), strict=True):
                rows = gradients.layers[number].T
                product(rows, positions.flatten(0, 1), weight.dtype, out=weight)
            for number in form.entries:
                weight = of_parameters.weights[number]
                weight = weight[:, weight.shape[1] - form.time :]
                torch.mm(gradients.sums[number].T, time, out=weight)
        _products(gradients.layers[1:].mT, outputs[:-1], out=of_parameters.square)
        side.join()
        if form.joined is not None:
            of_parameters.weights[form.joined][:, : form.width] = of_parameters.square[
                form.joined - 1
            ]
        return of_parameters.times(gradients.unit)


class _ParameterGradients:
    """One buffer for the gradients of all parameters, so that one kernel multiplies by the unit.

    Weights of outputs of layers come first, for one batched product; those of the joined layer are
    copied from there. The bias of the head is last, since it is not multiplied.
    """

    def __init__(self, form: Form, time: Tensor, layers: int, gradients: LayerGradients):
        width, rows, values = form.width, gradients.head.shape[1], len(gradients.head_sum)
        wide = form.position + form.time
        entries = [width * (wide + (width if number else 0)) for number in form.entries]
        sizes = [(layers - 1) * width * width, *entries, rows * width, layers * width, values]
        self.scaled = time.new_empty(sum(sizes))
        square, *entries, head, biases, self.head_bias = self.scaled.split(sizes)
        self.square = square.view(layers - 1, width, width)
        self.weights = [square, *self.square, head.view(rows, width)]
        for number, part in zip(form.entries, entries, strict=True):
            self.weights[number] = part.view(width, -1)
        self.biases = biases.view(layers, width)

    def of_positions(self, form: Form) -> list[Tensor]:
        """Weights of gamma(x); padding of its rows covers the first column of those of gamma(t)."""
        firsts = [form.width if number else 0 for number in form.entries]
        return [
            self.weights[n][:, first : first + form.columns]
            for n, first in zip(form.entries, firsts, strict=True)
        ]

    def times(self, unit: Tensor) -> list[Tensor]:
        """Weight and bias of every layer, then of the head, multiplied by the unit."""
        values = len(self.head_bias)
        self.scaled[:-values].mul_(unit)
        biases = [*self.biases, self.head_bias]
        weights = [*self.weights[:-1], self.weights[-1][:values]]
        return [value for pair in zip(weights, biases, strict=True) for value in pair]


def _pieces(keys: int, count: int) -> list[tuple[int, int, int]]:
    """(key, first row, end) of the pieces in which rows are multiplied, equal up to a row."""
    parts = max(-(-count // PIECE), 1)
    ends = [count * part // parts for part in range(parts + 1)]
    return [(key, *span) for key in range(keys) for span in pairwise(ends)]


def _of_times(
    form: Form, time: Tensor, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
) -> dict[int, Float[Tensor, "k width"]]:
    """Bias of every key in the layers that gamma(t) enters: W_t gamma(t) + b."""
    with_time = time.new_empty(len(form.entries), len(time), form.width)
    for out, number in zip(with_time, form.entries, strict=True):
        at_time = weights[number][:, weights[number].shape[1] - form.time :]
        torch.addmm(biases[number], time, at_time.T, out=out)
    return dict(zip(form.entries, with_time.to(form.dtype), strict=True))


def _joined_input(form: Form, position: Tensor, keys: int) -> Float[Tensor, "rows i"]:
    """Buffer for the input of the joined layer, with gamma(x) at its end for all keys."""
    joined = position.new_empty(keys * len(position), form.width + form.columns)
    _copy(joined.view(keys, len(position), -1)[..., form.width :], position.expand(keys, -1, -1))
    return joined


def _copy(to: Tensor, rows: Tensor) -> None:
    """Copy rows in units of 16 bytes, if both are aligned: faster than by halves."""
    sizes = [to.shape[-1], to.storage_offset(), *to.stride()[:-1]]
    sizes += [rows.shape[-1], rows.storage_offset(), *rows.stride()[:-1]]
    if all(size % (16 // to.element_size()) == 0 for size in sizes):
        to, rows = to.view(torch.complex128), rows.view(torch.complex128)
    to.copy_(rows)


def _sums(
    gradients: Float[Tensor, "layers rows width"], keys: int, dtype: torch.dtype
) -> Float[Tensor, "layers k width"]:
    """Sums over the rows of each key, by products with zeros and ones, padded to 16 bytes."""
    layers, rows, width = gradients.shape
    fold = math.gcd(rows // keys, FOLD)
    choice = gradients.new_zeros(keys, rows // keys // fold, -(-keys // ALIGNED) * ALIGNED)
    choice.diagonal(dim1=0, dim2=2).fill_(1.0)
    sums = gradients.new_empty(layers, choice.shape[2], fold * width, dtype=dtype)
    choices = choice.flatten(0, 1).T.expand(layers, -1, -1)
    _products(choices, gradients.view(layers, -1, fold * width), out=sums)
    return sums.view(layers, -1, fold, width)[:, :keys].sum(2)


def _largest(values: Float[Tensor, "rows v"]) -> Float[Tensor, ""]:
    """The largest magnitude, in two steps, since one thread block alone would take long."""
    parts = values.reshape(math.gcd(values.numel(), 16 * FOLD), -1)
    return torch.linalg.vector_norm(torch.linalg.vector_norm(parts, math.inf, dim=1), math.inf)


def _sum_rows(values: Float[Tensor, "rows v"]) -> Float[Tensor, "v"]:
    """The sum over rows, in two steps as well."""
    fold, width = math.gcd(len(values), FOLD), values.shape[1]
    return values.reshape(-1, fold * width).sum(0).view(fold, width).sum(0)


def _rounded(
    form: Form, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases as factors: without the columns of gamma(t), the head padded with zeros.

    Where ``columns`` exceeds gamma(x), a column of gamma(t) meets a column of zeros. Copies are cut
    into blocks of rows, since torch gives 65,536 values of a tensor to one thread block.
    """
    widths = [weight.shape[1] for weight in weights[:-1]]
    for number in form.entries:
        widths[number] += form.columns - form.position - form.time
    rows = -(-len(weights[-1]) // ALIGNED) * ALIGNED
    head = weights[-1].new_zeros(rows, form.width, dtype=form.dtype)
    made = [head.new_empty(form.width, columns) for columns in widths]
    shifts = [torch.empty_like(bias, dtype=form.dtype) for bias in biases[:-1]]
    to, given = [*shifts, head[: len(weights[-1])]], [*biases[:-1], weights[-1]]
    for factor, weight in zip(made, weights[:-1], strict=True):
        if weight.shape == factor.shape:
            to += factor.chunk(BLOCKS)
            given += weight.chunk(BLOCKS)
        else:
            factor.copy_(weight[:, : factor.shape[1]])
    torch._foreach_copy_(to, given)
    return [*made, head], shifts


def product(
    left: Float[Tensor, "a b"],
    right: Float[Tensor, "b c"],
    dtype: torch.dtype,
    *,
    out: Tensor | None = None,
) -> Float[Tensor, "a c"]:
    """A product whose result is not rounded to its factors' precision."""
    if left.dtype == dtype:
        return torch.mm(left, right, out=out)
    if left.is_cuda and hasattr(torch.ops.aten.mm, "dtype"):
        return torch.mm(left, right, out_dtype=dtype, out=out)
    return torch.mm(left.to(dtype), right.to(dtype), out=out)


def _products(
    left: Float[Tensor, "n a b"], right: Float[Tensor, "n b c"], *, out: Float[Tensor, "n a c"]
) -> None:
    """Several products, batched on a GPU unless their results would be rounded."""
    if left.is_cuda and left.dtype != out.dtype and hasattr(torch.ops.aten.bmm, "dtype_out"):
        torch.bmm(left, right, out_dtype=out.dtype, out=out)
        return
    for one, other, result in zip(left, right, out, strict=True):
        product(one, other, out.dtype, out=result)
