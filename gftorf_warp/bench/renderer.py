"""The renderer: forward, forward with backward, and every stage, on two families of scenes.

Two forms. *all*: quads, phasor, colour, distance, opacity and distortion, with a random cotangent
of each. *training*: no colour, and the cotangent of one quad only, as in a step of the presets
without colour. Stages are the calls of launch.py in its order, each repeated with its arguments.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from ..constants import CANONICAL_SHIFTS
from ..render import launch, stages
from ..render.buffers import Buffers, RenderSettings, SplatDistance
from ..render.inputs import Images, Inputs, names_of
from .scenes import CAMERA, FAMILIES, FAR, HEIGHT, NEAR, WIDTH, array_of, inputs_of, scene_of
from .timing import Function, HostWatch, Report, Watch, both_ways, lines_of, timed, two_passes

COUNTS = (20_000, 50_000, 100_000, 200_000, 300_000)
QUICK_COUNTS = (500,)
FORMS = ("all", "training")
WITHIN = 10  # repetitions of a stage in one graph
HEADROOM = 1.3  # pair capacity over the number of pairs
GAUSSIANS = ("mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh")


class WarpWatch:
    """Events of Warp on the stream of a device."""

    def __init__(self, device: wp.Device):
        self.device = device

    def mark(self) -> wp.Event:
        """An event, recorded."""
        event = wp.Event(self.device, enable_timing=True)
        self.device.stream.record_event(event)
        return event

    def between(self, start: wp.Event, stop: wp.Event) -> float:
        """Milliseconds between two events."""
        return wp.get_event_elapsed_time(start, stop)

    def synchronise(self) -> None:
        """Wait for the device."""
        wp.synchronize_device(self.device)

    def captured(self, function: Function) -> Function | None:
        """A graph of the launches of a function, whose modules are loaded."""
        with wp.ScopedCapture(device=self.device) as capture:
            function()
        return partial(wp.capture_launch, capture.graph)


class Case:
    """One scene in one form with its buffers."""

    def __init__(
        self,
        kind: str,
        count: int,
        scale: float,
        opacity: float,
        form: str,
        device: wp.Device,
        splat_distance: SplatDistance = SplatDistance.CENTRE,
    ):
        """Make everything but the pair capacity of its buffers, which needs a first rendering."""
        if form not in FORMS:
            raise ValueError(f"form {form!r} must be one of {FORMS}")
        everything = form == "all"
        self.shifts = CANONICAL_SHIFTS if everything else CANONICAL_SHIFTS[:1]
        self.inputs = inputs_of(scene_of(kind, count, scale, opacity), device, colour=everything)
        size = HEIGHT, WIDTH
        shapes: dict[str, tuple[int, ...]] = {"quads": (len(self.shifts), *size)}
        shapes["phasor"] = (3, *size)
        shapes |= {"colour": (3, *size)} if everything else {}
        shapes |= dict.fromkeys(("distance", "opacity", "distortion"), size)
        rng = np.random.default_rng(1)
        empty = dict.fromkeys(names_of(Images))
        zeros = {name: array_of(np.zeros(shape), device) for name, shape in shapes.items()}
        self.images = Images(**empty | zeros)
        known = shapes if everything else {"quads": shapes["quads"]}
        random = {name: array_of(rng.normal(size=shape), device) for name, shape in known.items()}
        self.cotangents = Images(**empty | random)
        self.wanted = Inputs(**dict.fromkeys(names_of(Inputs)))
        for name in GAUSSIANS:
            value = getattr(self.inputs, name)
            setattr(self.wanted, name, None if value is None else wp.zeros_like(value))
        self.count, self.device, self.splat_distance = count, device, splat_distance
        self.start(None)
        self.forward()
        self.pairs = int(self.buffers.total.numpy()[0])

    def start(self, capacity: int | None) -> None:
        """Buffers for ``capacity`` pairs; None: as many as needed."""
        settings = RenderSettings(
            near=NEAR, far=FAR, pair_capacity=capacity, splat_distance=self.splat_distance
        )
        self.buffers = Buffers(self.count, WIDTH, HEIGHT, settings, self.device)
        self.view = launch.uploaded(CAMERA, self.shifts, settings, self.device)

    def forward(self) -> None:
        """Render."""
        launch.forward(self.inputs, self.view, self.buffers, self.images)

    def backward(self) -> None:
        """Differentiate; the forward pass has run."""
        launch.backward(self.inputs, self.view, self.buffers, self.cotangents, self.wanted)

    def both(self) -> None:
        """Forward and backward."""
        self.forward()
        self.backward()

    def stages(self) -> dict[str, Function]:
        """Calls of stages.py in one forward and backward pass, by name, to be repeated."""
        calls: dict[str, list[Function]] = {}
        with _recorded(calls):
            self.both()

        return {name: partial(_run_all, some) for name, some in calls.items()}


def _run_all(calls: list[Function]) -> None:
    for call in calls:
        call()


@contextlib.contextmanager
def _recorded(calls: dict[str, list[Function]]) -> Iterator[None]:
    """Record the calls that launch.py makes to stages.py."""

    class Recorder:
        def __getattr__(self, name: str) -> Callable[..., Any]:
            stage = getattr(stages, name)

            def call(*arguments, **named):
                calls.setdefault(name, []).append(partial(stage, *arguments, **named))
                return stage(*arguments, **named)

            return call

    launch.stages = Recorder()  # type: ignore[assignment]
    try:
        yield
    finally:
        launch.stages = stages


def measure(
    device_name: str,
    *,
    runs: int,
    quick: bool,
    report: Report,
) -> list[dict[str, Any]]:
    """Rows of N, family and form: pairs, stages, forward, and forward with backward [ms]."""
    device = wp.get_device(device_name)
    watch: Watch = WarpWatch(device) if device.is_cuda else HostWatch()
    families, counts = (FAMILIES[:1], QUICK_COUNTS) if quick else (FAMILIES, COUNTS)
    cases = [(*family, n, form) for form in FORMS for family in families for n in counts]
    rows = []
    for done, (kind, scale, opacity, count, form) in enumerate(cases, start=1):
        case = Case(kind, count, scale, opacity, form, device)
        free = None
        if device.is_cuda:  # first with readback of the number of pairs, then without
            free = timed(case.both, watch, runs).plain()
            case.start(int(HEADROOM * case.pairs) + 1)
        forward, both = (both_ways(function, watch, runs) for function in (case.forward, case.both))
        parts = {
            name: both_ways(function, watch, runs, within=WITHIN)
            for name, function in case.stages().items()
        }
        case.buffers.check_capacity()
        assert case.images.distance is not None
        row = {"form": form, "scene": kind, "scale": scale, "opacity": opacity, "N": count}
        row |= {"pairs": case.pairs, "forward": forward, "forward_backward": both}
        row |= {"pairs_counted_on_host": free, "stages": parts}
        rows.append(row | {"mean_distance": float(case.images.distance.numpy().mean())})
        report(done, len(cases), N=count, ms=both["eager"]["median"])
    return rows


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Totals, then stages."""
    totals = [
        [f"{row['form']} {_scene(row)}", f"{row['N']:,}", f"{row['pairs']:,}", *two_passes(row)]
        for row in rows
    ]
    ways = ["forward, graph", "with backward", "forward, called", "with backward"]
    heads = ["form, scene", "N", "pairs", *ways]
    lines = lines_of(f"renderer, {WIDTH}x{HEIGHT}: median (10 .. 90 %) [ms]", heads, totals)
    for form in dict.fromkeys(row["form"] for row in rows):
        some = [row for row in rows if row["form"] == form]
        names = list(dict.fromkeys(name for row in some for name in row["stages"]))
        parts = [
            [_scene(row), f"{row['N']:,}"] + [_stage(row["stages"].get(name)) for name in names]
            for row in some
        ]
        heads = ["scene", "N", *(name.replace("_", " ") for name in names)]
        title = f"stages, form {form}: median [ms], of a graph where there is one"
        lines += ["", *lines_of(title, heads, parts)]
    return lines


def _scene(row: dict[str, Any]) -> str:
    return f"{row['scene']} {row['scale']:g} {row['opacity']:g}"


def _stage(timings: dict[str, Any] | None) -> str:
    return "-" if timings is None else f"{(timings['graph'] or timings['eager'])['median']:.3f}"
