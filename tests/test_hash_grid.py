"""Features in hash grids by kernels against the oracle, and the oracle against known fields and
finite differences.
"""

import pytest
import torch
from comparison import DEVICES

from gftorf_warp.render import hash_grid_reference as reference
from gftorf_warp.render.hash_grid import interpolated, levels_of

T, P = 3, 41


@pytest.fixture(params=DEVICES)
def device(request):
    """The CPU, and a GPU where there is one."""
    return request.param


def case(times, cells=(3, 5, 11), rows_max=512):
    """Points, a few of them beyond the cube; times of their rows; a table; levels, of which the
    last has more vertices than rows.
    """
    draw = torch.Generator().manual_seed(0)
    points = 1.2 * torch.rand(T, P, 3, generator=draw) - 0.1
    points[0, 0], points[0, 1] = 1.0, 0.0
    levels, rows = levels_of([*cells], times, rows_max)
    table = torch.randn(rows, 2, generator=draw)
    return points, torch.tensor([0, times - 1, times // 2], dtype=torch.int32), table, levels


def moved(levels, device):
    """Levels on a device."""
    return type(levels)(*(each.to(device) for each in levels[:3]), levels.times)


@pytest.mark.parametrize("times", [1, 2, 4])
def test_values_and_gradients_are_the_oracles(device, times):
    """To float32, at the corners of the cube and beyond it, with and without shared rows."""
    points, rows, table, levels = case(times)
    results = []
    for function, dtype, place in (
        (reference.interpolated, torch.float64, "cpu"),
        (interpolated, torch.float32, device),
    ):
        leaves = [value.to(place, dtype).requires_grad_() for value in (points, table)]
        found = function(leaves[0], rows.to(place), leaves[1], moved(levels, place))
        weight = torch.randn(found.shape, generator=torch.Generator().manual_seed(5)).to(found)
        slopes = torch.autograd.grad((found * weight).sum(), leaves)
        results.append([value.detach().double().cpu() for value in (found, *slopes)])
    assert results[0][0].shape == (T, P, 6)
    for got, want in zip(results[1], results[0], strict=True):
        assert want.abs().max() > 0.5, "a vanished gradient would pass"
        torch.testing.assert_close(got, want, rtol=2e-5, atol=2e-5)
    outside = ((points < 0.0) | (points > 1.0)).double()
    assert (results[0][1] * outside).abs().max() == 0.0
    assert outside.sum() > 10


def test_no_gradient_of_points_that_need_none(device):
    """Only the table gets one, of the same bits."""
    points, rows, table, levels = case(2)
    slopes = []
    for wanted in (False, True):
        leaf = table.to(device).requires_grad_()
        given = points.to(device).requires_grad_(wanted)
        found = interpolated(given, rows.to(device), leaf, moved(levels, device))
        found.square().sum().backward()
        assert (given.grad is not None) == wanted
        slopes.append(leaf.grad)
    torch.testing.assert_close(slopes[0], slopes[1])


def test_the_oracles_gradient_is_that_of_finite_differences():
    """In float64, of every element."""
    points, rows, table, levels = case(2, cells=(2, 4), rows_max=64)
    leaves = [points[:, 2:6].double().requires_grad_(), table.double().requires_grad_()]
    assert torch.autograd.gradcheck(
        lambda at, values: reference.interpolated(at, rows, values, levels), leaves
    )


def test_a_linear_field_is_interpolated_exactly():
    """Where every vertex has a row of its own, of each time its own field."""
    cells, times = 4, 3
    levels, rows = levels_of([cells], times, 1024)
    number = torch.arange(rows)
    side = cells + 1
    x, y, z = (number // side**k % side / cells for k in range(3))
    time = number // side**3
    table = torch.stack([x - 2.0 * y + 3.0 * z + 10.0 * time, x * 0.0 + 1.0], dim=-1)
    points, at, *_ = case(times)
    found = interpolated(points, at, table, levels)
    inside = points.clamp(0.0, 1.0)
    slope = inside @ torch.tensor([1.0, -2.0, 3.0])
    torch.testing.assert_close(found[..., 0], slope + 10.0 * at[:, None])
    torch.testing.assert_close(found[..., 1], torch.ones_like(slope))


def test_wrong_types_and_sizes_are_refused():
    """Both are named."""
    points, rows, table, levels = case(1)
    with pytest.raises(ValueError, match=r"float64.*float32"):
        interpolated(points.double(), rows, table, levels)
    with pytest.raises(ValueError, match="power of two, got 500"):
        levels_of([4], 1, 500)
