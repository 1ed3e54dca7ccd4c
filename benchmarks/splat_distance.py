"""What a distance per pixel of a splat costs: forward and forward with backward, against one
distance per splat, on the scenes of `gftorf bench`.

    python benchmarks/splat_distance.py [--device cuda:0] [--count 100000] [--runs 5] [--rounds 5]

The bound is 1.35 times the time of forward with backward on CUDA.
"""

from __future__ import annotations

import argparse
import math

import warp as wp

from gftorf_warp.bench.renderer import FORMS, HEADROOM, Case, WarpWatch
from gftorf_warp.bench.scenes import FAMILIES, HEIGHT, WIDTH
from gftorf_warp.bench.timing import HostWatch, Watch, both_ways
from gftorf_warp.render.buffers import SplatDistance


def main() -> None:
    """Print the smallest medians [ms] and their ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--runs", type=int, default=5, help="of which a median is taken")
    parser.add_argument("--rounds", type=int, default=5, help="of which the best median counts")
    a = parser.parse_args()
    device = wp.get_device(a.device)
    watch: Watch = WarpWatch(device) if device.is_cuda else HostWatch()
    print(f"{WIDTH}x{HEIGHT}, N = {a.count:,}, {device}: centre and plane [ms], ratio")
    for form in FORMS:
        for kind, scale, opacity in FAMILIES:
            cases = [
                Case(kind, a.count, scale, opacity, form, device, splat_distance)
                for splat_distance in SplatDistance
            ]
            found = [[math.inf, math.inf] for _ in cases]
            if device.is_cuda:  # without readback of the number of pairs, for a graph
                for case in cases:
                    case.start(int(HEADROOM * case.pairs) + 1)
            for _ in range(a.rounds):  # alternately: other programs slow down both
                for case, best in zip(cases, found, strict=True):
                    for n, function in enumerate((case.forward, case.both)):
                        times = both_ways(function, watch, a.runs)
                        best[n] = min(best[n], (times["graph"] or times["eager"])["median"])
            cells = [
                f"{name} {centre:8.3f} {plane:8.3f} {plane / centre:5.2f}"
                for name, centre, plane in zip(("forward", "with backward"), *found, strict=True)
            ]
            print(f"{form:<9}{kind:<8} {scale:g} {opacity:g}  " + "   ".join(cells), flush=True)


if __name__ == "__main__":
    main()
