"""A slanted wall in front of a camera at rest: what its raw frames would be without rounding."""

import numpy as np

from gftorf_warp import Sequence
from gftorf_warp.data.decode import closed_form_distance

LIGHT = 299_792_458.0  # [m/s]
LENS = "[camera]\nfx = 20\nfy = 20\ncx = 8\ncy = 6\n"


def distance(width=16, height=12, nearest=1.0):
    """Distance [H, W] in m."""
    row, column = np.mgrid[:height, :width]
    return nearest + 0.05 * column + 0.03 * row


def quads(wall, shifts_deg, f_mod_hz=20e6, *, frames=8, amplitude=1000.0, offset=0.0):
    """Raw frames [F, H, W] that repeat the shifts; one frequency, or one for each of them."""
    cycle = len(shifts_deg)
    frequencies = np.resize(f_mod_hz, cycle)
    return np.stack(
        [
            amplitude
            / wall**2
            * np.cos(
                4 * np.pi * frequencies[n % cycle] * wall / LIGHT
                - np.radians(shifts_deg[n % cycle])
            )
            + offset
            for n in range(frames)
        ]
    )


def largest_error(folder, wall, quartet=0):
    """Largest error [m] of the closed form of a quartet of a sequence folder."""
    return np.abs(closed_form_distance(Sequence.open(folder), quartet) - wall).max()
