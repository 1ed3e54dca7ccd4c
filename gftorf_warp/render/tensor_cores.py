"""The layers of the motion network on Hopper's tensor cores, by Warp kernels."""

from __future__ import annotations

import functools
import math

import torch
import warp as wp
from torch import Tensor

from ..kernels.network import encoding, parameter_gradients, weight_gradients, wgmma
from ..kernels.network import gradient_rows as lists
from ..kernels.network import gradient_scaling as ends
from ..kernels.network import perceptron as kernels
from ..kernels.training.ordered_sums import LANES
from .bridge import array_over
from .cuda import side_stream, stream_of
from .layers import LARGEST, SMALLEST, Form, LayerGradients, Layers


class FusedLayers(Layers):
    """Layers of 256 halves: all of them in one launch forward, in one launch backward.

    The backward pass is over the listed rows that have a gradient. On a CPU the same kernels run
    row by row, for tests.
    """

    def encode(
        self, mean: Tensor, length: float, powers: Tensor, *, columns: int, dtype: torch.dtype
    ) -> Tensor:
        """As the base class says, in one launch, of float32 to halves."""
        position = torch.empty(len(mean), columns, dtype=dtype, device=mean.device)
        if len(mean):
            with stream_of(mean):
                given, found = (
                    [array_over(mean), length, array_over(powers)],
                    [array_over(position, wp.float16)],
                )
                dim = encoding.threads(len(mean), len(powers))
                _launch(encoding.encode, dim, given, found, wp.device_from_torch(mean.device))
        return position

    def forward(
        self,
        form: Form,
        position: Tensor,
        time: Tensor,
        weights: tuple[Tensor, ...],
        biases: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """As the base class says; saved are packed weights for ``backward``, the head,
        and masks of the ReLUs.
        """
        keys, count, layers = len(time), len(position), len(weights) - 1
        parameters = torch.cat(
            [value.reshape(-1) for pair in zip(weights, biases, strict=True) for value in pair]
        )
        square, entry = form.width * form.width, form.width * form.columns
        sizes = [
            (layers - 1) * square + len(form.entries) * entry,
            (layers - 1) * square,
            wgmma.HEAD * form.width,
        ]
        packed = position.new_empty(sum(sizes)).split(sizes)
        shifts = time.new_empty(layers, keys, form.width)
        outputs = position.new_empty(layers, keys * count, form.width)
        masks = torch.empty(
            kernels.mask_words(layers, keys, count), dtype=torch.int32, device=position.device
        )
        of, device = _layers(form, layers), _ready(position.device)
        with stream_of(position):
            flat, halves = array_over(parameters), [array_over(part, wp.float16) for part in packed]
            added = array_over(shifts)
            units = sum(sizes) // kernels.UNIT + shifts.numel()
            _launch(kernels.pack, units, [of, flat, array_over(time)], [*halves, added], device)
            if count:
                rows = [of, keys, array_over(position, wp.float16), halves[0], added]
                found = [array_over(outputs, wp.float16), array_over(masks, wp.int32)]
                _launch(kernels.forward, _threads(device), rows, found, device)
        return outputs, packed[2].view(wgmma.HEAD, form.width), (packed[1], weights[-1], masks)

    def backward(
        self, form: Form, keys: int, gradient: Tensor, outputs: Tensor, saved: tuple[Tensor, ...]
    ) -> LayerGradients:
        """As the base class says, over listed rows."""
        back, head, masks = saved
        device, rows, layers = _ready(outputs.device), len(gradient), len(outputs)
        after = outputs.new_empty(rows, wgmma.HEAD)
        listed, begins = _list(gradient, keys, device)
        gradients = outputs.new_empty(layers, len(listed), form.width)
        unit, total, sums = (
            gradient.new_empty(1),
            gradient.new_empty(3),
            gradient.new_empty(layers, keys, form.width),
        )
        blocks = wgmma.GROUPS * (1 if device.is_cpu else device.sm_count)
        partials = gradient.new_zeros(layers, keys, blocks, form.width)
        lanes, block = (1, 1) if device.is_cpu else (LANES, ends.BLOCK)
        parts = gradient.new_empty(-(-rows // lanes), 4)
        with stream_of(outputs):
            given, found = array_over(gradient.contiguous()), array_over(parts)
            halves = [
                array_over(tensor, wp.float16) for tensor in (after, back, outputs, gradients)
            ]
            _launch(ends.measure_rows, len(parts) * lanes, [given], [found], device)
            scaled = [halves[0], array_over(unit), array_over(total)]
            blocks_of_rows = max(-(-rows // block), 1)
            _launch(
                ends.scale_rows,
                blocks_of_rows * block,
                [given, found, SMALLEST, LARGEST],
                scaled,
                device,
            )
            if rows:
                chosen = [array_over(part, wp.int32) for part in (listed, begins)]
                inputs = [
                    _layers(form, layers),
                    keys,
                    *chosen,
                    halves[0],
                    array_over(head),
                    halves[1],
                    halves[2],
                ]
                inputs.append(array_over(masks, wp.int32))
                _launch(
                    kernels.backward,
                    _threads(device),
                    inputs,
                    [halves[3], array_over(partials)],
                    device,
                )
        # only the products of the side stream depend on these sums
        with side_stream(outputs.device).fork(), stream_of(outputs):
            dim = layers * keys * (form.width // ends.COLUMNS) * block
            _launch(
                ends.add_partials, dim, [block, array_over(partials)], [array_over(sums)], device
            )
        return LayerGradients(
            unit.view(()), after, gradients, sums, total, listed, begins, partials
        )

    def parameter_gradients(
        self, form: Form, position: Tensor, time: Tensor, gradients: LayerGradients, outputs: Tensor
    ) -> list[Tensor]:
        """As the base class says, by three concurrent products, and one launch that adds up their
        partial results.

        The largest is launched behind the smallest, so that its blocks get whole multiprocessors,
        and before the one whose blocks share the others. Memory is allocated before any of them.
        """
        assert gradients.listed is not None
        assert gradients.begins is not None
        side = side_stream(position.device)
        device, layers, entries = _ready(position.device), len(outputs), len(form.entries)
        threads = 1 if device.is_cpu else wgmma.BLOCK
        of_outputs, of_positions, left = (
            (1, 1, 1) if device.is_cpu else weight_gradients.parts(device.sm_count, layers, entries)
        )
        shapes = _shapes(form, layers)
        found = time.new_empty(sum(map(math.prod, shapes)))
        by_outputs = time.new_empty(
            of_outputs, weight_gradients.HALVES * (layers - 1), weight_gradients.HALF * wgmma.WIDTH
        )
        by_positions = time.new_empty(
            of_positions, weight_gradients.HALVES * entries, weight_gradients.HALF * wgmma.COLUMNS
        )
        by_head = time.new_empty(
            parameter_gradients.HEAD_BLOCKS * left, 1, wgmma.VALUES * wgmma.WIDTH
        )
        parts = [array_over(part) for part in (by_outputs, by_positions, by_head)]
        of, listed = (
            _layers(form, layers),
            [array_over(part, wp.int32) for part in (gradients.listed, gradients.begins)],
        )
        given, back = [threads, len(time), *listed], array_over(gradients.layers, wp.float16)
        after, ahead = array_over(gradients.head, wp.float16), array_over(outputs, wp.float16)
        with side.fork(), stream_of(position):
            _launch(
                parameter_gradients.multiply_head,
                len(by_head) * threads,
                [*given, after, ahead],
                parts[2:],
                device,
            )
        with stream_of(position):
            if layers > 1:
                blocks = by_outputs.shape[0] * by_outputs.shape[1]
                _launch(
                    weight_gradients.multiply_outputs,
                    blocks * threads,
                    [*given, back, ahead],
                    parts[:1],
                    device,
                )
        with side.fork(wait=False), stream_of(position):
            more, blocks = (
                [of.joined, back, array_over(position, wp.float16)],
                by_positions.shape[0] * by_positions.shape[1],
            )
            _launch(
                weight_gradients.multiply_positions,
                blocks * threads,
                [*given, *more],
                parts[1:2],
                device,
            )
        side.join()
        with stream_of(position):
            made = [
                array_over(part)
                for part in (gradients.unit.view(1), gradients.sums, gradients.head_sum, time)
            ]
            dim = layers * wgmma.WIDTH + wgmma.VALUES, wgmma.WIDTH + form.position + form.time + 1
            _launch(
                parameter_gradients.collect, dim, [of, *made, *parts], [array_over(found)], device
            )
        values = found.split([*map(math.prod, shapes)])
        return [value.view(shape) for value, shape in zip(values, shapes, strict=True)]


def fits(form: Form, device: torch.device) -> bool:
    """Whether there are kernels for these sizes on this device."""
    sizes = form.width == wgmma.WIDTH and form.columns == wgmma.COLUMNS
    if not sizes or form.dtype != torch.float16 or device.type == "cpu":
        return False
    wp.init()
    return wp.device_from_torch(device).arch == wgmma.ARCHITECTURE


def _list(gradient: Tensor, keys: int, device: wp.Device) -> tuple[Tensor, Tensor]:
    """Rows that have a gradient, key by key, and where those of each key begin and end."""
    count = len(gradient) // keys
    blocks, threads = keys * -(-count // lists.BLOCK), 1 if device.is_cpu else lists.BLOCK
    integers = functools.partial(torch.empty, dtype=torch.int32, device=gradient.device)
    counts, listed, begins = (
        integers(blocks),
        integers(lists.capacity(keys, count)),
        integers(keys + 1),
    )
    if not count:
        begins.zero_()
    with stream_of(gradient):
        given, found = array_over(gradient.contiguous()), array_over(counts, wp.int32)
        if count:
            _launch(lists.count_rows, blocks * threads, [threads, given, count], [found], device)
            made = [array_over(listed, wp.int32), array_over(begins, wp.int32)]
            _launch(lists.list_rows, blocks * threads, [threads, given, found, count], made, device)
    return listed, begins


def _shapes(form: Form, layers: int) -> list[tuple[int, ...]]:
    """Of weight and bias of every layer, then of the head."""
    inputs = [form.width * (number > 0) for number in range(layers)]
    for number in form.entries:
        inputs[number] += form.position + form.time
    sizes = [*((form.width, own) for own in inputs), (wgmma.VALUES, form.width)]
    return [shape for size in sizes for shape in (size, size[:1])]


@functools.cache
def _ready(device: torch.device) -> wp.Device:
    """The device, with kernels compiled for exactly its architecture,
    which no other has the instructions of.
    """
    wp.init()
    found = wp.get_device("cpu") if device.type == "cpu" else wp.device_from_torch(device)
    if found.is_cuda:
        before, wp.config.cuda_arch_suffix = wp.config.cuda_arch_suffix, "a"
        try:
            for kernel in (kernels.forward, kernels.backward):
                kernel.module.load(found, wgmma.BLOCK)
        finally:
            wp.config.cuda_arch_suffix = before
    return found


@functools.cache
def _layers(form: Form, layers: int) -> kernels.Layers:
    of = kernels.Layers()
    of.layers, of.joined = layers, -1 if form.joined is None else form.joined
    of.position, of.time = form.position, form.time
    return of


def _threads(device: wp.Device) -> int:
    """One block per multiprocessor: registers do not hold more."""
    return 1 if device.is_cpu else device.sm_count * wgmma.BLOCK


def _launch(
    kernel: wp.Kernel, dim, inputs: list, outputs: list[wp.array], device: wp.Device
) -> None:
    wp.launch(kernel, dim, inputs, outputs, device=device, block_dim=wgmma.BLOCK, record_tape=False)
