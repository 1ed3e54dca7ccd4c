"""What a person waits for: `gftorf --help`, and the demo with an empty and with a filled kernel cache.

    python benchmarks/command_line.py [--json FILE] [--without-demo]

Budgets on two CPU cores: help 0.5 s, demo with an empty cache 90 s. Prints the demo's errors too, since fast and wrong
is no demo.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HELP_RUNS = 7
BUDGET_S = {"help": 0.5, "demo, empty kernel cache": 90.0}


def seconds_of(arguments: list[str], **environment: str) -> float:
    """Wall clock of one command in a process of its own [s].

    Raises:
        CalledProcessError: If it fails.
    """
    begun = time.perf_counter()
    command = [sys.executable, "-m", "gftorf_warp", *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | environment)
    return time.perf_counter() - begun


def main() -> None:
    """Measure, print, and optionally store as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--without-demo", action="store_true")
    a = parser.parse_args()

    rows = {"help": statistics.median(seconds_of(["--help"]) for _ in range(HELP_RUNS))}
    errors = {}
    if not a.without_demo:
        with tempfile.TemporaryDirectory() as folder:
            cache = str(Path(folder) / "kernels")
            for name in ("empty", "filled"):
                out = Path(folder) / name
                rows[f"demo, {name} kernel cache"] = seconds_of(["demo", "--out", str(out)], WARP_CACHE_PATH=cache)
            metrics = json.loads((out / "metrics.json").read_text())
            for pixels in ("moving", "static"):
                errors[pixels] = {k: metrics[pixels][k] for k in ("closed_form_mse_x100", "d_mse_x100")}

    print(f"{os.cpu_count()} CPUs")
    for name, seconds in rows.items():
        budget = f"  (budget {BUDGET_S[name]:g} s)" if name in BUDGET_S else ""
        print(f"{name:<28}{seconds:8.2f} s{budget}")
    for pixels, row in errors.items():
        print(
            f"{pixels:<28}closed form {row['closed_form_mse_x100']:.3f}, ours {row['d_mse_x100']:.3f} (MSE x100 [m^2])"
        )
    if a.json:
        a.json.write_text(json.dumps({"cpus": os.cpu_count(), "seconds": rows, "errors": errors}, indent=1) + "\n")


if __name__ == "__main__":
    main()
