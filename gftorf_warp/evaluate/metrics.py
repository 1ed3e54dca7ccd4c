"""Errors of distances and quads, and the raw frames they are taken over (method, section 8); masks are arguments.

All errors are mean squared errors [m^2], times 100. ``all`` and ``static`` reach every pixel nearly alike, so most of
what distinguishes methods is in ``moving``: the few per cent of pixels that change within a quartet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float

from ..constants import FRAMES_PER_QUARTET
from ..data.sequence import Sequence, Truth
from ..errors import InputError, UsageError
from ..scene.sensor import Sensor, distance_from_phasor, phasor_from_quads

PROTOCOLS = ("all", "ftorf13")
MOVING_M = 0.05  # [m] twice the noise of a distance decoded from typical quads, a fraction of any object
ERROR_UNIT = 100.0  # errors are printed times 100, as in the published tables
DISTANCES = ("closed_form", "d", "d_normalised", "d_tof")


def scored_frames(sequence: Sequence, protocol: str = "all") -> list[int]:
    """Raw frames n that count.

    Args:
        sequence: What was measured.
        protocol: ``all``: every raw frame of a complete quartet. ``ftorf13``: the first frame of every complete quartet
            but the first and the last, as in the published tables (13 of 60 frames).

    Raises:
        UsageError: If the protocol is unknown, or leaves nothing.
        InputError: If no quartet is complete.
    """
    if protocol not in PROTOCOLS:
        raise UsageError(
            f"unknown protocol {protocol!r}",
            where="--frames",
            why=f"expected one of {', '.join(PROTOCOLS)}",
            fix="use --frames all",
        )
    quartets = sequence.complete_quartets
    if not quartets:
        raise InputError(
            "no complete quartet, nothing to score",
            where=sequence.path or "sequence",
            why=f"a closed form needs four measured raw frames in a row; none among {sequence.frames} raw frames",
            fix="check the sequence with `gftorf check`, or record longer",
        )
    if protocol == "all":
        return [FRAMES_PER_QUARTET * i + k for i in quartets for k in range(FRAMES_PER_QUARTET)]
    if len(quartets) < 3:
        raise UsageError(
            "protocol ftorf13 leaves no frame",
            where="--frames",
            why=f"it drops the first and the last quartet, and the sequence has {len(quartets)}",
            fix="use --frames all",
        )
    return [FRAMES_PER_QUARTET * i for i in quartets[1:-1]]


def known_distance(truth: Truth) -> Float[np.ndarray, "F H W"]:
    """True distance of every raw frame [m], NaN wherever it is unknown."""
    return np.where(truth.known[:, None, None], truth.distance, np.nan)


def moving_and_static(
    distance_truth: Float[np.ndarray, "F H W"], frames: list[int]
) -> tuple[Bool[np.ndarray, "S H W"], Bool[np.ndarray, "S H W"]]:
    """Which pixels of the S scored frames move, and which rest.

    A pixel moves if its true distance has max - min > 0.05 m within the four raw frames of the quartet. It rests if all
    four are known and it does not move; with unknown truth [NaN] it may be neither.

    Args:
        distance_truth: True distance of every raw frame [m]; NaN: unknown.
        frames: The scored raw frames n.
    """
    moving, static = {}, {}
    for quartet in {n // FRAMES_PER_QUARTET for n in frames}:
        four = distance_truth[FRAMES_PER_QUARTET * quartet : FRAMES_PER_QUARTET * (quartet + 1)]
        unknown = np.isnan(four)
        low, high = np.where(unknown, np.inf, four).min(axis=0), np.where(unknown, -np.inf, four).max(axis=0)
        moving[quartet] = high - low > MOVING_M
        static[quartet] = ~moving[quartet] & ~unknown.any(axis=0)
    rows = [n // FRAMES_PER_QUARTET for n in frames]
    return np.stack([moving[i] for i in rows]), np.stack([static[i] for i in rows])


def squared_error(
    distance: Float[np.ndarray, "S H W"], truth: Float[np.ndarray, "S H W"]
) -> Float[np.ndarray, "S H W"]:
    """Squared difference of two distances [m^2]; NaN exactly where the truth is unknown."""
    if distance.shape != truth.shape:
        raise ValueError(f"distance {distance.shape} and truth {truth.shape} must share a shape")
    if not np.isfinite(distance[~np.isnan(truth)]).all():
        raise ValueError("distance: not finite at pixels whose truth is known, which no mean may hide")
    return np.square(distance - truth)


def pooled(error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]) -> float | None:
    """Mean over the known pixels of all frames in the mask; None if there is none."""
    chosen = error[mask & ~np.isnan(error)]
    return float(chosen.mean(dtype=np.float64)) if chosen.size else None


def mean_over_frames(error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]) -> float | None:
    """Mean over frames of the mean over the known pixels of each frame, as published; None if there is none."""
    per_frame = [value for value in per_frame_mean(error, mask) if value is not None]
    return float(np.mean(per_frame)) if per_frame else None


def per_frame_mean(error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]) -> list[float | None]:
    """Mean over the known pixels of each frame in the mask; None for a frame without any."""
    return [pooled(error[s : s + 1], mask[s : s + 1]) for s in range(len(error))]


def distance_errors(
    errors: Mapping[str, Float[np.ndarray, "S H W"]],
    mask: Bool[np.ndarray, "S H W"],
    reduce: Callable[[np.ndarray, np.ndarray], float | None] = pooled,
) -> dict[str, float | None]:
    """The keys ``<name>_mse_x100`` [m^2 x 100] of every kind of distance; None where there is no pixel."""
    table: dict[str, float | None] = {}
    for name in DISTANCES:
        value = reduce(errors[name], mask)
        table[f"{name}_mse_x100"] = None if value is None else ERROR_UNIT * value
    return table


def share(mask: Bool[np.ndarray, "S H W"], *others: Bool[np.ndarray, "S H W"]) -> float | None:
    """Pixels of the mask over pixels of all given masks together [1]; None if those are empty."""
    total = int(mask.sum()) + sum(int(other.sum()) for other in others)
    return int(mask.sum()) / total if total else None


def distance_from_quads(quads: torch.Tensor, sensor: Sensor) -> torch.Tensor:
    """d_ToF: the distance [m] in [0, c/2f) that a camera decodes from quads [Q, H, W] of one instant."""
    return distance_from_phasor(*phasor_from_quads(quads, sensor.shifts), sensor)


def normalised(distance: Float[np.ndarray, "*n"], opacity: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Mean distance divided by opacity [m]; 0 where nothing was hit."""
    return np.divide(distance, opacity, out=np.zeros_like(distance), where=opacity > 0)


def quad_psnr_db(
    rendered: Float[np.ndarray, "S H W"], measured: Float[np.ndarray, "S H W"], peak: float
) -> float | None:
    """10 log10(peak^2 / MSE) [dB], the MSE pooled over all pixels; None where it is not a number.

    Args:
        rendered: The measured slot of every scored frame, as rendered [file units].
        measured: What was recorded there [file units].
        peak: Largest measured |quad| [file units].
    """
    mse = float(np.square(rendered - measured, dtype=np.float64).mean())
    return 10.0 * math.log10(peak**2 / mse) if mse > 0 and peak > 0 else None
