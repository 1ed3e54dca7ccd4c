"""Kind ``arrays``: quads or phasors as arrays or pictures of any layout that keys describe."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..data.sequence import Sequence
from . import (
    camera_keys,
    codes,
    colour_keys,
    image_order,
    phasors,
    pose_keys,
    raw_frames,
    sensor_keys,
    stacks,
    timing,
)
from .imported import Imported, Notes
from .keys import Settings

KEYS = (
    *image_order.KEYS,
    *stacks.KEYS,
    *codes.KEYS,
    phasors.KEY,
    *sensor_keys.KEYS,
    raw_frames.KEY,
    *timing.KEYS,
    *camera_keys.KEYS,
    *pose_keys.KEYS,
    *colour_keys.KEYS,
)


def read(source: Path, settings: Settings) -> Imported:
    """A folder or file of images as a sequence.

    Raises:
        UsageError, InputError: If keys are missing, unusable, or do not fit the files; if a file is
            damaged.
        ResourceError: If h5py is needed.
    """
    notes = Notes()
    raw_frames.check_taps(settings)
    if of_phasors := phasors.are_stored(settings):
        settings = phasors.with_shifts(settings)
    patterns = image_order.patterns_of(source, settings)
    settings.require(
        *(name for files in patterns for name in stacks.needed_keys(files[0])),
        *pose_keys.needed_keys(settings),
        *colour_keys.needed_keys(settings, colour_keys.files_of(settings, source)),
    )
    modulation = sensor_keys.modulation_of(settings, notes)
    cycle = 1 if of_phasors else len(modulation.shifts)
    recorded = raw_frames.raw_frames_of(source, patterns, settings, cycle, notes)
    frames, height, width = recorded.quads.shape
    times = timing.times_of(settings, source, notes, frames, cycle)
    poses = pose_keys.poses_of(settings, source, notes, times, cycle, recorded.files)
    colour, poses = colour_keys.colour_of(settings, source, notes, times, poses)
    if poses is None:
        notes.understood.append("poses: the camera stands still (default)")
        poses = np.tile(np.eye(4), (frames, 1, 1))
    several = len(set(modulation.frequencies_hz.tolist())) > 1
    lens = camera_keys.intrinsics_of(settings, notes, width, root=source, height=height)
    sequence = Sequence(
        quads=recorded.quads,
        measured=recorded.measured,
        shifts=np.resize(modulation.shifts + recorded.turned, frames),
        times=times,
        frequencies_hz=np.resize(modulation.frequencies_hz, frames) if several else None,
        exposures=timing.exposures_of(settings, frames),
        camera_from_world=poses,
        intrinsics=lens,
        calibration=modulation.calibration,
        colour=colour,
    )
    if of_phasors:
        text = "phasors: each is four raw frames of one time; what moved between them is lost"
        notes.understood.append(f"{text} (sensor.taps)")
        sequence = phasors.as_raw_frames(sequence)
    understood, uncertain = tuple(notes.understood), tuple(notes.uncertain)
    return Imported(sequence=sequence, understood=understood, uncertain=uncertain)
