"""Simulate, reconstruct and compare from Python, then render the reconstruction between two raw
frames.
"""

import sys
import tempfile
from pathlib import Path

from gftorf_warp import compare, reconstruct, simulate


def main(folder: Path, images: int = 400) -> dict:
    """Work below ``folder`` and return the content of metrics.json.

    Few images and few pixels: this shows the calls, `gftorf demo` shows what they can do.
    """
    sequence = simulate("demo", folder / "sequence", frames=12, size=(48, 36))
    run = reconstruct(sequence, folder / "run", images=images)

    metrics = compare(run)
    print(
        f"{run.gaussians} Gaussians; distance error (MSE x100 [m^2]) over {metrics['frames']} "
        f"raw frames:"
    )
    print(f"  closed form {metrics['closed_form_mse_x100']:.3f}, ours {metrics['d_mse_x100']:.3f}")

    period = run.sensor.frame_period_s
    rendering = run.render(5.5 * period)  # no camera ever measured at this instant
    print(
        f"between raw frames 5 and 6: quads {tuple(rendering.quads.shape)}, mean distance of "
        f"the middle pixel "
    )
    print(f"  {float(rendering.distance[run.camera.height // 2, run.camera.width // 2]):.3f} m")
    return metrics


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
