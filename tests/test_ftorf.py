"""The F-TöRF folder: what is read from where."""

import json
import shutil

import numpy as np
import pytest
from ftorf_folder import (
    REAL_ORDER,
    SAMPLE,
    assert_same,
    assert_same_bits,
    fingerprint,
    random_poses,
    scene,
)
from sequences import NAMES

from gftorf_warp import Sequence
from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data.sequence import Calibration, Intrinsics
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError

PLUS_COS, MINUS_COS, PLUS_SIN, MINUS_SIN = CANONICAL_SHIFTS


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A complete folder in the order of the real recordings."""
    return write("ftorf", tmp_path_factory.mktemp("original") / "seq", *scene())


@pytest.fixture
def folder(original, tmp_path):
    """A copy of it to change."""
    return shutil.copytree(original, tmp_path / "seq")


def test_the_sample_is_read_as_it_is_described():
    """Sizes, calibration and flow of the sample, with half-integer pixel centres because cx is
    half the width.
    """
    sequence = Sequence.open(SAMPLE)
    assert (sequence.frames, sequence.height, sequence.width) == (32, 120, 160)
    assert sequence.measured.all()
    assert sequence.calibration.f_mod_hz == SPEED_OF_LIGHT / 15.0
    assert sequence.intrinsics == Intrinsics(fx=136.0, fy=136.0, cx=80.0, cy=60.0)
    assert sequence.sources["pixel_centre"] == "inferred from cx = 80 at width 160: half"
    assert sequence.calibration == Calibration(f_mod_hz=SPEED_OF_LIGHT / 15.0)
    assert sequence.sources["dc_offset"].startswith("default")
    assert sequence.sources["times"] == "default 120 Hz"
    assert sequence.sources["f_mod_hz"].startswith("file cams/depth_range.npy")
    np.testing.assert_allclose(np.diff(sequence.times), 1 / 120)
    np.testing.assert_array_equal(sequence.shifts[:4], [PLUS_COS, MINUS_COS, PLUS_SIN, MINUS_SIN])
    assert list(sequence.flow.forward) == list(range(0, 28, 4))
    assert list(sequence.flow.backward) == list(range(4, 32, 4))
    assert sequence.colour.images[0].shape == (120, 160, 3)
    np.testing.assert_array_equal(sequence.quads[6], np.load(SAMPLE / "tofType2/0006.npy"))
    assert sequence.truth().known.all()


def test_reading_twice_changes_nothing_on_disk(folder):
    """A reader never writes."""
    before = fingerprint(folder)
    assert_same(Sequence.open(folder), Sequence.open(folder))
    assert Sequence.open(folder).truth() is not None
    assert fingerprint(folder) == before


def test_without_calibration_the_defaults_are_used_and_named(tmp_path):
    """Absent scalars: offset 0, no gain, 15 m, 120 Hz, default order, identity poses,
    each said to be a default.
    """
    folder = write(
        "ftorf", tmp_path / "seq", *scene(phase_offset=0.0, dc_offset=0.0, permutation=(0, 1, 2, 3))
    )
    for name in (
        "depth_range",
        "phase_offset",
        "dc_offset",
        "frame_times",
        "tof_extrinsics",
        "color_intrinsics",
    ):
        (folder / f"cams/{name}.npy").unlink()
    (folder / "cams/poses.json").unlink()
    (folder / "tof_permutation.npy").unlink()
    got = Sequence.open(folder)
    assert_same(got, scene(phase_offset=0.0, dc_offset=0.0, permutation=(0, 1, 2, 3))[0])
    for name in (
        "f_mod_hz",
        "phase_offset",
        "dc_offset",
        "times",
        "camera_from_world",
        "shifts",
        "quad_scale",
    ):
        assert got.sources[name].startswith("default"), name


def test_every_field_of_a_sequence_names_its_source(folder):
    """Whatever the reader fills, it says where it is from, in one of four words."""
    got = Sequence.open(folder)
    assert set(got.sources) >= NAMES
    assert all(
        text.split()[0] in {"file", "default", "inferred", "setting"}
        for text in got.sources.values()
    )


@pytest.mark.parametrize(
    ("permutation", "order"),
    [
        (REAL_ORDER, [MINUS_COS, PLUS_SIN, PLUS_COS, MINUS_SIN]),
        # sine first, as the literature prints it
        ((1, 3, 0, 2), [PLUS_SIN, PLUS_COS, MINUS_SIN, MINUS_COS]),
    ],
)
def test_permutation_is_canonical_from_raw(tmp_path, permutation, order):
    """The file means canonical = raw[permutation]: the order of the real recordings and of the
    paper, spelled out.
    """
    sequence, _ = scene(permutation=(0, 1, 2, 3))
    folder = write("ftorf", tmp_path / "seq", sequence)
    np.save(folder / "tof_permutation.npy", np.array(permutation))
    got = Sequence.open(folder)
    np.testing.assert_array_equal(got.shifts, [*order, *order])
    assert list(permutation) == json.loads(got.sources["shifts"].partition(": ")[2])


def test_missing_frames_are_not_measured_and_dark(folder):
    """Any frame may be absent, the last one too, as long as the times know of it."""
    for n in (2, 7):
        (folder / f"tofType{n % 4}/{n:04d}.npy").unlink()
    got = Sequence.open(folder)
    assert got.frames == 8
    assert np.flatnonzero(~got.measured).tolist() == [2, 7]
    assert not got.quads[[2, 7]].any()
    assert got.complete_quartets == []
    assert got.sources["measured"] == "file 6 of 8 raw frames"
    (folder / "cams/frame_times.npy").unlink()
    (folder / "cams/poses.json").unlink()
    assert Sequence.open(folder).frames == 7


def test_warped_copies_are_no_measurements(folder):
    """Files of slot k at an id of another slot are ignored and counted, whatever they hold."""
    (folder / "tofType1/0004.npy").write_bytes(b"not even an array")
    shutil.copy(folder / "tofType0/0000.npy", folder / "tofType3/0000.npy")
    got = Sequence.open(folder)
    assert_same(got, scene()[0])
    assert "2 files of another slot" in got.sources["measured"]


def test_names_that_are_no_raw_frames_are_left_alone(folder):
    """Hidden files of file managers, notes and wrong endings are no frames."""
    for name in ("._0000.npy", "readme.txt", "0000.npy.bak", "00001.npy", "1.npy"):
        (folder / "tofType0" / name).write_bytes(b"?")
    assert_same(Sequence.open(folder), scene()[0])


def test_colour_of_three_equal_channels_is_called_amplitude(tmp_path):
    """Real static recordings store ToF amplitude as colour."""
    grey = np.repeat(np.arange(48.0).reshape(6, 8, 1), 3, axis=2)
    grey_folder = write("ftorf", tmp_path / "grey", scene(colour={0: grey})[0])
    assert "amplitude, not colour" in Sequence.open(grey_folder).sources["colour"]
    grey[0, 0, 1] = 7.0
    folder = write("ftorf", tmp_path / "colour", scene(colour={0: grey})[0])
    assert "amplitude" not in Sequence.open(folder).sources["colour"]


def test_flow_of_the_second_folder_counts_only_if_the_first_is_empty(folder):
    """forward_flow_2 before forward_flow; NaN stays NaN;
    frames behind the end are dropped and said to be.
    """
    flow = np.full((2, 6, 8), 2.0, np.float32)
    flow[0, 1, 2] = np.nan
    (folder / "forward_flow").mkdir()
    np.save(folder / "forward_flow/flow_0000.npy", flow)
    assert_same_bits(Sequence.open(folder).flow.forward[0], flow, "flow")
    (folder / "forward_flow_2").mkdir()
    for n in (4, 8):
        np.save(folder / f"forward_flow_2/flow_{n:04d}.npy", flow + 1)
    got = Sequence.open(folder)
    assert list(got.flow.forward) == [4]
    assert got.flow.forward[4][1, 0, 0] == 3.0
    assert got.sources["forward_flow"] == "file forward_flow_2, 1 images; 1 of other frames ignored"


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f4", "<f8", "<i2", "<u2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_any_real_type_and_memory_order_is_read(tmp_path, dtype, order):
    """Everything becomes float32; the source says so where that loses digits."""
    quads = np.arange(4 * 6 * 8).reshape(4, 6, 8) + (0.1 if dtype == "<f8" else 0.0)
    folder = write("ftorf", tmp_path / "seq", scene(frames=4)[0])
    for n in range(4):
        np.save(folder / f"tofType{n}/{n:04d}.npy", np.asarray(quads[n], dtype=dtype, order=order))
    got = Sequence.open(folder)
    assert_same_bits(got.quads, quads.astype(np.float32), "quads")
    assert got.sources["quads"].endswith("float64 rounded to float32") == (dtype == "<f8")


@pytest.mark.parametrize(
    ("centre", "cx", "added"),
    [
        ("integer", 4.0, 0.5),
        ("half", 4.0, 0.0),
        (None, 4.0, 0.0),
        (None, 3.5, 0.5),
        (None, 3.9, 0.5),
    ],
)
def test_pixel_centres_follow_the_file_then_cx(folder, centre, cx, added):
    """The width is 8: without a file, cx = 4 means half-integer centres and is kept,
    anything else gets 0.5.
    """
    np.save(folder / "cams/tof_intrinsics.npy", np.array([[9.0, 0, cx], [0, 9.0, 2.5], [0, 0, 1]]))
    (folder / "cams/pixel_centre.json").unlink()
    if centre:
        (folder / "cams/pixel_centre.json").write_text(json.dumps({"pixel_centre": centre}))
    got = Sequence.open(folder)
    assert (got.intrinsics.cx, got.intrinsics.cy) == (cx + added, 2.5 + added)
    assert got.sources["pixel_centre"].startswith(
        "file cams/pixel_centre.json" if centre else "inferred from cx"
    )


def test_matlab_calibration_is_read_like_numpy(folder):
    """4x4 or 3x3 K, and scalars that MATLAB stores as 1x1."""
    import scipy.io

    matrix = np.eye(4)
    matrix[:2, :3] = [[9.0, 0, 4.0], [0, 8.0, 3.0]]
    (folder / "cams/tof_intrinsics.npy").unlink()
    scipy.io.savemat(folder / "cams/tof_intrinsics.mat", {"K": matrix, "other": 1})
    for name, key, value in (("phase_offset", "P", 0.25), ("depth_range", "depth_range", 10)):
        (folder / f"cams/{name}.npy").unlink()
        scipy.io.savemat(folder / f"cams/{name}.mat", {key: value}, do_compression=True)
    got = Sequence.open(folder)
    assert (got.intrinsics.fx, got.intrinsics.fy, got.intrinsics.cx, got.intrinsics.cy) == (
        9.0,
        8.0,
        4.5,
        3.5,
    )
    assert (got.calibration.phase_offset, got.calibration.f_mod_hz) == (0.25, SPEED_OF_LIGHT / 10)
    assert got.sources["phase_offset"] == "file cams/phase_offset.mat"


def test_frame_rate_is_the_file_s_unless_one_is_given(folder):
    """Times come from the file; an explicit rate overrides them and is named a setting."""
    times = np.repeat([0.0, 0.1], 4)
    np.save(folder / "cams/frame_times.npy", times)
    np.testing.assert_array_equal(Sequence.open(folder).times, times)
    got = Sequence.open(folder, frame_rate_hz=60.0)
    np.testing.assert_allclose(got.times, np.arange(8) / 60)
    assert got.sources["times"] == "setting 60 Hz"
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(UsageError):
            Sequence.open(folder, frame_rate_hz=bad)


def test_poses_count_only_where_the_folder_says_so(folder):
    """F-TöRF cameras stand still: stored poses are ignored, and that is reported,
    unless cams/poses.json is there.
    """
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.arange(8)
    np.save(folder / "cams/tof_extrinsics.npy", poses)
    np.testing.assert_array_equal(Sequence.open(folder).camera_from_world, poses)
    (folder / "cams/poses.json").unlink()
    got = Sequence.open(folder)
    np.testing.assert_array_equal(got.camera_from_world, np.tile(np.eye(4), (8, 1, 1)))
    assert got.sources["camera_from_world"].startswith("default identity")
    assert "other poses" in got.sources["camera_from_world"]


def colour_at(height, width):
    """One random colour image."""
    return {0: np.random.default_rng(0).random((height, width, 3)).astype(np.float32)}


def test_the_colour_camera_is_that_of_the_files(folder):
    """Intrinsics in the pixel centres of the folder; poses only where the folder says that poses
    count.
    """
    (folder / "color").mkdir()
    np.save(folder / "color/0000.npy", colour_at(12, 16)[0])
    np.save(
        folder / "cams/color_intrinsics.npy", np.array([[20.0, 0, 7.0], [0, 21.0, 5.0], [0, 0, 1]])
    )
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = 0.05
    np.save(folder / "cams/color_extrinsics.npy", poses)
    got = Sequence.open(folder)
    assert got.colour.intrinsics == Intrinsics(fx=20.0, fy=21.0, cx=7.5, cy=5.5)
    np.testing.assert_array_equal(got.colour.camera_from_world, poses)
    (folder / "cams/pixel_centre.json").write_text('{"pixel_centre": "half"}')
    assert Sequence.open(folder).colour.intrinsics == Intrinsics(fx=20.0, fy=21.0, cx=7.0, cy=5.0)
    (folder / "cams/poses.json").unlink()
    np.testing.assert_array_equal(
        Sequence.open(folder).colour.camera_from_world, np.tile(np.eye(4), (8, 1, 1))
    )


def test_without_its_files_the_colour_camera_is_the_tof_camera(folder):
    """Intrinsics scaled to the colour image and flagged, poses those of the ToF camera;
    none without colour.
    """
    assert (
        Sequence.open(folder).colour.intrinsics,
        Sequence.open(folder).colour.camera_from_world,
    ) == (None, None)
    (folder / "color").mkdir()
    np.save(folder / "color/0000.npy", colour_at(12, 24)[0])
    for name in ("color_intrinsics", "color_extrinsics"):
        (folder / f"cams/{name}.npy").unlink()
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 1, 3] = np.arange(8)
    np.save(folder / "cams/tof_extrinsics.npy", poses)
    got = Sequence.open(folder)
    assert got.colour.intrinsics == got.intrinsics.scaled(3, 2)
    assert got.sources["colour_intrinsics"].startswith("inferred")
    np.testing.assert_array_equal(got.colour.camera_from_world, poses)


@pytest.mark.parametrize("shape", [(3, 4), (4, 4), (3, 5), (4, 5)])
def test_novel_views_are_read_in_every_shape(folder, shape):
    """Rows and columns beyond the rotation and the translation are left out or made up."""
    want = random_poses(5, np.random.default_rng(1))
    np.save(
        folder / "test_poses.npy",
        np.concatenate([want, np.full((5, 4, 1), 7.0)], axis=2)[:, : shape[0], : shape[1]],
    )
    np.testing.assert_array_equal(Sequence.open(folder).novel_from_world, want)


def test_truth_masks_what_nobody_knows(folder):
    """Frames without a file are unknown, and so are pixels of NaN or 0;
    frames after the sequence are not read.
    """
    image = np.full((6, 8), 2.0, np.float32)
    image[0, 0], image[1, 1] = np.nan, 0.0
    np.save(folder / "synthetic_depth/0001.npy", image)
    (folder / "synthetic_depth/0002.npy").unlink()
    (folder / "synthetic_depth/0009.npy").write_bytes(b"later")
    truth = Sequence.open(folder).truth()
    assert np.flatnonzero(~truth.known).tolist() == [2]
    assert np.isnan(truth.distance[2]).all()
    assert np.argwhere(np.isnan(truth.distance[1])).tolist() == [[0, 0], [1, 1]]
    assert truth.distance.dtype == np.float32
    shutil.rmtree(folder / "synthetic_depth")
    assert Sequence.open(folder).truth() is None
    assert scene()[0].truth() is None


def test_reading_never_opens_truth_phasors_or_masks(folder):
    """Without them, or with rubbish in them, the sequence is the same."""
    want = Sequence.open(folder)
    for name in ("synthetic_depth", "synthetic_tof", "tof", "occ_mask", "mask_tof"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "0000.npy").write_bytes(b"rubbish")
    assert_same(Sequence.open(folder), want)
    shutil.rmtree(folder / "synthetic_depth")
    assert_same(Sequence.open(folder), want)
