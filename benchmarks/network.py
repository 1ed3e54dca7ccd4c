"""What the motion network costs: forward and backward, all queries of a step stacked, in each
precision.

    python benchmarks/network.py [--device cpu|cuda] [--gaussians N ..] [--queries Q ..] [--repeats
    R]
                                 [--products float32|half|'half by torch' ..]
                                 [--hidden SHARE] [--profile] [--json FILE]

A query is one key time; a timing holds one encoding of positions, as a step has it, and the
gradient of all weights. ``half`` is the backend of a run on the device, ``half by torch`` that by
cuBLAS, by default where they differ. With ``--hidden`` that fraction of the Gaussians, drawn at
random, has no gradient. On a GPU every row is timed twice: called from Python, and replayed as a
CUDA graph, which must give what the call gave. Rows of one N and Q take turns. ``kernels`` counts
what the device ran in one call, products included; ``error`` is the largest difference of an offset
from that in float32, for weights whose offsets are a few decimetres. With ``--profile`` what ran
longest in it is listed under every row, replayed on a GPU: where the next saving is to be looked
for.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from gftorf_warp.bench.command import about
from gftorf_warp.bench.motion import BY_TORCH, kinds, points, products_of, set_backend
from gftorf_warp.bench.timing import WARM_UP, Watch, watch_of
from gftorf_warp.scene.gaussians import GaussianField
from gftorf_warp.scene.motion import MotionSettings, Products
from gftorf_warp.scene.network import Network

KEYS = 16  # of 60 frames
LENGTH = 7.5  # unambiguous range at 20 MHz [m]
PROFILED, NAME = 20, 160  # lines of a profile, characters of a name in it
MEGAFLOP = 3.007  # per Gaussian and query, forward and backward

Call = Callable[[], list[torch.Tensor]]


def field(count: int, device: str) -> GaussianField:
    """Gaussians in a box of six metres."""
    mean = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 6 - 3
    return points(mean).map(lambda value: value.to(device))


def network(kind: str, device: str) -> Network:
    """The published network, moving, as one of ``kinds``."""
    generator = torch.Generator().manual_seed(0)
    times = torch.arange(KEYS, dtype=torch.float64) * (4 / 120)
    settings = replace(MotionSettings(), products=products_of(kind))
    made = Network(times, settings, duration=float(times[-1]), length=LENGTH, generator=generator)
    with torch.no_grad():
        made.head.weight.normal_(0.0, 0.05, generator=generator)
    made = made.to(device)
    set_backend(made, kind)
    return made


def call_of(made: Network, gaussians: GaussianField, queries: int, hidden: float) -> Call:
    """Offsets at the middle keys and the gradient of every parameter;
    a share of the Gaussians has none of its own.
    """
    generator = torch.Generator().manual_seed(2)
    cotangent = (
        torch.randn(queries, len(gaussians), 3, generator=generator).to(gaussians.mean) / 76_800
    )
    cotangent *= (torch.rand(len(gaussians), 1, generator=generator) >= hidden).to(cotangent)
    keys, parameters = list(range(7, 7 + queries)), list(made.parameters())

    def call() -> list[torch.Tensor]:
        offsets = made.at_keys(made.bind(gaussians), keys).offset
        return [offsets.detach(), *torch.autograd.grad(offsets, parameters, cotangent)]

    return call


def once(run: Callable[[], object], watch: Watch) -> float:
    """Time of one run [ms]."""
    begun = watch.mark()
    run()
    return watch.between(begun, watch.mark())


def kernels(call: Call) -> int:
    """How many kernels, copies and fills a call puts on the device."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        call()
        torch.cuda.synchronize()
    return sum(event.device_type == torch.autograd.DeviceType.CUDA for event in profile.events())


def longest(run: Callable[[], object], device: str) -> list[str]:
    """Lines of what takes the most time in one run: microseconds, how often, name."""
    kinds = torch.profiler.ProfilerActivity
    with torch.profiler.profile(
        activities=[kinds.CPU if device == "cpu" else kinds.CUDA]
    ) as profile:
        run()
        if device != "cpu":
            torch.cuda.synchronize()
    times = {
        event.key: (
            event.self_cpu_time_total if device == "cpu" else event.self_device_time_total,
            event.count,
        )
        for event in profile.key_averages()
    }
    lines = [f"    {sum(spent for spent, _ in times.values()):10.1f} us in all, gaps not counted"]
    for name, (spent, often) in sorted(times.items(), key=lambda item: -item[1][0])[:PROFILED]:
        lines.append(f"    {spent:10.1f} us {often:4d} x  {name[:NAME]}")
    return lines


def rows_of(count: int, queries: int, options: argparse.Namespace) -> list[dict[str, object]]:
    """One row per precision."""
    device, watch, gaussians = (
        options.device,
        watch_of(options.device),
        field(count, options.device),
    )
    wanted = options.products or kinds(device)
    calls = {
        kind: call_of(network(kind, device), gaussians, queries, options.hidden) for kind in wanted
    }
    exact = call_of(network(str(Products.FLOAT32), device), gaussians, queries, options.hidden)()[0]
    rows: dict[str, dict[str, object]] = {}
    runs: dict[tuple[str, str], Callable[[], object]] = {}
    for kind, call in calls.items():
        for _ in range(WARM_UP):
            found = call()
        row: dict[str, object] = {"gaussians": count, "queries": queries, "products": kind}
        row["error_mm"] = 1e3 * float((found[0] - exact).norm(dim=-1).max())
        runs[kind, "called"] = call
        replay = watch.captured(call)
        if replay is not None:
            row["replay_equals_call"] = all(map(torch.equal, replay(), call()))
            row["kernels"] = kernels(call)
            runs[kind, "replayed"] = replay
        rows[kind] = row
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for _ in range(options.repeats):
        for name, run in runs.items():
            times[name].append(once(run, watch))
    if options.profile:
        for (kind, _), run in runs.items():  # replayed comes last
            rows[kind]["profile"] = longest(run, device)
    for (kind, how), taken in times.items():
        tenths = statistics.quantiles(taken, n=10) if len(taken) > 1 else taken * 9
        best = statistics.median(taken)
        rows[kind] |= {f"{how}_ms": best, f"{how}_p10_ms": tenths[0], f"{how}_p90_ms": tenths[-1]}
        rows[kind] |= {f"{how}_per_query_ms": best / queries}
        rows[kind] |= {f"{how}_tflops": MEGAFLOP * 1e-6 * count * queries / (1e-3 * best)}
    return list(rows.values())


def main() -> int:
    """Print, write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, nargs="+", default=[20_000, 100_000])
    parser.add_argument("--queries", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--products", nargs="+", choices=[*map(str, Products), BY_TORCH])
    parser.add_argument(
        "--hidden", type=float, default=0.0, help="share of Gaussians without gradient"
    )
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found, rows = about(options.device), []
    print(" - ".join(map(str, found.values())))
    head = [
        "N",
        "Q",
        "products",
        "kernels",
        "called",
        "per query",
        "replayed",
        "per query",
        "TFLOP/s",
        "error [mm]",
    ]
    print("".join(f"{name:>14}" for name in head), flush=True)
    for count in options.gaussians:
        for queries in options.queries:
            for row in rows_of(count, queries, options):
                rows.append(row)
                names = ["called_ms", "called_per_query_ms", "replayed_ms", "replayed_per_query_ms"]
                numbers = [row.get(name) for name in [*names, "replayed_tflops", "error_mm"]]
                texts = [row["gaussians"], row["queries"], row["products"], row.get("kernels", "-")]
                texts += ["-" if number is None else f"{number:.3f}" for number in numbers]
                texts += ["" if row.get("replay_equals_call", True) else " replay differs"]
                print(
                    "\n".join(["".join(f"{text:>14}" for text in texts), *row.get("profile", [])]),
                    flush=True,
                )
    if options.json:
        options.json.write_text(
            json.dumps(found | {"command": " ".join(sys.argv), "rows": rows}, indent=1) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
