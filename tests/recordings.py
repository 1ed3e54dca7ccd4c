"""A small recording of each camera with its file of keys, written from the layouts."""

import functools
import io

import cornell_folder
import h5py
import numpy as np
import vxl
import wall
from test_import_espros import raw_frame

from gftorf_warp.importers.command import read_recording

QUARTETS = np.round(wall.quads(wall.distance(), (0, 90, 180, 270))).reshape(2, 4, 12, 16)
SENSOR, RATE = "[sensor]\nf_mod_hz = 20e6\n", "[time]\nrate_hz = 40\n"
SLOTS = "[time]\nslot_period_s = 0.01\n"


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
        "[raw]\nformat = 'Y12'\nsize = [16, 12]\n" + SENSOR + RATE,
    ),
    "oak": (
        bytes(2 * 32 * 104),
        "[raw]\nsize = [32, 104]\npart_rows = 24\n[time]\ncycle_rate_hz = 10\nslot_period_s = 0\n",
    ),
    "espros": (b"".join(raw_frame(q + 2048) for q in QUARTETS), SENSOR + RATE),
    "espros, recorded": (hdf5(), SLOTS),
}


def write_file(name, folder):
    """A recording of one file and its keys."""
    content, keys = FILES[name]
    (folder / "recording").write_bytes(content)
    (folder / "keys.toml").write_text(keys + wall.LENS)


def write_cornell_box(folder):
    """A Cornell-Box sequence and its keys."""
    cornell_folder.write(folder / "recording", 4)
    (folder / "keys.toml").write_text("[assemble]\ntaps = 2\n")


WRITERS = {name: functools.partial(write_file, name) for name in FILES}
WRITERS["cornell_box"] = write_cornell_box


def read(name, folder):
    """Arrays of the recording in a folder."""
    kind = name.partition(",")[0]
    sequence = read_recording(kind, folder / "recording", folder / "keys.toml").sequence
    return [sequence.quads, sequence.times, sequence.shifts, sequence.camera_from_world]
