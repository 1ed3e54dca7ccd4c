"""Fixed patterns: constant differences between pixels (sensor notes, 2.4 and 3).

    psi += p(u, v)        light times 1 + N(0, gain)        dark current times 1 + N(0, dark)

They are drawn from a seed of the sensor, not of a recording: all recordings of a sensor share one
pattern.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

CODE = 2.0 * math.pi / 4096  # [rad] unit of the calibration file that the phase pattern imitates
PHASE, GAIN, DARK = range(3)  # parts of the seeds of the three maps


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """How much pixels differ; everything is off by default."""

    phase: float = 0.0
    """Multiple of the phase pattern [1]; 1: that of the calibration file of an OPT8241 kit."""
    gain: float = 0.0
    """Standard deviation of the response to light, PRNU [1]; 0.01 is usual, an assumption."""
    dark: float = 0.0
    """Standard deviation of the dark current, DSNU [1]; 0.2 is usual, an assumption."""
    seed: int = 0
    """Seed of the maps: the specimen of the sensor."""

    def __post_init__(self):
        for name in ("phase", "gain", "dark"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be a number of at least 0, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {self.seed}")


@lru_cache(maxsize=8)
def phase_map(pattern: Pattern, height: int, width: int) -> Float[np.ndarray, "H W"] | None:
    """Phase offset of each pixel [rad]; None: 0 everywhere.

    A quadratic bowl over the image, x and y in half widths, and noise of pixels, columns and rows.
    """
    if pattern.phase == 0.0:
        return None
    half = 0.5 * width
    x = (np.arange(width) + 0.5 - half) / half
    y = (np.arange(height)[:, None] + 0.5 - 0.5 * height) / half
    bowl = -15.6 - 110.1 * y - 27.9 * y**2 + 40.5 * x + 30.7 * x * y - 154.8 * x**2
    random = np.random.default_rng((pattern.seed, PHASE))
    noise = random.normal(0.0, 8.9, (height, width)) + random.normal(0.0, 3.6, width)
    return _constant(pattern.phase * CODE * (bowl + noise + random.normal(0.0, 1.4, (height, 1))))


@lru_cache(maxsize=8)
def gain_map(pattern: Pattern, height: int, width: int) -> Float[np.ndarray, "H W"] | None:
    """Response of each pixel to light as a multiple of the nominal one [1]; None: 1 everywhere."""
    return _spread(pattern.gain, (pattern.seed, GAIN), (height, width))


@lru_cache(maxsize=8)
def dark_map(pattern: Pattern, height: int, width: int) -> Float[np.ndarray, "H W"] | None:
    """Dark current of each pixel as a multiple of the nominal one [1]; None: 1 everywhere."""
    return _spread(pattern.dark, (pattern.seed, DARK), (height, width))


def _spread(deviation: float, seed: tuple[int, int], shape: tuple[int, int]) -> np.ndarray | None:
    if deviation == 0.0:
        return None
    random = np.random.default_rng(seed)
    return _constant(np.maximum(1.0 + random.normal(0.0, deviation, shape), 0.0))


def _constant(values: np.ndarray) -> np.ndarray:
    """A read-only array, shared by all raw frames."""
    values.setflags(write=False)
    return values
