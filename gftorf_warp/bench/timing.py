"""Repeated timings after a warm-up, by device events on CUDA; medians and percentiles."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import torch

LOG = logging.getLogger("gftorf_warp")
WARM_UP = 3  # runs before the first timing, which load kernels and allocate
Function = Callable[[], object]
Report = Callable[..., None]


class Watch(Protocol):
    """Clock and graphs of one device."""

    def mark(self) -> Any:
        """A time stamp in stream order."""

    def between(self, start: Any, stop: Any) -> float:
        """Milliseconds between two time stamps; waits for the second."""

    def synchronise(self) -> None:
        """Wait for the device."""

    def captured(self, function: Function) -> Function | None:
        """A function that replays the graph of another; None on a CPU."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Statistics of repeated timings."""

    median: float
    """[ms]"""
    p10: float
    """10th percentile [ms]."""
    p90: float
    """90th percentile [ms]."""
    runs: int
    """Number of repetitions."""

    @classmethod
    def of(cls, times: list[float]) -> Timing:
        """From single times [ms]."""
        p10, median, p90 = (float(value) for value in np.percentile(times, [10, 50, 90]))
        return cls(median=median, p10=p10, p90=p90, runs=len(times))

    def plain(self) -> dict[str, float | int]:
        """For JSON."""
        return asdict(self)


class HostWatch:
    """The clock of the host, where calls are synchronous."""

    def mark(self) -> float:
        """Now [s]."""
        return time.perf_counter()

    def between(self, start: float, stop: float) -> float:
        """Milliseconds between two marks."""
        return 1e3 * (stop - start)

    def synchronise(self) -> None:
        """There is nothing to wait for."""

    def captured(self, function: Function) -> Function | None:  # noqa: ARG002
        """There are no graphs."""
        return None


class TorchWatch:
    """Events of torch on its current stream."""

    def __init__(self, device: torch.device | str):
        self.module = torch.get_device_module(torch.device(device))

    def mark(self) -> Any:
        """An event, recorded."""
        event = self.module.Event(enable_timing=True)
        event.record()
        return event

    def between(self, start: Any, stop: Any) -> float:
        """Milliseconds between two events."""
        stop.synchronize()
        return start.elapsed_time(stop)

    def synchronise(self) -> None:
        """Wait for the device."""
        self.module.synchronize()

    def captured(self, function: Function) -> Function | None:
        """A CUDA graph of the function, which first runs on a side stream, as torch requires."""
        side = self.module.Stream()
        side.wait_stream(self.module.current_stream())
        with self.module.stream(side):
            for _ in range(WARM_UP):
                function()
        self.module.current_stream().wait_stream(side)
        graph = self.module.CUDAGraph()
        with self.module.graph(graph):
            kept = function()  # keeps the graph's memory

        def replay() -> object:
            graph.replay()
            return kept

        return replay


def quietly(done: int, total: int, **values: object) -> None:
    """A progress callback that does nothing."""


def watch_of(device: torch.device | str) -> Watch:
    """The clock of torch's device."""
    return HostWatch() if torch.device(device).type == "cpu" else TorchWatch(device)


def timed(function: Function, watch: Watch, runs: int, *, within: int = 1) -> Timing:
    """Times of single calls after a warm-up, without garbage collection, over ``within``."""
    for _ in range(WARM_UP):
        function()
    watch.synchronise()
    collecting = gc.isenabled()
    gc.disable()
    try:
        marks = []
        for _ in range(runs):  # without synchronisation, so that launch latency is hidden
            start = watch.mark()
            function()
            marks.append((start, watch.mark()))
        times = [watch.between(*pair) / within for pair in marks]
    finally:
        if collecting:
            gc.enable()
    return Timing.of(times)


def both_ways(function: Function, watch: Watch, runs: int, *, within: int = 1) -> dict[str, Any]:
    """``eager``: called from Python; ``graph``: replayed, None where there are no graphs.

    A graph holds the function ``within`` times, and times are per call: launching a graph takes
    some microseconds itself. A failed capture is reported under ``graph_error`` and in the log.
    """
    times: dict[str, Any] = {"eager": timed(function, watch, runs).plain(), "graph": None}
    try:
        replay = watch.captured(lambda: [function() for _ in range(within)])
    except RuntimeError as error:
        times["graph_error"] = str(error).splitlines()[0]
        LOG.warning("cannot be captured in a graph: %s", times["graph_error"])
        return times
    if replay is not None:
        times["graph"] = timed(replay, watch, runs, within=within).plain()
    return times


def cell(timing: dict[str, Any] | None) -> str:
    """A timing in a table: median and, in brackets, the 10th and 90th percentile [ms]."""
    if timing is None:
        return "-"
    return f"{timing['median']:.3f} ({timing['p10']:.3f} .. {timing['p90']:.3f})"


def two_passes(row: dict[str, Any]) -> list[str]:
    """Cells of a row: forward and forward with backward, as graphs, then called from Python."""
    kinds = "forward", "forward_backward"
    return [cell(row[kind][way]) for way in ("graph", "eager") for kind in kinds]


def lines_of(title: str, heads: list[str], rows: list[list[str]]) -> list[str]:
    """A table as lines of text; the first column is left-aligned."""
    widths = [max(len(row[k]) for row in [heads, *rows]) for k in range(len(heads))]

    def line(row: list[str]) -> str:
        pairs = enumerate(zip(row, widths, strict=True))
        cells = [f"{text:<{w}}" if k == 0 else f"{text:>{w}}" for k, (text, w) in pairs]
        return "  ".join(cells).rstrip()

    return [title, *(line(row) for row in [heads, *rows])]
