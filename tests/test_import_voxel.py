"""Recordings of the TI Voxel SDK, written by tests/vxl.py."""

import numpy as np
import pytest
import vxl
import wall

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers.command import read_recording

SHIFTS = (0, 90, 180, 270)
SENSOR = "[sensor]\nf_mod_hz = 20e6\n"
SLOTS = "[time]\nslot_period_s = 0.01\n"


def keys(tmp_path, text=SENSOR + SLOTS):
    """A TOML file of these keys and a lens."""
    path = tmp_path / "keys.toml"
    path.write_text(text + wall.LENS)
    return path


def of(tmp_path, content, text=SENSOR + SLOTS):
    """The import of a file of this content."""
    (tmp_path / "a.vxl").write_bytes(content)
    return read_recording("voxel", tmp_path / "a.vxl", keys(tmp_path, text))


@pytest.mark.parametrize("wide", [False, True])
def test_quads_are_bit_equal(wide, tmp_path):
    """Signed numbers of 12 bits, counts of 4 and of 8 bytes, times of frames and slots."""
    values = np.random.default_rng(2).integers(-2048, 2048, (3, 4, vxl.HEIGHT, vxl.WIDTH))
    imported = of(tmp_path, vxl.content(values, wide))
    quads = imported.sequence.quads
    np.testing.assert_array_equal(quads, values.reshape(12, vxl.HEIGHT, vxl.WIDTH))
    np.testing.assert_allclose(imported.sequence.times[[0, 1, 4, 7]], [0, 0.01, 0.05, 0.08])
    assert np.degrees(imported.sequence.shifts[:4]).round().tolist() == list(SHIFTS)


def test_a_recording_decodes_to_its_scene(tmp_path):
    """Imported, checked and decoded; three quads as well as four."""
    distance = wall.distance()
    for count in (4, 3):
        shifts = [360 * k / count for k in range(count)]
        quads = np.round(wall.quads(distance, shifts, frames=2 * count)).reshape(2, count, 12, 16)
        source, out = tmp_path / f"{count}.vxl", tmp_path / f"capture{count}"
        source.write_bytes(vxl.content(quads, quadCount=count))
        line = ["import", "voxel", str(source), "--out", str(out), "--config"]
        assert main([*line, str(keys(tmp_path))]) == 0
        assert main(["check", str(out)]) == 0
        assert Sequence.open(out).cycle == count
        assert wall.largest_error(out, distance, quartet=1) < 0.01


def test_what_is_not_applied_is_said(tmp_path):
    """Phase offsets of pixels, and rates that replace the times of the file."""
    frames = np.zeros((2, 4, vxl.HEIGHT, vxl.WIDTH))
    content = vxl.content(frames, phaseOffsets=b"\x00\x02\x00\x04" * 8)
    imported = of(tmp_path, content, SENSOR + "[time]\nrate_hz = 100\n")
    assert any("of 16 pixels, 67.5 degrees with a spread of 22.5" in x for x in imported.uncertain)
    np.testing.assert_allclose(imported.sequence.times, np.arange(8) / 100)
    imported = of(tmp_path, vxl.content(frames, phaseOffsets=b"\x01"))
    assert any("cut short" in line for line in imported.uncertain)


FRAMES = np.zeros((2, 4, vxl.HEIGHT, vxl.WIDTH))
GOOD = vxl.content(FRAMES)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "no .vxl file"),
        (b"\x00\x01" + bytes(11), "no .vxl file"),
        (b"\x00\x02" + GOOD[2:], "no .vxl file"),
        (GOOD[:-1], "damaged"),
        (GOOD + b"VOXEL", "truncated"),
        (GOOD.replace(b"VOXEL", b"VOXES", 1), "damaged"),
        (GOOD + vxl.packet(2, b""), "type 0 or 1"),
        (GOOD + vxl.packet(0, b"\x00" * 7), "count of bytes"),
        (GOOD + vxl.packet(0, b"\xff" * 24), "count of bytes"),
        (GOOD + b"VOXEL\x00\xff\xff\xff\xff", "damaged"),
        (GOOD.replace(b"quadCount", b"quadCaunt", 1), "known name"),
        (GOOD[:14] + vxl.packet(1, b"\x01"), "expected settings"),
        (GOOD[:14] + vxl.packet(1, b"\x01" + bytes(8)), "table"),
        (GOOD[:14], "settings of raw frames"),
        (vxl.content(FRAMES[:0]), "empty recording"),
        (vxl.content(FRAMES, tofFrameType=0), "amplitude and phase"),
        (vxl.content(FRAMES, tofFrameType=9), "tofFrameType 9"),
        (vxl.content(FRAMES, tofFrameType=None), "tofFrameType None"),
        (vxl.content(FRAMES, quadCount=2), "3 to 100 quads"),
        (vxl.content(FRAMES, quadCount=2**32 - 1), "3 to 100 quads"),
        (vxl.content(FRAMES, roiWidth=0), "settings of raw frames"),
        (vxl.content(FRAMES, frameWidth=None, roiWidth=2**32 - 1), "settings of raw frames"),
        (vxl.content(FRAMES, frameHeight=None, roiHeight=480), "frame too small"),
        (GOOD + vxl.settings(frameWidth=8), "one size"),
        (GOOD + vxl.frame(FRAMES[0], 2, 5), "never decrease"),
    ],
)
def test_a_damaged_file_is_a_named_error(content, word, tmp_path):
    """Wherever it is damaged, and whatever sizes it claims."""
    with pytest.raises(InputError) as error:
        of(tmp_path, content)
    assert word in str(error.value)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (SENSOR, "time.slot_period_s"),
        (SLOTS, "sensor.f_mod_hz"),
        (SENSOR + "shifts_deg = [0, 120, 240]\n" + SLOTS, "expected 4 shifts"),
        (SENSOR + "[time]\nslot_period_s = 1\n", "slot_period_s"),
    ],
)
def test_keys_that_are_missing_or_do_not_fit_are_named(text, word, tmp_path):
    """In the file of keys; without one, all are asked for."""
    with pytest.raises(InputError) as error:
        of(tmp_path, GOOD, text)
    assert word in str(error.value)
    with pytest.raises(UsageError, match="slot_period_s"):
        read_recording("voxel", tmp_path / "a.vxl")
