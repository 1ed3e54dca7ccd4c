"""Known mistakes with phasors of a moving camera (method, section 10): poses, lengths, ranges,
unknown pixels, colour.

The folders are written here, file by file, so that a reader and a writer cannot agree on a mistake.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from cases import pose
from mistakes import dots

from gftorf_warp import Sequence
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data import decode
from gftorf_warp.errors import InputError
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.measured import camera_of, colour_camera_of, sensor_of

TOF_FROM_WORLD = np.stack(
    [pose((0.2, 1.0, 0.1), 0.3 + 0.1 * i, (0.1, -0.2 * i, 0.3)) for i in range(3)]
)
# a relative pose E, colour to ToF
TOF_FROM_COLOUR = pose((0.1, 0.3, 1.0), 0.2, (0.12, 0.03, -0.05))
DISTANCE = 1.0 + 0.07 * np.arange(48).reshape(6, 8)
AMPLITUDE = 0.8 / DISTANCE**2  # of a quad
COLOUR = np.linspace(-0.2, 3.0, 12 * 16 * 3, dtype=np.float32).reshape(12, 16, 3)


@pytest.fixture
def folder(tmp_path):
    """Three phasors of 8x6 pixels at depth_range 10 m, colour images of 16x12, a pose per phasor,
    a relative pose.
    """
    root = tmp_path / "seq"
    for name in ("tof", "color", "cams"):
        (root / name).mkdir(parents=True)
    phase = 4 * math.pi * DISTANCE / 10.0 - 0.4
    phasor = (
        2
        * AMPLITUDE[..., None]
        * np.stack([np.cos(phase), np.sin(phase), np.ones_like(phase)], axis=-1)
    )
    for i in range(3):
        np.save(root / f"tof/{i:04d}.npy", phasor.astype(np.float32))
        np.save(root / f"color/{i:04d}.npy", COLOUR + np.float32(i))
    for name, value in {
        "tof_intrinsics": np.array([[7.0, 0, 3.4], [0, 7.5, 2.6], [0, 0, 1]]),
        "color_intrinsics": np.array([[14.0, 0, 7.2], [0, 14.5, 5.9], [0, 0, 1]]),
        "tof_extrinsics": TOF_FROM_WORLD,
        "relative_pose": TOF_FROM_COLOUR,
        "depth_range": np.float64(10.0),
        "phase_offset": np.float64(-0.4),
    }.items():
        np.save(root / f"cams/{name}.npy", value)
    return root


def test_mistake_09_the_range_of_phasors_is_half_of_what_the_file_says(folder):
    """depth_range 10 m is 29.98 MHz and unambiguous to 5 m;
    the pixels decode to their distances.
    """
    sequence = Sequence.open(folder)
    assert sequence.calibration.f_mod_hz == pytest.approx(SPEED_OF_LIGHT / 10.0, rel=1e-12)
    assert sensor_of(sequence).unambiguous_range == pytest.approx(5.0)
    np.testing.assert_allclose(decode.closed_form_distance(sequence, 2), DISTANCE, rtol=1e-5)


def test_mistake_10_quads_of_a_phasor_are_half_as_long(folder):
    """Their differences are the stored phasor to the bit,
    so a rendered amplitude of a is compared with 2a / 2.
    """
    sequence = Sequence.open(folder)
    stored = np.load(folder / "tof/0001.npy")
    np.testing.assert_array_equal(sequence.quads[4] - sequence.quads[5], stored[..., 0])
    np.testing.assert_array_equal(sequence.quads[6] - sequence.quads[7], stored[..., 1])
    np.testing.assert_allclose(np.hypot(sequence.quads[4], sequence.quads[6]), AMPLITUDE, rtol=1e-5)


def test_mistake_15_one_unknown_phasor_pixel_cannot_silence_a_sequence(folder):
    """It is named as an error when it is read; a scale of NaN or zero never arises."""
    scale, _ = decode.quad_scale(Sequence.open(folder))
    assert scale == pytest.approx(1.0 / (2 * AMPLITUDE.max()), rel=1e-5)
    broken = np.load(folder / "tof/0001.npy")
    broken[3, 4, 0] = np.nan
    np.save(folder / "tof/0001.npy", broken)
    with pytest.raises(InputError, match="nan"):
        Sequence.open(folder)


@pytest.mark.parametrize("phasor", [0, 2])
def test_mistake_20_poses_are_world_to_camera_for_all_four_quads(folder, phasor):
    """A point 2 m in front of the ToF camera is seen there at every raw frame of its phasor."""
    sequence = Sequence.open(folder)
    world = np.linalg.inv(TOF_FROM_WORLD[phasor]) @ [0.3, -0.1, 2.0, 1.0]
    for frame in range(4 * phasor, 4 * phasor + 4):
        at = camera_of(sequence, frame).project(torch.tensor(world[:3]))
        assert at.tolist() == pytest.approx([7.0 * 0.15 + 3.9, 7.5 * -0.05 + 3.1])
    image = rasterize(
        dots(world[:3], scale=0.3), camera_of(sequence, 4 * phasor), sensor_of(sequence)
    )
    y, x = divmod(int(image.opacity.argmax()), 8)
    assert (x, y) == (4, 2)
    assert float((image.distance / image.opacity)[y, x]) == pytest.approx(
        math.hypot(0.3, 0.1, 2.0), rel=1e-4
    )


def test_mistake_20_the_relative_pose_takes_colour_to_tof(folder):
    """What the colour camera has at (x, y, z) is where E and the ToF pose put it;
    the inverse of E would miss it.
    """
    sequence = Sequence.open(folder)
    for phasor in range(3):
        local = np.array([0.2, 0.3, 1.5, 1.0])
        world = np.linalg.inv(TOF_FROM_WORLD[phasor]) @ TOF_FROM_COLOUR @ local
        camera = colour_camera_of(sequence, 4 * phasor + 1)
        assert (camera.width, camera.height) == (16, 12)
        at = camera.project(torch.tensor(world[:3])).numpy()
        np.testing.assert_allclose(at, [14.0 * 0.2 / 1.5 + 7.7, 14.5 * 0.3 / 1.5 + 6.4], atol=1e-6)
        centre = np.linalg.inv(TOF_FROM_WORLD[phasor]) @ TOF_FROM_COLOUR[:, 3]
        np.testing.assert_allclose(camera.centre, centre[:3], atol=1e-9)


def test_mistake_20_colour_is_read_as_stored(folder):
    """Float, negative, above white, and between the steps of 8 bits."""
    sequence = Sequence.open(folder)
    assert sorted(sequence.colour.images) == [0, 4, 8]
    for i in range(3):
        assert sequence.colour.images[4 * i].dtype == np.float32
        np.testing.assert_array_equal(sequence.colour.images[4 * i], COLOUR + np.float32(i))


def test_mistake_21_tof_and_colour_keep_their_own_size_and_intrinsics(folder):
    """Twice the pixels in the colour images; the ToF camera does not notice.
    Integer centres gain half a pixel.
    """
    sequence = Sequence.open(folder)
    assert sequence.quads.shape == (12, 6, 8)
    assert dataclasses.astuple(sequence.intrinsics)[:4] == pytest.approx((7.0, 7.5, 3.9, 3.1))
    assert dataclasses.astuple(sequence.colour.intrinsics)[:4] == pytest.approx(
        (14.0, 14.5, 7.7, 6.4)
    )
