"""The complete state of an optimisation between two steps, which can be stored and rebuilt."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import SH_COEFFICIENTS
from ..render.network import with_backend
from ..scene.gaussians import GaussianField
from ..scene.initialise import Init, Start, from_phase, from_quartets, from_random
from ..scene.measured import key_times
from ..scene.models import KINDS, motion_from_dict
from ..scene.motion import Motion, MotionStart
from ..scene.unwrap import common_range
from . import densify
from .observations import Observations
from .optimiser import Optimiser, betas_of
from .settings import ReconSettings

FORMAT = 3  # of checkpoints; 1 and 2 are read, a higher one is refused
SEED_MASK = 0x7FFFFFFF  # a seed as a positive int32, for kernels
CUDA_STATE = 16  # bytes of the state of a CUDA generator


@dataclass(kw_only=True)
class Progress:
    """How far a run is, as plain numbers."""

    images: int = 0
    """Optimised images."""
    seconds: float = 0.0
    """Wall clock spent so far [s]."""
    rate_factor: float = 1.0
    """Multiplies all learning rates."""
    skipped: int = 0
    """Skipped steps: loss or gradient not finite."""
    rollbacks: int = 0
    """Returns to a checkpoint."""
    restarts: int = 0
    """Collapsed random starts before this one."""
    reset_at: int | None = None
    """Optimised images at the last opacity reset; None: there was none."""
    revived_at: int | None = None
    """Optimised images when the motion was last reinitialised; None: never."""
    revivals: int = 0
    """How often it was."""
    unseen_at: int = 0
    """Optimised images at the last visibility pruning."""
    attempt: int = 1
    """Number of the attempt, see attempts.py."""


PROGRESS = [field.name for field in fields(Progress)]


@dataclass(kw_only=True, eq=False)
class State(Progress):
    """An optimisation between two steps."""

    optimiser: Optimiser
    """Gaussians and moments."""
    motion: Motion
    """The motion model."""
    binding: Float[Tensor, "N M"]
    """What the motion model needs of each Gaussian."""
    statistics: densify.Statistics
    """Of densification, since the last one."""
    generator: torch.Generator
    """On the CPU: order of the raw frames, and positions of the halves of split Gaussians."""
    noise_seed: int
    """Of random backgrounds, which are a function of it and of the number of the image."""
    queue: list[int]
    """Batches still to be drawn in this epoch."""
    sums: dict[str, Tensor]
    """Loss terms and others, summed over the images since the last logged row."""
    judged: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Attempts that ended and failed, or were compared with one that had, see attempts.py."""
    other: dict[str, Any] | None = None
    """In a second attempt: state and rows at the end of the first."""


def begin(
    observations: Observations, settings: ReconSettings, *, seed: int, device: torch.device | str
) -> State:
    """Gaussians and motion to start from.

    Raises:
        InputError: If the sequence does not allow this initialisation.
    """
    generator = torch.Generator().manual_seed(seed)
    sequence = observations.sequence
    if settings.init.kind == Init.PHASE:
        first = from_phase(sequence, settings.init)
    elif settings.init.kind == Init.QUARTETS:
        first = from_quartets(sequence, settings.init, device)
    else:
        first = from_random(sequence, settings.init, generator)
    motion = with_backend(_motion(first, observations, settings, generator).to(device))
    field = first.field.map(lambda value: value.to(device))
    if settings.weights.colour > 0:
        field = replace(field, colour_sh=torch.zeros(len(field), SH_COEFFICIENTS, 3, device=device))
    return State(
        optimiser=Optimiser(field, motion, betas=betas_of(settings)),
        motion=motion,
        binding=motion.bind(field),
        statistics=densify.start(field),
        generator=generator,
        noise_seed=seed & SEED_MASK,
        queue=[],
        sums={},
    )


def _motion(
    start: Start, observations: Observations, settings: ReconSettings, generator: torch.Generator
) -> Motion:
    sequence = observations.sequence
    initial = MotionStart(
        key_times=key_times(sequence),
        field=start.field,
        tracks=None
        if start.positions is None
        else start.positions - start.positions[start.quartet],
        velocity=start.velocity,
        duration=float(sequence.times[-1] - sequence.times[0]),
        unambiguous_range=common_range(observations.sensor),
        generator=generator,
    )
    return KINDS[settings.motion.kind].start(settings.motion, initial)


def to_dict(state: State) -> dict[str, object]:
    """Tensors, numbers, strings, lists and dictionaries only, which a safe loader can read."""
    return {
        "format": FORMAT,
        "field": {name: value.detach() for name, value in state.optimiser.field.tensors().items()},
        "adam": state.optimiser.state_dict(),
        "motion": state.motion.to_dict(),
        "attachment": state.optimiser.field.mean.detach()
        if state.motion.follows_means
        else state.binding,
        "statistics": {name: getattr(state.statistics, name) for name in densify.STATISTICS},
        "generator": state.generator.get_state(),
        "noise_seed": state.noise_seed,
        "queue": list(state.queue),
        "sums": dict(state.sums),
        "judged": list(state.judged),
        "other": state.other,
        **{name: getattr(state, name) for name in PROGRESS},
    }


def field_and_motion(
    stored: dict, device: torch.device | str
) -> tuple[GaussianField, Motion, Tensor]:
    """Gaussians, their motion and their binding to it, from the stored form."""
    field = GaussianField(**{name: value.to(device) for name, value in stored["field"].items()})
    motion = with_backend(motion_from_dict(stored["motion"]).to(device))
    binding = motion.bind(field) if motion.follows_means else stored["attachment"].to(device)
    return field, motion, binding


def from_dict(stored: dict, device: torch.device | str) -> State:
    """Rebuild a state from :func:`to_dict`; on a CPU it continues to the same bits."""
    field, motion, binding = field_and_motion(stored, device)
    statistics = {name: value.to(device) for name, value in stored["statistics"].items()}
    generator = torch.Generator()
    generator.set_state(stored["generator"].cpu())
    progress = {name: stored[name] for name in PROGRESS if name in stored}  # format 1 had fewer
    progress.setdefault("unseen_at", stored["images"])
    return State(
        optimiser=Optimiser(field, motion, stored["adam"]),
        motion=motion,
        binding=binding,
        statistics=replace(densify.start(field), **statistics),
        generator=generator,
        noise_seed=_noise_seed(stored),
        queue=list(stored["queue"]),
        sums={name: value.to(device) for name, value in stored["sums"].items()},
        judged=list(stored.get("judged", [])),
        other=stored.get("other"),
        **progress,
    )


def _noise_seed(stored: dict) -> int:
    """Seed of random backgrounds; formats 1 and 2 had the state of a generator of torch."""
    if "noise_seed" in stored:
        return stored["noise_seed"]
    state = stored["noise"].cpu()
    if len(state) == CUDA_STATE:  # seed and offset, eight bytes each
        return int.from_bytes(bytes(state[:8].tolist()), "little") & SEED_MASK
    return torch.Generator().set_state(state).initial_seed() & SEED_MASK
