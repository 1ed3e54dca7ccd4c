"""Dumps of a Kinect v2 as libfreenect2 hands them out, written bit by bit from its layout."""

import functools

import numpy as np

WIDTH, HEIGHT = 512, 424
FREQUENCIES = 80e6, 16e6, 120e6
LIGHT = 299_792_458.0
LENS = {"fx": 365.5, "fy": 364.9, "cx": 258.3, "cy": 205.1}
K1, K2, P1, P2, K3 = DISTORTION = 0.09, -0.27, 0.001, -0.002, 0.09


def value_of_code():
    """Values of the 2048 codes, added up one by one."""
    values, value = [0] * 2048, 0
    for code in range(1024):
        values[code], values[1024 + code] = value, -value
        value += 1 << (code // 128 - (code >= 128))
    values[1024] = 32767
    return np.array(values, dtype=np.int16)


def code_of(quads):
    """The code whose value is nearest, by bisection over the codes in order of value."""
    values = value_of_code().astype(int)
    codes = np.delete(np.arange(2048), 1024)
    codes = codes[np.argsort(values[codes], kind="stable")]
    ordered = values[codes]
    above = np.clip(np.searchsorted(ordered, quads), 1, len(codes) - 1)
    nearer = quads - ordered[above - 1] < ordered[above] - quads
    return codes[above - nearer]


def packet(codes):
    """Ten sub-images of which nine are ``codes`` [9, 424, 512] and the last is all ones."""
    stored = np.full((10, HEIGHT, WIDTH), 2047, dtype=np.uint16)
    for row in range(HEIGHT):
        line = row if row < 212 else 635 - row
        for phase in range(4):  # pixels 0, 4, 8 .. come first, then 1, 5, 9 ..
            stored[:9, line, 128 * phase : 128 * (phase + 1)] = codes[:, row, phase::4]
    bits = stored[..., None] >> np.arange(11, dtype=np.uint16) & 1
    return np.packbits(bits.astype(np.uint8).reshape(-1), bitorder="little").tobytes()


def p0_response(steps):
    """The response with three tables [3, 424, 512] of 16 bits between words of no known meaning."""
    parts = [b"\x20\0\0\0" + bytes(28)]
    for table in steps:
        parts += [b"\xaa\xaa", table.astype("<u2").tobytes(), b"\x55\x55"]
    return b"".join(parts)


@functools.cache
def rays():
    """Where the ray through each pixel's centre is at z-depth 1, by fixed-point iteration."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    bent_x, bent_y = (column - LENS["cx"]) / LENS["fx"], (row - LENS["cy"]) / LENS["fy"]
    x, y = bent_x, bent_y
    for _ in range(60):
        r = x * x + y * y
        factor = 1 + K1 * r + K2 * r**2 + K3 * r**3
        x, y = (
            (bent_x - 2 * P1 * x * y - P2 * (r + 2 * x * x)) / factor,
            (bent_y - P1 * (r + 2 * y * y) - 2 * P2 * x * y) / factor,
        )
    return x, y


@functools.cache
def tables():
    """The X and Z tables as bytes."""
    x, y = rays()
    z = (6250.0 / 3.0) / np.sqrt(x * x + y * y + 1.0)
    return (8192.0 * x).astype("<f4").tobytes(), z.astype("<f4").tobytes()


def scene():
    """A slanted wall: distance [424, 512] in m and the P0 steps of a sensor that reads it late."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    distance = 1.5 + 0.004 * column + 0.002 * row
    steps = np.stack([9000 + 20 * row + 5 * column + 1000 * n for n in range(3)])
    return distance, steps


def quads_of(distance, steps, amplitude=4000.0):
    """Values [9, 424, 512] that the sensor would give without rounding."""
    return np.stack(
        [
            amplitude
            / distance**2
            * np.cos(4 * np.pi * f * distance / LIGHT - 3.1e-5 * np.pi * table + n * 2 * np.pi / 3)
            for f, table in zip(FREQUENCIES, steps, strict=True)
            for n in range(3)
        ]
    )


@functools.cache
def scene_codes():
    """The codes that the sensor stores of the scene [9, 424, 512]."""
    return code_of(quads_of(*scene()))


def write(folder, *, tables_too=True, lookup=False, packets=1):
    """A folder of a dump of the scene; returns its codes."""
    codes, (_, steps) = scene_codes().copy(), scene()
    write_codes(folder, [codes] * packets, steps, tables_too=tables_too, lookup=lookup)
    return codes


def write_codes(folder, packets, steps, *, tables_too=True, lookup=False):
    """A folder of packets of nine images of codes, with the P0 steps of the sensor."""
    folder.mkdir()
    for n, codes in enumerate(packets):
        (folder / f"packet{n + 9}.bin").write_bytes(packet(codes))
    (folder / "p0.bin").write_bytes(p0_response(steps))
    if tables_too:
        x, z = tables()
        (folder / "x.bin").write_bytes(x)
        (folder / "z.bin").write_bytes(z)
    if lookup:
        (folder / "lut.bin").write_bytes(value_of_code().astype("<i2").tobytes())
