"""Make the picture of README.md from a finished demo.

    python benchmarks/readme_picture.py [DEMO_FOLDER] [--out docs/demo.png]

One raw frame in which much moves: what was measured, three distances on one scale, two errors on
another.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gftorf_warp import Run
from gftorf_warp.evaluate.compare import comparison_of
from gftorf_warp.evaluate.metrics import scored_frames
from gftorf_warp.evaluate.panels import row_to_show
from gftorf_warp.evaluate.views import gather

INCHES = (12.0, 4.9)


def main() -> None:
    """Render, draw, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("demo", type=Path, nargs="?", default=Path("gftorf-demo"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "demo.png")
    a = parser.parse_args()

    run = Run.open(a.demo / "run")
    sequence = run.sequence()
    truth = sequence.truth()
    views = gather(run, sequence, scored_frames(sequence))
    s = row_to_show(comparison_of(sequence, views, truth))
    n = views.frames[s]
    true = truth.distance[n]

    low, high = np.percentile(true, [0.5, 99.5])
    peak = float(np.abs(sequence.quads[n]).max())
    signed = {"cmap": "RdBu_r", "vmin": -peak, "vmax": peak}
    distance = {"cmap": "viridis", "vmin": low, "vmax": high}
    error = {"cmap": "magma", "vmin": 0.0, "vmax": 1.0}
    panels = [
        (f"raw frame {n}: what was measured then", sequence.quads[n], signed),
        ("closed form from four raw frames", views.closed_form[s], distance),
        ("ours", views.d[s], distance),
        ("truth", true, distance),
        ("error of the closed form", np.abs(views.closed_form[s] - true), error),
        ("error of ours", np.abs(views.d[s] - true), error),
    ]
    units = ["quad units", "m", "m", "m", "m", "m"]
    figure = Figure(figsize=INCHES, layout="constrained")
    for axes, (title, image, colours), unit in zip(
        figure.subplots(2, 3).flat, panels, units, strict=True
    ):
        drawn = axes.imshow(image, interpolation="nearest", **colours)
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(drawn, ax=axes, label=unit, shrink=0.9)
    a.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(a.out, dpi=100, metadata={"Software": None})
    print(a.out)


if __name__ == "__main__":
    main()
