"""A .vxl file of the TI Voxel SDK, written field by field from its layout."""

import struct

import numpy as np

WIDTH, HEIGHT = 16, 12
VALUES = {
    "version": 3,
    "tofFrameType": 2,
    "quadCount": 4,
    "bytesPerPixel": 2,
    "dataArrangeMode": 0,
    "roiX": 0,
    "roiY": 0,
    "roiWidth": 2 * WIDTH,
    "roiHeight": 2 * HEIGHT,
    "maxFrameWidth": 320,
    "maxFrameHeight": 240,
    "frameWidth": WIDTH,
    "frameHeight": HEIGHT,
    "rowsToMerge": 2,
    "columnsToMerge": 2,
    "histogramEnabled": 0,
    "dealiased16BitMode": 0,
    "phaseOffsets": b"",
    "crossTalkCoefficients": b"",
}


def text(characters):
    """A length and characters."""
    return struct.pack("<I", len(characters)) + characters


def packet(kind, body, magic=b"VOXEL"):
    """A packet of a type."""
    return magic + struct.pack("<BI", kind, len(body)) + body


def settings(frame_type=1, **changes):
    """A packet of settings; a value of None is left out."""
    table = b""
    for name, value in (VALUES | changes).items():
        if value is not None:
            stored = text(value) if isinstance(value, bytes) else struct.pack("<I", value)
            table += text(name.encode()) + stored
    body = text(table)  # the table says its own size
    return packet(1, struct.pack("<BI", frame_type, len(body)) + body)


def frame(quads, number=0, time_us=0, wide=False):
    """A packet of one frame: Q images of whole numbers from -2048 to 2047."""
    pixels = np.moveaxis(np.asarray(quads).astype(int), 0, -1).reshape(-1)
    data = b"".join(struct.pack("<H", int(v) & 0xFFF) for v in pixels)
    return packet(0, struct.pack("<iQQ" if wide else "<iQI", number, time_us, len(data)) + data)


def content(frames, wide=False, **changes):
    """A whole file; frames [N, Q, H, W] 50 ms apart."""
    parts = [bytes([0, 1]) + struct.pack("<3I", 0x04510001, 2, 3), settings(**changes)]
    parts += [settings(frame_type=3)]  # of point clouds
    parts += [frame(q, n, 10**15 + 50_000 * n, wide) for n, q in enumerate(frames)]
    return b"".join(parts)
