"""Constant part of raw quads: an additive zero, or a multiple of the amplitude.

Stored without corrections, a raw frame is zero + a (cos(psi - theta) + b). What remains without the
wave, zero + b a, is a straight line over the amplitude a: flat if the ADC adds a zero, through the
origin if the sensor has a DC offset. Both hypotheses are fitted to medians over pixels of similar
amplitude, which noise and a few moving pixels do not change, and scored by what they leave.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from . import specs
from .decode import quartet_phasors
from .sequence import Sequence

# [1] real differential quads stay within a few hundredths of 0, unipolar ones are at 1
DC_TOLERANCE = 0.1
BINS = 12  # of amplitude, with equal numbers of pixels
QUARTETS_MAX = 8  # quartets, spread over the sequence: a hundred thousand pixels in small images
# [1] ratio of what two hypotheses leave: the data tells them apart by a factor of two or more
DECIDED = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class ConstantPart:
    """Constant part of quads over their amplitude, and what explains it."""

    zero: float
    """Additive zero that explains it best by itself [quad units], besides the one subtracted."""
    dc_offset: float
    """Multiple of the amplitude that explains it best by itself [1]."""
    left: float
    """Median of what the DC offset in use leaves, over the median amplitude [1]."""
    left_by_zero: float
    """The same of an additive zero alone [1]."""
    left_by_dc: float
    """The same of a DC offset alone [1]."""
    size: float
    """The same of the whole constant part [1]."""

    @property
    def is_explained(self) -> bool:
        """Whether the calibration in use explains it."""
        return self.left <= DC_TOLERANCE

    @property
    def is_zero(self) -> bool | None:
        """Whether an additive zero explains it better; None: both explain it equally well."""
        low, high = sorted((self.left_by_zero, self.left_by_dc))
        if high <= DC_TOLERANCE or low > DECIDED * high:
            return None
        return self.left_by_zero < self.left_by_dc

    def explained(self, left: float) -> float:
        """Share of the constant part that is explained if ``left`` is left [1]."""
        return max(0.0, 1.0 - left / self.size) if self.size > 0.0 else 1.0

    def advice(self, sequence: Sequence, form: str) -> str:
        """Which value of the calibration to change, and to what."""
        zero_at, dc_at = (specs.location(form, name) for name in ("adc_zero", "dc_offset"))
        zero = f"{zero_at} = {sequence.calibration.adc_zero + self.zero:.5g} and dc_offset 0"
        dc = f"{dc_at} = {self.dc_offset:.4g}"
        if self.is_zero is None:
            return f"state {zero}, or {dc}: amplitudes differ too little, or neither fits, to tell"
        return f"state {zero if self.is_zero else dc}"


def spread(quartets: list[int], most: int) -> list[int]:
    """At most so many quartets, evenly spread over all."""
    chosen = np.linspace(0, len(quartets) - 1, min(most, len(quartets))).round().astype(int)
    return [quartets[k] for k in chosen]


def constant_part(sequence: Sequence) -> ConstantPart:
    """Estimate the constant part of the quads of the complete quartets, for any shifts."""
    parts = [_of_quartet(sequence, i) for i in spread(sequence.complete_quartets, QUARTETS_MAX)]
    constant, amplitude = np.concatenate(parts, axis=1)
    bins = np.array_split(np.argsort(amplitude), BINS)
    middles = [(np.median(constant[b]), np.median(amplitude[b])) for b in bins if len(b)]
    c, a = np.array(middles).T
    tiny = np.finfo(np.float64).tiny
    typical = max(float(np.median(a)), tiny)
    # medians: a bright moving body spoils the brightest bins
    zero, dc_offset = float(np.median(c)), float(np.median(c / np.maximum(a, tiny)))

    def left(model: np.ndarray | float) -> float:
        return float(np.median(np.abs(c - model))) / typical

    return ConstantPart(
        zero=zero,
        dc_offset=dc_offset,
        left=left(sequence.calibration.dc_offset * a),
        left_by_zero=left(zero),
        left_by_dc=left(dc_offset * a),
        size=left(0.0),
    )


def without_constant(sequence: Sequence) -> Sequence:
    """The sequence without the constant part that its calibration does not explain, pixel by pixel
    and quartet by quartet: ambient light in a tap, which no phasor contains.

    Quads of incomplete quartets stay as they are.
    """
    quads, offset = sequence.quads.copy(), sequence.calibration.dc_offset
    for i in sequence.complete_quartets:
        for frames, (re, im) in quartet_phasors(sequence, i):
            constant = constant_of(sequence.quads[frames], sequence.shifts[frames])
            quads[frames] -= (constant - 0.5 * offset * np.hypot(re, im)).astype(np.float32)
    return replace(sequence, quads=quads)


def constant_of(
    quads: Float[np.ndarray, "Q H W"], shifts: Float[np.ndarray, "Q"]
) -> Float[np.ndarray, "H W"]:
    """What quads of one frequency have besides a wave over their shifts [rad], by least squares."""
    model = np.stack([np.cos(shifts), np.sin(shifts), np.ones(len(shifts))], axis=1)
    return np.tensordot(np.linalg.pinv(model)[2], quads.astype(np.float64), axes=1)


def _of_quartet(sequence: Sequence, i: int) -> Float[np.ndarray, "2 P"]:
    """Constant part and amplitude of every pixel and frequency of a quartet [quad units]."""
    columns = []
    for frames, (re, im) in quartet_phasors(sequence, i):
        constant = constant_of(sequence.quads[frames], sequence.shifts[frames])
        columns.append(np.stack([constant.ravel(), 0.5 * np.hypot(re, im).ravel()]))
    return np.concatenate(columns, axis=1)
