"""A whole rendering, forward and backward, with everything that comes out: ``gftorf bench renderer`` for one form.

    python benchmarks/scenes.py [--device cpu|cuda] [--all] [--repeats N] [--json FILE]
        [--walk rounds|entries|both] [--lists bits|sort|both]

On the CPU the first count of Gaussians only, unless --all. Scenes and stages are those of gftorf_warp/bench/. On CUDA
the lanes of a warp walk the list of a tile in rounds, or each of them by itself entry by entry (shared_batches.py).
Lists are read from a bit matrix (tile_bitmask.py), or come out of a sort of pairs.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import warp as wp

from gftorf_warp.bench import renderer
from gftorf_warp.bench.command import about
from gftorf_warp.kernels.rasterise import shared_batches
from gftorf_warp.render import buffers


def main() -> None:
    """Print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--all", action="store_true", help="every number of Gaussians instead of the first")
    parser.add_argument("--repeats", type=int, default=None, help="30 on CUDA, 5 on the CPU")
    parser.add_argument("--walk", choices=("rounds", "entries", "both"), default="rounds")
    parser.add_argument("--lists", choices=("bits", "sort", "both"), default="bits")
    parser.add_argument(
        "--warps", type=int, default=shared_batches.WARPS, help="tiles of a block of threads, CUDA, in rounds"
    )
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    device = wp.get_device(a.device)
    counts = renderer.COUNTS if a.all else renderer.COUNTS[:1]
    rows, shared_batches.WARPS = [], a.warps  # before the first kernel is made
    walks = ("rounds", "entries") if a.walk == "both" else (a.walk,)
    ways, largest = ("bits", "sort") if a.lists == "both" else (a.lists,), buffers.MATRIX_MAX
    for walk, lists in product(walks, ways):
        shared_batches.COOPERATIVE = walk == "rounds"
        buffers.MATRIX_MAX = largest if lists == "bits" else 0
        found = renderer.measure(
            device.alias, counts=counts, forms=("all",), runs=a.repeats or (30 if device.is_cuda else 5)
        )
        print("\n".join([f"lists by {lists}, walked in {walk}", *renderer.table(found)]))
        rows += [row | {"walk": walk, "lists": lists} for row in found]
    if a.json:
        a.json.write_text(json.dumps(about(device.alias) | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
