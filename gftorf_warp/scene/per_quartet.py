"""Points of moving surfaces, measured in every quartet by itself: distance, amplitude and velocity.

Slot k of a quartet is read where optical flow says that the surface was at that time. Several flows
are compared per pixel, and the one that explains the quartet best by one phasor is used: opposite
quads cancel along the right flow. A point moves if the raw frames along its flow differ from the
background. Truth is never read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..constants import CANONICAL_SHIFTS  # noqa: F401
from ..data.cycles import solution
from ..data.sequence import Sequence
from .measured import Change, FarLayer, camera_of, distance_noise, sensor_of
from .tracks import unproject
from .unwrap import distance_from_phasors

POOL = 5  # [px] side of the box over which residuals are averaged
DIFFERS = 2.5  # mean squared difference from the background over noise, from which a point moves
EXPLAINED = 4.0  # mean squared residual over noise up to which a phasor explains a quartet
RELATIVE = 0.2  # or up to this share of the amplitude, since phase and amplitude change meanwhile
NOISE_MAX = 0.25  # [m] largest noise of a distance that is used


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingPoints:
    """P points of moving surfaces in the middle of one quartet."""

    quartet: int
    """Its number."""
    mean: Float[Tensor, "P 3"]
    """Positions in the world [m]."""
    distance: Float[Tensor, "P"]
    """Distance from the camera [m]."""
    amplitude: Float[Tensor, "P"]
    """Amplitude [quad units]."""
    velocity: Float[Tensor, "P 3"]
    """Displacement during the quartet [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Decoded:
    """One quartet, decoded along the flow of every pixel in its middle."""

    flow: Float[np.ndarray, "2 H W"]
    distance: Float[np.ndarray, "H W"]
    amplitude: Float[np.ndarray, "H W"]
    moving: Bool[np.ndarray, "H W"]


def moving_points(
    sequence: Sequence, change: Change, far: FarLayer, spacing: float
) -> Iterator[MovingPoints]:
    """The points of every complete quartet that has any, ``spacing`` pixels apart."""
    background = _background(sequence, change, far)
    decoded = {j: _decoded(sequence, j, change, far, background) for j in change.quartets}
    camera = camera_of(sequence, 0)
    height, width = sequence.height, sequence.width
    columns, rows = max(round(width / spacing), 1), max(round(height / spacing), 1)
    x = (np.arange(columns) + 0.5) * (width / columns)
    y = (np.arange(rows) + 0.5) * (height / rows)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    col, row = points.astype(int).T
    for j, now in decoded.items():
        chosen = now.moving[row, col]
        if not chosen.any():
            continue
        place, c, r = points[chosen], col[chosen], row[chosen]
        flow, distance = now.flow[:, r, c].T, now.distance[r, c]
        along = _radial(decoded, j, place, flow, distance)
        tensors = [torch.as_tensor(value, dtype=torch.float32) for value in (place, flow)]
        near, change_of_distance = (
            torch.as_tensor(value, dtype=torch.float32) for value in (distance, along)
        )
        ends = [
            unproject(camera, tensors[0] + s * tensors[1], near + s * change_of_distance)
            for s in (-0.5, 0.0, 0.5)
        ]
        yield MovingPoints(
            quartet=j,
            mean=ends[1],
            distance=near,
            amplitude=torch.as_tensor(now.amplitude[r, c], dtype=torch.float32),
            velocity=ends[2] - ends[0],
        )


def _background(sequence: Sequence, change: Change, far: FarLayer) -> np.ndarray:
    """Quads [K, H, W] of the background in every slot: medians over the quartets that see it."""
    cycle = sequence.cycle
    stack = np.stack([sequence.quads[sequence.quartet_frames(j)] for j in change.quartets])
    sensor = sensor_of(sequence)
    psi = (sensor.phase_slope * far.distance + sensor.phase_offset).numpy()
    amplitude = far.amplitude.numpy()
    shifts = sequence.shifts[:cycle]
    model = np.stack(
        [amplitude * (np.cos(psi - shift) + sensor.dc_offset) for shift in shifts]
    ).astype(np.float32)
    return model if len(stack) else model


def _flows(sequence: Sequence, j: int) -> list[np.ndarray]:
    """Candidates of the displacement [2, H, W] during quartet j of what is there in its middle."""
    step, none = sequence.cycle, np.zeros((2, sequence.height, sequence.width), np.float32)
    forward, backward = sequence.flow.forward, sequence.flow.backward
    found = [(1.0, 0.5, forward.get(step * j)), (-1.0, -0.5, backward.get(step * (j + 1)))]
    found += [(-1.0, 0.5, backward.get(step * j)), (1.0, 1.5, forward.get(step * (j - 1)))]
    result = [none]
    for sign, late, flow in found:
        if flow is not None:
            whole = sign * np.nan_to_num(flow).astype(np.float32)
            # the flow was measured at another time: where the surface was then
            moved = _sampled(whole, -late * whole)
            result.append(moved)
            result.append(whole)
    return result


def _decoded(
    sequence: Sequence, j: int, change: Change, far: FarLayer, background: np.ndarray
) -> _Decoded:
    import cv2

    frames = sequence.quartet_frames(j)
    quads = sequence.quads[frames].astype(np.float32)
    shifts, times = sequence.shifts[frames], sequence.times[frames]
    frequencies = sequence.frame_frequencies[frames]
    share = (times - times.mean()) / max((times[-1] - times[0]) * len(times) / (len(times) - 1), 1e-12)
    noise = max(change.noise, 1e-12)
    differs = np.square((quads - background) / noise)
    sensor = sensor_of(sequence)

    def pooled(image: np.ndarray) -> np.ndarray:
        return cv2.blur(image, (POOL, POOL), borderType=cv2.BORDER_REPLICATE)

    best: list[np.ndarray] = []
    for flow in _flows(sequence, j):
        along = np.stack([_sampled(q[None], s * flow)[0] for q, s in zip(quads, share, strict=True)])
        apart = np.stack([_sampled(d[None], s * flow)[0] for d, s in zip(differs, share, strict=True)])
        phasors, squares, free = [], 0.0, 0
        for f in sequence.frequencies:
            own = frequencies == f
            columns = [np.cos(shifts[own]), np.sin(shifts[own])]
            if sensor.dc_offset or own.sum() < 4:
                columns.append(np.ones(own.sum()))
            model = np.stack(columns, axis=1)
            values = along[own].reshape(own.sum(), -1)
            fitted = np.linalg.pinv(model) @ values
            squares = squares + np.square(values - model @ fitted).sum(axis=0)
            free += max(len(model) - model.shape[1], 0)
            rows = solution(shifts[own])
            phasors.append(np.stack([2.0 * fitted[0], 2.0 * fitted[1]]).reshape(2, *flow.shape[1:]))
        residual = pooled((squares / (max(free, 1) * noise**2)).reshape(flow.shape[1:]).astype(np.float32))
        images = [residual, pooled(apart.mean(axis=0)), *flow, *np.concatenate(phasors)]
        if not best:
            best = [image.copy() for image in images]
            continue
        better = residual < best[0] * (0.8 if len(best) else 1.0)
        for old, new in zip(best, images, strict=True):
            old[better] = new[better]
    residual, apart, fx, fy, *parts = best
    pairs = [(torch.as_tensor(parts[i]), torch.as_tensor(parts[i + 1])) for i in range(0, len(parts), 2)]
    distance = distance_from_phasors(pairs, sensor).numpy()
    amplitude = 0.5 * np.hypot(parts[0], parts[1])
    deviation = distance_noise(torch.as_tensor(amplitude), noise, sequence).numpy()
    explained = residual < EXPLAINED + np.square(RELATIVE * amplitude / noise)
    moving = (apart > DIFFERS) & explained & (deviation < NOISE_MAX)
    moving &= distance < far.distance.numpy() - 0.02
    moving = cv2.medianBlur(moving.astype(np.uint8), 3) > 0
    return _Decoded(flow=np.stack([fx, fy]), distance=distance, amplitude=amplitude, moving=moving)


def _radial(
    decoded: dict[int, _Decoded], j: int, place: np.ndarray, flow: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Change of distance during a quartet [m]: slope to the neighbouring quartets where both see
    the point; else zero."""
    slopes = []
    for step in (-1, 1):
        other = decoded.get(j + step)
        if other is None:
            continue
        there = place + step * flow
        height, width = other.distance.shape
        c, r = np.floor(there).astype(int).T
        inside = (c >= 0) & (c < width) & (r >= 0) & (r < height)
        c, r = np.clip(c, 0, width - 1), np.clip(r, 0, height - 1)
        slope = step * (other.distance[r, c] - distance)
        known = inside & other.moving[r, c] & (np.abs(slope) < 0.5)
        slopes.append(np.where(known, slope, np.nan))
    if not slopes:
        return np.zeros(len(place))
    with np.errstate(all="ignore"):
        import warnings

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.nan_to_num(np.nanmean(slopes, axis=0))


def _sampled(image: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """[C, H, W] values at x + shift(x), bilinear, repeated beyond the border."""
    import cv2

    height, width = image.shape[1:]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    at = (x + shift[0]).astype(np.float32), (y + shift[1]).astype(np.float32)
    return np.stack(
        [
            cv2.remap(channel.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for channel in image
        ]
    )
