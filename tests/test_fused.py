"""Kernels of a training step beside rendering, against plain torch in float64,
torch's Adam and published numbers.
"""

import math

import numpy as np
import pytest
import torch
from comparison import DEVICES
from plain_step import plain_loss

from gftorf_warp.losses.image import similarity
from gftorf_warp.recon.settings import Norm
from gftorf_warp.render import descent, fused

# shorter than a window, than a block, odd
SIZES = [(1, 120, 160), (3, 37, 53), (2, 9, 11), (1, 5, 16), (1, 12, 33)]
# Random123's known answer for key and counter 0
PHILOX_OF_ZERO = (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)


@pytest.fixture(params=DEVICES)
def device(request):
    """Where there is a GPU, it is tested, too."""
    return request.param


def image(shape, seed, smooth=False):
    """Seeded values in [-1, 1], or a few waves of that size plus a hundredth of it."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(shape, generator=generator) * 2 - 1
    if not smooth:
        return noise
    y, x = (torch.arange(n) for n in shape[1:])
    waves = torch.sin(0.05 * seed + 0.11 * y[:, None]) * torch.cos(0.07 * x)
    return (0.9 * waves + 0.01 * noise).contiguous()


def oracle(rendered, measured, ssim, norm):
    """Loss and gradient in float64."""
    leaf = rendered.double().requires_grad_()
    loss, squared = plain_loss(leaf, measured.double(), ssim, norm)
    return loss.detach(), squared, torch.autograd.grad(loss, leaf)[0]


@pytest.mark.parametrize("norm", list(Norm))
@pytest.mark.parametrize("smooth", [False, True], ids=["noise", "smooth"])
@pytest.mark.parametrize("block", [16, 1], ids=["vectors", "pixels"])
@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_loss_of_an_image_is_the_oracles(monkeypatch, device, shape, block, smooth, norm):
    """Value to 1e-5, gradient to 2e-6 of its largest, 3e-5 where variance cancels:
    in blocks and pixel by pixel.
    """
    monkeypatch.setattr(fused, "BLOCK", block)
    rendered, measured = (
        image(shape, 1, smooth).to(device).requires_grad_(),
        image(shape, 2, smooth).to(device),
    )
    loss, squared, _ = fused.image_loss(rendered, measured, 0.2, absolute=norm == Norm.L1)
    (gradient,) = torch.autograd.grad(3.0 * loss, rendered)
    want, want_squared, want_gradient = oracle(rendered.detach(), measured, 0.2, norm)
    torch.testing.assert_close(loss.double(), want, rtol=1e-5, atol=0)
    torch.testing.assert_close(squared.double(), want_squared, rtol=1e-5, atol=0)
    scale = float(want_gradient.abs().max())
    assert scale > 1e-2 / rendered.numel(), "a gradient of zero would pass any test"
    torch.testing.assert_close(
        gradient.double() / 3, want_gradient, rtol=1e-5, atol=(3e-5 if smooth else 2e-6) * scale
    )
    assert not squared.requires_grad


def test_its_gradient_is_that_of_finite_differences(device):
    """Along a random direction and along the gradient itself,
    where it must be the square of its length.
    """
    rendered, measured = (
        image((1, 24, 40), 1).to(device).requires_grad_(),
        image((1, 24, 40), 2).to(device),
    )
    loss, *_ = fused.image_loss(rendered, measured, 0.6)
    (gradient,) = torch.autograd.grad(loss, rendered)
    assert gradient.norm() > 1e-3
    for direction in (gradient / gradient.abs().max(), image((1, 24, 40), 3).to(device)):
        h = 2e-3
        ends = [
            fused.image_loss(rendered.detach() + s * h * direction, measured, 0.6)[0].double()
            for s in (1, -1)
        ]
        slope = float(ends[0] - ends[1]) / (2 * h)
        assert slope == pytest.approx(float((gradient * direction).sum()), rel=5e-3, abs=2e-4)


def test_without_a_similarity_only_the_difference_is_left(device):
    """Share 0, in closed form: 2 (r - m) / n; share 1 of equal images: nothing is left at all."""
    rendered, measured = (
        image((2, 20, 30), 1).to(device).requires_grad_(),
        image((2, 20, 30), 2).to(device),
    )
    loss, squared, _ = fused.image_loss(rendered, measured, 0.0)
    (gradient,) = torch.autograd.grad(loss, rendered)
    torch.testing.assert_close(
        gradient, 2 * (rendered - measured).detach() / rendered.numel(), rtol=1e-5, atol=1e-9
    )
    torch.testing.assert_close(loss, squared)
    loss, *_ = fused.image_loss(measured.clone().requires_grad_(), measured, 1.0)
    assert abs(float(loss.detach())) < 1e-5


@pytest.mark.parametrize("contrast", [1.0, 1e-2, 1e-3])
def test_bright_images_of_little_contrast_cancel_no_worse_than_in_torch(device, contrast):
    """Variance as a difference of squares loses digits there; both forms lose them alike."""
    measured = (0.8 + contrast * image((1, 40, 48), 2)).to(device)
    rendered = (0.8 + contrast * image((1, 40, 48), 1)).to(device).requires_grad_()
    (gradient,) = torch.autograd.grad(fused.image_loss(rendered, measured, 1.0)[0], rendered)
    (twin,) = torch.autograd.grad(1.0 - similarity(rendered, measured).mean(), rendered)
    *_, want = oracle(rendered.detach(), measured, 1.0, Norm.L2)
    errors = [float((g.double() - want).norm() / want.norm()) for g in (gradient, twin)]
    assert errors[0] < max(3 * errors[1], 1e-6)
    assert errors[0] < 1e-3


@pytest.mark.parametrize("shape", [(1, 37, 53), (2, 9, 11), (1, 12, 33)], ids=str)
def test_a_row_of_many_images_is_compared_in_kept_memory(device, shape):
    """As that row alone, to the bit, also in planes that a loss before has used;
    the opacity is summed up beside it.
    """
    measured = torch.stack([image(shape, n) for n in range(2, 5)]).to(device)
    rendered, opacity = (
        image(shape, 1).to(device).requires_grad_(),
        image((1, *shape[1:]), 5)[0].to(device),
    )
    scratch, out = fused.Scratch(), torch.zeros(3, device=device)
    for n in (2, 0):
        row = torch.tensor([n], dtype=torch.int32, device=device)
        place = {"row": row, "scratch": scratch, "out": out}
        loss, squared, other = fused.image_loss(rendered, measured, 0.2, opacity=opacity, **place)
        (gradient,) = torch.autograd.grad(loss, rendered)
        want, want_squared, nothing = fused.image_loss(rendered, measured[n], 0.2)
        (want_gradient,) = torch.autograd.grad(want, rendered)
        assert torch.equal(gradient, want_gradient)
        assert torch.equal(loss, want)
        assert torch.equal(squared, want_squared)
        assert out.tolist() == [float(value.detach()) for value in (loss, squared, other)]
        torch.testing.assert_close(other, opacity.sum() / rendered.numel(), rtol=1e-5, atol=1e-6)
        assert float(nothing) == 0


def test_images_that_do_not_fit_are_refused():
    """Shape and precision are checked before any kernel reads them."""
    with pytest.raises(ValueError, match=r"\(1, 8, 9\).*\(1, 9, 8\)"):
        fused.image_loss(torch.zeros(1, 8, 9), torch.zeros(1, 9, 8), 0.2)
    with pytest.raises(ValueError, match="float64"):
        fused.image_loss(torch.zeros(1, 8, 9), torch.zeros(1, 8, 9, dtype=torch.float64), 0.2)


def origin(seed, number, device="cpu"):
    """What names an image."""
    return torch.tensor([seed, number], dtype=torch.int32, device=device)


def test_noise_begins_with_the_known_answer(device):
    """The first four pixels are the published words of Philox 4x32-10 for a key and a counter of
    zero.
    """
    drawn = fused.uniform((1, 1, 4), origin(0, 0, device), 3.0).flatten().double().cpu().numpy()
    words = np.array(PHILOX_OF_ZERO, dtype=np.uint64) >> np.uint64(9)
    np.testing.assert_allclose(drawn, 3.0 * (2.0 * (words + 0.5) * 2.0**-23 - 1.0), rtol=1e-6)


def test_noise_depends_on_seed_image_stream_channel_and_pixel_only(device):
    """Not on how many channels or pixels are asked for; and on each of the five."""
    whole = fused.uniform((3, 10, 7), origin(5, 9, device), 1.0)
    assert torch.equal(fused.uniform((2, 10, 7), origin(5, 9, device), 1.0), whole[:2])
    assert torch.equal(
        fused.uniform((3, 1, 33), origin(5, 9, device), 1.0).flatten(1), whole.flatten(1)[:, :33]
    )
    others = [
        fused.uniform((3, 10, 7), origin(*names, device), 1.0)
        for names in ((6, 9), (5, 10), (9, 5))
    ]
    others.append(fused.uniform((3, 10, 7), origin(5, 9, device), 1.0, stream=1))
    for other in others:
        assert (other != whole).float().mean() > 0.99
    assert len(torch.unique(whole)) > 205, "no channel and no pixel repeats another"


def test_noise_is_uniform_and_without_memory(device):
    """Moments, a histogram and correlations of 300,000 values,
    each within five standard deviations.
    """
    first, second = (
        fused.uniform((3, 250, 400), origin(11, n, device), 2.0).double().flatten() for n in (0, 1)
    )
    n = first.numel()
    assert first.abs().max() < 2.0
    assert abs(float(first.mean())) < 5 * 2.0 / math.sqrt(3 * n)
    assert float(first.square().mean()) == pytest.approx(
        4 / 3, abs=5 * 4 * math.sqrt((1 / 5 - 1 / 9) / n)
    )
    counts = torch.histc(first.float().cpu(), bins=64, min=-2.0, max=2.0).double()
    assert float(((counts - n / 64).square() / (n / 64)).sum()) < 63 + 5 * math.sqrt(2 * 63)
    for other in (second, first.roll(1), first.roll(4), first.roll(400), first.roll(100_000)):
        assert abs(float((first * other).mean()) * 3 / 4) < 5 / math.sqrt(n)


def adam_case(device):
    """Tensors of awkward lengths with rates and gradients of very different size."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(37, 3), (37,), (5, 4, 3), (16,), (1,), (64, 33)]
    values = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
    rates = [1e-3, 5e-2, 3e-2, 1e-4, 1e-2, 2e-3]

    def gradients():
        drawn = (torch.randn(shape, generator=generator) for shape in shapes)
        return [gradient.to(device) * 10.0 ** (-3 * k) for k, gradient in enumerate(drawn)]

    return values, rates, gradients


def moments_of(values):
    """Zero moments, as torch's Adam keeps them."""
    return [
        (torch.zeros((), device=x.device), torch.zeros_like(x), torch.zeros_like(x)) for x in values
    ]


def one_step(values, gradients, moments, rates, images=1, motion_from=None, longest=None):
    """A step with everything in device memory, after images whose loss is zero; whether it was
    valid.

    ``gradients`` are one list or, as a tuple, several of which the sum counts.
    """
    device = values[0].device
    output = descent.StepResults.empty(images, 1, device)
    table = descent.AdamTable(values, moments)
    table.point(gradients if isinstance(gradients, tuple) else (gradients,))
    table.send()
    descent.descend(
        table,
        torch.tensor(rates, device=device),
        output,
        torch.zeros(images, 3, device=device),
        torch.ones(1, device=device),
        images=images,
        motion_from=len(values) if motion_from is None else motion_from,
        motion_gradient_max=longest,
        capacity=0,
        betas=(0.9, 0.999),
        epsilon=1e-15,
    )
    return output.counts[0].item() == 0


@pytest.mark.parametrize("block", [16, 1], ids=["vectors", "elements"])
def test_adam_is_torchs_over_fifty_steps(monkeypatch, device, block):
    """Parameters and moments to 1e-6 of their size, with gradients from 1 to 1e-15."""
    monkeypatch.setattr(descent, "BLOCK", block)
    values, rates, gradients = adam_case(device)
    twins = [value.clone().requires_grad_() for value in values]
    groups = [{"params": [twin], "lr": rate} for twin, rate in zip(twins, rates, strict=True)]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=True)
    moments = moments_of(values)
    for _ in range(50):
        drawn = gradients()
        for twin, gradient in zip(twins, drawn, strict=True):
            twin.grad = gradient.clone()
        adam.step()
        assert one_step(values, drawn, moments, rates)
    for value, twin, (step, first, second) in zip(values, twins, moments, strict=True):
        torch.testing.assert_close(value, twin.detach(), rtol=1e-6, atol=1e-6)
        state = adam.state[twin]
        assert float(step) == 50
        scale = float(state["exp_avg"].abs().max())
        torch.testing.assert_close(first, state["exp_avg"], rtol=1e-5, atol=1e-6 * scale)
        torch.testing.assert_close(second, state["exp_avg_sq"], rtol=3e-5, atol=1e-6 * scale**2)


@pytest.mark.parametrize("images", [1, 2, 3, 4])
def test_gradients_of_several_images_count_as_their_sum(device, images):
    """In Adam, in the length of what is shortened and in what is valid; whoever of them has none,
    the others count.
    """
    values, rates, gradients = adam_case(device)
    lists = tuple(gradients() for _ in range(images))
    for n, found in enumerate(lists[:-1]):
        # one that another image has, and one that the last image alone has
        found[n], found[4] = None, None
    sums = [sum(g for g in each if g is not None) for each in zip(*lists, strict=True)]
    ends = []
    for given in (lists, sums):
        own = [value.clone() for value in values]
        moments = moments_of(own)
        for _ in range(2):  # all but the first are the motion's
            assert one_step(own, given, moments, rates, images, motion_from=1, longest=1e-3)
        ends.append([(value, *kept) for value, kept in zip(own, moments, strict=True)])
    for one, other in zip(*ends, strict=True):
        for x, y in zip(one, other, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-12)
    moved = float(torch.cat([first.flatten() for _, _, first, _ in ends[0][1:]]).norm())
    assert moved == pytest.approx(0.19 * 1e-3, rel=0.01), (
        "the gradient was shortened by the length of the sum"
    )
    lists[-1][-1] = torch.full_like(values[-1], math.inf)
    assert not one_step(values, lists, moments_of(values), rates, images)


def test_adam_rests_at_rate_zero_and_when_a_step_is_invalid(device):
    """To the bit, moments and step included; and the other tensors go on."""
    values, rates, gradients = adam_case(device)
    moments = moments_of(values)
    assert one_step(values, gradients(), moments, rates)
    before = [
        [x.clone() for x in (value, *kept)] for value, kept in zip(values, moments, strict=True)
    ]
    assert not one_step(values, [g * math.nan for g in gradients()], moments, rates)
    for old, value, kept in zip(before, values, moments, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(old, (value, *kept), strict=True))
    assert one_step(values, gradients(), moments, [0.0, *rates[1:]])
    for n, (old, value, kept) in enumerate(zip(before, values, moments, strict=True)):
        assert all(torch.equal(x, y) == (n == 0) for x, y in zip(old, (value, *kept), strict=True))


def test_adam_refuses_what_it_cannot_address():
    """An address says nothing of strides, precision or device."""
    value = torch.zeros(4, 3)
    with pytest.raises(ValueError, match="contiguous"):
        one_step([value.T], [value.T], moments_of([value.T]), [1.0])
    with pytest.raises(ValueError, match=r"\(3, 4\).*\(4, 3\)"):
        one_step([value], [torch.zeros(3, 4)], moments_of([value]), [1.0])
