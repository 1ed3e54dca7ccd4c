"""Distances and moving pixels from ground truth, for evaluation and diagnostics only."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ..constants import FRAMES_PER_QUARTET
from .sequence import Truth

# [m] twice the noise of a distance decoded from typical quads, a fraction of any object
MOVING_M = 0.05


def known_distance(truth: Truth) -> Float[np.ndarray, "F H W"]:
    """True distance of every raw frame [m], NaN where unknown."""
    return np.where(truth.known[:, None, None], truth.distance, np.nan)


def moving_and_static(
    distance_truth: Float[np.ndarray, "F H W"],
    frames: list[int],
    *,
    from_phasors: bool = False,
    cycle: int = FRAMES_PER_QUARTET,
) -> tuple[Bool[np.ndarray, "S H W"], Bool[np.ndarray, "S H W"]]:
    """Moving and static pixels of the S scored raw frames; NaN in the truth [m] is unknown.

    A pixel moves if its true distance has max - min > 0.05 m within the raw frames of its quartet.
    It is static if all of them are known and it does not move; with unknown truth it may be
    neither. The raw frames of a phasor are of one instant, so a pixel of phasors moves if its
    distance differs that much from one phasor to the next (the last: from the previous one).
    """
    step = cycle
    moving, static = {}, {}
    for quartet in {n // step for n in frames}:
        quartet_truth = distance_truth[step * quartet : step * (quartet + 1)]
        if from_phasors:
            last = step * (quartet + 1) >= len(distance_truth)
            neighbour = max(quartet - 1, 0) if last else quartet + 1
            quartet_truth = distance_truth[[step * quartet, step * neighbour]]
        unknown = np.isnan(quartet_truth)
        low = np.where(unknown, np.inf, quartet_truth).min(axis=0)
        high = np.where(unknown, -np.inf, quartet_truth).max(axis=0)
        moving[quartet] = high - low > MOVING_M
        static[quartet] = ~moving[quartet] & ~unknown.any(axis=0)
    rows = [n // step for n in frames]
    return np.stack([moving[i] for i in rows]), np.stack([static[i] for i in rows])


def static_throughout(distance_truth: Float[np.ndarray, "F H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose true distance [m] never changes by more than 0.05 m in the whole sequence.

    Raw frames of unknown truth (NaN) do not count.
    """
    unknown = np.isnan(distance_truth)
    low = np.where(unknown, np.inf, distance_truth).min(axis=0)
    high = np.where(unknown, -np.inf, distance_truth).max(axis=0)
    return high - low <= MOVING_M


def nearest(
    images: Float[np.ndarray, "F H W"], height: int, width: int
) -> Float[np.ndarray, "F h w"]:
    """Images resized by nearest neighbours: distances must not be averaged."""
    rows = ((np.arange(height) + 0.5) * images.shape[1] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * images.shape[2] / width).astype(int)
    return images[:, rows[:, None], columns]
