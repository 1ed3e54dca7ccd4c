"""Outlines on stored renderings: a sequence is fitted once, constants are then compared in seconds.

    python benchmarks/outlines.py fit OUT SEQUENCE... [--images 1500]   # ours/random-3 is simulated
    python benchmarks/outlines.py score OUT [SPEC...]   # such as outlines.FRONT_SPREAD=.3

`fit` reconstructs with preset best on the CPU and stores renderings of the fit under OUT. A
SEQUENCE named random-N that does not exist is simulated with engine mesh at 96x72, 24 raw frames.
`score` prints the error of d over that of the closed form on the same pixels, geometric means over
the sequences of one parent folder, on every fifth raw frame, for all, moving and static pixels and
for the static ones beside steps and elsewhere: of the fallback alone, with outlines, and with
constants of recon/outlines.py, recon/other_frames.py, recon/phasors.py, recon/quadrature.py or
recon/straight.py changed (several in one SPEC by commas).
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gftorf_warp import reconstruct, simulate
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.read import read, read_truth
from gftorf_warp.data.steps import near_steps
from gftorf_warp.data.truth import known_distance, moving_and_static
from gftorf_warp.evaluate.metrics import scored_frames
from gftorf_warp.evaluate.views import camera_at
from gftorf_warp.recon import other_frames, outlines, phasors, quadrature, straight
from gftorf_warp.recon.raw_frames import RawFrames
from gftorf_warp.recon.run import Run
from gftorf_warp.render.api import Rendering
from gftorf_warp.sim.random_scene import random_scene

SIZE, FRAMES = (96, 72), 24  # of simulated scenes
FIRST, EVERY = 2, 5  # [raw frames] scored ones: their slots differ
MODULES = {
    "outlines": outlines,
    "other_frames": other_frames,
    "phasors": phasors,
    "quadrature": quadrature,
    "straight": straight,
}
Stored = dict[str, Any]
Rule = Callable[[int, Rendering], torch.Tensor]  # distances of a raw frame from its rendering


def fit(out: Path, folder: Path, images: int) -> None:
    """Reconstruct a sequence, unless OUT has its renderings, and store them."""
    path = out / f"{folder.parent.name}-{folder.name}.pt"
    if path.exists():
        return
    if not folder.exists():
        number = int(folder.name.partition("-")[2])
        scene = random_scene(number)
        simulate(scene, folder, size=SIZE, frames=FRAMES, engine="mesh", seed=number)
    run_folder = out / "runs" / path.stem
    shutil.rmtree(run_folder, ignore_errors=True)
    run = reconstruct(read(folder), run_folder, "best", images=images, device="cpu")
    torch.save({"run": str(run.path), "renderings": renderings_of(run)}, path)


def renderings_of(run: Run) -> list[tuple[int, Rendering]]:
    """Raw frames with their renderings of the fit alone."""
    sequence = run.sequence()
    frames = scored_frames(sequence)[FIRST::EVERY]
    rendered = RawFrames(run, sequence, ("distance", "phasor", "opacity"), kept=frames)
    return [(n, rendered(n, float(sequence.frame_frequencies[n]))) for n in frames]


def errors(stored: Stored, resolved: Rule) -> dict[str, float]:
    """Mean squared error over that of the closed form, by class of pixels."""
    sequence = stored["open"].sequence()
    frames = [n for n, _ in stored["renderings"]]
    truth = known_distance(read_truth(sequence))
    moving, static = moving_and_static(truth, frames, cycle=sequence.cycle)
    edge = near_steps(truth[frames])
    closed = np.stack([closed_form_distance(sequence, n // sequence.cycle) for n in frames])
    given = np.stack([resolved(n, rendering).numpy() for n, rendering in stored["renderings"]])
    of_closed, of_given = (np.square(image - truth[frames]) for image in (closed, given))
    masks = {
        "all": np.ones_like(moving),
        "moving": moving,
        "static": static,
        "static edge": static & edge,
        "static interior": static & ~edge,
    }
    ratios = {}
    for name, mask in masks.items():
        known = mask & ~np.isnan(truth[frames])
        if known.any():
            ratios[name] = float(of_given[known].mean() / of_closed[known].mean())
    return ratios


def rule(run: Run, spec: str) -> Rule:
    """Distances of the fallback alone, or of a run with changed constants."""
    for change in filter(None, spec.split(",") if spec != "fallback" else ()):
        name, _, value = change.partition("=")
        module, _, constant = name.partition(".")
        if not hasattr(MODULES[module], constant):
            raise SystemExit(f"recon/{module}.py has no {constant}")
        setattr(MODULES[module], constant, type(getattr(MODULES[module], constant))(value))

    def distances(n: int, rendering: Rendering) -> torch.Tensor:
        time = float(run.sequence().times[n])
        camera = camera_at(run, run.sequence(), time)
        if spec != "fallback":
            return run.corrected(rendering, time, camera).distance
        replaced = run.fallback and run.fallback.applied(rendering, time, camera)
        return (replaced or rendering).distance

    return distances


def score(out: Path, specs: list[str]) -> None:
    """Print a table."""
    groups: dict[str, list[Stored]] = {}
    for path in sorted(out.glob("*.pt")):
        stored = torch.load(path, weights_only=False)  # a file of our own
        stored["open"] = Run.open(stored["run"], "cpu")
        groups.setdefault(path.stem.partition("-")[0], []).append(stored)
    constants = {
        (module, name): value
        for module in MODULES.values()
        for name, value in vars(module).items()
        if isinstance(value, int | float)
    }
    for spec in ("fallback", "", *specs):
        for group, sequences in groups.items():
            found = [errors(one, rule(one["open"], spec)) for one in sequences]
            for (module, name), value in constants.items():
                setattr(module, name, value)
            means = {
                name: np.exp(np.mean([np.log(one[name]) for one in found if name in one]))
                for name in found[0]
            }
            text = ", ".join(f"{name} {value:.3f}" for name, value in means.items())
            print(f"{spec or 'outlines'} | {group}, {len(found)} sequences | {text}", flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    fitting, scoring = commands.add_parser("fit"), commands.add_parser("score")
    for command in (fitting, scoring):
        command.add_argument("out", type=Path)
    fitting.add_argument("sequences", type=Path, nargs="+")
    fitting.add_argument("--images", type=int, default=1500)
    scoring.add_argument("specs", nargs="*")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.command == "score":
        score(arguments.out, arguments.specs)
    else:
        for folder in arguments.sequences:
            fit(arguments.out, folder.resolve(), arguments.images)


if __name__ == "__main__":
    main()
