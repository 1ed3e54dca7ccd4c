"""Optical flow computed from quads, against the exact flow that a recording brings: error and time
of each method.

    python benchmarks/flow.py [SEQUENCE] [--json FILE]

A pixel moves if its exact flow is above 0.5 px. 'kept' is the share of pixels that forward and
backward flow agree on; errors are mean end-point errors of those, over both directions.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import get_args

import numpy as np

from gftorf_warp import Sequence
from gftorf_warp.data.flow import Method, compute_flow

SAMPLE = Path(__file__).parents[1] / "tests" / "data" / "ftorf_sample_box"
MOVING_PX = 0.5


def measure(sequence: Sequence, method: Method) -> dict[str, float]:
    """Errors [px], shares and time [s] of one method on one sequence."""
    begun = time.perf_counter()
    computed = compute_flow(sequence, method=method)
    row = {"seconds": time.perf_counter() - begun}
    directions = (
        (computed.forward, sequence.flow.forward),
        (computed.backward, sequence.flow.backward),
    )
    pairs = [(found[n], exact[n]) for found, exact in directions for n in exact if n in found]
    row["images"] = len(pairs)
    error = np.stack([np.hypot(*(found - exact)) for found, exact in pairs])
    moves = np.stack([np.hypot(*exact) > MOVING_PX for _, exact in pairs])
    for name, pixels in (("moving", moves), ("static", ~moves)):
        known = error[pixels & np.isfinite(error)]
        row |= {
            f"{name}_px": float(known.mean()),
            f"{name}_p99_px": float(np.percentile(known, 99)),
        }
        row[f"{name}_kept"] = len(known) / int(pixels.sum())
    return row


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path, nargs="?", default=SAMPLE)
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    sequence = Sequence.open(a.sequence)
    rows = {method: measure(sequence, method) for method in get_args(Method)}
    print(
        f"{sequence.width}x{sequence.height}, {sequence.frames} raw frames, {os.cpu_count()} CPUs"
    )
    for method, row in rows.items():
        print(
            f"{method:<9} moving {row['moving_px']:.3f} px (p99 {row['moving_p99_px']:.2f}, "
            f"kept {row['moving_kept']:.1%})   static {row['static_px']:.3f} px (kept "
            f"{row['static_kept']:.1%})"
            f"   {row['seconds']:.2f} s for {row['images']} images"
        )
    if a.json:
        a.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
