"""Times of compositing: our kernels and naive ones.

    python benchmarks/composite.py [--device cpu|cuda] [--json FILE]

Scene: isotropic Gaussians on a wavy surface 1-5 m away, 320x240, the same positions, sizes and
opacities for all. All rows of one table come from one process, alternating, so that a busy machine
slows them alike. Ratios matter, not times.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import naive
import numpy as np
import warp as wp

from gftorf_warp.bench.scenes import CAMERA, FAR, HEIGHT, NEAR, WIDTH, inputs_of, surface
from gftorf_warp.kernels.rasterise.composite import CHANNEL_PLANES
from gftorf_warp.kernels.rasterise.composite_backward import GRAD_LIGHT_PLANES
from gftorf_warp.kernels.rasterise.splat import Splat
from gftorf_warp.render import launch, stages
from gftorf_warp.render.buffers import Buffers, RenderSettings


class Ours:
    """Our stages on the scene."""

    def __init__(self, scene: dict, device: str, threads: int):
        self.inputs = inputs_of(scene, device)
        settings = RenderSettings(near=NEAR, far=FAR, threads=threads)
        self.buffers = Buffers(len(scene["mean"]), WIDTH, HEIGHT, settings, wp.get_device(device))
        self.view = launch.uploaded(CAMERA, (), settings, self.buffers.device)
        stages.project(self.inputs, self.view, self.buffers)
        stages.sort_by_depth(self.buffers)
        stages.sort_by_tile(self.buffers)
        self.buffers.records = [self.buffers.splats]
        self.buffers.channels = [self.buffers.planes("channels 0", CHANNEL_PLANES)]
        self.grad_light, self.grad_channel = (
            self.buffers.gradient_planes("gradient of light", GRAD_LIGHT_PLANES, added=True),
            self.buffers.gradient_planes("gradient of channels 0", CHANNEL_PLANES, added=False),
        )
        rng = np.random.default_rng(1)
        for planes in (self.grad_light, self.grad_channel):
            planes.flat.assign(rng.normal(size=planes.flat.shape).astype(np.float32))
        self.records = wp.zeros(self.buffers.count, dtype=Splat, device=device)

    def forward(self) -> None:
        """Blend."""
        stages.composite(self.inputs, self.buffers, 0)

    def backward(self) -> None:
        """Blend backward, gradient records zeroed."""
        self.records.zero_()
        gradients = self.grad_light, self.grad_channel, self.records
        stages.composite_backward(self.inputs, self.buffers, 0, *gradients)
        stages.finish(self.buffers, self.records)


class Naive:
    """One thread per pixel, on the splats and lists of ours."""

    def __init__(self, ours: Ours):
        buffers = ours.buffers
        self.lists = [
            buffers.first,
            buffers.ids,
            buffers.splats,
            buffers.tile_width,
            buffers.tile_height,
            buffers.tiles_x,
        ]
        self.sums = wp.zeros((12, HEIGHT, WIDTH), dtype=float, device=buffers.device)
        grad = np.random.default_rng(1).normal(size=(9, HEIGHT, WIDTH))
        self.grad = wp.array(grad, dtype=float, device=buffers.device)
        self.records = wp.zeros(buffers.count, dtype=Splat, device=buffers.device)

    def forward(self) -> None:
        """Blend."""
        wp.launch(naive.forward, (HEIGHT, WIDTH), self.lists, [self.sums], device=self.sums.device)

    def backward(self) -> None:
        """Blend backward, gradient records zeroed."""
        self.records.zero_()
        inputs = [*self.lists, self.sums, self.grad]
        wp.launch(naive.backward, (HEIGHT, WIDTH), inputs, [self.records], device=self.sums.device)


def medians(rows: dict[str, object], repeats: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of both stages of each row, rows taking turns;
    the first turn is thrown away.
    """
    times: dict[str, dict[str, list[float]]] = {
        name: {"forward": [], "backward": []} for name in rows
    }
    for _ in range(repeats + 1):
        for name, row in rows.items():
            for stage in ("forward", "backward"):
                wp.synchronize()
                start = time.perf_counter()
                getattr(row, stage)()
                wp.synchronize()
                times[name][stage].append(1e3 * (time.perf_counter() - start))
    return {
        name: {s: statistics.median(t[1:]) for s, t in both.items()} for name, both in times.items()
    }


def side_by_side(scene: dict[str, np.ndarray]) -> float:
    """Time of two concurrent renderings over that of one: the load of the machine."""
    copies = [Ours(scene, "cpu", 1) for _ in range(2)]
    times: dict[int, list[float]] = {1: [], 2: []}
    with ThreadPoolExecutor(2) as pool:
        for _ in range(12):
            for count, record in times.items():
                start = time.perf_counter()
                list(pool.map(lambda copy: copy.forward(), copies[:count]))
                record.append(time.perf_counter() - start)
    return statistics.median(times[2][2:]) / statistics.median(times[1][2:])


def main() -> None:
    """Print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--scene", nargs=3, default=["20000", "0.03", "0.6"], metavar=("N", "SCALE", "OPACITY")
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    numbers = int(a.scene[0]), float(a.scene[1]), float(a.scene[2])
    scene = surface(*numbers)
    rows: dict[str, object] = {"ours, 1 thread": Ours(scene, a.device, 1)}
    if a.device == "cpu":
        rows["ours, 2 threads"] = Ours(scene, a.device, 2)
    rows["naive, 1 thread"] = Naive(rows["ours, 1 thread"])
    table = medians(rows, a.repeats)
    base = table["ours, 1 thread"]
    if a.device == "cpu":
        shared = side_by_side(scene)
        print(
            f"two independent copies side by side take {shared:.2f} times one: 1 means two "
            f"whole cores, 2 only one"
        )
    print(
        f"surface {' '.join(a.scene)}, {WIDTH}x{HEIGHT}, {a.device}, medians of {a.repeats}, "
        f"Warp {wp.__version__}"
    )
    for name, both in table.items():
        cells = [f"{t:8.2f} ms  {t / base[stage]:6.2f} x ours" for stage, t in both.items()]
        print(f"  {name:<20} forward {cells[0]:<26} backward {cells[1]}")
    if a.json:
        a.json.write_text(
            json.dumps({"scene": a.scene, "device": a.device, "ms": table}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
