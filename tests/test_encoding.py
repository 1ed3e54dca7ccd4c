"""gamma(x) and gamma(t) in the precision of a step: by one kernel and by torch,
within a half of what float64 gives.
"""

import math

import pytest
import torch
from small_runs import field, random
from test_perceptron import half, network

from gftorf_warp.render.cublas import CublasLayers
from gftorf_warp.render.layers import Form
from gftorf_warp.render.network import HalfPrecision
from gftorf_warp.render.tensor_cores import FusedLayers
from gftorf_warp.scene.encoding import encoded, powers_of_two
from gftorf_warp.scene.motion import MotionSettings

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]
LENGTH = 7.5


def halves_between(one, other):
    """How many halves lie between two tensors of halves, element by element: 0 means equal,
    1 neighbours.
    """
    ordered = [
        torch.where(bits < 0, -32768 - bits, bits)
        for bits in (t.view(torch.int16).int() for t in (one, other))
    ]
    return (ordered[0] - ordered[1]).abs()


def wanted(mean, frequencies, columns):
    """Rounded once: float32 positions over a length in float32, as both ways begin,
    everything else in float64.
    """
    return encoded((mean / LENGTH).double(), frequencies, columns=columns).half()


def anywhere(count):
    """Positions within metres, far away, next to zero,
    and where waves of high frequency are near zero [m].
    """
    rows = random(count, 3) * 12 - 6
    rows[::5] *= 50
    rows[1::5] *= 1e-6
    rows[2::5] = LENGTH * math.pi / 512 * torch.arange(1, 1 + len(rows[2::5]))[:, None]
    rows[:1] = 0.0
    return rows


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("frequencies", "columns"), [(10, 64), (10, 63), (9, 64), (9, 57), (0, 8)])
@pytest.mark.parametrize("count", [1, 33, 3_000])
def test_a_kernel_encodes_to_the_last_half(count, frequencies, columns, device):
    """Arguments of 20,000 rad and of 1e-9 alike; zeros behind the values, nothing unwritten."""
    mean = anywhere(count)
    powers = powers_of_two(frequencies).to(device)
    got = (
        FusedLayers()
        .encode(mean.to(device), LENGTH, powers, columns=columns, dtype=torch.float16)
        .cpu()
    )
    want = wanted(mean, frequencies, columns)
    assert got.shape == (count, columns)
    assert got.dtype == torch.float16
    apart = halves_between(got, want)
    assert apart.max() <= 1
    assert (apart == 0).float().mean() > 0.99, "two roundings differ from one now and then"
    assert not got[:, 3 + 6 * frequencies :].any()


@pytest.mark.parametrize("device", DEVICES)
def test_torch_and_the_kernel_encode_alike(device):
    """On a GPU torch multiplies by 1 / length, so that arguments of both differ by a rounding,
    2^9 times.
    """
    mean, powers = anywhere(500).to(device), powers_of_two(10).to(device)
    one, other = (
        way.encode(mean, LENGTH, powers, columns=64, dtype=torch.float16)
        for way in (FusedLayers(), CublasLayers())
    )
    if device == "cpu":
        assert halves_between(one, other).max() <= 1
    argument = 2.0**9 * float(mean.abs().max()) / LENGTH
    torch.testing.assert_close(one.float(), other.float(), rtol=1e-3, atol=argument * 2.0**-23)


def test_positions_may_lie_apart_and_may_be_none():
    """Rows of a wider tensor, and no Gaussians at all."""
    wide, powers = anywhere(20).repeat(1, 2), powers_of_two(10)
    mean = wide[:, 3:]
    assert not mean.is_contiguous()
    for rows in (mean, mean[:0]):
        got = FusedLayers().encode(rows, LENGTH, powers, columns=64, dtype=torch.float16)
        assert got.shape == (len(rows), 64)
        assert torch.equal(
            got,
            FusedLayers().encode(
                rows.contiguous(), LENGTH, powers, columns=64, dtype=torch.float16
            ),
        )


def test_a_network_is_encoded_by_its_backend(monkeypatch):
    """By cuBLAS's layers with torch, by kernels with those; without a backend in float32."""
    asked = []
    encode = FusedLayers.encode

    def counted(self, mean, *given, **named):
        asked.append(len(mean))
        return encode(self, mean, *given, **named)

    monkeypatch.setattr(FusedLayers, "encode", counted)
    quick, plain, gaussians = network(half()), network(), field(anywhere(40), None)
    first = quick.bind(gaussians)
    assert not asked
    quick.backend = HalfPrecision(FusedLayers(), Form.of(quick))
    got = quick.bind(gaussians)
    assert asked == [40]
    assert halves_between(first, got).max() <= 1
    assert plain.bind(gaussians).dtype == torch.float32
    quick.backend = HalfPrecision(CublasLayers(), Form.of(quick))
    assert torch.equal(quick.bind(gaussians), first)
    assert asked == [40]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("settings", [MotionSettings(), half()], ids=["float32", "half"])
def test_times_are_rounded_once_and_in_advance(settings, device):
    """Rows chosen in float32 are the rows chosen in float64 and rounded then, to the bit,
    and so are offsets.
    """
    made, gaussians = (
        network(settings).to(device),
        field(anywhere(20), None).map(lambda value: value.to(device)),
    )
    assert torch.equal(made.time_encodings_f32, made.time_encodings.float())
    assert not torch.equal(made.time_encodings_f32.double(), made.time_encodings), (
        "otherwise nothing was rounded"
    )
    binding = made.bind(gaussians)
    for keys in ([0, 2, 3], torch.tensor([3, 0], dtype=torch.int32, device=device)):
        want = made.offsets(binding, made.time_encodings[keys])
        assert torch.equal(made.at_keys(binding, keys).offset, want)


def test_in_float64_times_are_not_rounded():
    """A network that became one of float64 reads the table of float64."""
    made, gaussians = network().double(), field(anywhere(20).double(), None)
    binding, keys = made.bind(gaussians), [0, 2, 3]
    got = made.at_keys(binding, keys).offset
    assert torch.equal(got, made.offsets(binding, made.time_encodings[keys]))
    assert not torch.equal(got, made.offsets(binding, made.time_encodings_f32[keys]))
