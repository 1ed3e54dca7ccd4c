"""What kinds of captured steps there are, and what they know of an image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..render.api import Rendering
from .settings import Weights


@dataclass(frozen=True)
class Variant:
    """What decides which operations a step consists of."""

    shifts: tuple[float, ...]
    """Phase shift of each image [rad]."""
    moves: bool
    """Whether Gaussians are displaced."""
    flow: bool
    """Whether the first image is compared with optical flow, too."""
    rests: bool
    """Whether the Gaussians are frozen."""
    weights: Weights
    """Of the terms."""
    sh_degree: int
    """Of the harmonics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One image of a batch."""

    terms: dict[str, Tensor]
    """Terms of its loss, without weights."""
    tof: Rendering
    """What was compared."""
    gradients: list[Tensor | None]
    """Of the weighted terms, by the values of the field and then by the offsets; None: there is none."""
