"""Raw frames of a Luxonis OAK, written here pixel by pixel."""

import struct

import numpy as np
import pytest
import wall

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError
from gftorf_warp.importers.command import read_recording

SHIFTS = (0, 90, 180, 270, 180, 270, 0, 90) * 2
FREQUENCIES = (80e6,) * 8 + (100e6,) * 8
RAW = "[raw]\nsize = [32, 104]\npart_rows = 24\n"
TIMES = "[time]\ncycle_rate_hz = 10\nslot_period_s = 0.01\n"


def frame(taps, head=2):
    """A frame of four parts of taps [4, 4, 12, 16], each below two rows of other numbers."""
    words = []
    for a, b, c, d in taps:
        words += [0xABC] * (head * 32)
        for row in range(12):
            for first, second in ((a, b), (c, d)):
                for column in range(16):
                    words += [int(first[row][column]), int(second[row][column])]
    return struct.pack(f"<{len(words)}H", *words)


def keys(tmp_path, raw=RAW, sensor="", rest=TIMES):
    """A TOML file of keys."""
    path = tmp_path / "keys.toml"
    path.write_text(f"{raw}[sensor]\n{sensor}\n{rest}{wall.LENS}")
    return path


def test_taps_are_bit_equal(tmp_path):
    """Sixteen raw frames a frame; taps of one part share their time."""
    values = np.random.default_rng(6).integers(0, 4095, (2, 4, 4, 12, 16))
    values[1, 2, 3, 4, 5] = 4095
    (tmp_path / "raw").write_bytes(b"".join(map(frame, values)))
    imported = read_recording("oak", tmp_path / "raw", keys(tmp_path))
    np.testing.assert_array_equal(imported.sequence.quads, values.reshape(32, 12, 16))
    times = imported.sequence.times
    np.testing.assert_allclose(times[[0, 3, 4, 15, 16]], [0, 0, 0.01, 0.03, 0.1])
    assert any(line.startswith("1 codes") for line in imported.uncertain)


def test_a_recording_decodes_to_its_scene(tmp_path):
    """Two frequencies together, beyond the range of each alone."""
    distance = wall.distance(nearest=2.0)
    quads = wall.quads(distance, SHIFTS, FREQUENCIES, frames=16, amplitude=6000, offset=2000)
    (tmp_path / "raw").write_bytes(frame(np.round(quads).reshape(4, 4, 12, 16)))
    out = tmp_path / "capture"
    line = ["import", "oak", str(tmp_path / "raw"), "--out", str(out), "--config"]
    assert main([*line, str(keys(tmp_path))]) == 0
    assert main(["check", str(out)]) == 0
    assert Sequence.open(out).frequencies == (80e6, 100e6)
    assert wall.largest_error(out, distance) < 0.01


def test_another_layout_is_stated(tmp_path):
    """One part, one frequency, other shifts, and nothing is assumed about them."""
    distance = wall.distance()
    shifts = (90, 0, 270, 180)
    quads = np.round(wall.quads(distance, shifts, frames=4, offset=2000))
    (tmp_path / "raw").write_bytes(frame(quads[None], head=0))
    raw = "[raw]\nsize = [32, 24]\nparts = 1\npart_rows = 24\n"
    sensor = "f_mod_hz = 20e6\nshifts_deg = [90, 0, 270, 180]"
    out = tmp_path / "capture"
    line = ["import", "oak", str(tmp_path / "raw"), "--out", str(out), "--config"]
    assert main([*line, str(keys(tmp_path, raw, sensor))]) == 0
    assert wall.largest_error(out, distance) < 0.01
    imported = read_recording("oak", tmp_path / "raw", tmp_path / "keys.toml")
    assert not any("assumed" in line for line in imported.uncertain)


@pytest.mark.parametrize(
    ("content", "changes", "word"),
    [
        (b"", {}, "not whole buffers"),
        (bytes(6655), {}, "buffers of 6656 bytes"),
        (b"\xff\x7f" * 3328, {}, "no RAW12"),
        (bytes(6656), {"raw": "[raw]\nsize = [32, 103]\n"}, r"raw\.size"),
        (bytes(6656), {"raw": "[raw]\nsize = [32, 104]\npart_rows = 28\n"}, r"raw\.size"),
        (bytes(6656), {"raw": "[raw]\nsize = [32, 104]\nparts = 2\n"}, "expected 8"),
        (bytes(6656), {"sensor": "shifts_deg = [0, 90, 180, 270]"}, "one for each of 4 shifts"),
        (bytes(6656), {"rest": "[time]\ncycle_rate_hz = 10\n"}, "slot_period_s"),
        (bytes(13312), {"rest": TIMES.replace("0.01", "0.05")}, "slot_period_s"),
    ],
)
def test_what_does_not_fit_is_a_named_error(content, changes, word, tmp_path):
    """Sizes, bits and keys."""
    (tmp_path / "raw").write_bytes(content)
    with pytest.raises(InputError, match=word):
        read_recording("oak", tmp_path / "raw", keys(tmp_path, **changes))
