"""A folder of the Cornell-Box data set with motion: RGBE images written byte by byte."""

import math

import numpy as np

LIGHT = 299_792_458.0
WIDTH, HEIGHT = 16, 12
FREQUENCIES_MHZ = 20, 50, 70
REFLECTANCES = 1.0, 0.25, 0.5  # of the three materials


def rgbe(pixel):
    """Four bytes of a colour: three mantissas of one exponent."""
    largest = max(pixel)
    if largest <= 0:
        return bytes(4)
    exponent = math.frexp(largest)[1]
    return bytes([*(int(v * 256 / 2.0**exponent) for v in pixel), exponent + 128])


def radiance(image, packed=True):
    """A Radiance file of an image [H, W, 3]; ``packed``: rows by channel, in runs."""
    height, width, _ = image.shape
    head = b"#?RADIANCE\n# made by a test\nFORMAT=32-bit_rle_rgbe\n\n"
    content = head + f"-Y {height} +X {width}\n".encode()
    for row in image:
        pixels = [rgbe([float(v) for v in pixel]) for pixel in row]
        if not packed:
            content += b"".join(pixels)
            continue
        content += bytes([2, 2, width >> 8, width & 255])
        for channel in range(4):
            content += bytes([width, *(pixel[channel] for pixel in pixels)])
    return content


def stored(image):
    """The values that a file of an image holds."""
    values = np.zeros_like(image)
    for index in np.ndindex(image.shape[:2]):
        *mantissas, exponent = rgbe([float(v) for v in image[index]])
        values[index] = [m * 2.0 ** (exponent - 136) if exponent else 0.0 for m in mantissas]
    return values


def distance(instant):
    """A wall that comes closer [H, W], with a pixel that meets nothing."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    wall = 3.0 + 0.02 * column + 0.01 * row - 0.05 * instant
    wall[0, 0] = 1e4
    return wall


def correlation(instant, f_mhz, image):
    """Image k of an instant [H, W, 3]; a pixel that meets nothing is dark."""
    wall = distance(instant)
    phase = 4 * np.pi * f_mhz * 1e6 * wall / LIGHT
    seen = np.where(wall < 1e3, 1.0, 0.0)
    values = seen / wall**2 * (1.5 + np.cos(phase + image * np.pi / 2))
    return np.stack([r * values for r in REFLECTANCES], axis=2)


def write(folder, instants=8, distance=distance, correlation=correlation):
    """A folder of so many instants, of this wall or of what these functions see."""
    folder.mkdir()
    for n in range(instants):
        depth = np.repeat(distance(n)[..., None], 3, axis=2)
        (folder / f"{n:03d}_render_depth.hdr").write_bytes(radiance(depth, packed=n % 2 == 0))
        for f_mhz in FREQUENCIES_MHZ:
            for image in range(4):
                name = f"{n:03d}_render_{f_mhz}MHz_phase{image}.hdr"
                (folder / name).write_bytes(radiance(correlation(n, f_mhz, image)))
