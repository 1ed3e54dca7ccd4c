"""Edges and slopes of a truth drawn by hand, and errors pooled over them."""

import numpy as np
import pytest

from gftorf_warp.data.steps import near_steps
from gftorf_warp.evaluate.classes import class_errors, class_of_pixels

NAN = float("nan")


def ramp(slope, rows=5, columns=12):
    """[1, H, W] a plane whose distance grows along the columns [m/px]."""
    return np.tile(3.0 + slope * np.arange(columns), (1, rows, 1))


def test_two_pixels_on_either_side_of_a_step_are_edge():
    """Centres 0.5 and 1.5 px from the step; the thin end of a corner reaches no further."""
    truth = np.full((1, 9, 10), 4.0)
    truth[0, :, 5:] = 3.0
    assert near_steps(truth)[0].tolist() == [[3 <= x <= 6 for x in range(10)]] * 9
    assert not near_steps(np.full((1, 4, 4), 4.0)).any()
    one = np.full((1, 9, 9), 4.0)
    one[0, 4, 4] = 3.0
    assert int(near_steps(one).sum()) == 13, "all pixels at most two moves away"


@pytest.mark.parametrize("slope", [0.02, 0.3])
def test_a_slope_or_a_crease_is_no_step_however_steep(slope):
    """Only what leaves the surface on both sides is."""
    truth = ramp(slope)
    assert not near_steps(truth).any()
    crease = np.minimum(truth, truth[..., 6:7])
    assert not near_steps(crease).any()
    behind = truth + np.where(np.arange(12) > 5, 0.5, 0.0)
    assert near_steps(behind)[0, 0].tolist() == [4 <= x <= 7 for x in range(12)]


def test_a_pole_of_one_or_two_pixels_is_a_step():
    """However thin, what is before a wall differs from both of its sides."""
    for width in (1, 2):
        truth = np.full((1, 3, 12), 4.0)
        truth[..., 5 : 5 + width] = 2.0
        assert near_steps(truth)[0, 1].tolist() == [3 <= x <= 6 + width for x in range(12)]


def test_slopes_divide_the_interior():
    """5, 15, 30 and 60 mm per pixel are classes 1 to 4; diagonals count, the unknown is flat."""
    for slope, kind in ((0.005, 1), (0.015, 2), (0.03, 3), (0.06, 4)):
        assert (class_of_pixels(ramp(slope)) == kind).all()
    y, x = np.mgrid[0:5, 0:5]
    assert (class_of_pixels((3 + 0.008 * (x + y))[None]) == 2).all()
    unknown = ramp(0.005)
    unknown[0, 2, 2] = NAN
    assert set(class_of_pixels(unknown).ravel()) == {1}


def test_errors_by_class_and_motion():
    """A step between two flat halves; the left column moves, one pixel is unknown."""
    truth = np.full((1, 4, 10), 4.0)
    truth[..., 5:] = 3.0
    truth[0, 0, 0] = NAN
    error = np.where(np.isnan(truth), NAN, 0.01)
    error[..., 3:7] = 0.09
    moving = np.zeros(truth.shape, dtype=bool)
    moving[..., 0] = True
    found = class_errors({"d": error}, truth, moving, ~moving)
    assert found["moving"]["edge"]["share"] == 0.0
    assert set(found["moving"]["edge"].values()) == {None, 0.0}
    assert found["moving"]["interior"]["share"] == pytest.approx(3 / 39)
    static = found["static"]
    assert static["edge"]["d_mse_x100"] == pytest.approx(9.0)
    assert static["edge"]["closed_form_mse_x100"] is None
    assert static["edge"]["share"] == pytest.approx(16 / 39)
    assert static["interior"] == static["slope_0_10"]
    assert static["interior"]["d_mse_x100"] == pytest.approx(1.0)
    assert static["slope_over_40"]["share"] == 0.0
    shares = [
        row["share"] for group in found.values() for row in (group["edge"], group["interior"])
    ]
    assert sum(shares) == pytest.approx(1.0)
