"""Colour images beside raw quads: pictures, OpenEXR, DNG; their times, lens and poses."""

import cv2
import numpy as np
import pytest
from dng import dng, mosaic
from foreign import FRAMES, keys, recording
from test_import_arrays import exr
from test_import_poses import centre_and_axes, colmap, path_of

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.check import check
from gftorf_warp.errors import InputError
from gftorf_warp.importers.colour_images import read_colour, reduced
from gftorf_warp.importers.command import read_recording

H, W = 8, 10
RATE = 120.0
RIG = np.array([[0, 0, 1, 0.1], [0, 1, 0, -0.02], [-1, 0, 0, 0.03], [0, 0, 0, 1.0]])
LENS = {"colour__fx": 9.0, "colour__fy": 9.5, "colour__cx": 4.5, "colour__cy": 3.5}
KEYS = {"colour__files": "c/*", "colour__rate_hz": 30, "colour__encoding": "srgb", **LENS}


def picture(seed=0):
    """A colour image of 8 bits, red first."""
    return np.random.default_rng(seed).integers(0, 256, (H, W, 3), dtype=np.uint8)


def recorded(root, colour, **changes):
    """A recording with three colour images, written by ``colour(path, n)``, and its keys."""
    quads = root / "quads"
    (quads / "c").mkdir(parents=True, exist_ok=True)
    for n, image in enumerate(recording()[1]):
        np.save(quads / f"{n}.npy", image)
    for n in range(3):
        colour(quads / "c", n)
    given = {"values__zero": 0, "time__rate_hz": RATE, "source__files": "*.npy", **KEYS}
    matrix = {"colour__tof_from_colour": RIG.tolist()}
    (root / "keys.toml").write_text(keys(**given | matrix | changes))
    return quads, root / "keys.toml"


def png(folder, n):
    """A picture of 8 bits."""
    assert cv2.imwrite(str(folder / f"{n}.png"), picture(n)[..., ::-1])


def test_pictures_become_linear(tmp_path):
    """By the definition of sRGB, linear numbers as they are, 16 bits, an alpha channel ignored."""
    codes = picture() / 255
    curved = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    png(tmp_path, 0)
    np.testing.assert_allclose(read_colour(tmp_path / "0.png", "srgb", "none"), curved, atol=1e-6)
    linear = read_colour(tmp_path / "0.png", "linear", "none")
    np.testing.assert_allclose(linear, codes, atol=1e-6)
    deep = np.dstack([(picture()[..., ::-1].astype(np.uint16) * 257), np.full((H, W), 7, "u2")])
    assert cv2.imwrite(str(tmp_path / "1.tiff"), deep)
    np.testing.assert_allclose(read_colour(tmp_path / "1.tiff", "linear", "none"), codes, atol=1e-6)
    red, green, blue = np.moveaxis(picture() / 50.0, -1, 0)
    exr(tmp_path / "2.exr", R=red, G=green, B=blue, Z=red)
    found = read_colour(tmp_path / "2.exr", "srgb", "none")
    np.testing.assert_allclose(found, picture() / 50.0, rtol=1e-6)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("neutral", [(1.0, 1.0, 1.0), (0.5, 1.0, 0.8)])
def test_a_raw_file_is_linear(pattern, neutral, tmp_path):
    """Black and white level, every Bayer pattern, white balance; not turned, and not brightened:
    half the light is half the number.
    """
    rgb = np.empty((24, 32, 3))
    rgb[:, :16], rgb[:, 16:] = (0.5, 0.25, 0.125), (0.1, 0.2, 0.4)
    for light in (1.0, 0.5):
        codes = np.rint(mosaic(light * rgb * neutral, pattern) * 59000 + 1000)
        path = tmp_path / "a.dng"
        path.write_bytes(dng(codes, pattern, 1000, 60000, neutral, turned=6))
        image = read_colour(path, "linear", "camera")
        assert image.shape == rgb.shape
        for x in (6, 25):
            np.testing.assert_allclose(image[12, x], light * rgb[12, x], atol=2e-4)


def test_no_white_balance(tmp_path):
    """The numbers of the sensor."""
    path = tmp_path / "a.dng"
    path.write_bytes(dng(np.full((24, 32), 30000), neutral=(0.5, 1.0, 0.8)))
    found = read_colour(path, "linear", "none")[12, 16]
    np.testing.assert_allclose(found, 30000 / 65535, atol=1e-4)


def test_a_reduced_image_is_a_mean():
    """Of whole blocks; what is left over is cut off."""
    image = np.arange(5 * 7 * 3, dtype=np.float32).reshape(5, 7, 3)
    small = reduced(image, 2)
    assert small.shape == (2, 3, 3)
    np.testing.assert_allclose(small[1, 2], image[2:4, 4:6].mean(axis=(0, 1)))
    with pytest.raises(ValueError, match="reduced"):
        reduced(image, 6)


def test_colour_fixed_to_the_camera(tmp_path):
    """Every image goes to its nearest raw frame; its camera is the rig's at the image's time; the
    capture has it all.
    """
    quads, config = recorded(tmp_path, png, colour__delay_s=0.001)
    line = f"import arrays {quads} --config {config} --out {tmp_path / 'seq'}"
    assert main(line.split()) == 0
    found = Sequence.open(tmp_path / "seq")
    assert sorted(found.colour.images) == [0, 4, 8]
    codes = picture(1) / 255
    curved = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(found.colour.images[4], curved, atol=1e-6)
    assert (found.colour.intrinsics.cx, found.colour.intrinsics.fy) == (5.0, 9.5)
    # a point one metre before the ToF camera, in coordinates of the colour camera
    seen = found.colour.camera_from_world[3] @ [0, 0, 1, 1]
    np.testing.assert_allclose(RIG @ seen, [0, 0, 1, 1], atol=1e-12)
    check(tmp_path / "seq")
    imported = read_recording("arrays", quads, config)
    assert any("up to 1 ms away" in text for text in imported.uncertain)


def test_poses_of_the_colour_camera_move_the_tof_camera(tmp_path):
    """COLMAP saw the colour images; the rig says where the ToF camera was."""
    path = path_of(3)
    quads, config = recorded(tmp_path, png)
    more = colmap(tmp_path, path)
    more = {name.replace("poses__", "colour__poses__"): value for name, value in more.items()}
    recorded(tmp_path, png, **more)
    found = read_recording("arrays", quads, config).sequence
    for image, frame in enumerate((0, 4, 8)):
        colour_pose = found.colour.camera_from_world[frame]
        np.testing.assert_allclose(colour_pose, path[image], atol=1e-9)
        centre = centre_and_axes(found.camera_from_world[frame])[0]
        offset = path[image] @ [*centre, 1]  # of the ToF camera, for the colour camera
        np.testing.assert_allclose(RIG @ offset, [0, 0, 0, 1], atol=1e-9)
    assert len(found.camera_from_world) == FRAMES
    recorded(tmp_path, png, **more, colour__delay_s=0.003)
    late = read_recording("arrays", quads, config).sequence
    for image, frame in enumerate((0, 4, 8)):  # the pose of the image, not that of the raw frame
        np.testing.assert_allclose(late.colour.camera_from_world[frame], path[image], atol=1e-9)
    assert np.abs(late.camera_from_world[4] - found.camera_from_world[4]).max() > 1e-3


def test_raw_files_of_a_recording(tmp_path):
    """DNG, reduced, with times of their own; an image far from the recording is left out."""

    def write(folder, n):
        (folder / f"{n}.dng").write_bytes(dng(np.full((24, 32), 5000 * (n + 1))))

    (tmp_path / "t.csv").write_text("5000\n5033.3333\n9000\n")
    more = {"time_file": "t.csv", "time_unit": "ms", "time_start_s": 5.0, "reduce": 2}
    more |= {"rate_hz": None, "encoding": None, "fx": 40.0, "fy": 40.0}
    quads, config = recorded(tmp_path, write, **{f"colour__{k}": v for k, v in more.items()})
    found = read_recording("arrays", quads, config)
    assert sorted(found.sequence.colour.images) == [0, 4]
    image = found.sequence.colour.images[4]
    assert image.shape == (12, 16, 3)
    np.testing.assert_allclose(image[6, 8], 10000 / 65535, atol=1e-4)
    assert found.sequence.colour.intrinsics.fx == 20.0
    assert any("1 colour images are left out" in text for text in found.uncertain)


BAD = [  # changed keys, a word of the error
    ({"colour__encoding": None}, "colour.encoding"),
    ({"colour__rate_hz": None}, "colour.rate_hz"),
    ({"colour__files": None}, "nothing without colour.files"),
    ({"colour__fx": None, "values__zero": None}, "2 keys are missing"),
    ({"colour__tof_from_colour": None}, "or colour.poses.file"),
    (
        {"colour__tof_from_colour": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
        "rotation",
    ),
    ({"colour__poses__file": "p.txt"}, "colour.poses.form"),
    ({"colour__files": "d/*.png"}, "no file of"),
    ({"colour__files": "../keys.toml"}, "a link out of"),
    ({"colour__files": "0.npy"}, "raw file of a camera"),
    ({"colour__delay_s": 7}, "no colour"),
    ({"colour__reduce": 9}, "cannot be reduced"),
    ({"colour__time_file": "t.csv", "colour__rate_hz": None}, "colour.time_start_s"),
    ({"colour__distortion": [0.1, 0, 0, 0, 0]}, "undistort"),
    ({"colour__fx": 0.1}, "colour.fx"),
]


@pytest.mark.parametrize(("changes", "word"), BAD)
def test_bad_keys_of_colour_are_named(changes, word, tmp_path):
    """Missing, contradicting, of other files."""
    quads, config = recorded(tmp_path, png, **changes)
    with pytest.raises(InputError) as error:
        read_recording("arrays", quads, config)
    assert word in str(error.value)


def test_bad_colour_images_are_named(tmp_path):
    """Grey, of another size, cut off, or another thing."""
    bad = {"1.png": cv2.imencode(".png", np.ones((H, W), np.uint8))[1].tobytes()}
    bad["a.png"] = cv2.imencode(".png", np.ones((H, W + 1, 3), np.uint8))[1].tobytes()
    bad["a.dng"] = dng(np.ones((24, 32)))[:400]
    bad["a.cr2"] = b"II*\0" + bytes(50)
    for name, content in bad.items():
        quads, config = recorded(tmp_path, png, colour__rate_hz=60)
        (quads / "c" / name).write_bytes(content)
        with pytest.raises(InputError) as error:
            read_recording("arrays", quads, config)
        assert name in str(error.value)
        (quads / "c" / name).unlink()


def test_a_flipped_bit_of_a_raw_file_never_crashes(tmp_path):
    """Another image, or a named error."""
    whole, rng = dng(np.full((24, 32), 30000)), np.random.default_rng(2)
    path, refused = tmp_path / "a.dng", 0
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, 400, 2):
            data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            read_colour(path, "linear", "camera")
        except InputError as error:
            refused += "a.dng" in error.where
    assert refused > 3
