"""Broken TöRF folders end in one named error, from reading and from ``gftorf check`` alike."""

import re
import shutil

import numpy as np
import pytest
import torf_folder
from ftorf_folder import fingerprint

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.check import check
from gftorf_warp.errors import InputError

PHASOR = "tof/0001.npy"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Three phasors with everything a folder may have."""
    folder = torf_folder.build(tmp_path_factory.mktemp("original") / "seq")
    np.save(folder / "test_poses.npy", torf_folder.poses(2))
    np.save(folder / "cams/frame_times.npy", np.arange(3) / 30)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    """A copy of it to break."""
    return shutil.copytree(original, tmp_path / "seq")


def refused(path, read=Sequence.open):
    """The input error that reading and checking end in, with nothing changed on disk."""
    before = fingerprint(path.parent)
    errors = []
    for attempt in (read, check) if read is Sequence.open else (read,):
        with pytest.raises(InputError) as caught:
            attempt(path)
        errors.append(caught.value)
    assert len({str(error) for error in errors}) == 1
    assert fingerprint(path.parent) == before
    assert errors[0].exit_code == 3
    assert re.search("expected .*found", errors[0].why, re.DOTALL)
    assert errors[0].fix
    return errors[0]


def assert_names(error, file, *words):
    """The error is about one file, and says these words."""
    assert error.where.endswith(file), error
    assert all(word in str(error) for word in words), error


def with_nan():
    """A phasor of which one number is missing."""
    phasor = np.zeros((6, 8, 3), np.float32)
    phasor[2, 3, 1] = np.nan
    return phasor


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        (PHASOR, np.zeros((6, 9, 3)), ["phasor", "(6, 8, 3)", "(6, 9, 3)"]),
        (PHASOR, np.zeros((6, 8, 2)), ["phasor", "(6, 8, 3)", "(6, 8, 2)"]),
        (PHASOR, np.zeros((6, 8)), ["phasor", "(6, 8)"]),
        (PHASOR, np.zeros((6, 8, 3), np.complex64), ["phasor", "complex64"]),
        (PHASOR, with_nan(), ["phasor", "nan", "[2, 3, 1]", "1 values"]),
        ("color/0002.npy", np.zeros((12, 17, 3)), ["colour", "(12, 16, 3)", "(12, 17, 3)"]),
        ("color/0002.npy", np.full((12, 16, 3), np.inf), ["colour", "inf"]),
        (
            "cams/tof_extrinsics.npy",
            np.tile(np.eye(4), (4, 1, 1)),
            ["tof_extrinsics", "3 phasors", "4"],
        ),
        (
            "cams/tof_extrinsics.npy",
            np.tile(2 * np.eye(4), (3, 1, 1)),
            ["tof_extrinsics", "rotations"],
        ),
        (
            "cams/tof_extrinsics.npy",
            np.tile(np.diag([1.0, 1, -1, 1]), (3, 1, 1)),
            ["tof_extrinsics", "determinant"],
        ),
        ("cams/tof_extrinsics.npy", np.full((3, 4, 4), np.nan), ["tof_extrinsics", "nan"]),
        ("cams/tof_extrinsics.npy", np.eye(4), ["tof_extrinsics", "(P, 4, 4)"]),
        ("cams/relative_pose.npy", 2 * np.eye(4), ["relative_pose", "rotations"]),
        (
            "cams/relative_pose.npy",
            np.tile(np.eye(4), (3, 1, 1)),
            ["relative_pose", "(1, 4, 4)", "(3, 4, 4)"],
        ),
        ("cams/tof_intrinsics.npy", np.diag([0.2, 0.2, 1.0]), ["implausible intrinsics"]),
        ("cams/color_intrinsics.npy", np.diag([0.2, 0.2, 1.0]), ["implausible intrinsics"]),
        ("cams/depth_range.npy", np.float64(10e6), ["depth_range", "1e+07"]),
        ("cams/frame_times.npy", np.arange(2.0), ["frame_times", "3", "2", "30 Hz"]),
        ("cams/frame_times.npy", np.array([0.0, 2.0, 1.0]), ["frame_times", "after frame 1"]),
        ("test_poses.npy", np.tile(2 * np.eye(4), (2, 1, 1)), ["test_poses", "rotations"]),
    ],
)
def test_a_wrong_array_is_named_with_field_expected_and_found(folder, name, array, words):
    """One file is broken, and the message is about that file."""
    np.save(folder / name, array)
    assert_names(refused(folder), name, *words)


def test_absolute_colour_poses_are_checked_where_they_count(folder):
    """Without a relative pose their number and shape matter; with one they are replaced."""
    np.save(folder / "cams/color_extrinsics.npy", np.tile(np.eye(4), (2, 1, 1)))
    Sequence.open(folder)
    (folder / "cams/relative_pose.npy").unlink()
    assert_names(refused(folder), "cams/color_extrinsics.npy", "3 phasors", "found 2")


def test_an_inferred_relative_pose_must_be_one(folder):
    """R that is no rotation."""
    import scipy.io

    (folder / "cams/relative_pose.npy").unlink()
    scipy.io.savemat(folder / "cams/relative_R.mat", {"R": 2.0 * np.eye(3)})
    scipy.io.savemat(folder / "cams/relative_T.mat", {"T": np.zeros(3)})
    assert_names(refused(folder), "cams/relative_R.mat", "rotations")


@pytest.mark.parametrize(
    ("name", "variable", "value"),
    [
        ("depth_range", "depth_range", 15.0),
        ("phase_offset", "P", 1.0),
        ("tof_intrinsics", "K", np.diag([7.0, 7, 1])),
        ("color_intrinsics", "K", np.diag([7.0, 7, 1])),
    ],
)
def test_files_that_contradict_each_other_are_refused(folder, name, variable, value):
    """The same quantity as .npy and as .mat with different values."""
    import scipy.io

    scipy.io.savemat(folder / f"cams/{name}.mat", {variable: value})
    assert_names(refused(folder), f"cams/{name}.npy", "disagree", f"{name}.mat")


def test_what_is_missing_is_named(folder):
    """Intrinsics, then cams/ as a whole, then every phasor."""
    (folder / "cams/tof_intrinsics.npy").unlink()
    assert_names(refused(folder), "cams/tof_intrinsics.npy", "tof_intrinsics.mat")
    shutil.rmtree(folder / "cams")
    error = refused(folder)
    assert "cams missing" in str(error)
    shutil.rmtree(folder / "tof")
    (folder / "tof").mkdir()
    assert_names(refused(folder), "tof", "no phasors")
    (folder / "tof").rmdir()
    assert_names(refused(folder), "seq", "not a sequence folder", "tofType0", "phasors")


def test_one_level_off_names_the_sequence(folder):
    """Both above and inside a folder, the fix is its path."""
    above = folder.parent / "above"  # of which nothing else is read
    above.mkdir()
    folder = folder.rename(above / "seq")
    for path in (folder.parent, folder / "tof"):
        assert_names(refused(path), path.name, "one level off", str(folder))


def test_an_absurd_number_is_refused(folder):
    """It would ask for memory in proportion."""
    shutil.copy(folder / PHASOR, folder / "tof/40000000.npy")
    assert_names(refused(folder), "tof/40000000.npy", "40000000")


def test_raw_quads_are_not_read_as_phasors(folder):
    """A folder with tofType0 .. is one of raw quads, and these are missing."""
    for slot in range(4):
        (folder / f"tofType{slot}").mkdir()
    assert_names(refused(folder), "tofType0", "no raw frames")


def test_one_pass_names_everything_that_is_wrong(folder, capsys):
    """Seven broken files of different kinds in one error,
    and the command prints it and exits with 3.
    """
    np.save(folder / PHASOR, with_nan())
    np.save(folder / "tof/0002.npy", np.zeros((6, 9, 3)))
    np.save(folder / "color/0000.npy", np.full((12, 16, 3), np.nan))
    np.save(folder / "cams/depth_range.npy", -1.0)
    np.save(folder / "cams/tof_extrinsics.npy", np.tile(2 * np.eye(4), (3, 1, 1)))
    np.save(folder / "test_poses.npy", np.zeros((2, 4, 4)))
    (folder / "cams/tof_intrinsics.npy").write_text("text")
    error = refused(folder)
    assert error.what == "7 problems"
    assert error.where == str(folder)
    names = (
        PHASOR,
        "tof/0002.npy",
        "color/0000.npy",
        "depth_range",
        "tof_extrinsics",
        "test_poses",
        "tof_intrinsics",
    )
    for name in names:
        assert name in error.why, name
    assert main(["check", str(folder)]) == 3
    printed = capsys.readouterr().err
    assert all(name in printed for name in names)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.full((6, 8), -1.0), ["negative", "-1"]),
        (np.full((6, 8), np.inf), ["inf"]),
        (np.ones((6, 9)), ["(6, 8)", "(6, 9)"]),
    ],
)
@pytest.mark.parametrize("name", ["distance", "depth"])
def test_truth_is_checked_when_it_is_read(folder, array, words, name):
    """And only then, in either folder."""
    (folder / "distance").rename(folder / name)
    np.save(folder / f"{name}/0002.npy", array)
    Sequence.open(folder)
    error = refused(folder, read=lambda path: Sequence.open(path).truth())
    assert_names(error, f"{name}/0002.npy", "distance", *words)
