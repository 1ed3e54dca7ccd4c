"""Who rests: Gaussians that only pixels see whose raw quads never change. They have not moved, whatever a network says.

An approximation, off unless ``GateSettings.still_pixels``. Who rests has a negative layer, which is stored with the
run; its displacement is exactly zero, in a step and ever after (design/training-step.md).
"""

from __future__ import annotations

import logging

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene.gaussians import GaussianField
from ..scene.initialise import MOVING
from ..scene.motion import Motion
from ..scene.network import Network
from ..scene.still import rests
from .densify import crossed, round_is_due
from .observations import Observations
from .optimiser import frozen
from .settings import ReconSettings
from .state import State

LOG = logging.getLogger("gftorf_warp")
BUCKET = 2048  # rows that ask come in such numbers


def is_due(before: int, after: int, settings: ReconSettings) -> bool:
    """Whether a step from ``before`` to ``after`` images ends with a judgement.

    At the end of the warm-up, after a round, and every so many images as long as Gaussians are optimised.
    """
    warm_up = settings.schedule.warm_up
    if not settings.gate.still_pixels or after < warm_up or frozen(settings, before):
        return False
    if before < max(warm_up, 1) or crossed(before, after, settings.gate.every):
        return True
    return round_is_due(before, after, settings.densify, settings.schedule)


@torch.no_grad()
def judge_after(state: State, before: int, observations: Observations, settings: ReconSettings) -> bool:
    """The judgement that may be due after a step: who only still pixels see rests, everybody else is awake.

    Args:
        state: Its layers and attachment change.
        before: Optimised images before the step.
        observations: Which pixels are still.
        settings: When.

    Returns:
        Whether anybody fell asleep or woke up.
    """
    if observations.still is None or not is_due(before, state.images, settings):
        return False
    optimiser, field = state.optimiser, state.optimiser.field
    layer = torch.full_like(field.mean[:, 0], MOVING, dtype=torch.int64) if field.layer is None else field.layer.abs()
    asleep = rests(field, observations.still, observations.cameras[0])
    layer = torch.where(asleep, -layer, layer)
    if field.layer is not None and torch.equal(layer, field.layer):
        return False  # nodes stay attached as they are
    optimiser.layer = layer
    state.attachment = state.motion.attach(optimiser.field)
    LOG.debug("%d of %d Gaussians are awake at image %d", int((layer > 0).sum()), len(layer), state.images)
    return True


class Asking:
    """Rows that ask the network in steps whose shapes are fixed: whole buckets, so that a graph can look at them.

    Where fewer are awake, some at rest ask as well, and what they are told counts nothing; so no row comes twice, and
    gradients are exact.
    """

    def __init__(self, motion: Motion, *, gated: bool):
        """Nobody is known yet.

        Args:
            motion: Of the run; what is no network is cheap to ask, and asked for everybody.
            gated: Whether anybody may be at rest.
        """
        self._motion, self._gated = motion, gated and isinstance(motion, Network)
        self._asked: tuple[Int[Tensor, "A"], Float[Tensor, "A 1"]] | None = None  # rows, and 1 for who is awake

    @property
    def counts(self) -> tuple[int, int] | None:
        """Gaussians that are awake and rows that ask, which waits for the device; None: everybody asks."""
        return None if self._asked is None else (int(self._asked[1].sum()), len(self._asked[0]))

    def follow(self, layer: Int[Tensor, "rows"] | None) -> bool:
        """Gaussians came, went, woke up or fell asleep; the host waits once.

        Args:
            layer: Of all rows; 0 behind the last Gaussian.

        Returns:
            Whether a tensor lies elsewhere than before, so that nothing captured with the old ones may run again.
        """
        if not self._gated or layer is None:
            return False
        awake = layer > 0
        wanted = max(-(-int(awake.sum()) // BUCKET), 1) * BUCKET
        if self._asked is not None and 0 <= len(self._asked[0]) - wanted <= BUCKET:  # one too many does no harm
            wanted = len(self._asked[0])
        rows = awake.int().argsort(descending=True, stable=True)[:wanted].sort().values
        asked = rows, awake[rows, None].to(torch.float32)
        if self._asked is None or len(rows) != len(self._asked[0]):
            self._asked = asked
            return True
        for place, value in zip(self._asked, asked, strict=True):
            place.copy_(value)
        return False

    def offsets(
        self, field: GaussianField, attachment: Float[Tensor, "rows M"] | None, keys: Int[Tensor, "k"]
    ) -> Float[Tensor, "k rows 3"]:
        """Displacements [m] at some keys, with a gradient to the motion for those who are awake.

        Args:
            field: All rows.
            attachment: How they hang on the motion; None: that is found out, for those who ask.
            keys: Numbers of keys, read on their device.
        """
        motion = self._motion
        if not isinstance(motion, Network):
            return motion.key_offsets(motion.attach(field) if attachment is None else attachment, keys)
        if self._asked is None:  # everybody is awake
            return motion.asked(motion.attach_at(field.mean.detach()) if attachment is None else attachment, keys)
        rows, awake = self._asked
        if attachment is None:
            place = motion.attach_at(field.mean.detach().index_select(0, rows))
        else:
            place = attachment.index_select(0, rows)
        told = motion.asked(place, keys) * awake
        return told.new_zeros(len(keys), len(field), 3).index_copy(1, rows, told)
