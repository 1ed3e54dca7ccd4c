"""Damaged recordings of every camera: bits flipped, bytes lost, doubled or put in, anywhere.

Each either reads as whole quads or ends in an error that a user can act on; never in another one,
and never after asking for memory that the file does not justify.
"""

import io
import tracemalloc

import cornell_folder as cornell
import h5py
import kinect2_dump as kinect2
import numpy as np
import pytest
import vxl
import wall
from hypothesis import given, settings
from hypothesis import strategies as st
from test_import_espros import raw_frame

from gftorf_warp.errors import GftorfError
from gftorf_warp.importers import kinect2_packets
from gftorf_warp.importers.command import read_recording

MEMORY_MAX = 20 << 20  # [bytes] for files of a few kilobytes
QUARTETS = np.round(wall.quads(wall.distance(), (0, 90, 180, 270))).reshape(2, 4, 12, 16)
SENSOR, TIMES = "[sensor]\nf_mod_hz = 20e6\n", "[time]\nrate_hz = 40\n"
SLOTS = "[time]\nslot_period_s = 0.01\n"
DAMAGE = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "drop", "repeat", "insert"]),
        st.floats(0, 1, exclude_max=True),
        st.integers(0, 255),
    ),
    min_size=1,
    max_size=4,
)


def hdf5():
    """A file of the recorder of a TOFcam."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs["mod_frequency"] = 20.0
        group = file.create_group("DCS")
        group.create_dataset("frames", data=QUARTETS.astype(np.int16), maxshape=(None, 4, 12, 16))
        group.create_dataset("timestamps", data=np.arange(2) * 0.05, maxshape=(None,))
    return content.getvalue()


FILES = {  # kind: content, keys
    "voxel": (vxl.content(QUARTETS), SENSOR + SLOTS),
    "mlx7502x": (
        (QUARTETS.astype(int) & 0xFFF).astype("<u2").tobytes(),
        "[raw]\nformat = 'Y12'\nsize = [16, 12]\n" + SENSOR + TIMES,
    ),
    "oak": (
        bytes(2 * 32 * 104),
        "[raw]\nsize = [32, 104]\npart_rows = 24\n[time]\ncycle_rate_hz = 10\nslot_period_s = 0\n",
    ),
    "espros": (b"".join(raw_frame(q + 2048) for q in QUARTETS), SENSOR + TIMES),
    "espros recorded": (hdf5(), SLOTS),
}


def damaged(content, damage):
    """The content after some damage, each at a fraction of its length."""
    content = bytearray(content)
    for what, place, value in damage:
        n = int(place * len(content))
        if what == "flip" and content:
            content[n] ^= 1 << value % 8
        elif what == "cut":
            del content[n:]
        elif what == "drop":
            del content[n : n + value + 1]
        elif what == "repeat":
            content[n:n] = content[n : n + value + 1]
        else:
            content[n:n] = bytes([value]) * (1 + value % 8)
    return bytes(content)


def assert_helpful(error):
    """An error says where, why and what to do."""
    assert all((error.what, error.where, error.why, error.fix)), error


def assert_read_or_refused(kind, source, keys):
    """Whole quads, or an error that says where and why; without much memory."""
    tracemalloc.start()
    try:
        sequence = read_recording(kind, source, keys).sequence
        assert np.isfinite(sequence.quads).all()
        assert len(sequence.quads) == len(sequence.times)
        assert (np.diff(sequence.times) >= 0).all()
    except GftorfError as error:
        assert_helpful(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MEMORY_MAX, f"{peak} bytes"


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=80, deadline=None, derandomize=True, database=None)
@given(damage=DAMAGE)
def test_a_damaged_file_is_read_or_refused(name, tmp_path_factory, damage):
    """All formats of one file."""
    content, text = FILES[name]
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "keys.toml").write_text(text + wall.LENS)
    (folder / "file").write_bytes(damaged(content, damage))
    assert_read_or_refused(name.partition(" ")[0], folder / "file", folder / "keys.toml")


@pytest.fixture(scope="module")
def cornell_box(tmp_path_factory):
    """A Cornell-Box sequence."""
    folder = tmp_path_factory.mktemp("damaged") / "o_1"
    cornell.write(folder, 4)
    return folder


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(damage=DAMAGE, name=st.sampled_from(["depth", "20MHz_phase0", "20MHz_phase3"]))
def test_a_damaged_image_is_read_or_refused(cornell_box, damage, name):
    """Of a Cornell-Box sequence."""
    path = cornell_box / f"000_render_{name}.hdr"
    content = path.read_bytes()
    try:
        path.write_bytes(damaged(content, damage))
        assert_read_or_refused("cornell_box", cornell_box, None)
    finally:
        path.write_bytes(content)


TABLES = kinect2.tables()


@settings(max_examples=20, deadline=None, derandomize=True, database=None)
@given(damage=DAMAGE, first=st.booleans())
def test_damaged_tables_of_a_lens_are_read_or_refused(damage, first):
    """Of a Kinect: values of all kinds, infinities and NaN among them."""
    tables, whole = list(TABLES), len(TABLES[0])
    tables[not first] = damaged(tables[not first], damage)[:whole].ljust(whole, b"\xff")
    x, z = (np.frombuffer(t, "<f4").reshape(kinect2.HEIGHT, kinect2.WIDTH) for t in tables)
    try:
        lens = kinect2_packets.lens(x, z)
    except (ValueError, np.linalg.LinAlgError):
        return
    assert lens.fx > 0
    assert np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]).all()
