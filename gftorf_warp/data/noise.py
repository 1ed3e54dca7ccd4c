"""Noise of quads, estimated from the recording alone.

The difference of two raw frames one cycle apart has no scene in it where nothing moves, and twice
the variance of one of them. The high pass (1, -2, 1) along rows and columns, which multiplies the
variance of independent noise by 36 (Immerkaer, "Fast noise variance estimation", 1996), removes
what a moving camera or surface leaves there, except at edges; a median over pixels ignores those.
Shot noise is modelled to first order: variance = floor + gain x amplitude, a straight line through
medians over pixels of similar amplitude. Noise that is correlated between neighbouring pixels is
underestimated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .decode import quartet_phasors
from .kept import kept
from .sequence import Sequence

MEDIAN = 0.6745  # of |x| of a standard normal distribution
HIGH_PASS = 6.0  # root of the sum of the squared weights of the two-dimensional high pass
PAIRS_MAX = 6  # pairs of quartets, spread over the sequence: enough pixels for a percent
LEAST = 1e-3  # [1] of the amplitude: a millimetre at 20 MHz, and the rounding of exact recordings
BINS = 12  # of amplitude, with equal numbers of pixels
BIN_PIXELS_MIN = 200  # for a median within 10 %


@dataclass(frozen=True, kw_only=True, eq=False)
class QuadNoise:
    """Variance of a quad as a function of its amplitude, a straight line per slot of the cycle."""

    floor: Float[np.ndarray, "K"]
    """Variance without light [quad units^2]."""
    gain: Float[np.ndarray, "K"]
    """Variance per amplitude [quad units]: shot noise."""

    def sigma(self, amplitude: Float[np.ndarray, "K H W"]) -> Float[np.ndarray, "K H W"]:
        """Standard deviation of quads [quad units] of every slot from amplitudes a, at least a
        thousandth of these.
        """
        floor, gain = (values.reshape(-1, 1, 1) for values in (self.floor, self.gain))
        return np.sqrt(floor + gain * amplitude + np.square(LEAST * amplitude))


@kept
def quad_noise(sequence: Sequence) -> QuadNoise | None:
    """Noise of the quads of each slot; None if no quartet is complete.

    With a single complete quartet, the quads themselves are taken instead of differences, and
    texture counts as noise.
    """
    quartets = sequence.complete_quartets
    if not quartets:
        return None
    pairs = [(i, i + 1) for i in quartets if i + 1 in quartets]
    chosen = np.linspace(0, len(pairs) - 1, min(PAIRS_MAX, len(pairs))).round().astype(int)
    taken = [pairs[k] for k in chosen] or [(quartets[0],)]
    variances, amplitudes = [], []
    for pair in taken:
        quads = [sequence.quads[sequence.quartet_frames(i)].astype(np.float64) for i in pair]
        difference = quads[0] if len(quads) == 1 else quads[1] - quads[0]
        variances.append(_high_pass(difference) / (HIGH_PASS * np.sqrt(len(quads))))
        mean = np.mean([amplitudes_of(sequence, i) for i in pair], axis=0)
        amplitudes.append(mean[:, 1:-1, 1:-1] if min(mean.shape[1:]) > 2 else mean)
    residuals, light = np.stack(variances, axis=1), np.stack(amplitudes, axis=1)
    lines = [_line(residuals[k].ravel(), light[k].ravel()) for k in range(sequence.cycle)]
    floor, gain = np.array(lines).T
    return QuadNoise(floor=floor, gain=gain)


def amplitudes_of(sequence: Sequence, i: int) -> Float[np.ndarray, "K H W"]:
    """Measured amplitude a [quad units] of every slot of a complete quartet."""
    first = sequence.cycle * i
    result = np.empty((sequence.cycle, sequence.height, sequence.width))
    for frames, (re, im) in quartet_phasors(sequence, i):
        result[np.array(frames) - first] = 0.5 * np.hypot(re, im)
    return result


@kept
def median_amplitudes(sequence: Sequence) -> Float[np.ndarray, "K H W"]:
    """Median over all complete quartets of the amplitude of every slot [quad units]."""
    return np.median([amplitudes_of(sequence, i) for i in sequence.complete_quartets], axis=0)


def _high_pass(images: Float[np.ndarray, "K H W"]) -> Float[np.ndarray, "K h w"]:
    """Second differences along rows and columns; images too small for them as they are."""
    if min(images.shape[1:]) <= 2:
        return images * HIGH_PASS
    rows = images[:, :-2] - 2.0 * images[:, 1:-1] + images[:, 2:]
    return rows[..., :-2] - 2.0 * rows[..., 1:-1] + rows[..., 2:]


def _line(residual: Float[np.ndarray, "n"], amplitude: Float[np.ndarray, "n"]) -> tuple:
    """Floor and gain of the variance, neither negative."""
    bins = min(BINS, len(residual) // BIN_PIXELS_MIN)
    overall = float(np.median(np.abs(residual)) / MEDIAN) ** 2
    if bins < 2 or overall == 0.0:
        return overall, 0.0
    parts = np.array_split(np.argsort(amplitude), bins)
    light = np.array([amplitude[part].mean() for part in parts])
    variance = np.array([(np.median(np.abs(residual[part])) / MEDIAN) ** 2 for part in parts])
    weights = 1.0 / np.maximum(variance, 0.01 * overall)  # errors of variances are relative
    gain, floor = np.polyfit(light, variance, 1, w=weights)
    if gain < 0.0:
        return float(np.average(variance, weights=weights)), 0.0
    if floor < 0.0:
        return 0.0, float(np.sum(weights**2 * variance * light) / np.sum((weights * light) ** 2))
    return float(floor), float(gain)
