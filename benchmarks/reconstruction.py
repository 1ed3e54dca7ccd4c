"""What each ingredient of the demo preset is worth: one reconstruction per row, scored like `gftorf
compare`.

    python benchmarks/reconstruction.py [SEQUENCE] [--images N] [--seeds S] [--device cpu] [--json
    FILE]

The first row is the preset, once per seed; in every other row one thing is changed (seed 0).
Distance errors are mean squared errors times 100 [m^2] over all raw frames: d, and d_ToF decoded
from rendered quads.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path

from gftorf_warp import __version__
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon.presets import demo
from gftorf_warp.recon.settings import FlowSource, ReconSettings
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.initialise import Init
from gftorf_warp.scene.motion import Still

SAMPLE = Path(__file__).parents[1] / "tests" / "data" / "ftorf_sample_box"
KEYS = ("d_mse_x100", "d_tof_mse_x100", "closed_form_mse_x100")


def variants() -> dict[str, ReconSettings]:
    """Settings by what is changed in them."""
    s = demo()
    # from the start it would keep noise where it is
    late = replace(s.schedule, distortion_from=0.4)
    return {
        "flow by DIS": replace(s, flow=FlowSource.DIS),
        "flow by DeepFlow": replace(s, flow=FlowSource.DEEPFLOW),
        "no flow: keys start at rest": replace(s, flow=FlowSource.NONE),
        "motion off": replace(s, motion=replace(s.motion, kind=Still.kind)),
        "random start": replace(
            s, init=replace(s.init, kind=Init.RANDOM, opacity=0.3), schedule=late
        ),
        "black background": replace(s, background=0.0),
        "no depth distortion": replace(s, weights=replace(s.weights, distortion=0.0)),
        "no SSIM": replace(
            s, weights=replace(s.weights, ssim=0.0, distortion=0.01 * s.weights.distortion)
        ),
        "flow loss 0.001": replace(s, weights=replace(s.weights, flow=1e-3)),
        "reflectivity 10x slower": slow(s),
        "decay to 0.01": replace(s, rates_last=s.rates.times(0.01)),
        "half the width": replace(s, width_max=80),
    }


def slow(s: ReconSettings) -> ReconSettings:
    """With a tenth of the rate of the reflectivity."""
    first, last = (
        replace(r, reflectivity_sh=0.1 * r.reflectivity_sh) for r in (s.rates, s.rates_last)
    )
    return replace(s, rates=first, rates_last=last)


def row_of(
    sequence: Path, settings: ReconSettings, images: int | None, seed: int, device: str
) -> dict[str, object]:
    """Reconstruct in a temporary folder, compare, and keep the numbers."""
    with tempfile.TemporaryDirectory() as folder:
        run = reconstruct(
            sequence, Path(folder) / "run", settings, images=images, seed=seed, device=device
        )
        found = compare(run, report=False)
    row = {
        key: found[key]
        for key in (*KEYS, "gaussians", "seconds_reconstruct", "images_optimised", "seed", "device")
    }
    return row | {part: {key: found[part][key] for key in KEYS} for part in ("moving", "static")}


def line(name: str, row: dict) -> str:
    """One row of the table."""
    cells = [
        f"{row[key]:7.3f} /{row['moving'][key]:7.2f} /{row['static'][key]:7.3f}" for key in KEYS[:2]
    ]
    return (
        f"{name:<30}{cells[0]}   {cells[1]}   {row['seconds_reconstruct']:6.1f} s   "
        f"N={row['gaussians']}"
    )


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path, nargs="?", default=SAMPLE)
    parser.add_argument("--images", type=int, help="raw frames to optimise (the preset's own)")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    print(f"{'':<30}{'d: all / moving / static':<25}   d_ToF: all / moving / static")
    rows = {}
    todo = [(f"demo, seed {seed}", demo(), seed) for seed in range(a.seeds)]
    for name, settings, seed in [
        *todo,
        *((name, settings, 0) for name, settings in variants().items()),
    ]:
        rows[name] = row_of(a.sequence, settings, a.images, seed, a.device)
        if len(rows) == 1:
            cells = [rows[name][part]["closed_form_mse_x100"] for part in ("moving", "static")]
            closed = rows[name]["closed_form_mse_x100"]
            print(f"{'closed form':<30}{closed:7.3f} /{cells[0]:7.2f} /{cells[1]:7.3f}")
        print(line(name, rows[name]), flush=True)
    if a.json:
        facts = {"version": __version__, "cpus": os.cpu_count(), "sequence": a.sequence.name}
        a.json.write_text(json.dumps({**facts, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
