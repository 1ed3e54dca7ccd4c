"""Pixels of 12 bits as V4L2 and its like store them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int16, UInt8

FORMATS = {"Y12": 16, "Y12P": 12, "Y16": 16}  # bits of a stored pixel
CODES = 1 << 12


def twelve_bits(stored: UInt8[np.ndarray, "H n"], form: str) -> Int16[np.ndarray, "H W"]:
    """Codes 0 .. 4095 of rows of bytes in a format of V4L2.

    Y12P: two pixels are three bytes, the upper eight bits of each and then the lower four of both,
    those of the second one above. Y12 may have its sign repeated in the four bits above.

    Raises:
        ValueError: If there are other bits where there should be none.
    """
    if form == "Y12P":
        first, second, low = (stored[:, n::3].astype(np.int16) for n in range(3))
        codes = np.stack([first << 4 | low & 15, second << 4 | low >> 4], axis=2)
        return codes.reshape(len(stored), -1)
    words = stored.view("<u2")
    if form == "Y16":
        unused, codes = words & 15, words >> 4
    else:
        sign = np.where(words & 0x800, 15, 0)
        unused, codes = words >> 12, words & 0xFFF
        unused = np.where(unused == sign, 0, unused)
    if unused.any():
        raise ValueError(
            f"bits that {form} leaves at 0 are set in {int((unused > 0).sum())} pixels"
        )
    return codes.astype(np.int16)
