"""How long things take: repeated, warmed up, by the clock of the device where it has one; medians and percentiles."""

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
WARM_UP = 3  # runs before the first that counts: kernels are loaded, memory is found
Function = Callable[[], object]
Report = Callable[..., None]


class Watch(Protocol):
    """A clock of one device, and the graphs of the library that works on it."""

    def mark(self) -> Any:
        """A moment in the order of what was asked for."""

    def between(self, start: Any, stop: Any) -> float:
        """Milliseconds between two moments; waits for the second."""

    def synchronise(self) -> None:
        """Wait until everything that was asked for is done."""

    def captured(self, function: Function) -> Function | None:
        """The work of a function as something that replays it; None where there are no graphs."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Milliseconds of one thing over its runs."""

    median: float
    """Half of the runs are faster [ms]."""
    p10: float
    """A tenth of the runs is faster [ms]."""
    p90: float
    """A tenth of the runs is slower [ms]."""
    runs: int
    """How often it was done."""

    @classmethod
    def of(cls, times: list[float]) -> Timing:
        """From single times [ms]."""
        p10, median, p90 = (float(value) for value in np.percentile(times, [10, 50, 90]))
        return cls(median=median, p10=p10, p90=p90, runs=len(times))

    def over(self, count: int) -> Timing:
        """Of one, where each run did ``count``."""
        return Timing(median=self.median / count, p10=self.p10 / count, p90=self.p90 / count, runs=self.runs)

    def plain(self) -> dict[str, float | int]:
        """For JSON."""
        return asdict(self)


class HostWatch:
    """The clock of the processor; on a CPU, what was asked for is done when the call returns."""

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
        """A CUDA graph of the function, which has run before on a stream of its own, as torch wants it."""
        side = self.module.Stream()
        side.wait_stream(self.module.current_stream())
        with self.module.stream(side):
            for _ in range(WARM_UP):
                function()
        self.module.current_stream().wait_stream(side)
        graph = self.module.CUDAGraph()
        with self.module.graph(graph):
            kept = function()  # results live in the graph's memory as long as the function that replays it

        def replay() -> object:
            graph.replay()
            return kept

        return replay


def quietly(done: int, total: int, **values: object) -> None:
    """A report that says nothing."""


def watch_of(device: torch.device | str) -> Watch:
    """The clock for work that torch asks for."""
    return HostWatch() if torch.device(device).type == "cpu" else TorchWatch(device)


def timed(function: Function, watch: Watch, runs: int, *, warm_up: int = WARM_UP) -> Timing:
    """Time of one call, over so many calls that count."""
    for _ in range(warm_up):
        function()
    watch.synchronise()
    collecting = gc.isenabled()
    gc.disable()
    try:
        marks = []
        for _ in range(runs):  # nothing waits in between: an idle device would count the host's way to it
            start = watch.mark()
            function()
            marks.append((start, watch.mark()))
        times = [watch.between(*pair) for pair in marks]
    finally:
        if collecting:
            gc.enable()
    return Timing.of(times)


def both_ways(function: Function, watch: Watch, runs: int, *, within: int = 1) -> dict[str, Any]:
    """``eager``: called from Python; ``graph``: replayed, None where there are no graphs.

    A graph holds the function ``within`` times, and times are those of one: what takes a few microseconds is not
    measured by launching a graph, which takes as long. What a library cannot capture is reported under ``graph_error``
    and in the log, and the table goes on.
    """
    found: dict[str, Any] = {"eager": timed(function, watch, runs).plain(), "graph": None}
    try:
        replay = watch.captured(lambda: [function() for _ in range(within)])
    except RuntimeError as error:
        found["graph_error"] = str(error).splitlines()[0]
        LOG.warning("cannot be captured in a graph: %s", found["graph_error"])
        return found
    if replay is not None:
        found["graph"] = timed(replay, watch, runs).over(within).plain()
    return found


def cell(timing: dict[str, Any] | None) -> str:
    """A timing in a table: median and, in brackets, the 10th and 90th percentile [ms]."""
    if timing is None:
        return "-"
    return f"{timing['median']:.3f} ({timing['p10']:.3f} .. {timing['p90']:.3f})"


def lines_of(title: str, heads: list[str], rows: list[list[str]]) -> list[str]:
    """A table as lines of text, columns as wide as they need to be; the first one to the left."""
    widths = [max(len(row[k]) for row in [heads, *rows]) for k in range(len(heads))]

    def line(row: list[str]) -> str:
        pairs = enumerate(zip(row, widths, strict=True))
        cells = [f"{text:<{w}}" if k == 0 else f"{text:>{w}}" for k, (text, w) in pairs]
        return "  ".join(cells).rstrip()

    return [title, *(line(row) for row in [heads, *rows])]
