"""One sensor behind both engines: harmonics, patterns,
several frequencies and any shifts on a wall, in closed form.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from closed_forms import cycle_distance

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.pattern import Pattern, phase_map
from gftorf_warp.scene.sensor import Sensor, phasor_from_quads
from gftorf_warp.scene.unwrap import common_range
from gftorf_warp.sim.assembly import Level
from gftorf_warp.sim.ideal_sensor import ideal_recording
from gftorf_warp.sim.paths import Still
from gftorf_warp.sim.record import frame_times, record
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.world import Body, Texture

ENGINES = ["gaussian", "mesh"]
SIZE = 18, 24
# of the amplitude [1], of a distance [m]
WITHIN = {"gaussian": (1.2e-2, 2e-3), "mesh": (8e-5, 2e-5)}


def wall(sensor, z=5.2, **more):
    """A grey wall in front of a narrow camera, in which splats are as exact as they get."""
    body = Body(
        shape=Level(axis=2, value=z),
        texture=Texture(low=0.5, high=0.5),
        path=Still(position=(0.0, 0.0, 0.0)),
    )
    texts = {"name": "wall", "description": "a wall", "motion": "none"}
    view = {"width": SIZE[1], "height": SIZE[0], "horizontal_fov_deg": 10.0, "subsamples": 1}
    return Scene(**texts, bodies=(body,), frames=len(sensor.cycle), sensor=sensor, **view, **more)


def quads_and_light(sensor, engine):
    """Recorded quads without noise, and amplitude and phase [rad] at the first frequency,
    from shapes alone.
    """
    scene = wall(sensor)
    got = record(scene, engine=engine, noise=False)
    cosine = scene.camera().directions()[..., 2].numpy()
    distance = 5.2 / cosine
    amplitude = float(sensor.source_intensity) * 0.5 * cosine / distance**2
    return got.sequence, amplitude, distance


@pytest.mark.parametrize("engine", ENGINES)
def test_harmonics_and_patterns_are_the_closed_form(engine):
    """Sum_h r_h cos h (psi + offset + pattern - shift) of an opaque wall,
    at every raw frame and pixel.
    """
    ratios = {1: 1.0, 3: 0.2, 4: -0.05}
    sensor = Sensor(
        f_mod_hz=30e6,
        shifts=(0.3, 2.0, 4.5),
        phase_offset=0.4,
        dc_offset=0.25,
        source_intensity=1.3,
        harmonic_contrast=(0.0, ratios[3], ratios[4]),
        pattern=Pattern(phase=4.0),
    )
    sequence, amplitude, distance = quads_and_light(sensor, engine)
    pattern = phase_map(sensor.pattern, *SIZE)
    assert np.ptp(pattern) > 0.5
    for quad, shift in zip(sequence.quads, sensor.shifts, strict=True):
        angle = sensor.phase_slope * distance + 0.4 + pattern - shift
        want = amplitude * (sum(r * np.cos(h * angle) for h, r in ratios.items()) + 0.25)
        share = quad[2:-2, 2:-2] / amplitude[2:-2, 2:-2] - (want / amplitude)[2:-2, 2:-2]
        assert np.abs(share).max() < WITHIN[engine][0]


def test_every_effect_alone_changes_what_is_recorded():
    """Harmonics, the pattern of the phase and that of the gain, by both engines;
    what is zero changes nothing.
    """
    for engine in ENGINES:
        plain = record(wall(Sensor()), engine=engine).sequence.quads
        for effect in (
            {"harmonic_contrast": (0.0, 0.2)},
            {"pattern": Pattern(phase=1.0)},
            {"pattern": Pattern(gain=0.1)},
        ):
            other = record(wall(Sensor(**effect)), engine=engine).sequence.quads
            assert np.abs(other - plain).max() > 0.01 * np.abs(plain).max(), (engine, effect)
        none = record(
            wall(Sensor(harmonic_contrast=(0.0, 0.0), pattern=Pattern(seed=3))), engine=engine
        )
        np.testing.assert_array_equal(none.sequence.quads, plain)


@pytest.mark.parametrize("engine", ENGINES)
def test_two_frequencies_see_beyond_the_range_of_each(engine, tmp_path):
    """A wall at 5.2 m by 60 and 40 MHz, which alone reach 2.5 and 3.7 m;
    each raw frame keeps its own frequency.
    """
    sensor = Sensor(f_mod_hz=60e6, further_hz=(40e6,), shifts=(0.0, 2.1, 4.2))
    sequence, _, distance = quads_and_light(sensor, engine)
    assert sequence.frequencies_hz.tolist() == [60e6] * 3 + [40e6] * 3
    assert sequence.shifts.tolist() == [0.0, 2.1, 4.2] * 2
    assert sensor.unambiguous_range < 2.5 < 5.2 < common_range(sensor)
    got = cycle_distance(torch.from_numpy(sequence.quads).double(), sensor).numpy()
    np.testing.assert_allclose(got[2:-2, 2:-2], distance[2:-2, 2:-2], atol=WITHIN[engine][1])
    np.testing.assert_allclose(closed_form_distance(sequence, 0), got, atol=1e-6)
    with pytest.raises(UsageError, match="frequencies_hz"):
        write(
            "ftorf",
            tmp_path / "out",
            replace(sequence, shifts=np.resize([0, math.pi, math.pi / 2, 1.5 * math.pi], 6)),
        )
    ideal = ideal_recording(wall(sensor))[0]
    assert (ideal.cycle, ideal.frequencies) == (6, (60e6, 40e6))
    np.testing.assert_allclose(closed_form_distance(ideal, 0), distance, atol=1e-4)
    with pytest.raises(ValueError, match="read by a sensor of"):
        ideal_recording(wall(sensor), sensor=replace(sensor, further_hz=()))


@pytest.mark.parametrize(
    "shifts",
    [(0.0, 1.0, 2.5), (3.0, 0.2, 5.5, 1.7, 4.0), tuple(math.tau * j / 8 for j in range(8))],
)
def test_any_shifts_give_the_distance(shifts):
    """Three, five and eight of them, evenly spaced or not."""
    sensor = Sensor(f_mod_hz=20e6, shifts=shifts, dc_offset=0.3)
    sequence, _, distance = quads_and_light(sensor, "mesh")
    assert sequence.shifts.tolist() == list(shifts)
    np.testing.assert_allclose(
        cycle_distance(torch.from_numpy(sequence.quads).double(), sensor), distance, atol=1e-4
    )


def test_a_cycle_of_any_length_shares_one_time_in_sync():
    """The control mode takes whole cycles at once, not quartets."""
    sensor = Sensor(frame_period_s=0.01, shifts=(0.0, 2.0, 4.0))
    np.testing.assert_allclose(frame_times(sensor, 7, sync=True), [0, 0, 0, 0.03, 0.03, 0.03, 0.06])
    two = replace(sensor, further_hz=(30e6,))
    np.testing.assert_allclose(frame_times(two, 7, sync=True), [0] * 6 + [0.06])


def test_frames_of_a_shorter_recording_are_those_of_a_longer():
    """With pattern, harmonics, noise and two frequencies:
    everything belongs to the raw frame or to the sensor.
    """
    sensor = Sensor(
        noise=True,
        further_hz=(30e6,),
        harmonic_contrast=(0.0, 0.1),
        pattern=Pattern(phase=1.0, gain=0.01, dark=0.2),
    )
    long, short = (record(wall(sensor), frames=n, seed=3, engine="mesh").sequence for n in (10, 6))
    np.testing.assert_array_equal(long.quads[:6], short.quads)
    other = record(wall(sensor), frames=6, seed=4, engine="mesh").sequence
    assert not np.array_equal(other.quads, short.quads)
    decoded = []
    for sequence in (short, other):
        re, im = phasor_from_quads(torch.from_numpy(sequence.quads[:4]), sensor.shifts)
        decoded.append(torch.atan2(im, re).numpy())
    fixed = np.corrcoef(*(image.ravel() for image in decoded))[0, 1]
    assert fixed > 0.5  # what two recordings of one specimen have in common
