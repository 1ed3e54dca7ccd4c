"""Displaced Gaussians by kernels against the oracle, finite differences,
and rotations known otherwise.
"""

import inspect
import math

import pytest
import torch
from comparison import DEVICES
from small_runs import random

from gftorf_warp.render import displacement_reference as reference
from gftorf_warp.render.displacement import displaced
from gftorf_warp.scene.gaussians import product
from gftorf_warp.scene.motion import KeyMotion

N = 37
# K, D, rotations
CASES = [(1, 0, False), (2, 0, False), (3, 2, False), (2, 1, True), (4, 0, True), (6, 2, True)]


@pytest.fixture(params=DEVICES)
def device(request):
    """The CPU, and a GPU where there is one."""
    return request.param


def case(keys, channels, rotations):
    """Float64 leaves mean, quaternion, offset and, perhaps, rotation; weights,
    of which row 0 sums to 1.
    """
    values = [random(N, 3), random(N, 4, seed=1), random(keys, N, 3, seed=2)]
    if rotations:
        values.append(torch.tensor([2.0, 0, 0, 0]) + random(keys, N, 4, seed=3))
    weights = random(1 + channels, keys, seed=4)
    weights[0] = weights[0].softmax(0)
    return [value.double() for value in values], weights.double()


def evaluated(function, values, weights, channels, used=(0, 1, 2)):
    """Results, and gradients w.r.t. all values of random weighted sums of those in use."""
    leaves = [value.requires_grad_() for value in values]
    mean, quaternion, offset, *rest = leaves
    motion = KeyMotion(offset, rest[0] if rest else None)
    results = function(mean, quaternion, motion, weights, channels=channels)
    pairs = [
        (results[n], random(*results[n].shape, seed=5 + n).to(results[n]))
        for n in used
        if results[n] is not None
    ]
    loss = sum((result * cotangent).sum() for result, cotangent in pairs)
    return results, torch.autograd.grad(loss, leaves, allow_unused=True)


@pytest.mark.parametrize(
    "used", [(0,), (1,), (2,), (0, 1, 2)], ids=["moved", "turned", "channels", "all"]
)
@pytest.mark.parametrize(("keys", "channels", "rotations"), CASES)
def test_values_and_gradients_are_the_oracles(device, keys, channels, rotations, used):
    """To float32; gradients of each result alone, absent where the oracle's are."""
    if used == (2,) and not channels:
        pytest.skip("no channels")
    values, weights = case(keys, channels, rotations)
    want, slopes = evaluated(reference.displaced, values, weights, channels > 0, used)
    single = [value.detach().float().to(device) for value in values]
    got, gradients = evaluated(displaced, single, weights.float().to(device), channels > 0, used)
    for one, other in zip(got, want, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one.double().cpu(), other, rtol=1e-5, atol=2e-6)
    sizes = []
    for one, other in zip(gradients, slopes, strict=True):
        if one is None or other is None:  # a zero
            assert all(tensor is None or tensor.abs().max() == 0 for tensor in (one, other))
            continue
        sizes.append(float(other.abs().max()))
        torch.testing.assert_close(one.double().cpu(), other, rtol=1e-5, atol=5e-6)
    assert min(sizes) > 0.1, "a vanished gradient would pass any tolerance"


@pytest.mark.parametrize(("keys", "channels", "rotations"), CASES)
def test_the_oracles_gradient_is_that_of_finite_differences(keys, channels, rotations):
    """In float64, of every element."""
    values, weights = case(keys, channels, rotations)
    few = [value[:, :3] if n >= 2 else value[:3] for n, value in enumerate(values)]

    def results(mean, quaternion, offset, *rest):
        motion = KeyMotion(offset, rest[0] if rest else None)
        return tuple(
            result
            for result in reference.displaced(
                mean, quaternion, motion, weights, channels=channels > 0
            )
            if result is not None
        )

    assert torch.autograd.gradcheck(results, [value.clone().requires_grad_() for value in few])


def test_gradients_of_the_kernel_are_those_of_finite_differences(device):
    """Along a random direction of all inputs together."""
    values, weights = case(4, 2, True)
    values, weights = [value.float().to(device) for value in values], weights.float().to(device)
    _, gradients = evaluated(displaced, values, weights, True)
    directions = [random(*value.shape, seed=20 + n).to(device) for n, value in enumerate(values)]
    slope = sum(float((g * d).sum()) for g, d in zip(gradients, directions, strict=True))
    ends, h = [], 1e-2
    for sign in (1, -1):
        moved = [value.detach() + sign * h * d for value, d in zip(values, directions, strict=True)]
        results = displaced(*moved[:2], KeyMotion(*moved[2:]), weights, channels=True)
        ends.append(
            sum(
                float((r.double() * random(*r.shape, seed=5 + n).to(r)).sum())
                for n, r in enumerate(results)
            )
        )
    assert abs(slope) > 1.0
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(slope, rel=5e-3)


def test_without_rotations_orientations_are_the_same_tensor(device):
    """Nothing is copied, and its gradient is its own."""
    values, weights = case(2, 0, False)
    mean, quaternion, offset = (value.float().to(device).requires_grad_() for value in values)
    moved, turned, ways = displaced(
        mean, quaternion, KeyMotion(offset, None), weights.float().to(device), channels=False
    )
    assert turned is quaternion
    assert ways is None
    torch.autograd.grad(moved.sum(), mean)


def test_halfway_between_two_rotations_is_half_the_angle(device):
    """A quarter turn about z at the second key is an eighth of a turn halfway,
    for any quaternion it is applied to.
    """
    half = math.pi / 4
    rotation = torch.tensor(
        [[1.0, 0, 0, 0], [math.cos(half), 0, 0, math.sin(half)]], device=device
    )[:, None]
    own = torch.tensor([[0.5, 0.5, -0.5, 0.5]], device=device)
    zero = torch.zeros(2, 1, 3, device=device)
    weights = torch.tensor([[0.5, 0.5]], device=device)
    _, turned, _ = displaced(zero[0], own, KeyMotion(zero, rotation), weights, channels=False)
    eighth = torch.tensor([[math.cos(half / 2), 0, 0, math.sin(half / 2)]], device=device)
    torch.testing.assert_close(turned, product(eighth, own))


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(device, count):
    """None and one."""
    values, weights = case(3, 1, True)
    values = [value[:, :count] if n >= 2 else value[:count] for n, value in enumerate(values)]
    values = [value.float().to(device) for value in values]
    results, gradients = evaluated(displaced, values, weights.float().to(device), True)
    assert [len(result) for result in results] == [count] * 3
    assert [gradient.shape for gradient in gradients] == [value.shape for value in values]


def test_the_oracle_takes_the_same_arguments():
    """So that a test can call both alike."""
    assert inspect.signature(displaced) == inspect.signature(reference.displaced)


@pytest.mark.contract
def test_numbers_of_keys_that_disagree_and_float64_are_refused():
    """With both numbers in the message."""
    values, weights = case(3, 0, False)
    mean, quaternion, offset = (value.float() for value in values)
    with pytest.raises(ValueError, match=r"weights \(1, 2\) must be \(1 \+ D, 3\)"):
        displaced(mean, quaternion, KeyMotion(offset, None), weights[:, :2].float(), channels=False)
    with pytest.raises(ValueError, match="float32"):
        displaced(
            mean, quaternion, KeyMotion(offset.double(), None), weights.float(), channels=False
        )
