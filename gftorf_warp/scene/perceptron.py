"""The network's products in half precision: all keys stacked, bias and ReLU in the product, gradients by hand.

With a = [gamma(x), gamma(t)] the layers are

    z_n = W_n h_(n-1) + b_n,   h_n = max(z_n, 0),   h_-1 = a;   before layer ``joined`` h becomes [h, a]

What a layer makes of gamma(t) is one vector per key, a part of the bias: W a + b = W_x gamma(x) + (W_t gamma(t) + b).
Backwards, d_n being the gradient at z_n: dW_n = d_n^T h_(n-1), db_n = sum of d_n, d_(n-1) = d_n W_n where h_(n-1) > 0.

Factors are halves; sums, weights, biases with a time in them, weight gradients and results are float32. A factor beyond
65504 is infinite, and makes the gradient of a weight infinite or NaN: such a step is not sound. Positions have no
gradient. Nothing here asks the device. design/network.md has the reasons.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

ALIGNED = 8  # halves in 16 bytes: products whose rows begin at multiples of it are several times faster
LARGEST = 64.0  # gradient of an offset, in scaled units: 10 bits below the largest half, 20 above the smallest normal
SMALLEST = 1e-30  # below any gradient; keeps 0 / 0 away where there is none
PIECE = 21_120  # rows of a product at most: two full waves of 128 x 160 results on 132 multiprocessors
FOLD = 64  # rows side by side in a sum over rows, if they are so many times something
BLOCKS = 8  # into which a weight is cut to be rounded


@dataclass(frozen=True, kw_only=True)
class Form:
    """What the parameters do not say by themselves."""

    place: int
    """Values in gamma(x)."""
    moment: int
    """Values in gamma(t)."""
    width: int
    """Values in the output of a layer."""
    joined: int | None
    """Number of the layer whose input is joined by gamma(x) and gamma(t) again; None: there is none."""
    dtype: torch.dtype
    """Of the factors: float16, or that of the parameters, where the same code is exact."""
    passes: Passes | None = None
    """Who takes rows through the layers; None: :class:`Products`."""

    @property
    def columns(self) -> int:
        """Length of the rows that hold gamma(x): the next aligned one, if a weight is as wide."""
        return min(-(-self.place // ALIGNED) * ALIGNED, self.place + self.moment)

    @property
    def entries(self) -> list[int]:
        """Numbers of the layers which gamma(x) and gamma(t) enter."""
        return [0] if self.joined is None else [0, self.joined]


class Slopes(NamedTuple):
    """Gradients on their way back, as factors: all but the last are in units of ``unit``, which no host knows."""

    unit: Float[Tensor, ""]
    """Largest magnitude of a gradient of an offset over ``LARGEST``."""
    head: Float[Tensor, "rows h"]
    """At the output of the head, with zeros up to its rows."""
    layers: Float[Tensor, "layers rows width"]
    """Before the ReLU of every layer; of listed rows, where there is a list."""
    sums: Float[Tensor, "layers k width"]
    """These, summed over the rows of each key; perhaps :func:`beside`, so there behind it, or :func:`join` first."""
    head_sum: Float[Tensor, "3"]
    """Gradients of the offsets, summed over all rows."""
    listed: Int[Tensor, "capacity"] | None = None
    """Which row each of ``layers`` is of, or -1; None: all, in their order."""
    begins: Int[Tensor, "ends"] | None = None
    """Where the listed rows of each key begin, and the last one's end: behind it nothing is written."""
    partials: Float[Tensor, "layers k parts width"] | None = None
    """What ``sums`` are made of, if that happens beside: kept until who asks for memory has joined."""


@runtime_checkable
class Passes(Protocol):
    """Takes rows through the layers, and gradients back."""

    def forward(
        self,
        form: Form,
        place: Float[Tensor, "N columns"],
        moment: Float[Tensor, "k t"],
        weights: tuple[Tensor, ...],
        biases: tuple[Tensor, ...],
    ) -> tuple[Float[Tensor, "layers rows width"], Float[Tensor, "h width"], tuple[Tensor, ...]]:
        """Outputs of all layers, the weight of the head as a factor, and what ``backward`` wants of the parameters.

        Args:
            form: Sizes and precision.
            place: gamma(x) in the precision of the factors, with zeros up to ``form.columns``.
            moment: gamma(t) of every key, in the precision of the parameters.
            weights: Of every layer and the head.
            biases: The same.
        """
        ...

    def backward(
        self,
        form: Form,
        keys: int,
        gradient: Float[Tensor, "rows 3"],
        outputs: Float[Tensor, "layers rows width"],
        kept: tuple[Tensor, ...],
    ) -> Slopes:
        """What the gradient of the offsets becomes on its way back.

        Args:
            form: Sizes and precision.
            keys: Number k of keys.
            gradient: Of the offsets, in the precision of the parameters.
            outputs: Of ``forward``.
            kept: By ``forward``.
        """
        ...

    def weigh(
        self,
        form: Form,
        place: Float[Tensor, "N columns"],
        moment: Float[Tensor, "k t"],
        slopes: Slopes,
        outputs: Float[Tensor, "layers rows width"],
    ) -> list[Tensor]:
        """Gradients of weight and bias of every layer, then of the head, in the unit of the loss."""
        ...


class Products:
    """Passes as products of matrices, layer by layer."""

    def forward(
        self, form: Form, place: Tensor, moment: Tensor, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """As the protocol says."""
        factors, shifts = _rounded(form, weights, biases)
        keys, count, layers = len(moment), len(place), len(weights) - 1
        own = _of_moments(form, moment, weights, biases)
        outputs = place.new_empty(layers, keys * count, form.width)
        again = None if form.joined is None else _joined_room(form, place, keys)
        for key, begin, end in _pieces(keys, count):
            rows = slice(key * count + begin, key * count + end)
            hidden = place[begin:end]
            for number in range(layers):
                if again is not None and number == form.joined:
                    _copy(again[rows, : form.width], hidden)
                    hidden = again[rows]
                shift = own[number][key] if number in own else shifts[number]
                out = outputs[number][rows]
                torch._addmm_activation(shift, hidden, factors[number].T, use_gelu=False, out=out)
                hidden = out
        return outputs, factors[-1], tuple(factors)

    def backward(self, form: Form, keys: int, gradient: Tensor, outputs: Tensor, kept: tuple[Tensor, ...]) -> Slopes:
        """As the protocol says."""
        unit = _largest(gradient).clamp_min(SMALLEST) / LARGEST
        head = outputs.new_zeros(len(gradient), len(kept[-1]))
        torch.div(gradient, unit, out=head[:, : gradient.shape[1]])
        slopes, after = torch.empty_like(outputs), head
        for number in reversed(range(len(outputs))):
            factor, slope, before = kept[number + 1][:, : form.width], slopes[number], outputs[number]
            for key, begin, end in _pieces(keys, len(after) // keys):
                rows = slice(key * len(after) // keys + begin, key * len(after) // keys + end)
                torch.mm(after[rows], factor, out=slope[rows])
                torch.ops.aten.threshold_backward.grad_input(slope[rows], before[rows], 0.0, grad_input=slope[rows])
            after = slope
        return Slopes(unit, head, slopes, _sums(slopes, keys, gradient.dtype), _sum_rows(gradient))

    def weigh(self, form: Form, place: Tensor, moment: Tensor, slopes: Slopes, outputs: Tensor) -> list[Tensor]:
        """As the protocol says."""
        keys, found = len(moment), _Gradients(form, moment, len(outputs), slopes)
        with beside(place.device):  # small products, while one fills the device with blocks that end one by one
            found.head_bias.copy_(slopes.head_sum)
            _product(slopes.head.T, outputs[-1], moment.dtype, out=found.weights[-1])
            torch.sum(slopes.sums, 1, out=found.biases)
            places = place.new_empty(keys, len(place), form.columns)
            _copy(places, place.expand(keys, -1, -1))
            for number, weight in zip(form.entries, found.of_places(form), strict=True):
                _product(slopes.layers[number].T, places.flatten(0, 1), weight.dtype, out=weight)
            for number in form.entries:
                weight = found.weights[number]
                torch.mm(slopes.sums[number].T, moment, out=weight[:, weight.shape[1] - form.moment :])
        _products(slopes.layers[1:].mT, outputs[:-1], out=found.square)
        join(place.device)
        if form.joined is not None:
            found.weights[form.joined][:, : form.width] = found.square[form.joined - 1]
        return found.times(slopes.unit)


class Stacked(torch.autograd.Function):
    """Offsets of all Gaussians at all keys, with a gradient for parameters only."""

    @staticmethod
    def forward(
        context, form: Form, place: Float[Tensor, "N columns"], moment: Float[Tensor, "k t"], *parameters: Tensor
    ) -> Float[Tensor, "k N 3"]:
        """Offsets [m].

        Args:
            context: For the gradient.
            form: Sizes and precision.
            place: gamma(x) in the precision of the factors, with zeros up to ``form.columns``.
            moment: gamma(t) of every key, in the precision of the parameters.
            parameters: Weight and bias of every layer, then of the head.
        """
        weights, biases = parameters[0::2], parameters[1::2]
        outputs, head, kept = (form.passes or Products()).forward(form, place, moment, weights, biases)
        context.form = form
        context.save_for_backward(place, moment, *kept, outputs)
        found = _product(outputs[-1], head.T, moment.dtype)[:, : len(biases[-1])] + biases[-1]
        return found.view(len(moment), len(place), len(biases[-1]))

    @staticmethod
    @once_differentiable
    def backward(context, gradient: Float[Tensor, "k N 3"]) -> tuple[Tensor | None, ...]:
        """Gradients of all parameters, in their own precision.

        Scaled by the largest gradient of an offset, which no host knows; everything up to the weights is linear in it.
        """
        form, (place, moment, *kept, outputs) = context.form, context.saved_tensors
        passes, rows = form.passes or Products(), gradient.reshape(-1, gradient.shape[-1])
        slopes = passes.backward(form, len(moment), rows, outputs, tuple(kept))
        return None, None, None, *passes.weigh(form, place, moment, slopes, outputs)


class _Gradients:
    """Room for the gradients of all parameters in one piece, so that one kernel multiplies them.

    Parts of weights that meet outputs of layers come first, for one product; that of the joined layer, whose rows go
    on, is copied. Biases stand behind weights, the head's last: it is summed before anything is scaled.
    """

    def __init__(self, form: Form, moment: Tensor, layers: int, slopes: Slopes):
        width, wide, rows, values = form.width, form.place + form.moment, slopes.head.shape[1], len(slopes.head_sum)
        columns = [wide + (width if number else 0) for number in form.entries]
        sizes = [(layers - 1) * width * width, *(width * own for own in columns), rows * width, layers * width, values]
        self.scaled = moment.new_empty(sum(sizes))
        square, *entries, head, biases, self.head_bias = self.scaled.split(sizes)
        self.square = square.view(layers - 1, width, width)
        self.weights = [square, *self.square, head.view(rows, width)]
        for number, part in zip(form.entries, entries, strict=True):
            self.weights[number] = part.view(width, -1)
        self.biases = biases.view(layers, width)

    def of_places(self, form: Form) -> list[Tensor]:
        """What gamma(x) meets of weights, with the first column of gamma(t) where rows of gamma(x) are longer."""
        firsts = [form.width if number else 0 for number in form.entries]
        return [self.weights[n][:, first : first + form.columns] for n, first in zip(form.entries, firsts, strict=True)]

    def times(self, unit: Tensor) -> list[Tensor]:
        """Weight and bias of every layer, then of the head, in the unit of the loss."""
        values = len(self.head_bias)
        self.scaled[:-values].mul_(unit)
        biases = [*self.biases, self.head_bias]
        weights = [*self.weights[:-1], self.weights[-1][:values]]
        return [value for pair in zip(weights, biases, strict=True) for value in pair]


@functools.cache
def _second(device: torch.device) -> torch.cuda.Stream:
    """A stream for what may be done at the same time, always the same: products keep memory for every stream."""
    return torch.cuda.Stream(device)


@contextlib.contextmanager
def beside(device: torch.device, *, behind: bool = True) -> Iterator[None]:
    """Work from here on is beside what comes behind this block until :func:`join`, and behind what was beside already.

    By default it is ``behind`` everything before as well.
    """
    if device.type == "cpu":
        yield
        return
    stream = _second(device)
    if behind:
        stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        yield


def join(device: torch.device) -> None:
    """Wait for what is done beside, on the current stream."""
    if device.type != "cpu":
        torch.cuda.current_stream(device).wait_stream(_second(device))


def _pieces(keys: int, count: int) -> list[tuple[int, int, int]]:
    """Key, first and last row of the parts in which rows go through the layers: as equal as they can be."""
    parts = max(-(-count // PIECE), 1)
    ends = [count * part // parts for part in range(parts + 1)]
    return [(key, *span) for key in range(keys) for span in pairwise(ends)]


def _of_moments(
    form: Form, moment: Tensor, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
) -> dict[int, Float[Tensor, "k width"]]:
    """What every key adds in the layers which gamma(t) enters, bias included."""
    own = moment.new_empty(len(form.entries), len(moment), form.width)
    for room, number in zip(own, form.entries, strict=True):
        at_moment = weights[number][:, weights[number].shape[1] - form.moment :]
        torch.addmm(biases[number], moment, at_moment.T, out=room)
    return dict(zip(form.entries, own.to(form.dtype), strict=True))


def _joined_room(form: Form, place: Tensor, keys: int) -> Float[Tensor, "rows i"]:
    """Room for the input of the layer that is joined, gamma(x) at its end for all keys."""
    room = place.new_empty(keys * len(place), form.width + form.columns)
    _copy(room.view(keys, len(place), -1)[..., form.width :], place.expand(keys, -1, -1))
    return room


def _copy(to: Tensor, rows: Tensor) -> None:
    """Copy rows in units of 16 bytes, if both begin at multiples of it: a fraction of the time that halves take."""
    step = 16 // to.element_size()
    if all(n % step == 0 for one in (to, rows) for n in (one.shape[-1], one.storage_offset(), *one.stride()[:-1])):
        to, rows = to.view(torch.complex128), rows.view(torch.complex128)
    to.copy_(rows)


def _sums(slopes: Float[Tensor, "layers rows width"], keys: int, dtype: torch.dtype) -> Float[Tensor, "layers k width"]:
    """Sums over the rows of each key, by products with zeros and ones.

    A product of few rows with many columns fills a GPU without splitting its sum; what lies side by side is added
    later. Columns are what is contiguous: there are as many rows as 16 bytes hold.
    """
    layers, rows, width = slopes.shape
    fold = math.gcd(rows // keys, FOLD)
    choice = slopes.new_zeros(keys, rows // keys // fold, -(-keys // ALIGNED) * ALIGNED)
    choice.diagonal(dim1=0, dim2=2).fill_(1.0)
    sums = slopes.new_empty(layers, choice.shape[2], fold * width, dtype=dtype)
    _products(choice.flatten(0, 1).T.expand(layers, -1, -1), slopes.view(layers, -1, fold * width), out=sums)
    return sums.view(layers, -1, fold, width)[:, :keys].sum(2)


def _largest(values: Float[Tensor, "rows v"]) -> Float[Tensor, ""]:
    """The largest magnitude, in two steps: one block of a GPU alone would look for long."""
    parts = values.reshape(math.gcd(values.numel(), 16 * FOLD), -1)
    return torch.linalg.vector_norm(torch.linalg.vector_norm(parts, math.inf, dim=1), math.inf)


def _sum_rows(values: Float[Tensor, "rows v"]) -> Float[Tensor, "v"]:
    """The sum over rows, in two steps as well."""
    fold, width = math.gcd(len(values), FOLD), values.shape[1]
    return values.reshape(-1, fold * width).sum(0).view(fold, width).sum(0)


def _rounded(form: Form, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]) -> tuple[list[Tensor], list[Tensor]]:
    """Copies of weights and biases as factors: without the columns of gamma(t), the head with rows of zeros below it.

    Where ``columns`` has more than gamma(x), a column of gamma(t) meets a column of zeros. Whole ones are cut into
    blocks of rows, since torch gives 65,536 values of a tensor to one block of threads.
    """
    widths = [weight.shape[1] for weight in weights[:-1]]
    for number in form.entries:
        widths[number] += form.columns - form.place - form.moment
    head = weights[-1].new_zeros(-(-len(weights[-1]) // ALIGNED) * ALIGNED, form.width, dtype=form.dtype)
    made = [head.new_empty(form.width, columns) for columns in widths]
    shifts = [torch.empty_like(bias, dtype=form.dtype) for bias in biases[:-1]]
    whole = [number for number, weight in enumerate(weights[:-1]) if weight.shape == made[number].shape]
    torch._foreach_copy_(
        [*(part for number in whole for part in made[number].chunk(BLOCKS)), *shifts, head[: len(weights[-1])]],
        [*(part for number in whole for part in weights[number].chunk(BLOCKS)), *biases[:-1], weights[-1]],
    )
    for number, factor in enumerate(made):
        if number not in whole:
            factor.copy_(weights[number][:, : factor.shape[1]])
    return [*made, head], shifts


def _product(
    left: Float[Tensor, "a b"], right: Float[Tensor, "b c"], dtype: torch.dtype, *, out: Tensor | None = None
) -> Float[Tensor, "a c"]:
    """A product whose result is not rounded to its factors' precision."""
    if left.dtype == dtype:
        return torch.mm(left, right, out=out)
    if left.is_cuda and hasattr(torch.ops.aten.mm, "dtype"):
        return torch.mm(left, right, out_dtype=dtype, out=out)
    return torch.mm(left.to(dtype), right.to(dtype), out=out)


def _products(left: Float[Tensor, "n a b"], right: Float[Tensor, "n b c"], *, out: Float[Tensor, "n a c"]) -> None:
    """Several products that fill a GPU together; one after the other where their results would be rounded."""
    if left.is_cuda and left.dtype != out.dtype and hasattr(torch.ops.aten.bmm, "dtype_out"):
        torch.bmm(left, right, out_dtype=out.dtype, out=out)
        return
    for one, other, result in zip(left, right, out, strict=True):
        _product(one, other, out.dtype, out=result)
