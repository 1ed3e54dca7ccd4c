"""Networks that die: no ReLU of some layer lets anything through any more, for any Gaussian at any time.

Then all Gaussians move alike, by the bias of the last layer, and no weight before it has a gradient, so that nothing
ever moves again by itself. Adam makes steps of the full rate from the first image on, when all gradients still pull
the same way: of eleven runs of quartets, whose rates are four times as large, one ended so, and its loss never fell
below that of a scene at rest. ``Schedule.motion_ramp`` prevents it; this is for what it does not prevent.
"""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from ..scene.network import Network
from .settings import ReconSettings
from .state import State

LOG = logging.getLogger("gftorf_warp")


@torch.no_grad()
def is_dead(state: State, settings: ReconSettings) -> bool | Tensor:
    """Whether the motion is a network that has learnt, and gives every Gaussian the same offset at all times.

    A tensor where the device has to be asked: whoever has time reads it later.
    """
    if not isinstance(state.motion, Network) or state.images <= settings.schedule.warm_up:
        return False
    keys = [0, len(state.motion.key_times) // 2]
    offsets = state.motion.at_keys(state.motion.attach(state.optimiser.field), keys).offset
    return len(offsets[0]) > 1 and (offsets == offsets[:1, :1]).all()


def revive(state: State, settings: ReconSettings) -> None:
    """Draw a dead network anew, at rest, if that was not done too often; the Gaussians stay as they are."""
    again = state.revivals < settings.restarts_max
    then = "begins again at rest" if again else "stays so: it began again too often"
    LOG.warning("the motion network is dead at image %d: all its gradients are zero; it %s", state.images, then)
    if not again:
        return
    assert isinstance(state.motion, Network)
    state.motion.draw(state.generator)
    state.optimiser.forget_motion()
    state.revived_at, state.revivals = state.images, state.revivals + 1
