"""The motion network on tensor cores: one launch forward, one backward, where torch would multiply layer by layer."""

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
from ..scene.perceptron import LARGEST, SMALLEST, Form, Products, Slopes, beside, join
from .bridge import array_over
from .cuda import stream_of

LISTED = True  # whether rows without gradient are left out of the way back: design/network.md says what that brings


class TensorCores(Products):
    """Passes for layers of 256 halves, see ``scene.perceptron.Passes``; an encoder, too.

    Weight gradients are torch's, unless rows without gradient are left out: then those are kernels, too. On a CPU they
    are slow, and there for tests.

    Args:
        listed: Whether only rows with a gradient go back.
    """

    def __init__(self, *, listed: bool = LISTED):
        self.listed = listed

    def encode(self, mean: Tensor, length: float, powers: Tensor, *, columns: int, dtype: torch.dtype) -> Tensor:
        """As ``scene.encoding.Encoder`` says, in one launch, of float32 to halves."""
        place = torch.empty(len(mean), columns, dtype=dtype, device=mean.device)
        if len(mean):
            with stream_of(mean):
                given, found = [array_over(mean), length, array_over(powers)], [array_over(place, wp.float16)]
                dim = encoding.threads(len(mean), len(powers))
                _launch(encoding.encode, dim, given, found, wp.device_from_torch(mean.device))
        return place

    def forward(
        self, form: Form, place: Tensor, moment: Tensor, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Outputs of all layers, and the head as halves; kept are weights for the way back, the head, and masks."""
        keys, count, layers = len(moment), len(place), len(weights) - 1
        parameters = torch.cat([value.reshape(-1) for pair in zip(weights, biases, strict=True) for value in pair])
        square, entry = form.width * form.width, form.width * form.columns
        sizes = [(layers - 1) * square + len(form.entries) * entry, (layers - 1) * square, wgmma.HEAD * form.width]
        packed = place.new_empty(sum(sizes)).split(sizes)
        shifts = moment.new_empty(layers, keys, form.width)
        outputs = place.new_empty(layers, keys * count, form.width)
        masks = torch.empty(kernels.mask_words(layers, keys, count), dtype=torch.int32, device=place.device)
        of, device = _layers(form, layers), _ready(place.device, self.listed)
        with stream_of(place):
            flat, halves = array_over(parameters), [array_over(part, wp.float16) for part in packed]
            added = array_over(shifts)
            units = sum(sizes) // kernels.UNIT + shifts.numel()
            _launch(kernels.pack, units, [of, flat, array_over(moment)], [*halves, added], device)
            if count:
                rows = [of, keys, array_over(place, wp.float16), halves[0], added]
                found = [array_over(outputs, wp.float16), array_over(masks, wp.int32)]
                _launch(kernels.forward, _threads(device), rows, found, device)
        return outputs, packed[2].view(wgmma.HEAD, form.width), (packed[1], weights[-1], masks)

    def backward(self, form: Form, keys: int, gradient: Tensor, outputs: Tensor, kept: tuple[Tensor, ...]) -> Slopes:
        """What the gradient becomes on its way back."""
        back, head, masks = kept
        device, rows, layers = _ready(outputs.device, self.listed), len(gradient), len(outputs)
        after = outputs.new_empty(rows, wgmma.HEAD)
        listed, begins = _list(gradient, keys, device) if self.listed else (None, None)
        slopes = outputs.new_empty(layers, rows if listed is None else len(listed), form.width)
        unit, total, sums = gradient.new_empty(1), gradient.new_empty(3), gradient.new_empty(layers, keys, form.width)
        blocks = wgmma.GROUPS * (1 if device.is_cpu else device.sm_count)
        partials = gradient.new_zeros(layers, keys, blocks, form.width)
        lanes, block = (1, 1) if device.is_cpu else (LANES, ends.BLOCK)
        parts = gradient.new_empty(-(-rows // lanes), 4)
        with stream_of(outputs):
            given, found = array_over(gradient.contiguous()), array_over(parts)
            halves = [array_over(tensor, wp.float16) for tensor in (after, back, outputs, slopes)]
            _launch(ends.measure_rows, len(parts) * lanes, [given], [found], device)
            scaled = [halves[0], array_over(unit), array_over(total)]
            blocks_of_rows = max(-(-rows // block), 1)
            _launch(ends.scale_rows, blocks_of_rows * block, [given, found, SMALLEST, LARGEST], scaled, device)
            if rows:
                chosen = [array_over(part, wp.int32) for part in (listed, begins) if part is not None]
                passed = [_layers(form, layers), keys, *chosen, halves[0], array_over(head), halves[1], halves[2]]
                passed.append(array_over(masks, wp.int32))
                way = kernels.backward_listed if chosen else kernels.backward
                _launch(way, _threads(device), passed, [halves[3], array_over(partials)], device)
        # nobody waits for these sums but what runs beside the large products, too
        with beside(outputs.device), stream_of(outputs):
            dim = layers * keys * (form.width // ends.COLUMNS) * block
            _launch(ends.add_partials, dim, [block, array_over(partials)], [array_over(sums)], device)
        return Slopes(unit.view(()), after, slopes, sums, total, listed, begins, partials)

    def weigh(self, form: Form, place: Tensor, moment: Tensor, slopes: Slopes, outputs: Tensor) -> list[Tensor]:
        """As the protocol says; of listed rows by three products at the same time, and one launch that adds up parts.

        The largest is asked for behind the smallest, so that its blocks find whole multiprocessors, and before the one
        whose blocks share what is left. Memory is asked for before any of them.
        """
        if slopes.listed is None:
            return super().weigh(form, place, moment, slopes, outputs)
        assert slopes.begins is not None
        device, layers, entries = _ready(place.device, True), len(outputs), len(form.entries)
        threads = 1 if device.is_cpu else wgmma.BLOCK
        of_outputs, of_places, left = (
            (1, 1, 1) if device.is_cpu else weight_gradients.parts(device.sm_count, layers, entries)
        )
        shapes = _shapes(form, layers)
        found = moment.new_empty(sum(map(math.prod, shapes)))
        by_outputs = moment.new_empty(
            of_outputs, weight_gradients.HALVES * (layers - 1), weight_gradients.HALF * wgmma.WIDTH
        )
        by_places = moment.new_empty(
            of_places, weight_gradients.HALVES * entries, weight_gradients.HALF * wgmma.COLUMNS
        )
        by_head = moment.new_empty(parameter_gradients.HEAD_BLOCKS * left, 1, wgmma.VALUES * wgmma.WIDTH)
        parts = [array_over(part) for part in (by_outputs, by_places, by_head)]
        of, listed = _layers(form, layers), [array_over(part, wp.int32) for part in (slopes.listed, slopes.begins)]
        given, back = [threads, len(moment), *listed], array_over(slopes.layers, wp.float16)
        after, ahead = array_over(slopes.head, wp.float16), array_over(outputs, wp.float16)
        with beside(place.device), stream_of(place):
            _launch(
                parameter_gradients.multiply_head, len(by_head) * threads, [*given, after, ahead], parts[2:], device
            )
        with stream_of(place):
            if layers > 1:
                blocks = by_outputs.shape[0] * by_outputs.shape[1]
                _launch(weight_gradients.multiply_outputs, blocks * threads, [*given, back, ahead], parts[:1], device)
        with beside(place.device, behind=False), stream_of(place):
            more, blocks = [of.joined, back, array_over(place, wp.float16)], by_places.shape[0] * by_places.shape[1]
            _launch(weight_gradients.multiply_places, blocks * threads, [*given, *more], parts[1:2], device)
        join(place.device)
        with stream_of(place):
            made = [array_over(part) for part in (slopes.unit.view(1), slopes.sums, slopes.head_sum, moment)]
            dim = layers * wgmma.WIDTH + wgmma.VALUES, wgmma.WIDTH + form.place + form.moment + 1
            _launch(parameter_gradients.collect, dim, [of, *made, *parts], [array_over(found)], device)
        values = found.split([*map(math.prod, shapes)])
        return [value.view(shape) for value, shape in zip(values, shapes, strict=True)]


def fits(form: Form, device: torch.device) -> bool:
    """Whether a perceptron can go that way: its sizes, and a GPU that has such products."""
    sizes = form.width == wgmma.WIDTH and form.columns == wgmma.COLUMNS
    if not sizes or form.dtype != torch.float16 or device.type == "cpu":
        return False
    wp.init()
    return wp.device_from_torch(device).arch == wgmma.ARCHITECTURE


def _list(gradient: Tensor, keys: int, device: wp.Device) -> tuple[Tensor, Tensor]:
    """Rows that have a gradient, key by key, and where the part of each key begins and ends."""
    count = len(gradient) // keys
    blocks, threads = keys * -(-count // lists.BLOCK), 1 if device.is_cpu else lists.BLOCK
    integers = functools.partial(torch.empty, dtype=torch.int32, device=gradient.device)
    counts, listed, begins = integers(blocks), integers(lists.capacity(keys, count)), integers(keys + 1)
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
        inputs[number] += form.place + form.moment
    sizes = [*((form.width, own) for own in inputs), (wgmma.VALUES, form.width)]
    return [shape for size in sizes for shape in (size, size[:1])]


@functools.cache
def _ready(device: torch.device, listed: bool) -> wp.Device:
    """The device, with kernels compiled for exactly its architecture: what they use is no part of any other."""
    wp.init()
    found = wp.get_device("cpu") if device.type == "cpu" else wp.device_from_torch(device)
    if found.is_cuda:
        before, wp.config.cuda_arch_suffix = wp.config.cuda_arch_suffix, "a"
        try:
            for kernel in (kernels.forward, kernels.backward_listed if listed else kernels.backward):
                kernel.module.load(found, wgmma.BLOCK)
        finally:
            wp.config.cuda_arch_suffix = before
    return found


@functools.cache
def _layers(form: Form, layers: int) -> kernels.Layers:
    of = kernels.Layers()
    of.layers, of.joined = layers, -1 if form.joined is None else form.joined
    of.place, of.moment = form.place, form.moment
    return of


def _threads(device: wp.Device) -> int:
    """One block on every multiprocessor, which is all that its registers hold."""
    return 1 if device.is_cpu else device.sm_count * wgmma.BLOCK


def _launch(kernel: wp.Kernel, dim, inputs: list, outputs: list[wp.array], device: wp.Device) -> None:
    wp.launch(kernel, dim, inputs, outputs, device=device, block_dim=wgmma.BLOCK, record_tape=False)
