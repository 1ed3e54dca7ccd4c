"""Regular recordings: one cycle again and again, every raw frame of it measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.sequence import Intrinsics, Sequence, Truth
from . import camera_keys, pose_keys
from .imported import Imported, Notes
from .keys import Key, Settings
from .sensor_keys import Modulation

AT_REST = "poses: the camera is at rest (default); this format has none"


def lens_given(settings: Settings) -> bool:
    """Whether keys state a lens, where it is not needed.

    Raises:
        UsageError, InputError: If they state a part of it.
    """
    names = [f"camera.{name}" for name in camera_keys.PINHOLE]
    if not any(map(settings.given, [*names, "camera.file"])):
        return False
    settings.require(*names)
    return True


def pixel_centres_half(keys: tuple[Key, ...]) -> tuple[Key, ...]:
    """Keys of a lens whose pixel centres are at i + 0.5, unless another convention is stated."""
    return tuple(
        replace(key, default="half") if key.name == "camera.pixel_centre" else key for key in keys
    )


def imported(
    source: Path,
    settings: Settings,
    notes: Notes,
    quads: Float[np.ndarray, "F H W"],
    modulation: Modulation,
    times: Float[np.ndarray, "F"],
    *,
    lens: Intrinsics | None = None,
    exposures: Float[np.ndarray, "F"] | None = None,
    truth: Truth | None = None,
) -> Imported:
    """Raw frames as a sequence, with the poses that the keys name, or else of a camera at rest.

    Args:
        source: The recording; files that keys name may be in it.
        settings: Values of the keys of a lens and of poses.
        notes: What was understood so far; lens and poses are added.
        quads: Values [quad units], float32.
        modulation: What the raw frames of a cycle measure; the last cycle may be truncated.
        times: Times [s] from any start on, which never decrease.
        lens: The lens; None: that of the keys.
        exposures: Exposure times [s]; None: unknown.
        truth: Ground truth, if the source has it.

    Raises:
        UsageError, InputError: If keys of lens or poses are missing or do not fit.
    """
    frames, height, width = quads.shape
    times = times - times[0]
    if lens is None:
        lens = camera_keys.intrinsics_of(settings, notes, width, root=source, height=height)
    poses = pose_keys.poses_of(settings, source, notes, times, len(modulation.shifts), None)
    if poses is None:
        notes.understood.append(AT_REST)
        poses = np.tile(np.eye(4), (frames, 1, 1))
    several = len(set(modulation.frequencies_hz.tolist())) > 1
    sequence = Sequence(
        quads=quads,
        measured=np.ones(frames, dtype=bool),
        shifts=np.resize(modulation.shifts, frames),
        times=times,
        frequencies_hz=np.resize(modulation.frequencies_hz, frames) if several else None,
        exposures=exposures,
        camera_from_world=poses,
        intrinsics=lens,
        calibration=modulation.calibration,
    )
    understood, uncertain = tuple(notes.understood), tuple(notes.uncertain)
    return Imported(sequence=sequence, understood=understood, uncertain=uncertain, truth=truth)
