"""The motion network: its size, what it computes, its small initial displacements,
and its checkpoints.
"""

import copy

import pytest
import torch
from small_runs import KEYS, field, random

from gftorf_warp.scene.encoding import encoded
from gftorf_warp.scene.motion import MotionSettings, Products
from gftorf_warp.scene.network import Network


def network(settings=MotionSettings(), *, seed=0, head=None):
    """A network over three quartets of twelve frames; ``head``: deviation of the last layer,
    to see it move.
    """
    generator = torch.Generator().manual_seed(seed)
    made = Network(KEYS, settings, duration=11 / 120, length=7.5, generator=generator)
    if head is not None:
        with torch.no_grad():
            made.head.weight.normal_(0.0, head, generator=generator)
            for layer in made.layers:
                layer.bias.normal_(0.0, 0.1, generator=generator)
    return made


def spelt_out(motion, position, key):
    """What a float64 network gives, every input joined as the method has it."""
    settings, time = (
        motion.settings,
        torch.full((len(position), 1), float(KEYS[key]) / motion.duration).double(),
    )
    parts = (
        (position.double() / motion.length, settings.position_frequencies),
        (time, settings.time_frequencies),
    )
    inputs = torch.cat([_gamma(*part) for part in parts], dim=1)
    hidden = inputs
    for number, layer in enumerate(motion.layers):
        hidden = torch.relu(
            layer(torch.cat([hidden, inputs], dim=1) if number == settings.skip_after else hidden)
        )
    return motion.head(hidden)


def _gamma(value, frequencies):
    rows = [value]
    for power in range(frequencies):
        rows += [(2.0**power * value).sin(), (2.0**power * value).cos()]
    return torch.cat(rows, dim=1)


def test_it_has_the_published_size():
    """84 inputs, eight layers of 256, the input again before the sixth, three outputs."""
    made = network()
    assert sum(parameter.numel() for parameter in made.parameters()) == 504_579
    assert [layer.weight.shape[1] for layer in made.layers] == [
        84,
        256,
        256,
        256,
        256,
        340,
        256,
        256,
    ]


def test_it_computes_what_the_method_says():
    """Sharing the part of the positions between keys changes nothing but rounding;
    four layers without a skip too.
    """
    position = random(40, 3) * 6 - 3
    for settings in (MotionSettings(), MotionSettings(layers=4, width=32)):
        made = network(settings, head=0.1)
        binding = made.bind(field(position, None))
        got = made.at_keys(binding, [0, 2, 3]).offset
        for row, key in zip(got, (0, 2, 3), strict=True):
            want = spelt_out(copy.deepcopy(made).double(), position, key)
            assert want.abs().max() > 0.01
            torch.testing.assert_close(row.double(), want, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(
                made.at_keys(binding, [key]).offset[0], row, rtol=1e-4, atol=1e-6
            )
    assert (got[0] - got[1]).abs().max() > 1e-3, "it depends on time"


def test_gradients_reach_every_weight_and_no_position():
    """Those of the weights are the ones of the network spelt out."""
    made, position = network(head=0.1), (random(25, 3) * 4).requires_grad_()
    cotangent = random(25, 3, seed=5)
    parameters = list(made.parameters())
    gaussians = field(position, None)
    loss = (made.at(made.bind(gaussians), 5 / 120).offset * cotangent).sum()
    *got, none = torch.autograd.grad(loss, [*parameters, position], allow_unused=True)
    assert none is None
    twin = copy.deepcopy(made).double()
    ends = [spelt_out(twin, position.detach(), key) for key in (1, 2)]
    want = torch.autograd.grad(
        ((0.75 * ends[0] + 0.25 * ends[1]) * cotangent).sum(), list(twin.parameters())
    )
    for one, other in zip(got, want, strict=True):
        assert other.abs().max() > 1e-6
        torch.testing.assert_close(
            one.double(), other, rtol=2e-3, atol=2e-4 * float(other.abs().max())
        )


def test_it_starts_at_rest_and_the_same_for_a_seed():
    """To a fraction of a millimetre."""
    position = random(200, 3) * 6 - 3
    made = network()
    moved = made.at(made.bind(field(position, None)), 0.05).offset.abs().max()
    assert 0 < moved < 5e-4
    for one, other in zip(network(seed=3).parameters(), network(seed=3).parameters(), strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(network(seed=3).head.weight, network(seed=4).head.weight)


def test_encoding_has_no_factor_pi():
    """gamma(v) = [v, sin v, cos v, sin 2v, cos 2v, ..];
    the order of the waves is a convention of the weights only.
    """
    value = torch.tensor([[0.3]])
    got = sorted(encoded(value, 2)[0].tolist())
    want = sorted(
        [
            0.3,
            *(float(wave(torch.tensor(a))) for a in (0.3, 0.6) for wave in (torch.sin, torch.cos)),
        ]
    )
    assert got == pytest.approx(want)
    assert encoded(torch.zeros(4, 3), 10).shape == (4, 63)
    assert encoded(torch.zeros(4, 1), 10).shape == (4, 21)


def test_layers_say_nothing_to_a_network():
    """Nodes do not move the static layer; a network has no layers."""
    made, position = network(head=0.1), random(30, 3)
    static = made.at_keys(
        made.bind(field(position, torch.zeros(30, dtype=torch.long))), [1]
    ).offset[0]
    assert static.any(dim=1).all()
    assert torch.equal(static, made.at_keys(made.bind(field(position, None)), [1]).offset[0])


@pytest.mark.contract
def test_what_cannot_be_meant_is_refused():
    """No time, no length, no layer."""
    with pytest.raises(ValueError, match=r"duration.*0"):
        Network(KEYS, MotionSettings(), duration=0.0, length=7.5)
    with pytest.raises(ValueError, match="width"):
        MotionSettings(width=0)
    with pytest.raises(ValueError, match="input_scale"):
        MotionSettings(input_scale=0.0)


def test_a_run_with_tf32_is_read_as_float32(caplog):
    """Earlier versions had it: a thousandth off, faster on a GPU."""
    made = network(MotionSettings())
    stored = made.to_dict()
    stored["shape"]["products"] = "tf32"
    with caplog.at_level("WARNING"):
        assert Network.from_dict(stored).settings.products == Products.FLOAT32
    assert "tf32 is no longer supported" in caplog.text
    with pytest.raises(ValueError, match="bfloat16"):
        Products("bfloat16")
