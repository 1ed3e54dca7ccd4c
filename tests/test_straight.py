"""Shares of mixed pixels in a column, along an upright outline at the middle of an image."""

import numpy as np
import pytest
import torch

from gftorf_warp.recon.straight import Outline, along_outline

NEAR, FAR, COLUMN = 1.0, 3.0, 3
SHARES = torch.linspace(0.0, 1.0, 21)
CHANCES = torch.tensor([0.3, 0.7])


def image(rows=5, far=FAR):
    """Distances of two surfaces on both sides of a column that is between them [m]."""
    distance = torch.full((rows, 2 * COLUMN + 1), NEAR)
    distance[:, COLUMN] = 0.5 * (NEAR + FAR)
    distance[:, COLUMN + 1 :] = torch.as_tensor(far).reshape(-1, 1)
    return distance


def outline(distance, rows, column=COLUMN):
    """The pixels of that column in some rows; the first surface is on the left."""
    rows = torch.as_tensor(rows)
    columns = torch.full_like(rows, 0) + torch.as_tensor(column)
    first, second = distance[rows, 0], distance[rows, -1]
    return Outline((0, 1), (rows, columns), first, second, distance, 0.25)


def peaks(*positions, gains=None):
    """Likelihoods [g s P] of narrow peaks at some shares; None: of any share. One gain's is that
    of the other one times ``gains``.
    """
    flat = torch.ones_like(SHARES)
    each = [flat if p is None else torch.exp(-200.0 * (SHARES - p) ** 2) for p in positions]
    one = torch.stack(each, dim=1)
    one = one / one.sum(dim=0)
    return torch.stack([one, one * (torch.ones(len(positions)) if gains is None else gains)])


def mean_share(likelihood):
    """Mean of each pixel's share under its likelihood [s P]."""
    return (likelihood * SHARES[:, None]).sum(dim=0) / likelihood.sum(dim=0)


@pytest.mark.parametrize(("above", "below"), [(0.2, 0.4), (0.9, 0.7), (0.1, 0.1)])
def test_a_pixel_that_could_be_any_share_has_the_mean_of_those_beside(above, below):
    """And the likelihood that it is a mixture stays."""
    given = along_outline(
        peaks(above, None, below), CHANCES, 0.3, outline(image(3), torch.arange(3))
    )
    middle = 0.5 * (above + below)
    assert mean_share(given)[1] == pytest.approx(middle, abs=0.15)
    assert given.sum(dim=0)[1] == pytest.approx(1.0, rel=1e-4)


def test_a_slanted_outline_goes_on_in_the_next_column():
    """It crosses half a pixel per row: a whole pixel and 0.1 above, 0.1 below, so 0.6 between."""
    distance = image(3)
    distance[0, COLUMN], distance[0, COLUMN + 1] = NEAR, 0.5 * (NEAR + FAR)
    found = outline(distance, [0, 1, 2], [COLUMN + 1, COLUMN, COLUMN])
    given = along_outline(peaks(0.1, None, 0.1), CHANCES, 0.3, found)
    assert mean_share(given)[1] == pytest.approx(0.6, abs=0.1)


def test_other_surfaces_and_a_single_pixel_tell_nothing():
    """Of another step, and where only one of both neighbours is a mixture of known surfaces."""
    alone = peaks(0.2, None, 0.2)
    expected = (CHANCES[:, None, None] * alone).sum(dim=0)
    for far in ([9.0, 3.0, 9.0], [3.0, 3.0, 9.0]):
        given = along_outline(alone, CHANCES, 0.3, outline(image(3, far), torch.arange(3)))
        np.testing.assert_allclose(given[:, 1], expected[:, 1], rtol=1e-5)


def test_a_gain_that_explains_the_neighbours_is_likely():
    """The second gain explains the neighbours a hundred times better: the first one hardly counts,
    unless both are equally good there or the neighbours may be no mixtures at all.
    """
    better = torch.tensor([100.0, 1.0, 100.0])
    likelihood = peaks(None, None, None, gains=better)
    likelihood[0, :, 1] = 0.0
    rows = torch.arange(3)
    known = along_outline(likelihood, CHANCES, 1e-6, outline(image(3), rows)).sum(dim=0)[1]
    assert known > 0.95
    unknown = along_outline(likelihood, CHANCES, 1e9, outline(image(3), rows)).sum(dim=0)[1]
    assert unknown == pytest.approx(float(CHANCES[1]), rel=1e-3)
