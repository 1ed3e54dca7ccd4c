"""ESPROS TOFcams: raw frames, packed here field by field, and HDF5 files as their recorder writes
them.
"""

import struct

import h5py
import numpy as np
import pytest
import wall

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError
from gftorf_warp.importers.command import read_recording

SHIFTS = (0, 90, 180, 270)
SENSOR = "[sensor]\nf_mod_hz = 20e6\n"
RATE = "[time]\nrate_hz = 80\n"


def raw_frame(dcs, *, times_us=(150, 0, 0), temperature=3125, offset=25, columns=None):
    """A raw frame of four images of numbers around 2048."""
    rows = len(dcs[0])
    columns = len(dcs[0][0]) if columns is None else columns
    head = struct.pack(">BHHHHHHHH", 3, 5, columns, rows, 8, 4, 8 + columns, 4 + rows, times_us[0])
    head += struct.pack(">HHhH", *times_us[1:], temperature, offset)
    pixels = [int(v) for image in dcs for row in image for v in row]
    return head + struct.pack(f"<{len(pixels)}H", *pixels)


def keys(tmp_path, text=SENSOR + RATE):
    """A TOML file of these keys and a lens."""
    path = tmp_path / "keys.toml"
    path.write_text(text + wall.LENS)
    return path


def rounded(frames=8, nearest=1.0):
    """Quartets of the wall [N, 4, 12, 16], whole numbers without the zero."""
    distance = wall.distance(nearest=nearest)
    quads = np.round(wall.quads(distance, SHIFTS, frames=frames))
    return distance, quads.reshape(-1, 4, 12, 16).astype(int)


@pytest.mark.parametrize("several", [False, True])
def test_raw_frames_are_bit_equal_and_decode(several, tmp_path):
    """One file of raw frames, or one file each."""
    distance, quartets = rounded()
    frames = [raw_frame(q + 2048) for q in quartets]
    source = tmp_path / "dcs"
    if several:
        source.mkdir()
        for n, frame in enumerate(frames):
            (source / f"{n}.bin").write_bytes(frame)
    else:
        source.write_bytes(b"".join(frames))
    out = tmp_path / "capture"
    config = str(keys(tmp_path))
    assert main(["import", "espros", str(source), "--out", str(out), "--config", config]) == 0
    assert main(["check", str(out)]) == 0
    sequence = Sequence.open(out)
    np.testing.assert_array_equal(sequence.quads, quartets.reshape(8, 12, 16))
    np.testing.assert_allclose(sequence.exposures, 150e-6)
    assert wall.largest_error(out, distance, quartet=1) < 0.01


def test_codes_take_the_nearest_raw_frame_of_their_dcs(tmp_path):
    """64002 and 64003, counted, and no other number outside of 12 bits."""
    _, quartets = rounded(12)
    stored = quartets + 2048
    stored[1, 2, 3, 4], stored[:, 0, 5, 6], stored[0, 1, 0, 0] = 64003, 64002, 64002
    (tmp_path / "dcs").write_bytes(b"".join(map(raw_frame, stored)))
    imported = read_recording("espros", tmp_path / "dcs", keys(tmp_path))
    quads = imported.sequence.quads.reshape(3, 4, 12, 16)
    assert quads[1, 2, 3, 4] == quartets[0, 2, 3, 4]
    assert quads[0, 1, 0, 0] == quartets[1, 1, 0, 0]
    assert (quads[:, :, 5, 6] == 0).all()
    for line in ("4 values are too bright", "1 values are saturated", "1 pixels are never"):
        assert any(text.startswith(line) for text in imported.uncertain), line
    stored[2, 0, 0, 0] = 5000
    (tmp_path / "dcs").write_bytes(b"".join(map(raw_frame, stored)))
    with pytest.raises(InputError, match="found 5000 in image 8"):
        read_recording("espros", tmp_path / "dcs", keys(tmp_path))


def test_rolling_mode_takes_each_dcs_once(tmp_path):
    """Of a scene that moves: 9 quartets are 12 raw frames, from the oldest DCS on."""
    taken = []
    for n in range(12):  # DCS 2 is the oldest of the first quartet
        quads = wall.quads(wall.distance(nearest=1 + 0.01 * n), SHIFTS, frames=4)
        taken.append(np.round(quads[(n + 2) % 4]).astype(int))
    quartets = []
    for n in range(9):
        order = [(n + 2 + k) % 4 for k in range(4)]
        quartet = [taken[n + order.index(dcs)] for dcs in range(4)]
        quartets.append(raw_frame(np.array(quartet) + 2048))
    (tmp_path / "dcs").write_bytes(b"".join(quartets))
    imported = read_recording("espros", tmp_path / "dcs", keys(tmp_path))
    np.testing.assert_array_equal(imported.sequence.quads, taken)
    degrees = np.degrees(imported.sequence.shifts).round().astype(int).tolist()
    assert degrees == [180, 270, 0, 90] * 3
    assert any("rolling mode" in line for line in imported.understood)


def recorder(path, quartets, layout):
    """A file of the recorder: images grouped by type, or a grid of 2x2, upright or turned."""
    with h5py.File(path, "w") as file:
        file.attrs["mod_frequency"] = 20.0
        file.attrs["roi"] = (0, 0, 16, 12)
        grids = [np.block([[q[0], q[1]], [q[2], q[3]]]) for q in quartets]
        if layout.endswith("turned"):
            grids = [np.rot90(grid, 3) for grid in grids]
        rows, columns = (n // 2 for n in grids[0].shape)
        if layout.startswith("grid"):
            group, frames = file, np.stack(grids).astype(np.uint16)
        else:
            group = file.create_group("DCS")
            cells = [(0, 0), (0, columns), (rows, 0), (rows, columns)]
            frames = np.stack([[g[r : r + rows, c : c + columns] for r, c in cells] for g in grids])
            frames = frames.astype(np.float64 if layout.endswith("turned") else np.int16)
        group.create_dataset("frames", data=frames, maxshape=(None, *frames.shape[1:]))
        times = 1e9 + 0.05 * np.arange(len(grids))
        group.create_dataset("timestamps", data=times, maxshape=(None,))


@pytest.mark.parametrize("layout", ["grid", "grid turned", "DCS", "DCS turned"])
def test_recordings_are_upright_and_in_order(layout, tmp_path):
    """Whatever the version of the recorder did to them; time and frequency are in the file."""
    distance, quartets = rounded()
    zero = 0 if layout == "DCS" else 2048
    recorder(tmp_path / "dcs.h5", quartets + zero, layout)
    config = keys(tmp_path, "[time]\nslot_period_s = 0.002\n")
    imported = read_recording("espros", tmp_path / "dcs.h5", config)
    np.testing.assert_array_equal(imported.sequence.quads, quartets.reshape(8, 12, 16))
    assert imported.sequence.calibration.f_mod_hz == 20e6
    np.testing.assert_allclose(imported.sequence.times[[0, 1, 4]], [0, 0.002, 0.05], atol=1e-6)
    out = tmp_path / "capture"
    line = ["import", "espros", str(tmp_path / "dcs.h5"), "--out", str(out), "--config"]
    assert main([*line, str(config)]) == 0
    assert wall.largest_error(out, distance) < 0.01


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "no raw frames"),
        (b"\x03" * 24, "truncated"),
        (raw_frame(np.full((4, 12, 16), 2048))[:-1], "truncated"),
        (raw_frame(np.full((4, 12, 16), 2048), columns=0), "no raw frame of a TOFcam"),
        (raw_frame(np.full((4, 12, 16), 2048), columns=60000), "no raw frame of a TOFcam"),
        (raw_frame(np.full((4, 12, 16), 2048), columns=8000), "truncated"),
        (raw_frame(np.full((4, 12, 16), 2048), offset=99), "byte 99"),
        (
            raw_frame(np.full((4, 12, 16), 2048)) + raw_frame(np.full((4, 6, 16), 2048)),
            "one size, found 16x12, 16x6",
        ),
        (b"\x89HDF\r\n\x1a\n" + bytes(500), "whole HDF5 file"),
    ],
)
def test_damaged_files_are_named_errors(content, word, tmp_path):
    """Truncated, with absurd sizes, of two sizes, or no HDF5 file after all."""
    (tmp_path / "dcs").write_bytes(content)
    with pytest.raises(InputError, match=word):
        read_recording("espros", tmp_path / "dcs", keys(tmp_path))


@pytest.mark.parametrize(
    ("name", "shape", "times", "word"),
    [
        ("Distance/frames", (2, 12, 16), 2, "found Distance/frames"),
        ("DCS/frames", (2, 3, 12, 16), 2, "found (2, 3, 12, 16)"),
        ("frames", (2, 11, 16), 2, "found (2, 11, 16)"),
        ("DCS/frames", (2, 4, 12, 16), 3, "2 timestamps, found (3,)"),
        ("DCS/frames", (0, 4, 12, 16), 0, "not complete"),
    ],
)
def test_other_recordings_are_named_errors(name, shape, times, word, tmp_path):
    """Of another image type, shape, or number of times."""
    with h5py.File(tmp_path / "dcs.h5", "w") as file:
        file[name] = np.zeros(shape)
        file[name.replace("frames", "timestamps")] = np.arange(times)
    config = keys(tmp_path, SENSOR + "[time]\nslot_period_s = 0\n")
    with pytest.raises(InputError) as error:
        read_recording("espros", tmp_path / "dcs.h5", config)
    assert word in str(error.value)
