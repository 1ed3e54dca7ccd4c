"""Points of moving surfaces, measured in every quartet by itself: distance, amplitude and velocity.

Slot k of a quartet is read where a flow says that the surface was at that time; of several flows,
each pixel takes the one along which one phasor explains the quartet best, see along_flow.py. A
point moves if the raw frames along its flow differ from the static background. Truth is never read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.sequence import Sequence
from ..data.threads import KeptThreads
from .along_flow import DIFFERS, POOL, REACH, along_best
from .measured import (
    ROUNDING,
    Change,
    FarLayer,
    camera_of,
    distance_noise,
    key_times,
    sensor_of,
)
from .sensor import quad_from_phasor
from .tracks import unproject
from .unwrap import distance_from_phasors

POOL_DIFFERENCE = 3  # [px] side of the box over which squared differences are averaged
EXPLAINED = 3.0  # mean squared residual over what is allowed, up to which a flow is right
NOISE_MAX = 0.25  # [m] largest noise of a distance that is used
NEARER = 0.02  # [m] least distance in front of the background
RADIAL_MAX = 0.5  # [m] largest change of distance from one quartet to the next


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingPoints:
    """P points of moving surfaces in the middle between the starts of a quartet and of the next."""

    quartet: int
    """Its number."""
    mean: Float[Tensor, "P 3"]
    """Positions in the world [m]."""
    distance: Float[Tensor, "P"]
    """Distance from the camera at the mean time of the raw frames [m]."""
    amplitude: Float[Tensor, "P"]
    """Amplitude [quad units]."""
    velocity: Float[Tensor, "P 3"]
    """Displacement during the quartet [m]."""


def moving_points(
    sequence: Sequence,
    change: Change,
    background: FarLayer,
    spacing: float,
    device: torch.device | str = "cpu",
) -> Iterator[MovingPoints]:
    """The points, ``spacing`` pixels apart, of every complete quartet of a static camera, decoded
    on ``device``; nothing if there is one alone, in which nothing can be seen to change.
    """
    if len(change.quartets) < 2:
        return
    quads, where = _quads_of(sequence, background), torch.device(device)

    def decoded(quartet: int) -> _Decoded:
        return _decoded(sequence, quartet, change, background, quads, where)

    by_quartet = dict(zip(change.quartets, _mapped(decoded, change.quartets, where), strict=True))
    camera, size = camera_of(sequence, 0), (sequence.width, sequence.height)
    keys = key_times(sequence).tolist()
    columns, rows = (
        (np.arange(count := max(round(side / spacing), 1)) + 0.5) * (side / count) for side in size
    )
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    for quartet, now in by_quartet.items():
        column, row = points.astype(int).T
        moving = now.moving[row, column]
        position, column, row = points[moving], column[moving], row[moving]
        flow, distance = now.flow[:, row, column].T, now.distance[row, column]
        along = _radial(by_quartet, quartet, position, flow, distance)
        values = (position, flow, distance, along, now.amplitude[row, column])
        at, step, near, nearer, amplitude = (torch.as_tensor(v).float() for v in values)
        # raw frames are taken at the beginning of each period, so their mean time is before the
        # middle of the quartet, which ends where the next one begins
        begin, finish = keys[quartet : quartet + 2]
        measured_at = float(sequence.times[sequence.quartet_frames(quartet)].mean())
        late = (0.5 * (begin + finish) - measured_at) / (finish - begin)
        start, middle, end = (
            unproject(camera, at + s * step, near + s * nearer)
            for s in (late - 0.5, late, late + 0.5)
        )
        yield MovingPoints(
            quartet=quartet, mean=middle, distance=near, amplitude=amplitude, velocity=end - start
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Decoded:
    """One quartet, decoded along the flow of every pixel in its middle."""

    flow: Float[np.ndarray, "2 H W"]
    """Displacement during the quartet [px]."""
    distance: Float[np.ndarray, "H W"]
    """[m]"""
    amplitude: Float[np.ndarray, "H W"]
    """[quad units]"""
    moving: Bool[np.ndarray, "H W"]
    """Whether the other images are those of a moving surface."""


def _mapped(
    decoded: Callable[[int], _Decoded], quartets: Iterable[int], device: torch.device
) -> list[_Decoded]:
    """Every quartet decoded: on a CPU by a thread each, as many as torch may use, so that no result
    depends on their number.
    """
    if device.type != "cpu":
        return list(map(decoded, quartets))
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with KeptThreads("gftorf-points", count) as threads:
            return list(threads.map(decoded, quartets))
    finally:
        torch.set_num_threads(count)


def _quads_of(sequence: Sequence, background: FarLayer) -> Float[np.ndarray, "K H W"]:
    """Quads of the background in every slot."""
    sensor, slots = sensor_of(sequence), slice(0, sequence.cycle)
    distance, amplitude = background.distance.numpy(), background.amplitude.numpy()
    quads = []
    for shift, f in zip(sequence.shifts[slots], sequence.frame_frequencies[slots], strict=True):
        slope = float(sensor.phase_slope) * float(f) / sequence.frequencies[0]
        phase = slope * distance + float(sensor.phase_offset)
        re, im = 2.0 * amplitude * np.cos(phase), 2.0 * amplitude * np.sin(phase)
        constant = 2.0 * amplitude * float(sensor.dc_offset)
        quads.append(quad_from_phasor(re, im, constant, float(shift)))
    return np.stack(quads).astype(np.float32)


def _decoded(
    sequence: Sequence,
    quartet: int,
    change: Change,
    background: FarLayer,
    background_quads: Float[np.ndarray, "K H W"],
    device: torch.device,
) -> _Decoded:
    """Decode a quartet along the best of several flows, inside the box that holds all changes."""
    import cv2

    quads = sequence.quads[sequence.quartet_frames(quartet)].astype(np.float32)
    least = max(ROUNDING * float(background.amplitude.max()), 1e-12)
    noise, shape = max(change.noise, least), quads.shape[1:]
    differs = _pooled(np.square((quads - background_quads) / noise), POOL_DIFFERENCE)
    changed = np.asarray((differs > DIFFERS).any(axis=0), dtype=np.uint8)
    box = _box(cv2.medianBlur(changed, 3), margin=round(REACH * sequence.width) + POOL)
    whole = _Decoded(
        flow=np.zeros((2, *shape), np.float32),
        distance=np.zeros(shape, np.float32),
        amplitude=np.zeros(shape, np.float32),
        moving=np.zeros(shape, bool),
    )
    if box is None:
        return whole
    images = np.stack([quads, differs])[..., box[0], box[1]]
    best = along_best(sequence, quartet, torch.as_tensor(images, device=device), box, noise)
    phasors = [(re, im) for re, im in best.phasors.cpu()]
    distance = distance_from_phasors(phasors, sensor_of(sequence)).numpy()
    amplitude = 0.5 * torch.hypot(*phasors[0])
    deviation = distance_noise(amplitude, noise, sequence).numpy()
    moving = (best.moves & (best.residual < EXPLAINED)).cpu().numpy() & (deviation < NOISE_MAX)
    moving &= distance < background.distance.numpy()[box] - NEARER
    whole.flow[:, box[0], box[1]] = best.flow.cpu().numpy()
    whole.distance[box], whole.amplitude[box] = distance, amplitude.numpy()
    whole.moving[box] = cv2.medianBlur(moving.astype(np.uint8), 3) > 0
    return whole


def _radial(
    decoded: Mapping[int, _Decoded],
    quartet: int,
    position: Float[np.ndarray, "P 2"],
    flow: Float[np.ndarray, "P 2"],
    distance: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P"]:
    """Change of the distance during a quartet [m]: mean slope to those neighbouring quartets that
    see the point, else zero.
    """
    total, count = np.zeros(len(position)), np.zeros(len(position))
    for step in (-1, 1):
        if (other := decoded.get(quartet + step)) is None:
            continue
        height, width = other.distance.shape
        column, row = np.floor(position + step * flow).astype(int).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = column.clip(0, width - 1), row.clip(0, height - 1)
        slope = step * (other.distance[row, column] - distance)
        known = inside & other.moving[row, column] & (np.abs(slope) < RADIAL_MAX)
        total += np.where(known, slope, 0.0)
        count += known
    return total / np.maximum(count, 1)


def _box(mask: np.ndarray, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest box with all marked pixels, ``margin`` pixels larger."""
    if not mask.any():
        return None
    sides = []
    for axis, side in enumerate(mask.shape):
        marked = np.flatnonzero(mask.any(axis=1 - axis))
        sides.append(slice(max(marked[0] - margin, 0), min(marked[-1] + margin + 1, side)))
    return sides[0], sides[1]


def _pooled(images: Float[np.ndarray, "C H W"], side: int) -> Float[np.ndarray, "C H W"]:
    """Means over boxes of ``side`` pixels."""
    import cv2

    return np.stack([cv2.blur(i, (side, side), borderType=cv2.BORDER_REPLICATE) for i in images])
