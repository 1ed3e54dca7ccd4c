"""What averaging over time makes of the closed form, without any reconstruction: the least that one
must beat.

Where camera and surface stand still, all quartets measure the same, so that their mean has the
noise of one over the root of their number. A quartet *agrees* in a pixel if every raw frame is
within a few standard deviations of the pixel's median in that slot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..constants import SPEED_OF_LIGHT
from .cycles import phase_noise
from .decode import closed_form_distance, quartet_phasors
from .kept import kept
from .noise import QuadNoise, amplitudes_of, median_amplitudes, quad_noise
from .sequence import ColourCamera, Flow, Sequence

STILL_M = 1e-6  # [m], [1] poses that differ less are one pose
AGREES = 4.0  # [standard deviations] from the median; of 3 to 6 the best on twelve random scenes

AGREEING_MIN = 2  # quartets
SAME = 3.0  # [standard deviations of the difference] between neighbours that measured the same


def camera_rests(sequence: Sequence) -> bool:
    """Whether all raw frames have one pose."""
    return float(np.ptp(sequence.camera_from_world, axis=0).max()) <= STILL_M


def averaged(sequence: Sequence) -> Sequence:
    """The sequence with the temporal mean of its agreeing quartets instead of each of them.

    Other pixels keep what was measured.
    """
    agrees = agreement(sequence)
    if not agrees.any():
        return sequence
    stacked = stacked_quads(sequence)
    weights = agrees[:, None].astype(np.float32)
    mean = (stacked * weights).sum(axis=0) / np.maximum(weights.sum(axis=0), 1.0)
    quads = sequence.quads.copy()
    for i, there, measured in zip(sequence.complete_quartets, agrees, stacked, strict=True):
        quads[sequence.quartet_frames(i)] = np.where(there, mean, measured)
    return replace(sequence, quads=quads)


@kept
def agreement(sequence: Sequence) -> Bool[np.ndarray, "Q H W"]:
    """Whether each complete quartet agrees with the median of its pixel over time, and another one
    does: medians of several slots can be of two surfaces, which a single quartet may mix alike.

    False everywhere where the camera moves; read-only.
    """
    quartets, noise = sequence.complete_quartets, quad_noise(sequence)
    agrees = np.zeros((len(quartets), sequence.height, sequence.width), dtype=bool)
    if noise is not None and camera_rests(sequence):
        stacked = stacked_quads(sequence)
        reach = AGREES * noise.sigma(median_amplitudes(sequence))
        agrees = (np.abs(stacked - np.median(stacked, axis=0)) <= reach).all(axis=1)
        agrees &= agrees.sum(axis=0) >= AGREEING_MIN
    agrees.flags.writeable = False
    return agrees


def averaged_locally(sequence: Sequence) -> tuple[Sequence, Int[np.ndarray, "Q H W"]]:
    """The sequence with the mean of each complete quartet and those of its neighbours in time that
    measured the same, slot by slot, and the number of quartets in each mean.

    That number is 1 where no neighbour did, and everywhere where the camera moves.
    """
    quartets, noise = sequence.complete_quartets, quad_noise(sequence)
    count = np.ones((len(quartets), sequence.height, sequence.width), dtype=np.int64)
    if noise is None or not camera_rests(sequence):
        return sequence, count
    stacked = stacked_quads(sequence)
    variance = [np.square(noise.sigma(amplitudes_of(sequence, i))) for i in quartets]
    total = stacked.astype(np.float64)
    for k in range(len(quartets) - 1):
        if quartets[k + 1] != quartets[k] + 1:
            continue
        reach = SAME * np.sqrt(variance[k] + variance[k + 1])
        same = (np.abs(stacked[k + 1] - stacked[k]) <= reach).all(axis=0)
        total[k] += same * stacked[k + 1]
        total[k + 1] += same * stacked[k]
        count[k : k + 2] += same
    quads = sequence.quads.copy()
    for i, mean in zip(quartets, total / count[:, None], strict=True):
        quads[sequence.quartet_frames(i)] = mean
    return replace(sequence, quads=quads), count


def averaged_or_locally(sequence: Sequence) -> tuple[Sequence, Int[np.ndarray, "Q H W"]]:
    """:func:`averaged` where a complete quartet agrees, else :func:`averaged_locally`, and the
    number of quartets in each mean.
    """
    agrees, (local, count) = agreement(sequence), averaged_locally(sequence)
    quads, means = local.quads.copy(), averaged(sequence).quads
    for i, there in zip(sequence.complete_quartets, agrees, strict=True):
        frames = sequence.quartet_frames(i)
        quads[frames] = np.where(there, means[frames], quads[frames])
    return replace(sequence, quads=quads), np.where(agrees, agrees.sum(axis=0), count)


def sigma_of_mean(
    sequence: Sequence, noise: QuadNoise, count: Int[np.ndarray, "*q H W"]
) -> Float[np.ndarray, "*q H W"]:
    """Standard deviation of the distance of the mean of so many quartets [m], from the first
    frequency.
    """
    first = quartet_phasors(sequence, sequence.complete_quartets[0])[0][0]
    slot = first[0] % sequence.cycle
    light = median_amplitudes(sequence)
    relative = noise.sigma(light)[slot] / np.maximum(light[slot], np.finfo(np.float32).tiny)
    metres_per_rad = SPEED_OF_LIGHT / (4.0 * math.pi * sequence.frequencies[0])
    scale = phase_noise(sequence.shifts[first]) * metres_per_rad
    return scale * relative / np.sqrt(np.maximum(count, 1))


def over_time(sequence: Sequence, reduce: Callable[..., np.ndarray]) -> Float[np.ndarray, "H W"]:
    """Closed form [m] of the quads of each slot reduced over all complete quartets.

    Args:
        sequence: What was measured.
        reduce: ``np.mean``, or ``np.median``; called with ``axis=0``.

    Returns:
        One image in [0, range), meaningful where neither camera nor surface moves in the whole
        recording.

    Raises:
        IndexError: If no quartet is complete.
    """
    first = sequence.cycle * sequence.complete_quartets[0]
    one = one_quartet(sequence, reduce(stacked_quads(sequence), axis=0), first)
    return closed_form_distance(one, 0)


def nearest_quartet(sequence: Sequence, time: float) -> int:
    """The complete quartet during which ``time`` [s] lies,
    else the one that ends or begins nearest to it.
    """

    def away(quartet: int) -> float:
        first = sequence.cycle * quartet
        start, end = sequence.times[first], sequence.times[first + sequence.cycle - 1]
        return max(float(start - time), float(time - end), 0.0)

    return min(sequence.complete_quartets, key=away)


def one_quartet(sequence: Sequence, quads: Float[np.ndarray, "K H W"], first: int) -> Sequence:
    """A sequence of one quartet with other quads; the rest is that of raw frames ``first`` .."""
    frames = slice(first, first + sequence.cycle)
    return replace(
        sequence,
        quads=quads.astype(np.float32),
        measured=np.ones(sequence.cycle, dtype=bool),
        shifts=sequence.shifts[frames],
        times=sequence.times[frames],
        frequencies_hz=sequence.frame_frequencies[frames],
        exposures=None,
        camera_from_world=sequence.camera_from_world[frames],
        calibration=replace(sequence.calibration, cycle_length=sequence.cycle),
        tap_sums={},
        colour=ColourCamera(),
        flow=Flow(),
    )


def stacked_quads(sequence: Sequence) -> Float[np.ndarray, "Q K H W"]:
    """Quads of all complete quartets."""
    return np.stack(
        [sequence.quads[sequence.quartet_frames(i)] for i in sequence.complete_quartets]
    )
