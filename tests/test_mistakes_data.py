"""Known mistakes with recordings (method, section 10): columns, order, ranges, gaps, scales,
offsets, sizes, colour.

Each test is named after the number of the mistake it would fail at; design/mistakes.md lists all of
them.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from ftorf_folder import REAL_ORDER
from mistakes import DEPTH_RANGE, dots, phase_of, ramp, wall
from sequences import changed

from gftorf_warp import Sequence
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data import decode
from gftorf_warp.data.check import check
from gftorf_warp.data.constant import constant_part
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe, reduced
from gftorf_warp.recon.settings import FlowSource
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.initialise import MOVING, STATIC, InitSettings, from_phase
from gftorf_warp.scene.measured import camera_of, decode_along_flow, key_times, sensor_of

SIZES = pytest.mark.parametrize(("height", "width"), [(12, 20), (20, 12)], ids=["wide", "tall"])
WITHOUT_FLOW = replace(presets.demo(), flow=FlowSource.NONE)
EVERY_PIXEL = InitSettings(static_spacing=1.0, moving_spacing=1.0)


def seen_at(sequence, field, label):
    """Pixel (rows, columns) and distance [m] of the Gaussians of one layer,
    as the camera sees them.
    """
    camera, mean = camera_of(sequence, 0), field.mean[field.layer == label]
    x, y = camera.project(mean).unbind(dim=1)
    assert ((x % 1.0 - 0.5).abs() < 1e-3).all(), "they sit at pixel centres"
    return y.long().numpy(), x.long().numpy(), mean.norm(dim=1).numpy()


@SIZES
def test_mistake_04_the_static_layer_is_back_projected_through_its_own_column(height, width):
    """No two pixels are equally far, and the image is no square:
    an index taken modulo the wrong side shows.
    """
    distance = ramp(height, width)
    sequence = wall(distance)
    rows, columns, got = seen_at(sequence, from_phase(sequence, EVERY_PIXEL).field, STATIC)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == list(
        np.ndindex(height, width)
    )
    np.testing.assert_allclose(got, distance[rows, columns], rtol=1e-4)


@SIZES
def test_mistake_04_the_moving_layer_is_back_projected_through_its_own_column(height, width):
    """Something off the middle is there in three of seven quartets,
    a metre in front of the wall behind it.
    """
    far, near = ramp(height, width), np.arange(7) // 2 == 1
    near[4] = True
    block = np.zeros((height, width), dtype=bool)
    block[height // 4 : height // 4 + 6, width // 2 : width // 2 + 5] = True
    distance = np.stack([np.where(block & near[n // 4], far - 1.0, far) for n in range(28)])
    sequence = wall(distance, frames=28)
    rows, columns, got = seen_at(sequence, from_phase(sequence, EVERY_PIXEL).field, MOVING)
    assert block[rows, columns].all()
    assert len(rows) > 0.5 * block.sum(), "all but its corners"
    np.testing.assert_allclose(got, far[rows, columns] - 1.0, rtol=1e-4)


def test_mistake_04_the_start_is_one_distance_per_pixel_within_one_range():
    """No wrap hypothesis is added: what is farther than c/2f starts one range too near,
    and is not doubled.
    """
    sequence = wall(ramp(12, 20) + 7.0)
    field = from_phase(sequence, EVERY_PIXEL).field
    assert len(field) == 12 * 20
    assert field.mean.norm(dim=1).max() < DEPTH_RANGE / 2


@pytest.mark.parametrize(
    "permutation", [REAL_ORDER, (0, 1, 2, 3), (1, 3, 0, 2)], ids=["real", "canonical", "paper"]
)
def test_mistake_07_the_order_of_quads_is_read_from_the_folder(tmp_path, permutation):
    """Every stored order decodes to the truth; real files in the paper's order are off by a
    quarter of c/2f.
    """
    distance = ramp(6, 8)
    folder = write("ftorf", tmp_path / "seq", wall(distance, permutation=permutation))
    sequence = Sequence.open(folder)
    np.testing.assert_allclose(decode.closed_form_distance(sequence, 1), distance, rtol=1e-5)
    start = from_phase(sequence, EVERY_PIXEL).field
    np.testing.assert_allclose(start.mean.norm(dim=1).numpy(), distance.ravel(), rtol=1e-4)
    if permutation == REAL_ORDER:
        np.save(folder / "tof_permutation.npy", np.array([1, 3, 0, 2]))
        wrong = decode.closed_form_distance(Sequence.open(folder), 1)
        offset = wrong - distance
        np.testing.assert_allclose(np.abs(offset), DEPTH_RANGE / 8, rtol=0.35)
        assert np.abs(offset).min() > 1.0


def test_mistake_09_depth_range_is_twice_the_unambiguous_range(tmp_path):
    """A file that says 15 means 19.986 MHz and 7.5 m: a wall at 6 m is at 6 m,
    one at 9 m appears at 1.5 m.
    """
    distance = np.where(np.arange(8) < 4, 6.0, 9.0) * np.ones((6, 1))
    folder = write("ftorf", tmp_path / "seq", wall(distance))
    np.save(folder / "cams/depth_range.npy", np.float64(15.0))
    sequence = Sequence.open(folder)
    assert sequence.calibration.f_mod_hz == pytest.approx(SPEED_OF_LIGHT / 15.0, rel=1e-12)
    sensor = sensor_of(sequence)
    assert sensor.unambiguous_range == pytest.approx(7.5)
    assert sensor.phase_slope == pytest.approx(2 * math.pi / 7.5)
    np.testing.assert_allclose(
        decode.closed_form_distance(sequence, 0), np.where(distance > 7, 1.5, 6.0), rtol=1e-5
    )


def test_mistake_10_the_start_takes_half_a_phasor_for_the_amplitude():
    """Quads of amplitude 0.8 / d^2 make phasors of twice that;
    the reflectivity behind them is 0.8.
    """
    distance = ramp(12, 20)
    sequence = wall(distance, phase_offset=0.0, dc_offset=0.0)
    quads = 0.8 / distance**2 * np.cos(phase_of(distance) - sequence.shifts[:, None, None])
    sequence = replace(sequence, quads=quads.astype(np.float32))
    _, amplitude = decode_along_flow(sequence, 1, torch.tensor([[7.5, 2.5]]), None, None)
    assert amplitude.item() == pytest.approx(0.8 / distance[2, 7] ** 2, rel=1e-4)
    start = from_phase(sequence, EVERY_PIXEL).field
    got = start.reflectivity_sh[:, 0].numpy() * 0.28209479 + 0.5
    np.testing.assert_allclose(got, 0.8, rtol=1e-4)


def test_mistake_15_a_pixel_of_unknown_flow_is_read_and_left_out(tmp_path):
    """NaN in a flow file stays NaN on its way to the loss, where it is masked,
    also after the images are reduced.
    """
    flow = np.ones((2, 12, 20), np.float32)
    flow[0, 3, 4] = np.nan
    folder = write("ftorf", tmp_path / "seq", wall(ramp(12, 20), forward_flow={0: flow}))
    sequence = Sequence.open(folder)
    assert np.isnan(sequence.flow.forward[0]).sum() == 1
    prepared = observe(sequence, replace(presets.demo(), width_max=10), "cpu")
    unknown = prepared.flow[0][0].isnan().any(dim=0)
    assert unknown.sum() == 1
    assert unknown[1, 2]
    field = from_phase(sequence, EVERY_PIXEL).field
    assert all(value.isfinite().all() for value in field.parameters().values())


@pytest.mark.parametrize("frame", [2, 6])
def test_mistake_15_a_quad_that_is_no_number_is_an_error_and_never_a_scale(tmp_path, frame):
    """A plain maximum over the sequence would be NaN, or zero after a comparison;
    frames not taken do not count.
    """
    sequence = wall(ramp(6, 8))
    scale, _ = decode.quad_scale(sequence)
    broken = sequence.quads.copy()
    broken[frame, 3, 4] = np.nan
    with pytest.raises(InputError):
        observe(replace(sequence, quads=broken), WITHOUT_FLOW, "cpu")
    folder = write("ftorf", tmp_path / "seq", sequence)
    np.save(folder / f"tofType2/{frame:04d}.npy", broken[frame])
    with pytest.raises(InputError, match="nan"):
        Sequence.open(folder)
    taken = np.ones(8, dtype=bool)
    taken[frame] = False
    partly = replace(sequence, quads=broken, measured=taken)
    got, _ = decode.quad_scale(partly)
    assert got == pytest.approx(scale, rel=1e-6)
    prepared = observe(partly, WITHOUT_FLOW, "cpu")
    assert prepared.quad_scale == pytest.approx(scale, rel=1e-6)
    assert prepared.quads[taken].isfinite().all()


def test_mistake_16_the_factor_of_the_file_is_used_once_and_nothing_overrides_it(tmp_path):
    """Quads as read keep the units of the file; the optimisation multiplies by the stated factor,
    or by 1 / maximum.
    """
    plain = wall(ramp(6, 8))
    stated = Sequence.open(write("ftorf", tmp_path / "seq", changed(plain, quad_scale=5.0)))
    np.testing.assert_array_equal(stated.quads, plain.quads)
    for sequence, factor in ((stated, 5.0), (plain, 1.0 / decode.largest_amplitude(plain))):
        prepared = observe(sequence, WITHOUT_FLOW, "cpu")
        assert prepared.quad_scale == pytest.approx(factor, rel=1e-6)
        np.testing.assert_allclose(prepared.quads.numpy(), sequence.quads * factor, rtol=1e-5)
    assert [
        name for name, preset in presets.PRESETS.items() if preset().quad_scale is not None
    ] == []
    asked = observe(stated, replace(WITHOUT_FLOW, quad_scale=2.0), "cpu")
    assert (asked.quad_scale, asked.quad_scale_source) == (2.0, "setting")


@pytest.mark.parametrize("constant", [0.0, 1.0])
def test_mistake_17_the_constant_part_is_tested_when_a_recording_is_checked(tmp_path, constant):
    """Quads with b = 1 fitted with b = 0: the estimate says so,
    and stating it silences the warning.
    """
    sequence = wall(ramp(12, 20), dc_offset=constant)
    assert constant_part(sequence).dc_offset == pytest.approx(constant, abs=1e-3)
    for stated in (0.0, 1.0):
        folder = write("ftorf", tmp_path / f"says-{stated}", changed(sequence, dc_offset=stated))
        warned = any("dc_offset" in text for text in check(folder).warnings)
        assert warned == (stated != constant)
        assert sensor_of(Sequence.open(folder)).dc_offset == stated


@pytest.mark.parametrize("offset", [-7.0, -0.6, 0.6])
def test_mistake_18_closed_form_and_start_take_the_modulo(offset):
    """A negative phase offset must not put anything beyond c/2f."""
    distance = np.linspace(0.3, 7.3, 12 * 20).reshape(12, 20)
    sequence = wall(distance, phase_offset=offset)
    decoded = decode.closed_form_distance(sequence, 0)
    assert ((decoded >= 0) & (decoded < DEPTH_RANGE / 2)).all()
    np.testing.assert_allclose(decoded, distance, rtol=1e-4)
    start = from_phase(sequence, EVERY_PIXEL).field
    np.testing.assert_allclose(start.mean.norm(dim=1).numpy(), distance.ravel(), rtol=1e-3)


def test_mistake_20_colour_keeps_its_digits(tmp_path):
    """Values between two steps of 8 bits, above white and below black are read as they were
    written.
    """
    colour = np.linspace(-0.3, 3.0, 6 * 8 * 3, dtype=np.float32).reshape(6, 8, 3)
    colour[0, 0] = [0.5, 0.5 + 1e-6, 200.0]
    sequence = Sequence.open(write("ftorf", tmp_path / "seq", wall(ramp(6, 8), colour={0: colour})))
    assert sequence.colour.images[0].dtype == np.float32
    np.testing.assert_array_equal(sequence.colour.images[0], colour)


def test_mistake_21_colour_of_another_size_resizes_nothing_else(tmp_path):
    """Quads keep their size and the ToF camera its intrinsics, whatever the colour camera has."""
    sequence = wall(
        ramp(6, 8), colour={0: np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)}
    )
    got = Sequence.open(write("ftorf", tmp_path / "seq", sequence))
    assert got.quads.shape == (8, 6, 8)
    assert got.colour.images[0].shape == (12, 16, 3)
    assert got.intrinsics == sequence.intrinsics


def test_mistake_21_reducing_images_reduces_their_intrinsics():
    """A Gaussian is seen in the same place of the view at every size,
    by observation and by camera.
    """
    sequence = changed(wall(ramp(24, 40)), cx=17.0, cy=14.0, fx=33.0, fy=36.0)
    full, half = camera_of(sequence, 0), camera_of(reduced(sequence, 20), 0)
    assert (half.width, half.height) == (20, 12)
    for camera in (half, full.resized(20, 12)):
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (16.5, 18.0, 8.5, 7.0)
    point = dots([[0.6, -0.3, 2.0]], scale=0.05)
    large, small = (
        rasterize(point, camera, sensor_of(sequence)).opacity for camera in (full, half)
    )
    for axis, size in ((0, 24), (1, 40)):
        share = [
            float(
                (o.sum(1 - axis) * (torch.arange(o.shape[axis]) + 0.5)).sum()
                / o.sum()
                / o.shape[axis]
            )
            for o in (large, small)
        ]
        assert share[0] == pytest.approx(share[1], abs=0.25 / size)


def test_mistake_21_a_truncated_quartet_is_recognised(tmp_path):
    """Fourteen frames: three quartets to decode, all frames to compare,
    and a key after the last one.
    """
    folder = write("ftorf", tmp_path / "seq", wall(ramp(12, 20), frames=14))
    sequence = Sequence.open(folder)
    assert sequence.complete_quartets == [0, 1, 2]
    assert any("truncated after 2" in text for text in check(folder).warnings)
    prepared = observe(sequence, WITHOUT_FLOW, "cpu")
    assert sorted(n for batch in prepared.batches for n in batch) == list(range(14))
    assert key_times(sequence).tolist() == pytest.approx([0, 4 / 120, 8 / 120, 12 / 120, 16 / 120])
    with pytest.raises(ValueError, match="complete"):
        decode.quartet_phasor(sequence, 3)
