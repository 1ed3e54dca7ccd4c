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

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

ALIGNED = 8  # halves in 16 bytes: products whose rows begin at multiples of it are several times faster
LARGEST = 64.0  # gradient of an offset, in scaled units: 10 bits below the largest half, 20 above the smallest normal
SMALLEST = 1e-30  # below any gradient; keeps 0 / 0 away where there is none


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

    @property
    def columns(self) -> int:
        """Length of the rows that hold gamma(x): the next aligned one, if a weight is as wide."""
        return min(-(-self.place // ALIGNED) * ALIGNED, self.place + self.moment)


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
        factors, shifts = _rounded(form, weights, biases)
        keys, count = len(moment), len(place)
        places = place.expand(keys, count, form.columns)
        inputs: list[Tensor] = []  # of every layer behind the first, and of the head; rows of all keys
        hidden = place
        for number, weight in enumerate(weights[:-1]):
            factor = factors[number].T
            if number in (0, form.joined):
                at_moment = weight[:, weight.shape[1] - form.moment :]
                own = torch.addmm(biases[number], moment, at_moment.T).to(form.dtype)
                if number:
                    hidden = torch.cat([hidden.view(keys, count, form.width), places], dim=2)
                    inputs[-1] = hidden.flatten(0, 1)
                rows = hidden if number else places
                out = place.new_empty(keys, count, form.width)
                for key in range(keys):
                    torch._addmm_activation(own[key], rows[key], factor, use_gelu=False, out=out[key])
                hidden = out.view(keys * count, form.width)
            else:
                hidden = torch._addmm_activation(shifts[number], hidden, factor, use_gelu=False)
            inputs.append(hidden)
        context.form = form
        context.save_for_backward(place, moment, *factors, *inputs)
        offsets = _product(hidden, factors[-1].T, moment.dtype)[:, : len(biases[-1])] + biases[-1]
        return offsets.view(keys, count, len(biases[-1]))

    @staticmethod
    @once_differentiable
    def backward(context, gradient: Float[Tensor, "k N 3"]) -> tuple[Tensor | None, ...]:
        """Gradients of all parameters, in their own precision.

        Scaled by the largest gradient of an offset, which no host knows; everything up to the weights is linear in it.
        """
        form, (place, moment, *rest) = context.form, context.saved_tensors
        layers = len(rest) // 2
        factors, inputs = rest[: layers + 1], [None, *rest[layers + 1 :]]
        keys, count = len(moment), len(place)
        unit = torch.linalg.vector_norm(gradient, math.inf).clamp_min(SMALLEST) / LARGEST
        outputs = gradient.shape[-1]
        slope = place.new_zeros(keys * count, len(factors[-1]))
        torch.div(gradient.reshape(-1, outputs), unit, out=slope[:, :outputs])
        found = [gradient.sum((0, 1)) / unit, _product(slope.T, inputs[layers], moment.dtype)[:outputs]]
        for number in reversed(range(layers)):
            slope = slope @ factors[number + 1][:, : form.width]
            after = inputs[number + 1][:, : form.width]
            torch.ops.aten.threshold_backward.grad_input(slope, after, 0.0, grad_input=slope)
            if number in (0, form.joined):
                slopes = slope.view(keys, count, form.width)
                sums = slopes.sum(1, dtype=moment.dtype)
                if number:
                    at_rows = _product(slope.T, inputs[number], moment.dtype)
                else:
                    at_rows = _product(slopes[0].T, place, moment.dtype)
                    for key in range(1, keys):
                        at_rows += _product(slopes[key].T, place, moment.dtype)
                known = at_rows.shape[1] - form.columns + form.place
                found += [sums.sum(0), torch.cat([at_rows[:, :known], sums.T @ moment], dim=1)]
            else:
                found += [slope.sum(0, dtype=moment.dtype), _product(slope.T, inputs[number], moment.dtype)]
        return None, None, None, *reversed(torch._foreach_mul([value.contiguous() for value in found], unit))


def _rounded(form: Form, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]) -> tuple[list[Tensor], list[Tensor]]:
    """Copies of weights and biases as factors: without the columns of gamma(t), the head with rows of zeros below it.

    Where ``columns`` has more than gamma(x), a column of gamma(t) meets a column of zeros.
    """
    widths = [weight.shape[1] for weight in weights[:-1]]
    for number in [0] if form.joined is None else [0, form.joined]:
        widths[number] += form.columns - form.place - form.moment
    head = weights[-1].new_zeros(-(-len(weights[-1]) // ALIGNED) * ALIGNED, form.width, dtype=form.dtype)
    made = [head.new_empty(form.width, columns) for columns in widths]
    shifts = [torch.empty_like(bias, dtype=form.dtype) for bias in biases[:-1]]
    whole = [number for number, weight in enumerate(weights[:-1]) if weight.shape == made[number].shape]
    torch._foreach_copy_(
        [*(made[number] for number in whole), *shifts, head[: len(weights[-1])]],
        [*(weights[number] for number in whole), *biases[:-1], weights[-1]],
    )
    for number, factor in enumerate(made):
        if number not in whole:
            factor.copy_(weights[number][:, : factor.shape[1]])
    return [*made, head], shifts


def _product(left: Float[Tensor, "a b"], right: Float[Tensor, "b c"], dtype: torch.dtype) -> Float[Tensor, "a c"]:
    """A product whose result is not rounded to its factors' precision."""
    if left.dtype == dtype:
        return left @ right
    if left.is_cuda and hasattr(torch.ops.aten.mm, "dtype"):
        return torch.mm(left, right, out_dtype=dtype)
    return left.to(dtype) @ right.to(dtype)
