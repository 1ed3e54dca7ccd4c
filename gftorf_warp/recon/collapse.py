"""Detects two ways in which an optimisation collapses, and reinitialises it.

*Opaque veil*: falloff makes a Gaussian at a tenth of the distance a hundred times as bright, so
Gaussians that a random start puts right in front of the camera turn black first. Opaque, they are
as good as black images and hide everything. Opacity resets do not help: what is in front turns
opaque first. One of nine measured starts ended so. The loss stays that of black images.

*Dead ReLU*: no ReLU of some layer of the motion network is active for any Gaussian at any time. All
Gaussians then move alike, by the bias of the head, and no earlier weight has a gradient. Adam makes
steps of the full rate from the first image on, when all gradients agree: one of eleven runs of
quartets ended so. ``Schedule.motion_ramp`` mostly prevents it.
"""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from ..render.fused import image_loss
from ..scene.initialise import Init
from ..scene.network import Network
from .observations import Observations
from .settings import ReconSettings
from .state import State

LOG = logging.getLogger("gftorf_warp")
CHECKED_AFTER = 0.15  # of the run
WARM_UPS = 1.5  # and after so many warm-ups
NEAR = 0.03  # relative distance from the loss of black images: rows average over different images
ROWS = 3  # of metrics so near, at least,
SHARE = 0.3  # and of all rows; a slow start is above that loss at first, and passes it
IMAGES = 32  # for the loss of black images, spread over the sequence


def veil_checked_at(settings: ReconSettings) -> int | None:
    """Images after which a run is checked for a veil, a multiple of ``log_every``; None: never."""
    schedule = settings.schedule
    if settings.init.kind != Init.RANDOM or settings.weights.quads <= 0:
        return None
    images = max(CHECKED_AFTER * schedule.images, WARM_UPS * schedule.warm_up)
    images = math.ceil(images / schedule.log_every) * schedule.log_every
    # else too short to tell, or to restart
    return images if 2 * images <= schedule.images else None


def is_veiled(losses: list[float], observations: Observations, settings: ReconSettings) -> bool:
    """Whether the loss reached that of black images and stayed there.

    Args:
        losses: The term ``quads`` in every row of metrics.
        observations: What is compared.
        settings: Of the run.
    """
    black = loss_of_black(observations, settings)
    near = sum(abs(loss - black) <= NEAR * black for loss in losses)
    return near >= max(ROWS, SHARE * len(losses)) and min(losses) >= (1.0 - NEAR) * black


@torch.no_grad()
def loss_of_black(observations: Observations, settings: ReconSettings) -> float:
    """The term ``quads`` of the loss if all rendered images were zero:
    the mean over some frames.
    """
    images = observations.phasors.images
    if not observations.phasors:
        measured = torch.as_tensor(observations.sequence.measured)
        images = observations.quads[measured.to(observations.quads.device)][:, None]
    images = images[:: math.ceil(len(images) / IMAGES)]
    ssim = settings.weights.ssim
    losses = [image_loss(torch.zeros_like(image), image, ssim)[0] for image in images]
    return settings.weights.quads * float(torch.stack(losses).mean())


@torch.no_grad()
def has_dead_network(state: State, settings: ReconSettings) -> bool | Tensor:
    """Whether a trained motion network displaces every Gaussian alike at all times.

    A boolean tensor on the device where that has to be computed: reading it may wait.
    """
    if not isinstance(state.motion, Network) or state.images <= settings.schedule.warm_up:
        return False
    keys = [0, len(state.motion.key_times) // 2]
    offsets = state.motion.at_keys(state.motion.bind(state.optimiser.field), keys).offset
    return len(offsets[0]) > 1 and (offsets == offsets[:1, :1]).all()


def revive(state: State, settings: ReconSettings) -> None:
    """Reinitialise a dead network, unless that was done too often; the Gaussians stay."""
    again = state.revivals < settings.restarts_max
    then = "it is reinitialised" if again else "it was reinitialised too often and stays"
    LOG.warning("dead ReLU layer in the motion network at image %d: %s", state.images, then)
    if not again:
        return
    assert isinstance(state.motion, Network)
    state.motion.reset_parameters(state.generator)
    state.optimiser.forget_motion()
    state.revived_at, state.revivals = state.images, state.revivals + 1
