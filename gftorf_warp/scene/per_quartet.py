"""Points of moving surfaces, measured in every quartet by itself: distance, amplitude and velocity.

Slot k of a quartet is read where optical flow says that the surface was at that time. Several flows
are compared per pixel, and the one that explains the quartet best by one phasor is used: opposite
quads cancel along the right flow. A point moves if the raw frames along its flow differ from the
background. Truth is never read.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.cycles import solution
from ..data.sequence import Sequence
from .measured import Change, FarLayer, camera_of, distance_noise, sensor_of
from .tracks import unproject
from .unwrap import distance_from_phasors

POOL = 5  # [px] side of the box over which residuals are averaged
DIFFERS = 4.0  # squared difference from the background over noise, from which a raw frame has moved
EXPLAINED = 3.0  # mean squared residual over what is allowed, up to which a flow is right
RELATIVE = 0.1  # allowed share of the amplitude: phase and amplitude change during a quartet
UNMOVED, UNLIKELY = 4.0, 0.3  # penalties of flows towards the background, and of translations
REACH = 0.08  # of the width: largest translation during a quartet
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
    quads = _background(sequence, far)
    with ThreadPoolExecutor(thread_name_prefix="gftorf-points") as threads:
        found = threads.map(lambda j: _decoded(sequence, j, change, far, quads), change.quartets)
        decoded = dict(zip(change.quartets, found, strict=True))
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


def _background(sequence: Sequence, far: FarLayer) -> Float[np.ndarray, "K H W"]:
    """Quads of the background in every slot."""
    sensor = sensor_of(sequence)
    amplitude, dc = far.amplitude.numpy(), float(sensor.dc_offset)
    quads = []
    for shift, f in zip(
        sequence.shifts[: sequence.cycle], sequence.frame_frequencies[: sequence.cycle], strict=True
    ):
        slope = float(sensor.phase_slope) * float(f) / sequence.frequencies[0]
        psi = slope * far.distance.numpy() + float(sensor.phase_offset)
        quads.append(amplitude * (np.cos(psi - shift) + dc))
    return np.stack(quads).astype(np.float32)


def _flows(sequence: Sequence, j: int) -> Iterator[Float[np.ndarray, "2 H W"]]:
    """Candidates of the displacement during quartet j of what is there in its middle: optical flow
    of the neighbouring quartet starts, and translations of the whole image."""
    step, size = sequence.cycle, (2, sequence.height, sequence.width)
    forward, backward = sequence.flow.forward, sequence.flow.backward
    found = [(1.0, 0.5, forward.get(step * j)), (-1.0, -0.5, backward.get(step * (j + 1)))]
    found += [(-1.0, 0.5, backward.get(step * j)), (1.0, 1.5, forward.get(step * (j - 1)))]
    yield np.zeros(size, np.float32)
    for sign, late, flow in found:
        if flow is not None:
            whole = sign * np.nan_to_num(flow).astype(np.float32)
            # the flow is that of another time: there the surface was elsewhere
            yield _sampled(whole, -late * whole)
            yield whole
    reach = REACH * sequence.width
    pitch = max(round(reach / 6), 1)
    grid = np.arange(-6, 7) * pitch
    for y in grid:
        for x in grid:
            if 0 < np.hypot(x, y) <= 6.5 * pitch:
                yield np.broadcast_to(np.float32([x, y])[:, None, None], size)


def _decoded(
    sequence: Sequence, j: int, change: Change, far: FarLayer, background: np.ndarray
) -> _Decoded:
    import cv2

    frames = sequence.quartet_frames(j)
    quads = sequence.quads[frames].astype(np.float32)
    shifts, times = sequence.shifts[frames], sequence.times[frames]
    frequencies, count = sequence.frame_frequencies[frames], len(quads)
    duration = (times[-1] - times[0]) * count / (count - 1)
    share = (times - times.mean()) / duration
    noise, sensor = max(change.noise, 1e-12), sensor_of(sequence)
    differs = _pooled(np.square((quads - background) / noise), 3)
    stack = np.concatenate([quads, differs])
    own = [frequencies == f for f in sequence.frequencies]
    models = []
    for mask in own:
        columns = [np.cos(shifts[mask]), np.sin(shifts[mask])]
        if float(sensor.dc_offset) or mask.sum() < 4:
            columns.append(np.ones(mask.sum()))
        models.append(np.stack(columns, axis=1).astype(np.float32))
    free = max(sum(len(model) - model.shape[1] for model in models), 1)
    best: list[np.ndarray] = []
    for number, flow in enumerate(_flows(sequence, j)):
        along = np.stack([_sampled(stack[k :: count], share[k] * flow) for k in range(count)])
        values, apart = along[:, 0], along[:, 1]
        phasors, squares = [], np.zeros(flow.shape[1:], np.float32)
        for mask, model in zip(own, models, strict=True):
            fitted = np.tensordot(np.linalg.pinv(model), values[mask], axes=1)
            squares += np.square(values[mask] - np.tensordot(model, fitted, axes=1)).sum(axis=0)
            phasors += [2.0 * fitted[0], 2.0 * fitted[1]]
        amplitude = 0.5 * np.hypot(phasors[0], phasors[1])
        allowed = noise**2 + np.square(RELATIVE * amplitude)
        residual = _pooled((squares / (free * allowed))[None], POOL)[0]
        # all raw frames but one differ from the background, which may look alike in one slot
        moves = np.sort(apart, axis=0)[1] > DIFFERS
        score = residual + np.where(moves, 0.0, UNMOVED) + (UNLIKELY if number > 8 else 0.0)
        images = [score, residual, apart.mean(axis=0), moves, *flow, amplitude, *phasors]
        if not best:
            best = [np.array(image) for image in images]
            continue
        better = score < 0.8 * best[0]
        for old, new in zip(best, images, strict=True):
            old[better] = new[better]
    _, residual, apart, moves, fx, fy, amplitude, *parts = best
    tensors = [torch.as_tensor(part) for part in parts]
    pairs = list(zip(tensors[::2], tensors[1::2], strict=True))
    distance = distance_from_phasors(pairs, sensor).numpy()
    deviation = distance_noise(torch.as_tensor(amplitude), noise, sequence).numpy()
    moving = moves & (residual < EXPLAINED) & (deviation < NOISE_MAX)
    moving &= distance < far.distance.numpy() - 0.02
    moving = cv2.medianBlur(moving.astype(np.uint8), 3) > 0
    return _Decoded(flow=np.stack([fx, fy]), distance=distance, amplitude=amplitude, moving=moving)


def _pooled(images: Float[np.ndarray, "C H W"], side: int) -> Float[np.ndarray, "C H W"]:
    """Means over boxes of ``side`` pixels."""
    import cv2

    return np.stack([cv2.blur(i, (side, side), borderType=cv2.BORDER_REPLICATE) for i in images])


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
