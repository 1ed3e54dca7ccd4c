"""What speed costs in quality: two presets, or one with other settings, on several sequences with
several seeds.

    python benchmarks/quality.py SEQUENCE... --out DIR [--preset released] [--fast-preset fast]
    [--images 5000]
        [--seeds 0 1 2] [--device cuda] [--reference NAME=VALUE...] [--fast NAME=VALUE...] [--limit
        SECONDS] [--known FILE] [--json FILE]

Every run is ``presets.shortened`` to --images, so that warm-up, rounds and resets have their places
in it. Errors are those of `gftorf compare`: mean squared errors of the distance times 100 [m^2],
all raw frames, all pixels. The last lines are geometric means over sequences and seeds of fast over
reference. A run that is there and finished is not repeated, so the same command goes on where the
time was up. --known is the JSON of an earlier call, whose reference runs are not repeated either.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

from gftorf_warp import Sequence
from gftorf_warp.bench.command import about
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import with_flow
from gftorf_warp.recon.settings import FlowSource, ReconSettings
from gftorf_warp.recon.train import CHANGES, reconstruct
from gftorf_warp.scene.changes import changed
from gftorf_warp.scene.measured import sensor_of

REFERENCE = ["schedule.batch=frame", "motion.products=float32"]
FAST: list[str] = []
KEYS = ("d", "d_tof")


def settings_of(sequence: Sequence, preset: str, images: int, changes: list[str]) -> ReconSettings:
    """A preset, shortened, with single changes."""
    recorded = presets.Recorded(unambiguous_range=sensor_of(sequence).unambiguous_range)
    return changed(presets.shortened(presets.preset(preset, recorded), images), changes, CHANGES)


def run(
    sequence: Sequence, out: Path, settings: ReconSettings, seed: int, device: str
) -> dict[str, float]:
    """One reconstruction and its score."""
    begun = time.perf_counter()
    found = reconstruct(sequence, out, settings, seed=seed, device=device)
    scores = compare(found, report=False)
    row = {f"{key}": scores[f"{key}_mse_x100"] for key in ("closed_form", *KEYS)}
    row |= {f"{key}_moving": scores["moving"][f"{key}_mse_x100"] for key in ("closed_form", *KEYS)}
    row |= {"seconds": found.config["seconds_reconstruct"], "gaussians": found.gaussians}
    print(f"{out.name:<32}" + "  ".join(f"{k} {v:.4g}" for k, v in row.items()), flush=True)
    print(f"    {time.perf_counter() - begun:.1f} s in all", flush=True)
    return row


def ratios(rows: dict[str, dict[str, dict]]) -> dict[str, float]:
    """Geometric mean over all pairs of fast over reference, by error."""
    pairs = [
        (rows["fast"][name], rows["reference"][name])
        for name in rows["fast"]
        if name in rows["reference"]
    ]
    return (
        {
            key: math.exp(float(np.mean([math.log(a[key] / b[key]) for a, b in pairs])))
            for key in KEYS
        }
        if pairs
        else {}
    )


def main() -> None:
    """Run what the time allows, print, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="released")
    parser.add_argument("--fast-preset", default="fast")
    parser.add_argument("--images", type=int, default=5000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--reference", nargs="+", default=REFERENCE, metavar="NAME=VALUE")
    parser.add_argument("--fast", nargs="+", default=FAST, metavar="NAME=VALUE")
    parser.add_argument("--known", type=Path)
    parser.add_argument(
        "--limit", type=float, default=math.inf, help="no further run begins after so many seconds"
    )
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)
    begun, left = time.monotonic(), 0
    rows: dict[str, dict[str, dict]] = {"fast": {}, "reference": {}}
    if a.known:
        rows["reference"] = json.loads(a.known.read_text())["rows"]["reference"]
    sequences = [Sequence.open(path) for path in a.sequences]
    flown = [with_flow(sequence, FlowSource.AUTO)[0] for sequence in sequences]
    for seed in a.seeds:
        for way, preset, changes in (
            ("fast", a.fast_preset, a.fast),
            ("reference", a.preset, a.reference),
        ):
            for path, sequence in zip(a.sequences, flown, strict=True):
                if f"{path.name}-{seed}" in rows[way]:
                    continue
                if time.monotonic() - begun > a.limit:
                    left += 1
                    continue
                settings = settings_of(sequence, preset, a.images, changes)
                settings = replace(
                    settings, schedule=replace(settings.schedule, checkpoint_every_s=1e9)
                )
                name = f"{path.name}-{seed}"
                rows[way][name] = run(sequence, a.out / f"{name}-{way}", settings, seed, a.device)
    means = ratios(rows)
    print(
        "fast over reference, geometric mean: "
        + ", ".join(f"{k} {v:.4f}" for k, v in means.items())
    )
    if left:
        print(f"{left} runs are left: run this again to go on")
    if a.json:
        what = {"preset": a.preset, "fast_preset": a.fast_preset, "images": a.images}
        what |= {"reference": a.reference, "fast": a.fast}
        a.json.write_text(
            json.dumps(about(a.device) | what | {"ratios": means, "rows": rows}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
