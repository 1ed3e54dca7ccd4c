"""The inverse crime, measured: a fit to what our own model rendered against fits to rays through
the scene.

    python benchmarks/canary.py [SCENE] [--images N] [--size WIDTHxHEIGHT] [--device cpu] [--json
    FILE]

'own model': the fit to 'mesh, one ray' is rendered at every raw frame's time, quads and distance; a
new fit from the same start gets those quads and is scored against those distances, so its data hold
nothing that it cannot express. The other rows are scored against the analytic truth. All are
without noise, fitted by preset demo from the same seed. Errors are mean squared errors times
100 [m^2] over all raw frames; in brackets, over those of 'own model': above 1, truth has what the
fitted model lacks (sensor notes, T34: more than 2). 'gaussian' is engine gaussian, which covers the
same surfaces with splats and is neither of the two.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from gftorf_warp import Truth, __version__
from gftorf_warp.constants import FRAMES_PER_QUARTET
from gftorf_warp.data.write import write
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.views import quad_of_shift
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.sim.simulate import simulate

BESIDE = "emitter=0.03,0,0"
PRESET = "demo"  # one scene for all times; stored results are of it
SOURCE = "mesh, one ray"
ROWS = {  # name: how light is made
    SOURCE: {"engine": "mesh", "overrides": ["subsamples=1"]},
    "mesh, 4x4 rays": {"engine": "mesh", "overrides": ["subsamples=4"]},
    "... light beside the camera": {"engine": "mesh", "overrides": ["subsamples=4", BESIDE]},
    "... and two bounces": {
        "engine": "mesh",
        "overrides": ["subsamples=4", BESIDE],
        "bounces": 2,
        "paths": 64,
    },
    "gaussian": {"engine": "gaussian", "overrides": ["subsamples=1"]},
}
KEYS = ("d_mse_x100", "d_tof_mse_x100", "closed_form_mse_x100")


def own_model(run: Run, out: Path) -> Path:
    """A sequence of what a run renders: the quad of every raw frame at its time,
    and its distance as truth.
    """
    sequence = run.sequence()
    quads, distances = np.empty_like(sequence.quads), np.empty_like(sequence.quads)
    for n, time in enumerate(sequence.times):
        rendering = run.render(float(time))
        quads[n] = quad_of_shift(rendering, run.sensor, float(sequence.shifts[n])).numpy()
        distances[n] = (rendering.distance / rendering.opacity.clamp_min(1e-6)).numpy()
    known = np.ones(len(quads), dtype=bool)
    assert len(quads) % FRAMES_PER_QUARTET == 0
    return write(
        "ftorf", out, replace(sequence, quads=quads), Truth(distance=distances, known=known)
    )


def scores(run: Run) -> dict[str, float]:
    """Errors of a run, over everything and over what rests."""
    found = compare(run, report=False)
    return {key: found[key] for key in KEYS} | {
        f"static_{key}": found["static"][key] for key in KEYS
    }


def main() -> None:
    """Simulate, fit, score, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="demo")
    parser.add_argument("--images", type=int, help="raw frames to optimise (the preset's own)")
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    size = tuple(int(part) for part in a.size.split("x"))
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for k, (name, how) in enumerate(ROWS.items()):
            sequence = simulate(a.scene, place / f"sequence{k}", size=size, noise=False, **how)
            run = reconstruct(sequence, place / f"run{k}", PRESET, images=a.images, device=a.device)
            if name == SOURCE:
                own = own_model(run, place / "own")
                rows["own model"] = scores(
                    reconstruct(own, place / "again", PRESET, images=a.images, device=a.device)
                )
            rows[name] = scores(run)
            print(name, flush=True)
    for name, found in rows.items():
        cells = [
            f"{found[key]:8.3f} ({found[key] / rows['own model'][key]:6.2f})"
            for key in (*KEYS[:2], "static_" + KEYS[0])
        ]
        print(
            f"{name:<30}d {cells[0]}   d_ToF {cells[1]}   d, static {cells[2]}   closed form "
            f"{found[KEYS[2]]:8.3f}"
        )
    if a.json:
        facts = {"version": __version__, "scene": a.scene, "size": a.size, "images": a.images}
        a.json.write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
