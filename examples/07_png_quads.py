"""Raw quads as many cameras deliver them: a folder of 16-bit PNG files with unsigned codes of 12
bits, one for each raw frame. docs/import.md reads them.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from gftorf_warp import Sequence, simulate

ZERO = 2048  # code without light: the middle of 12 bits


def main(folder: Path, scene: str = "demo") -> Sequence:
    """Write the raw frames of a simulated scene to a new folder; returns them."""
    with tempfile.TemporaryDirectory() as work:
        sequence = Sequence.open(simulate(scene, Path(work) / "sequence"))
    # as if the brightest pixel had three quarters of the range
    codes = np.rint(sequence.quads * (1536 / np.abs(sequence.quads).max())) + ZERO
    folder.mkdir()
    for number, image in enumerate(codes.astype(np.uint16)):
        cv2.imwrite(str(folder / f"{number}.png"), image)
    lens, shifts = sequence.intrinsics, np.degrees(sequence.shifts[: sequence.cycle])
    print(
        f"{sequence.frames} raw frames of {sequence.width}x{sequence.height} in {folder}: "
        f"{sequence.calibration.f_mod_hz / 1e6:.3f} MHz, shifts {shifts.round().tolist()} degrees, "
        f"{1 / sequence.times[1]:.0f} per second, fx {lens.fx:.2f}, fy {lens.fy:.2f}, "
        f"cx {lens.cx - 0.5}, cy {lens.cy - 0.5} (first pixel at 0, as OpenCV counts)"
    )
    return sequence


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "quads"))
