"""The second truth: what the closed form would decode from four noise-free quads of one instant,
of all the light.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES

SIZE = (32, 24)


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"engine": "mesh"},
        {"engine": "mesh", "bounces": 2, "paths": 256},
        {"exposure_samples": 3},
    ],
    ids=str,
)
def test_it_is_the_closed_form_of_one_instant(more):
    """At quartet starts the noise-free closed form of simultaneous quads, whatever noise,
    blur and motion did.
    """
    scene = replace(SCENES["demo"], sensor=Sensor(noise=True, phase_offset=0.7, dc_offset=0.1))
    size = (16, 12) if "bounces" in more else SIZE
    truth = record(scene, size=size, frames=5, **more).truth
    still = {**more, "exposure_samples": 1}
    sync = record(scene, size=size, frames=8, sync=True, noise=False, **still).sequence
    bound = 0.03 if "bounces" in more else 1e-4  # every raw frame has other random paths
    for i in (0, 1):
        difference = np.abs(closed_form_distance(sync, i) - truth.phasor_distance[4 * i])
        assert np.median(difference) < bound
        assert np.quantile(difference, 0.9 if "bounces" in more else 1.0) < 5 * bound
    assert np.abs(truth.phasor_distance[1] - truth.phasor_distance[0]).max() > 0.3, (
        "nothing moved: any time would do"
    )


def test_light_that_bounces_makes_it_longer_and_geometry_does_not_know():
    """In a closed room at 20 MHz indirect light comes late;
    the geometric distance is that of the first hit.
    """
    direct, indirect = (
        record(SCENES["demo"], size=SIZE, frames=1, engine="mesh", bounces=n, paths=64).truth
        for n in (0, 2)
    )
    np.testing.assert_array_equal(direct.distance, indirect.distance)
    assert np.median(indirect.phasor_distance - direct.phasor_distance) > 0.05
    assert np.median(np.abs(direct.phasor_distance - direct.distance)) < 0.02


def test_it_wraps_where_distance_does_not():
    """It lies in [0, c/2f), and is the distance again modulo that range."""
    sensor = Sensor(noise=True, f_mod_hz=6e7)
    scene = replace(SCENES["demo"], sensor=sensor, bodies=SCENES["demo"].bodies[:1], subsamples=1)
    truth = record(scene, size=SIZE, frames=1, engine="mesh").truth
    reach = sensor.unambiguous_range
    assert truth.distance.max() > reach > truth.phasor_distance.max()
    assert truth.phasor_distance.min() >= 0
    turned = 2 * math.pi * (truth.phasor_distance - truth.distance) / reach
    assert np.abs(np.angle(np.exp(1j * turned))).max() < 1e-3


def test_amplitude_and_objects_are_those_of_the_scene():
    """The amplitude is that of the quads, without noise; objects are numbered as in the scene."""
    recording = record(replace(SCENES["demo"], sensor=Sensor()), size=SIZE, frames=4, sync=True)
    re = recording.sequence.quads[0] - recording.sequence.quads[1]
    im = recording.sequence.quads[2] - recording.sequence.quads[3]
    ratio = np.hypot(re, im) / 2 / recording.truth.amplitude[0]
    assert 0.99 < np.median(ratio) < 1.001
    assert set(np.unique(recording.truth.body)) == {0, 1}
    assert np.median(recording.truth.distance[recording.truth.body == 1]) < 3.2
