"""Buffers of Melexis sensors as V4L2 dumps them, packed here pixel by pixel."""

import struct

import numpy as np
import pytest
import wall

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers.command import read_recording

SHIFTS = (0, 180, 90, 270)
TIMES = "[time]\nrate_hz = 40\nexposure_s = 0.001\n"


def stored(values, form):
    """An image of codes 0 .. 4095 as bytes, pixel by pixel."""
    pixels = [int(v) & 0xFFF for v in values.ravel()]
    if form == "Y12P":
        pairs = zip(pixels[::2], pixels[1::2], strict=True)
        return b"".join(bytes([a >> 4, b >> 4, (b & 15) * 16 + (a & 15)]) for a, b in pairs)
    shift = 4 if form == "Y16" else 0
    return b"".join(struct.pack("<H", v << shift) for v in pixels)


def keys(tmp_path, raw="", sensor="", form="Y12", rest=TIMES):
    """A TOML file of keys for images of 16x12."""
    path = tmp_path / "keys.toml"
    head = f"[raw]\nformat = '{form}'\nsize = [16, 12]\n{raw}\n"
    path.write_text(f"{head}[sensor]\nf_mod_hz = 20e6\n{sensor}\n{rest}{wall.LENS}")
    return path


@pytest.mark.parametrize("form", ["Y12", "Y12P", "Y16"])
def test_signed_differences_are_bit_equal(form, tmp_path):
    """A - B in every pixel format, of which the lowest and highest code are counted."""
    values = np.random.default_rng(3).integers(-2047, 2047, (8, 12, 16))
    values[2, 3, 4], values[5, 0, 0] = 2047, -2048
    (tmp_path / "dump.raw").write_bytes(b"".join(stored(v, form) for v in values))
    imported = read_recording("mlx7502x", tmp_path / "dump.raw", keys(tmp_path, form=form))
    np.testing.assert_array_equal(imported.sequence.quads, values)
    assert np.degrees(imported.sequence.shifts[:5]).round().tolist() == [0, 180, 90, 270, 0]
    assert imported.sequence.exposures.tolist() == [0.001] * 8
    assert any(line.startswith("2 codes") for line in imported.uncertain)


def test_a_dump_decodes_to_its_scene(tmp_path):
    """Files of one buffer each, in natural order, imported, checked and decoded."""
    distance = wall.distance()
    folder = tmp_path / "dump"
    folder.mkdir()
    for n, values in enumerate(np.round(wall.quads(distance, SHIFTS, frames=12))):
        (folder / f"frame{n}.raw").write_bytes(stored(values, "Y12P"))
    out, config = tmp_path / "capture", keys(tmp_path, form="Y12P")
    line = ["import", "mlx7502x", str(folder), "--out", str(out), "--config", str(config)]
    assert main(line) == 0
    assert main(["check", str(out)]) == 0
    assert wall.largest_error(out, distance, quartet=2) < 0.01
    np.testing.assert_allclose(Sequence.open(out).times, np.arange(12) / 40)


def test_poses_of_a_file_move_the_camera(tmp_path):
    """A trajectory beside the keys, interpolated at the times of the buffers."""
    (tmp_path / "poses.txt").write_text("5 0 0 0 0 0 0 1\n6 2 0 0 0 0 0 1\n")
    (tmp_path / "dump").write_bytes(bytes(8 * 384))
    poses = "[poses]\nfile = 'poses.txt'\nform = 'tum'\nstart_s = 5\n"
    config = keys(tmp_path, rest=TIMES + poses)
    imported = read_recording("mlx7502x", tmp_path / "dump", config)
    moved = imported.sequence.camera_from_world[:, 0, 3]
    np.testing.assert_allclose(moved, -2 * np.arange(8) / 40, atol=1e-9)
    assert not any("at rest" in line for line in imported.understood)


@pytest.mark.parametrize("mode", ["A", "B", "A&B halves", "A&B columns"])
def test_taps_give_the_same_distance(mode, tmp_path):
    """One tap with ambient light, or both, which is removed by their difference."""
    mode, _, both = mode.partition(" ")
    distance = wall.distance()
    a = np.round(wall.quads(distance, SHIFTS, frames=4, offset=1500))
    b = np.round(wall.quads(distance, [s + 180 for s in SHIFTS], frames=4, offset=1500))
    images = {"A": a, "B": b, "A&B": np.concatenate([a, b], axis=2)}[mode]
    if both == "columns":
        images = np.stack([a, b], axis=3).reshape(4, 12, 32)
    (tmp_path / "dump").write_bytes(b"".join(stored(v, "Y12") for v in images))
    raw = f"output_mode = '{mode}'\n" + (f"both = '{both}'" if both else "")
    out = tmp_path / "capture"
    line = ["import", "mlx7502x", str(tmp_path / "dump"), "--out", str(out), "--config"]
    assert main([*line, str(keys(tmp_path, raw))]) == 0
    assert wall.largest_error(out, distance) < 0.01
    assert Sequence.open(out).width == 16


def test_padding_of_rows_and_buffers_is_skipped(tmp_path):
    """As bytesperline and sizeimage of V4L2 say."""
    values = np.random.default_rng(4).integers(-2047, 2047, (4, 12, 16))
    rows = [stored(row, "Y12") + b"\xff" * 8 for image in values for row in image]
    padded = [b"".join(rows[12 * n : 12 * n + 12]) + b"\xee" * 20 for n in range(4)]
    (tmp_path / "dump").write_bytes(b"".join(padded))
    config = keys(tmp_path, "bytesperline = 40\nsizeimage = 500")
    imported = read_recording("mlx7502x", tmp_path / "dump", config)
    np.testing.assert_array_equal(imported.sequence.quads, values)


def test_a_sign_repeated_above_twelve_bits_is_accepted(tmp_path):
    """Some receivers extend it to 16 bits."""
    values = np.random.default_rng(5).integers(-2048, 2048, (4, 12, 16))
    (tmp_path / "dump").write_bytes(values.astype("<i2").tobytes())
    imported = read_recording("mlx7502x", tmp_path / "dump", keys(tmp_path))
    np.testing.assert_array_equal(imported.sequence.quads, values)


WHOLE = 4 * 16 * 12 * 2  # bytes of four buffers of Y12


@pytest.mark.parametrize(
    ("content", "changes", "word"),
    [
        (b"", {}, "buffers of 384 bytes"),
        (bytes(WHOLE - 1), {}, "not whole buffers"),
        (bytes(5 * 288), {"form": "Y16"}, "whole buffers of Y12P"),
        (b"\xff\x1f" * (WHOLE // 2), {}, "leaves at 0"),
        (b"\x01\x00" * (WHOLE // 2), {"form": "Y16"}, "leaves at 0"),
        (bytes(WHOLE), {"form": "Y10"}, "one of Y12, Y12P, Y16"),
        (bytes(WHOLE), {"raw": "bytesperline = 16"}, "VIDIOC_G_FMT"),
        (bytes(WHOLE), {"raw": "sizeimage = 99"}, "VIDIOC_G_FMT"),
        (bytes(WHOLE), {"raw": "output_mode = 'A+B'"}, "one of A-B, A, B, A&B"),
        (bytes(WHOLE), {"raw": "output_mode = 'A&B'"}, r"raw\.both"),
        (bytes(WHOLE), {"sensor": "shifts_deg = [0, 180]"}, "three or more"),
        (bytes(WHOLE), {"rest": ""}, r"time\.rate_hz"),
        (bytes(WHOLE), {"raw": "depth = 3"}, "unknown key raw.depth"),
    ],
)
def test_what_does_not_fit_is_a_named_error(content, changes, word, tmp_path):
    """Sizes, formats, modes and keys."""
    (tmp_path / "dump").write_bytes(content)
    with pytest.raises(InputError, match=word):
        read_recording("mlx7502x", tmp_path / "dump", keys(tmp_path, **changes))


def test_a_packed_row_has_an_even_number_of_columns(tmp_path):
    """Half a byte is no end of a row."""
    (tmp_path / "dump").write_bytes(bytes(90))
    path = keys(tmp_path, form="Y12P")
    path.write_text(path.read_text().replace("[16, 12]", "[15, 4]"))
    with pytest.raises(InputError, match="even number of columns"):
        read_recording("mlx7502x", tmp_path / "dump", path)


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    """It is no part of the recording."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "dump").write_bytes(bytes(WHOLE))
    (tmp_path / "folder" / "dump").symlink_to(tmp_path / "dump")
    with pytest.raises(InputError, match="a link out of the folder"):
        read_recording("mlx7502x", tmp_path / "folder", keys(tmp_path))


def test_without_keys_all_are_asked_for(tmp_path):
    """By name, in one error."""
    (tmp_path / "dump").write_bytes(bytes(WHOLE))
    with pytest.raises(UsageError) as error:
        read_recording("mlx7502x", tmp_path / "dump")
    for name in ("raw.format", "raw.size", "sensor.f_mod_hz", "time.rate_hz", "camera.fx"):
        assert name in str(error.value), name
