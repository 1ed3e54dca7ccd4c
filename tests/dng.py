"""A small DNG file, written from the DNG specification: one Bayer image of 16 bits."""

import struct

import numpy as np

# XYZ (D65) to linear sRGB, IEC 61966-2-1: a camera whose own primaries are those of sRGB
SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
BYTE, ASCII, SHORT, LONG, RATIONAL, SIGNED = 1, 2, 3, 4, 5, 10
SIZES = {BYTE: 1, ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, SIGNED: 8}


def mosaic(rgb, pattern="RGGB"):
    """The Bayer image [h, w] that a sensor sees of a colour image [h, w, 3]."""
    image = np.empty(rgb.shape[:2])
    for k, letter in enumerate(pattern):
        image[k // 2 :: 2, k % 2 :: 2] = rgb[k // 2 :: 2, k % 2 :: 2, "RGB".index(letter)]
    return image


def dng(codes, pattern="RGGB", black=0, white=65535, neutral=(1.0, 1.0, 1.0), turned=1):
    """The bytes of a file of codes [h, w]; ``turned`` is the TIFF orientation."""
    height, width = codes.shape
    strip = codes.astype("<u2").tobytes()
    colours = bytes("RGB".index(letter) for letter in pattern)
    tags = [
        (254, LONG, [0]),
        (256, LONG, [width]),
        (257, LONG, [height]),
        (258, SHORT, [16]),
        (259, SHORT, [1]),
        (262, SHORT, [32803]),
        (271, ASCII, b"Maker\0"),
        (272, ASCII, b"Model\0"),
        (273, LONG, [0]),
        (274, SHORT, [turned]),
        (277, SHORT, [1]),
        (278, LONG, [height]),
        (279, LONG, [len(strip)]),
        (33421, SHORT, [2, 2]),
        (33422, BYTE, colours),
        (50706, BYTE, bytes([1, 4, 0, 0])),
        (50708, ASCII, b"Maker Model\0"),
        (50714, LONG, [black]),
        (50717, LONG, [white]),
        (50721, SIGNED, [number for row in SRGB for number in row]),
        (50728, RATIONAL, neutral),
        (50778, SHORT, [21]),
    ]
    start = 8 + 2 + 12 * len(tags) + 4
    entries, behind = b"", b""
    for tag, kind, values in tags:
        if kind in (RATIONAL, SIGNED):
            code = "<2i" if kind == SIGNED else "<2I"
            data = b"".join(struct.pack(code, round(v * 10000), 10000) for v in values)
        elif isinstance(values, bytes):
            data = values
        else:
            data = struct.pack(f"<{len(values)}{'H' if kind == SHORT else 'I'}", *values)
        count = len(data) // SIZES[kind]
        if tag == 273:
            data = b"STRP"
        if len(data) > 4:
            offset, padding = start + len(behind), b"\0" * (len(data) % 2)
            behind += data + padding
            data = struct.pack("<I", offset)
        entries += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
    entries = entries.replace(b"STRP", struct.pack("<I", start + len(behind)))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + behind + strip
