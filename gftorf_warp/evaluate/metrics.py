"""Errors of distances and quads, and the scored raw frames (method, section 8).

All errors are mean squared errors [m^2], times 100. Methods differ mostly on ``moving``, the few
per cent of pixels that change within a quartet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float

from ..data.sequence import Sequence
from ..errors import InputError, UsageError
from ..scene.sensor import Sensor, phasor_from_quads
from ..scene.unwrap import distance_from_phasors

PROTOCOLS = ("all", "ftorf13")
ERROR_UNIT = 100.0  # errors are printed times 100, as in the published tables
CRITERION = "d_minus_dtof_static_m"  # key of diagnostics that indicates a good state without truth
TEMPORAL = ("temporal_mean", "temporal_median", "temporal")  # need a resting camera
DISTANCES = ("closed_form", *TEMPORAL, "d", "d_fit", "d_normalised", "d_median", "d_tof")


def scored_frames(sequence: Sequence, protocol: str = "all") -> list[int]:
    """Raw frames n to score.

    Args:
        sequence: What was measured.
        protocol: ``all``: every raw frame of a complete quartet, of a phasor only the first.
            ``ftorf13``: the first frame of every complete quartet but the first and the last, as in
            the published tables (13 of 60 frames).

    Raises:
        UsageError: If the protocol is unknown, or leaves nothing.
        InputError: If no quartet is complete.
    """
    if protocol not in PROTOCOLS:
        why, fix = f"expected one of {', '.join(PROTOCOLS)}", "use --frames all"
        raise UsageError(f"unknown protocol {protocol!r}", where="--frames", why=why, fix=fix)
    quartets = sequence.complete_quartets
    if not quartets:
        what, where = "no complete quartet, nothing to score", sequence.path or "sequence"
        need = "a closed form needs all raw frames of a cycle in a row"
        fix = "check the sequence with `gftorf check`, or record longer"
        why = f"{need}; none among {sequence.frames} raw frames"
        raise InputError(what, where=where, why=why, fix=fix)
    if protocol == "all":
        slots = range(1 if sequence.from_phasors else sequence.cycle)
        return [sequence.cycle * i + k for i in quartets for k in slots]
    if len(quartets) < 3:
        what, fix = "protocol ftorf13 leaves no frame", "use --frames all"
        why = f"it drops the first and the last quartet, and the sequence has {len(quartets)}"
        raise UsageError(what, where="--frames", why=why, fix=fix)
    return [sequence.cycle * i for i in quartets[1:-1]]


def squared_error(
    distance: Float[np.ndarray, "S H W"], truth: Float[np.ndarray, "S H W"]
) -> Float[np.ndarray, "S H W"]:
    """Squared difference of two distances [m^2]; NaN exactly where the truth is unknown."""
    if distance.shape != truth.shape:
        raise ValueError(f"distance {distance.shape} and truth {truth.shape} must share a shape")
    error = np.empty(distance.shape, np.result_type(distance, truth))
    for image, true, out in zip(distance, truth, error, strict=True):  # a frame fits into a cache
        np.subtract(image, true, out=out)
        if not (np.isfinite(out) | np.isnan(true)).all():
            raise ValueError("distance: not finite at pixels with a known truth")
        np.square(out, out=out)
    return error


def pooled(error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]) -> float | None:
    """Mean over the known pixels of all frames in the mask; None if there is none."""
    chosen = error[mask & ~np.isnan(error)]
    return float(chosen.mean(dtype=np.float64)) if chosen.size else None


def mean_over_frames(
    error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]
) -> float | None:
    """Mean over frames of the mean of each frame's known pixels, as published; None if none."""
    per_frame = [value for value in per_frame_mean(error, mask) if value is not None]
    return float(np.mean(per_frame)) if per_frame else None


def per_frame_mean(
    error: Float[np.ndarray, "S H W"], mask: Bool[np.ndarray, "S H W"]
) -> list[float | None]:
    """Mean over the known pixels of each frame in the mask; None for a frame without any."""
    return [pooled(error[s : s + 1], mask[s : s + 1]) for s in range(len(error))]


def distance_errors(
    errors: Mapping[str, Float[np.ndarray, "S H W"]],
    mask: Bool[np.ndarray, "S H W"],
    reduce: Callable[[np.ndarray, np.ndarray], float | None] = pooled,
) -> dict[str, float | None]:
    """``<name>_mse_x100`` [m^2 x 100] of every kind of distance; None where there is no pixel, or
    no such distance.
    """
    values = {name: reduce(errors[name], mask) if name in errors else None for name in DISTANCES}
    return {f"{name}_mse_x100": v and ERROR_UNIT * v for name, v in values.items()}


def share(mask: Bool[np.ndarray, "S H W"], *others: Bool[np.ndarray, "S H W"]) -> float | None:
    """Pixels of the mask over pixels of all given masks together [1]; None if those are empty."""
    total = int(mask.sum()) + sum(int(other.sum()) for other in others)
    return int(mask.sum()) / total if total else None


def distance_from_quads(
    quads: torch.Tensor, sensor: Sensor, *further: torch.Tensor
) -> torch.Tensor:
    """d_ToF: the distance [m] that a camera decodes from quads [Q, H, W] of one instant.

    In [0, c/2f), or, with ``further`` quads for each of ``sensor.further_hz``, in [0, c / 2 f_0).
    """
    return distance_from_phasors(
        [phasor_from_quads(one, sensor.shifts) for one in (quads, *further)], sensor
    )


def normalised(
    distance: Float[np.ndarray, "*n"], opacity: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Mean distance divided by opacity [m]; 0 where nothing was hit."""
    return np.divide(distance, opacity, out=np.zeros_like(distance), where=opacity > 0)


def psnr_db(
    rendered: Float[np.ndarray, "*n"], measured: Float[np.ndarray, "*n"], peak: float
) -> float | None:
    """10 log10(peak^2 / MSE) [dB], the MSE over all elements; None where it is not a number."""
    mse = float(np.square(rendered - measured, dtype=np.float64).mean())
    return 10.0 * math.log10(peak**2 / mse) if mse > 0 and peak > 0 else None


def along_run(rows: list[dict[str, float]]) -> dict[str, float | int | None] | None:
    """Summary of the rows of ``diagnostics.jsonl``; None if there are none.

    Returns:
        The number of rows; the least error of d [m^2 x 100] and its images, None without truth;
        the least |d - d_ToF| on static pixels [m], its images, and the error of d there.
    """
    if not rows:
        return None
    best, calm = _least(rows, "d_mse_x100"), _least(rows, CRITERION)
    return {
        "rows": len(rows),
        "d_mse_x100_least": best.get("d_mse_x100"),
        "images_at_least": best.get("images"),
        "criterion_m_least": calm.get(CRITERION),
        "images_at_criterion": calm.get("images"),
        "d_mse_x100_at_criterion": calm.get("d_mse_x100"),
    }


def _least(rows: list[dict[str, float]], name: str) -> dict[str, float]:
    """The first row with the least value of a name; empty if no row has it."""
    known = [row for row in rows if row.get(name) is not None]
    return min(known, key=lambda row: row[name], default={})
