"""The ablation rows of the paper at a size for two CPU cores: each with several seeds, scored like
`gftorf compare`.

    python benchmarks/ablation.py SEQUENCE... [--seeds 3] [--images 6000] [--rows nobias dd h1 h1h2
    h1h2dd]
        [--quad-scale S] [--distortion W...] [--together 2] [--device cpu] [--json FILE]

Preset `paper` with 2,000 Gaussians at the start and 5,000 at most, images of 80 columns, a network
of 3 layers of 32 with 6 frequencies, and a course for a tenth of the images: rates of centres and
motion are twice and those of shape five times as large, because there are fewer steps. Reflectivity
keeps the published rates, which are what the rows are about. Both heuristics are about the true
reflectivity, in the units of the normalised quads, being below 0.5, so that a start at 0.5 is too
bright: `--quad-scale` sets those units, and the first line says what they are.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import mean

from gftorf_warp import __version__
from gftorf_warp.recon import presets
from gftorf_warp.recon.settings import ReconSettings

KEYS = ("d", "d_tof")
SHAPE_RATES = ("log_scale", "quaternion")


def small(images: int, unambiguous_range: float) -> ReconSettings:
    """The preset at that size."""
    s = presets.paper(presets.Recorded(unambiguous_range=unambiguous_range))

    def faster(rates):
        shape = {name: 5.0 * getattr(rates, name) for name in SHAPE_RATES}
        return replace(rates, mean=2.0 * rates.mean, motion=2.0 * rates.motion, **shape)

    share = images / 6000
    return replace(
        s,
        width_max=80,
        init=replace(s.init, count=2000),
        motion=replace(
            s.motion, layers=3, width=32, skip_after=2, position_frequencies=6, time_frequencies=6
        ),
        rates=faster(s.rates),
        rates_last=faster(s.rates_last),
        schedule=replace(
            s.schedule,
            images=images,
            warm_up=round(600 * share),
            flow_from=round(600 * share),
            sh_degree_every=round(250 * share),
        ),
        densify=replace(
            s.densify,
            every=round(100 * share),
            start=round(200 * share),
            scale_from=round(1500 * share),
            scale_range=(0.0, s.densify.scale_range[1]),
            reset_every=round(1500 * share),
            gaussians_max=5000,
        ),
    )


def reflectivities(path: Path, scale: float | None) -> tuple[float, float, float]:
    """10th, 50th and 90th percentile of the reflectivity a d^2 that measured quartets decode to."""
    import numpy as np

    from gftorf_warp import Sequence
    from gftorf_warp.data.decode import closed_form_distance, quad_scale, quartet_phasor

    sequence = Sequence.open(path)
    factor = quad_scale(sequence)[0] if scale is None else scale
    found = [
        factor / 2 * np.hypot(*quartet_phasor(sequence, i)) * closed_form_distance(sequence, i) ** 2
        for i in sequence.complete_quartets
    ]
    return tuple(float(value) for value in np.percentile(found, [10, 50, 90]))


def row_of(job: tuple[Path, str, int, int, str, float | None, float | None]) -> dict[str, object]:
    """Reconstruct in a temporary folder, compare, and keep the numbers."""
    from gftorf_warp import Sequence
    from gftorf_warp.evaluate.compare import compare
    from gftorf_warp.recon.train import reconstruct
    from gftorf_warp.scene.measured import sensor_of

    path, row, seed, images, device, distortion, scale = job
    logging.disable(logging.WARNING)
    sequence = Sequence.open(path)
    settings = presets.ablated(small(images, sensor_of(sequence).unambiguous_range), row)
    settings = replace(settings, quad_scale=scale)
    if distortion is not None:
        settings = replace(settings, weights=replace(settings.weights, distortion=distortion))
    with tempfile.TemporaryDirectory() as folder:
        run = reconstruct(sequence, Path(folder) / "run", settings, seed=seed, device=device)
        found = compare(run, report=False)
    groups = {"all": found, "moving": found["moving"], "static": found["static"]}
    numbers = {
        group: {key: values[f"{key}_mse_x100"] for key in KEYS} for group, values in groups.items()
    }
    facts = {
        "sequence": path.name,
        "row": row,
        "seed": seed,
        "distortion": settings.weights.distortion,
    }
    facts["quad_scale"] = run.quad_scale
    return {
        **facts,
        **numbers,
        "gaussians": found["gaussians"],
        "seconds": found["seconds_reconstruct"],
    }


def line(name: str, rows: list[dict]) -> str:
    """Means over the seeds of d and d_ToF on all, moving and static pixels,
    and the span of d over all.
    """
    cells = [
        " / ".join(
            f"{mean(row[group][key] for row in rows):8.3f}" for group in ("all", "moving", "static")
        )
        for key in KEYS
    ]
    span = [row["all"]["d"] for row in rows]
    seconds = mean(row["seconds"] for row in rows)
    return (
        f"{name:<26}{cells[0]}   {cells[1]}   d {min(span):.3f} .. {max(span):.3f}   "
        f"{seconds:.0f} s"
    )


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--rows", nargs="+", default=list(presets.ABLATIONS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--images", type=int, default=6000)
    parser.add_argument(
        "--distortion",
        type=float,
        nargs="+",
        default=[None],
        help="other weights of it, for a sweep",
    )
    parser.add_argument(
        "--quad-scale", type=float, help="multiplies the quads (to a largest phasor of 1)"
    )
    parser.add_argument("--together", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    jobs = [
        (path, row, seed, a.images, a.device, weight, a.quad_scale)
        for path in a.sequences
        for row in a.rows
        for weight in a.distortion
        for seed in range(a.seeds)
    ]
    print(f"{'':<26}{'d: all / moving / static':<30}   d_ToF: all / moving / static", flush=True)
    for path in a.sequences:
        low, middle, high = reflectivities(path, a.quad_scale)
        print(
            f"{path.name}: reflectivity {low:.2f} .. {middle:.2f} .. {high:.2f} (10, 50, 90 %)",
            flush=True,
        )
    rows: list[dict] = []
    with multiprocessing.get_context("spawn").Pool(a.together) as pool:
        for row in pool.imap(row_of, jobs):
            rows.append(row)
            if len(rows) % a.seeds == 0:
                weight = f" {row['distortion']:g}" if row["distortion"] else ""
                print(
                    line(f"{row['sequence'][:14]} {row['row']}{weight}", rows[-a.seeds :]),
                    flush=True,
                )
            if a.json:
                a.json.write_text(
                    json.dumps({"version": __version__, "images": a.images, "rows": rows}, indent=2)
                )


if __name__ == "__main__":
    main()
