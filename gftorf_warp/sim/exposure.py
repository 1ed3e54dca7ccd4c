"""One raw frame before the read-out: the light of every pixel, whichever engine computed it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float


class Exposure(NamedTuple):
    """What a sensor without noise measures in one raw frame."""

    quad: Float[np.ndarray, "H W"]
    """Mean quad of the raw frame's shift, DC offset included [relative units]."""
    amplitude: Float[np.ndarray, "H W"]
    """Mean amplitude a, source intensity included [relative units]."""
    distance: Float[np.ndarray, "H W"]
    """Distance that the engine sees [m]: mean over opacity, or first hit; NaN where none."""
    phasor: Complex[np.ndarray, "H W"]
    """Light at the modulation frequency, with the sensor's phase offset, in any unit; 0: none."""
    ambient: Float[np.ndarray, "H W"] | None = None
    """Share of even ambient light that is reflected, the mean reflectance of a pixel's rays [1];
    None: the engine does not compute it, and every pixel receives all of the sensor's ambient
    electrons."""
    layers: dict[str, Float[np.ndarray, "C H W"]] | None = None
    """Further images by name, see sim/truth_layers.py; None: none."""


def pooled(image: torch.Tensor | np.ndarray, subsamples: int) -> Float[np.ndarray, "*C H W"]:
    """Mean over the rays of each pixel, float64."""
    *channels, rows, columns = image.shape
    blocks = (*channels, rows // subsamples, subsamples, columns // subsamples, subsamples)
    return np.asarray(image, dtype=np.float64).reshape(blocks).mean((-3, -1))
