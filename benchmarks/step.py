"""What a training step costs on a sequence or run of your own, and with --profile where its time
goes.

    python benchmarks/step.py SEQUENCE [--run RUN] [--preset released] [--from IMAGES] [--images N]
    [--set NAME=VALUE]
        [--device cpu|cuda] [--profile] [--timeline FILE] [--json FILE]

The same measurement as ``gftorf bench step``, for the one way that preset and --set name. The state
is the last checkpoint of RUN or, without one, the first of the preset; every timing begins with it
again. --timeline writes when each kernel of a few steps began, how long it took, and on which
stream: what waits for what is seen there only.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch
import warp as wp

from gftorf_warp import Sequence
from gftorf_warp.bench import states, step
from gftorf_warp.bench.command import about


def main() -> int:
    """Print, write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--preset", default="released")
    parser.add_argument(
        "--from", dest="begin", type=int, help="pretend that so many images are optimised"
    )
    parser.add_argument("--images", type=int, default=step.IMAGES)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--timeline", type=Path, help="of a GPU")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    if a.timeline and torch.device(a.device).type == "cpu":
        parser.error("--timeline is of kernels of a GPU: say --device cuda, or --profile for a CPU")
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)
    sequence = Sequence.open(a.sequence)
    settings = states.settings_of(sequence, a.preset, a.set, a.device)
    fitted = states.from_run(a.run, sequence, settings, a.device)
    if a.begin is not None:
        fitted.stored["images"] = a.begin
    [row] = step.rows_of([settings], fitted, a.device, images=a.images)
    print("\n".join(step.table([row])))
    if a.profile:
        print(step.profiled(step.fresh(fitted, fitted.observations, settings, a.device), a.device))
    if a.timeline:
        seen = step.timeline(step.fresh(fitted, fitted.observations, settings, a.device), a.device)
        a.timeline.write_text("\n".join(seen) + "\n")
    if a.json:
        what = {"preset": a.preset, "set": a.set}
        a.json.write_text(json.dumps(about(a.device) | what | row, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
