"""The closed form as a method: what a camera computes by itself, behind the interface of a
reconstruction.

Every quartet is decoded as if its raw frames had been taken at once (method, sections 2.9 and 7,
row ``ctof``). Nothing was fitted, so there is one distance per quartet and one viewpoint.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..data.decode import decode_quartet, quartet_phasors
from ..data.sequence import Sequence
from ..data.temporal import camera_rests, nearest_quartet
from ..errors import InputError, UsageError
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import channel_of, quad_from_phasor

POSE_TOLERANCE = 1e-6  # [m], [1] poses are stored as float32 at worst
TIME_S = 1e-6  # [s] outside of a quartet that still count as inside


def rendering_of(
    sequence: Sequence,
    time: float,
    shifts: Iterable[float],
    *,
    f_mod_hz: float | None,
    extra_channels: int | None,
    device: torch.device,
) -> Rendering:
    """The measured quartet nearest to a time [s] as a rendering, see :meth:`ClosedForm.render`."""
    quartet = nearest_quartet(sequence, time)
    decoded = decode_quartet(sequence, quartet)
    if f_mod_hz is not None and f_mod_hz not in sequence.frequencies:
        measured = ", ".join(f"{f:.9g}" for f in sequence.frequencies)
        raise ValueError(f"f_mod_hz {f_mod_hz:.9g} must be one of those measured, {measured}")
    which = 0 if f_mod_hz is None else sequence.frequencies.index(f_mod_hz)
    re, im = decoded.phasors[which]
    size = (sequence.height, sequence.width)

    def tensor(image: np.ndarray) -> Tensor:
        return torch.tensor(image, dtype=torch.float32, device=device)

    return Rendering(
        quads=tensor(quads_of(sequence, quartet, shifts, which)),
        phasor=tensor(np.stack([re, im, np.hypot(re, im)])),
        colour=None,
        distance=tensor(decoded.distance),
        opacity=tensor(np.ones(size)),
        distortion=tensor(np.zeros(size)),
        distance_median=tensor(decoded.distance),
        extra=None if extra_channels is None else tensor(np.zeros((extra_channels, *size))),
        screen=None,
    )


def row_of(sequence: Sequence, time: float, camera: Camera, sequence_camera: Camera) -> int | None:
    """Which complete quartet, counted from 0, a time [s] is in, seen from the sequence's own
    camera; None outside of them, and for another camera.
    """
    quartet = nearest_quartet(sequence, time)
    times = sequence.times[sequence.quartet_frames(quartet)]
    if not times[0] - TIME_S <= time <= times[-1] + TIME_S:
        return None
    if another_view(sequence, time, camera, sequence_camera):
        return None
    return sequence.complete_quartets.index(quartet)


def another_view(sequence: Sequence, time: float, camera: Camera, sequence_camera: Camera) -> str:
    """How a camera differs from that of the sequence at a time [s], in words; empty if it does
    not.
    """
    frames = [*range(sequence.frames)[sequence.quartet_frames(nearest_quartet(sequence, time))]]
    frames.append(int(np.abs(sequence.times - time).argmin()))
    apart = (
        np.abs(sequence.camera_from_world[frames] - camera.camera_from_world).max(axis=(1, 2)).min()
    )
    names = ("width", "height", "fx", "fy", "cx", "cy")
    differ = [
        name
        for name in names
        if not math.isclose(getattr(camera, name), getattr(sequence_camera, name))
    ]
    if camera.distortion != sequence_camera.distortion:
        differ.append("lens")
    if differ:
        return ", ".join(differ)
    return f"pose, {apart:.3g} away from that of the quartet" if apart > POSE_TOLERANCE else ""


def check_camera(
    sequence: Sequence, time: float, camera: Camera, sequence_camera: Camera, where: Path
) -> None:
    """Refuse every camera but the sequence's own.

    Raises:
        UsageError: If ``camera`` has other intrinsics or another lens than ``sequence_camera``, or
            a pose far from those of the quartet.
    """
    if differs := another_view(sequence, time, camera, sequence_camera):
        raise UsageError(
            "a closed form has one view",
            where=where,
            why=f"asked for another {differs}",
            fix="render other views from a run of Gaussians, for example --preset demo",
        )


def check_rests(sequence: Sequence) -> None:
    """Refuse to average over time what a moving camera recorded.

    Raises:
        InputError: If the poses of the raw frames differ.
    """
    if not camera_rests(sequence):
        raise InputError(
            "the camera moves",
            where=sequence.path or "sequence",
            why="the preset temporal averages pixels over time, which needs one pose throughout",
            fix="use --preset ctof, the closed form of every quartet",
        )


def checked(sequence: Sequence) -> Sequence:
    """The sequence, which must have a complete quartet.

    Raises:
        InputError: If it has none.
    """
    if not sequence.complete_quartets:
        raise InputError(
            "no complete quartet",
            where=sequence.path or "sequence",
            why="a closed form needs all raw frames of a cycle in a row",
            fix="check the sequence with `gftorf check`, or record longer",
        )
    return sequence


def quads_of(
    sequence: Sequence, quartet: int, shifts: Iterable[float], frequency: int = 0
) -> Float[np.ndarray, "Q H W"]:
    """The raw frames of a quartet with these shifts [rad], at one of its frequencies.

    If these are not all that was measured there, they are a (cos(psi - shift) + dc_offset) of the
    decoded phasor: some of the measured ones decode to another phase than all of them.
    """
    frames, (re, im) = quartet_phasors(sequence, quartet)[frequency]
    shifts = list(shifts)
    slots = [channel_of(sequence.shifts[frames].tolist(), shift) for shift in shifts]
    if any(slot is None for slot in slots) or len(frames) != len(slots):
        constant = sequence.calibration.dc_offset * np.hypot(re, im)
        return np.stack([quad_from_phasor(re, im, constant, shift) for shift in shifts])
    return np.stack([sequence.quads[frames[slot]] for slot in slots if slot is not None])
