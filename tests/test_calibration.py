"""Scenes at rest against their closed forms."""

import math

import numpy as np
import pytest
import torch

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.sim.calibration import CALIBRATION
from gftorf_warp.sim.ideal_sensor import ideal_recording, light_of
from gftorf_warp.sim.scenes import SCENES


def seen(name):
    """Ideal light, unit rays in world axes, and the scene."""
    scene = SCENES[name]
    return light_of(scene, 0.0), scene.camera().rays(dtype=torch.float64).numpy(), scene


@pytest.mark.parametrize("name", [make.__name__ for make in CALIBRATION])
def test_nothing_moves_and_the_closed_form_is_right(name):
    """To float32 rounding of the quads, in every pixel."""
    light, _, scene = seen(name)
    assert not any(body.moves for body in scene.bodies)
    assert not scene.camera_moves
    sequence, truth = ideal_recording(scene, dict.fromkeys(range(4), light))
    np.testing.assert_allclose(closed_form_distance(sequence, 0), truth.distance[0], atol=2e-5)
    assert truth.distance[0].max() < scene.sensor.unambiguous_range
    assert scene.closed_form == 0.0


def test_flat_wall():
    """D / cos and rho cos^3 / D^2."""
    light, ray, _ = seen("flat_wall")
    np.testing.assert_allclose(light.distance, 2.0 / ray[..., 2], rtol=1e-12)
    np.testing.assert_allclose(light.amplitude, 0.5 * ray[..., 2] ** 3 / 4.0, rtol=1e-12)


def test_wedge():
    """Beside the edge, at 2 m, rays in the plane of its cross-section meet faces z = 2 + |x|."""
    light, ray, _ = seen("wedge")
    row = light.distance[120, 130:190]
    across = ray[120, 130:190, 2] - np.abs(ray[120, 130:190, 0])
    np.testing.assert_allclose(row, 2.0 / across, rtol=1e-12)


def test_corner():
    """The camera looks at the line x = -1, z = 2 and sees both walls,
    each over half of the image or so.
    """
    light, ray, _ = seen("corner")
    with np.errstate(divide="ignore"):
        left = np.where(ray[..., 0] < 0, -1.0 / ray[..., 0], np.inf)
        back = np.where(ray[..., 2] > 0, 2.0 / ray[..., 2], np.inf)
    np.testing.assert_allclose(light.distance, np.minimum(left, back), rtol=1e-12)
    assert 0.3 < (left < back).mean() < 0.7
    assert light.distance[119:121, 159:161].max() == pytest.approx(math.sqrt(5.0), rel=0.01)


def test_sphere():
    """Nearest in the middle, at 2 m, and as wide as its tangents."""
    light, _, scene = seen("sphere")
    assert light.distance.min() == pytest.approx(2.0, abs=1e-4)
    wide = (light.distance[120] < 2.6).sum()
    assert wide == pytest.approx(2 * scene.camera().fx * math.tan(math.asin(0.5 / 2.5)), abs=2)
