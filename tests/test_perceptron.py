"""The network in half precision: its hand-written gradient is exact, its rounding small,
its overflow seen.
"""

import copy
from dataclasses import replace

import pytest
import torch
from small_runs import KEYS, field, random

from gftorf_warp.render import cublas
from gftorf_warp.render.cublas import CublasLayers
from gftorf_warp.render.layers import Form
from gftorf_warp.render.network import HalfPrecision, Offsets, with_backend
from gftorf_warp.scene.encoding import encoded
from gftorf_warp.scene.motion import MotionSettings, Products
from gftorf_warp.scene.network import Network

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]
SMALL = MotionSettings(width=16, position_frequencies=3, time_frequencies=2, layers=5, skip_after=2)
SHAPES = {  # with a join, without, right behind the first layer, with nothing to pad by
    "small": SMALL,
    "plain": replace(SMALL, layers=2),
    "early": replace(SMALL, skip_after=1),
    "tight": replace(SMALL, position_frequencies=1, time_frequencies=0),
}


def network(settings=MotionSettings(), *, head=0.1, seed=0):
    """A network that moves, over three quartets."""
    generator = torch.Generator().manual_seed(seed)
    made = Network(KEYS, settings, duration=11 / 120, length=7.5, generator=generator)
    with torch.no_grad():
        made.head.weight.normal_(0.0, head, generator=generator)
        for layer in [*made.layers, made.head]:
            layer.bias.normal_(0.0, 0.1, generator=generator)
    return with_backend(made)


def half(settings=MotionSettings()):
    """The same settings in half precision."""
    return replace(settings, products=Products.HALF)


def positions(count):
    """Within three metres [m]."""
    return field(random(count, 3) * 6 - 3, None)


def gradients(made, gaussians, cotangent, keys):
    """Offsets and the gradient of every parameter, by autograd through whatever the network
    does.
    """
    found = made.at_keys(made.bind(gaussians), keys).offset
    return found, torch.autograd.grad((found * cotangent).sum(), list(made.parameters()))


def exact(made, gaussians, cotangent, keys):
    """The plain network in float64."""
    twin = Network(
        KEYS,
        replace(made.settings, products=Products.FLOAT32),
        duration=made.duration,
        length=made.length,
    )
    twin.load_state_dict(made.state_dict())
    return gradients(
        twin.double().to(cotangent.device),
        gaussians.map(torch.Tensor.double),
        cotangent.double(),
        keys,
    )


def distance(one, other):
    """Of two tensors, by the norm of the second."""
    return float((one.detach().double() - other.detach()).norm() / other.detach().norm())


def compare_replay(made, gaussians, cotangent):
    """Capture offsets and gradients at two keys; replay for other positions and times,
    and ask again.
    """
    place, moment = made.bind(gaussians), made.time_encodings[:2].clone()
    parameters = list(made.parameters())

    def call():
        found = made.offsets(place, moment)
        # without its history, which would keep what torch knows of the stream that it began on
        return found.detach(), *torch.autograd.grad((found * cotangent).sum(), parameters)

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        kept = call()
    place.mul_(0.5)
    moment.copy_(made.time_encodings[2:])
    graph.replay()
    for one, other in zip(kept, call(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("shape", SHAPES)
def test_finite_differences_agree_in_float64(shape):
    """Nothing is rounded there, so the derivative by hand is compared with the very function."""
    made = network(SHAPES[shape]).double()
    form = Form.of(made, torch.float64)
    gaussians = positions(7).map(torch.Tensor.double)
    place = encoded(
        gaussians.mean / made.length, made.settings.position_frequencies, columns=form.columns
    )
    moment = made.time_encodings[[0, 2]]
    layers = [*made.layers, made.head]
    parameters = [
        value.detach().requires_grad_() for layer in layers for value in (layer.weight, layer.bias)
    ]
    found = Offsets.apply(form, CublasLayers(), place, moment, *parameters)
    want = exact(made, gaussians, torch.ones_like(found), [0, 2])[0]
    torch.testing.assert_close(found, want, rtol=1e-12, atol=1e-13)
    assert torch.autograd.gradcheck(  # along random directions, not one parameter after the other
        lambda *values: Offsets.apply(form, CublasLayers(), place, moment, *values),
        parameters,
        fast_mode=True,
    )


@pytest.mark.parametrize("keys", [[1], [0, 2, 3]])
def test_in_float32_it_is_the_network(keys):
    """At the published size: offsets and every gradient to 1e-5."""
    made, gaussians = network(half()), positions(50)
    made.backend = HalfPrecision(CublasLayers(), Form.of(made, torch.float32))
    cotangent = random(len(keys), 50, 3, seed=5) - 0.5
    found, got = gradients(made, gaussians, cotangent, keys)
    want, wanted = exact(made, gaussians, cotangent, keys)
    assert found.dtype == torch.float32
    assert distance(found, want) < 1e-5
    for one, other in zip(got, wanted, strict=True):
        assert other.abs().max() > 1e-4, "a vanished gradient would pass any tolerance"
        assert one.shape == other.shape
        assert distance(one, other) < 1e-5


def on_the_same_side(made, gaussians, cotangent, keys):
    """Gradients of the plain network in float64 whose units are at rest where those of the rounded
    one are.
    """
    offsets = made.at_keys(made.bind(gaussians), keys).offset  # kept: what is saved may go with it
    saved = offsets.grad_fn.saved_tensors[-1]
    alive = [rows[:, : made.settings.width] > 0 for rows in saved]
    twin = copy.deepcopy(made).double()
    place = encoded(gaussians.mean.double() / made.length, made.settings.position_frequencies)
    moment = made.time_encodings[keys][:, None].expand(-1, len(place), -1)
    inputs = torch.cat([place.expand(len(keys), -1, -1), moment], dim=2).flatten(0, 1)
    hidden = inputs
    for number, layer in enumerate(twin.layers):
        hidden = (
            torch.cat([hidden, inputs], dim=1) if number == made.settings.skip_after else hidden
        )
        hidden = layer(hidden) * alive[number]
    found = twin.head(hidden).view_as(cotangent)
    return torch.autograd.grad((found * cotangent.double()).sum(), list(twin.parameters()))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_in_half_precision_every_gradient_is_right_to_a_thousandth(device, scale):
    """However small or large the loss is: a mean over 76,800 pixels has gradients that no half can
    hold.

    One unit in ten thousand is at rest in one precision only, and has all of its gradient or none.
    That is no mistake of the gradient: among equals it is right to 1e-3. If gradients of Gaussians
    point the same way, the rest cancels.
    """
    made, gaussians = network(half()).to(device), positions(200).map(lambda value: value.to(device))
    for offset, difference in ((0.0, 3e-2), (0.5, 8e-2)):
        cotangent = (scale * (random(3, 200, 3, seed=5) - offset)).to(device)
        found, got = gradients(made, gaussians, cotangent, [0, 1, 3])
        want, wanted = exact(made, gaussians, cotangent, [0, 1, 3])
        assert found.dtype == torch.float32
        assert 1e-6 < distance(found, want) < 2e-3, "rounded, but not by much"
        equals = on_the_same_side(made, gaussians, cotangent, [0, 1, 3])
        for one, other, equal in zip(got, wanted, equals, strict=True):
            assert other.abs().max() > 1e-4 * scale
            assert one.dtype == torch.float32
            assert distance(one, equal) < 2e-3
            assert distance(one, other) < difference


@pytest.mark.parametrize("device", DEVICES)
def test_sums_over_many_gaussians_are_no_halves(device):
    """What pulls all of them the same way is 10^5 in scaled units, beyond the largest half."""
    made, gaussians = (
        network(half()).to(device),
        positions(1400).map(lambda value: value.to(device)),
    )
    cotangent = torch.ones(2, 1400, 3, device=device)
    _, got = gradients(made, gaussians, cotangent, [0, 2])
    _, wanted = exact(made, gaussians, cotangent, [0, 2])
    assert 64 * wanted[-2].abs().max() > 1.5 * torch.finfo(torch.float16).max
    for one, other in zip(got, wanted, strict=True):
        assert distance(one, other) < 1e-2


def test_the_first_steps_have_gradients_too():
    """The last layer begins at 1e-5, the others learn through it."""
    made, gaussians = network(half(), head=1e-5), positions(200)
    cotangent = 1e-6 * (random(2, 200, 3, seed=5) - 0.5)
    _, got = gradients(made, gaussians, cotangent, [0, 1])
    for one, equal in zip(got, on_the_same_side(made, gaussians, cotangent, [0, 1]), strict=True):
        assert equal.abs().max() > 0
        assert distance(one, equal) < 1e-2


@pytest.mark.parametrize("device", DEVICES)
def test_offsets_of_a_trained_field_differ_by_less_than_a_millimetre(device):
    """A field that turns by decimetres, learnt in float32, asked in half precision."""
    made, gaussians = network(MotionSettings(), head=1e-2), positions(128)
    made, gaussians = made.to(device), gaussians.map(lambda value: value.to(device))
    place, keys = made.bind(gaussians), [0, 1, 2, 3]
    turn = torch.linspace(0, 1, len(keys), device=device)[:, None, None]
    target = 0.3 * turn * torch.sin(1.5 * gaussians.mean.roll(1, dims=1) + turn)
    adam = torch.optim.Adam(made.parameters(), lr=1e-3)
    for _ in range(25):
        adam.zero_grad()
        loss = (made.at_keys(place, keys).offset - target).square().mean()
        loss.backward()
        adam.step()
    assert loss < 0.3 * target.square().mean(), "it has learnt something"
    quick = network(half()).to(device)
    quick.load_state_dict(made.state_dict())
    with torch.no_grad():
        error = (
            quick.at_keys(quick.bind(gaussians), keys).offset - made.at_keys(place, keys).offset
        ).norm(dim=-1)
    assert 0 < error.max() < 1e-3, f"{error.max()} m"


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("where", ["activation", "gradient", "loss"])
def test_overflow_ends_in_a_gradient_that_is_not_finite(device, where):
    """So that the step is skipped, wherever it happened."""
    made, gaussians = network(half()).to(device), positions(30).map(lambda value: value.to(device))
    cotangent = random(2, 30, 3).to(device)
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
            cotangent[1, 4, 2] = torch.inf
    found, got = gradients(made, gaussians, cotangent, [0, 1])
    assert found.isfinite().all() or where == "activation"
    assert not torch.nn.utils.get_total_norm(got).isfinite()


def test_rows_may_go_through_the_layers_in_parts(monkeypatch):
    """Of unequal length here, three to a key, and four rows side by side in sums;
    the results are the same.
    """
    made, gaussians, cotangent = network(half()), positions(172), random(2, 172, 3)
    whole = gradients(made, gaussians, cotangent, [0, 2])
    monkeypatch.setattr(cublas, "PIECE", 60)
    rows, product = [], torch._addmm_activation
    monkeypatch.setattr(
        torch, "_addmm_activation", lambda *a, **k: rows.append(len(a[1])) or product(*a, **k)
    )
    parts = gradients(made, gaussians, cotangent, [0, 2])
    assert sorted({*rows}) == [57, 58]
    for one, other in zip([parts[0], *parts[1]], [whole[0], *whole[1]], strict=True):
        assert other.abs().max() > 0
        assert distance(one, other) < 1e-3


@pytest.mark.parametrize("keys", [1, 3, 9])
@pytest.mark.parametrize("count", [5, 192])
def test_sums_over_rows_are_those_of_their_key(keys, count):
    """Also of more keys than 16 bytes hold, and of a number of rows that no power of two
    divides.
    """
    made = network(half()).double()
    form = Form.of(made, torch.float64)
    binding = encoded(positions(count).mean.double() / made.length, made.powers)
    parameters = [*made.layers, made.head]
    weights, biases = ([getattr(p, n).detach() for p in parameters] for n in ("weight", "bias"))
    layers = cublas.CublasLayers()
    binding = torch.nn.functional.pad(binding, (0, form.columns - form.position))
    time = made.time_encodings[[k % 3 for k in range(keys)]]
    outputs, _, saved = layers.forward(form, binding, time, weights, biases)
    found = layers.backward(form, keys, random(keys * count, 3).double(), outputs, saved)
    want = found.layers.unflatten(1, (keys, count)).sum(2)
    assert want.abs().max() > 0
    torch.testing.assert_close(found.sums, want)


def test_a_loss_without_gradient_has_none():
    """Nothing is divided by the largest of zeros."""
    made = network(half())
    _, got = gradients(made, positions(9), torch.zeros(2, 9, 3), [0, 1])
    assert all(torch.equal(one, torch.zeros_like(one)) for one in got)


def test_two_calls_agree_to_the_bit():
    """Sums have a fixed order."""
    made, gaussians, cotangent = network(half()), positions(300), random(2, 300, 3)
    first, again = (gradients(made, gaussians, cotangent, [0, 2]) for _ in range(2))
    assert torch.equal(first[0], again[0])
    assert all(torch.equal(one, other) for one, other in zip(first[1], again[1], strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_replay_equals_a_call():
    """Captured with its gradient; also with other positions and times written in between."""
    made, gaussians = (
        network(half()).to("cuda"),
        positions(2000).map(lambda value: value.to("cuda")),
    )
    compare_replay(made, gaussians, random(2, 2000, 3).to("cuda"))


def test_bound_positions_are_aligned_halves():
    """Encoded once for all calls of a step: 63 values and one of zeros."""
    made, gaussians = network(half()), positions(5)
    place = made.bind(gaussians)
    assert (place.dtype, place.shape) == (torch.float16, (5, 64))
    torch.testing.assert_close(
        place[:, :63].float(), encoded(gaussians.mean / 7.5, 10), rtol=1e-3, atol=1e-4
    )
    assert place[:, 63].abs().max() == 0
    assert Form(position=63, time=0, width=8, joined=None, dtype=torch.float16).columns == 63, (
        "no wider than a weight"
    )


def test_parameters_and_stored_form_are_those_of_float32():
    """Precision is a matter of speed: a checkpoint knows no difference."""
    plain, quick = network(), network(half())
    assert [*plain.state_dict()] == [*quick.state_dict()]
    for one, other in zip(
        plain.state_dict().values(), copy.deepcopy(quick).state_dict().values(), strict=True
    ):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
