"""The motion network on tensor cores: one launch forward, one backward, where torch would multiply layer by layer."""

from __future__ import annotations

import functools

import torch
import warp as wp
from torch import Tensor

from ..kernels import encoding, weights, wgmma
from ..kernels import perceptron as kernels
from ..kernels import rows as lists
from ..kernels import slopes as ends
from ..kernels.sums import LANES
from ..scene.perceptron import LARGEST, SMALLEST, Form, Products, Slopes, beside
from .bridge import array_over, stream_of

LISTED = False  # whether rows without gradient are left out of the way back: prepared, not measured, design/network.md


class TensorCores(Products):
    """Passes for layers of 256 halves, see ``scene.perceptron.Passes`` and ``kernels/perceptron.py``; an encoder, too.

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
        # nobody waits for these sums but small products, which run beside the large ones, too; what they are made of is
        # given back before that, but nothing is asked for until both have joined
        with beside(outputs.device), stream_of(outputs):
            dim = layers * keys * (form.width // ends.COLUMNS) * block
            _launch(ends.add_partials, dim, [block, array_over(partials)], [array_over(sums)], device)
        return Slopes(unit.view(()), after, slopes, sums, total, listed, begins)

    def weigh_outputs(self, slopes: Slopes, outputs: Tensor, *, out: Tensor) -> None:
        """As the protocol says."""
        if slopes.listed is None:
            super().weigh_outputs(slopes, outputs, out=out)
        elif len(out):
            results = [out.view(-1, out.shape[-1])]
            _weigh(weights.multiply_outputs, slopes, array_over(outputs, wp.float16), [], results)

    def weigh_places(self, form: Form, keys: int, slopes: Slopes, place: Tensor, *, out: list[Tensor]) -> None:
        """As the protocol says."""
        if slopes.listed is None:
            super().weigh_places(form, keys, slopes, place, out=out)
        else:
            joined = -1 if form.joined is None else form.joined
            _weigh(weights.multiply_places, slopes, array_over(place, wp.float16), [joined], out)


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


def _weigh(kernel: wp.Kernel, slopes: Slopes, inputs: wp.array, more: list[int], results: list[Tensor]) -> None:
    """Weight gradients of listed rows: every multiprocessor has a part of them, then parts are added up."""
    assert slopes.listed is not None
    assert slopes.begins is not None
    device = _ready(slopes.layers.device, True)
    jobs = sum(map(len, results)) // weights.HALF
    parts, threads = (1, 1) if device.is_cpu else (max(device.sm_count // jobs, 1), weights.BLOCK)
    partials = results[0].new_empty(parts, jobs, weights.HALF * results[0].shape[1])
    with stream_of(slopes.layers):
        listed = [array_over(part, wp.int32) for part in (slopes.listed, slopes.begins)]
        given = [threads, len(slopes.begins) - 1, *more, *listed, array_over(slopes.layers, wp.float16), inputs]
        found = array_over(partials)
        _launch(kernel, parts * jobs * threads, given, [found], device)
        for number, result in enumerate(results):
            first = number * len(result) // weights.HALF
            _launch(weights.add_parts, result.shape, [found, first], [array_over(result)], device)


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
