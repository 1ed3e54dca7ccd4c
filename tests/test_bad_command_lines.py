"""Wrong `gftorf simulate` lines: scenes, sensors, meshes, sizes, folders: three lines, a code,
nothing written.
"""

import os

import pytest

from gftorf_warp.cli import main

WALL = """
[[bodies]]
shape = { kind = "level", axis = 2, value = 3.0 }
texture = { low = 0.2, high = 0.8 }
path = { kind = "still" }
"""
MESH = """
[[bodies]]
shape = { kind = "mesh", file = "%s", open = %s }
texture = { low = 0.2, high = 0.8 }
path = { kind = "line", position = [0, 0, 2], velocity = [1, 0, 0] }
"""
OBJ = {
    "sheet.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "fan.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 -1 1\nf 1 2 3\nf 1 2 4\nf 1 2 5\n",
    "empty.obj": "",
    "points.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "nan.obj": "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "noise.ply": "\x01\x02 not a mesh",
}
SCENES = {
    "wall.toml": WALL,
    "bare.toml": "frames = 4\n",
    "typing.toml": "frame = 4\n" + WALL,
    "syntax.toml": "frames = = 4\n",
    "deep.toml": f"frames = {5000 * '['}",
    "dark.toml": WALL.replace("0.8", "-0.8"),
    "stuck.toml": WALL.replace('"still"', '"stil"'),
    "sensor.toml": "sensor = { f_mod_hz = -1 }\n" + WALL,
    "product.toml": 'sensor = "kinect"\n' + WALL,
    "gone.toml": MESH % ("gone.ply", "false"),
    "moving.toml": MESH % ("sheet.obj", "true"),
    **{f"{name.partition('.')[0]}.mesh.toml": MESH % (name, "false") for name in OBJ},
}
# what follows `gftorf simulate`, exit code, a word of the answer; {scenes} and {out} are folders
BAD = [
    ("slidin", 2, "did you mean sliding"),
    ("{scenes}/none.toml", 3, "none.toml"),
    ("{scenes}/pipe.toml", 3, "a pipe or a device"),
    ("{scenes}/deep.toml", 3, "no TOML file"),
    ("{scenes}", 2, "there is no scene"),
    ("{scenes}/bare.toml", 3, "bodies"),
    ("{scenes}/typing.toml", 3, "did you mean frames?"),
    ("{scenes}/syntax.toml", 3, "line 1"),
    ("{scenes}/dark.toml", 3, "low <= high"),
    ("{scenes}/stuck.toml", 3, "'stil'"),
    ("{scenes}/sensor.toml", 3, "f_mod_hz must be above 0"),
    ("{scenes}/product.toml", 3, "kinect"),
    ("{scenes}/gone.toml --engine mesh", 3, "gone.ply"),
    ("{scenes}/sheet.mesh.toml --engine mesh", 3, "sheet.obj"),
    ("{scenes}/fan.mesh.toml --engine mesh", 3, "fan.obj"),
    ("{scenes}/empty.mesh.toml --engine mesh", 3, "empty.obj"),
    ("{scenes}/points.mesh.toml --engine mesh", 3, "points.obj"),
    ("{scenes}/nan.mesh.toml --engine mesh", 3, "nan.obj"),
    ("{scenes}/noise.mesh.toml --engine mesh", 3, "noise.ply"),
    ("{scenes}/moving.toml", 2, "a mesh that moves"),
    ("demo --override sensor=kinect", 2, "kinect"),
    ("demo --override sensor.f_mod_hz=0", 2, "f_mod_hz must be above 0"),
    ("demo --override sensor.exposure_s=-0.001", 2, "exposure_s"),
    ("demo --override sensor.row_time_s=1e-5 --format capture", 2, "--engine mesh"),
    ("demo --override sensor.row_time_s=1e-5 --engine mesh", 2, "--format capture"),
    (
        "demo --override sensor.row_time_s=1e-5 --engine mesh --format capture --flow",
        2,
        "leave --flow out",
    ),
    ("demo --override sensor.row_time_s=-1e-5", 2, "row_time_s must be 0 or more"),
    ("demo --override sensor.contrast=2", 2, "contrast must be in (0, 1]"),
    ("demo --override sensor.ambient_electrons=-1", 2, "0 or more"),
    ("demo --override sensor.adc_bits=99", 2, "adc_bits"),
    ("demo --override sensor.shifts=0 --format capture", 2, "a phase needs 3 different shifts"),
    ("demo --override sensor.further_hz=6e7", 2, "one modulation frequency"),
    ("demo --override sensor.f_mod=2e7", 2, "did you mean sensor.f_mod_hz?"),
    ("demo --override bodies.7.path.velocity=1,0,0", 2, "no such setting"),
    ("demo --override lens.distortion=0.1,0,0,0,0 --engine mesh", 2, "lens"),
    ("demo --override lens.falloff=nowhere.png", 3, "there is no such file"),
    ("demo --size 0x4", 2, "width and a height"),
    ("demo --size 12", 2, "96x72"),
    ("demo --size 8193x1", 2, "at most 8192 pixels a side"),
    ("tour --size 2x4097", 2, "at most 8192 pixels a side"),
    ("demo --frames -3", 2, "at least 1"),
    ("demo --seed x", 2, "whole number"),
    ("axial --frames 4000", 2, "nearer to the camera"),
    ("demo --level L9", 2, "sync, L0, L1, L2, L3, L4"),
    ("demo --level L1 --ladder", 2, "one level or all"),
    ("demo --engine rays", 2, "gaussian, mesh"),
    ("demo --bounces 1", 2, "--engine"),
    ("demo --override emitter=0.04,0,0", 2, "the light is beside the camera"),
    ("demo --override beam_deg=60,40", 2, "mesh"),
    ("demo --device cuda:99 --engine mesh", 5, "cuda:99"),
    ("demo --format zip", 2, "ftorf, torf, capture"),
    ("demo --format torf --frames 3", 2, "at least 4"),
    ("demo --format torf --flow", 2, "cannot store optical flow"),
    ("demo --truth all", 2, "--engine mesh --format capture"),
    ("demo --truth most", 2, "usual, all"),
    ("demo --paths 0 --engine mesh --bounces 1", 2, "at least 1"),
    ("demo --paths 8 --engine mesh", 2, "--bounces"),
    ("demo --exposure-samples 0", 2, "at least 1"),
]


@pytest.fixture
def scenes(tmp_path):
    """A folder of scene files and meshes, all but one wrong."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    for name, text in {**SCENES, **OBJ}.items():
        (folder / name).write_text(text)
    os.mkfifo(folder / "pipe.toml")  # which nobody writes to
    return folder


def refused(arguments, code, word, capsys):
    """It ends with this code and three lines, one of which has the word, and prints no result."""
    assert main([*arguments, "-q"]) == code
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert not out
    assert word in err, err
    assert [line[:7] for line in lines] == ["error: ", "  why: ", "  fix: "], err


@pytest.mark.parametrize(("line", "code", "word"), BAD, ids=[line for line, _, _ in BAD])
def test_a_wrong_line_ends_in_three_lines_and_writes_nothing(
    line, code, word, scenes, tmp_path, capsys
):
    """Whatever is wrong; the folder and what is unfinished beside it do not appear."""
    size = [] if "--size" in line else ["--size", "8x6"]
    arguments = [
        "simulate",
        *line.format(scenes=scenes).split(),
        *size,
        "--out",
        str(tmp_path / "out" / "seq"),
    ]
    refused(arguments, code, word, capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["scenes"]
    assert {path.name for path in scenes.iterdir()} == {*SCENES, *OBJ, "pipe.toml"}


def test_folders_that_cannot_be_written_stay_as_they_are(scenes, tmp_path, capsys):
    """A file, a folder of something else, a folder below a file, a sequence of other settings."""
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("mine")
    good = ["simulate", str(scenes / "wall.toml"), "--size", "8x6", "--frames", "4"]
    assert main([*good, "--out", str(tmp_path / "seq"), "-q"]) == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for name, more in (
        ("file", []),
        ("folder", []),
        ("folder", ["--fresh"]),
        ("file/seq", []),
        ("seq", ["--sync"]),
    ):
        refused([*good, "--out", str(tmp_path / name), *more], 2, name, capsys)
    refused(good, 2, "--out SEQ", capsys)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
