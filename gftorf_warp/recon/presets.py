"""Named settings. A preset is a function that returns them."""

from __future__ import annotations

from ..errors import UsageError
from .settings import Batch, DensifySettings, Rates, ReconSettings, Schedule, Weights

LATER = ("paper", "released")  # names kept for the published settings


def demo() -> ReconSettings:
    """Minutes on two CPU cores: small images, motion nodes instead of a network, and a start from measured phase.

    Neither heuristic of method section 6.4 is used. Slow reflectivity hurts once the start is close, since errors of
    the decoded amplitude have to be repaired; low initial reflectivity is meaningless where it is measured.
    """
    return ReconSettings(
        preset="demo",
        width_max=160,
        rates=Rates(mean=1e-3, log_scale=3e-2, quaternion=2e-2, opacity_logit=0.02, reflectivity_sh=1e-2, motion=1e-3),
        weights=Weights(ssim=0.2, distortion=0.1),
        schedule=Schedule(images=4000, batch=Batch.QUARTET, decay=0.3),
        densify=DensifySettings(every=None),
    )


PRESETS = {"demo": demo}


def preset(name: str) -> ReconSettings:
    """The settings of a name.

    Raises:
        UsageError: If there are none, or not in this version.
    """
    if name in PRESETS:
        return PRESETS[name]()
    known = ", ".join(PRESETS)
    if name in LATER:
        raise UsageError(
            f"preset {name} is not available in this version",
            where="--preset",
            why=f"available: {known}; the published settings are named {' and '.join(LATER)} and come later",
            fix=f"use --preset {next(iter(PRESETS))}",
        )
    raise UsageError(
        f"unknown preset {name}", where="--preset", why=f"available: {known}", fix=f"use --preset {next(iter(PRESETS))}"
    )
