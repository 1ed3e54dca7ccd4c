"""The sequence of a camera whose file format knows no poses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..data.sequence import Intrinsics, Sequence
from .imported import Notes
from .sensor_keys import Modulation

NOTE = "poses: the camera is at rest; this format has none"


def at_rest(
    quads: Float[np.ndarray, "F H W"],
    modulation: Modulation,
    times: Float[np.ndarray, "F"],
    intrinsics: Intrinsics,
    notes: Notes,
    *,
    exposures: Float[np.ndarray, "F"] | None = None,
) -> Sequence:
    """A sequence of raw frames that repeat one cycle and were all measured.

    Args:
        quads: Values [quad units], float32.
        modulation: What the raw frames of a cycle measure; the last cycle may be truncated.
        times: Times [s] from any start on, which never decrease.
        intrinsics: The lens.
        notes: That the camera is at rest is added.
        exposures: Exposure times [s]; None: unknown.
    """
    frames = len(quads)
    several = len(set(modulation.frequencies_hz.tolist())) > 1
    notes.understood.append(NOTE)
    return Sequence(
        quads=quads,
        measured=np.ones(frames, dtype=bool),
        shifts=np.resize(modulation.shifts, frames),
        times=times - times[0],
        frequencies_hz=np.resize(modulation.frequencies_hz, frames) if several else None,
        exposures=exposures,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
        intrinsics=intrinsics,
        calibration=modulation.calibration,
    )
