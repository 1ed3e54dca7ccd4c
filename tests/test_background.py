"""The static background of a recording: planted cases, one per block of pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording
from sequences import changed

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.scene.background import background
from gftorf_warp.scene.measured import change_of, distance_noise

QUARTETS, HEIGHT, SIDE = 12, 24, 8
NOISE = 2e-4  # [quad units]
WALL, NEAR = 3.0, 2.0  # [m]
AMPLITUDE = 0.05  # [quad units]; a distance has a noise of 3.4 mm
RANGE = 7.5  # [m]


def seen(name, i):
    """Distance [m] and amplitude of a case in quartet i."""
    passing = 1.2 + 0.1 * i  # a body that comes nearer or goes away, never twice at one distance
    distance = {
        "rest": WALL,
        "passed": passing if 4 <= i < 8 else WALL,
        "came late": NEAR if i >= 6 else WALL,
        "moved away": NEAR if i < 7 else WALL,
        "came a little": WALL - 0.15 if i >= 6 else WALL,
        "seen twice": NEAR if i >= 2 else WALL,
        "seen three times": NEAR if i >= 3 else WALL,
        "recedes": 1.5 + 0.12 * i,
        "starts late": NEAR if i < 7 else NEAR + 0.12 * (i - 6),
        "one outlier": 6.0 if i == 5 else WALL,
        "dark": WALL,
        "at the range": RANGE - 0.002,
        "beyond the range": RANGE + 0.8,
    }[name]
    return distance, 1e-5 if name == "dark" else AMPLITUDE


CASES = (
    *("rest", "passed", "came late", "came a little", "moved away"),
    *("seen twice", "seen three times", "recedes", "starts late"),
    *("one outlier", "dark", "at the range", "beyond the range"),
)


def planted(
    *, noise=NOISE, shifts=(0.0, np.pi, np.pi / 2, 3 * np.pi / 2), frequencies=None, seed=0
):
    """A recording with a block of every case between wider blocks at rest."""
    cycle, width = len(shifts), 4 * SIDE * len(CASES)
    frequencies = (
        np.full(cycle, SPEED_OF_LIGHT / (2 * RANGE)) if frequencies is None else frequencies
    )
    quads = np.zeros((cycle * QUARTETS, HEIGHT, width))
    for i in range(QUARTETS):
        values = np.array([seen(name, i) for case in CASES for name in (*3 * ["rest"], case)])
        distance, amplitude = np.repeat(values, SIDE, axis=0).T
        for k, (shift, f) in enumerate(zip(shifts, frequencies, strict=True)):
            phase = 4 * np.pi * f / SPEED_OF_LIGHT * distance - shift
            quads[cycle * i + k] = amplitude * np.cos(phase)
    quads += noise * np.random.default_rng(seed).standard_normal(quads.shape)
    frames = len(quads)
    base = recording(frames=4, with_flow=False)[0]
    return changed(
        base,
        quads=quads.astype(np.float32),
        measured=np.ones(frames, dtype=bool),
        shifts=np.tile(shifts, QUARTETS),
        times=np.arange(frames) / 120.0,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
        f_mod_hz=float(frequencies[0]),
        frequencies_hz=np.tile(frequencies, QUARTETS),
        cycle_length=cycle,
    )


def block(image, name):
    """The pixels of a case."""
    start = SIDE * (4 * CASES.index(name) + 3)
    return image[:, start : start + SIDE]


@pytest.fixture(scope="module")
def found():
    """The background of the planted cases, and the noise of one distance [m]."""
    sequence = planted()
    change = change_of(sequence)
    assert change.noise == pytest.approx(NOISE, rel=0.1)
    sigma = float(distance_noise(torch.tensor(AMPLITUDE), NOISE, sequence))
    return background(sequence, change), sigma


@pytest.mark.parametrize(
    ("name", "quartets"),
    [
        ("rest", 12),  # all quartets are averaged
        ("passed", 8),
        ("came late", 6),
        ("came a little", 6),
        ("moved away", 5),
        ("one outlier", 11),
    ],
)
def test_the_wall_is_averaged_over_the_quartets_that_saw_it(found, name, quartets):
    """Its error is that of a mean of so many quartets, without a bias."""
    far, sigma = found
    assert block(far.known, name).float().mean() > 0.97
    error = (block(far.distance, name) - WALL)[block(far.known, name)]
    assert float(error.square().mean().sqrt()) < 1.15 * sigma / quartets**0.5
    assert abs(float(error.mean())) < 0.3 * sigma
    amplitude = block(far.amplitude, name)[block(far.known, name)]
    torch.testing.assert_close(amplitude, torch.full_like(amplitude, AMPLITUDE), rtol=0.01, atol=0)


def test_what_is_hidden_but_for_two_quartets_has_the_distance_of_what_hides_it(found):
    """A body that comes after two quartets and stays is background for a recording this short."""
    far, _ = found
    assert block(far.known, "seen twice").float().mean() > 0.97
    error = (block(far.distance, "seen twice") - NEAR)[block(far.known, "seen twice")]
    assert float(error.abs().max()) < 0.02


@pytest.mark.parametrize("name", ["seen three times", "recedes", "starts late", "dark"])
def test_unknown_pixels_are_filled_by_their_neighbours(found, name):
    """Where what is behind a body was not seen often enough, where no distance was measured twice,
    where a body that rested recedes and where hardly any light comes back: not known, and the wall
    at both sides is continued.
    """
    far, sigma = found
    assert block(far.known, name).float().mean() < 0.03
    error = block(far.distance, name)[~block(far.known, name)] - WALL
    assert float(error.abs().max()) < 6.0 * sigma
    amplitude = block(far.amplitude, name)[~block(far.known, name)]
    torch.testing.assert_close(amplitude, torch.full_like(amplitude, AMPLITUDE), rtol=0.05, atol=0)


def test_distances_at_the_end_of_the_range_are_averaged_as_phasors(found):
    """Noise takes single distances to zero; no mean is half the range. Beyond it they are wrapped,
    as those of every quartet.
    """
    far, sigma = found
    distance = block(far.distance, "at the range")
    apart = (distance - (RANGE - 0.002) + RANGE / 2) % RANGE - RANGE / 2
    assert float(apart.square().mean().sqrt()) < 1.15 * sigma / QUARTETS**0.5
    error = block(far.distance, "beyond the range") - 0.8
    assert float(error.abs().max()) < 6.0 * sigma / QUARTETS**0.5


@pytest.mark.parametrize("name", ["rest", "came late", "moved away", "beyond the range"])
def test_several_frequencies_are_averaged_and_unwrapped_together(name):
    """40 and 60 MHz with three shifts each: distances modulo 7.5 m."""
    shifts = (0.0, 2.1, 4.2, 0.0, 2.1, 4.2)
    step = SPEED_OF_LIGHT / (2 * RANGE)
    sequence = planted(shifts=shifts, frequencies=np.repeat([3 * step, 2 * step], 3))
    far = background(sequence, change_of(sequence))
    assert block(far.known, name).float().mean() > 0.97
    want = 0.8 if name == "beyond the range" else WALL
    error = (block(far.distance, name) - want)[block(far.known, name)]
    assert float(error.abs().max()) < 0.02


def test_one_quartet_alone_is_its_own_background():
    """Its noise cannot be measured; every pixel with light is known."""
    whole = planted()
    frames = slice(0, 4)
    parts = ("quads", "measured", "shifts", "times", "camera_from_world", "frequencies_hz")
    one = replace(whole, **{name: getattr(whole, name)[frames] for name in parts})
    far = background(one, change_of(one))
    assert far.known.all()
    error = block(far.distance, "rest") - WALL
    sigma = float(distance_noise(torch.tensor(AMPLITUDE), NOISE, whole))
    assert float(error.square().mean().sqrt()) < 1.2 * sigma


def test_a_recording_without_noise_has_a_background():
    """Means of equal phasors differ by rounding."""
    sequence = planted(noise=0.0)
    far = background(sequence, change_of(sequence))
    for name in ("rest", "passed", "came late", "moved away"):
        assert block(far.known, name).all()
        assert float((block(far.distance, name) - WALL).abs().max()) < 1e-3
