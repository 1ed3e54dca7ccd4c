"""A sweep on a local Dask cluster whose workers are killed, against the same one without.

    python benchmarks/lost_workers.py [--jobs 24] [--workers 3] [--every 20] [--out DIR]

Fits of 200 images of preset demo to random scenes of 48x36 pixels, one seed after the other. Every
few seconds SIGKILL ends one of the workers; Dask starts another. Prints how many were killed, the
jobs that failed, and those whose errors differ from the sweep without a cluster: none should.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import threading
import time
from pathlib import Path

from distributed import LocalCluster

from gftorf_warp.sweep.command import sweep
from gftorf_warp.sweep.plan import Plan, Row, Scene

SCENES = 4


def plan_of(jobs: int) -> Plan:
    """So many fits."""
    return Plan(
        scenes=tuple(Scene(name=f"random-{n}") for n in range(SCENES)),
        rows=(Row(preset="demo"),),
        seeds=tuple(range(-(-jobs // SCENES))),
        images=200,
        simulate={"size": (48, 36), "frames": 12, "engine": "mesh"},
    )


def kill_workers(cluster: LocalCluster, every: float, stop: threading.Event) -> list[int]:
    """Kill one worker every few seconds until told to stop; their process numbers."""
    killed: list[int] = []
    while not stop.wait(every):
        running = [nanny.pid for nanny in cluster.workers.values() if nanny.pid]
        if running:
            killed.append(random.choice(running))
            os.kill(killed[-1], signal.SIGKILL)
            print(f"killed {killed[-1]}", flush=True)
    return killed


def main() -> int:
    """Both sweeps; 1 if they differ."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--every", type=float, default=20.0, help="[s]")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp())
    plan, stop, killed = plan_of(options.jobs), threading.Event(), []
    begun = time.monotonic()
    with LocalCluster(
        n_workers=options.workers,
        threads_per_worker=1,
        dashboard_address=None,
        host="127.0.0.1",
    ) as cluster:
        killer = threading.Thread(
            target=lambda: killed.extend(kill_workers(cluster, options.every, stop))
        )
        killer.start()
        there = sweep(plan, out / "cluster", scheduler=cluster.scheduler_address)
        stop.set()
        killer.join()
    seconds = time.monotonic() - begun
    here = sweep(plan, out / "here", workers=1)
    failed = [result["id"] for result in there.values() if "error" in result]
    fits = [job.id for job in plan.fits]
    error = {"there": there, "here": here}
    differ = [
        id
        for id in fits
        if id not in failed
        and len({one[id]["metrics"]["d_mse_x100"] for one in error.values()}) > 1
    ]
    print(f"{len(fits)} fits in {seconds:.0f} s, {len(killed)} workers killed")
    print(f"failed: {failed or 'none'}; other errors than without a cluster: {differ or 'none'}")
    return int(bool(failed or differ))


if __name__ == "__main__":
    raise SystemExit(main())
