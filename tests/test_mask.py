"""The kernel between two layers of the motion network's gradient: mask and sums, against torch."""

from dataclasses import replace

import pytest
import torch
from small_runs import random
from test_perceptron import DEVICES, SHAPES, distance, gradients, half, network, positions

from gftorf_warp.render import fused
from gftorf_warp.scene import perceptron
from gftorf_warp.scene.motion import MotionSettings


def rows_of(count, width, dtype, device):
    """Gradients, and what a ReLU left: zeros of both signs, values of both signs and no numbers among them."""
    slope, before = random(count, width, seed=3) - 0.4, random(count, width, seed=4) - 0.5
    before[::3] = before[::3].clamp_min(0.0)
    before[1::5, ::2] = -0.0
    before[2::7, 1::4] = torch.nan
    slope[::4, ::3] = torch.inf
    before[::4, ::3] = 0.0  # nothing is left of what is infinite
    return slope.to(device, dtype), before.to(device, dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
@pytest.mark.parametrize(
    ("count", "width", "parts"),
    [(1, 256, 1), (127, 256, 1), (1000, 256, 8), (1000, 256, 7), (77, 16, 3), (5, 24, 4), (3, 8, 5), (300, 1024, 2)],
)
def test_it_masks_and_sums_as_torch_does(device, dtype, count, width, parts):
    """Rows to the bit, sums to rounding; parts may be uneven, or have no rows at all."""
    slope, before = rows_of(count, width, dtype, device)
    want = torch.ops.aten.threshold_backward(slope, before, 0.0)
    assert want.ne(slope).float().mean() > 0.2
    assert want.isfinite().all()
    each = -(-count // parts)
    sums = [want[part * each : (part + 1) * each].double().sum(0) for part in range(parts)]
    out = torch.full((parts, width), torch.nan, device=device)
    kept = before.clone()
    fused.masked(slope, before, out)
    assert torch.equal(slope, want)
    assert torch.equal(before.nan_to_num(7.0), kept.nan_to_num(7.0))
    torch.testing.assert_close(out.double(), torch.stack(sums), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_it_writes_no_other_rows(device):
    """Parts of a larger room, as a layer has it."""
    slope, before = rows_of(60, 256, torch.float16, device)
    whole, out = slope.clone(), torch.zeros(4, 256, device=device)
    fused.masked(slope[13:50], before[13:50], out[1:3])
    assert torch.equal(slope[:13], whole[:13])
    assert torch.equal(slope[50:], whole[50:])
    assert not torch.equal(slope[13:50], whole[13:50])
    assert out[[0, 3]].abs().max() == 0
    torch.testing.assert_close(out.sum(0), slope[13:50].float().sum(0), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
@pytest.mark.parametrize(("keys", "count"), [([1], 1), ([2], 257), ([0, 2, 3], 172), ([0, 1, 3], 401)])
def test_gradients_of_the_network_are_those_by_torch(device, dtype, keys, count, monkeypatch):
    """Also where rows of a key go through the layers in parts of unequal length."""
    made, gaussians = network(half()).to(device), positions(count).map(lambda value: value.to(device))
    made._form = replace(made._form, dtype=dtype)
    cotangent = (random(len(keys), count, 3, seed=5) - 0.5).to(device)
    for piece in (perceptron.PIECE, 150):
        monkeypatch.setattr(perceptron, "PIECE", piece)
        made.mask_by(None)
        found, wanted = gradients(made, gaussians, cotangent, keys)
        made.mask_by(fused.masked)
        again, got = gradients(made, gaussians, cotangent, keys)
        assert torch.equal(found, again)
        for one, other in zip(got, wanted, strict=True):
            assert other.abs().max() > 1e-4
            assert distance(one, other) < 1e-5


@pytest.mark.parametrize("shape", SHAPES)
def test_small_networks_have_the_same_gradients(shape):
    """Two rows of threads to a block, or hundreds."""
    made, gaussians, cotangent = network(half(SHAPES[shape])), positions(333), random(2, 333, 3, seed=5) - 0.5
    assert fused.masks(made.settings.width, torch.float16)
    _, wanted = gradients(made, gaussians, cotangent, [0, 2])
    made.mask_by(fused.masked)
    _, got = gradients(made, gaussians, cotangent, [0, 2])
    for one, other in zip(got, wanted, strict=True):
        assert distance(one, other) < 1e-5


def test_rows_that_do_not_fit_are_refused():
    """By width, precision, shape, and place in memory."""
    assert fused.masks(MotionSettings().width, torch.float16)
    assert [fused.masks(width, torch.float16) for width in (8, 12, 2048, 2056, 0)] == [True, False, True, False, False]
    assert [fused.masks(width, torch.float32) for width in (4, 6, 1024, 1028)] == [True, False, True, False]
    assert not fused.masks(8, torch.float64)
    rows, out = torch.zeros(6, 16), torch.zeros(2, 16)
    for slope, before, sums in (
        (rows[:, :6], rows[:, :6], out[:, :6]),
        (rows, rows[:5], out),
        (rows, rows, out[:, :8]),
        (rows.double(), rows.double(), out),
        (rows, rows.half(), out),
        (rows, rows, out.half()),
        (rows[:, :8], rows[:, :8], out[:, :8].contiguous()),
        (rows.flatten()[1:81].view(5, 16), rows[:5], out),
    ):
        with pytest.raises(ValueError, match=r"masked and summed|must be"):
            fused.masked(slope, before, sums)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("keys", [1, 2, 3])
def test_a_replay_on_cuda_equals_a_call(keys):
    """Captured by the bridge, on a stream of its own; with other positions written in between."""
    from gftorf_warp.render.bridge import Captured

    made, gaussians = network(half()).to("cuda"), positions(4099).map(lambda value: value.to("cuda"))
    made.mask_by(fused.masked)
    cotangent, place = random(keys, 4099, 3).to("cuda"), made.attach(gaussians)
    moment, parameters, kept = made.moments[:keys].clone(), list(made.parameters()), []

    def call():
        found = made.offsets(place, moment)
        kept[:] = [found.detach(), *torch.autograd.grad(found, parameters, cotangent)]

    call()
    replay = Captured(call, torch.device("cuda"))
    replay()
    held = list(kept)
    place.mul_(0.5)
    replay()
    call()
    for one, other in zip(held, kept, strict=True):
        assert torch.equal(one, other)
