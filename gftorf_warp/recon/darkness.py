"""Random starts that end in the dark: splats near the camera turn black, hide everything, and stay.

Fall-off makes a splat at a tenth of the distance a hundred times as bright, so that those which a random start puts
right before the camera become black first; opaque they are worth as much as black images, and nothing behind them is
seen any more. Resets of the opacities do not help: what is in front is opaque again first. One of nine
measured starts ended so (design/reconstruction.md). The loss tells: from then on it is that of black images.
"""

from __future__ import annotations

import math

import torch

from ..scene.initialise import Init
from .objective import image_loss
from .observations import Observations
from .settings import ReconSettings

AFTER = 0.15  # of a run has to be over
WARM = 1.5  # warm-ups have to be over
NEAR = 0.03  # of the loss of black images is how far from it dark runs stay: different images make up the rows
ROWS = 3  # of metrics so near, at least,
SHARE = 0.3  # and of all rows; a start that learns slowly is above it at first, and passes by
LOOKED_AT = 32  # images at most, spread over the sequence


def judged_at(settings: ReconSettings) -> int | None:
    """Images after which a run is judged, a multiple of those between two rows of metrics; None: it never is."""
    schedule = settings.schedule
    if settings.init.kind != Init.RANDOM or settings.weights.quads <= 0:
        return None
    images = max(AFTER * schedule.images, WARM * schedule.warm_up)
    images = math.ceil(images / schedule.log_every) * schedule.log_every
    return images if 2 * images <= schedule.images else None  # too short to say, or to begin again


def is_dark(losses: list[float], observations: Observations, settings: ReconSettings) -> bool:
    """Whether the mean loss of images came down to that of black images, and stayed there.

    Args:
        losses: What ``quads`` came to in each row of metrics.
        observations: What is compared.
        settings: How.
    """
    black = loss_of_black(observations, settings)
    near = sum(abs(loss - black) <= NEAR * black for loss in losses)
    return near >= max(ROWS, SHARE * len(losses)) and min(losses) >= (1.0 - NEAR) * black


@torch.no_grad()
def loss_of_black(observations: Observations, settings: ReconSettings) -> float:
    """The term ``quads`` of the loss, if all images were zero: the mean over some that were measured."""
    if observations.phasors:
        images = list(observations.phasors.values())
    else:
        images = [image[None] for image in observations.quads[torch.as_tensor(observations.sequence.measured)]]
    images = images[:: math.ceil(len(images) / LOOKED_AT)]
    losses = [image_loss(torch.zeros_like(image), image, settings.weights.ssim)[0] for image in images]
    return settings.weights.quads * float(torch.stack(losses).mean())
