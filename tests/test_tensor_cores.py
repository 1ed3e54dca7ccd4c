"""The motion network by Warp kernels: the same results as torch's products, whatever the sizes,
and nothing lost.
"""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from small_runs import random
from test_perceptron import (
    compare_replay,
    distance,
    exact,
    gradients,
    half,
    network,
    on_the_same_side,
    positions,
)

from gftorf_warp.kernels.network import gradient_scaling as ends
from gftorf_warp.kernels.network import perceptron as kernels
from gftorf_warp.kernels.network import wgmma
from gftorf_warp.kernels.training.ordered_sums import LANES
from gftorf_warp.render import tensor_cores
from gftorf_warp.render.bridge import array_over
from gftorf_warp.render.cublas import CublasLayers
from gftorf_warp.render.cuda import side_stream
from gftorf_warp.render.layers import LARGEST, SMALLEST, Form
from gftorf_warp.render.network import HalfPrecision, with_backend
from gftorf_warp.render.tensor_cores import FusedLayers, fits
from gftorf_warp.scene.motion import MotionSettings

HOPPER = torch.cuda.is_available() and torch.cuda.get_device_capability() == (9, 0)
ON_HOPPER = pytest.mark.skipif(not HOPPER, reason="needs CUDA with sm_90")
DEVICES = ["cpu", pytest.param("cuda", marks=ON_HOPPER)]
WIDTH, TILE = wgmma.WIDTH, wgmma.TILE
FULL = MotionSettings()
# the published one; shallow; deep and not joined; joined at its second layer, with fewer
# frequencies
SHAPES = {
    "published": FULL,
    "single": replace(FULL, layers=1),
    "two": replace(FULL, layers=2),
    "plain": replace(FULL, layers=8, skip_after=8),
    "early": replace(FULL, layers=3, skip_after=1, position_frequencies=9, time_frequencies=4),
}


def pair(settings=FULL, device="cpu", **options):
    """The same network twice: by tensor cores and by torch."""
    plain = network(half(settings), **options).to(device)
    quick = copy.deepcopy(plain)
    quick.backend = HalfPrecision(FusedLayers(), Form.of(quick))
    return quick, plain


def rows(count, keys, device="cpu", scale=1.0):
    """Positions and gradients of offsets, of both signs and of every size."""
    cotangent = scale * (random(keys, count, 3, seed=5) - 0.3)
    return positions(count).map(lambda value: value.to(device)), cotangent.to(device)


def inputs_of(made, count, keys):
    """What ``Passes.forward`` gets: form, gamma(x), gamma(t), weights and biases."""
    device = made.head.weight.device
    place = made.bind(positions(count).map(lambda value: value.to(device)))
    layers = [*made.layers, made.head]
    weights, biases = zip(
        *((layer.weight.detach(), layer.bias.detach()) for layer in layers), strict=True
    )
    return (
        made.backend.form,
        place,
        made.time_encodings[:keys].to(device, torch.float32),
        weights,
        biases,
    )


def alike(made, twin, count, keys, *, device="cpu", scale=1.0):
    """Offsets and gradients are those of torch's products and of float64,
    as closely as halves can be.
    """
    gaussians, cotangent = rows(count, len(keys), device, scale)
    found, got = gradients(made, gaussians, cotangent, keys)
    also, _ = gradients(twin, gaussians, cotangent, keys)
    want, wanted = exact(made, gaussians, cotangent, keys)
    assert found.shape == (len(keys), count, 3)
    assert found.dtype == torch.float32
    assert 1e-6 < distance(found, want) < 1e-3, "rounded, but not by much"
    assert distance(found, also) < 2e-3, "both are rounded"
    equals = on_the_same_side(made, gaussians, cotangent, keys)
    for one, other, equal in zip(got, wanted, equals, strict=True):
        assert other.abs().max() > 1e-4 * scale, "a vanished gradient would pass any tolerance"
        assert one.dtype == torch.float32
        assert distance(one, equal) < 2e-3
        assert distance(one, other) < (0.1 if count > 1 else 0.5), (
            "some units are at rest in one precision only"
        )


def placed(form, layers, parameters, moment, device="cpu"):
    """What ``pack`` makes of parameters: halves of all layers, of the way back, of the head,
    and shifts.
    """
    square, entry = form.width * form.width, form.width * form.columns
    sizes = [
        (layers - 1) * square + len(form.entries) * entry,
        (layers - 1) * square,
        wgmma.HEAD * form.width,
    ]
    parts = [torch.full((size,), torch.nan, dtype=torch.float16, device=device) for size in sizes]
    shifts = torch.full((layers, len(moment), form.width), torch.nan, device=device)
    arrays = [*(array_over(part, wp.float16) for part in parts), array_over(shifts)]
    given = [of(form, layers), array_over(parameters), array_over(moment)]
    launched(kernels.pack, sum(sizes) // kernels.UNIT + shifts.numel(), given, arrays, device)
    return [*(part.cpu() for part in parts), shifts]


def of(form, layers):
    """Sizes as kernels have them."""
    return tensor_cores.sizes_of(form, layers)


def launched(kernel, dim, inputs, outputs, device):
    """A launch as the passes do it, waited for."""
    wp.init()
    if device != "cpu":
        torch.cuda.synchronize()  # Warp has a stream of its own here
    wp.launch(kernel, dim, inputs, outputs, device=device, block_dim=wgmma.BLOCK)
    wp.synchronize()


def shares():
    """Which output every row of packed weights is, and which input every piece of 32: as one lane
    has its share.

    A lane t of four has inputs 2t, 2t + 1, 2t + 8 and 2t + 9 of 16, and of every eight outputs 2t
    and 2t + 1 (PTX, wgmma: fragments of A and D); those of two products, or of four times eight
    outputs, are neighbours 8 t to 8 t + 7.
    """
    inputs, outputs = np.zeros(32, int), np.zeros(32, int)
    for lane in range(4):
        own = [
            16 * product + 8 * upper + 2 * lane + e
            for product in (0, 1)
            for upper in (0, 1)
            for e in (0, 1)
        ]
        inputs[own] = 8 * lane + np.arange(8)
        own = [8 * eight + 2 * lane + e for eight in range(4) for e in (0, 1)]
        outputs[own] = 8 * lane + np.arange(8)
    return inputs, outputs


def unswizzled(packed):
    """[blocks, outputs, 64 inputs] as tensor cores see them:
    pieces of 16 bytes are exchanged by the row's number.
    """
    pieces = packed.view(-1, WIDTH, 8, 8).clone()
    for n in range(WIDTH):
        pieces[:, n] = packed.view(-1, WIDTH, 8, 8)[:, n, [u ^ n % 8 for u in range(8)]]
    return pieces.view(-1, WIDTH, 64)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("count", "keys"), [(1, [3]), (33, [0, 1, 3]), (70, [1]), (TILE, [0, 2])])
def test_it_is_torchs_product_and_float64(count, keys, device):
    """Fewer rows than a tile, a tile and a bit, just one; at the published size."""
    alike(*pair(device=device), count, keys, device=device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "published"])
def test_other_numbers_of_layers(shape, device):
    """Whether, and where, the input is joined again."""
    alike(*pair(SHAPES[shape], device), 33, [0, 3], device=device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_however_large_the_loss(scale, device):
    """No half holds these gradients."""
    alike(
        *pair(replace(FULL, layers=4, skip_after=2), device), 33, [0, 1], device=device, scale=scale
    )


@ON_HOPPER
@pytest.mark.parametrize(
    ("count", "keys"),
    [
        (5_000, [0, 1, 2]),
        (16_339, [1]),
        (20_289, [0, 1]),
        (20_480, [2]),
        (36_864, [0, 1, 3]),
        (40_000, [0, 1, 3]),
    ],
)
def test_many_rows(count, keys):
    """More tiles than multiprocessors, several rounds of a block, keys that end within one.

    16,339 rows give some of 132 blocks one tile, 36,864 at three keys give some 13, one more than a
    round: then one of two groups of warps has none, as in tests/test_weight_ring.py.
    """
    alike(*pair(device="cuda"), count, keys, device="cuda")


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_what_comes_out_of_every_layer(shape, device):
    """Outputs of all layers, and the head as a factor, against torch's;
    nothing is left unwritten.
    """
    made, _ = pair(SHAPES[shape], device)
    inputs = inputs_of(made, 21, 3)
    outputs, head, _ = FusedLayers().forward(*inputs)
    want, same, _ = CublasLayers().forward(*inputs)
    assert torch.equal(head, same)
    for one, other in zip(outputs, want, strict=True):
        assert 0.2 < float((other > 0).float().mean()) < 0.8
        assert distance(one, other) < 1e-3


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_slopes_of_the_same_outputs(shape, device):
    """The way back alone, where the same units are at rest: every slope, and its sums,
    which are no halves.
    """
    made, _ = pair(SHAPES[shape], device)
    inputs = inputs_of(made, 33, 2)
    form, gradient = made.backend.form, (random(66, 3, seed=6) - 0.3).to(device)
    outputs, _, kept = FusedLayers().forward(*inputs)
    found = FusedLayers().backward(form, 2, gradient, outputs, kept)
    side_stream(outputs.device).join()
    want = CublasLayers().backward(form, 2, gradient, outputs, CublasLayers().forward(*inputs)[2])
    torch.testing.assert_close(found.unit, want.unit, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.head, want.head, rtol=2e-3, atol=1e-5)
    assert (found.listed[: found.begins[-1]] >= 0).sum() == 66, "every row has a gradient"
    order = found.listed[: found.begins[-1]].long()
    layers = torch.zeros_like(outputs)
    layers[:, order[order >= 0]] = found.layers[:, : len(order)][:, order >= 0]
    found = found._replace(layers=layers)
    torch.testing.assert_close(found.head_sum, gradient.sum(0), rtol=1e-5, atol=1e-5)
    assert found.layers[outputs == 0].abs().max() == 0
    assert float((found.layers[outputs > 0] != 0).float().mean()) > 0.99
    for one, other in zip(found.layers, want.layers, strict=True):
        assert distance(one, other) < 2e-3
    assert found.sums.dtype == torch.float32
    sums = found.layers.double().unflatten(1, (2, 33)).sum(2)
    assert float((found.sums - sums).abs().max() / sums.abs().max()) < 1e-3


@pytest.mark.parametrize("device", DEVICES)
def test_no_rows(device):
    """No Gaussians: no offsets, and gradients that are zero, not whatever lay in memory."""
    made, _ = pair(device=device)
    found, got = gradients(made, *rows(0, 2, device), [0, 1])
    assert found.shape == (2, 0, 3)
    for one in got:
        assert torch.equal(one, torch.zeros_like(one))


@pytest.mark.parametrize("device", DEVICES)
def test_a_loss_without_gradient_has_none(device):
    """Nothing is divided by the largest of zeros."""
    made, _ = pair(device=device)
    gaussians, cotangent = rows(9, 2, device)
    _, got = gradients(made, gaussians, 0 * cotangent, [0, 1])
    assert all(torch.equal(one, torch.zeros_like(one)) for one in got)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("where", ["activation", "gradient", "infinite", "no number"])
def test_overflow_ends_in_a_gradient_that_is_not_finite(where, device):
    """So that the step is skipped, wherever it happened."""
    made, _ = pair(device=device)
    gaussians, cotangent = rows(30, 2, device)
    with torch.no_grad():
        if where == "activation":
            made.layers[1].weight *= 1e5
            made.layers[2].weight /= 1e5
        elif where == "gradient":  # activations stay as they are
            made.layers[3].weight *= 1e-4
            made.layers[3].bias *= 1e-4
            made.layers[4].weight *= 1e4
            made.head.weight *= 1e2
        else:
            cotangent[1, 4, 2] = torch.inf if where == "infinite" else torch.nan
    found, got = gradients(made, gaussians, cotangent, [0, 1])
    assert found.isfinite().all() or where == "activation"
    assert not torch.nn.utils.get_total_norm(got).isfinite()


@pytest.mark.parametrize("device", DEVICES)
def test_two_calls_agree_to_the_bit(device):
    """Sums have a fixed order: nothing is added by whoever comes first."""
    made, _ = pair(device=device)
    gaussians, cotangent = rows(70 if device == "cpu" else 20_289, 2, device)
    first, again = (gradients(made, gaussians, cotangent, [0, 2]) for _ in range(2))
    for one, other in zip([first[0], *first[1]], [again[0], *again[1]], strict=True):
        assert torch.equal(one, other)


@ON_HOPPER
@pytest.mark.parametrize("count", [2_000, 20_289])
def test_a_replay_equals_a_call(count):
    """Captured with its gradient; also with other positions and times written in between."""
    made, _ = pair(device="cuda")
    compare_replay(made, *rows(count, 2, "cuda"))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_every_weight_is_packed_once(shape, device):
    """Numbers of weights in place of weights, in two digits that halves hold:
    where each of them went.
    """
    made = network(half(SHAPES[shape]))
    form, layers = Form.of(made), len(made.layers)
    weights = [layer.weight for layer in [*made.layers, made.head]]
    biases = [layer.bias for layer in [*made.layers, made.head]]
    count = sum(value.numel() for value in [*weights, *biases])
    number = torch.arange(count, device=device)
    moment, digits = torch.zeros(1, form.time, device=device), (number % 1024, number // 1024)
    low, high = (placed(form, layers, digit.float(), moment, device)[:3] for digit in digits)
    forth, back, head = (1024 * two.long() + one.long() for one, two in zip(low, high, strict=True))
    inputs, outputs = shares()
    k = (32 * np.arange(2)[:, None] + inputs).ravel()
    p = (32 * np.arange(8)[:, None] + outputs).ravel()
    forth, back = unswizzled(forth), unswizzled(back)
    at = part = 0
    for layer, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
        numbers = (at + torch.arange(weight.numel())).view(weight.shape)
        used = numbers[
            :, : (WIDTH if layer else 0) + (form.columns if layer in form.entries else 0)
        ]
        for block in used.split(64, dim=1):
            assert torch.equal(forth[part], block[p][:, k]), f"block {part}, of layer {layer}"
            part += 1
        for block in range(4 if layer else 0):
            turned = numbers[:, :WIDTH].T[p][:, 64 * block + k]
            assert torch.equal(back[4 * (layers - 1 - layer) + block], turned), (
                f"back from layer {layer}"
            )
        at += weight.numel() + bias.numel()
    assert (part, 4 * (layers - 1)) == (len(forth), len(back))
    want = at + torch.arange(3 * WIDTH)
    assert torch.equal(
        head, torch.cat([want, torch.zeros((wgmma.HEAD - 3) * WIDTH, dtype=torch.long)])
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_what_a_time_adds(shape, device):
    """Bias and gamma(t), of every layer and key."""
    made = network(half(SHAPES[shape])).to(device)
    form, _, moment, weights, biases = inputs_of(made, 1, 3)
    layers = len(made.layers)
    parameters = torch.cat(
        [value.reshape(-1) for both in zip(weights, biases, strict=True) for value in both]
    )
    found = placed(form, layers, parameters, moment, device)[-1]
    for number in range(layers):
        want = biases[number].expand(3, -1)
        if number in form.entries:
            own = moment @ weights[number][:, -form.time :].T
            assert own.abs().max() > 0.1
            want = want + own
        torch.testing.assert_close(found[number], want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 33, 300, 9_000])
def test_gradients_become_halves(count, device):
    """By the largest of them; sums are those of what was given."""
    if device == "cpu":
        count = min(count, 1_000)
    gradient = (1e-7 * (random(count, 3, seed=3) - 0.4)).to(device)
    gradient[count // 2, 1] = -3e-7
    lanes, block = (1, 1) if device == "cpu" else (LANES, ends.BLOCK)
    partials = torch.full((-(-count // lanes), 4), torch.nan, device=device)
    launched(
        ends.measure_rows,
        len(partials) * lanes,
        [array_over(gradient)],
        [array_over(partials)],
        device,
    )
    torch.testing.assert_close(partials[:, :3].sum(0), gradient.sum(0), rtol=1e-5, atol=1e-12)
    assert partials[:, 3].max() == gradient.abs().max()
    after = torch.full((count, wgmma.HEAD), torch.nan, dtype=torch.float16, device=device)
    unit, total = torch.zeros(1, device=device), torch.zeros(3, device=device)
    given = [array_over(gradient), array_over(partials), SMALLEST, LARGEST]
    made = [array_over(after, wp.float16), array_over(unit), array_over(total)]
    launched(ends.scale_rows, -(-count // block) * block, given, made, device)
    torch.testing.assert_close(unit[0], gradient.abs().max() / LARGEST, rtol=1e-6, atol=0)
    torch.testing.assert_close(total, gradient.sum(0), rtol=1e-5, atol=1e-12)
    torch.testing.assert_close(after[:, :3].float(), gradient / unit, rtol=1e-3, atol=1e-6)
    assert float(after.abs().max()) == LARGEST
    assert torch.equal(after[:, 3:], torch.zeros_like(after[:, 3:]))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("parts", [1, 2, 264])
def test_partial_sums_become_sums(parts, device):
    """Of every layer, key and column; few parts and many."""
    partials = (random(3, 2, parts, WIDTH) - 0.4).to(device)
    sums = torch.full((3, 2, WIDTH), torch.nan, device=device)
    block = 1 if device == "cpu" else ends.BLOCK
    dim = 3 * 2 * (WIDTH // ends.COLUMNS) * block
    launched(ends.add_partials, dim, [block, array_over(partials)], [array_over(sums)], device)
    torch.testing.assert_close(sums, partials.sum(2), rtol=1e-5, atol=1e-5)


def test_it_fits_the_published_network_on_hopper_only(monkeypatch):
    """Anything else is torch's: a CPU, other GPUs, other widths, more frequencies,
    factors that are no halves.
    """
    published = Form.of(network())
    assert (published.width, published.columns, published.dtype) == (256, 64, torch.float16)
    assert not fits(published, torch.device("cpu"))
    gpu = torch.device("cuda", 0)
    for arch, fitting in ((80, False), (89, False), (90, True), (100, False), (120, False)):
        monkeypatch.setattr(
            wp, "device_from_torch", lambda _, arch=arch: SimpleNamespace(arch=arch)
        )
        assert fits(published, gpu) == fitting
    monkeypatch.setattr(wp, "device_from_torch", lambda _: SimpleNamespace(arch=90))
    others = [
        {"width": 128},
        {"position": 64 + 1},
        {"position": 48},
        {"dtype": torch.float32},
        {"dtype": torch.float64},
    ]
    assert not any(fits(replace(published, **change), gpu) for change in others)
    assert fits(replace(published, joined=None), gpu)


def test_a_run_has_the_backend_of_its_device(monkeypatch):
    """Kernels of ours where they fit, else torch's products; none in float32;
    a copy has the same.
    """
    assert with_backend(network()).backend is None
    assert isinstance(with_backend(network(half())).backend.layers, CublasLayers)
    monkeypatch.setattr("gftorf_warp.render.network.fits", lambda _, device: device.type == "cpu")
    made = with_backend(network(half()))
    assert isinstance(copy.deepcopy(made).backend.layers, FusedLayers)
