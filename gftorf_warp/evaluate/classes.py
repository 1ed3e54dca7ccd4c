"""Errors by the shape of the truth around a pixel: near a step (see data/steps.py) it is *edge*,
elsewhere *interior*, which the slope of the truth divides further.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..data.steps import near_steps
from .metrics import DISTANCES, ERROR_UNIT

SLOPES = (0.01, 0.02, 0.04)  # [m/px] bounds of the classes of slope
EDGE = "edge"
OF_SLOPE = ("slope_0_10", "slope_10_20", "slope_20_40", "slope_over_40")  # [mm/px]
CLASSES = ("interior", EDGE, *OF_SLOPE)
"""Names of all classes; the slopes divide the interior."""


def class_of_pixels(truth: Float[np.ndarray, "S H W"]) -> UInt8[np.ndarray, "S H W"]:
    """0: edge; 1 to 4: the classes of slope, of true distances [m] with NaN where unknown."""
    edge = near_steps(truth)
    slope = np.zeros(truth.shape, dtype=np.float32)
    for axis in (1, 2):
        if truth.shape[axis] > 1:
            slope += np.square(np.nan_to_num(np.gradient(truth, axis=axis), nan=0.0))
    label = np.ones(truth.shape, dtype=np.uint8)
    for bound in np.square(SLOPES):
        label += slope >= bound
    label[edge] = 0
    return label


def class_errors(
    errors: Mapping[str, Float[np.ndarray, "S H W"]],
    truth: Float[np.ndarray, "S H W"],
    moving: Bool[np.ndarray, "S H W"],
    static: Bool[np.ndarray, "S H W"],
) -> dict[str, dict[str, dict[str, float | None]]]:
    """``<name>_mse_x100`` [m^2 x 100] of every distance and ``share`` of all moving and static
    pixels, by ``moving`` or ``static`` and by class; None where there is no pixel.
    """
    kinds = 1 + len(OF_SLOPE)
    label = class_of_pixels(truth) + kinds * static.astype(np.uint8)
    label[~(moving | static) | np.isnan(truth)] = 2 * kinds
    flat = label.ravel()
    pixels = np.bincount(flat, minlength=2 * kinds + 1)[: 2 * kinds].reshape(2, kinds)
    sums = {
        # errors are NaN where the truth is unknown, which have the last label
        name: np.bincount(flat, error.ravel(), 2 * kinds + 1)[: 2 * kinds]
        for name, error in errors.items()
    }
    rows = {"interior": slice(1, kinds), EDGE: slice(0, 1)}
    rows |= {name: slice(k, k + 1) for k, name in enumerate(OF_SLOPE, start=1)}
    result: dict[str, dict[str, dict[str, float | None]]] = {}
    for group, name in enumerate(("moving", "static")):
        result[name] = {}
        for kind, chosen in rows.items():
            count = int(pixels[group, chosen].sum())
            values: dict[str, float | None] = {
                f"{key}_mse_x100": ERROR_UNIT
                * float(total.reshape(2, kinds)[group, chosen].sum())
                / count
                if count
                else None
                for key, total in sums.items()
            }
            values |= {f"{key}_mse_x100": None for key in DISTANCES if key not in sums}
            share = count / pixels.sum() if pixels.sum() else None
            result[name][kind] = {**values, "share": share}
    return result
