"""Closed-form analysis of quads: distance along the flow, changes, background (method, 2.9).

Truth is never read.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.cycles import phase_noise
from ..data.decode import quartet_phasors, unambiguous_range
from ..data.sequence import Intrinsics, Sequence
from ..errors import InputError
from .camera import Camera
from .distortion import Distortion
from .sensor import Sensor, phasor_from_quads
from .unwrap import distance_from_phasors

CHANGED = 2.5  # [standard deviations] least change of quads, pooled over slots and 3x3 pixels
ROUNDING = 1e-5  # least noise of quads, as a share of the largest amplitude: single precision
DISTANCE_TRUSTED = 0.15  # [m] largest noise of a distance that is used


def sensor_of(sequence: Sequence) -> Sensor:
    """The sensor that recorded a sequence, with the canonical shifts, at all its frequencies.

    Source intensity 1, since only its product with reflectivity is known.

    Raises:
        InputError: If its frequencies have no common range.
    """
    unambiguous_range(sequence)
    return Sensor(
        f_mod_hz=sequence.frequencies[0],
        further_hz=sequence.frequencies[1:],
        phase_offset=sequence.calibration.phase_offset,
        dc_offset=sequence.calibration.dc_offset,
        frame_period_s=frame_period(sequence),
    )


def camera_of(sequence: Sequence, frame: int) -> Camera:
    """The camera of raw frame ``frame``.

    Raises:
        InputError: If its lens cannot be undone over the whole image.
    """
    size = sequence.height, sequence.width
    try:
        return _camera(sequence.intrinsics, size, sequence.camera_from_world[frame])
    except ValueError as error:
        if sequence.intrinsics.distortion is None:
            raise
        what, where = "a lens that cannot be undone", sequence.path or "sequence"
        fix = "correct the distortion, k1, k2, p1, p2, k3 of OpenCV, or leave it out"
        raise InputError(what, where=where, why=str(error), fix=fix) from error


def colour_camera_of(sequence: Sequence, frame: int) -> Camera | None:
    """The colour camera at raw frame ``frame``; None if it is not known."""
    colour = sequence.colour
    if colour.size is None or colour.intrinsics is None or colour.camera_from_world is None:
        return None
    return _camera(colour.intrinsics, colour.size, colour.camera_from_world[frame])


def _camera(intrinsics: Intrinsics, size: tuple[int, int], pose: np.ndarray) -> Camera:
    return Camera(
        width=size[1],
        height=size[0],
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        camera_from_world=pose,
        distortion=Distortion.of(intrinsics.distortion),
    )


def frame_period(sequence: Sequence) -> float:
    """Mean time between raw frames [s]; 1 s if all are of one instant."""
    return float(np.diff(sequence.times).mean()) if sequence.times[-1] > 0 else 1.0


def key_times(sequence: Sequence) -> Float[Tensor, "T"]:
    """Start of every quartet, a truncated one included, and one quartet later [s]."""
    starts = torch.as_tensor(sequence.times[:: sequence.cycle], dtype=torch.float64)
    return torch.cat([starts, starts[-1:] + sequence.cycle * frame_period(sequence)])


def sample(image: Float[Tensor, "C H W"], points: Float[Tensor, "P 2"]) -> Float[Tensor, "C P"]:
    """Values at image positions (x, y) [px], bilinear, repeated beyond the border."""
    return _sampled(image[None], points[None, None])[0, :, 0]


def displaced(
    images: Float[Tensor, "B C H W"], displacement: Float[Tensor, "B 2 H W"]
) -> Float[Tensor, "B C H W"]:
    """Images at x + displacement(x) [px], bilinear, repeated beyond the border."""
    height, width = images.shape[2:]
    y, x = (torch.arange(side, device=images.device) + 0.5 for side in (height, width))
    centre = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    return _sampled(images, centre + displacement.permute(0, 2, 3, 1))


def _sampled(
    images: Float[Tensor, "B C H W"], points: Float[Tensor, "B h w 2"]
) -> Float[Tensor, "B C h w"]:
    size = images.new_tensor([images.shape[3], images.shape[2]])
    grid = (2.0 * points / size - 1.0).to(images)
    return torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def flow_at(
    sequence: Sequence, quartet: int, step: int, points: Float[Tensor, "P 2"]
) -> Float[Tensor, "P 2"] | None:
    """Optical flow [px] of points [px] from the start of ``quartet`` to the next (1) or last (-1).

    NaN where it is unknown. If the flow of this direction is absent, it is the negative flow of the
    other direction; None if both are absent.
    """
    same, other = (sequence.flow.forward, sequence.flow.backward)[:: 1 if step > 0 else -1]
    for sign, flow in ((1.0, same), (-1.0, other)):
        if sequence.cycle * quartet in flow:
            return sign * sample(torch.tensor(flow[sequence.cycle * quartet]), points).T
    return None


def decode_along_flow(
    sequence: Sequence,
    quartet: int,
    points: Float[Tensor, "P 2"],
    ahead: Float[Tensor, "P 2"] | None,
    behind: Float[Tensor, "P 2"] | None,
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Distance [m] and amplitude [quad units] of moving points at the start of a quartet.

    Slot k was measured k raw frames later and, in the quartet before, K - k raw frames earlier.
    Both are sampled along the flow and interpolated to the start, so that motion across the image
    and along the ray causes no artefact to first order. Without a measured quartet before, the
    value is extrapolated from the one after; without either, slot k is used as measured.

    ``points`` are positions [px] at the start of a complete quartet; ``ahead`` and ``behind`` their
    flow to the next quartet and to the one before [px]; NaN and None: no motion.
    """
    complete = set(sequence.complete_quartets)
    ahead = torch.zeros_like(points) if ahead is None else ahead.nan_to_num(0.0)
    behind = -ahead if behind is None else behind.nan_to_num(0.0)
    quads, step = [], sequence.cycle
    for k in range(step):
        share = k / step
        frame = step * quartet + k
        value = _quad_at(sequence, frame, points + share * ahead)
        if quartet - 1 in complete:
            earlier = _quad_at(sequence, frame - step, points + (1.0 - share) * behind)
            value = (1.0 - share) * value + share * earlier
        elif quartet + 1 in complete:
            later = _quad_at(sequence, frame + step, points + (1.0 + share) * ahead)
            value = (1.0 + share) * value - share * later
        quads.append(value)
    frames, stack, phasors = sequence.quartet_frames(quartet), torch.stack(quads), []
    shifts, frequencies = sequence.shifts[frames], sequence.frame_frequencies[frames]
    for f in sequence.frequencies:
        of_f = frequencies == f
        angles = tuple(float(s) for s in shifts[of_f])
        phasors.append(phasor_from_quads(stack[torch.as_tensor(of_f)], angles))
    return distance_from_phasors(phasors, sensor_of(sequence)), 0.5 * torch.hypot(*phasors[0])


def _quad_at(sequence: Sequence, frame: int, points: Float[Tensor, "P 2"]) -> Float[Tensor, "P"]:
    return sample(torch.tensor(sequence.quads[frame])[None], points)[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """Pixels in which same-shift quads of successive quartets differ by more than noise."""

    quartets: tuple[int, ...]
    """The complete quartets."""
    changed: Bool[Tensor, "J H W"]
    """Whether a pixel changes from one complete quartet to the next; J = quartets - 1."""
    noise: float
    """Standard deviation of the noise of one quad [quad units]."""


def change_of(sequence: Sequence) -> Change:
    """Compare every complete quartet with the next one, slot by slot.

    The noise is estimated by the median absolute difference, right as long as most pixels are
    static. Slots are matched by frequency and shift.
    """
    quartets = sequence.complete_quartets
    ordered = []
    for frames in map(sequence.quartet_frames, quartets):
        order = np.lexsort((sequence.shifts[frames], sequence.frame_frequencies[frames]))
        ordered.append(torch.tensor(sequence.quads[frames][order]))
    quads = torch.stack(ordered)
    difference = quads.diff(dim=0)
    if difference.numel() == 0:
        none = difference.new_zeros(0, *quads.shape[2:]).bool()
        return Change(quartets=tuple(quartets), changed=none, noise=0.0)
    deviation = max(float(1.4826 * difference.abs().median()), 1e-12)
    pooled = torch.nn.functional.avg_pool2d(
        difference.square().mean(dim=1), 3, stride=1, padding=1, count_include_pad=False
    )
    return Change(
        quartets=tuple(quartets),
        changed=pooled.sqrt() > CHANGED * deviation,
        noise=deviation / float(np.sqrt(2.0)),
    )


def distance_noise(amplitude: Tensor, noise: float, sequence: Sequence) -> Tensor:
    """Standard deviation [m] of a distance: noise / (gain amplitude) radians."""
    radians = noise / (quads_gain(sequence) * amplitude.clamp_min(1e-12))
    return radians / sensor_of(sequence).phase_slope


def quads_gain(sequence: Sequence) -> float:
    """Signal-to-noise ratio of the first phase of a quartet over that of a quad [1].

    It is sqrt(K / 2) of K equally spaced quads; for others see
    :func:`gftorf_warp.data.cycles.phase_noise`.
    """
    frames = slice(0, sequence.cycle)
    shifts = sequence.shifts[frames][sequence.frame_frequencies[frames] == sequence.frequencies[0]]
    gain = 1.0 / phase_noise(shifts)
    even = (0.5 * len(shifts)) ** 0.5
    return even if abs(gain - even) < 1e-9 * even else gain


@dataclass(frozen=True, kw_only=True, eq=False)
class FarLayer:
    """The background of all moving bodies: the largest distance at which each pixel was static."""

    distance: Float[Tensor, "H W"]
    """Distance [m]; where unknown, that of the nearest known pixels."""
    amplitude: Float[Tensor, "H W"]
    """Amplitude [quad units], likewise filled."""
    known: Bool[Tensor, "H W"]
    """Whether the pixel was static and bright enough at least once."""


def far_layer(sequence: Sequence, change: Change) -> FarLayer:
    """Mean phasors of the quartets in which a pixel is static at its largest distance.

    A pixel is static in a quartet if it changes neither from the quartet before nor to the next
    one. Distances are wrapped: a background beyond the common range of all frequencies becomes too
    near.
    """
    sensor = sensor_of(sequence)
    still = torch.ones(len(change.quartets), *sequence.quads.shape[1:], dtype=torch.bool)
    still[1:] &= ~change.changed
    still[:-1] &= ~change.changed
    phasors = decoded_phasors(sequence, change.quartets)
    distance = distance_from_phasors([(p[:, 0], p[:, 1]) for p in phasors], sensor)
    amplitude = 0.5 * phasors[0].norm(dim=1)
    tolerance = 4.0 * distance_noise(amplitude, change.noise, sequence)
    still &= tolerance < 4.0 * DISTANCE_TRUSTED
    reach = torch.where(still, distance, -1.0).amax(dim=0)
    there = still & (distance > reach - 0.05 - tolerance)
    count = there.sum(dim=0)
    means = (phasors * there[:, None]).sum(dim=1) / count.clamp_min(1)
    known = count > 0
    together = distance_from_phasors([(mean[0], mean[1]) for mean in means], sensor)
    fields = torch.stack([together, 0.5 * means[0].norm(dim=0)])
    distance, amplitude = fill(fields, known)
    return FarLayer(distance=distance, amplitude=amplitude, known=known)


def decoded_phasors(sequence: Sequence, quartets: Iterable[int]) -> Float[Tensor, "f J 2 H W"]:
    """Phasors of some complete quartets, at each frequency, float32 [quad units]."""
    phasors = [[phasor for _, phasor in quartet_phasors(sequence, i)] for i in quartets]
    return torch.as_tensor(np.stack(phasors, axis=1), dtype=torch.float32)


def extremes(image: Float[Tensor, "H W"]) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Smallest and largest value within 3x3 pixels."""
    both = torch.nn.functional.max_pool2d(torch.stack([-image, image]), 3, stride=1, padding=1)
    return -both[0], both[1]


def fill(image: Float[Tensor, "C H W"], known: Bool[Tensor, "H W"]) -> Float[Tensor, "C H W"]:
    """Replace unknown pixels by the mean of known neighbours, ring by ring, else by zero."""
    weight = known.to(image)[None]
    value = torch.where(known, image, 0.0)
    while bool((weight == 0).any()) and bool((weight > 0).any()):
        count = torch.nn.functional.avg_pool2d(weight, 3, stride=1, padding=1)
        mean = torch.nn.functional.avg_pool2d(value, 3, stride=1, padding=1) / count.clamp_min(1e-6)
        value = torch.where(weight > 0, value, torch.where(count > 0, mean, 0.0))
        weight = ((weight > 0) | (count > 1e-6)).to(image)
    return value
