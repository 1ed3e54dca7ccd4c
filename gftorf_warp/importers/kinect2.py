"""Dumps of a Kinect v2 by libfreenect2 (DumpPacketPipeline): a folder of packets and tables.

libfreenect2 hands these out as arrays and names no files, so they are told apart by their sizes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.folder import empty_quads
from ..data.sequence import Calibration, Intrinsics
from ..data.untrusted import FRAMES_MAX
from ..errors import InputError
from . import camera_keys, pose_keys, regular
from . import kinect2_packets as packets
from .codes import fill
from .imported import Imported, Notes
from .keys import Key, Settings
from .raw_files import files_of, raw_bytes, size_of
from .sensor_keys import Modulation

LENS = camera_keys.camera_keys("camera", "replaces the X and Z tables", needed=False)
KEYS = (
    *regular.pixel_centres_half(LENS),  # as getIrCameraParams() counts
    *pose_keys.KEYS,
    Key(
        name="time.cycle_rate_hz",
        kind=float,
        about="packets per second [Hz]",
        example=15.0,
        default=30.0,
        above=0.0,
    ),
)
MODULATION = Modulation(
    frequencies_hz=np.repeat(packets.FREQUENCIES_HZ, 3),
    shifts=np.tile(packets.SHIFTS, 3),
    calibration=Calibration(f_mod_hz=packets.FREQUENCIES_HZ[0], cycle_length=9),
)
# bytes of the tables if the number of values, which libfreenect2 returns, is taken for bytes
CUT_SHORT = {packets.TABLE_BYTES // 4, packets.CODES}
UNCERTAIN = (
    "frequencies 80, 16, 120 MHz are from literature; libfreenect2 has their ratios only",
    "rows: libfreenect2 counts cy from the first row of its images, as here, but the rows of its X "
    "and Z tables from the last; if distances tilt from top to bottom, set camera.cy to 424 - cy",
    "the image may be mirrored left to right, as on the screen of this camera; the scene then is "
    "mirrored too",
)


@dataclass
class Dump:
    """Files of a dump by what they contain."""

    packets: list[Path] = field(default_factory=list)
    p0: list[Path] = field(default_factory=list)
    tables: list[Path] = field(default_factory=list)
    lookup: list[Path] = field(default_factory=list)
    others: list[Path] = field(default_factory=list)


def read(source: Path, settings: Settings) -> Imported:
    """A dump as a sequence: per packet three raw frames at 80, 16 and 120 MHz each.

    The phase offsets of P0 are taken out, so that one offset fits all pixels.

    Raises:
        InputError: If packets or tables are missing, damaged or doubled.
        UsageError: If the tables of the lens are missing and no key states it.
    """
    notes = Notes()
    dump = _dump(source, notes)
    lens = _lens(source, dump, settings, notes)
    quads = _quads(source, dump, notes)
    notes.understood.append(
        "raw frames: 3 at 80 MHz, 3 at 16 MHz, 3 at 120 MHz, each at 0, -120, -240 degrees; the "
        "tenth sub-image is left out"
    )
    times = _times(len(quads) // packets.SUB_IMAGES_USED, settings, notes)
    notes.uncertain += UNCERTAIN
    return regular.imported(source, settings, notes, quads, MODULATION, times, lens=lens)


def _dump(source: Path, notes: Notes) -> Dump:
    """The files of a dump, of each kind as many as there should be.

    Raises:
        InputError: If not.
    """
    dump = _by_size(source)
    several = f"one or more files of a multiple of {packets.PACKET_BYTES}"
    for files, count, what, expected in (
        (dump.packets, range(1, FRAMES_MAX), "packets", several),
        (dump.p0, range(1, 2), "P0 tables", f"one file of {packets.P0_BYTES}"),
        (dump.lookup, range(2), "lookup table", f"at most one file of {2 * packets.CODES}"),
        (dump.tables, range(3), "X and Z tables", f"at most two files of {packets.TABLE_BYTES}"),
    ):
        if len(files) not in count:
            names = ", ".join(path.name for path in files)
            sizes = ", ".join(f"{path.name} ({size_of(path)})" for path in dump.others[:5])
            why = f"expected {expected} bytes, found "
            why += names or f"none; other files: {sizes or 'none'}"
            fix = "put packets and tables of one session, and nothing else, into one folder"
            raise InputError(what, where=source, why=why, fix=fix)
    notes.understood.append(f"files: {len(dump.packets)} of packets, by their sizes, as named")
    if dump.others:
        names = ", ".join(path.name for path in dump.others[:5])
        notes.understood.append(f"ignored: {len(dump.others)} files of other sizes: {names}")
    return dump


def _by_size(source: Path) -> Dump:
    """All files by kind, which follows from their sizes.

    Raises:
        InputError: If one is a table that was cut short.
    """
    dump = Dump()
    tables = {
        packets.P0_BYTES: dump.p0,
        packets.TABLE_BYTES: dump.tables,
        2 * packets.CODES: dump.lookup,
    }
    for path in files_of(source):
        size = size_of(path)
        if size in CUT_SHORT:
            why = f"expected {size} values of 4 or 2 bytes each, found {size} bytes: libfreenect2 "
            why += "returns the number of values, not of bytes"
            fix = "dump the table again, with that number times the size of a value"
            raise InputError("a quarter or half of a table", where=path, why=why, fix=fix)
        whole = size > 0 and size % packets.PACKET_BYTES == 0
        tables.get(size, dump.packets if whole else dump.others).append(path)
    return dump


def _lens(source: Path, dump: Dump, settings: Settings, notes: Notes) -> Intrinsics:
    """The lens of the keys, or else of the X and Z tables."""
    shape = packets.HEIGHT, packets.WIDTH
    if regular.lens_given(settings) or len(dump.tables) < 2:
        settings.require("camera.fx", "camera.fy", "camera.cx", "camera.cy")
        return camera_keys.intrinsics_of(
            settings, notes, packets.WIDTH, root=source, height=packets.HEIGHT
        )
    tables = [raw_bytes(path).view("<f4").reshape(shape) for path in dump.tables]
    with np.errstate(invalid="ignore"):
        x, z = sorted(tables, key=lambda table: bool((table > 0).all()))  # Z is positive
    files = " and ".join(path.name for path in dump.tables)
    try:
        lens = packets.lens(x, z)
    except (ValueError, np.linalg.LinAlgError) as error:
        why = f"expected the X and Z tables of libfreenect2, found others: {error}"
        fix = "dump both again, or state camera.fx, fy, cx, cy and remove them"
        raise InputError("tables of the lens", where=files, why=why, fix=fix) from error
    text = f"camera: fx {lens.fx:.6g}, fy {lens.fy:.6g}, cx {lens.cx:.6g}, cy {lens.cy:.6g} px"
    notes.understood.append(f"{text} and its distortion, fitted to {files}")
    return lens


def _quads(source: Path, dump: Dump, notes: Notes) -> Float[np.ndarray, "F H W"]:
    """Values of all raw frames without the phase offsets of their pixels."""
    offsets = packets.phase_offsets(raw_bytes(dump.p0[0]))
    count = sum(size_of(path) // packets.PACKET_BYTES for path in dump.packets)
    size = {"H": packets.HEIGHT, "W": packets.WIDTH}
    quads = empty_quads(source, packets.SUB_IMAGES_USED * count, size)
    triples, saturated = quads.reshape(-1, 3, *quads.shape[1:]), 0
    for n, measured in enumerate(_triples(dump)):
        triples[n] = packets.without_offsets(measured, offsets[n % 3])
        full = (measured == packets.SATURATED).any(axis=0)
        full[:, [0, -1]] = False
        triples[n][:, full] = np.nan
        saturated += int(full.sum())
    quads[..., [0, -1]] = 0.0
    table = dump.lookup[0].name if dump.lookup else "the table that libfreenect2 computes"
    notes.understood += [
        f"codes: 11 bits, to values by {table}",
        f"phase offsets: {dump.p0[0].name}, taken out: the three raw frames of one frequency are "
        "turned together, and have one time",
        "columns 0 and 511 are 0 throughout: libfreenect2 reads none there",
    ]
    if saturated:
        dark = fill(quads, np.ones(len(quads), dtype=bool), packets.SUB_IMAGES_USED)
        notes.uncertain.append(
            f"{saturated} times a pixel is saturated at one frequency: its three quads are those "
            f"of the nearest packet; {dark} pixels always are, and are 0"
        )
    return quads


def _triples(dump: Dump) -> Iterator[Float[np.ndarray, "3 H W"]]:
    """Values of the three raw frames of each frequency, packet by packet."""
    values = packets.usual_values()
    if dump.lookup:
        values = raw_bytes(dump.lookup[0]).view("<i2").astype(np.float32)
    for path in dump.packets:
        for first in range(0, size_of(path), packets.PACKET_BYTES):
            codes = packets.codes(raw_bytes(path, first, packets.PACKET_BYTES))
            yield from values[codes].reshape(3, 3, packets.HEIGHT, packets.WIDTH)


def _times(count: int, settings: Settings, notes: Notes) -> Float[np.ndarray, "F"]:
    """Times [s] of the raw frames of evenly spaced packets; those of one frequency share theirs."""
    rate, source = settings["time.cycle_rate_hz"], settings.source("time.cycle_rate_hz")
    notes.understood.append(f"times: {rate:g} packets per second ({source})")
    notes.uncertain.append(
        "times: ten sub-images are taken as evenly spaced in a packet, and no packet as lost; the "
        "files do not say"
    )
    in_packet = np.repeat(np.arange(3) * 3 / packets.SUB_IMAGES, 3)
    return (np.arange(count)[:, None] + in_packet).ravel() / rate
