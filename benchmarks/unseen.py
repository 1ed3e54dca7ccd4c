"""How many Gaussians of a run nobody sees, and how long the lists of its tiles are
(design/whole-run.md).

    python benchmarks/unseen.py RUN... [--times N] [--device cpu|cuda]

The weight of a Gaussian is what the backward pass sums: w = alpha T over the pixels of an image
[px]. Rows: which share of the Gaussians has at most so much in every image, and which share of all
weight is theirs.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
import warp as wp

from gftorf_warp.recon.run import Run
from gftorf_warp.render.api import rasterize
from gftorf_warp.render.buffers import Workspace

AT_MOST = (0.0, 0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # [px]


def weights_of(run: Run, seconds: list[float]) -> tuple[torch.Tensor, np.ndarray]:
    """Weights [S, N] at some times, and the lengths of all lists."""
    weights, lengths = [], []
    for time in seconds:
        with torch.no_grad():
            field = run.widened(run.field.moved(*run.motion.at(run.binding, time)), run.camera)
        field = field.map(lambda value: value.requires_grad_(value.is_floating_point()))
        workspace = Workspace()
        options = {"images": ("distance",), "screen_gradient": True, "workspace": workspace}
        rendering = rasterize(field, run.camera, run.sensor, run.render_settings, **options)
        rendering.distance.sum().backward()
        weights.append(rendering.screen.weight.cpu())
        lengths.append(np.diff(workspace.last.first.numpy()))
    return torch.stack(weights), np.concatenate(lengths)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, nargs="+")
    parser.add_argument("--times", type=int, default=12)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    for path in options.run:
        run = Run.open(path, options.device)
        last = float(run.motion.key_times[-1])
        weights, lengths = weights_of(run, np.linspace(0.0, last, options.times).tolist())
        largest, mean = weights.amax(0), weights.mean(0)
        print(f"{path}: {run.gaussians:,} Gaussians, {options.times} times")
        for most in AT_MOST:
            few = largest <= most
            share, theirs = float(few.float().mean()), float(mean[few].sum() / mean.sum())
            print(
                f"  at most {most:5.3f} px: {share:6.1%} of the Gaussians, {theirs:7.3%} of "
                f"all weight"
            )
        tile, middle, most = (
            "8x8" if options.device == "cpu" else "8x4",
            np.median(lengths),
            np.percentile(lengths, 99),
        )
        print(
            f"  lists of {tile} pixels: median {middle:.0f}, 99 % at most {most:.0f}, longest "
            f"{lengths.max()}"
        )


if __name__ == "__main__":
    main()
