"""Steps of an image of distances: where a surface ends before another one.

A step lies between two neighbouring pixels whose distances differ by more than ``STEP_M`` from each
other and from the continuation of the surface on either side; a slope, however steep, is no step.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

STEP_M = 0.1  # [m] twice the change that counts as motion
EDGE_PX = 1.5  # [px] from a step: two pixels on either side of it


def near_steps(truth: Float[np.ndarray, "S H W"]) -> Bool[np.ndarray, "S H W"]:
    """Pixels within ``EDGE_PX`` of the middle between two pixels with a step between them."""
    beside = np.zeros(truth.shape, dtype=bool)
    for axis in (1, 2):
        along, marked = (np.moveaxis(array, axis, -1) for array in (truth, beside))
        step = _steps(along)
        marked[..., :-1] |= step
        marked[..., 1:] |= step
    return grown(beside)


def grown(mask: Bool[np.ndarray, "S H W"]) -> Bool[np.ndarray, "S H W"]:
    """The mask and its four neighbours in the image."""
    result = mask.copy()
    result[:, 1:] |= mask[:, :-1]
    result[:, :-1] |= mask[:, 1:]
    result[..., 1:] |= mask[..., :-1]
    result[..., :-1] |= mask[..., 1:]
    return result


def _steps(distance: Float[np.ndarray, "*n w"]) -> Bool[np.ndarray, "*n w-1"]:
    """Whether there is a step between each pixel of a row and the next."""
    change = np.diff(distance, axis=-1)
    with np.errstate(invalid="ignore"):  # comparisons with unknown truth are false
        bend = np.abs(np.diff(change, axis=-1)) <= STEP_M
        step = np.abs(change) > STEP_M
    step[..., :-1] &= ~bend
    step[..., 1:] &= ~bend
    return step
