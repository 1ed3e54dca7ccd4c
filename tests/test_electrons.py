"""Predicted noise against what the read-out does, against published numbers,
and its derivatives.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from closed_forms import phase_noise, predicted_distance_noise, predicted_phase_noise

from gftorf_warp.scene.electrons import contrast, electron_gain
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads
from gftorf_warp.sim.readout import read_out
from gftorf_warp.sim.sensors import SENSORS

DRAWS = 100_000


def spread(amplitude, sensor, psi=1.1, **more):
    """Standard deviation [rad] of the phase of many pixels, and its mean error."""
    generator, ones = np.random.default_rng(0), np.ones((1, DRAWS))
    quads = [
        read_out(
            amplitude * (math.cos(psi - shift) + float(sensor.dc_offset)) * ones,
            amplitude * ones,
            sensor,
            generator,
            **more,
        ).quad
        for shift in sensor.shifts
    ]
    re, im = phasor_from_quads(torch.from_numpy(np.stack(quads)).double(), sensor.shifts)
    error = np.angle(np.exp(1j * (np.arctan2(im.numpy(), re.numpy()) - psi)))
    return error.std(), error.mean()


@pytest.mark.parametrize("count", [3, 4, 6, 8])
@pytest.mark.parametrize("unipolar", [False, True])
def test_prediction_is_the_spread_of_the_read_out(count, unipolar):
    """Sensor notes, T9: ambient light, dark current and a coarse ADC included, 2 %."""
    sensor = Sensor(
        noise=True,
        unipolar=unipolar,
        dc_offset=2.0 if unipolar else 0.0,
        shifts=tuple(2 * math.pi * j / count for j in range(count)),
        ambient_electrons=2e4,
        full_well_electrons=math.inf,
        electrons_per_code=150.0,
        adc_bits=16,
    )
    psi = math.pi / 6 if count == 3 else 1.1  # three shifts of one tap: where cos(3 psi) is 0
    got, bias = spread(0.1, sensor, psi)
    want = float(predicted_phase_noise(0.1, sensor))
    assert got == pytest.approx(want, rel=0.02)
    assert abs(bias) < 4 * want / math.sqrt(DRAWS) + 0.1 * want**2


def test_three_shifts_of_one_tap_depend_on_the_phase():
    """Sensor notes, 2.5: the variance is lower where cos(3 psi) is 1;
    nothing else depends on it.
    """
    low, high = (
        float(phase_noise(1e4, 4.5e3, 50.0, 3, taps=1, phase=psi)) for psi in (0.0, math.pi / 3)
    )
    mean = float(phase_noise(1e4, 4.5e3, 50.0, 3, taps=1))
    assert low < mean < high
    assert low**2 + high**2 == pytest.approx(2 * mean**2)
    assert low / mean == pytest.approx(math.sqrt(1 - 4.5e3 / (2 * 12500)))
    assert float(phase_noise(1e4, 4.5e3, 50.0, 4, taps=1, phase=0.0)) == float(
        phase_noise(1e4, 4.5e3, 50.0, 4, taps=1)
    )
    for wrong in ({"samples": 2}, {"samples": 4, "taps": 3}):
        with pytest.raises(ValueError, match="at least 3 samples"):
            phase_noise(1e4, 4.5e3, 50.0, **wrong)


@pytest.mark.parametrize(
    ("distance", "reflectance", "ambient", "millimetres"),
    [
        (2, 0.5, 0, 7.3),
        (3, 0.5, 0, 12.5),
        (4, 0.5, 0, 19.1),
        (5, 0.5, 0, 27.5),
        (3, 0.5, 3.14e5, 42),
        (4, 0.05, 0, 149),
    ],
)
def test_electron_budget(distance, reflectance, ambient, millimetres):
    """Sensor notes, section 3: what a camera like the OPT8241 would show, to the digits printed."""
    sensor = replace(SENSORS["opt8241_cdk"], ambient_electrons=ambient)
    got = 1e3 * float(predicted_distance_noise(reflectance / distance**2, sensor))
    assert got == pytest.approx(millimetres, rel=0.015)


def test_ambient_light_is_noise_and_no_phase():
    """Sensor notes, T8: by the share that each pixel sends back; the mean phase stays."""
    sensor = Sensor(noise=True, ambient_electrons=1e5, full_well_electrons=math.inf)
    for share in (0.2, 0.9):
        got, bias = spread(0.1, sensor, ambient=np.full((1, DRAWS), share))
        want = float(predicted_phase_noise(0.1, replace(sensor, ambient_electrons=share * 1e5)))
        assert got == pytest.approx(want, rel=0.02)
        assert abs(bias) < 4 * want / math.sqrt(DRAWS)


def test_a_unipolar_sensor_knows_the_ambient_level():
    """What it writes down has no ambient light in it on average, whatever a pixel reflects."""
    sensor = Sensor(noise=True, unipolar=True, dc_offset=2.0, ambient_electrons=3e4, adc_bits=None)
    share = np.linspace(0.0, 1.0, DRAWS)[None]
    quad = read_out(
        np.full((1, DRAWS), 0.2),
        np.full((1, DRAWS), 0.1),
        sensor,
        np.random.default_rng(0),
        ambient=share,
    )
    for half in (quad.quad[0, : DRAWS // 2], quad.quad[0, DRAWS // 2 :]):
        assert half.mean(dtype=np.float64) == pytest.approx(
            0.2, abs=4 * float(half.std()) / math.sqrt(DRAWS / 2)
        )


def test_contrast_falls_with_the_frequency():
    """The two contrasts of the MLX75027's datasheet; a unipolar one is its DC offset's."""
    sensor = SENSORS["mlx75027"]
    for frequency, want in ((40e6, 0.85), (100e6, 0.78)):
        assert contrast(replace(sensor, f_mod_hz=frequency)) == pytest.approx(want, abs=2e-3)
    assert contrast(Sensor(f_mod_hz=100e6)) == 0.45
    assert contrast(SENSORS["ftorf_synthetic"]) == 1.0
    assert electron_gain(sensor) == pytest.approx(electron_gain(SENSORS["opt8241_cdk"]) * 4 / 9)


def test_derivative_of_the_noise_by_the_frequency():
    """Sensor notes, T29: -sigma_d (1/f + C'/C), float64 1e-6;
    the least noise is at the cutoff of the contrast.
    """
    for f in (20e6, 100e6, 303e6, 500e6):
        value = torch.tensor(f, dtype=torch.float64, requires_grad=True)
        sigma = predicted_distance_noise(0.1, replace(SENSORS["mlx75027"], f_mod_hz=value))
        (got,), sigma = torch.autograd.grad(sigma, value), float(sigma.detach())
        by_contrast = -2 * f / 303e6**2 / (1 + (f / 303e6) ** 2)
        want = -sigma * (1 / f + by_contrast)
        assert float(got) == pytest.approx(want, rel=1e-6, abs=1e-9 * sigma / f)
        assert np.sign(round(float(got) * f / sigma, 6)) == np.sign(f - 303e6)
