"""Kinect v2 dumps of libfreenect2, written by tests/kinect2_dump.py."""

import kinect2_dump as dump
import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.decode import closed_form_distance, quartet_phasors
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers import kinect2_packets as packets
from gftorf_warp.importers.command import read_recording


def test_codes_are_where_the_writer_put_them():
    """Every code of nine images, and the value of each code."""
    codes = np.random.default_rng(1).integers(0, 2048, (9, dump.HEIGHT, dump.WIDTH))
    content = np.frombuffer(dump.packet(codes), np.uint8)
    assert len(content) == packets.PACKET_BYTES
    np.testing.assert_array_equal(packets.codes(content), codes)
    np.testing.assert_array_equal(packets.usual_values(), dump.value_of_code())


def test_the_lens_is_found_in_its_tables():
    """Focal lengths, principal point and distortion, from tables of float32."""
    x, z = (np.frombuffer(table, "<f4").reshape(dump.HEIGHT, dump.WIDTH) for table in dump.tables())
    lens = packets.lens(x, z)
    for name, value in dump.LENS.items():
        assert getattr(lens, name) == pytest.approx(value, abs=0.01), name
    np.testing.assert_allclose(lens.distortion, dump.DISTORTION, atol=1e-4)


def test_a_dump_decodes_to_its_scene(tmp_path, capsys):
    """Import, check, and the closed form of three frequencies, beyond the range of two of them."""
    dump.write(tmp_path / "dump", packets=2)
    out = tmp_path / "capture"
    assert main(["import", "kinect2", str(tmp_path / "dump"), "--out", str(out)]) == 0
    assert main(["check", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "80, 16, 120 MHz" in printed
    sequence = Sequence.open(out)
    assert (sequence.frames, sequence.cycle) == (18, 9)
    np.testing.assert_allclose(sequence.times[[0, 2, 3, 6, 9]] * 30, [0, 0, 0.3, 0.6, 1])
    distance, _ = dump.scene()
    error = np.abs(closed_form_distance(sequence, 1) - distance)[:, 1:-1]
    assert error.mean() < 2e-3
    assert error.max() < 2e-2  # steps of the codes, at 4.4 m


def phase_of_libfreenect2(content, steps, f, x, y):
    """Phase of a pixel as libfreenect2 decodes it; its y counts from the last row of the image."""
    cosine = sine = 0.0
    for k in range(3):
        first = 298496 * (3 * f + k) + 704 * (y + 212 if y < 212 else 423 - y)
        line = int.from_bytes(content[first : first + 704], "little")
        code = line >> (11 * ((x >> 2) + ((x & 3) << 7))) & 2047
        angle = -0.000031 * np.pi * steps[f, 423 - y, x] + (0, 2.094395, 4.18879)[k]
        cosine += np.cos(angle) * dump.value_of_code()[code]
        sine -= np.sin(angle) * dump.value_of_code()[code]
    return np.arctan2(sine, cosine)


def test_phases_are_those_of_libfreenect2(tmp_path):
    """At pixels of both halves and of all four positions in a group."""
    dump.write(tmp_path / "dump")
    content = (tmp_path / "dump" / "packet9.bin").read_bytes()
    sequence = read_recording("kinect2", tmp_path / "dump").sequence
    _, steps = dump.scene()
    for f, (_, (re, im)) in enumerate(quartet_phasors(sequence, 0)):
        for x, y in ((5, 3), (102, 50), (300, 211), (301, 212), (450, 400), (256, 423)):
            phase = phase_of_libfreenect2(content, steps, f, x, y)
            error = np.angle(np.exp(1j * (np.arctan2(im, re)[423 - y, x] - phase)))
            assert abs(error) < 1e-4, (f, x, y)


def test_a_table_of_its_own_and_stated_intrinsics_replace_what_is_usual(tmp_path):
    """The lookup table of the dump is used, and keys where the X and Z tables are missing."""
    codes = dump.write(tmp_path / "dump", tables_too=False, lookup=True)
    doubled = 2 * np.minimum(dump.value_of_code(), 16000)
    (tmp_path / "dump" / "lut.bin").write_bytes(doubled.astype("<i2").tobytes())
    with pytest.raises(UsageError, match=r"camera\.fx"):
        read_recording("kinect2", tmp_path / "dump")
    keys = tmp_path / "keys.toml"
    keys.write_text("[camera]\nfx = 365\nfy = 366\ncx = 257\ncy = 204\n")
    imported = read_recording("kinect2", tmp_path / "dump", keys)
    assert imported.sequence.intrinsics.cx == 257.0
    _, steps = dump.scene()
    value = doubled[codes[6:, 100, 200]].astype(float)
    phasor = 2 / 3 * (value * np.exp(-2j * np.pi / 3 * np.arange(3))).sum()
    turned = phasor * np.exp(1j * 3.1e-5 * np.pi * steps[2, 100, 200])
    quads = value.mean() + (turned * np.exp(2j * np.pi / 3 * np.arange(3))).real
    np.testing.assert_allclose(imported.sequence.quads[6:, 100, 200], quads, rtol=1e-4)


def test_saturated_pixels_take_another_packet_and_edges_are_empty(tmp_path):
    """One full raw frame replaces the three of its frequency, no others."""
    codes = dump.write(tmp_path / "dump")
    full = codes.copy()
    full[4, 300, 17] = full[4, 300, 18] = 1024
    codes[1, 300, 18] = 1024
    packets = dump.packet(full) + dump.packet(codes)
    (tmp_path / "dump" / "packet9.bin").write_bytes(packets)
    imported = read_recording("kinect2", tmp_path / "dump")
    first, second = imported.sequence.quads.reshape(2, 9, dump.HEIGHT, dump.WIDTH)[:, :, 300, 17]
    np.testing.assert_array_equal(first, second)
    assert (first != 0).all()
    first, second = imported.sequence.quads.reshape(2, 9, dump.HEIGHT, dump.WIDTH)[:, :, 300, 18]
    np.testing.assert_array_equal(first, second)
    assert (imported.sequence.quads[..., [0, 511]] == 0).all()
    assert any("3 times a pixel is saturated" in line for line in imported.uncertain)


def spoiled(folder, name):
    """A dump with one thing wrong with it."""
    p0, x, packet = ((folder / n).read_bytes() for n in ("p0.bin", "x.bin", "packet9.bin"))
    if name == "no packet":
        (folder / "packet9.bin").unlink()
    elif name == "truncated packet":
        (folder / "packet9.bin").write_bytes(packet[:-1])
    elif name == "no p0":
        (folder / "p0.bin").unlink()
    elif name == "two p0":
        (folder / "p0 again.bin").write_bytes(p0)
    elif name == "truncated p0":
        (folder / "p0.bin").write_bytes(p0[:-2])
    elif name == "quarter of x":
        (folder / "x.bin").write_bytes(x[: len(x) // 4])
    elif name == "half of the lookup table":
        (folder / "lut.bin").write_bytes(bytes(2048))
    elif name == "x twice":
        (folder / "z.bin").write_bytes(x)
    elif name == "empty tables":
        (folder / "x.bin").write_bytes(bytes(len(x)))
    elif name == "damaged tables":
        (folder / "x.bin").write_bytes(np.random.default_rng(0).bytes(len(x)))
    elif name == "three tables":
        (folder / "y.bin").write_bytes(x)
    elif name == "a folder for a packet":
        (folder / "packet9.bin").unlink()
        (folder / "packet9.bin").mkdir()
    elif name == "a link to nothing":
        (folder / "packet9.bin").unlink()
        (folder / "packet9.bin").symlink_to("nothing")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A dump that is right."""
    folder = tmp_path_factory.mktemp("kinect2") / "dump"
    dump.write(folder)
    return folder


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("no packet", "packets"),
        ("truncated packet", "multiple of 2984960 bytes"),
        ("no p0", "P0 tables"),
        ("two p0", "p0 again.bin"),
        ("truncated p0", r"p0.bin \(1302570\)"),
        ("quarter of x", "number of values, not of bytes"),
        ("half of the lookup table", "number of values, not of bytes"),
        ("x twice", "X and Z tables"),
        ("empty tables", "X and Z tables"),
        ("damaged tables", "X and Z tables"),
        ("three tables", "X and Z tables"),
        ("a folder for a packet", "packets"),
        ("a link to nothing", "packets"),
    ],
)
def test_a_wrong_dump_is_a_named_error(good, tmp_path, name, word):
    """What, where, why and what to do."""
    folder = tmp_path / "dump"
    folder.mkdir()
    for path in good.iterdir():  # the files are not changed, but replaced
        (folder / path.name).write_bytes(path.read_bytes())
    spoiled(folder, name)
    with pytest.raises(InputError, match=word):
        read_recording("kinect2", folder)
