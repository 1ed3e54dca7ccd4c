"""Everything an optimisation knows at one moment, as a value that can be stored and rebuilt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import SH_COEFFICIENTS
from ..scene.gaussians import GaussianField
from ..scene.initialise import Init, Start, from_phase, from_random
from ..scene.measured import key_times
from ..scene.models import KINDS, motion_from_dict
from ..scene.motion import Motion, MotionStart
from ..scene.unwrap import common_range
from . import densify
from .observations import Observations
from .optimiser import Optimiser, betas_of
from .settings import ReconSettings

FORMAT = 2  # of the stored form; a higher one is refused


@dataclass(kw_only=True, eq=False)
class State:
    """An optimisation between two steps."""

    optimiser: Optimiser
    """Gaussians and moments."""
    motion: Motion
    """Where they move."""
    attachment: Float[Tensor, "N M"]
    """How each Gaussian hangs on the motion."""
    statistics: densify.Statistics
    """What densification has seen since its last round."""
    generator: torch.Generator
    """On the CPU: the order of raw frames, and where halves of split Gaussians go."""
    noise: torch.Generator
    """On the device: random backgrounds."""
    queue: list[int]
    """Batches still to be drawn in this epoch."""
    images: int
    """Optimised images."""
    seconds: float
    """Wall clock spent so far [s]."""
    sums: dict[str, Tensor]
    """Loss terms and others, summed over the images since the last logged row."""
    rate_factor: float = 1.0
    """Multiplies all rates."""
    skipped: int = 0
    """Steps without a finite loss and gradient so far."""
    rollbacks: int = 0
    """Returns to a checkpoint so far."""
    restarts: int = 0
    """Random starts before this one, all in the dark."""
    reset_at: int | None = None
    """Optimised images at the last reset of the opacities; None: there was none."""
    revived_at: int | None = None
    """Optimised images when the motion was last drawn anew; None: it never was."""
    revivals: int = 0
    """How often it was."""
    unseen_at: int = 0
    """Optimised images when Gaussians that nobody sees were last looked for."""


def begin(observations: Observations, settings: ReconSettings, *, seed: int, device: torch.device | str) -> State:
    """Gaussians and motion to start from.

    Raises:
        InputError: If the sequence does not allow this initialisation.
    """
    generator = torch.Generator().manual_seed(seed)
    sequence = observations.sequence
    if settings.init.kind == Init.PHASE:
        first = from_phase(sequence, settings.init)
    else:
        first = from_random(sequence, settings.init, generator)
    motion = _motion(first, observations, settings, generator).to(device)
    field = first.field.map(lambda value: value.to(device))
    if settings.weights.colour > 0:
        field = replace(field, colour_sh=torch.zeros(len(field), SH_COEFFICIENTS, 3, device=device))
    return State(
        optimiser=Optimiser(field, motion, betas=betas_of(settings)),
        motion=motion,
        attachment=motion.attach(field),
        statistics=densify.start(field),
        generator=generator,
        noise=torch.Generator(device).manual_seed(seed),
        queue=[],
        images=0,
        seconds=0.0,
        sums={},
    )


def _motion(start: Start, observations: Observations, settings: ReconSettings, generator: torch.Generator) -> Motion:
    sequence = observations.sequence
    initial = MotionStart(
        key_times=key_times(sequence),
        field=start.field,
        tracks=None if start.positions is None else start.positions - start.positions[start.quartet],
        duration=float(sequence.times[-1] - sequence.times[0]),
        unambiguous_range=common_range(observations.sensor),
        generator=generator,
    )
    return KINDS[settings.motion.kind].start(settings.motion, initial)


def to_dict(state: State) -> dict[str, object]:
    """Tensors, numbers, texts, lists and dictionaries only: what a safe loader reads back."""
    return {
        "format": FORMAT,
        "field": {name: value.detach() for name, value in state.optimiser.field.tensors().items()},
        "adam": state.optimiser.adam.state_dict(),
        "motion": state.motion.to_dict(),
        "attachment": state.optimiser.field.mean.detach() if state.motion.follows_means else state.attachment,
        "statistics": {name: getattr(state.statistics, name) for name in densify.STATISTICS},
        "generator": state.generator.get_state(),
        "noise": state.noise.get_state(),
        "queue": list(state.queue),
        "images": state.images,
        "seconds": state.seconds,
        "sums": dict(state.sums),
        "rate_factor": state.rate_factor,
        "skipped": state.skipped,
        "rollbacks": state.rollbacks,
        "restarts": state.restarts,
        "reset_at": state.reset_at,
        "revived_at": state.revived_at,
        "revivals": state.revivals,
        "unseen_at": state.unseen_at,
    }


def field_and_motion(stored: dict, device: torch.device | str) -> tuple[GaussianField, Motion, Tensor]:
    """Gaussians, their motion and how they hang on it, from the stored form."""
    field = GaussianField(**{name: value.to(device) for name, value in stored["field"].items()})
    motion = motion_from_dict(stored["motion"]).to(device)
    attachment = motion.attach(field) if motion.follows_means else stored["attachment"].to(device)
    return field, motion, attachment


def from_dict(stored: dict, device: torch.device | str) -> State:
    """Rebuild a state from :func:`to_dict`; what follows is what would have followed, to the bit on a CPU."""
    field, motion, attachment = field_and_motion(stored, device)
    seen: dict[str, Tensor] = stored["statistics"]  # earlier runs did not look for the unseen
    generator, noise = torch.Generator(), torch.Generator(device)
    generator.set_state(stored["generator"].cpu())
    drawn = stored["noise"].cpu()
    if len(drawn) == len(noise.get_state()):
        noise.set_state(drawn)
    else:  # of another kind of device, whose generator is another: backgrounds go on with other numbers
        noise.manual_seed(stored["images"])
    return State(
        optimiser=Optimiser(field, motion, stored["adam"]),
        motion=motion,
        attachment=attachment,
        statistics=replace(densify.start(field), **{name: value.to(device) for name, value in seen.items()}),
        generator=generator,
        noise=noise,
        queue=list(stored["queue"]),
        sums={name: value.to(device) for name, value in stored["sums"].items()},
        reset_at=stored.get("reset_at"),  # format 1 had none
        restarts=stored.get("restarts", 0),  # neither had earlier runs
        revived_at=stored.get("revived_at"),
        revivals=stored.get("revivals", 0),
        unseen_at=stored.get("unseen_at", stored["images"]),
        **{name: stored[name] for name in ("images", "seconds", "rate_factor", "skipped", "rollbacks")},
    )
