"""What a step and a rendering are timed on without an earlier run: a simulated scene, and Gaussians that look fitted.

The scene slides past a camera at rest. Gaussians start from its measured phase, as many as are left of the published
start after its first reset of opacities (19 to 21 thousand), and a network moves them, as published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ..data.decode import unambiguous_range
from ..data.sequence import Sequence
from ..errors import InputError
from ..recon import checkpoint, folder, presets
from ..recon.config import config_of
from ..recon.observations import Observations, input_of, observe
from ..recon.settings import Input, ReconSettings
from ..recon.state import State, begin, field_and_motion, to_dict
from ..recon.train import CHANGES
from ..render.replay import Replay
from ..scene.changes import changed
from ..scene.initialise import Init, InitSettings
from ..sim.simulate import simulate

SCENE = "sliding"
FRAMES, SIZE = 60, (320, 240)
QUICK_FRAMES, QUICK_SIZE = 12, (64, 48)
COUNT = (19_000, 21_000)  # Gaussians that are left of the published start [Gaussians]
QUICK_COUNT = (700, 900)
TRIES = 8  # at a spacing that gives so many
REACHED = 5_000  # images that count as optimised: past the warm-up, before the freeze


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """An optimisation in its middle."""

    observations: Observations
    """What is compared."""
    settings: ReconSettings
    """Without rounds and resets."""
    stored: dict
    """The state, as a checkpoint holds it, on the device."""
    sequence: Sequence
    """As it was read."""

    @property
    def gaussians(self) -> int:
        """Number N of Gaussians."""
        return len(self.stored["field"]["mean"])


def simulated(path: Path, *, quick: bool) -> Path:
    """The scene as a folder, simulated unless it is there."""
    if path.exists():
        return path
    return simulate(SCENE, path, frames=QUICK_FRAMES if quick else FRAMES, size=QUICK_SIZE if quick else SIZE, seed=0)


def settings_of(sequence: Sequence, preset: str, changes: list[str], device: str) -> ReconSettings:
    """A preset, changed, that neither adds nor removes nor dims Gaussians."""
    found = input_of(sequence, Input.AUTO)
    recorded = presets.Recorded(input=found, unambiguous_range=unambiguous_range(sequence))
    settings = changed(presets.preset(preset, recorded), changes, CHANGES)
    settings = replace(settings, densify=replace(settings.densify, stop_share=0.0))
    threads = 1 if torch.device(device).type == "cpu" else settings.render.threads
    return replace(settings, render=replace(settings.render, threads=threads))


def from_run(run: Path | None, sequence: Sequence, settings: ReconSettings, device: str) -> Fitted:
    """The newest checkpoint of a run; without a run, the first state of the settings.

    Raises:
        InputError: If the run holds no checkpoint.
    """
    observations = observe(sequence, settings, device)
    stored = None if run is None else checkpoint.last(run, device)
    if stored is None and run is not None:
        fix = "name the --out of a reconstruction, or leave --run out"
        raise InputError("the run has no checkpoint", where=run, why="nothing was reconstructed yet", fix=fix)
    if stored is None:
        stored = to_dict(begin(observations, settings, seed=0, device=device))
    return Fitted(observations=observations, settings=settings, stored=stored, sequence=sequence)


def from_phase(sequence: Sequence, settings: ReconSettings, device: str, *, quick: bool) -> Fitted:
    """Gaussians from measured phase, 19 to 21 thousand of them, with the motion of the settings."""
    low, high = QUICK_COUNT if quick else COUNT
    observations = observe(sequence, settings, device)
    init = replace(InitSettings(), kind=Init.PHASE)
    spacing = (observations.sequence.width * observations.sequence.height / (0.5 * (low + high))) ** 0.5
    state: State | None = None
    for _ in range(TRIES):
        init = replace(init, static_spacing=spacing, moving_spacing=0.5 * spacing)
        state = begin(observations, replace(settings, init=init), seed=0, device=device)
        count = len(state.optimiser.field)
        if low <= count <= high:
            break
        spacing *= (count / (0.5 * (low + high))) ** 0.5
    assert state is not None
    stored = to_dict(state)
    stored["images"] = min(REACHED, settings.schedule.images // 4)
    return Fitted(observations=observations, settings=settings, stored=stored, sequence=sequence)


def pairs_of(fitted: Fitted) -> int:
    """(tile, splat) pairs of the state in the middle of the sequence, at the size of the optimisation."""
    seen, device = fitted.observations, fitted.observations.quads.device
    middle = seen.sequence.frames // 2
    camera = seen.cameras[middle]
    field, motion, attachment = field_and_motion(fitted.stored, device)
    replay = Replay(field, motion, attachment, seen.sensor, fitted.settings.render, camera)
    replay(seen.time_at(middle), camera)
    return replay.largest


def as_run(fitted: Fitted, path: Path, device: torch.device | str) -> Path:
    """The state as the folder of a run, which ``Run.open`` reads."""
    seen = fitted.observations
    config = config_of(fitted.sequence, fitted.settings, seed=0, device=device)
    config |= {
        "flow": None,
        "changes": [],
        "quad_scale": seen.quad_scale,
        "quad_scale_source": seen.quad_scale_source,
        "flow_source": seen.flow_source,
        "input": str(Input.PHASOR if seen.phasors else Input.QUADS),
        "colour_scale": seen.colour_scale,
        "size_optimised": [seen.sequence.width, seen.sequence.height],
    }
    path.mkdir(parents=True, exist_ok=True)
    folder.write_config(path, config)
    checkpoint.save(path, fitted.stored)
    return path
