"""What a step of a neural volume costs at the published size, and what a whole run would take.

    python benchmarks/volumes.py [--preset ftorf|torf|volume] [--steps N] [--graph on|off ..]
                                 [--products float32|half ..] [--device cpu|cuda] [--sequence SEQ]
                                 [--set NAME=VALUE ..] [--profile] [--json FILE]

Without a sequence, 60 raw frames of ``sliding_cube`` are simulated. Each row times N steps, updates
of Adam included, as CUDA graphs or launched one by one, after a warm-up of a third as many: for
``ftorf`` and ``volume`` those in which a quartet is simultaneous and those with scene flow, for
``torf`` all alike. ``whole run`` extrapolates to the steps of the preset; ``image`` is the
rendering of one raw frame at the size of the sequence. With ``--profile`` what ran longest in ten
steps is listed above every row, and how long the device was busy in each.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gftorf_warp.bench.command import about
from gftorf_warp.data.read import read
from gftorf_warp.data.sequence import Sequence
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.record import Metrics
from gftorf_warp.recon.settings import Input, ReconSettings
from gftorf_warp.recon.train import CHANGES
from gftorf_warp.recon.volume.loop import VolumeLoop
from gftorf_warp.recon.volume.render import rendering_of
from gftorf_warp.recon.volume.state import VolumeState, begin
from gftorf_warp.recon.volume.step import VolumeStep
from gftorf_warp.recon.volume.targets import Targets
from gftorf_warp.scene.changes import changed
from gftorf_warp.scene.measured import camera_of, sensor_of
from gftorf_warp.scene.motion import Products
from gftorf_warp.sim.simulate import simulate

PROFILED_STEPS, PROFILED_LINES = 10, 20
WARM_UP = 3  # so many times fewer steps than are timed: nearly always all graphs are captured
NOTHING = Path("no folder: neither rows nor checkpoints are written")


def main() -> None:
    """Print a table, and write it as JSON."""
    options = parsed()
    with tempfile.TemporaryDirectory() as folder:
        sequence = recorded(options.sequence, Path(folder))
    rows, settings = [], settings_of(options.preset, sequence, "float32", options.set)
    targets = Targets(observe(sequence, settings, options.device))
    for products in options.products:
        for graph in options.graph:
            settings = settings_of(options.preset, sequence, products, options.set)
            rows.append(measured(targets, replace(settings, graph=graph == "on"), options))
            print(line(rows[-1]), flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps({**about(options.device), "rows": rows}, indent=2))


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--preset", choices=("ftorf", "torf", "volume"), default="ftorf")
    parser.add_argument("--steps", type=int, default=200, help="of each kind")
    parser.add_argument("--products", nargs="+", default=["float32", "half"])
    parser.add_argument("--graph", nargs="+", choices=("on", "off"), help="default: on CUDA both")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--sequence", help="folder; simulated otherwise")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json")
    options = parser.parse_args()
    options.graph = options.graph or (["off"] if options.device == "cpu" else ["on", "off"])
    return options


def recorded(path: str | None, folder: Path) -> Sequence:
    """The sequence to fit."""
    return read(path or simulate("sliding_cube", folder / "sliding_cube"))


def settings_of(
    preset: str, sequence: Sequence, products: str, changes: list[str]
) -> ReconSettings:
    """The preset, in a precision and with changes."""
    wanted = Input.PHASOR if preset == "torf" else Input.QUADS
    settings = presets.preset(preset, presets.Recorded.of(sequence, wanted))
    assert settings.volume is not None
    volume = replace(settings.volume, products=Products(products))
    settings = changed(replace(settings, volume=volume), changes, CHANGES)
    return replace(settings, cycle=sequence.cycle)


def measured(
    targets: Targets, settings: ReconSettings, options: argparse.Namespace
) -> dict[str, Any]:
    """Seconds per step of each kind, and of an image."""
    device = torch.device(options.device)
    state = begin(settings, targets, 0, device)
    step = VolumeStep(state, targets, settings)
    loop = VolumeLoop(step, NOTHING, Metrics(NOTHING), lambda: 0.0, None)
    assert settings.volume is not None
    total = settings.schedule.images
    starts = {"steps": 0}
    shares = {"steps": 1.0}
    if options.preset != "torf":
        share = settings.volume.scene_flow.simultaneous_share
        starts = {"simultaneous": 0, "scene flow": round(share * total) + 1}
        shares = {"simultaneous": share, "scene flow": 1.0 - share}
    seconds = {}
    for name, start in starts.items():
        state.images = start
        timed(loop, max(1, options.steps // WARM_UP), device)
        seconds[name] = timed(loop, options.steps, device) / options.steps
        if options.profile:
            profile(loop, device)
    whole = sum(shares[name] * value for name, value in seconds.items()) * total
    return {
        "preset": options.preset,
        "products": str(settings.volume.products),
        "graph": settings.graph,
        "seconds_per_step": seconds,
        "seconds_per_image": seconds_per_image(targets.observations.sequence, state, device),
        "steps": total,
        "hours_whole_run": whole / 3600.0,
        "gigabytes": peak(device),
        "loss_is_finite": bool(torch.stack([*state.sums.values()]).isfinite().all()),
    }


def timed(loop: VolumeLoop, steps: int, device: torch.device) -> float:
    """Seconds of some steps, the device included."""
    wait(device)
    begun = time.perf_counter()
    for _ in range(steps):
        loop.step()
    wait(device)
    return time.perf_counter() - begun


def seconds_per_image(sequence: Sequence, state: VolumeState, device: torch.device) -> float:
    """Seconds of one rendering between two quartet starts, after a first one."""
    camera, sensor = camera_of(sequence, 0), sensor_of(sequence)
    for _ in range(2):
        wait(device)
        begun = time.perf_counter()
        time_s = float(sequence.times[1])
        rendering_of(state.volume, time_s, camera, sensor, quad_scale=1.0, colour_scale=1.0)
        wait(device)
    return time.perf_counter() - begun


def profile(loop: VolumeLoop, device: torch.device) -> None:
    """Print what ran longest in a few steps, and what a step costs host and device."""
    kinds = [torch.profiler.ProfilerActivity.CPU]
    kinds += [torch.profiler.ProfilerActivity.CUDA] if device.type == "cuda" else []
    with torch.profiler.profile(activities=kinds) as found:
        timed(loop, PROFILED_STEPS, device)
    averages = found.key_averages()
    key = "self_cuda_time_total" if device.type == "cuda" else "self_cpu_time_total"
    print(averages.table(sort_by=key, row_limit=PROFILED_LINES, max_name_column_width=60))
    launches = sum(one.count for one in averages if one.key == "cudaLaunchKernel")
    busy = sum(one.self_device_time_total for one in averages) / 1e3
    print(f"kernels launched one by one, per step: {launches / PROFILED_STEPS:.0f}")
    print(f"device busy per step: {busy / PROFILED_STEPS:.2f} ms")


def wait(device: torch.device) -> None:
    """Until the device has done everything."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def peak(device: torch.device) -> float | None:
    """Largest memory of the device so far [GB]."""
    if device.type != "cuda":
        return None
    return torch.cuda.max_memory_allocated(device) / 1e9


def line(row: dict[str, Any]) -> str:
    """A row in words."""
    steps = ", ".join(f"{n} {1e3 * s:.2f} ms" for n, s in row["seconds_per_step"].items())
    memory = "" if row["gigabytes"] is None else f", {row['gigabytes']:.1f} GB"
    return (
        f"{row['preset']} {row['products']}, graph {'on' if row['graph'] else 'off'}: "
        f"{steps}; whole run of {row['steps']} steps "
        f"{row['hours_whole_run']:.2f} h; image {row['seconds_per_image']:.2f} s{memory}"
        f"{'' if row['loss_is_finite'] else '; the loss is NOT finite'}"
    )


if __name__ == "__main__":
    main()
