"""Two modulation frequencies decoded together."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from closed_forms import cycle_distance, unwrap_failure

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data.unwrap import multiples
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.scene.unwrap import common_range, unwrap

TURN = 2 * math.pi


@pytest.mark.parametrize(("m1", "m2"), [(3, 2), (2, 3), (5, 4), (4, 3), (1, 2), (7, 3)])
def test_exact_phases_are_unwrapped_everywhere(m1, m2):
    """Over the whole common range, float64; also of phases that were not reduced."""
    base = torch.linspace(0, TURN, 4001, dtype=torch.float64)[:-1] + 1e-9
    got = unwrap(((m1 * base) % TURN, (m2 * base) % TURN), (m1, m2))
    torch.testing.assert_close(got, base, rtol=0, atol=1e-12)
    torch.testing.assert_close(
        unwrap((m1 * base - TURN, m2 * base + TURN), (m1, m2)), base, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("m1", "m2", "sigma", "want"),
    [
        (3, 2, 0.3, 0.0037),
        (3, 2, 0.4, 0.0294),
        (5, 4, 0.2, 0.0142),
        (5, 4, 0.25, 0.0497),
        (4, 3, 0.3, 0.0362),
    ],
)
def test_noise_chooses_wrong_candidates_as_often_as_predicted(m1, m2, sigma, want):
    """Sensor notes, T28: 4 sigma of the counted rate; the prediction is the published number."""
    random, count = np.random.default_rng(2), 400_000
    base = random.uniform(0, TURN, count)
    first, second = (
        torch.from_numpy((m * base + random.normal(0, sigma, count)) % TURN) for m in (m1, m2)
    )
    off = np.angle(np.exp(1j * (unwrap((first, second), (m1, m2)).numpy() - base)))
    predicted = unwrap_failure(sigma, m1, m2)
    assert predicted == pytest.approx(want, abs=6e-5)
    assert (np.abs(off) > math.pi / m1).mean() == pytest.approx(
        predicted, abs=4 * math.sqrt(predicted / count)
    )


@pytest.mark.parametrize(
    ("first", "second", "want"), [(60e6, 40e6, (3, 2)), (40e6, 60e6, (2, 3)), (100e6, 80e6, (5, 4))]
)
def test_a_cycle_of_two_frequencies_reaches_farther(first, second, want):
    """Distances over the common range from quads of a whole cycle,
    with a phase offset and a DC offset.
    """
    sensor = Sensor(f_mod_hz=first, further_hz=(second,), phase_offset=0.4, dc_offset=0.3)
    found, base = multiples((first, second))
    assert found == want
    assert common_range(sensor) == pytest.approx(SPEED_OF_LIGHT / (2 * base))
    assert common_range(sensor) > 1.9 * sensor.unambiguous_range
    distance = torch.linspace(0.01, common_range(sensor) - 0.01, 999, dtype=torch.float64)
    quads = []
    for n, frame in enumerate(sensor.cycle):
        shot = sensor.at_frame(n)
        assert (shot.f_mod_hz, shot.shifts, shot.further_hz) == (frame.f_mod_hz, (frame.shift,), ())
        quads.append(torch.cos(shot.phase_slope * distance + 0.4 - frame.shift) + 0.3)
    assert [frame.f_mod_hz for frame in sensor.cycle] == [first] * 4 + [second] * 4
    torch.testing.assert_close(
        cycle_distance(torch.stack(quads), sensor), distance, rtol=0, atol=1e-9
    )
    alone = cycle_distance(torch.stack(quads[:4]), replace(sensor, further_hz=()))
    torch.testing.assert_close(alone, distance % sensor.unambiguous_range, rtol=0, atol=1e-9)


def test_the_gradient_is_that_of_the_first_phase():
    """Candidates are chosen without a gradient: d base / d psi_1 = 1 / m_1."""
    base = torch.tensor([0.5, 3.0, 6.0], dtype=torch.float64)
    first, second = ((m * base % TURN).requires_grad_() for m in (3, 2))
    one, two = torch.autograd.grad(
        unwrap((first, second), (3, 2)).sum(), (first, second), allow_unused=True
    )
    torch.testing.assert_close(one, torch.full((3,), 1 / 3, dtype=torch.float64))
    assert two is None or not two.any()


def test_frequencies_that_do_not_fit_are_refused():
    """Equal, incommensurate or impossible ones, and cycles of another length."""
    for second in (60e6, 60e6 * math.sqrt(2), 1e6, 0.0, math.nan):
        with pytest.raises(ValueError, match="Hz"):
            multiples((60e6, second))
    with pytest.raises(ValueError, match="common divisor"):
        unwrap((torch.zeros(1), torch.zeros(1)), (4, 2))
    three = Sensor(f_mod_hz=60e6, further_hz=(40e6, 60e6))
    with pytest.raises(ValueError, match="different multiples"):
        cycle_distance(torch.zeros(12, 2), three)
    with pytest.raises(ValueError, match="2 phasors for 3 frequencies"):
        cycle_distance(torch.zeros(8, 2), three)
