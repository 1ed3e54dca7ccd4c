"""The training step: consecutive images of one state, without densification and opacity resets.

Rows are single images and quartets, with and without CUDA graphs, in every precision of the
network; all begin with the same state.
"""

from __future__ import annotations

import copy
import json
import statistics
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ..recon.loop import one_torch_thread
from ..recon.observations import Observations, observe
from ..recon.settings import Batch, ReconSettings
from ..recon.state import State, from_dict
from ..recon.stepper import Stepper
from ..scene.motion import Products
from ..scene.network import Network
from .states import Fitted, pairs_of
from .timing import Report, Timing, lines_of, quietly, watch_of

# Images before anything is timed: kernels are loaded, moments exist. Within the first epoch a step
# takes 1 to 2 ms longer on the host, where a batch is drawn for the first time.
WARM_UP = 24
WATCHED = 16  # images of a profile
ON_DEVICE = {"kernel", "gpu_memset", "gpu_memcpy"}  # kinds of events of torch's profiler
PART = 40  # images of one timing
IMAGES = 400
QUICK_IMAGES, QUICK_PART, QUICK_WARM_UP = 8, 4, 4


def ways(settings: ReconSettings, changes: list[str], device: str) -> list[ReconSettings]:
    """The settings of every row; what ``changes`` sets stays as it is."""
    fixed = {change.partition("=")[0].strip() for change in changes}
    gpu = torch.device(device).type != "cpu"
    moves = settings.motion.kind == Network.kind and gpu
    graphs = [settings.graph] if "graph" in fixed or not gpu else [False, True]
    batches = [settings.schedule.batch] if "schedule.batch" in fixed else list(Batch)
    one = "motion.products" in fixed or not moves
    products = [settings.motion.products] if one else list(Products)
    pairs = [(graph, products[-1]) for graph in graphs]
    pairs += [(graphs[-1], precision) for precision in products[:-1]]
    schedules = [replace(settings.schedule, batch=batch) for batch in batches]
    motions = {precision: replace(settings.motion, products=precision) for precision in products}
    return [
        replace(settings, graph=graph, schedule=schedule, motion=motions[precision])
        for graph, precision in pairs
        for schedule in schedules
    ]


def fresh(
    fitted: Fitted,
    observations: Observations,
    settings: ReconSettings,
    device: str,
    warm_up: int = WARM_UP,
) -> Run:
    """A copy of the state with its stepper, after a warm-up."""
    stored = copy.deepcopy(fitted.stored)
    if "shape" in stored["motion"]:  # of the row, not of the checkpoint
        stored["motion"]["shape"]["products"] = str(settings.motion.products)
    stored["queue"] = []  # batches of other settings have other numbers
    state = from_dict(stored, device)
    run = Run(state, Stepper(state, observations, settings))
    advance(run, warm_up)
    return run


class Run(NamedTuple):
    """A state and its stepper."""

    state: State
    steps: Stepper


def advance(run: Run, images: int) -> int:
    """Optimise so many more images; returns the number of skipped updates."""
    end, skipped = run.state.images + images, run.state.skipped
    while run.state.images < end:
        run.steps.step()
    run.steps.collect()
    return run.state.skipped - skipped


def measure(
    fitted: Fitted,
    device: str,
    *,
    changes: list[str],
    quick: bool,
    images: int | None,
    report: Report,
) -> list[dict[str, Any]]:
    """Rows of :func:`ways`; ``changes`` are those that ``fitted`` was made with."""
    usual = (QUICK_IMAGES, QUICK_PART, QUICK_WARM_UP) if quick else (IMAGES, PART, WARM_UP)
    count, part, warm_up = usual
    chosen, count = ways(fitted.settings, changes, device), images or count
    with one_torch_thread(torch.device(device)):  # as in a run
        return rows_of(
            chosen, fitted, device, images=count, part=part, warm_up=warm_up, report=report
        )


def rows_of(
    chosen: list[ReconSettings],
    fitted: Fitted,
    device: str,
    *,
    images: int,
    part: int = PART,
    warm_up: int = WARM_UP,
    report: Report = quietly,
) -> list[dict[str, Any]]:
    """One row per settings: mean of consecutive images, percentiles of parts [ms per image].

    Args:
        chosen: The settings.
        fitted: The initial state of each.
        device: "cpu" or a CUDA device.
        images: Number of images, rounded down to whole parts, at least one.
        part: Images of one timing.
        warm_up: Images before the first timing.
        report: Called with (images done, images in all).
    """
    parts, rows, watch = max(images // part, 1), [], watch_of(device)
    pairs, gpu = pairs_of(fitted), torch.device(device).type != "cpu"
    for number, settings in enumerate(chosen):
        observations = observe(fitted.sequence, settings, device)
        run = fresh(fitted, observations, settings, device, warm_up)
        state = run.state
        times, before, skipped = [], state.images, 0
        for done in range(1, parts + 1):
            watch.synchronise()
            first, begun = state.images, time.perf_counter()
            skipped += advance(run, part)
            watch.synchronise()
            times.append(1e3 * (time.perf_counter() - begun) / (state.images - first))
            report((number * parts + done) * part, len(chosen) * parts * part, ms=times[-1])
        row: dict[str, Any] = {
            "graph": settings.graph and gpu,
            "batch": str(settings.schedule.batch),
            "products": str(settings.motion.products),
            "N": len(state.optimiser.field),
            "pairs": pairs,
            "from": before,
            "images": state.images - before,
            "flow": observations.flow_source,
            "skipped": skipped,
            "ms_per_image": statistics.mean(times),
            "parts": Timing.of(times).plain(),
        }
        if gpu:
            run = fresh(fitted, observations, settings, device, warm_up)
            row["waits_per_image"] = waits(run, device)
        rows.append(row)
    return rows


def waits(run: Run, device: str) -> float:
    """Synchronisations with the device per image, as torch reports them (not those of Warp)."""
    module = torch.get_device_module(device)
    module.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        advance(run, WATCHED)
    module.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in messages) / WATCHED


def profiled(run: Run, device: str) -> str:
    """Torch's table of the most expensive kernels and operators."""
    on_cpu = torch.device(device).type == "cpu"
    activity = torch.profiler.ProfilerActivity
    activities = [activity.CPU] if on_cpu else [activity.CPU, activity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        advance(run, WATCHED)
        watch_of(device).synchronise()
    order = "self_cpu_time_total" if on_cpu else "self_device_time_total"
    return profile.key_averages().table(sort_by=order, row_limit=30)


def timeline(run: Run, device: str) -> list[str]:
    """GPU activities of a few steps in order: begin and duration [us], stream, name."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        advance(run, WATCHED)
        watch_of(device).synchronise()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        profile.export_chrome_trace(str(path))
        return lines_of_trace(json.loads(path.read_text())["traceEvents"])


def lines_of_trace(events: list[dict[str, Any]]) -> list[str]:
    """Lines of :func:`timeline` from torch's trace events; those of the host are left out."""
    operations = sorted(
        (e for e in events if e.get("cat") in ON_DEVICE), key=lambda event: event["ts"]
    )
    return [
        f"{event['ts'] - operations[0]['ts']:10.1f} {event['dur']:8.1f}  "
        f"{event['args'].get('stream', '-')!s:>4}  {event['name']}"
        for event in operations
    ]


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line per way."""
    heads = ["graph, batch, products", "N", "pairs", "images", "mean", "10 .. 90 % of parts"]
    cells = [
        [
            f"{'graph' if row['graph'] else 'eager'}, {row['batch']}, {row['products']}",
            f"{row['N']:,}",
            f"{row['pairs']:,}",
            str(row["images"]),
            f"{row['ms_per_image']:.3f}",
            f"{row['parts']['p10']:.3f} .. {row['parts']['p90']:.3f}",
            f"{row['waits_per_image']:.2f}" if "waits_per_image" in row else "-",
        ]
        for row in rows
    ]
    title = "training step without densification and opacity resets [ms per image]"
    return lines_of(title, [*heads, "waits per image"], cells)
