"""Reconstruct phasors and colour images of a moving camera,
and render a view that no camera had.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from gftorf_warp import Sequence, compare, reconstruct, simulate
from gftorf_warp.recon import presets
from gftorf_warp.recon.settings import Input
from gftorf_warp.scene.measured import sensor_of


def main(folder: Path, images: int = 400) -> dict:
    """Work below ``folder`` and return the content of metrics.json.

    The published preset with a fiftieth of its images, few Gaussians and a small network: this
    shows the calls. The whole preset is `gftorf reconstruct SEQ --out RUN --preset released`.
    """
    sequence = Sequence.open(
        simulate("tour", folder / "sequence", frames=16, size=(48, 36), format="torf")
    )
    print(
        f"{len(sequence.complete_quartets)} phasors, {len(sequence.colour.images)} colour "
        f"images, a pose for each"
    )

    recorded = presets.Recorded(
        input=Input.PHASOR, unambiguous_range=sensor_of(sequence).unambiguous_range
    )
    # every interval shrinks with the run
    settings = presets.shortened(presets.released(recorded), images)
    settings = replace(
        settings,
        init=replace(settings.init, count=1000),
        motion=replace(settings.motion, layers=3, width=32, skip_after=2),
    )
    run = reconstruct(sequence, folder / "run", settings)

    metrics = compare(run)
    along = metrics["diagnostics"]
    print(
        f"{run.gaussians} Gaussians after {images} images; colour PSNR "
        f"{metrics['colour_psnr_db']:.1f} dB"
    )
    print(f"d and d_ToF were nearest to each other after {along['images_at_criterion']} images")

    camera = run.camera.at(sequence.novel_from_world[0])  # a pose in the folder without a phasor
    view = run.render(time=0.05, camera=camera)
    print(
        f"novel view: colour {tuple(view.colour.shape)}, mean distance "
        f"{float(view.distance.mean()):.2f} m"
    )
    return metrics


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
