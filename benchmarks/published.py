"""Whole reconstructions with the published presets, several at once; run it again to go on where
the time was up.

    python benchmarks/published.py SEQUENCE... --out DIR [--preset released] [--images N] [--seeds
    S]
        [--ablations ROW...] [--set NAME=VALUE] [--device cuda] [--together 3] [--limit SECONDS]
        [--json FILE]

Every reconstruction is a process of its own, `gftorf reconstruct`, which is told to stop (SIGTERM)
when the time is up and goes on from its checkpoint the next time. Finished ones are scored like
`gftorf compare`: mean squared errors of the distance times 100 [m^2], all raw frames. N(t) is the
number of Gaussians along the run.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

KEYS = ("closed_form", "d", "d_normalised", "d_tof")
GROUPS = ("all", "moving", "static")


def command(
    sequence: Path, out: Path, options: argparse.Namespace, seed: int, row: str | None
) -> list[str]:
    """One reconstruction as a command line."""
    words = [sys.executable, "-m", "gftorf_warp", "reconstruct", str(sequence), "--out", str(out)]
    words += ["--preset", options.preset, "--device", options.device, "--seed", str(seed)]
    if options.images:
        words += ["--images", str(options.images)]
    for change in options.set:
        words += ["--set", change]
    return words + (["--ablation", row] if row else [])


def run_all(jobs: dict[Path, list[str]], together: int, limit: float) -> dict[Path, int | None]:
    """Exit code of every job that ran; None for one that had no turn before the time was up."""
    begun, waiting, running = time.monotonic(), dict(jobs), {}
    codes: dict[Path, int | None] = dict.fromkeys(jobs)
    stopping = False
    while waiting or running:
        late = time.monotonic() - begun > limit
        while waiting and len(running) < together and not late:
            out = next(iter(waiting))
            out.parent.mkdir(parents=True, exist_ok=True)
            with (out.parent / f"{out.name}.log").open("a") as log:
                running[out] = subprocess.Popen(waiting.pop(out), stdout=log, stderr=log)
        if late and not stopping:
            stopping = True
            waiting.clear()
            for process in running.values():
                process.send_signal(signal.SIGTERM)
        for out, process in list(running.items()):
            if process.poll() is not None:
                codes[out] = running.pop(out).returncode
                print(
                    f"{time.monotonic() - begun:6.1f} s  {out.name}: exit {codes[out]}", flush=True
                )
        time.sleep(0.5)
    return codes


def scored(out: Path, device: str) -> dict[str, object]:
    """Numbers of a finished run."""
    from gftorf_warp.evaluate.compare import compare
    from gftorf_warp.recon.run import Run

    found = compare(Run.open(out, device), report=False)
    diagnostics = [
        json.loads(line) for line in (out / "diagnostics.jsonl").read_text().splitlines()
    ]
    groups = {"all": found, "moving": found["moving"], "static": found["static"]}
    return {
        **{
            group: {key: values[f"{key}_mse_x100"] for key in KEYS}
            for group, values in groups.items()
        },
        **{
            key: found[key]
            for key in ("gaussians", "images_optimised", "seconds_reconstruct", "quad_psnr_db")
        },
        "gaussians_along": {row["images"]: row["gaussians"] for row in diagnostics[::5]},
    }


def lines(name: str, row: dict) -> list[str]:
    """A row of the table: every kind of distance on all, moving and static pixels,
    then N along the run.
    """
    cells = (
        " / ".join("-" if row[g][key] is None else f"{row[g][key]:.3f}" for g in GROUPS)
        for key in KEYS
    )
    along = ", ".join(f"{images}: {count}" for images, count in row["gaussians_along"].items())
    tail = (
        f"N={row['gaussians']}  {row['seconds_reconstruct']:.0f} s  {row['images_optimised']} "
        f"images"
    )
    return [
        f"{name:<28}" + "".join(f"{cell:>30}" for cell in cells) + f"   {tail}",
        f"    N(t) {along}",
    ]


def main() -> None:
    """Run what the time allows, print a table of what is finished, and optionally store it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="released")
    parser.add_argument("--images", type=int)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--ablations", nargs="*", default=[None])
    parser.add_argument("--set", action="append", default=[], help="NAME=VALUE, passed on")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--together", type=int, default=3, help="processes that share the device")
    parser.add_argument(
        "--limit", type=float, default=1e9, help="seconds after which all are told to stop"
    )
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    jobs = {
        options.out / "-".join(filter(None, (sequence.name, options.preset, row, str(seed)))): (
            sequence,
            seed,
            row,
        )
        for sequence in options.sequences
        for row in options.ablations
        for seed in range(options.seeds)
    }
    commands = {out: command(job[0], out, options, *job[1:]) for out, job in jobs.items()}
    codes = run_all(commands, options.together, options.limit)
    rows = {}
    print(
        f"MSE x100 [m^2]: {' / '.join(GROUPS)} pixels; seconds; images\n{'':<28}"
        + "".join(f"{k:>30}" for k in KEYS)
    )
    for out, code in codes.items():
        if code == 0:
            rows[out.name] = scored(out, options.device)
            print("\n".join(lines(out.name, rows[out.name])), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")
    print(
        "finished"
        if all(code == 0 for code in codes.values())
        else "not finished: run this again to go on"
    )


if __name__ == "__main__":
    main()
