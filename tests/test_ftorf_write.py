"""Writing an F-TöRF folder: the inverse of reading it, described to the last file,
and refused where it cannot hold.
"""

import dataclasses
import json
import tomllib
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
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
from sequences import NAMES, changed, sequence_of

from gftorf_warp import Sequence, Truth
from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data import specs
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError

ROOT = Path(__file__).parents[1]


@pytest.fixture
def folder(tmp_path):
    """A complete folder in the order of the real recordings."""
    return write("ftorf", tmp_path / "seq", *scene())


@st.composite
def sequences(draw):
    """Sequences in which nothing is trivial, with truth."""
    frames, height, width = (
        draw(st.integers(1, 11)),
        draw(st.integers(1, 4)),
        draw(st.integers(1, 5)),
    )
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    permutation = draw(st.permutations(range(4)))
    measured = np.array(draw(st.lists(st.booleans(), min_size=frames, max_size=frames)))
    measured[draw(st.integers(0, frames - 1))] = True
    quads = (
        generator.normal(size=(frames, height, width)) * 10.0 ** draw(st.integers(-30, 30))
    ).astype(np.float32)
    quads[~measured] = 0.0
    poses = random_poses(frames, generator)
    steps = generator.random(frames - 1) * (generator.random(frames - 1) < 0.5)

    def images(*shape, unknown):
        """Images of some raw frames."""
        result = {}
        for n in draw(st.lists(st.integers(0, frames - 1), unique=True)):
            image = generator.normal(size=shape).astype(np.float32)
            result[n] = (
                np.where(generator.random(shape) < 0.2, np.float32(np.nan), image)
                if unknown
                else image
            )
        return dict(sorted(result.items()))

    colour = images(draw(st.integers(1, 3)), draw(st.integers(1, 3)), 3, unknown=False)
    sequence = sequence_of(
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


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(sequences())
def test_write_then_read_is_the_identity(tmp_path_factory, drawn):
    """Images bit by bit in float32, calibration in float64, whatever is missing;
    and a second round too.
    """
    sequence, truth = drawn
    with mock.patch("os.fsync"):  # waiting for the disk, thousands of times, shows nothing here
        first = write(
            "ftorf",
            tmp_path_factory.mktemp("round") / "first",
            sequence,
            truth,
            readme="# a card\n",
        )
        got = Sequence.open(first)
        again = write("ftorf", first.parent / "second", got, got.truth())
    assert_same(got, sequence)
    assert_same(Sequence.open(again), sequence)
    got_truth = Sequence.open(again).truth()
    if truth.known.any():
        assert_same_bits(got_truth.distance, truth.distance, "distance")
        assert_same_bits(got_truth.known, truth.known, "known")
    else:
        assert got_truth is None
    assert (first / "README.md").read_text() == "# a card\n"


def test_the_sample_survives_a_round(tmp_path):
    """Read, write, read: every bit of the sample, though the writer stores other pixel centres and
    states them.
    """
    want = Sequence.open(SAMPLE)
    folder = write("ftorf", tmp_path / "seq", want, want.truth())
    got = Sequence.open(folder)
    assert_same(got, want)
    assert_same_bits(got.truth().distance, want.truth().distance, "distance")
    assert np.load(folder / "cams/tof_intrinsics.npy")[:2, 2].tolist() == [79.5, 59.5]
    assert json.loads((folder / "cams/pixel_centre.json").read_text()) == {
        "pixel_centre": "integer"
    }
    assert np.load(folder / "color/0000.npy").dtype == np.float16


def test_everything_written_is_described(folder):
    """No file of the writer lacks an entry in data_specs/,
    and its type is one that the entry allows.
    """
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
    """Every field of Sequence and Truth is filled from a described one,
    and no description fills anything else.
    """
    filled = {name for field in specs.fields("ftorf").values() for name in field.fills}
    assert filled == (NAMES | {f.name for f in dataclasses.fields(Truth)}) - CAPTURE_ONLY
    for field in specs.fields("ftorf").values():
        assert field.kind in {"array", "choice", "other"}, field.name
        assert field.role in {"measurement", "calibration", "truth", "check", "unused"}, field.name
        assert field.nan in {"error", "unknown"}, field.name
        assert field.meaning, field.name
        assert field.unit, field.name


def test_the_page_beside_the_descriptions_names_every_field():
    """data_specs/README.md mentions every path, and the wheel carries the description where the
    reader looks.
    """
    page = (ROOT / "data_specs" / "README.md").read_text(encoding="utf-8")
    for field in specs.fields("ftorf").values():
        assert all(f"`{path}`" in page for path in field.paths), field.name
    included = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"][
        "targets"
    ]["wheel"]
    names = [path.name for path in (ROOT / "data_specs").glob("*.toml")]
    assert included["force-include"] == {
        f"data_specs/{name}": f"gftorf_warp/data/specs/{name}" for name in names
    }
    assert (specs.INSTALLED / "ftorf.toml").parts[-4:] == (
        "gftorf_warp",
        "data",
        "specs",
        "ftorf.toml",
    )


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
        ({"quad_scale": 0.0}, "quad_scale"),
        ({"fx": 0.01}, "focal"),
        ({"colour": {0: np.zeros((1, 8193, 3), np.float32)}}, "size"),
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
        write("ftorf", tmp_path / "seq", changed(scene()[0], **changes))
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
        write("ftorf", tmp_path / "seq", sequence, truth)
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
        {"novel_from_world": np.eye(4)},
        {"from_phasors": True},
    ],
)
def test_parts_that_do_not_fit_together_are_a_programming_mistake(tmp_path, changes):
    """The message names the part and both shapes."""
    with pytest.raises(ValueError, match=next(iter(changes))):
        write("ftorf", tmp_path / "seq", scene(**changes)[0])


def test_a_full_folder_is_not_written_to(folder):
    """Nor is one written half: the check comes before the first file."""
    before = fingerprint(folder)
    with pytest.raises(UsageError) as caught:
        write("ftorf", folder, scene()[0])
    assert caught.value.exit_code == 2
    assert str(folder) in caught.value.where
    assert fingerprint(folder) == before
