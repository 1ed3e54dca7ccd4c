"""Settings of a rendering, and the arrays they size."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Support(StrEnum):
    """Which pixels a splat may touch."""

    ALPHA = "alpha"
    """The exact ellipse alpha >= 1/255."""
    SIGMA3_TILE16 = "sigma3_tile16"
    """That ellipse, cut by the 3-sigma square rounded out to 16-pixel tiles: parity with the released code."""


class Stop(StrEnum):
    """What happens to the splat that takes a pixel's transmittance below 1e-4."""

    INCLUSIVE = "inclusive"
    """It is the last one added: almost nothing is left over."""
    EXCLUSIVE = "exclusive"
    """It is dropped, so up to 1 % of the distance is missing: parity with the released code."""


class ClampGradient(StrEnum):
    """The derivative of alpha = min(0.99, o G) where it is clamped."""

    EXACT = "exact"
    """Zero."""
    STRAIGHT = "straight"
    """As if unclamped: parity with the released code."""


class Distortion(StrEnum):
    """How depth distortion is summed (method, section 2.7)."""

    PAPER = "paper"
    """sum_k sum_l w_k w_l (d_k - d_l)^2 over all pairs [m^2]."""
    RELEASED = "released"
    """Half that sum, on zeta = far / (far - near) (1 - near / d) instead of metres [1]."""


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """How Gaussians are rendered. The defaults are exact; the alternatives exist for parity with published code."""

    near: float = 0.05
    """Gaussians nearer than this z-depth are culled [m]."""
    far: float = 1000.0
    """Gaussians farther than this z-depth are culled [m]."""
    sh_degree: int = 3
    """Harmonics above this degree are ignored, 0..3."""
    phasor_factor: float = 2.0
    """Length of a phasor over the amplitude a: 2 equals the differences of opposite quads, 1 is the released code's."""
    support: Support = Support.ALPHA
    """Which pixels a splat may touch."""
    stop: Stop = Stop.INCLUSIVE
    """How a pixel ends early."""
    clamp_gradient: ClampGradient = ClampGradient.EXACT
    """The derivative of a clamped alpha."""
    distortion: Distortion = Distortion.PAPER
    """Which distortion is returned."""
    pair_capacity: int | None = None
    """(tile, splat) pairs to reserve; None reads their number back, the one host synchronisation of a rendering."""
    threads: int | None = None
    """CPU threads of the blend; None: as many as this process may use. Another number changes sums by rounding only."""

    def __post_init__(self):
        if not 0 < self.near < self.far:
            raise ValueError(f"near and far must satisfy 0 < near < far, got {self.near} and {self.far}")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
