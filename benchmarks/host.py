"""Where the host's time of a reconstruction goes (design/whole-run.md).

    python benchmarks/host.py SEQ OUT [--preset fast] [--device cuda] [--images N] [--seed S]

Times are those that the host spends inside a function, calls of others included; nobody waits for a device because of
them, so a wait counts where the host waits. Run it twice: the first time compiles kernels.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path

import torch
import warp as wp

from gftorf_warp.recon import captured, checkpoint, dead, densify, train
from gftorf_warp.recon.captured import CapturedSteps
from gftorf_warp.recon.diagnostics import Watch
from gftorf_warp.recon.padded import Padded
from gftorf_warp.recon.run import Run
from gftorf_warp.render import bridge

WATCHED = [
    (train, "observe"),
    (train, "begin"),
    (CapturedSteps, "__init__"),
    (CapturedSteps, "step"),
    (CapturedSteps, "_body"),
    (bridge.Captured, "_capture"),
    (torch.cuda, "empty_cache"),
    (torch.cuda.CUDAGraph, "capture_end"),
    (torch.cuda.CUDAGraph, "replay"),
    (captured, "densify_after"),
    (densify, "round_of"),
    (Padded, "adopt"),
    (Padded, "_reserve"),
    (CapturedSteps, "_forget"),
    (CapturedSteps, "_look"),
    (CapturedSteps, "collect"),
    (train._Loop, "report"),
    (Watch, "begin"),
    (Watch, "finish"),
    (dead, "is_dead"),
    (checkpoint, "save"),
    (Run, "open"),
]
TOLD = {"_forget", "_reserve"}  # whose callers are shown: why there are other graphs


def watch(owner: object, name: str, spent: dict[str, list[float]], told: list[str]) -> None:
    """Let a function write down how long it takes."""
    what, of = getattr(owner, name), getattr(owner, "__name__", str(owner)).rpartition(".")[2]

    def timed(*given, **named):
        if name in TOLD:
            frames = [sys._getframe(depth).f_code.co_name for depth in (1, 2, 3)]
            told.append(
                f"{time.perf_counter() - begun:7.3f} s  {name} by {', '.join(f for f in frames if f != 'timed')}"
            )
        start = time.perf_counter()
        try:
            return what(*given, **named)
        finally:
            spent[f"{of}.{name}"].append(time.perf_counter() - start)

    begun = time.perf_counter()
    setattr(owner, name, timed)


def main() -> None:
    """Reconstruct and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--images", type=int)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    spent: dict[str, list[float]] = defaultdict(list)
    told: list[str] = []
    for owner, name in WATCHED:
        watch(owner, name, spent, told)
    how = {"images": options.images, "seed": options.seed, "device": options.device, "fresh": True}
    start = time.perf_counter()
    run = train.reconstruct(options.sequence, options.out, options.preset, **how)
    wall = time.perf_counter() - start
    print(f"{wall:.2f} s, {run.config['seconds_reconstruct']:.2f} s by config.json, {run.gaussians:,} Gaussians")
    print(f"{'':28}{'calls':>8}{'sum ms':>10}{'median':>10}{'longest':>10}")
    for name, seconds in sorted(spent.items(), key=lambda pair: -sum(pair[1])):
        numbers = 1e3 * sum(seconds), 1e3 * statistics.median(seconds), 1e3 * max(seconds)
        print(f"{name:28}{len(seconds):8}" + "".join(f"{number:10.2f}" for number in numbers))
    print("\n".join(told))


if __name__ == "__main__":
    main()
