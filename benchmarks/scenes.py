"""A whole rendering, forward and backward, on eight scenes of three families.

    python benchmarks/scenes.py [--device cpu|cuda] [--all] [--images all|training] [--json FILE]

'surface': Gaussians on a wavy surface 1-5 m away; 'volume': filling the viewing frustum; 'grown': sizes over two
decades on that surface, thirty of them as large as the image, as training from a random start has them. 320x240, quads,
phasor, colour, distance, opacity and distortion with a random derivative each; 'training': one quad with a derivative
and the opacity. On CUDA everything is replayed from a graph and
timed by events, on the CPU it is called; medians in milliseconds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
import torch
import warp as wp
from surfaces import CAMERA, FAR, HEIGHT, NEAR, WIDTH, array_of, grown, inputs_of, surface, volume

from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.render import launch
from gftorf_warp.render.buffers import Frame, RenderSettings
from gftorf_warp.render.inputs import Images, Inputs, names_of

SCENES = [
    ("grown", 20_000, 0.01, 0.6),
    ("surface", 20_000, 0.03, 0.6),
    ("surface", 50_000, 0.015, 0.6),
    ("volume", 100_000, 0.03, 0.1),
    ("surface", 100_000, 0.015, 0.6),
    ("volume", 200_000, 0.03, 0.1),
    ("surface", 200_000, 0.015, 0.6),
    ("surface", 300_000, 0.015, 0.6),
]
FAMILIES = {"surface": surface, "volume": volume, "grown": grown}


class Case:
    """One scene, ready to be rendered and differentiated."""

    def __init__(self, kind: str, count: int, scale: float, opacity: float, device: wp.Device, few: bool = False):
        self.inputs = inputs_of(FAMILIES[kind](count, scale, opacity), device)
        self.shifts = CANONICAL_SHIFTS[:1] if few else CANONICAL_SHIFTS
        size = HEIGHT, WIDTH
        shapes = {"quads": (4, *size), "phasor": (3, *size), "colour": (3, *size)}
        shapes |= dict.fromkeys(("distance", "opacity", "distortion"), size)
        names = ["mean", "log_scale", "quaternion", "opacity_logit", "reflectivity_sh", "colour_sh"]
        if few:
            self.inputs.colour_sh = None
            names.remove("colour_sh")
            shapes = {"quads": (1, *size), "opacity": size}
        rng = np.random.default_rng(1)
        empty = dict.fromkeys(names_of(Images))
        self.images = Images(**empty | {name: array_of(np.zeros(shape), device) for name, shape in shapes.items()})
        self.cotangents = Images(
            **empty | {name: array_of(rng.normal(size=shape), device) for name, shape in shapes.items()}
        )
        if few:
            self.cotangents.opacity = None
        self.wanted = Inputs(**dict.fromkeys(names_of(Inputs)))
        for name in names:
            setattr(self.wanted, name, wp.zeros_like(getattr(self.inputs, name)))
        self.count, self.device = count, device
        self.start(None)
        self.forward()
        self.pairs = int(self.frame.total.numpy()[0])

    def start(self, capacity: int | None) -> None:
        """A fresh frame with room for ``capacity`` pairs."""
        settings = RenderSettings(near=NEAR, far=FAR, pair_capacity=capacity)
        self.frame = Frame(self.count, WIDTH, HEIGHT, settings, self.device)
        self.view = launch.view_of(CAMERA, settings)

    def forward(self) -> None:
        """Render."""
        launch.forward(self.inputs, self.view, self.shifts, self.frame, self.images)

    def backward(self) -> None:
        """Differentiate; the forward pass has run."""
        launch.backward(self.inputs, self.view, self.shifts, self.frame, self.cotangents, self.wanted)


def both(case: Case) -> None:
    """Forward and backward."""
    case.forward()
    case.backward()


def timed(function, device: wp.Device, repeats: int) -> float:
    """Median milliseconds: of graph replays on CUDA, of calls on the CPU."""
    function()
    times = []
    if device.is_cuda:
        with wp.ScopedCapture(device=device) as capture:
            function()
        for _ in range(repeats + 3):
            start, stop = (wp.Event(device, enable_timing=True) for _ in range(2))
            wp.record_event(start)
            wp.capture_launch(capture.graph)
            wp.record_event(stop)
            times.append(wp.get_event_elapsed_time(start, stop))
        return statistics.median(times[3:])
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def main() -> None:
    """Print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--all", action="store_true", help="all eight scenes instead of the first two")
    parser.add_argument("--images", choices=("all", "training"), default="all", help="which images, with derivatives")
    parser.add_argument("--repeats", type=int, default=None, help="30 on CUDA, 5 on the CPU")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    device = wp.get_device(a.device)
    repeats = a.repeats or (30 if device.is_cuda else 5)
    rows = []
    print(f"{device.name}, Warp {wp.__version__}, {WIDTH}x{HEIGHT}, medians of {repeats} [ms]")
    for kind, count, scale, opacity in SCENES if a.all else SCENES[:2]:
        case = Case(kind, count, scale, opacity, device, a.images == "training")
        eager = timed_eager(case, repeats)
        if device.is_cuda:
            case.start(int(1.25 * case.pairs))
        forward = timed(case.forward, device, repeats)
        total = timed(lambda case=case: both(case), device, repeats)
        checked = "opacity" if a.images == "training" else "distance"
        mean = float(getattr(case.images, checked).numpy().mean())
        row = {"scene": kind, "N": count, "scale": scale, "opacity": opacity, "pairs": case.pairs, "forward": forward}
        rows.append(row | {"both": total, "eager": eager, f"mean_{checked}": mean})
        print(
            f"  {kind:<8} N {count:<7} pairs {case.pairs:<8} forward {forward:8.3f}  forward + backward {total:8.3f}"
            f"  eager {eager:8.3f}  mean {checked} {mean:.3f}",
            flush=True,
        )
    if a.json:
        about = {"device": device.name, "warp": wp.__version__, "torch": torch.__version__, "images": a.images}
        a.json.write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")


def timed_eager(case: Case, repeats: int) -> float:
    """Median milliseconds of forward and backward called from Python, counting pairs on the host."""
    times = []
    for _ in range(repeats + 1):
        wp.synchronize()
        start = time.perf_counter()
        both(case)
        wp.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


if __name__ == "__main__":
    main()
