"""The TöRF folder: what is read from where in both of its conventions,
and that writing is the inverse of reading.
"""

import dataclasses
import shutil
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torf_folder
from ftorf_folder import (
    CAPTURE_ONLY,
    SAMPLE,
    assert_same,
    assert_same_bits,
    fingerprint,
    random_poses,
    scene,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from sequences import NAMES, changed, sequence_of, values_of

from gftorf_warp import Sequence, Truth
from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data import decode, specs
from gftorf_warp.data.sequence import Calibration, Intrinsics
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Three phasors of a moving camera, with colour and truth."""
    return torf_folder.build(tmp_path_factory.mktemp("original") / "seq")


@pytest.fixture
def folder(original, tmp_path):
    """A copy of it to change."""
    return shutil.copytree(original, tmp_path / "seq")


def test_a_phasor_becomes_four_raw_frames(folder):
    """re/2, -re/2, im/2, -im/2 with the canonical shifts, one time and one pose;
    colour at the first of the four.
    """
    got = Sequence.open(folder)
    phasors, _ = torf_folder.images(3)
    assert got.from_phasors
    assert (got.frames, got.height, got.width, got.measured.all()) == (12, 6, 8, True)
    for i in range(3):
        re, im = phasors[i, ..., 0], phasors[i, ..., 1]
        assert_same_bits(
            got.quads[4 * i : 4 * i + 4], np.stack([re, -re, im, -im]) / np.float32(2), "quads"
        )
    np.testing.assert_array_equal(got.shifts, [*CANONICAL_SHIFTS] * 3)
    np.testing.assert_array_equal(got.times, np.repeat([0, 1 / 30, 2 / 30], 4))
    np.testing.assert_array_equal(got.camera_from_world, np.repeat(torf_folder.poses(3), 4, axis=0))
    assert list(got.colour.images) == [0, 4, 8]
    assert_same_bits(got.colour.images[4], torf_folder.colour_images(3)[1], "colour")
    assert got.calibration == Calibration(f_mod_hz=SPEED_OF_LIGHT / 10)
    # stored 3.5, 2.5 for integer centres
    assert (got.intrinsics.cx, got.intrinsics.cy) == (4.0, 3.0)
    assert got.colour.intrinsics == Intrinsics(fx=20.0, fy=21.0, cx=7.5, cy=5.5)
    assert got.sources["times"] == "default 30 Hz"


def test_phasors_decode_to_the_truth(folder):
    """The length of the phasor, its angle and the distance are those that made the folder,
    for every raw frame.
    """
    got = Sequence.open(folder)
    phasors, distance = torf_folder.images(3)
    truth = got.truth()
    assert truth.known.all()
    for i in range(3):
        np.testing.assert_allclose(
            decode.quartet_phasor(got, i), np.moveaxis(phasors[i, ..., :2], -1, 0), atol=1e-7
        )
        np.testing.assert_allclose(decode.closed_form_distance(got, i), distance[i], atol=1e-5)
        assert_same_bits(truth.distance[4 * i : 4 * i + 4], np.stack([distance[i]] * 4), "distance")


@pytest.mark.parametrize("first_id", [1, 0, 17])
def test_both_conventions_are_one_sequence(folder, tmp_path, first_id):
    """Ids from 0001 and .mat files, as originally published, or renumbered: nothing differs,
    truth included.
    """
    other = torf_folder.build(tmp_path / "other", first_id=first_id, matlab=True)
    before = fingerprint(other)
    got = Sequence.open(other)
    assert_same(got, Sequence.open(folder))
    assert_same_bits(got.truth().distance, Sequence.open(folder).truth().distance, "distance")
    assert f"ids from {first_id:04d}" in got.sources["measured"]
    assert got.sources["fx"] == "file cams/tof_intrinsics.mat"
    assert fingerprint(other) == before


@pytest.mark.parametrize("first_id", [0, 1])
def test_a_gap_is_not_measured_and_nothing_moves_up(tmp_path, first_id):
    """The four raw frames of a missing phasor are masked; later ones keep their times,
    poses and colour.
    """
    folder = torf_folder.build(tmp_path / "seq", 4, first_id=first_id)
    want = Sequence.open(folder)
    (folder / f"tof/{first_id + 1:04d}.npy").unlink()
    got = Sequence.open(folder)
    assert np.flatnonzero(~got.measured).tolist() == [4, 5, 6, 7]
    assert not got.quads[4:8].any()
    assert got.complete_quartets == [0, 2, 3]
    quads = want.quads.copy()
    quads[4:8] = 0.0
    assert_same(got, dataclasses.replace(want, quads=quads, measured=got.measured))
    assert "3 of 4 phasors" in got.sources["measured"]


def test_phasor_0_is_known_by_colour_and_times(tmp_path):
    """A missing first phasor does not renumber the others where another file tells the count."""
    folder = torf_folder.build(tmp_path / "seq", 3)
    (folder / "tof/0000.npy").unlink()
    assert Sequence.open(folder).complete_quartets == [1, 2]
    shutil.rmtree(folder / "color")
    np.save(folder / "cams/frame_times.npy", np.array([0.0, 0.5, 0.75]))
    got = Sequence.open(folder)
    assert got.complete_quartets == [1, 2]
    np.testing.assert_array_equal(got.times, np.repeat([0.0, 0.5, 0.75], 4))
    assert Sequence.open(folder).truth().distance[0, 0, 0] == torf_folder.images(3)[1][0, 0, 0]


def test_times_are_the_file_s_unless_a_rate_is_given(folder):
    """One time per phasor; the file may state phasors after the last file."""
    np.save(folder / "cams/frame_times.npy", np.array([0.0, 0.1, 0.3, 0.4]))
    np.save(folder / "cams/tof_extrinsics.npy", torf_folder.poses(4))
    got = Sequence.open(folder)
    np.testing.assert_array_equal(got.times, np.repeat([0.0, 0.1, 0.3, 0.4], 4))
    assert got.complete_quartets == [0, 1, 2]
    got = Sequence.open(folder, frame_rate_hz=10.0)
    np.testing.assert_allclose(got.times, np.repeat(np.arange(4) / 10, 4))
    assert got.sources["times"] == "setting 10 Hz"


@pytest.mark.parametrize("shape", [(4, 4), (1, 4, 4)])
def test_the_relative_pose_goes_from_colour_to_tof(folder, shape):
    """A point in front of the colour camera, taken by E to the ToF camera,
    is the same point of the world.
    """
    np.save(folder / "cams/relative_pose.npy", torf_folder.RELATIVE.reshape(shape))
    np.save(folder / "cams/color_extrinsics.npy", torf_folder.poses(3))  # replaced
    got = Sequence.open(folder)
    world = np.array([0.3, -0.2, 2.0, 1.0])
    for n in (0, 5, 11):
        in_colour, in_tof = (
            got.colour.camera_from_world[n] @ world,
            got.camera_from_world[n] @ world,
        )
        np.testing.assert_allclose(torf_folder.RELATIVE @ in_colour, in_tof, atol=1e-12)
    assert "replaces" in got.sources["colour_from_world"]


def test_colour_poses_come_from_the_best_file(folder):
    """relative_pose, then color_extrinsics that are not all identity, then R and T,
    then the ToF camera's.
    """
    import scipy.io

    own = random_poses(3, np.random.default_rng(2))
    np.save(folder / "cams/color_extrinsics.npy", own)
    scipy.io.savemat(folder / "cams/relative_R.mat", {"R": torf_folder.RELATIVE[:3, :3]})
    scipy.io.savemat(folder / "cams/relative_T.mat", {"T": -torf_folder.RELATIVE[:3, 3:]})
    relative = np.linalg.inv(torf_folder.RELATIVE) @ torf_folder.poses(3)

    def first():
        got = Sequence.open(folder)
        return got.colour.camera_from_world[::4], got.sources["colour_from_world"]

    np.testing.assert_allclose(first()[0], relative)
    assert first()[1].startswith("file cams/relative_pose.npy")
    (folder / "cams/relative_pose.npy").unlink()
    np.testing.assert_array_equal(first()[0], own)
    assert first()[1] == "file cams/color_extrinsics.npy"
    for _ in range(2):  # all identity, then absent
        np.save(folder / "cams/color_extrinsics.npy", np.tile(np.eye(4), (3, 1, 1)))
        np.testing.assert_allclose(first()[0], relative)
        assert first()[1].startswith("inferred from cams/relative_R.mat")
        (folder / "cams/color_extrinsics.npy").unlink()
    (folder / "cams/relative_T.mat").unlink()
    np.testing.assert_array_equal(first()[0], torf_folder.poses(3))
    assert first()[1].startswith("inferred as the ToF camera")


def test_without_calibration_the_defaults_are_used_and_named(folder):
    """10 m, offset 0, identity poses, a colour camera scaled from the ToF camera;
    each says what it is.
    """
    for path in (folder / "cams").iterdir():
        if path.name != "tof_intrinsics.npy":
            path.unlink()
    got = Sequence.open(folder)
    assert (got.calibration.f_mod_hz, got.calibration.phase_offset) == (SPEED_OF_LIGHT / 10, 0.0)
    np.testing.assert_array_equal(got.camera_from_world, np.tile(np.eye(4), (12, 1, 1)))
    assert got.colour.intrinsics == got.intrinsics.scaled(2, 2)
    for name in (
        "f_mod_hz",
        "phase_offset",
        "times",
        "camera_from_world",
        "quad_scale",
        "novel_from_world",
    ):
        assert got.sources[name].startswith("default"), name
    for name in ("colour_intrinsics", "colour_from_world", "pixel_centre"):
        assert got.sources[name].startswith("inferred"), name
    shutil.rmtree(folder / "color")
    got = Sequence.open(folder)
    assert (got.colour.images, got.colour.intrinsics, got.colour.camera_from_world) == (
        {},
        None,
        None,
    )


@pytest.mark.parametrize(
    ("centre", "cx", "added"), [(None, 4.0, 0.0), ("integer", 4.0, 0.5), ("half", 3.9, 0.0)]
)
def test_pixel_centres_are_those_of_both_cameras(folder, centre, cx, added):
    """The width is 8: cx = 4 means half-integer centres, for colour too,
    unless the folder says otherwise.
    """
    np.save(folder / "cams/tof_intrinsics.npy", np.array([[9.0, 0, cx], [0, 9.0, 2.5], [0, 0, 1]]))
    if centre:
        (folder / "cams/pixel_centre.json").write_text(f'{{"pixel_centre": "{centre}"}}')
    got = Sequence.open(folder)
    assert (got.intrinsics.cx, got.intrinsics.cy) == (cx + added, 2.5 + added)
    assert got.colour.intrinsics == Intrinsics(fx=20.0, fy=21.0, cx=7.0 + added, cy=5.0 + added)


def test_every_field_names_its_source(folder):
    """Whatever the reader fills, it says where it is from, in one of four words."""
    got = Sequence.open(folder)
    assert set(got.sources) >= NAMES
    assert all(
        text.split()[0] in {"file", "default", "inferred", "setting"}
        for text in got.sources.values()
    )


def test_truth_is_distance_before_depth(folder):
    """depth/ counts only where distance/ is empty; 0 and NaN are unknown; no truth is None."""
    image = np.full((6, 8), 2.5, np.float32)
    image[0, 0], image[1, 1] = 0.0, np.nan
    (folder / "depth").mkdir()
    np.save(folder / "depth/0001.npy", image)
    assert Sequence.open(folder).truth().distance[4, 2, 2] != 2.5
    shutil.rmtree(folder / "distance")
    truth = Sequence.open(folder).truth()
    assert np.flatnonzero(truth.known).tolist() == [4, 5, 6, 7]
    assert np.argwhere(np.isnan(truth.distance[6])).tolist() == [[0, 0], [1, 1]]
    assert np.isnan(truth.distance[:4]).all()
    shutil.rmtree(folder / "depth")
    assert Sequence.open(folder).truth() is None


def test_reading_never_opens_truth_or_masks(folder):
    """Without them, or with rubbish in them, the sequence is the same."""
    want = Sequence.open(folder)
    for name in ("distance", "depth", "mask_tof", "mask_color"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "0000.npy").write_bytes(b"rubbish")
    assert_same(Sequence.open(folder), want)
    for name in ("distance", "depth"):
        shutil.rmtree(folder / name)
    assert_same(Sequence.open(folder), want)


def test_raw_quads_are_looked_for_before_phasors(folder, tmp_path):
    """An F-TöRF folder may have phasors too, and its reader is chosen;
    a TöRF folder has a reader of its own.
    """
    mixed = write("ftorf", tmp_path / "mixed", *scene())
    shutil.copytree(folder / "tof", mixed / "tof")
    assert not Sequence.open(mixed).from_phasors
    assert Sequence.open(mixed).truth().known.all()
    assert Sequence.open(folder).from_phasors


@st.composite
def phasor_sequences(draw):
    """Sequences of phasors in which nothing is trivial, with truth."""
    count, height, width = draw(st.integers(1, 4)), draw(st.integers(1, 4)), draw(st.integers(1, 5))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    measured = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    measured[draw(st.integers(0, count - 1))] = True
    powers = generator.integers(-8, 9, size=(count, 2, height, width)) + draw(st.integers(-24, 24))
    phasors = (generator.normal(size=powers.shape) * 10.0**powers).astype(np.float32)
    phasors[~measured] = 0.0
    re, im = phasors[:, 0] / np.float32(2), phasors[:, 1] / np.float32(2)
    poses = random_poses(count, generator)
    same = draw(st.booleans())
    relative = random_poses(1 if same else count, generator)
    size = (draw(st.integers(1, 3)), draw(st.integers(1, 3)), 3)
    drawn = sorted(draw(st.lists(st.integers(0, count - 1), unique=True)))
    colour = {4 * i: generator.normal(size=size).astype(np.float32) for i in drawn}
    steps = generator.random(count - 1) * (generator.random(count - 1) < 0.7)
    known = generator.random(count) < 0.7
    distance = generator.uniform(0.1, 9.0, size=(count, height, width)).astype(np.float32)
    distance[generator.random(distance.shape) < 0.1] = np.nan
    distance[~known] = np.nan
    sequence = sequence_of(
        quads=np.stack([re, -re, im, -im], axis=1).reshape(4 * count, height, width)
        * np.repeat(measured, 4)[:, None, None],
        measured=np.repeat(measured, 4),
        shifts=np.tile(CANONICAL_SHIFTS, count),
        times=np.repeat(np.concatenate([[0.0], np.cumsum(steps)]), 4),
        f_mod_hz=SPEED_OF_LIGHT / draw(st.floats(0.1, 1000.0)),
        phase_offset=draw(st.floats(-10, 10)),
        fx=draw(st.floats(0.05 * width, 50.0)),
        fy=draw(st.floats(0.05 * width, 50.0)),
        cx=draw(st.integers(0, 64)) / 8 + 0.25,
        cy=draw(st.integers(-64, 64)) / 8,
        camera_from_world=np.repeat(poses, 4, axis=0),
        quad_scale=draw(st.none() | st.floats(1e-3, 1e3)),
        from_phasors=True,
        colour=colour,
        colour_intrinsics=(draw(st.floats(0.5, 50.0)), 3.0, 1.25, -0.5) if colour else None,
        colour_from_world=np.repeat(relative @ poses, 4, axis=0) if colour else None,
        novel_from_world=random_poses(2, generator) if draw(st.booleans()) else None,
    )
    return sequence, Truth(distance=np.repeat(distance, 4, axis=0), known=np.repeat(known, 4)), same


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(phasor_sequences())
def test_write_then_read_is_the_identity(tmp_path_factory, drawn):
    """Bit by bit, poses of both cameras included, whichever phasor is missing;
    and a second round too.
    """
    sequence, truth, same = drawn
    with mock.patch("os.fsync"):  # waiting for the disk, thousands of times, shows nothing here
        first = write(
            "torf", tmp_path_factory.mktemp("round") / "first", sequence, truth, readme="# a card\n"
        )
        got = Sequence.open(first)
        again = write("torf", first.parent / "second", got, got.truth())
    want = dataclasses.replace(sequence, quads=sequence.quads * sequence.measured[:, None, None])
    for other in (got, Sequence.open(again)):
        np.testing.assert_array_equal(other.quads, want.quads)  # -0 of an absent phasor is 0
        assert_same(dataclasses.replace(other, quads=want.quads), want)
    got_truth = Sequence.open(again).truth()
    if truth.known.any():
        assert_same_bits(got_truth.distance, truth.distance, "distance")
        assert_same_bits(got_truth.known, truth.known, "known")
    else:
        assert got_truth is None
    if sequence.colour.images:
        assert (first / "cams/relative_pose.npy").exists() == (same or sequence.frames == 4)
    assert (first / "README.md").read_text() == "# a card\n"


def test_an_original_folder_survives_a_round(tmp_path):
    """Ids from 1 and .mat files: read, write, read gives every bit;
    the third channel becomes the length.
    """
    folder = torf_folder.build(tmp_path / "seq", first_id=1, matlab=True, phase_offset=0.2)
    np.save(folder / "test_poses.npy", torf_folder.poses(5)[:, :3])
    want = Sequence.open(folder)
    again = write("torf", tmp_path / "again", want, want.truth())
    got = Sequence.open(again)
    assert_same(got, want)
    assert_same_bits(got.truth().distance, want.truth().distance, "distance")
    assert len(got.novel_from_world) == 5
    stored = np.load(again / "tof/0000.npy")
    assert_same_bits(
        stored[..., :2], torf_folder.images(3, phase_offset=0.2)[0][0, ..., :2], "phasor"
    )
    np.testing.assert_allclose(stored[..., 2], np.hypot(stored[..., 0], stored[..., 1]), rtol=1e-6)
    np.testing.assert_allclose(
        np.load(again / "cams/relative_pose.npy"), torf_folder.RELATIVE, atol=1e-12
    )


def test_complete_quartets_of_raw_quads_become_phasors(tmp_path):
    """In any order of the slots, with the time, pose, colour and truth of raw frame 4i;
    the constant part is gone.
    """
    poses = random_poses(14, np.random.default_rng(3))
    colour = {n: np.full((2, 2, 3), 0.5 * n, np.float32) for n in range(14)}
    sequence, truth = scene(14, camera_from_world=poses, colour=colour, times=np.arange(14) / 100)
    sequence.measured[[2, 7]] = False  # quartets 0 and 1 are incomplete, 3 is truncated
    sequence.quads[[2, 7]] = 0.0
    sequence.measured[2] = True
    got = Sequence.open(write("torf", tmp_path / "seq", sequence, truth))
    assert got.complete_quartets == [0, 2]
    assert got.frames == 12
    for i in (0, 2):
        np.testing.assert_allclose(
            decode.quartet_phasor(got, i), decode.quartet_phasor(sequence, i), rtol=1e-6, atol=1e-7
        )
    np.testing.assert_array_equal(got.times, np.repeat([0.0, 0.04, 0.08], 4))
    np.testing.assert_array_equal(got.camera_from_world, np.repeat(poses[[0, 4, 8]], 4, axis=0))
    assert {n: image[0, 0, 0] for n, image in got.colour.images.items()} == {0: 0.0, 4: 2.0, 8: 4.0}
    np.testing.assert_array_equal(got.truth().distance[8:12], np.stack([truth.distance[8]] * 4))
    assert (got.calibration.dc_offset, got.calibration.phase_offset) == (
        0.0,
        sequence.calibration.phase_offset,
    )


def test_the_sample_decodes_alike_as_phasors(tmp_path):
    """The closed form of the sample's quads and of the phasors they are written as."""
    sequence = Sequence.open(SAMPLE)
    got = Sequence.open(write("torf", tmp_path / "seq", sequence, sequence.truth()))
    assert (got.frames, got.from_phasors) == (32, True)
    want = decode.closed_form_distance(sequence, 3)
    difference = np.abs(decode.closed_form_distance(got, 3) - want)
    assert np.quantile(difference, 0.999) < 1e-5


def test_everything_written_is_described(folder, tmp_path):
    """No file of the writer lacks an entry in data_specs/,
    and its type is one that the entry allows.
    """
    sequence = changed(Sequence.open(folder), quad_scale=2.0, novel_from_world=torf_folder.poses(2))
    written = write("torf", tmp_path / "written", sequence, sequence.truth())
    described = {path: field for field in specs.fields("torf").values() for path in field.paths}
    names = {str(path.relative_to(written)) for path in written.rglob("*.*")}
    assert {"test_poses.npy", "distance/0002.npy", "cams/relative_pose.npy"} <= names
    for name in names:
        field = described[name if name in described else name.replace(Path(name).stem[-4:], "{id}")]
        assert field.written != "never", name
        if field.kind == "array":
            assert np.load(written / name).dtype.kind in field.dtypes, name


def test_descriptions_cover_the_sequence_and_the_truth():
    """Every field of Sequence and Truth but flow is filled from a described one,
    and the page names every path.
    """
    fields = specs.fields("torf").values()
    filled = {name for field in fields for name in field.fills}
    names = (NAMES | {f.name for f in dataclasses.fields(Truth)}) - {
        "forward_flow",
        "backward_flow",
    }
    assert filled == names - CAPTURE_ONLY
    page = (ROOT / "data_specs" / "README.md").read_text(encoding="utf-8")
    table = page.partition("## The fields of TöRF")[2].partition("\n## ")[0]
    for field in fields:
        assert field.kind in {"array", "choice", "other"}, field.name
        assert field.role in {"measurement", "calibration", "truth", "check", "unused"}, field.name
        assert field.meaning, field.name
        assert all(f"`{path}`" in table for path in field.paths), field.name


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"measured": np.arange(12) % 4 > 0}, "quartets"),
        ({"quads": np.full((12, 6, 8), np.nan, np.float32)}, "quads"),
        ({"quads": np.full((12, 6, 8), 3e38, np.float32)}, "quads"),
        ({"times": np.arange(12) + 1.0}, "times"),
        ({"colour_from_world": np.tile(2.0 * np.eye(4), (12, 1, 1))}, "colour_from_world"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path, changes, word):
    """A named usage error, and nothing on disk."""
    with pytest.raises(UsageError) as caught:
        write("torf", tmp_path / "seq", scene(12, **changes)[0])
    assert word in caught.value.what
    assert "torf" in caught.value.where
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("quads", lambda a: a + 1),
        ("shifts", lambda a: a[::-1]),
        ("times", lambda a: a + np.arange(12)),
        ("measured", lambda a: a & (np.arange(12) > 0)),
        ("dc_offset", lambda a: a + 0.5),
        ("adc_zero", lambda a: a + 0.5),
        ("camera_from_world", lambda a: random_poses(len(a), np.random.default_rng(0))),
    ],
)
def test_phasors_that_are_none_are_a_programming_mistake(folder, tmp_path, name, change):
    """Raw frames that differ within a phasor would be lost without a word."""
    sequence = Sequence.open(folder)
    with pytest.raises(ValueError, match=f"from_phasors: {name}"):
        write(
            "torf", tmp_path / "new", changed(sequence, **{name: change(values_of(sequence)[name])})
        )


def test_phasors_are_no_raw_quads(folder, tmp_path):
    """They were not measured one by one, so the other format refuses them."""
    with pytest.raises(UsageError, match="phasors"):
        write("ftorf", tmp_path / "new", Sequence.open(folder))
