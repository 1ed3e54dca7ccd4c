"""Waves that are no sines, through the sensor: their contrast,
and the error that decoding makes of them.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from closed_forms import wiggling

from gftorf_warp.scene.sensor import Sensor, phasor_from_quads
from gftorf_warp.scene.waveform import Waveform, contrast_ratios, contrasts, harmonics_of, peak
from gftorf_warp.sim.readout import mean_quad

SINE, SQUARE = Waveform.SINE, Waveform.SQUARE
PHASE = np.linspace(0.0, 2.0 * math.pi, 1440, endpoint=False)[None]


def error(ratios, samples, **more):
    """Decoded minus true phase [rad] of a surface seen with that many equally spaced shifts."""
    shifts = tuple(2.0 * math.pi * j / samples for j in range(samples))
    sensor = Sensor(shifts=shifts, harmonic_contrast=ratios, contrast=0.4, **more)
    light = np.exp(1j * np.array(sensor.harmonics)[:, None, None] * PHASE)
    quads = [mean_quad(light, np.ones_like(PHASE), sensor.at_frame(j))[0] for j in range(samples)]
    re, im = phasor_from_quads(torch.from_numpy(np.stack(quads)), shifts)
    return np.angle(
        np.exp(1j * (np.arctan2(im.numpy(), re.numpy()) - float(sensor.phase_offset) - PHASE))
    )


@pytest.mark.parametrize(
    ("samples", "want"), [(3, 0.01976), (4, 0.07110), (6, 0.01976), (8, 0.00803)]
)
def test_square_waves_wiggle(samples, want):
    """Sensor notes, T17: two square waves of 50 %; the phase offset shifts the wave and does not
    change its size.
    """
    ratios = contrast_ratios(SQUARE, SQUARE, 59)
    for offset in (0.0, 0.7):
        assert np.abs(error(ratios, samples, phase_offset=offset)).max() == pytest.approx(
            want, abs=1e-4
        )


@pytest.mark.parametrize("samples", [3, 4, 6, 8])
def test_a_sine_does_not_wiggle(samples):
    """Sensor notes, T17: whatever the other wave is."""
    for waves in ((SINE, SQUARE), (SQUARE, SINE)):
        assert np.abs(error(contrast_ratios(*waves, 59), samples)).max() < 1e-12


@pytest.mark.parametrize("samples", [3, 4, 6, 8])
def test_wiggling_is_its_formula_where_it_is_small(samples):
    """Sensor notes, 2.6: up to second order in the harmonics;
    those not beside a multiple of K are unseen.
    """
    for ratios in ((0.0, 0.01), (0.02, 0.0, 0.0, -0.01), (0.01, 0.01, 0.01, 0.01, 0.01, 0.01)):
        got, want = error(ratios, samples), wiggling(PHASE, ratios, samples)
        assert np.abs(got - want).max() < 4 * sum(map(abs, ratios)) ** 2
        assert (np.abs(want).max() > 0) == (np.abs(got).max() > 1e-12)


def test_short_pulses_have_more_contrast():
    """Sensor notes, T18: the first coefficient of a pulse of mean 1 is 2 sin(pi D) / (pi D)."""
    for duty, want in ((1 / 2, 1.2732), (1 / 3, 1.6540), (1 / 4, 1.8006)):
        assert harmonics_of(SQUARE, 1, duty)[0] == pytest.approx(want, abs=1e-4)
        assert contrasts(SQUARE, SQUARE, 1, duty)[0] == pytest.approx(
            want * 4 / math.pi / 2, abs=1e-4
        )


def test_coefficients_are_those_of_the_wave():
    """Their sum is the wave: on for the duty at height 1 / D, off otherwise;
    a sine has one of them.
    """
    turn = np.arange(4000) / 4000
    for duty in (0.5, 0.2):
        waves = enumerate(harmonics_of(SQUARE, 400, duty), start=1)
        wave = 1 + sum(s * np.cos(2 * math.pi * h * turn) for h, s in waves)
        want = np.where(np.minimum(turn, 1 - turn) < duty / 2, 1 / duty, 0.0)
        inside = np.abs(np.minimum(turn, 1 - turn) - duty / 2) > 0.02
        np.testing.assert_allclose(wave[inside], want[inside], atol=0.05 / duty)
    assert harmonics_of(SINE, 3) == (1.0, 0.0, 0.0)
    assert contrast_ratios(SQUARE, SQUARE, 5) == pytest.approx((0.0, 1 / 9, 0.0, 1 / 25))


def test_two_square_waves_correlate_to_a_triangle():
    """Its peak is all of the light, so contrasts add up to 1; peak() finds that of any wave."""
    c = contrasts(SQUARE, SQUARE, 499)
    assert c[0] * peak(contrast_ratios(SQUARE, SQUARE, 499)) == pytest.approx(1.0, abs=1e-3)
    assert peak(()) == 1.0
    x = np.linspace(0, 2 * math.pi, 10001)
    for ratios in itertools.product((-0.3, 0.2), repeat=3):
        wave = np.cos(x) + sum(r * np.cos(h * x) for h, r in enumerate(ratios, start=2))
        assert peak(ratios) == pytest.approx(np.abs(wave).max(), rel=1e-3)


def test_waves_that_are_none():
    """Duty and count are checked, and light at another number of harmonics than the sensor sees."""
    for wrong in ({"duty": 0.0}, {"duty": 1.0}, {"duty": math.nan}, {"count": 0}):
        with pytest.raises(ValueError, match="duty"):
            harmonics_of(**{"wave": SQUARE, "count": 3, **wrong})
    with pytest.raises(ValueError, match="number of harmonics"):
        mean_quad(
            np.ones((2, 1, 1), complex), np.ones((1, 1)), Sensor(harmonic_contrast=(0.0, 0.1, 0.1))
        )
