"""Points of moving surfaces, measured in every quartet by itself: distance, amplitude and velocity.

Slot k of a quartet is read where optical flow says that the surface was at that time. Of several
flows, each pixel takes the one along which one phasor explains the quartet best: opposite quads
cancel along the right flow. A point moves if the raw frames along its flow differ from the static
background. Truth is never read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.flow import sample
from ..data.sequence import Sequence
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

POOL, POOL_DIFFERENCE = 5, 3  # [px] sides of the boxes over which squares are averaged
# squared difference from the background over noise, from which a raw frame shows something else
DIFFERS = 4.0
EXPLAINED = 3.0  # mean squared residual over what is allowed, up to which a flow is right
RELATIVE = 0.1  # allowed share of the amplitude: phase and amplitude change during a quartet
# penalties of a flow: towards the background, and of a translation beside optical flow
TO_BACKGROUND, TRANSLATED = 4.0, 0.3
GAIN = 0.8  # a later candidate must have less than this share of the score
REACH = 0.08  # [width] largest translation during a quartet
STEPS = 6  # translations from the middle to the reach
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
    sequence: Sequence, change: Change, background: FarLayer, spacing: float
) -> Iterator[MovingPoints]:
    """The points, ``spacing`` pixels apart, of every complete quartet of a static camera; nothing
    if there is one alone, in which nothing can be seen to change.
    """
    if len(change.quartets) < 2:
        return
    quads = _quads_of(sequence, background)

    def decoded(quartet: int) -> _Decoded:
        return _decoded(sequence, quartet, change, background, quads)

    with ThreadPoolExecutor(thread_name_prefix="gftorf-points") as threads:
        by_quartet = dict(zip(change.quartets, threads.map(decoded, change.quartets), strict=True))
    camera, size = camera_of(sequence, 0), (sequence.width, sequence.height)
    keys = key_times(sequence).tolist()
    columns, rows = (
        (np.arange(count := max(round(side / spacing), 1)) + 0.5) * (side / count) for side in size
    )
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    for quartet, now in by_quartet.items():
        column, row = points.astype(int).T
        moving = now.moving[row, column]
        place, column, row = points[moving], column[moving], row[moving]
        flow, distance = now.flow[:, row, column].T, now.distance[row, column]
        along = _radial(by_quartet, quartet, place, flow, distance)
        values = (place, flow, distance, along, now.amplitude[row, column])
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
) -> _Decoded:
    """Decode a quartet along the best of several flows, inside the box that holds all changes."""
    import cv2

    frames = sequence.quartet_frames(quartet)
    quads = sequence.quads[frames].astype(np.float32)
    least = max(ROUNDING * float(background.amplitude.max()), 1e-12)
    noise, shape = max(change.noise, least), quads.shape[1:]
    differs = _pooled(np.square((quads - background_quads) / noise), POOL_DIFFERENCE)
    changed = ((differs > DIFFERS).sum(axis=0) > 1).astype(np.uint8)
    box = _box(cv2.medianBlur(changed, 3), margin=round(REACH * sequence.width) + POOL)
    whole = _Decoded(
        flow=np.zeros((2, *shape), np.float32),
        distance=np.zeros(shape, np.float32),
        amplitude=np.zeros(shape, np.float32),
        moving=np.zeros(shape, bool),
    )
    if box is None:
        return whole
    best = _Best()
    slots = _Slots.of(sequence, quartet)
    images = np.stack([quads, differs], axis=1)[..., box[0], box[1]]
    for candidate, translated in _flows(sequence, quartet, slots):
        flow = candidate[:, box[0], box[1]]
        along = np.stack(
            [sample(i, flow, share) for i, share in zip(images, slots.share, strict=True)]
        )
        phasors, squares = slots.phasors(along[:, 0])
        amplitude = 0.5 * np.hypot(*phasors[0])
        allowed = noise**2 + np.square(RELATIVE * amplitude)
        residual = _pooled((squares / allowed)[None], POOL)[0]
        # all raw frames but one: a surface may look like the background in one slot
        moves = np.sort(along[:, 1], axis=0)[1] > DIFFERS
        score = residual + np.where(moves, 0.0, TO_BACKGROUND) + TRANSLATED * translated
        best.update(score, [residual, moves, *flow, *phasors.reshape(-1, *residual.shape)])
    residual, moves, fx, fy, *parts = best.images
    pairs = torch.as_tensor(np.stack(parts)).unflatten(0, (-1, 2))
    distance = distance_from_phasors([(p[0], p[1]) for p in pairs], sensor_of(sequence)).numpy()
    amplitude = 0.5 * np.hypot(*parts[:2])
    deviation = distance_noise(torch.as_tensor(amplitude), noise, sequence).numpy()
    moving = (moves > 0) & (residual < EXPLAINED) & (deviation < NOISE_MAX)
    moving &= distance < background.distance.numpy()[box] - NEARER
    whole.flow[:, box[0], box[1]] = fx, fy
    whole.distance[box], whole.amplitude[box] = distance, amplitude
    whole.moving[box] = cv2.medianBlur(moving.astype(np.uint8), 3) > 0
    return whole


class _Best:
    """The images of the best candidate of every pixel."""

    def __init__(self):
        self.images: list[np.ndarray] = []
        self._score = np.zeros(0)

    def update(self, score: np.ndarray, images: list[np.ndarray]) -> None:
        """Take the pixels in which a candidate is clearly better."""
        if not self.images:
            self._score, self.images = score, [np.array(i, dtype=np.float32) for i in images]
            return
        better = score < GAIN * self._score
        for old, new in zip((self._score, *self.images), (score, *images), strict=True):
            old[better] = new[better]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Slots:
    """Raw frames of a quartet: when they were taken, and the phasor that explains them best."""

    share: Float[np.ndarray, "K"]
    """Time from the middle of the quartet, in units of its duration; 0 if all have one time."""
    groups: list[tuple[Bool[np.ndarray, "K"], Float[np.ndarray, "k m"]]]
    """Raw frames of each frequency, and their model: quads = model @ (re, im, perhaps constant)."""

    @property
    def free(self) -> int:
        """Degrees of freedom of the residual of :meth:`phasors`."""
        return sum(model.shape[0] - model.shape[1] for _, model in self.groups)

    @property
    def decide(self) -> bool:
        """Whether one flow may explain the raw frames better than another: not those of three
        shifts, nor those that have one time, as those of a phasor.
        """
        return self.free > 0 and bool(self.share.any())

    @classmethod
    def of(cls, sequence: Sequence, quartet: int) -> _Slots:
        frames = sequence.quartet_frames(quartet)
        times, shifts = sequence.times[frames], sequence.shifts[frames]
        duration = (times[-1] - times[0]) * len(times) / (len(times) - 1)
        constant = float(sequence.calibration.dc_offset) != 0.0
        groups = []
        for f in sequence.frequencies:
            mask = sequence.frame_frequencies[frames] == f
            columns = [np.cos(shifts[mask]), np.sin(shifts[mask])]
            if constant or mask.sum() == 3:
                columns.append(np.ones(mask.sum()))
            groups.append((mask, np.stack(columns, axis=1).astype(np.float32)))
        at_once = sequence.from_phasors or duration == 0.0
        share = np.zeros(len(times)) if at_once else (times - times.mean()) / duration
        return cls(share=share, groups=groups)

    def phasors(
        self, quads: Float[np.ndarray, "K H W"]
    ) -> tuple[Float[np.ndarray, "f 2 H W"], Float[np.ndarray, "H W"]]:
        """Phasors by least squares, and the mean squared residual per degree of freedom, zero if
        there is none.
        """
        phasors, squares = [], np.zeros(quads.shape[1:], np.float32)
        for mask, model in self.groups:
            values = quads[mask]
            fitted = np.tensordot(np.linalg.pinv(model), values, axes=1)
            if model.shape[0] > model.shape[1]:
                squares += np.square(values - np.tensordot(model, fitted, axes=1)).sum(axis=0)
            phasors.append(2.0 * fitted[:2])
        return np.stack(phasors), squares / max(self.free, 1)


def _flows(
    sequence: Sequence, quartet: int, slots: _Slots
) -> Iterator[tuple[Float[np.ndarray, "2 H W"], bool]]:
    """Candidates of the displacement during a quartet of what is there in its middle, and whether
    each is a translation of the whole image: no motion, optical flow between the starts of
    neighbouring quartets, and translations.

    No motion comes after optical flow if the raw frames fit every flow equally well.
    """
    cycle, size = sequence.cycle, (2, sequence.height, sequence.width)
    forward, backward = sequence.flow.forward, sequence.flow.backward
    still = np.zeros(size, np.float32)
    if slots.decide:
        yield still, False
    middle = 0.5 if slots.share.any() else 0.0  # phasors are those of the start
    # flow from the start of a quartet, and its sign
    for flows, step, sign in (
        (forward, 0, 1.0),
        (backward, 1, -1.0),
        (backward, 0, -1.0),
        (forward, -1, 1.0),
    ):
        if cycle * (quartet + step) in flows:
            flow = sign * np.nan_to_num(flows[cycle * (quartet + step)]).astype(np.float32)
            yield sample(flow, flow, step - middle), False
            yield flow, False
    if not slots.decide:
        yield still, False
    pitch = max(REACH * sequence.width / STEPS, 1.0)
    grid = np.arange(-STEPS, STEPS + 1)
    for y in grid:
        for x in grid:
            if 0 < np.hypot(x, y) <= STEPS + 0.5:
                translation = np.array([pitch * x, pitch * y], np.float32)[:, None, None]
                yield np.broadcast_to(translation, size), True


def _radial(
    decoded: Mapping[int, _Decoded],
    quartet: int,
    place: Float[np.ndarray, "P 2"],
    flow: Float[np.ndarray, "P 2"],
    distance: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P"]:
    """Change of the distance during a quartet [m]: mean slope to those neighbouring quartets that
    see the point, else zero.
    """
    total, count = np.zeros(len(place)), np.zeros(len(place))
    for step in (-1, 1):
        if (other := decoded.get(quartet + step)) is None:
            continue
        height, width = other.distance.shape
        column, row = np.floor(place + step * flow).astype(int).T
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
