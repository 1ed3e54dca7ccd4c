"""What a training step costs beside rendering: loss of an image, backgrounds and Adam, by kernels and by torch.

    python benchmarks/step_kernels.py [--device cpu|cuda] [--gaussians N] [--repeats N] [--json FILE]

Rows of one table come from one process, alternating, so that a busy machine slows them alike. On a GPU every row is
timed twice: called from Python, and replayed as a CUDA graph; a replay must give what the call gave.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path

import torch
import warp as wp

from gftorf_warp.bench.command import about
from gftorf_warp.bench.timing import WARM_UP, watch_of
from gftorf_warp.recon.objective import image_loss
from gftorf_warp.recon.optimiser import BETAS, EPSILON
from gftorf_warp.render import descent, fused, training
from gftorf_warp.render.bridge import array_over
from gftorf_warp.render.cuda import capture, stream_of

IMAGES = {"1 x 120 x 160": (1, 120, 160), "1 x 240 x 320": (1, 240, 320), "4 x 240 x 320": (4, 240, 320)}
NETWORK = [(256, 84), *[(256, 256)] * 4, (256, 340), *[(256, 256)] * 2, (3, 256), *[(256,)] * 8, (3,)]


def loss_rows(device: str) -> dict[str, Callable[[], torch.Tensor]]:
    """Loss and gradient of images of several sizes."""
    rows = {}
    for name, shape in IMAGES.items():
        rendered, measured = (torch.rand(shape, device=device) * 2 - 1 for _ in range(2))
        rendered.requires_grad_()

        def run(kernel: bool, r=rendered, m=measured) -> torch.Tensor:
            return torch.autograd.grad(image_loss(r, m, 0.2, kernel=kernel)[0], r)[0]

        rows[f"loss {name}, kernels"] = lambda run=run: run(True)
        rows[f"loss {name}, torch"] = lambda run=run: run(False)
    return rows


def noise_rows(device: str) -> dict[str, Callable[[], torch.Tensor]]:
    """One background."""
    origin, shape = torch.tensor([0, 1], dtype=torch.int32, device=device), IMAGES["1 x 240 x 320"]
    return {
        "background 1 x 240 x 320, kernels": lambda: fused.uniform(shape, origin, 1.0),
        "background 1 x 240 x 320, torch": lambda: 2.0 * torch.rand(shape, device=device) - 1.0,
    }


def adam_rows(device: str, count: int) -> dict[str, Callable[[], torch.Tensor]]:
    """All tensors of ``count`` Gaussians and of the published network; what a step comes to was judged before."""
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 16), *NETWORK]
    values = [torch.randn(shape, device=device) for shape in shapes]
    gradients = [torch.randn(shape, device=device) for shape in shapes]
    moments = [(torch.zeros((), device=device), torch.zeros_like(v), torch.zeros_like(v)) for v in values]
    table = descent.AdamTable(values, gradients, moments)
    rates = torch.full((len(shapes),), 1e-3, device=device)
    ledger, none = descent.Ledger.empty(1, torch.device(device)), torch.zeros(1, dtype=torch.int32, device=device)
    rest = {"motion_gradient_max": None, "pairs": [none], "capacity": 0, "betas": BETAS, "epsilon": EPSILON}
    descent.descend(table, rates, ledger, [0.0] * len(descent.FOUND_NAMES), motion_from=len(values), **rest)
    tables = array_over(table.rows, wp.int64), array_over(table.first_block, wp.int32)
    sizes = array_over(table.sizes)
    twins = [value.clone().requires_grad_() for value in values]
    for twin, gradient in zip(twins, gradients, strict=True):
        twin.grad = gradient
    adam = torch.optim.Adam([{"params": [t], "lr": 1e-3} for t in twins], betas=BETAS, eps=EPSILON, fused=True)

    def by_kernels() -> torch.Tensor:
        with stream_of(rates):
            training.adam_step(*tables, table.blocks, BETAS, EPSILON, sizes)
        return values[0]

    def by_torch() -> torch.Tensor:
        adam.step()
        return twins[0]

    return {f"Adam N = {count}, kernels": by_kernels, f"Adam N = {count}, torch": by_torch}


def replay_of(run: Callable[[], torch.Tensor]) -> tuple[Callable[[], None], torch.Tensor]:
    """A graph of ``run`` on a stream of its own, and where its result is."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UP):
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with capture(graph, side):
        result = run()
    return graph.replay, result


def timed(runs: dict[str, Callable], repeats: int, device: str) -> dict[str, float]:
    """Median milliseconds of every row, taken in turns."""
    watch = watch_of(device)
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for n in range(repeats + WARM_UP):
        for name, run in runs.items():
            begun = watch.mark()
            run()
            spent[name].append(watch.between(begun, watch.mark()))
            if n < WARM_UP:
                spent[name].clear()
    return {name: statistics.median(values) for name, values in spent.items()}


def main() -> int:
    """Print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=51)
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)
    rows = loss_rows(a.device) | noise_rows(a.device) | adam_rows(a.device, a.gaussians)
    found = {"called": timed(rows, a.repeats, a.device)}
    if a.device != "cpu":
        replays, unequal = {}, []
        for name, run in rows.items():
            if name.endswith("kernels"):
                replays[name], result = replay_of(run)
                if name.startswith("loss"):
                    replays[name]()
                    unequal += [] if torch.equal(result, run()) else [name]
        found["replayed"] = timed(replays, a.repeats, a.device)
        print("replay equals call to the bit" if not unequal else f"replay differs from call: {unequal}")
    for name in rows:
        times = "  ".join(f"{how} {values[name]:8.3f} ms" for how, values in found.items() if name in values)
        print(f"{name:<40} {times}")
    if a.json:
        a.json.write_text(json.dumps(about(a.device) | {"repeats": a.repeats, "milliseconds": found}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
