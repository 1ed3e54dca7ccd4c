"""Does the truth have what the fitted model lacks? One fit to our own rendering, others to rays through the same scene.

    python benchmarks/canary.py [SCENE] [--images N] [--size WIDTHxHEIGHT] [--device cpu] [--json FILE]

All recordings are without noise and fitted by the same settings from the same seed; they differ in how light was made.
Errors are mean squared errors times 100 [m^2] against the analytic truth, which is the same for all, over all raw
frames; a ratio is to the first row. If the ratios were 1, the engines would share what they must not (sensor notes,
T34: more than 2 is wanted for the whole of what rays can do).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from gftorf_warp import __version__
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.sim.simulate import simulate

BESIDE = "emitter=0.03,0,0"
ROWS = {  # name: how light is made
    "gaussian, one ray": {"engine": "gaussian", "overrides": ["subsamples=1"]},
    "mesh, one ray": {"engine": "mesh", "overrides": ["subsamples=1"]},
    "mesh, 4x4 rays": {"engine": "mesh", "overrides": ["subsamples=4"]},
    "... light beside the camera": {"engine": "mesh", "overrides": ["subsamples=4", BESIDE]},
    "... and two bounces": {"engine": "mesh", "overrides": ["subsamples=4", BESIDE], "bounces": 2, "paths": 64},
}
KEYS = ("d_mse_x100", "d_tof_mse_x100", "closed_form_mse_x100")


def errors(scene: str, how: dict, size: tuple[int, int], images: int | None, device: str) -> dict[str, float]:
    """Simulate, fit, score."""
    with tempfile.TemporaryDirectory() as folder:
        sequence = simulate(scene, Path(folder) / "seq", size=size, noise=False, **how)
        run = reconstruct(sequence, Path(folder) / "run", images=images, device=device)
        found = compare(run, report=False)
    return {key: found[key] for key in KEYS} | {f"static_{key}": found["static"][key] for key in KEYS}


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="demo")
    parser.add_argument("--images", type=int, help="raw frames to optimise (the preset's own)")
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    width, height = (int(part) for part in a.size.split("x"))
    rows: dict[str, dict[str, float]] = {}
    for name, how in ROWS.items():
        rows[name] = found = errors(a.scene, how, (width, height), a.images, a.device)
        own = next(iter(rows.values()))
        cells = [f"{found[key]:8.3f} ({found[key] / own[key]:6.2f})" for key in (*KEYS[:2], "static_d_mse_x100")]
        text = "d {}   d_ToF {}   d, static {}".format(*cells)
        print(f"{name:<30}{text}   closed form {found[KEYS[2]]:8.3f}", flush=True)
    if a.json:
        facts = {"version": __version__, "scene": a.scene, "size": a.size, "images": a.images}
        a.json.write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
