"""Bad input ends in one named error: file, field, expected, found, what to do, exit code 3,
and nothing written.
"""

import contextlib
import json
import pickle
import re
import shutil
import struct

import numpy as np
import pytest
from ftorf_folder import fingerprint, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp import Sequence
from gftorf_warp.data import arrays, specs
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError

QUAD = "tofType2/0006.npy"
FLOW = np.zeros((2, 6, 8), np.float32)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A complete folder with colour and flow."""
    colour = {n: np.full((6, 8, 3), 0.1 * n, np.float32) for n in range(8)}
    sequence, truth = scene(
        colour=colour, forward_flow={0: FLOW}, backward_flow={4: FLOW}, quad_scale=2.0
    )
    return write("ftorf", tmp_path_factory.mktemp("original") / "seq", sequence, truth)


@pytest.fixture
def folder(original, tmp_path):
    """A copy of it to break."""
    return shutil.copytree(original, tmp_path / "seq")


def refused(path, read=Sequence.open):
    """The input error that reading ends in, with nothing changed on disk."""
    before = fingerprint(path.parent)
    with pytest.raises(InputError) as caught:
        read(path)
    assert fingerprint(path.parent) == before
    error = caught.value
    assert error.exit_code == 3
    assert re.search("expected .*found", error.why, re.DOTALL)
    assert error.fix
    return error


def assert_names(error, file, *words):
    """The error is about one file, and says these words."""
    assert error.where.endswith(file), error
    assert all(word in str(error) for word in words), error


class Gadget:
    """Unpickling this would create a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def npy(shape, descr="'<f4'", data=b"", magic=b"\x93NUMPY\x01\x00"):
    """Bytes of a .npy file with a header of one's own."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return magic + struct.pack("<H", len(header)) + header.encode() + data


@pytest.mark.parametrize("kind", ["missing", "file", "empty", "unrelated"])
def test_what_is_no_sequence_folder(tmp_path, kind):
    """The path is named, and what a sequence would have been."""
    path = tmp_path / "data"
    if kind == "file":
        path.write_text("x")
    elif kind != "missing":
        (path / ("sub" if kind == "unrelated" else "")).mkdir(parents=True)
    assert_names(refused(path), "data", "tofType0")


def test_one_level_off_names_the_sequence(folder):
    """Both above and inside a sequence, the fix is its path."""
    above = folder.parent / "above"  # of which nothing else is read
    above.mkdir()
    folder = folder.rename(above / "seq")
    for path in (folder.parent, folder / "tofType1", folder / "cams"):
        assert_names(refused(path), path.name, "one level off", str(folder))


@pytest.mark.parametrize("missing", ["tofType3", "cams"])
def test_an_incomplete_folder_names_what_is_missing(folder, missing):
    """It resembles a sequence, so the missing part is named."""
    shutil.rmtree(folder / missing)
    assert missing in refused(folder).what


def test_a_folder_of_phasors_is_told_from_one_of_quads(folder):
    """TöRF has tof/ and cams/ only; an F-TöRF folder may have tof/ too."""
    (folder / "tof").mkdir()
    Sequence.open(folder)
    for slot in range(4):
        shutil.rmtree(folder / f"tofType{slot}")
    assert "no phasors" in refused(folder).what
    np.save(folder / "tof/0000.npy", np.ones((6, 8, 3)))
    for name in ("frame_times", "tof_extrinsics", "color_extrinsics"):
        (folder / f"cams/{name}.npy").unlink()
    assert Sequence.open(folder).from_phasors


def test_no_frame_of_its_own_slot_is_no_raw_frame(folder):
    """Slots full of warped copies, or of other names, measure nothing."""
    for slot in range(4):
        shutil.rmtree(folder / f"tofType{slot}")
        (folder / f"tofType{slot}").mkdir()
    np.save(folder / "tofType1/0000.npy", np.zeros((6, 8), np.float32))
    assert_names(refused(folder), "tofType0", "no raw frames")


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        (QUAD, np.zeros((6, 9), np.float32), ["quads", "(6, 8)", "(6, 9)"]),
        (QUAD, np.zeros((6, 8, 1), np.float32), ["quads", "(6, 8)", "(6, 8, 1)"]),
        (QUAD, np.zeros((6, 8), np.complex64), ["quads", "complex64"]),
        (QUAD, np.zeros((6, 8), bool), ["quads", "bool"]),
        (QUAD, np.full((6, 8), "1"), ["quads", "<U1"]),
        (QUAD, np.zeros((0, 8), np.float32), ["quads", "(0, 8)"]),
        (QUAD, np.full((6, 8), 1e300), ["quads", "float32"]),
        (
            QUAD,
            np.where(np.arange(48).reshape(6, 8) == 19, np.nan, 1.0),
            ["quads", "nan", "[2, 3]", "1 values"],
        ),
        (
            QUAD,
            np.where(np.arange(48).reshape(6, 8) > 45, -np.inf, 1.0),
            ["quads", "-inf", "[5, 6]", "2 values"],
        ),
        ("color/0003.npy", np.zeros((6, 9, 3), np.float32), ["colour", "(6, 9, 3)"]),
        ("color/0003.npy", np.zeros((6, 8), np.float32), ["colour", "(6, 8)"]),
        ("color/0003.npy", np.full((6, 8, 3), np.nan), ["colour", "nan"]),
        (
            "forward_flow_2/flow_0000.npy",
            np.zeros((6, 8, 2), np.float32),
            ["forward_flow", "(2, 6, 8)", "(6, 8, 2)"],
        ),
        ("forward_flow_2/flow_0000.npy", np.zeros((2, 6, 8), int), ["forward_flow", "int64"]),
        ("backward_flow_2/flow_0004.npy", np.full((2, 6, 8), np.inf), ["backward_flow", "inf"]),
        ("tof_permutation.npy", np.array([0, 1, 2, 2]), ["unknown permutation", "[0, 1, 2, 2]"]),
        ("tof_permutation.npy", np.array([1, 2, 3, 4]), ["unknown permutation", "[1, 2, 3, 4]"]),
        ("tof_permutation.npy", np.array([0.5, 1, 2, 3]), ["unknown permutation", "0.5"]),
        ("tof_permutation.npy", np.array([0, 1, 2]), ["permutation", "(4)", "(3,)"]),
        ("cams/depth_range.npy", np.float32(0.0), ["depth_range", "found 0"]),
        ("cams/depth_range.npy", np.float32(-15.0), ["depth_range", "-15"]),
        ("cams/depth_range.npy", np.float64(20e6), ["depth_range", "2e+07"]),
        ("cams/depth_range.npy", np.array([15.0, 15.0]), ["depth_range", "one number", "(2,)"]),
        ("cams/depth_range.npy", np.float64(np.nan), ["depth_range", "nan"]),
        ("cams/phase_offset.npy", np.float64(np.inf), ["phase_offset", "inf"]),
        ("cams/dc_offset.npy", np.array("0"), ["dc_offset", "<U1"]),
        (
            "cams/quad_values_scale_factor.npy",
            np.float64(0.0),
            ["quad_values_scale_factor", "found 0"],
        ),
        ("cams/tof_intrinsics.npy", np.eye(2), ["tof_intrinsics", "(3, 3)", "(2, 2)"]),
        ("cams/tof_intrinsics.npy", np.diag([0.2, 0.2, 1.0]), ["implausible intrinsics", "0.2"]),
        ("cams/tof_intrinsics.npy", np.diag([-9.0, 9.0, 1.0]), ["implausible intrinsics", "-9"]),
        (
            "cams/tof_intrinsics.npy",
            np.array([[9.0, 0, 0], [0, 9, 0], [4, 3, 1]]),
            ["implausible", "transposed"],
        ),
        (
            "cams/tof_intrinsics.npy",
            np.array([[9.0, 1, 4], [0, 9, 3], [0, 0, 1]]),
            ["implausible", "skew"],
        ),
        ("cams/tof_extrinsics.npy", np.tile(np.eye(4), (7, 1, 1)), ["tof_extrinsics", "8", "7"]),
        (
            "cams/tof_extrinsics.npy",
            np.tile(2 * np.eye(4), (8, 1, 1)),
            ["tof_extrinsics", "rotations", "2.0"],
        ),
        (
            "cams/tof_extrinsics.npy",
            np.tile(np.diag([1.0, 1, -1, 1]), (8, 1, 1)),
            ["tof_extrinsics", "determinant"],
        ),
        ("cams/tof_extrinsics.npy", np.full((8, 4, 4), 1e200), ["tof_extrinsics", "rotations"]),
        (
            "cams/color_extrinsics.npy",
            np.tile(np.eye(4), (7, 1, 1)),
            ["color_extrinsics", "8", "7"],
        ),
        (
            "cams/color_extrinsics.npy",
            np.tile(2 * np.eye(4), (8, 1, 1)),
            ["color_extrinsics", "rotations"],
        ),
        ("cams/color_intrinsics.npy", np.diag([0.2, 0.2, 1.0]), ["implausible intrinsics", "0.2"]),
        ("test_poses.npy", np.tile(2 * np.eye(4), (2, 1, 1)), ["test_poses", "rotations"]),
        ("test_poses.npy", np.eye(4), ["test_poses", "(M, 3, 4)", "(4, 4)"]),
        ("cams/frame_times.npy", np.arange(7.0), ["frame_times", "8", "7"]),
        ("cams/frame_times.npy", np.arange(8.0) + 1, ["frame_times", "start at 0"]),
        (
            "cams/frame_times.npy",
            np.array([0, 1, 2, 3, 2.5, 5, 6, 7]),
            ["frame_times", "after frame 3"],
        ),
    ],
)
def test_a_wrong_array_is_named_with_field_expected_and_found(folder, name, array, words):
    """One file is broken, and the message is about that file."""
    (folder / name).unlink(missing_ok=True)
    np.save(folder / name, array)
    assert_names(refused(folder), name, *words)


@pytest.mark.parametrize(
    "name",
    [QUAD, "tofType0/0000.npy", "cams/dc_offset.npy", "cams/tof_extrinsics.npy", "color/0000.npy"],
)
@pytest.mark.parametrize(
    "content", [b"", b"1 2 3\n4 5 6\n", b"\x93NUMPY", b"\x93NUMPY\x09\x00v\x00", npy("(6, 8")]
)
def test_text_and_other_files_where_an_array_should_be(folder, name, content):
    """Anything without a sound header, from an empty file to a damaged one."""
    (folder / name).write_bytes(content)
    assert_names(refused(folder), name, "not a .npy array", "numpy.save")


@pytest.mark.parametrize(
    "name", [QUAD, "cams/phase_offset.npy", "tof_permutation.npy", "forward_flow_2/flow_0000.npy"]
)
@pytest.mark.parametrize("wrapped", [True, False])
def test_pickles_are_refused_and_never_run(folder, name, wrapped):
    """As an array of objects, and as a bare pickle."""
    trap = folder.parent.parent / f"{folder.parent.name}-sprung"
    if wrapped:
        np.save(folder / name, np.array([Gadget(trap)], dtype=object), allow_pickle=True)
    else:
        (folder / name).write_bytes(pickle.dumps(Gadget(trap)))
    assert_names(refused(folder), name, "pickled" if wrapped else "not a .npy array")
    assert not trap.exists()


@pytest.mark.parametrize(
    ("shape", "descr"),
    [
        ("(60000, 8)", "'<f4'"),
        ("(1000000000000, 1000000000000)", "'<f4'"),
        ("(-6, -8)", "'<f4'"),
        ("(6, 8)", "'<f8'"),
        ("(6, 8)", "'|O'"),
        ("(6, 8)", "[('a', '<f4')]"),
        ("(6, 8)", "'<f4', 'more': 1"),
        ("(6, 8.0)", "'<f4'"),
        ("()", "'<f4'"),
        ("(6, __import__('os'))", "'<f4'"),
        ("(6, 8)", "'|S0'"),
    ],
)
@pytest.mark.parametrize("name", ["tofType0/0000.npy", QUAD])
def test_forged_headers_are_refused_before_memory_is_allocated(folder, name, shape, descr):
    """The first file of a recording sets the size, so its own header must be judged by the file's
    length.
    """
    (folder / name).write_bytes(npy(shape, descr, bytes(6 * 8 * 4)))
    error = refused(folder)
    assert name in str(error), error
    assert "npy" in error.where or "problems" in error.what


def test_every_truncation_of_a_quad_is_refused(folder):
    """Cut at every byte; and one byte too many."""
    path, spec = folder / QUAD, specs.fields("ftorf")["quads"]
    whole = path.read_bytes()
    assert arrays.read_array(path, spec).shape == (6, 8)
    for length in [*range(len(whole)), len(whole) + 1]:
        path.write_bytes((whole + b"\0")[:length])
        with pytest.raises(InputError) as caught:
            arrays.read_array(path, spec)
        assert caught.value.where == str(path)
    path.write_bytes(whole[:-1])
    assert_names(refused(folder), QUAD, "truncated", "192", "191")


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.tuples(st.integers(0, 127), st.integers(0, 255)), min_size=1, max_size=6),
    st.booleans(),
)
def test_a_mutated_header_is_refused_or_read_as_numbers(tmp_path_factory, changes, matlab):
    """Whatever bytes change, there is a checked array or a named error: no other exception,
    no objects, no warning.
    """
    name = "tof_intrinsics" if matlab else "quads"
    path = tmp_path_factory.getbasetemp() / ("mutated.mat" if matlab else "mutated.npy")
    spec = specs.fields("ftorf")[name]
    if matlab:
        import scipy.io

        scipy.io.savemat(path, {"K": np.diag([9.0, 9.0, 1.0])})
    else:
        np.save(path, np.arange(48, dtype=np.float32).reshape(6, 8))
    data = bytearray(path.read_bytes())
    for position, value in changes:
        data[(position + 120 if matlab else position) % len(data)] = value
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        array = arrays.read_array(path, spec)
        assert array.dtype.kind in spec.dtypes
        assert np.isfinite(array).all()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cams/pixel_centre.json", "integer"),
        ("cams/pixel_centre.json", '{"pixel_centre": "corner"}'),
        ("cams/pixel_centre.json", '{"pixel_centre": "half", "more": 1}'),
        ("cams/pixel_centre.json", '{"pixel_centre": ["half"]}'),
        ("cams/pixel_centre.json", '["half"]'),
        ("cams/pixel_centre.json", "[" * 60_000),
        ("cams/pixel_centre.json", " " * 70_000),
        ("cams/poses.json", '{"poses": "world_from_camera"}'),
    ],
)
def test_unknown_statements_are_refused(folder, name, content):
    """The message shows what could have been said."""
    (folder / name).write_text(content)
    error = refused(folder)
    assert_names(error, name)
    assert "pixel_centre" in str(error) or "camera_from_world" in str(error)


def test_undecodable_json_is_refused(folder):
    """Bytes that are no text."""
    (folder / "cams/poses.json").write_bytes(b"\xff\xfe\x00")
    assert_names(refused(folder), "cams/poses.json", "not JSON")


def test_poses_that_count_must_be_there(folder):
    """The statement without the file."""
    (folder / "cams/tof_extrinsics.npy").unlink()
    assert_names(refused(folder), "cams/tof_extrinsics.npy", "no such file")


def test_intrinsics_must_be_there(folder):
    """Both places that were looked at are named."""
    (folder / "cams/tof_intrinsics.npy").unlink()
    assert_names(refused(folder), "cams/tof_intrinsics.npy", "tof_intrinsics.mat")


@pytest.mark.parametrize(
    ("name", "variable", "value"),
    [("depth_range", "depth_range", 10.0), ("tof_intrinsics", "K", np.diag([7.0, 7.0, 1.0]))],
)
def test_files_that_contradict_each_other_are_refused(folder, name, variable, value):
    """The same quantity as .npy and as .mat with different values."""
    import scipy.io

    scipy.io.savemat(folder / f"cams/{name}.mat", {variable: value})
    assert_names(refused(folder), f"cams/{name}.npy", "disagree", f"{name}.mat")


@pytest.mark.parametrize("content", [b"text", b"\0" * 200, b"x" * 70_000])
def test_a_file_that_only_ends_in_mat_is_refused(folder, content):
    """Text, zeros, or too much of anything."""
    (folder / "cams/tof_intrinsics.npy").unlink()
    (folder / "cams/tof_intrinsics.mat").write_bytes(content)
    assert_names(refused(folder), "cams/tof_intrinsics.mat")


@pytest.mark.parametrize("variables", [{"k": np.eye(3)}, {"K": "text"}, {"K": {"a": 1}}])
def test_a_matlab_file_needs_its_variable(folder, variables):
    """By the documented name, and a matrix."""
    import scipy.io

    (folder / "cams/tof_intrinsics.npy").unlink()
    scipy.io.savemat(folder / "cams/tof_intrinsics.mat", variables)
    assert_names(refused(folder), "cams/tof_intrinsics.mat")


def test_a_folder_in_place_of_a_file_is_refused(folder):
    """And so would be a pipe, which would make the reader wait for ever."""
    (folder / QUAD).unlink()
    (folder / QUAD).mkdir()
    assert_names(refused(folder), QUAD, "no such file")


def test_an_absurd_frame_number_is_refused(folder):
    """It would ask for memory in proportion."""
    shutil.copy(folder / "tofType0/0000.npy", folder / "tofType0/40000000.npy")
    assert_names(refused(folder), "tofType0/40000000.npy", "40000000")


def test_one_pass_names_everything_that_is_wrong(folder):
    """Five broken files of different kinds in one error."""
    np.save(folder / QUAD, np.full((6, 8), np.nan))
    (folder / "tofType1/0001.npy").write_text("text")
    np.save(folder / "cams/depth_range.npy", -1.0)
    np.save(folder / "tof_permutation.npy", np.zeros(4, int))
    (folder / "cams/pixel_centre.json").write_text("{}")
    error = refused(folder)
    assert error.what == "5 problems"
    assert error.where == str(folder)
    for name in (QUAD, "tofType1/0001.npy", "depth_range", "permutation", "pixel_centre"):
        assert name in error.why, name
    assert error.fix.count("\n") == 4


def test_a_long_list_is_cut(folder):
    """A broken export repeats itself in every file; twenty are shown, the rest is counted."""
    for n in range(8, 40):
        (folder / f"tofType{n % 4}/{n:04d}.npy").write_text("text")
    for name in ("frame_times.npy", "poses.json"):
        (folder / "cams" / name).unlink()
    error = refused(folder)
    assert error.what == "32 problems"
    assert "and 12 more" in error.why


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.full((6, 8), -1.0), ["negative", "-1"]),
        (np.full((6, 8), np.inf), ["inf"]),
        (np.ones((6, 9)), ["(6, 8)", "(6, 9)"]),
    ],
)
def test_truth_is_checked_when_it_is_read(folder, array, words):
    """And only then."""
    np.save(folder / "synthetic_depth/0003.npy", array)
    Sequence.open(folder)
    error = refused(folder, read=lambda path: Sequence.open(path).truth())
    assert_names(error, "synthetic_depth/0003.npy", "distance", *words)


def test_errors_are_one_line_of_json_when_asked_for(folder):
    """Their parts are plain text, so that a command can print them as it likes."""
    (folder / QUAD).write_text("text")
    error = refused(folder)
    assert json.loads(json.dumps([error.what, error.where, error.why, error.fix]))[1] == str(
        folder / QUAD
    )
