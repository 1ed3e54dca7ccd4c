"""Motion: interpolation between keys, binding of Gaussians to nodes, and gradients."""

import pytest
import torch
from small_runs import KEYS, field, random

from gftorf_warp.scene.motion import Nodes, Still, farthest_points


@pytest.fixture
def nodes():
    """Four nodes in one moving layer, two in another."""
    layer = torch.tensor([1, 1, 1, 1, 2, 2])
    return Nodes(KEYS, random(6, 3), layer, random(4, 6, 3, seed=1), neighbours=3)


@pytest.fixture
def gaussians():
    """Nine Gaussians in three layers, two of them static."""
    return field(random(9, 3, seed=2), torch.tensor([0, 1, 1, 2, 0, 1, 2, 1, 1]))


@pytest.mark.parametrize("frame", [0, 1, 2, 3, 4, 6, 9, 11])
def test_inside_a_quartet_motion_is_linear(nodes, gaussians, frame):
    """x(j) = (i + 1 - j) x(i) + (j - i) x(i + 1), i = floor(j)."""
    binding = nodes.bind(gaussians)
    i, j = frame // 4, frame / 4
    start, end = nodes.at_keys(binding, [i, i + 1]).offset
    want = (i + 1 - j) * start + (j - i) * end
    torch.testing.assert_close(nodes.at(binding, frame / 120).offset, want, rtol=1e-5, atol=1e-6)


def test_several_times_are_asked_for_at_once(nodes, gaussians, monkeypatch):
    """Beyond the ends, on a key and between keys; each key only once."""
    binding, times = nodes.bind(gaussians), [-1.0, float(KEYS[1]), 0.5 * float(KEYS[1]), 9.0]
    want = [nodes.at(binding, time).offset for time in times]
    asked, at_keys = [], nodes.at_keys
    monkeypatch.setattr(nodes, "at_keys", lambda of, keys: asked.append(keys) or at_keys(of, keys))
    for one, other in zip(nodes.at_times(binding, times), want, strict=True):
        torch.testing.assert_close(one.offset, other, rtol=0, atol=0)
    assert asked == [[0, 1, 3]]


def test_motion_is_continuous_at_keys_and_holds_beyond_the_ends(nodes, gaussians):
    """Any time is allowed."""
    binding = nodes.bind(gaussians)
    key = float(KEYS[1])
    before, after = (nodes.at(binding, key + dt).offset for dt in (-1e-7, 1e-7))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-5)
    torch.testing.assert_close(
        nodes.at(binding, -5.0).offset, nodes.at_keys(binding, [0]).offset[0]
    )
    torch.testing.assert_close(nodes.at(binding, 1e3).offset, nodes.at_keys(binding, [3]).offset[0])
    assert (
        nodes.at_keys(binding, [0]).offset[0] - nodes.at_keys(binding, [3]).offset[0]
    ).abs().max() > 0.05


def test_gaussians_follow_nodes_of_their_own_layer_and_the_static_layer_is_pinned(nodes, gaussians):
    """Whatever node is nearest."""
    binding = nodes.bind(gaussians)
    moving = gaussians.layer > 0
    torch.testing.assert_close(binding.sum(dim=1), moving.float())
    for row, layer in zip(binding, gaussians.layer, strict=True):
        assert (row[nodes.layer != layer] == 0).all()
        assert (row > 0).sum() <= 3
    assert nodes.at(binding, 0.05).offset[~moving].abs().max() == 0
    assert nodes.bind(field(random(3, 3), None)).abs().max() == 0


def test_nearer_nodes_count_more():
    """And two nodes equally far count the same."""
    motion = Nodes(KEYS, torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]), torch.tensor([1, 1]))
    weights = motion.bind(
        field(torch.tensor([[0.0, 0, 0], [0.4, 0, 0], [0.5, 0, 0]]), torch.ones(3, dtype=int))
    )
    assert weights[0, 0] > weights[1, 0] > 0.5
    torch.testing.assert_close(weights[2], torch.tensor([0.5, 0.5]))
    points = random(20, 3)
    alone = Nodes(KEYS, random(6, 3, seed=1), torch.ones(6, dtype=torch.long), neighbours=1)
    nearest = torch.cdist(points, alone.node).argmin(dim=1)
    want = torch.nn.functional.one_hot(nearest, 6).float()
    torch.testing.assert_close(alone.bind(field(points, torch.ones(20, dtype=torch.long))), want)


def test_gradient_reaches_the_two_keys_around_a_time_only(nodes, gaussians):
    """With the weights of the interpolation."""
    binding = nodes.bind(gaussians)
    cotangent = random(9, 3, seed=3)
    (gradient,) = torch.autograd.grad(
        (nodes.at(binding, 5 / 120).offset * cotangent).sum(), nodes.offset
    )
    assert gradient[[0, 3]].abs().max() == 0
    torch.testing.assert_close(gradient[1], 0.75 * binding.T @ cotangent, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(gradient[2], 0.25 * binding.T @ cotangent, rtol=1e-4, atol=1e-6)


def test_still_moves_nothing_and_has_nothing_to_learn(gaussians):
    """The control of all experiments on motion."""
    motion = Still(KEYS)
    assert motion.at(motion.bind(gaussians), 0.07).offset.abs().max() == 0
    assert not list(motion.parameters())


def test_farthest_points_spread_and_depend_on_the_points_only():
    """Not on their order in memory."""
    points = random(200, 3)
    chosen = farthest_points(points, 20)
    assert len(set(chosen.tolist())) == 20
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    assert {tuple(p) for p in points[chosen].tolist()} == {
        tuple(p) for p in points[order][farthest_points(points[order], 20)].tolist()
    }
    apart, anywhere = (torch.pdist(points[rows]).min() for rows in (chosen, slice(20)))
    assert apart > 2.0 * anywhere
    assert len(farthest_points(points[:3], 20)) == 3
    assert len(farthest_points(points[:0], 20)) == 0


@pytest.mark.contract
def test_what_cannot_be_meant_is_refused():
    """With both values in the message."""
    node = random(2, 3)
    with pytest.raises(ValueError, match="increasing"):
        Still(torch.tensor([0.0, 0.0]))
    with pytest.raises(ValueError, match="static"):
        Nodes(KEYS, node, torch.tensor([0, 1]))
    with pytest.raises(ValueError, match=r"\(3, 2, 3\).*keys"):
        Nodes(KEYS, node, torch.tensor([1, 1]), random(3, 2, 3))
    with pytest.raises(ValueError, match="neighbours"):
        Nodes(KEYS, node, torch.tensor([1, 1]), neighbours=0)
