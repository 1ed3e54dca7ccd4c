"""What a training step costs: consecutive images of a fixed state, without rounds or resets, and what the time goes to.

    python benchmarks/step.py SEQUENCE [--run RUN] [--preset released] [--from IMAGES] [--images N] [--set NAME=VALUE]
        [--device cpu|cuda] [--profile] [--json FILE]

The state is the last checkpoint of RUN or, without one, the first of the preset; every timing begins with it again. On
a GPU the table also says how often the host waited for the device in an image, and with --profile where time went.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import torch
import warp as wp

from gftorf_warp.data.sequence import Sequence
from gftorf_warp.recon import checkpoint, presets
from gftorf_warp.recon.observations import Observations, input_of, observe
from gftorf_warp.recon.settings import Input, ReconSettings
from gftorf_warp.recon.state import State, begin, from_dict, to_dict
from gftorf_warp.recon.step import step, threads_for
from gftorf_warp.recon.train import CHANGES
from gftorf_warp.scene.changes import changed
from gftorf_warp.scene.measured import sensor_of

WARM_UP = 24  # images before anything is timed: kernels are loaded, moments exist
WATCHED = 16  # images in which waits are counted and profiled
PART = 40  # images between two looks at the clock


def settings_of(sequence: Sequence, options: argparse.Namespace) -> ReconSettings:
    """A preset that neither adds nor removes nor dims Gaussians."""
    found = input_of(sequence, Input.AUTO)
    recorded = presets.Recorded(input=found, unambiguous_range=sensor_of(sequence).unambiguous_range)
    settings = changed(presets.preset(options.preset, recorded), options.set, CHANGES)
    settings = replace(settings, densify=replace(settings.densify, stop_share=0.0))
    return threads_for(settings, options.device, 1)[0]


def advance(state: State, observations: Observations, settings: ReconSettings, images: int) -> None:
    """Steps until so many more images are optimised."""
    end = state.images + images
    while state.images < end:
        step(state, observations, settings)


def synchronised(device: str) -> float:
    """The clock [s] after everything that was asked for is done."""
    if device != "cpu":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def waits(state: State, observations: Observations, settings: ReconSettings) -> float:
    """How often the host waits for the device in an image, as torch sees it; reads of Warp are not seen."""
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        advance(state, observations, settings, WATCHED)
    torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in seen) / WATCHED


def profiled(state: State, observations: Observations, settings: ReconSettings, device: str) -> str:
    """Torch's table of the most expensive kernels and operators."""
    kinds = [torch.profiler.ProfilerActivity.CPU]
    kinds += [torch.profiler.ProfilerActivity.CUDA] if device != "cpu" else []
    with torch.profiler.profile(activities=kinds) as profile:
        advance(state, observations, settings, WATCHED)
        synchronised(device)
    order = "self_cpu_time_total" if device == "cpu" else "self_cuda_time_total"
    return profile.key_averages().table(sort_by=order, row_limit=30)


def main() -> int:
    """Print, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--preset", default="released")
    parser.add_argument("--from", dest="begin", type=int, help="pretend that so many images are optimised")
    parser.add_argument("--images", type=int, default=400)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)
    sequence = Sequence.open(a.sequence)
    settings = settings_of(sequence, a)
    observations = observe(sequence, settings, a.device)
    if a.run:
        stored = checkpoint.last(a.run, a.device)
        if stored is None:
            parser.error(f"{a.run} holds no checkpoint")
    else:
        stored = to_dict(begin(observations, settings, seed=0, device=a.device))
    if "shape" in stored["motion"]:  # precision is a matter of speed: that of the command line, not of the run
        stored["motion"]["shape"]["products"] = str(settings.motion.products)
    if a.begin is not None:
        stored["images"] = a.begin

    def fresh() -> State:
        state = from_dict(copy.deepcopy(stored), a.device)
        advance(state, observations, settings, WARM_UP)
        return state

    state = fresh()
    parts = []
    for _ in range(max(a.images // PART, 1)):
        before, begun = state.images, synchronised(a.device)
        advance(state, observations, settings, PART)
        parts.append(1e3 * (synchronised(a.device) - begun) / (state.images - before))
    row: dict[str, object] = {
        "device": torch.cuda.get_device_name(a.device) if a.device != "cpu" else "cpu",
        "warp": wp.__version__,
        "torch": torch.__version__,
        "preset": a.preset,
        "set": a.set,
        "gaussians": len(state.optimiser.field),
        "from": int(stored["images"]),
        "images": PART * len(parts),
        "mean_ms": statistics.mean(parts),
        "median_ms": statistics.median(parts),
    }
    if a.device != "cpu":
        row["waits"] = waits(fresh(), observations, settings)
    print("  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    if a.profile:
        print(profiled(fresh(), observations, settings, a.device))
    if a.json:
        a.json.write_text(json.dumps(row, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
