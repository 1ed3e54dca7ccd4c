"""The F-TöRF folder: what is read from where, and that writing is the inverse of reading."""

import dataclasses
import json
import shutil
import tomllib
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from ftorf_folder import REAL_ORDER, SAMPLE, assert_same, assert_same_bits, fingerprint, random_poses, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data import ftorf, specs
from gftorf_warp.data.sequence import Sequence, Truth
from gftorf_warp.errors import UsageError

ROOT = Path(__file__).parents[1]
PLUS_COS, MINUS_COS, PLUS_SIN, MINUS_SIN = CANONICAL_SHIFTS


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A complete folder in the order of the real recordings."""
    return ftorf.write(tmp_path_factory.mktemp("original") / "seq", *scene())


@pytest.fixture
def folder(original, tmp_path):
    """A copy of it to change."""
    return shutil.copytree(original, tmp_path / "seq")


def test_the_sample_is_read_as_it_is_described():
    """Sizes, calibration and flow of the sample, with half-integer pixel centres because cx is half the width."""
    sequence = Sequence.open(SAMPLE)
    assert (sequence.frames, sequence.height, sequence.width) == (32, 120, 160)
    assert sequence.measured.all()
    assert sequence.f_mod_hz == SPEED_OF_LIGHT / 15.0
    assert (sequence.fx, sequence.fy, sequence.cx, sequence.cy) == (136.0, 136.0, 80.0, 60.0)
    assert sequence.sources["pixel_centre"] == "inferred from cx = 80 at width 160: half"
    assert (sequence.phase_offset, sequence.dc_offset, sequence.quad_scale) == (0.0, 0.0, None)
    assert sequence.sources["dc_offset"].startswith("default")
    assert sequence.sources["times"] == "default 120 Hz"
    assert sequence.sources["f_mod_hz"].startswith("file cams/depth_range.npy")
    np.testing.assert_allclose(np.diff(sequence.times), 1 / 120)
    np.testing.assert_array_equal(sequence.shifts[:4], [PLUS_COS, MINUS_COS, PLUS_SIN, MINUS_SIN])
    assert list(sequence.forward_flow) == list(range(0, 28, 4))
    assert list(sequence.backward_flow) == list(range(4, 32, 4))
    assert sequence.colour[0].shape == (120, 160, 3)
    np.testing.assert_array_equal(sequence.quads[6], np.load(SAMPLE / "tofType2/0006.npy"))
    assert sequence.truth().known.all()


def test_reading_twice_changes_nothing_on_disk(folder):
    """A reader never writes."""
    before = fingerprint(folder)
    assert_same(ftorf.read(folder), ftorf.read(folder))
    assert ftorf.read_truth(folder, frames=8) is not None
    assert fingerprint(folder) == before


def test_without_calibration_the_defaults_are_used_and_named(tmp_path):
    """Absent scalars: offset 0, no gain, 15 m, 120 Hz, default order, identity poses, each said to be a default."""
    folder = ftorf.write(tmp_path / "seq", *scene(phase_offset=0.0, dc_offset=0.0, permutation=(0, 1, 2, 3)))
    for name in ("depth_range", "phase_offset", "dc_offset", "frame_times", "tof_extrinsics", "color_intrinsics"):
        (folder / f"cams/{name}.npy").unlink()
    (folder / "cams/poses.json").unlink()
    (folder / "tof_permutation.npy").unlink()
    got = ftorf.read(folder)
    assert_same(got, scene(phase_offset=0.0, dc_offset=0.0, permutation=(0, 1, 2, 3))[0])
    for name in ("f_mod_hz", "phase_offset", "dc_offset", "times", "camera_from_world", "shifts", "quad_scale"):
        assert got.sources[name].startswith("default"), name


def test_every_field_of_a_sequence_names_its_source(folder):
    """Whatever the reader fills, it says where it is from, in one of four words."""
    got = ftorf.read(folder)
    names = {f.name for f in dataclasses.fields(Sequence)} - {"sources", "path"}
    assert names <= set(got.sources)
    assert all(text.split()[0] in {"file", "default", "inferred", "setting"} for text in got.sources.values())


@pytest.mark.parametrize(
    ("permutation", "order"),
    [
        (REAL_ORDER, [MINUS_COS, PLUS_SIN, PLUS_COS, MINUS_SIN]),
        ((1, 3, 0, 2), [PLUS_SIN, PLUS_COS, MINUS_SIN, MINUS_COS]),  # sine first, as the literature prints it
    ],
)
def test_permutation_is_canonical_from_raw(tmp_path, permutation, order):
    """The file means canonical = raw[permutation]: the order of the real recordings and of the paper, spelled out."""
    sequence, _ = scene(permutation=(0, 1, 2, 3))
    folder = ftorf.write(tmp_path / "seq", sequence)
    np.save(folder / "tof_permutation.npy", np.array(permutation))
    got = ftorf.read(folder)
    np.testing.assert_array_equal(got.shifts, [*order, *order])
    assert list(permutation) == json.loads(got.sources["shifts"].partition(": ")[2])


def test_missing_frames_are_not_measured_and_dark(folder):
    """Any frame may be absent, the last one too, as long as the times know of it."""
    for n in (2, 7):
        (folder / f"tofType{n % 4}/{n:04d}.npy").unlink()
    got = ftorf.read(folder)
    assert got.frames == 8
    assert np.flatnonzero(~got.measured).tolist() == [2, 7]
    assert not got.quads[[2, 7]].any()
    assert got.complete_quartets == []
    assert got.sources["measured"] == "file 6 of 8 raw frames"
    (folder / "cams/frame_times.npy").unlink()
    (folder / "cams/poses.json").unlink()
    assert ftorf.read(folder).frames == 7


def test_warped_copies_are_no_measurements(folder):
    """Files of slot k at an id of another slot are ignored and counted, whatever they hold."""
    (folder / "tofType1/0004.npy").write_bytes(b"not even an array")
    shutil.copy(folder / "tofType0/0000.npy", folder / "tofType3/0000.npy")
    got = ftorf.read(folder)
    assert_same(got, scene()[0])
    assert "2 files of another slot" in got.sources["measured"]


def test_names_that_are_no_raw_frames_are_left_alone(folder):
    """Hidden files of file managers, notes and wrong endings are no frames."""
    for name in ("._0000.npy", "readme.txt", "0000.npy.bak", "00001.npy", "1.npy"):
        (folder / "tofType0" / name).write_bytes(b"?")
    assert_same(ftorf.read(folder), scene()[0])


def test_colour_of_three_equal_channels_is_called_amplitude(tmp_path):
    """Real static recordings store ToF amplitude as colour."""
    grey = np.repeat(np.arange(48.0).reshape(6, 8, 1), 3, axis=2)
    grey_folder = ftorf.write(tmp_path / "grey", scene(colour={0: grey})[0])
    assert "amplitude, not colour" in ftorf.read(grey_folder).sources["colour"]
    grey[0, 0, 1] = 7.0
    folder = ftorf.write(tmp_path / "colour", scene(colour={0: grey})[0])
    assert "amplitude" not in ftorf.read(folder).sources["colour"]


def test_flow_of_the_second_folder_counts_only_if_the_first_is_empty(folder):
    """forward_flow_2 before forward_flow; NaN stays NaN; frames behind the end are dropped and said to be."""
    flow = np.full((2, 6, 8), 2.0, np.float32)
    flow[0, 1, 2] = np.nan
    (folder / "forward_flow").mkdir()
    np.save(folder / "forward_flow/flow_0000.npy", flow)
    assert_same_bits(ftorf.read(folder).forward_flow[0], flow, "flow")
    (folder / "forward_flow_2").mkdir()
    for n in (4, 8):
        np.save(folder / f"forward_flow_2/flow_{n:04d}.npy", flow + 1)
    got = ftorf.read(folder)
    assert list(got.forward_flow) == [4]
    assert got.forward_flow[4][1, 0, 0] == 3.0
    assert got.sources["forward_flow"] == "file forward_flow_2, 1 images; 1 of later frames ignored"


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f4", "<f8", "<i2", "<u2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_any_real_type_and_memory_order_is_read(tmp_path, dtype, order):
    """Everything becomes float32; the source says so where that loses digits."""
    quads = np.arange(4 * 6 * 8).reshape(4, 6, 8) + (0.1 if dtype == "<f8" else 0.0)
    folder = ftorf.write(tmp_path / "seq", scene(frames=4)[0])
    for n in range(4):
        np.save(folder / f"tofType{n}/{n:04d}.npy", np.asarray(quads[n], dtype=dtype, order=order))
    got = ftorf.read(folder)
    assert_same_bits(got.quads, quads.astype(np.float32), "quads")
    assert got.sources["quads"].endswith("float64 rounded to float32") == (dtype == "<f8")


@pytest.mark.parametrize(
    ("centre", "cx", "added"),
    [("integer", 4.0, 0.5), ("half", 4.0, 0.0), (None, 4.0, 0.0), (None, 3.5, 0.5), (None, 3.9, 0.5)],
)
def test_pixel_centres_follow_the_file_then_cx(folder, centre, cx, added):
    """The width is 8: without a file, cx = 4 means half-integer centres and is kept, anything else gets 0.5."""
    np.save(folder / "cams/tof_intrinsics.npy", np.array([[9.0, 0, cx], [0, 9.0, 2.5], [0, 0, 1]]))
    (folder / "cams/pixel_centre.json").unlink()
    if centre:
        (folder / "cams/pixel_centre.json").write_text(json.dumps({"pixel_centre": centre}))
    got = ftorf.read(folder)
    assert (got.cx, got.cy) == (cx + added, 2.5 + added)
    assert got.sources["pixel_centre"].startswith("file cams/pixel_centre.json" if centre else "inferred from cx")


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
    got = ftorf.read(folder)
    assert (got.fx, got.fy, got.cx, got.cy) == (9.0, 8.0, 4.5, 3.5)
    assert (got.phase_offset, got.f_mod_hz) == (0.25, SPEED_OF_LIGHT / 10)
    assert got.sources["phase_offset"] == "file cams/phase_offset.mat"


def test_frame_rate_is_the_file_s_unless_one_is_given(folder):
    """Times come from the file; an explicit rate overrides them and is named a setting."""
    times = np.repeat([0.0, 0.1], 4)
    np.save(folder / "cams/frame_times.npy", times)
    np.testing.assert_array_equal(ftorf.read(folder).times, times)
    got = Sequence.open(folder, frame_rate_hz=60.0)
    np.testing.assert_allclose(got.times, np.arange(8) / 60)
    assert got.sources["times"] == "setting 60 Hz"
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(UsageError):
            ftorf.read(folder, frame_rate_hz=bad)


def test_poses_count_only_where_the_folder_says_so(folder):
    """F-TöRF cameras stand still: stored poses are ignored, and that is reported, unless cams/poses.json is there."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.arange(8)
    np.save(folder / "cams/tof_extrinsics.npy", poses)
    np.testing.assert_array_equal(ftorf.read(folder).camera_from_world, poses)
    (folder / "cams/poses.json").unlink()
    got = ftorf.read(folder)
    np.testing.assert_array_equal(got.camera_from_world, np.tile(np.eye(4), (8, 1, 1)))
    assert got.sources["camera_from_world"].startswith("default identity")
    assert "other poses" in got.sources["camera_from_world"]


def colour_at(height, width):
    """One random colour image."""
    return {0: np.random.default_rng(0).random((height, width, 3)).astype(np.float32)}


def test_the_colour_camera_is_that_of_the_files(folder):
    """Intrinsics in the pixel centres of the folder; poses only where the folder says that poses count."""
    (folder / "color").mkdir()
    np.save(folder / "color/0000.npy", colour_at(12, 16)[0])
    np.save(folder / "cams/color_intrinsics.npy", np.array([[20.0, 0, 7.0], [0, 21.0, 5.0], [0, 0, 1]]))
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = 0.05
    np.save(folder / "cams/color_extrinsics.npy", poses)
    got = ftorf.read(folder)
    assert got.colour_intrinsics == (20.0, 21.0, 7.5, 5.5)
    np.testing.assert_array_equal(got.colour_from_world, poses)
    (folder / "cams/pixel_centre.json").write_text('{"pixel_centre": "half"}')
    assert ftorf.read(folder).colour_intrinsics == (20.0, 21.0, 7.0, 5.0)
    (folder / "cams/poses.json").unlink()
    np.testing.assert_array_equal(ftorf.read(folder).colour_from_world, np.tile(np.eye(4), (8, 1, 1)))


def test_without_its_files_the_colour_camera_is_the_tof_camera(folder):
    """Intrinsics scaled to the colour image and flagged, poses those of the ToF camera; none without colour."""
    assert (ftorf.read(folder).colour_intrinsics, ftorf.read(folder).colour_from_world) == (None, None)
    (folder / "color").mkdir()
    np.save(folder / "color/0000.npy", colour_at(12, 24)[0])
    for name in ("color_intrinsics", "color_extrinsics"):
        (folder / f"cams/{name}.npy").unlink()
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 1, 3] = np.arange(8)
    np.save(folder / "cams/tof_extrinsics.npy", poses)
    got = ftorf.read(folder)
    assert got.colour_intrinsics == (3 * got.fx, 2 * got.fy, 3 * got.cx, 2 * got.cy)
    assert got.sources["colour_intrinsics"].startswith("inferred")
    np.testing.assert_array_equal(got.colour_from_world, poses)


@pytest.mark.parametrize("shape", [(3, 4), (4, 4), (3, 5), (4, 5)])
def test_novel_views_are_read_in_every_shape(folder, shape):
    """Rows and columns beyond the rotation and the translation are left out or made up."""
    want = random_poses(5, np.random.default_rng(1))
    np.save(
        folder / "test_poses.npy", np.concatenate([want, np.full((5, 4, 1), 7.0)], axis=2)[:, : shape[0], : shape[1]]
    )
    np.testing.assert_array_equal(ftorf.read(folder).novel_from_world, want)


def test_truth_masks_what_nobody_knows(folder):
    """Frames without a file are unknown, and so are pixels of NaN or 0; frames after the sequence are not read."""
    image = np.full((6, 8), 2.0, np.float32)
    image[0, 0], image[1, 1] = np.nan, 0.0
    np.save(folder / "synthetic_depth/0001.npy", image)
    (folder / "synthetic_depth/0002.npy").unlink()
    (folder / "synthetic_depth/0009.npy").write_bytes(b"later")
    truth = ftorf.read_truth(folder, frames=8)
    assert np.flatnonzero(~truth.known).tolist() == [2]
    assert np.isnan(truth.distance[2]).all()
    assert np.argwhere(np.isnan(truth.distance[1])).tolist() == [[0, 0], [1, 1]]
    assert truth.distance.dtype == np.float32
    shutil.rmtree(folder / "synthetic_depth")
    assert ftorf.read_truth(folder, frames=8) is None
    assert scene()[0].truth() is None


def test_reading_never_opens_truth_phasors_or_masks(folder):
    """Without them, or with rubbish in them, the sequence is the same."""
    want = ftorf.read(folder)
    for name in ("synthetic_depth", "synthetic_tof", "tof", "occ_mask", "mask_tof"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "0000.npy").write_bytes(b"rubbish")
    assert_same(ftorf.read(folder), want)
    shutil.rmtree(folder / "synthetic_depth")
    assert_same(ftorf.read(folder), want)


@st.composite
def sequences(draw):
    """Sequences in which nothing is trivial, with truth."""
    frames, height, width = draw(st.integers(1, 11)), draw(st.integers(1, 4)), draw(st.integers(1, 5))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    permutation = draw(st.permutations(range(4)))
    measured = np.array(draw(st.lists(st.booleans(), min_size=frames, max_size=frames)))
    measured[draw(st.integers(0, frames - 1))] = True
    quads = (generator.normal(size=(frames, height, width)) * 10.0 ** draw(st.integers(-30, 30))).astype(np.float32)
    quads[~measured] = 0.0
    poses = random_poses(frames, generator)
    steps = generator.random(frames - 1) * (generator.random(frames - 1) < 0.5)

    def images(*shape, unknown):
        """Images of some raw frames."""
        result = {}
        for n in draw(st.lists(st.integers(0, frames - 1), unique=True)):
            image = generator.normal(size=shape).astype(np.float32)
            result[n] = np.where(generator.random(shape) < 0.2, np.float32(np.nan), image) if unknown else image
        return dict(sorted(result.items()))

    colour = images(draw(st.integers(1, 3)), draw(st.integers(1, 3)), 3, unknown=False)
    sequence = Sequence(
        quads=quads,
        measured=measured,
        shifts=np.array(CANONICAL_SHIFTS)[np.argsort(permutation)[np.arange(frames) % 4]],
        times=np.concatenate([[0.0], np.cumsum(steps)]),
        f_mod_hz=SPEED_OF_LIGHT / draw(st.floats(0.1, 1000.0)),
        phase_offset=draw(st.floats(-10, 10)),
        dc_offset=draw(st.floats(-2, 2)),
        fx=draw(st.floats(0.05 * width, 50.0)),
        fy=draw(st.floats(0.05 * width, 50.0)),
        cx=draw(st.integers(0, 64)) / 8 + 0.25,
        cy=draw(st.integers(-64, 64)) / 8,
        camera_from_world=poses,
        quad_scale=draw(st.none() | st.floats(1e-3, 1e3)),
        colour=colour,
        colour_intrinsics=(draw(st.floats(0.5, 50.0)), 3.0, 1.25, -0.5) if colour else None,
        colour_from_world=random_poses(frames, generator) if colour else None,
        novel_from_world=random_poses(3, generator) if draw(st.booleans()) else None,
        forward_flow=images(2, height, width, unknown=True),
        backward_flow=images(2, height, width, unknown=True),
    )
    known = generator.random(frames) < 0.7
    distance = generator.uniform(0.1, 9.0, size=(frames, height, width)).astype(np.float32)
    distance[generator.random(distance.shape) < 0.1] = np.nan
    distance[~known] = np.nan
    return sequence, Truth(distance=distance, known=known)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(sequences())
def test_write_then_read_is_the_identity(tmp_path_factory, drawn):
    """Images bit by bit in float32, calibration in float64, whatever is missing; and a second round too."""
    sequence, truth = drawn
    with mock.patch("os.fsync"):  # waiting for the disk, thousands of times, shows nothing here
        first = ftorf.write(tmp_path_factory.mktemp("round") / "first", sequence, truth, readme="# a card\n")
        got = ftorf.read(first)
        again = ftorf.write(first.parent / "second", got, got.truth())
    assert_same(got, sequence)
    assert_same(ftorf.read(again), sequence)
    got_truth = ftorf.read_truth(again, frames=sequence.frames)
    if truth.known.any():
        assert_same_bits(got_truth.distance, truth.distance, "distance")
        assert_same_bits(got_truth.known, truth.known, "known")
    else:
        assert got_truth is None
    assert (first / "README.md").read_text() == "# a card\n"


def test_the_sample_survives_a_round(tmp_path):
    """Read, write, read: every bit of the sample, though the writer stores other pixel centres and states them."""
    want = ftorf.read(SAMPLE)
    folder = ftorf.write(tmp_path / "seq", want, want.truth())
    got = ftorf.read(folder)
    assert_same(got, want)
    assert_same_bits(got.truth().distance, want.truth().distance, "distance")
    assert np.load(folder / "cams/tof_intrinsics.npy")[:2, 2].tolist() == [79.5, 59.5]
    assert json.loads((folder / "cams/pixel_centre.json").read_text()) == {"pixel_centre": "integer"}
    assert np.load(folder / "color/0000.npy").dtype == np.float16


def test_everything_written_is_described(folder):
    """No file of the writer lacks an entry in data_specs/, and its type is one that the entry allows."""
    described = {
        pattern.replace("{slot}", str(slot)): field
        for field in specs.fields("ftorf").values()
        for pattern in field.paths
        for slot in range(4)
    }
    for path in folder.rglob("*.*"):
        name = str(path.relative_to(folder))
        pattern = name if name in described else name.replace(path.stem[-4:], "{id}")
        field = described[pattern]
        assert field.written != "never", name
        if field.kind == "array":
            assert np.load(path).dtype.kind in field.dtypes, name


def test_descriptions_cover_the_sequence_and_the_truth():
    """Every field of Sequence and Truth is filled from a described one, and no description fills anything else."""
    filled = {name for field in specs.fields("ftorf").values() for name in field.fills}
    names = {f.name for kind in (Sequence, Truth) for f in dataclasses.fields(kind)}
    assert filled == names - {"sources", "path"}
    for field in specs.fields("ftorf").values():
        assert field.kind in {"array", "choice", "other"}, field.name
        assert field.role in {"measurement", "calibration", "truth", "check", "unused"}, field.name
        assert field.nan in {"error", "unknown"}, field.name
        assert field.meaning, field.name
        assert field.unit, field.name


def test_the_page_beside_the_descriptions_names_every_field():
    """data_specs/README.md mentions every path, and the wheel carries the description where the reader looks."""
    page = (ROOT / "data_specs" / "README.md").read_text(encoding="utf-8")
    for field in specs.fields("ftorf").values():
        assert all(f"`{path}`" in page for path in field.paths), field.name
    included = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    names = [path.name for path in (ROOT / "data_specs").glob("*.toml")]
    assert included["force-include"] == {f"data_specs/{name}": f"gftorf_warp/data/specs/{name}" for name in names}
    assert (specs.INSTALLED / "ftorf.toml").parts[-4:] == ("gftorf_warp", "data", "specs", "ftorf.toml")


def poses_with(**changes):
    """Poses of eight frames of which one is changed."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[3, changes["row"], changes["column"]] = changes["value"]
    return poses


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"shifts": np.arange(8) * np.pi / 4}, "shifts"),
        ({"shifts": np.tile([0.0, np.pi, 0.0, np.pi], 2)}, "shifts"),
        ({"shifts": np.array([0, 1, 2, 3, 1, 0, 2, 3]) * np.pi / 2}, "shifts"),
        ({"measured": np.zeros(8, dtype=bool)}, "empty"),
        ({"quads": np.full((8, 6, 8), np.nan, np.float32)}, "quads"),
        ({"times": np.arange(8) + 1.0}, "times"),
        ({"times": np.array([0, 1, 2, 3, 2, 5, 6, 7.0])}, "times"),
        ({"phase_offset": float("nan")}, "calibration"),
        ({"f_mod_hz": 1.0}, "f_mod_hz"),
        ({"quad_scale": 0.0}, "quad_scale"),
        ({"fx": 0.01}, "focal"),
        ({"camera_from_world": poses_with(row=0, column=0, value=-1.0)}, "camera_from_world"),
        ({"camera_from_world": poses_with(row=3, column=0, value=1.0)}, "camera_from_world"),
        ({"colour": {0: np.full((2, 2, 3), np.inf)}}, "colour"),
        ({"colour_intrinsics": (0.01, 9.0, 4.0, 3.0)}, "colour_intrinsics"),
        ({"colour_intrinsics": (9.0, 9.0, 4.0, np.nan)}, "colour_intrinsics"),
        ({"colour_from_world": poses_with(row=0, column=0, value=-1.0)}, "colour_from_world"),
        ({"novel_from_world": 2.0 * np.eye(4)[None]}, "novel_from_world"),
        ({"forward_flow": {0: np.full((2, 6, 8), np.inf)}}, "flow"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path, changes, word):
    """A named usage error, and nothing on disk."""
    with pytest.raises(UsageError) as caught:
        ftorf.write(tmp_path / "seq", dataclasses.replace(scene()[0], **changes))
    assert caught.value.exit_code == 2
    assert word in caught.value.what
    assert caught.value.fix
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf])
def test_truth_that_is_no_distance_is_refused(tmp_path, value):
    """Unknown is NaN, nothing else."""
    sequence, truth = scene()
    truth.distance[1, 2, 3] = value
    with pytest.raises(UsageError, match="truth"):
        ftorf.write(tmp_path / "seq", sequence, truth)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"times": np.zeros(7)},
        {"camera_from_world": np.eye(4)},
        {"forward_flow": {0: np.zeros((6, 8, 2))}},
        {"backward_flow": {8: np.zeros((2, 6, 8))}},
        {"colour": {0: np.zeros((6, 8, 3)), 1: np.zeros((6, 9, 3))}},
        {"colour_from_world": np.eye(4)},
        {"colour_intrinsics": (9.0, 9.0, 4.0)},
        {"novel_from_world": np.eye(4)},
        {"from_phasors": True},
    ],
)
def test_parts_that_do_not_fit_together_are_a_programming_mistake(tmp_path, changes):
    """The message names the part and both shapes."""
    with pytest.raises(ValueError, match=next(iter(changes))):
        ftorf.write(tmp_path / "seq", scene(**changes)[0])


def test_a_full_folder_is_not_written_to(folder):
    """Nor is one written half: the check comes before the first file."""
    before = fingerprint(folder)
    with pytest.raises(UsageError) as caught:
        ftorf.write(folder, scene()[0])
    assert caught.value.exit_code == 2
    assert str(folder) in caught.value.where
    assert fingerprint(folder) == before
