"""Engine gaussian against engine mesh on the demo: a picture of where they differ, and by how much
along the motion.

    python benchmarks/engines.py [--size WIDTHxHEIGHT] [--out docs/engines.png]

Simultaneous quads without noise. 'Inside' is two pixels or more inside one texture cell of one
face.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES, Scene
from gftorf_warp.sim.world import Hits, first_hit

PIXELS = 2  # how far inside
PHASE_MM, SHARE = 20.0, 0.2  # ends of the scales


def phasors(scene: Scene, size: tuple[int, int], engine: str) -> np.ndarray:
    """Complex a exp(i psi) [quartets, H, W]."""
    quads = record(scene, size=size, noise=False, sync=True, engine=engine).sequence.quads.astype(
        np.float64
    )
    quads = quads.reshape(-1, 4, *quads.shape[1:])
    return (quads[:, 0] - quads[:, 1] + 1j * (quads[:, 2] - quads[:, 3])) / 2


def inside(hit: Hits, moves: np.ndarray, wanted: bool) -> np.ndarray:
    """Pixels of bodies that move, or that do not, away from edges of faces and of texture cells."""
    key = np.where(
        moves[hit.body] == wanted, hit.body + 10 * hit.face + 1000 * hit.reflectance, np.nan
    )
    mask = np.isfinite(key)
    for dy in range(-PIXELS, PIXELS + 1):
        for dx in range(-PIXELS, PIXELS + 1):
            mask &= np.roll(key, (dy, dx), (0, 1)) == key
    return mask


def main() -> None:
    """Record twice, print, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", default="192x144")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parents[1] / "docs" / "engines.png"
    )
    a = parser.parse_args()
    scene = SCENES["demo"]
    width, height = (int(part) for part in a.size.split("x"))
    gaussian, mesh = (phasors(scene, (width, height), engine) for engine in ("gaussian", "mesh"))
    phase_mm = 1e3 * np.angle(gaussian / mesh) / scene.sensor.phase_slope
    share = np.abs(gaussian) / np.abs(mesh) - 1
    moves = np.array([body.moves for body in scene.bodies])
    for quartet in range(len(mesh)):
        time = 4 * quartet * scene.sensor.frame_period_s
        hit = first_hit(scene.bodies, scene.camera((width, height)), time)
        for name, wanted in (("still", False), ("moving", True)):
            mask = inside(hit, moves, wanted)
            distance, phase, amplitude = (
                hit.distance[mask].mean(),
                phase_mm[quartet][mask],
                share[quartet][mask],
            )
            print(
                f"quartet {quartet:2d} {name:<7}{mask.sum():6d} pixels at {distance:.2f} m",
                end="   ",
            )
            print(f"phase {phase.mean():+6.2f} (at most {np.abs(phase).max():6.2f}) mm", end="   ")
            print(f"amplitude {100 * amplitude.mean():+6.2f} %")
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, quartet in zip(axes, (0, len(mesh) - 1), strict=True):
        panels = (
            (
                "amplitude, mesh",
                np.abs(mesh[quartet]),
                "gray",
                0.0,
                float(np.quantile(np.abs(mesh), 0.99)),
            ),
            ("phase, gaussian - mesh [mm]", phase_mm[quartet], "RdBu", -PHASE_MM, PHASE_MM),
            ("amplitude, gaussian / mesh - 1", share[quartet], "RdBu", -SHARE, SHARE),
        )
        for axis, (title, image, colours, low, high) in zip(row, panels, strict=True):
            shown = axis.imshow(image, cmap=colours, vmin=low, vmax=high)
            axis.set_title(f"{title}, quartet {quartet}", fontsize=9)
            axis.set_axis_off()
            figure.colorbar(shown, ax=axis, shrink=0.8)
    figure.savefig(a.out, dpi=80)
    print(a.out)


if __name__ == "__main__":
    main()
