"""Bytes of a Kinect v2 as numbers: packets of its infrared camera and the tables to decode them.

A packet is ten sub-images of 512x424 codes of 11 bits: three shifts at each of three frequencies,
and one that is not used. The table P0 has the phase offset of each pixel, X and Z the ray.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, UInt16

from ..data.cycles import solution
from ..data.sequence import Intrinsics

WIDTH, HEIGHT = 512, 424
BITS = 11  # of a code
SUB_IMAGES, SUB_IMAGES_USED = 10, 9
SUB_IMAGE_BYTES = WIDTH * HEIGHT * BITS // 8
PACKET_BYTES = SUB_IMAGES * SUB_IMAGE_BYTES
# three tables of uint16, each between two more, behind a header of eight uint32
P0_HEADER_BYTES = 32
P0_BYTES = P0_HEADER_BYTES + 3 * (WIDTH * HEIGHT + 2) * 2
TABLE_BYTES = WIDTH * HEIGHT * 4  # of X and Z, float32
CODES = 1 << BITS
SATURATED = 32767  # value of the code that a full pixel gives
P0_RAD = 3.1e-5 * math.pi  # [rad] one step of P0
X_STEPS = 8192.0  # one in the X table, at a z-depth of 1
Z_MM = 6250.0 / 3.0  # [mm] Z table on the optical axis
# [Hz] known multiples of 8 MHz: the ranges in the decoder of libfreenect2 are in the ratio 3:15:2
FREQUENCIES_HZ = (80e6, 16e6, 120e6)
# [rad] its decoder has + 0, 120, 240 degrees inside the cosine: quad = a cos(phase - shift)
SHIFTS = (0.0, -2.0 * math.pi / 3.0, -4.0 * math.pi / 3.0)
FIT_PX = 0.1  # [px] largest mean error of a lens fitted to tables that describe one


def codes(packet: np.ndarray) -> UInt16[np.ndarray, "9 424 512"]:
    """Codes 0 .. 2047 of the nine sub-images in use of one packet (uint8, ``PACKET_BYTES``).

    Row r of the upper half is row r as stored, the lower half is stored from its last row up. In a
    row of 352 words of 16 bits pixel x is code (x >> 2) + 128 (x & 3), lowest bits first.
    """
    words = packet[: SUB_IMAGES_USED * SUB_IMAGE_BYTES].view("<u2")
    words = words.reshape(SUB_IMAGES_USED, HEIGHT, WIDTH * BITS // 16).astype(np.uint32)
    x, half = np.arange(WIDTH), HEIGHT // 2
    bit = BITS * ((x >> 2) + 128 * (x & 3))
    word, low = bit >> 4, (bit & 15).astype(np.uint32)
    following = np.minimum(word + 1, words.shape[2] - 1)  # the last code ends with its word
    rows = np.concatenate([words[:, :half], words[:, : half - 1 : -1]], axis=1)
    values = rows[..., word] >> low | rows[..., following] << (np.uint32(16) - low)
    return (values & np.uint32(CODES - 1)).astype(np.uint16)


def usual_values() -> Float[np.ndarray, "2048"]:
    """Value of each code in the table that libfreenect2 computes: steps of 1, from 256 codes on
    doubling every 128, up to 64; the upper half of the codes are the negative values.
    """
    steps = np.repeat([1, 1, 2, 4, 8, 16, 32, 64], 128)
    values = np.concatenate([[0], np.cumsum(steps)[:-1]])
    values = np.concatenate([values, -values]).astype(np.float32)
    values[CODES // 2] = SATURATED
    return values


def phase_offsets(p0: np.ndarray) -> Float[np.ndarray, "3 424 512"]:
    """Measured minus true phase [rad] of each pixel at each frequency, from the content of a P0
    response (uint8, ``P0_BYTES``), in the rows of :func:`codes`.
    """
    tables = p0[P0_HEADER_BYTES:].view("<u2").reshape(3, WIDTH * HEIGHT + 2)
    return -P0_RAD * tables[:, 1:-1].reshape(3, HEIGHT, WIDTH).astype(np.float64)


def without_offsets(
    quads: Float[np.ndarray, "3 H W"], offset: Float[np.ndarray, "H W"]
) -> Float[np.ndarray, "3 H W"]:
    """Three quads of ``SHIFTS`` as they would be if the phase offset [rad] of every pixel were 0.

    Their phasor is turned back; their mean stays.
    """
    rows = solution(np.array(SHIFTS))
    assert rows is not None
    re, im = np.tensordot(rows, quads.astype(np.float64), axes=1)
    phasor = (re + 1j * im) * np.exp(-1j * offset)
    waves = np.exp(-1j * np.array(SHIFTS))[:, None, None]
    return (quads.mean(axis=0) + 0.5 * (phasor * waves).real).astype(np.float32)


@np.errstate(all="ignore")  # damaged tables have any number
def lens(
    x_table: Float[np.ndarray, "424 512"], z_table: Float[np.ndarray, "424 512"]
) -> Intrinsics:
    """The lens that the X and Z tables of libfreenect2 were computed from.

    They hold x and 1/sqrt(x^2 + y^2 + 1) of the ray through each pixel, so that the pixel's column
    is linear in fx, fx k1, fx k2, fx p1, fx p2, fx k3 and cx, and its row then in fy and cy.

    Raises:
        ValueError: If no lens explains them within ``FIT_PX``.
    """
    x = x_table.astype(np.float64) / X_STEPS
    square = (Z_MM / z_table.astype(np.float64)) ** 2 - 1.0 - x**2
    size = np.sqrt(np.maximum(square, 0.0))
    middle = size.argmin(axis=0)  # the row of the principal point, in every column
    y = np.where(np.arange(len(x))[:, None] < middle, -size, size)
    known = np.isfinite(x) & np.isfinite(square) & (size > 0.02)  # float32 loses small y
    if known.mean() < 0.5:
        raise ValueError("most values are no rays")
    row, column = (index + 0.5 for index in np.nonzero(known))
    x, y = x[known], y[known]
    r = x**2 + y**2
    radial = np.stack([x, x * r, x * r**2, 2.0 * x * y, r + 2.0 * x**2, x * r**3, x**0], axis=1)
    (fx, *scaled, cx), *_ = np.linalg.lstsq(radial, column, rcond=None)
    k1, k2, p1, p2, k3 = (float(value / fx) for value in scaled)
    bent = y * (1.0 + r * (k1 + r * (k2 + r * k3))) + p1 * (r + 2.0 * y**2) + 2.0 * p2 * x * y
    (fy, cy), *_ = np.linalg.lstsq(np.stack([bent, y**0], axis=1), row, rcond=None)
    errors = radial @ np.array([fx, *scaled, cx]) - column, fy * bent + cy - row
    worst = max(float(np.abs(error).mean()) for error in errors)
    if not (worst < FIT_PX and fx > 0 and fy > 0):
        raise ValueError(f"no lens explains them: {worst:.3g} px on average")
    return Intrinsics(
        fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), distortion=(k1, k2, p1, p2, k3)
    )
