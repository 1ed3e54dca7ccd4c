"""From light to numbers, against closed forms (sensor notes, section 5); statistics with fixed
seeds.

``T5`` and so on are the numbers of those tests in the notes.
"""

import math

import numpy as np
import pytest
import torch

from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor, phasor_from_quads
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.readout import (
    contrast,
    electron_gain,
    mean_quad,
    mean_taps,
    quantise,
    read_out,
)
from gftorf_warp.sim.record import frame_times
from gftorf_warp.sim.world import Body, Plane, Texture, first_hit

DRAWS = 100_000
PAIRED = tuple(math.radians(a) for a in (0, 180, 90, 270))
SEQUENTIAL = tuple(math.radians(a) for a in (0, 90, 180, 270))
PALINDROMIC = tuple(math.radians(a) for a in (0, 90, 270, 180))
AHEAD = Camera.from_fov(1, 1, 1.0)  # one ray, straight along +z


def equally_spaced(count):
    """That many shifts over the circle [rad]."""
    return tuple(2 * math.pi * j / count for j in range(count))


def quads(psi, amplitude, sensor):
    """Mean quads [Q, ...] of a surface with phase ``psi`` [rad]."""
    shift = np.reshape(sensor.shifts, (-1, *[1] * np.ndim(psi)))
    return amplitude * (np.cos(psi - shift) + float(sensor.dc_offset))


def phase(samples, shifts):
    """Decoded phase [rad], unwrapped nowhere."""
    re, im = phasor_from_quads(torch.as_tensor(np.asarray(samples, dtype=np.float64)), shifts)
    return np.arctan2(im.numpy(), re.numpy())


def wrapped(angle):
    """Angle [rad] in (-pi, pi]."""
    return np.angle(np.exp(1j * np.asarray(angle)))


def taps_sensor(*, mean, amplitude, read, unipolar, shifts, **more):
    """A sensor of which a tap holds ``mean`` + ``amplitude`` cos electrons for the relative
    amplitude 1.
    """
    contrast_ = 0.45
    active = 2 * amplitude / contrast_  # N_s, both taps
    return Sensor(
        noise=True,
        unipolar=unipolar,
        dc_offset=1 / contrast_ if unipolar else 0.0,
        contrast=contrast_,
        electrons_per_unit=active,
        ambient_electrons=2 * mean - active,
        dark_electrons_per_s=0.0,
        read_noise_electrons=read,
        full_well_electrons=1e9,
        adc_bits=None,
        shifts=shifts,
        **more,
    )


def recorded(psi, sensor, seed=0):
    """Read out many pixels of phase ``psi`` and relative amplitude 1, one raw frame per shift."""
    generator = np.random.default_rng(seed)
    ones = np.ones((1, DRAWS))
    return np.stack(
        [read_out(q * ones, ones, sensor, generator).quad for q in quads(psi, 1.0, sensor)]
    )


def test_sample_algebra():
    """T5: opposite quads add up to twice the DC level, and the phasor is the quads' own."""
    sensor = Sensor(dc_offset=0.3)
    psi = np.random.default_rng(1).uniform(0, 2 * math.pi, 200)
    q = quads(psi, 0.7, sensor)
    np.testing.assert_allclose(q[0] + q[1], 2 * 0.7 * 0.3)
    np.testing.assert_allclose(q[2] + q[3], 2 * 0.7 * 0.3)
    for shifts in (PAIRED, SEQUENTIAL, PALINDROMIC):
        np.testing.assert_allclose(
            wrapped(phase(quads(psi, 0.7, Sensor(shifts=shifts)), shifts) - psi), 0, atol=1e-9
        )


@pytest.mark.parametrize("count", [3, 4, 5, 8])
def test_any_order_of_a_static_cycle_is_one_phasor(count):
    """T5: phase and amplitude of any number of shifts in any order, evenly spaced or not, 1e-6."""
    random = np.random.default_rng(count)
    psi = random.uniform(0, 2 * math.pi, 200)
    for even in (True, False):
        shifts = np.array(equally_spaced(count)) + 0.3
        shifts = shifts if even else shifts + random.uniform(-0.3, 0.3, count)
        for _ in range(6):
            order = tuple(random.permutation(shifts).tolist())
            samples = torch.from_numpy(quads(psi, 0.7, Sensor(shifts=order, dc_offset=0.4)))
            re, im = phasor_from_quads(samples, order)
            np.testing.assert_allclose(re, 1.4 * np.cos(psi), atol=1e-6)
            np.testing.assert_allclose(im, 1.4 * np.sin(psi), atol=1e-6)


def test_shifts_that_determine_no_phase_are_refused():
    """Two shifts, or three of which two are one."""
    for shifts in ((0.0, 1.0), (0.0, 1.0, 1.0), (0.0, math.pi, 2 * math.pi, 3 * math.pi)):
        with pytest.raises(ValueError, match="shifts: a phase needs"):
            phasor_from_quads(torch.zeros(len(shifts), 2), shifts)


def test_light_adds_and_scales():
    """T6: the mean quad is linear in the light, harmonics included, and in the source intensity."""
    sensor = Sensor(shifts=(0.7,), phase_offset=0.2, dc_offset=0.5, harmonic_contrast=(0.1, -0.2))
    random = np.random.default_rng(0)
    one, two = (
        random.normal(size=(3, 4, 5)) + 1j * random.normal(size=(3, 4, 5)) for _ in range(2)
    )
    a, b = random.uniform(size=(2, 4, 5))
    parts = [mean_quad(light, amplitude, sensor)[0] for light, amplitude in ((one, a), (two, b))]
    np.testing.assert_allclose(
        mean_quad(one + two, a + b, sensor)[0], sum(parts), rtol=1e-6, atol=1e-12
    )
    bright = Sensor(**{**vars(sensor), "source_intensity": 3.0})
    np.testing.assert_allclose(
        mean_quad(one, a, bright), 3 * np.array(mean_quad(one, a, sensor)), rtol=1e-6
    )


def test_two_paths():
    """T7: 2 m and, .3 as strong, 3 m at 20 MHz: arg of the sum, 1e-6 rad;
    at worst an error of asin(.3).
    """
    sensor = Sensor(f_mod_hz=20e6)

    def decoded(difference):
        """Phase [rad] beyond that of the near path, the far one being ``difference`` [rad]
        later.
        """
        psi = 2.0 * sensor.phase_slope
        light = (np.exp(1j * psi) + 0.3 * np.exp(1j * (psi + difference)))[None, None]
        samples = [
            mean_quad(light, np.full_like(difference[None], 1.3), sensor.at_frame(j))[0]
            for j in range(4)
        ]
        return wrapped(phase(samples, sensor.shifts) - psi)[0]

    step = np.array([1.0 * sensor.phase_slope])
    assert decoded(step)[0] == pytest.approx(
        math.atan2(0.3 * math.sin(step[0]), 1 + 0.3 * math.cos(step[0])), abs=1e-6
    )
    worst = np.abs(decoded(np.linspace(0, 2 * math.pi, 20_001))).max()
    assert worst == pytest.approx(math.asin(0.3), abs=1e-6)


def test_taps_share_the_light():
    """T6: n_A + n_B does not depend on the shift and is linear in the light;
    n_A - n_B is the quad.
    """
    sensor = Sensor(ambient_electrons=5e3, dark_electrons_per_s=1e5)
    a = np.full((1, 4), 0.1)
    dark = 2 * 1e5 * sensor.exposure_s
    for psi in (0.3, 2.0):
        for q in quads(psi, 0.1, sensor):
            n_a, n_b = mean_taps(q * np.ones((1, 4)), a, sensor)
            np.testing.assert_allclose(
                n_a + n_b, 5e3 + dark + 0.1 * electron_gain(sensor), rtol=1e-12
            )
            np.testing.assert_allclose(
                n_a - n_b, q * sensor.contrast * electron_gain(sensor), rtol=1e-9
            )
    unipolar = Sensor(unipolar=True, dc_offset=2.0)
    assert contrast(unipolar) == 0.5
    bright = quads(0.0, 0.1, unipolar)
    n_a, n_b = mean_taps(bright[0] * np.ones((1, 4)), a, unipolar)
    dark = unipolar.dark_electrons_per_s * unipolar.exposure_s
    np.testing.assert_allclose(n_a - dark, 0.75 * 0.1 * electron_gain(unipolar), rtol=1e-9)
    np.testing.assert_allclose(n_a + n_b - 2 * dark, 0.1 * electron_gain(unipolar), rtol=1e-9)


def test_without_noise_the_mean_is_returned():
    """Bit by bit, in float32."""
    q = np.random.default_rng(0).normal(0, 0.1, (5, 7))
    reading = read_out(q, np.abs(q), Sensor(noise=False), np.random.default_rng(0))
    np.testing.assert_array_equal(reading.quad, q.astype(np.float32))
    assert not reading.saturated.any()


@pytest.mark.parametrize("unipolar", [False, True])
def test_readout_is_unbiased(unipolar):
    """The mean of many readings with noise, dark current,
    ambient light and ADC is the mean quad.
    """
    sensor = Sensor(
        noise=True,
        unipolar=unipolar,
        dc_offset=1.25 if unipolar else 0.0,
        ambient_electrons=4e3,
        contrast=0.8,
    )
    for a in (0.0, 0.02, 0.2):
        for q in quads(0.9, a, sensor):
            got = read_out(
                np.full((1, DRAWS), q), np.full((1, DRAWS), a), sensor, np.random.default_rng(3)
            ).quad
            assert got.mean(dtype=np.float64) == pytest.approx(
                q, abs=4 * float(got.std()) / math.sqrt(DRAWS)
            )


@pytest.mark.parametrize("count", [3, 4, 6, 8])
@pytest.mark.parametrize("unipolar", [False, True])
@pytest.mark.parametrize(
    ("mean", "amplitude", "read"), [(1e4, 4500.0, 50.0), (2e3, 900.0, 83.0), (5e4, 4e3, 50.0)]
)
def test_phase_noise(count, unipolar, mean, amplitude, read):
    """T8 and T9: the spread of the phase is that of section 2.5, ambient light included;
    its mean is true.
    """
    shifts, psi = equally_spaced(count), 1.1
    sensor = taps_sensor(
        mean=mean, amplitude=amplitude, read=read, unipolar=unipolar, shifts=shifts
    )
    error = wrapped(phase(recorded(psi, sensor), shifts) - psi)
    variance = 2 / count * (mean + read**2) / amplitude**2
    if not unipolar:
        variance /= 2
    elif count == 3:
        variance *= 1 - amplitude * math.cos(3 * psi) / (2 * (mean + read**2))
    assert error.std() == pytest.approx(math.sqrt(variance), rel=0.02)
    # arg is convex at second order
    assert abs(error.mean()) < 4 * math.sqrt(variance / DRAWS) + 0.1 * variance


def test_default_noise_is_the_published_formula():
    """Four shifts, two taps: sigma_psi = sqrt((N_s + N_a)/2 + N_dark + s_r^2 [+ e^2/24 of the
    ADC]) / (C N_s).
    """
    sensor = Sensor(noise=True)
    a = np.full((1, DRAWS), 0.05)
    generator = np.random.default_rng(5)
    samples = [
        read_out(q * np.ones((1, DRAWS)), a, sensor, generator).quad
        for q in quads(2.0, 0.05, sensor)
    ]
    active = 0.05 * electron_gain(sensor)
    tap = (
        active / 2
        + sensor.dark_electrons_per_s * sensor.exposure_s
        + sensor.read_noise_electrons**2
    )
    want = math.sqrt(tap + sensor.electrons_per_code**2 / 24) / (sensor.contrast * active)
    assert wrapped(phase(samples, sensor.shifts) - 2.0).std() == pytest.approx(want, rel=0.01)


def test_tap_statistics():
    """T10: the variance of a tap is mean + s_r^2, and taps are independent:
    variances of a difference add.
    """
    bound = 4 * math.sqrt(2 / DRAWS)  # four standard deviations of an estimated variance
    one = taps_sensor(mean=9e3, amplitude=3e3, read=80.0, unipolar=True, shifts=(0.0,))
    electrons = recorded(0.0, one)[0] * 3e3
    assert electrons.var() == pytest.approx(9e3 + 3e3 + 6400, rel=bound)
    two = taps_sensor(mean=9e3, amplitude=3e3, read=80.0, unipolar=False, shifts=(0.0,))
    electrons = recorded(0.0, two)[0] * 6e3
    assert electrons.var() == pytest.approx(2 * 9e3 + 2 * 6400, rel=bound)


def test_exposure_scales_the_light():
    """Twice the exposure collects twice the electrons and dark current: relative noise falls."""
    once, twice = Sensor(noise=True), Sensor(noise=True, exposure_s=2 * 2.34e-3)
    assert electron_gain(twice) == pytest.approx(2 * electron_gain(once))
    q = np.full((1, DRAWS), 0.05)
    spreads = [
        read_out(q, q, sensor, np.random.default_rng(0)).quad.std() for sensor in (once, twice)
    ]
    assert 1.5 < spreads[0] / spreads[1] < 2.0


def test_quantiser():
    """T11: it adds a twelfth of a step squared, rises monotonically, and ends at -2048 and 2047."""
    sensor = taps_sensor(
        mean=5e3,
        amplitude=1e3,
        read=30.0,
        unipolar=False,
        shifts=(math.pi / 2,),
        electrons_per_code=200.0,
    )
    coarse = Sensor(adc_bits=12, electrons_per_code=200.0)
    electrons = recorded(0.0, sensor)[0] * 2e3  # psi - shift = -pi/2: equal taps
    codes = quantise(electrons, coarse)[0] / 200.0
    assert codes.var() == pytest.approx((1e4 + 1800) / 4e4 + 1 / 12, rel=0.03)
    ramp = np.linspace(-6e5, 6e5, 5001)
    stepped, clipped = quantise(ramp, coarse)
    assert (np.diff(stepped) >= 0).all()
    assert stepped.min() == -2048 * 200
    assert stepped.max() == 2047 * 200
    np.testing.assert_array_equal(clipped, (ramp < -2047.5 * 200) | (ramp > 2046.5 * 200))
    assert (np.abs(stepped - ramp)[~clipped] <= 100 + 1e-6).all()


def test_a_unipolar_adc_does_not_cut_off_the_dark():
    """Its pedestal leaves room for read noise below zero,
    and the range above holds the full well.
    """
    sensor = Sensor(unipolar=True, dc_offset=1.0, noise=True)
    electrons, clipped = quantise(np.array([-400.0, 0.0, 1e5]), sensor)
    assert not clipped.any()
    np.testing.assert_allclose(electrons, [-400.0, 0.0, 1e5], atol=16)


def test_saturation():
    """T12: a sine of B 1, A .45 clipped at 1.3 errs by .05677 rad at most,
    with period pi/2 and mean 0, and says so.
    """
    electrons = 1e12  # so many that shot noise is a millionth
    sensor = taps_sensor(
        mean=electrons, amplitude=0.45 * electrons, read=0.0, unipolar=True, shifts=PAIRED
    )
    sensor = Sensor(**{**vars(sensor), "full_well_electrons": 1.3 * electrons})
    psi = np.linspace(0, 2 * math.pi, 721)[:-1]
    readings = [
        read_out(q[None], np.ones((1, 720)), sensor, np.random.default_rng(0))
        for q in quads(psi, 1.0, sensor)
    ]
    error = wrapped(phase([r.quad[0] for r in readings], PAIRED) - psi)
    assert np.abs(error).max() == pytest.approx(0.05677, abs=1e-4)
    assert abs(error.mean()) < 1e-5
    np.testing.assert_allclose(error, np.roll(error, 180), atol=1e-4)
    full = 1 + 0.45 * np.cos(psi) > 1.3
    assert (readings[0].saturated[0] == full).mean() > 0.99
    assert full.any()


@pytest.mark.parametrize(
    ("snr", "want"), [(0.5, 1.459), (1, 1.117), (2, 0.609), (5, 0.2046), (10, 0.1007)]
)
def test_low_signal(snr, want):
    """T13: the phase of a weak signal, where arg is no longer linear;
    snr is length over sigma of each quadrature.
    """
    amplitude, mean = 4.5e3, 1e4  # per tap; a quad of two taps has twice the amplitude
    # a quadrature is the difference of two quads of two taps
    read = math.sqrt((2 * amplitude / snr) ** 2 - mean)
    sensor = taps_sensor(
        mean=mean, amplitude=amplitude, read=read, unipolar=False, shifts=SEQUENTIAL
    )
    error = wrapped(phase(recorded(1.1, sensor), SEQUENTIAL) - 1.1)
    assert error.std() == pytest.approx(want, rel=0.02)


def test_contradicting_contrast_is_refused():
    """A differential tap cannot hold less than no light."""
    sensor = Sensor(noise=True, contrast=0.9, dc_offset=0.5)
    with pytest.raises(ValueError, match=r"contrast 0\.9 times .* 1\.5"):
        read_out(np.full((1, 1), 0.15), np.full((1, 1), 0.1), sensor, np.random.default_rng(0))


def test_frames_have_their_own_times():
    """Frame n at n periods; in the control mode a quartet shares the time of its first."""
    sensor = Sensor(frame_period_s=0.01)
    np.testing.assert_allclose(
        frame_times(sensor, 6, sync=False), [0, 0.01, 0.02, 0.03, 0.04, 0.05]
    )
    np.testing.assert_allclose(frame_times(sensor, 6, sync=True), [0, 0, 0, 0, 0.04, 0.04])


# -- motion, with analytic light in place of the renderer ------------------------------------------


def cycle(bodies, sensor, *, unit_amplitude=False):
    """Quads of one asynchronous cycle on the axis, and the distances [m] at their times."""
    hits = [
        first_hit(bodies, AHEAD, float(t))
        for t in frame_times(sensor, len(sensor.shifts), sync=False)
    ]
    distance = np.array([hit.distance.item() for hit in hits])
    amplitude = np.array([1.0 if unit_amplitude else hit.amplitude.item() for hit in hits])
    psi = distance * sensor.phase_slope
    return amplitude * (np.cos(psi - np.array(sensor.shifts)) + sensor.dc_offset), distance


@pytest.mark.parametrize(
    ("shifts", "factor"), [(SEQUENTIAL, 0.5), (PAIRED, 1.0), (PALINDROMIC, 0.0)]
)
def test_axial_motion_lags_and_ripples(shifts, factor):
    """T14: phase of mid cycle, 1.5 delta late, plus eta cos(2 psi_mid) with eta by order."""
    sensor = Sensor(f_mod_hz=20e6, shifts=shifts)
    delta = 0.05
    speed = delta / (sensor.phase_slope * sensor.frame_period_s)
    middle, error = [], []
    for start in np.linspace(2.0, 2.0 + sensor.unambiguous_range, 180, endpoint=False):
        wall = Body(
            shape=Plane(size=(9.0, 9.0)),
            texture=Texture(low=0.5, high=0.5),
            path=Line(position=(0.0, 0.0, float(start)), velocity=(0.0, 0.0, speed)),
        )
        samples, distance = cycle((wall,), sensor, unit_amplitude=True)
        middle.append(distance.mean() * sensor.phase_slope)
        error.append(float(wrapped(phase(samples, shifts) - distance[0] * sensor.phase_slope)))
    middle, error = np.array(middle), np.array(error)
    assert error.mean() == pytest.approx(1.5 * delta, abs=1e-3)
    assert 2 * np.mean(error * np.cos(2 * middle)) == pytest.approx(
        factor * delta, abs=0.05 * 0.5 * delta
    )


@pytest.mark.parametrize(
    ("shifts", "dc", "want"),
    [
        (SEQUENTIAL, 0, (2.407, 2.103, 2.196, 2.196, 2.053, 2.331)),
        (SEQUENTIAL, 1, (1.700, 2.378, 1.799, 2.812, 2.005, 2.546)),
        (PAIRED, 0, (2.407, 2.103, 2.178, 2.204, 2.053, 2.331)),
        (PAIRED, 1, (1.700, 2.378, 2.178, 2.204, 2.005, 2.546)),
        (PALINDROMIC, 0, (2.407, 2.103, 2.196, 2.196, 2.103, 2.407)),
        (PALINDROMIC, 1, (1.700, 2.378, 1.799, 2.812, 1.803, 2.870)),
    ],
)
def test_a_sliding_edge_mixes_two_distances(shifts, dc, want):
    """T15: a near wall uncovers or covers a far one after 1, 2 or 3 raw frames;
    published distances, to 1 mm.
    """
    sensor = Sensor(f_mod_hz=20e6, shifts=shifts, dc_offset=float(dc))
    far = Body(
        shape=Plane(size=(9.0, 9.0)),
        texture=Texture(low=0.074 * 2.6**2, high=0.074 * 2.6**2),
        path=Still(position=(0.0, 0.0, 2.6)),
    )
    got = []
    for frames in (1, 2, 3):
        for edge in (
            1.0,
            -1.0,
        ):  # of a wall 2 m wide that moves to the right: its left edge leaves, its right one comes
            # [m] that it has moved when its edge is on the axis
            passing = 3.0 * sensor.frame_period_s * (frames - 0.5)
            near = Body(
                shape=Plane(size=(2.0, 2.0)),
                texture=Texture(low=0.15 * 2.0**2, high=0.15 * 2.0**2),
                path=Line(position=(edge - passing, 0.0, 2.0), velocity=(3.0, 0.0, 0.0)),
            )
            samples, distance = cycle((far, near), sensor)
            first = 2.0 if edge > 0 else 2.6
            np.testing.assert_allclose(distance == first, np.arange(4) < frames)
            re, im = phasor_from_quads(torch.from_numpy(samples), shifts)
            got.append(float(distance_from_phasor(re, im, sensor)))
    np.testing.assert_allclose(got, want, atol=1e-3)


def test_the_gain_is_that_of_the_notes():
    """Electron budget of section 3: reflectance .5 at 1 m gives 1.572e5 modulated electrons."""
    assert 0.5 * electron_gain(Sensor()) == pytest.approx(1.572e5, rel=1e-3)
