"""Lenses of OpenCV, ROS, COLMAP and nerfstudio files, each written as its program defines it."""

import json

import cv2
import numpy as np
import pytest

from gftorf_warp.errors import InputError
from gftorf_warp.importers import camera_keys
from gftorf_warp.importers.imported import Notes
from gftorf_warp.importers.keys import load, template
from gftorf_warp.importers.lens_files import read_lens

FX, FY, CX, CY = 20.5, 21.25, 8.5, 6.125  # pixel centres at i + 0.5
LENS = (0.1, -0.02, 0.003, 0.004, 0.05)
SIZE = (16, 12)
MATRIX = np.array([[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]])  # OpenCV's centres
ROS = """image_width: 16
image_height: 12
camera_name: tof
camera_matrix:
  rows: 3
  cols: 3
  data: [20.5, 0.0, 8.0, 0.0, 21.25, 5.625, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.02, 0.003, 0.004, 0.05]
"""


def opencv(path, matrix="camera_matrix", lens="distortion_coefficients", coefficients=LENS):
    """A calibration as OpenCV's sample writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write(matrix, MATRIX)
    storage.write(lens, np.array(coefficients))
    storage.release()
    return path


def colmap(path, model="FULL_OPENCV", parameters=(FX, FY, CX, CY, *LENS[:4], LENS[4], 0, 0, 0)):
    """cameras.txt with two cameras."""
    values = " ".join(map(str, parameters))
    text = "# Camera list with one line of data per camera:\n1 PINHOLE 640 480 500 500 320 240\n"
    path.write_text(f"{text}2 {model} 16 12 {values}\n")
    return path


def nerfstudio(path, **changes):
    """transforms.json with the lens of all images."""
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = dict(zip(names, (FX, FY, CX, CY, *LENS), strict=True))
    content = {"camera_model": "OPENCV", "w": 16, "h": 12, **values, "frames": [], **changes}
    path.write_text(json.dumps(content))
    return path


def lens_of(path, text="", width=SIZE[0]):
    """Intrinsics with the file named by a TOML file."""
    config = path.parent / "keys.toml"
    config.write_text(f"[camera]\nfile = '{path.name}'\n{text}")
    notes = Notes()
    settings = load(config, camera_keys.KEYS)
    return camera_keys.intrinsics_of(settings, notes, width, root=path, height=SIZE[1]), notes


@pytest.mark.parametrize("name", ["a.yaml", "b.xml", "c.json", "ros.yaml", "cameras.txt", "t.json"])
def test_a_lens_of_any_file(name, tmp_path):
    """The same numbers in the same convention; a projected point is where OpenCV has it."""
    path, more = tmp_path / name, ""
    if name == "ros.yaml":
        path.write_text(ROS)
    elif name == "cameras.txt":
        colmap(path)
        more = "number = 2\n"
    elif name == "t.json":
        nerfstudio(path)
    else:
        opencv(path)
    lens, notes = lens_of(path, more)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (FX, FY, CX, CY)
    assert lens.distortion == LENS
    point = np.array([[[0.3, -0.2, 1.5]]])
    seen = cv2.projectPoints(point, np.zeros(3), np.zeros(3), MATRIX, np.array(LENS))[0].ravel()
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    ours = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))
    np.testing.assert_allclose(ours[0].ravel(), seen + 0.5, atol=1e-12)
    assert any(path.name in line for line in notes.understood)


def test_a_template_leaves_pixel_centres_to_the_file_of_the_lens(tmp_path):
    """COLMAP counts from corners, whatever typed numbers do by default."""
    colmap(tmp_path / "cameras.txt")
    given = "file = 'cameras.txt'\nnumber = 2\n"
    text = template("any", camera_keys.KEYS).replace("[camera]\n", f"[camera]\n{given}")
    (tmp_path / "keys.toml").write_text(text)
    settings = load(tmp_path / "keys.toml", camera_keys.KEYS)
    lens = camera_keys.intrinsics_of(settings, Notes(), 16)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (FX, FY, CX, CY)


def test_other_names_and_fewer_coefficients(tmp_path):
    """K and D; four coefficients may be a fisheye's; none are a pinhole; COLMAP's one focal
    length.
    """
    lens, notes = lens_of(opencv(tmp_path / "a.yml", "K", "D", LENS[:4]))
    assert lens.distortion == (*LENS[:4], 0)
    assert "fisheye" in notes.uncertain[0]
    assert lens_of(opencv(tmp_path / "b.yml", "M1", "D1", [0.0] * 5))[0].distortion is None
    found = read_lens(colmap(tmp_path / "c.txt", "SIMPLE_RADIAL", (FX, CX, CY, 0.1)), 2)
    assert found.values["fx"] == found.values["fy"] == FX
    assert found.distortion == (0.1, 0, 0, 0, 0)
    stated = lens_of(opencv(tmp_path / "d.yml"), "pixel_centre = 'half'\n")[0]
    assert stated.cx == CX - 0.5


BAD = [  # file, what it contains, further keys, a word of the error
    ("a.yaml", "", "", "named camera_matrix"),
    ("a.yaml", "camera_matrix: 3", "", "named camera_matrix"),
    ("a.yaml", "K: [1, 2, 3]", "", "named camera_matrix"),
    ("a.yaml", "K: [20, 0, 8, 0, 20, 6, 0, 0, 1]\nD: [0, 0, 0, 0, 0, 1.5]", "", "'k4': 1.5"),
    ("a.yaml", "K: [20, 1.5, 8, 0, 20, 6, 0, 0, 1]", "", "'skew': 1.5"),
    ("a.yaml", "K: [1, 0, 3", "", "as cv2.FileStorage writes it"),
    ("a.yaml", b"\xff\xfe", "", "expected text"),
    ("a.xml", "<?xml version='1.0'?><a>", "", "as cv2.FileStorage writes it"),
    ("a.json", "{", "", "no JSON"),
    ("a.json", '["fl_x"]', "", "JSON object"),
    ("a.json", '{"K": 3}', "", "named camera_matrix"),
    ("a.json", '{"fl_x": 3}', "", "fl_y"),
    ("a.json", '{"fl_x": "3", "fl_y": 3, "cx": 1, "cy": 1}', "", "numbers"),
    ("cameras.txt", "", "", "lines of numbers"),
    ("cameras.txt", "1 OPENCV_FISHEYE 16 12 1 1 1 1 0 0 0 0", "", "line 1"),
    ("cameras.txt", "1 PINHOLE 16 12 20 20 8", "", "line 1"),
    ("cameras.txt", "1 PINHOLE 16 12 20 20 8 x", "", "line 1"),
    ("cameras.txt", "1 PINHOLE", "", "line 1"),
    ("cameras.txt", "1 PINHOLE 16 12 20 20 8 6\n2 PINHOLE 16 12 20 20 8 6", "", "one camera"),
    ("cameras.txt", "1 PINHOLE 16 12 20 20 8 6", "number = 7\n", "camera 7"),
    ("cameras.txt", "1 PINHOLE 32 24 20 20 8 6", "", "images of 32x24"),
    ("cameras.txt", "1 PINHOLE 16 12 20 20 8 6", "fx = 3\n", "both state the lens"),
    ("cameras.txt", "1 PINHOLE 16 12 0.2 20 8 6", "", "pixels"),
    ("cameras.txt", "1 PINHOLE 16 12 nan 20 8 6", "", "finite"),
    ("cameras.txt", "1 FULL_OPENCV 16 12 20 20 8 6 0 0 0 0 0 1 0 0", "", "'k4': 1.0"),
]


@pytest.mark.parametrize(("name", "content", "more", "word"), BAD)
def test_a_file_that_is_no_lens_is_named(name, content, more, word, tmp_path, capfd):
    """Damage, other models, other sizes, contradictions."""
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        lens_of(path, more)
    assert word in str(error.value)
    assert capfd.readouterr().err == "", "OpenCV's own messages"


def test_a_flipped_bit_of_a_lens_never_crashes(tmp_path):
    """Another lens, or a named error."""
    rng, refused = np.random.default_rng(1), []
    files = opencv(tmp_path / "a.yaml"), opencv(tmp_path / "b.xml"), nerfstudio(tmp_path / "c.json")
    for path in files:
        whole = path.read_bytes()
        for _ in range(40):
            data = bytearray(whole)
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            path.write_bytes(data)
            try:
                read_lens(path)
            except InputError as error:
                refused.append(error.where)
    assert {str(path) for path in files} == set(refused)
