"""The layers of the motion network on Hopper's tensor cores, by Warp kernels."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from ..kernels.network import encoding, parameter_gradients, weight_gradients, wgmma
from ..kernels.network import gradient_rows as lists
from ..kernels.network import gradient_scaling as ends
from ..kernels.network import perceptron as kernels
from ..kernels.training.ordered_sums import LANES
from . import runtime
from .cuda import side_stream
from .fused import launch
from .layers import LARGEST, SMALLEST, Form, LayerGradients, Layers


class FusedLayers(Layers):
    """Layers of 256 halves, one launch per pass; backward over rows that have a gradient."""

    def encode(
        self, mean: Tensor, length: float, powers: Tensor, *, columns: int, dtype: torch.dtype
    ) -> Tensor:
        """As the base class says, in one launch, of float32 to halves."""
        position = torch.empty(len(mean), columns, dtype=dtype, device=mean.device)
        if len(mean):
            dim = encoding.threads(len(mean), len(powers))
            launch(encoding.encode, dim, [mean, length, powers], [position])
        return position

    def forward(
        self,
        form: Form,
        position: Tensor,
        time: Tensor,
        weights: tuple[Tensor, ...],
        biases: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Saves packed weights for ``backward``, the head, and the masks of the ReLUs."""
        keys, count, layers = len(time), len(position), len(weights) - 1
        forth, back, head, shifts = packed(form, time, weights, biases)
        outputs = position.new_empty(layers, keys * count, form.width)
        masks = shifts.new_empty(kernels.mask_words(layers, keys, count), dtype=torch.int32)
        if count:
            rows = [sizes_of(form, layers), keys, position, forth, shifts]
            threads = _threads(_ready(position.device))
            launch(kernels.forward, threads, rows, [outputs, masks])
        return outputs, head.view(wgmma.HEAD, form.width), (back, weights[-1], masks)

    def backward(
        self, form: Form, keys: int, gradient: Tensor, outputs: Tensor, saved: tuple[Tensor, ...]
    ) -> LayerGradients:
        """As the base class says, over listed rows."""
        back, head, masks = saved
        device, rows, layers = _ready(outputs.device), len(gradient), len(outputs)
        after, given = outputs.new_empty(rows, wgmma.HEAD), gradient.contiguous()
        listed, begins = listed_rows(gradient, keys)
        gradients = outputs.new_empty(layers, len(listed), form.width)
        unit, total = gradient.new_empty(1), gradient.new_empty(3)
        sums = gradient.new_empty(layers, keys, form.width)
        blocks = wgmma.GROUPS * (1 if device.is_cpu else device.sm_count)
        partials = gradient.new_zeros(layers, keys, blocks, form.width)
        lanes, block = (1, 1) if device.is_cpu else (LANES, ends.BLOCK)
        parts = gradient.new_empty(-(-rows // lanes), 4)
        launch(ends.measure_rows, len(parts) * lanes, [given], [parts])
        dim, inputs = max(-(-rows // block), 1) * block, [given, parts, SMALLEST, LARGEST]
        launch(ends.scale_rows, dim, inputs, [after, unit, total])
        if rows:
            inputs = [sizes_of(form, layers), keys, listed, begins, after, head, back, outputs]
            launch(kernels.backward, _threads(device), [*inputs, masks], [gradients, partials])
        # only the products of the side stream depend on these sums
        with side_stream(outputs.device).fork():
            dim = layers * keys * (form.width // ends.COLUMNS) * block
            launch(ends.add_partials, dim, [block, partials], [sums])
        return LayerGradients(
            unit.view(()), after, gradients, sums, total, listed, begins, partials
        )

    def parameter_gradients(
        self, form: Form, position: Tensor, time: Tensor, gradients: LayerGradients, outputs: Tensor
    ) -> list[Tensor]:
        """As the base class says, by three concurrent products and a launch that adds their parts.

        The largest is launched behind the smallest, so that its blocks get whole multiprocessors,
        and before the one whose blocks share the others. Memory is allocated before any of them.
        """
        listed, begins = gradients.listed, gradients.begins
        side = side_stream(position.device)
        device, layers, entries = _ready(position.device), len(outputs), len(form.entries)
        threads = 1 if device.is_cpu else wgmma.BLOCK
        counts = (1, 1, 1)
        if device.is_cuda:
            counts = weight_gradients.parts(device.sm_count, layers, entries)
        half, halves, width = weight_gradients.HALF, weight_gradients.HALVES, wgmma.WIDTH
        shapes = parameter_shapes(form, layers)
        of_parameters = time.new_empty(sum(map(math.prod, shapes)))
        by_outputs = time.new_empty(counts[0], halves * (layers - 1), half * width)
        by_positions = time.new_empty(counts[1], halves * entries, half * wgmma.COLUMNS)
        heads = parameter_gradients.HEAD_BLOCKS * counts[2]
        by_head = time.new_empty(heads, 1, wgmma.VALUES * width)
        of, given = sizes_of(form, layers), [threads, len(time), listed, begins]
        with side.fork():
            inputs = [*given, gradients.head, outputs]
            launch(parameter_gradients.multiply_head, heads * threads, inputs, [by_head])
        if layers > 1:
            dim, inputs = (
                by_outputs.shape[:2].numel() * threads,
                [*given, gradients.layers, outputs],
            )
            launch(weight_gradients.multiply_outputs, dim, inputs, [by_outputs])
        with side.fork(wait=False):
            inputs = [*given, of.joined, gradients.layers, position]
            dim = by_positions.shape[:2].numel() * threads
            launch(weight_gradients.multiply_positions, dim, inputs, [by_positions])
        side.join()
        inputs = [of, gradients.unit.view(1), gradients.sums, gradients.head_sum, time]
        size = layers * width + wgmma.VALUES, width + form.position + form.time + 1
        parts = [by_outputs, by_positions, by_head]
        launch(parameter_gradients.collect, size, [*inputs, *parts], [of_parameters])
        values = of_parameters.split([*map(math.prod, shapes)])
        return [value.view(shape) for value, shape in zip(values, shapes, strict=True)]


def fits(form: Form, device: torch.device) -> bool:
    """Whether there are kernels for these sizes on this device."""
    sizes = form.width == wgmma.WIDTH and form.columns == wgmma.COLUMNS
    if not sizes or form.dtype != torch.float16 or device.type == "cpu":
        return False
    runtime.start()
    return wp.device_from_torch(device).arch == wgmma.ARCHITECTURE


def packed(
    form: Form, time: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights as halves in the order of the passes: forward, backward, those of the head; and the
    biases with what gamma(t) of every key adds to them.
    """
    layers, both = len(weights) - 1, zip(weights, biases, strict=True)
    parameters = torch.cat([value.reshape(-1) for pair in both for value in pair])
    square, entry = form.width * form.width, form.width * form.columns
    sizes = [(layers - 1) * square + len(form.entries) * entry, (layers - 1) * square]
    sizes.append(wgmma.HEAD * form.width)
    forth, back, head = time.new_empty(sum(sizes), dtype=torch.float16).split(sizes)
    shifts = time.new_empty(layers, len(time), form.width)
    units = sum(sizes) // kernels.UNIT + shifts.numel()
    inputs = [sizes_of(form, layers), parameters, time]
    launch(kernels.pack, units, inputs, [forth, back, head, shifts])
    return forth, back, head, shifts


def listed_rows(gradient: Tensor, keys: int) -> tuple[Tensor, Tensor]:
    """Rows that have a gradient, key by key, and where those of each key begin and end."""
    count, given, device = len(gradient) // keys, gradient.contiguous(), _ready(gradient.device)
    blocks, threads = keys * -(-count // lists.BLOCK), 1 if device.is_cpu else lists.BLOCK
    integers = functools.partial(gradient.new_empty, dtype=torch.int32)
    listed, begins = integers(lists.capacity(keys, count)), integers(keys + 1)
    if count:
        counts, dim = integers(blocks), blocks * threads
        launch(lists.count_rows, dim, [threads, given, count], [counts])
        launch(lists.list_rows, dim, [threads, given, counts, count], [listed, begins])
    else:
        begins.zero_()
    return listed, begins


def parameter_shapes(form: Form, layers: int) -> list[tuple[int, ...]]:
    """Of weight and bias of every layer, then of the head."""
    inputs = [form.width * (number > 0) for number in range(layers)]
    for number in form.entries:
        inputs[number] += form.position + form.time
    sizes = [*((form.width, count) for count in inputs), (wgmma.VALUES, form.width)]
    return [shape for size in sizes for shape in (size, size[:1])]


@functools.cache
def _ready(device: torch.device) -> wp.Device:
    """The device, with kernels compiled for exactly its architecture (sm_90a)."""
    runtime.start()
    warp_device = wp.get_device("cpu") if device.type == "cpu" else wp.device_from_torch(device)
    if warp_device.is_cuda:
        before, wp.config.cuda_arch_suffix = wp.config.cuda_arch_suffix, "a"
        try:
            for kernel in (kernels.forward, kernels.backward):
                kernel.module.load(warp_device, wgmma.BLOCK)
        finally:
            wp.config.cuda_arch_suffix = before
    return warp_device


@functools.cache
def sizes_of(form: Form, layers: int) -> kernels.Layers:
    """Sizes as kernels read them."""
    of = kernels.Layers()
    of.layers, of.joined = layers, form.entries[-1]
    of.position, of.time = form.position, form.time
    return of


def _threads(device: wp.Device) -> int:
    """One block per multiprocessor: registers do not hold more."""
    return 1 if device.is_cpu else device.sm_count * wgmma.BLOCK
