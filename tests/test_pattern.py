"""Fixed patterns: reproducible, as large as stated, and removed exactly by who knows them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gftorf_warp.scene.electrons import electron_gain
from gftorf_warp.scene.pattern import CODE, Pattern, dark_map, gain_map, phase_map
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads
from gftorf_warp.sim.readout import mean_quad, mean_taps, read_out

SIZE = 240, 320


def angle(quads, sensor):
    """Decoded phase [rad], float64."""
    re, im = phasor_from_quads(torch.from_numpy(np.stack(quads).astype(np.float64)), sensor.shifts)
    return np.arctan2(im.numpy(), re.numpy())


def wrapped(phase):
    """Angle [rad] in (-pi, pi]."""
    return np.angle(np.exp(1j * phase))


def cycle(psi, sensor):
    """Mean quads of a surface of phase ``psi`` [rad] and amplitude 1, one per shift."""
    light = np.exp(1j * np.array(sensor.harmonics)[:, None, None] * psi)
    return [
        mean_quad(light, np.ones(psi.shape), sensor.at_frame(j))[0]
        for j in range(len(sensor.shifts))
    ]


def test_the_phase_pattern_adds_to_the_phase_and_a_calibration_removes_it():
    """Sensor notes, T27: 1e-6 rad; the map of the sensor is the calibration map of a recording
    without noise.
    """
    psi = np.random.default_rng(0).uniform(0, 2 * math.pi, SIZE)
    sensor = Sensor(pattern=Pattern(phase=1.0, seed=4), phase_offset=0.3, dc_offset=0.2)
    known = phase_map(sensor.pattern, *SIZE)
    measured = angle(cycle(psi, sensor), sensor)
    assert np.abs(wrapped(measured - psi - 0.3)).max() > 0.1
    np.testing.assert_allclose(wrapped(measured - psi - 0.3 - known), 0, atol=1e-6)
    wall = np.full(SIZE, 1.0)
    calibration = angle(cycle(wall, sensor), sensor) - wall  # as a flat wall would give it
    np.testing.assert_allclose(wrapped(measured - psi - calibration), 0, atol=1e-6)


def test_the_phase_pattern_turns_harmonics_as_often():
    """It is a delay: wiggling with a pattern is wiggling at the delayed phase."""
    psi = np.random.default_rng(1).uniform(0, 2 * math.pi, (20, 24))
    plain = Sensor(harmonic_contrast=(0.0, 0.1))
    sensor = replace(plain, pattern=Pattern(phase=3.0))
    late = psi + phase_map(sensor.pattern, 20, 24)
    np.testing.assert_allclose(cycle(psi, sensor), cycle(late, plain), atol=1e-12)


def test_the_phase_pattern_is_as_large_as_the_notes_say():
    """Spread from pixel to pixel .0138 rad; the bowl at the centre and in a corner."""
    map_ = phase_map(Pattern(phase=1.0), *SIZE)
    assert (np.diff(map_, axis=0).std() / math.sqrt(2)) == pytest.approx(0.0138, abs=1e-3)
    centre, corner = map_[110:130, 150:170].mean(), map_[:20, :20].mean()
    x, y = -1 + 10 / 160, -0.75 + 10 / 160
    bowl = -15.6 - 110.1 * y - 27.9 * y**2 + 40.5 * x + 30.7 * x * y - 154.8 * x**2
    assert centre == pytest.approx(-15.6 * CODE, abs=3 * CODE)
    assert corner == pytest.approx(bowl * CODE, abs=3 * CODE)
    np.testing.assert_allclose(phase_map(Pattern(phase=0.5), *SIZE), 0.5 * map_)
    # two specimens, one bowl
    noise = (map_ - phase_map(Pattern(phase=1.0, seed=1), *SIZE)) / (math.sqrt(2) * CODE)
    for axis, deviation in ((0, 3.6), (1, 1.4)):  # of columns and of rows
        want = math.hypot(deviation, 8.9 / math.sqrt(SIZE[axis]))
        assert noise.mean(axis).std() == pytest.approx(want, rel=4 / math.sqrt(2 * SIZE[1 - axis]))
    assert noise.std() == pytest.approx(math.sqrt(8.9**2 + 3.6**2 + 1.4**2), rel=0.03)


@pytest.mark.parametrize(
    ("make", "name", "deviation"), [(gain_map, "gain", 0.01), (dark_map, "dark", 0.2)]
)
def test_responses_spread_as_asked(make, name, deviation):
    """Mean 1 and the deviation, 4 sigma; never negative, and none at all at 0."""
    map_ = make(Pattern(**{name: deviation}), *SIZE)
    assert map_.mean() == pytest.approx(1.0, abs=4 * deviation / math.sqrt(map_.size))
    assert map_.std() == pytest.approx(deviation, rel=4 / math.sqrt(2 * map_.size))
    assert (make(Pattern(**{name: 2.0}), *SIZE) >= 0).all()
    assert make(Pattern(), *SIZE) is None


def test_a_specimen_is_its_seed():
    """One seed, one pattern, which nobody can change; other seeds and other maps have nothing in
    common.
    """
    for make in (phase_map, gain_map, dark_map):
        one, other = (
            make(Pattern(phase=1.0, gain=0.01, dark=0.2, seed=seed), 60, 80) for seed in (1, 2)
        )
        make.cache_clear()
        np.testing.assert_array_equal(
            one, make(Pattern(phase=1.0, gain=0.01, dark=0.2, seed=1), 60, 80)
        )
        # neither bowl nor stripes
        noise = [np.diff(np.diff(map_, axis=0), axis=1).ravel() for map_ in (one, other)]
        assert abs(np.corrcoef(*noise)[0, 1]) < 0.1
        with pytest.raises(ValueError, match="read-only"):
            one[0, 0] = 0.0
    gain, dark = gain_map(Pattern(gain=0.1), 60, 80), dark_map(Pattern(dark=0.1), 60, 80)
    assert abs(np.corrcoef(gain.ravel(), dark.ravel())[0, 1]) < 0.1


def test_pixels_respond_differently_to_all_light_and_to_none():
    """The gain multiplies the quad, ambient light and the light of both taps;
    dark current has its own factor.
    """
    sensor = Sensor(
        noise=True, pattern=Pattern(gain=0.1, dark=0.2), ambient_electrons=1e4, adc_bits=None
    )
    gain, dark = gain_map(sensor.pattern, 6, 8), dark_map(sensor.pattern, 6, 8)
    ones = np.ones((6, 8))
    exact = read_out(
        0.05 * ones, 0.1 * ones, replace(sensor, noise=False), np.random.default_rng(0)
    )
    np.testing.assert_allclose(exact.quad, 0.05 * gain, rtol=1e-6)
    n_a, n_b = mean_taps(0.05 * gain, 0.1 * gain, sensor, gain)
    constant = 2 * dark * sensor.dark_electrons_per_s * sensor.exposure_s
    np.testing.assert_allclose(
        n_a + n_b, (1e4 + 0.1 * electron_gain(sensor)) * gain + constant, rtol=1e-12
    )
    many = replace(sensor, read_noise_electrons=0.0, dark_electrons_per_s=5e6)
    draws = [
        read_out(0 * ones, 0.1 * ones, many, np.random.default_rng(n)).quad for n in range(4000)
    ]
    taps = sum(mean_taps(0 * gain, 0.1 * gain, many, gain))  # the variance of a difference
    np.testing.assert_allclose(
        np.var(draws, axis=0) * (0.45 * electron_gain(many)) ** 2, taps, rtol=5 / math.sqrt(2000)
    )


@pytest.mark.parametrize(
    "wrong", [{"phase": -1.0}, {"gain": math.nan}, {"dark": math.inf}, {"seed": -1}]
)
def test_patterns_that_cannot_be(wrong):
    """The message names the setting."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Pattern(**wrong)
