"""Simulate a moving scene: a sequence of asynchronous quads with noise,
and the true distance of every raw frame.
"""

import sys
import tempfile
from pathlib import Path

from gftorf_warp import Sequence, SimSettings, simulate


def main(folder: Path) -> Path:
    """Write a small sequence below ``folder`` and return its path."""
    settings = SimSettings(frames=8, size=(48, 36), seed=1)
    # or single settings: simulate(scene, out, frames=8)
    path = simulate("axial", folder / "axial", settings)
    sequence = Sequence.open(path)
    print(f"{sequence.frames} raw frames of {sequence.width}x{sequence.height} in {path}")
    for n in range(4):  # one quartet: four phase shifts, four instants
        print(
            f"  raw frame {n}: shift {sequence.shifts[n]:.4f} rad at "
            f"{1e3 * sequence.times[n]:.2f} ms"
        )

    truth = sequence.truth()
    middle = sequence.height // 2, sequence.width // 3
    print(
        f"true distance of pixel {list(middle)} over time: "
        f"{truth.distance[:, *middle].round(3).tolist()} m"
    )
    return path


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
