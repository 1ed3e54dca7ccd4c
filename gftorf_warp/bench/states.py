"""States for timing steps and renderings: of a run, or from phase, of a simulated scene.

The scene slides past a static camera. The number of Gaussians is that of the published
initialisation after its first opacity reset (19 to 21 thousand); a network moves them, as
published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

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
COUNT = (19_000, 21_000)  # least and largest number of Gaussians
QUICK_COUNT = (700, 900)
TRIES = 8  # to find a spacing that gives so many
REACHED = 5_000  # optimised images of the state: after the warm-up, before motion freezes


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """State of an optimisation in progress."""

    observations: Observations
    """The prepared sequence."""
    settings: ReconSettings
    """Without densification and opacity resets."""
    stored: dict
    """The state as a checkpoint, on the device."""
    sequence: Sequence
    """The sequence as read."""

    @property
    def gaussians(self) -> int:
        """Number N of Gaussians."""
        return len(self.stored["field"]["mean"])


def simulated(path: Path, *, quick: bool) -> Path:
    """The folder of the scene, simulated if absent."""
    frames, size = (QUICK_FRAMES, QUICK_SIZE) if quick else (FRAMES, SIZE)
    return path if path.exists() else simulate(SCENE, path, frames=frames, size=size, seed=0)


def settings_of(sequence: Sequence, preset: str, changes: list[str], device: str) -> ReconSettings:
    """A preset with changes, without densification and opacity resets."""
    resolved = input_of(sequence, Input.AUTO)
    recorded = presets.Recorded.of(sequence, resolved)
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
        why = "nothing was reconstructed yet"
        fix = "name the --out of a reconstruction, or leave --run out"
        raise InputError("the run has no checkpoint", where=run, why=why, fix=fix)
    if stored is None:
        stored = to_dict(begin(observations, settings, seed=0, device=device))
    return Fitted(observations=observations, settings=settings, stored=stored, sequence=sequence)


def from_phase(sequence: Sequence, settings: ReconSettings, device: str, *, quick: bool) -> Fitted:
    """19 to 21 thousand Gaussians from measured phase, with the motion of the settings."""
    low, high = QUICK_COUNT if quick else COUNT
    observations = observe(sequence, settings, device)
    init, middle = replace(InitSettings(), kind=Init.PHASE), 0.5 * (low + high)
    spacing = (observations.sequence.width * observations.sequence.height / middle) ** 0.5
    state: State | None = None
    for _ in range(TRIES):
        init = replace(init, static_spacing=spacing, moving_spacing=0.5 * spacing)
        state = begin(observations, replace(settings, init=init), seed=0, device=device)
        count = len(state.optimiser.field)
        if low <= count <= high:
            break
        spacing *= (count / middle) ** 0.5
    assert state is not None
    stored = to_dict(state)
    stored["images"] = min(REACHED, settings.schedule.images // 4)
    return Fitted(observations=observations, settings=settings, stored=stored, sequence=sequence)


def pairs_of(fitted: Fitted) -> int:
    """Number of (tile, splat) pairs of the state in the middle of the sequence, as optimised."""
    observations = fitted.observations
    middle = observations.sequence.frames // 2
    camera = observations.cameras[middle]
    gaussians = field_and_motion(fitted.stored, observations.quads.device)
    replay = Replay(*gaussians, observations.sensor, fitted.settings.render, camera)
    replay(observations.time_at(middle), camera)
    return replay.largest


def as_run(fitted: Fitted, path: Path, device: torch.device | str) -> Path:
    """The state as the folder of a run, which ``Run.open`` reads."""
    observations = fitted.observations
    config = config_of(fitted.sequence, fitted.settings, seed=0, device=device)
    config |= {
        "flow": None,
        "changes": [],
        "quad_scale": observations.quad_scale,
        "quad_scale_source": observations.quad_scale_source,
        "flow_source": observations.flow_source,
        "input": str(Input.PHASOR if observations.phasors else Input.QUADS),
        "colour_scale": observations.colour_scale,
        "size_optimised": [observations.sequence.width, observations.sequence.height],
    }
    path.mkdir(parents=True, exist_ok=True)
    folder.write_config(path, config)
    checkpoint.save(path, fitted.stored)
    return path
