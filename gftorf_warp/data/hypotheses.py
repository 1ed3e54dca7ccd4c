"""Hypotheses about the order and sign of the phase shifts, ranked without ground truth.

Each is another assignment of the recorded shifts to the raw frames of a cycle. Two measures rank
them: how much of the quads no cosine explains, which is noise and motion if opposite shifts are
paired rightly (four shifts or more), and the fall-off of the amplitude (falloff.py), which tells
the phase itself from its mirror image and from a quarter turn.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from ..constants import FRAMES_PER_QUARTET
from . import specs
from .constant import spread
from .cycles import solution
from .decode import distance_from_phase
from .falloff import LENIENT, Pairs, pairs_of
from .sequence import Sequence
from .temporal import camera_rests

ALL_ORDERS = 4  # shifts of one frequency of which all orders are tried; of more, slips and mirrors
MEDIAN_OF = 24  # quartets of a camera at rest, spread over the sequence, whose median is taken
MOVING_QUARTETS = 4  # quartets of a moving camera
BRIGHT = 0.5  # share of the pixels, the darker, that say nothing about pairs of shifts
OFFSETS = 72  # phase offsets that are tried: every five degrees
# [1] of the amplitude: what a wrong pair leaves more than the right one; noise of bright pixels and
# motion leave the same in both
PAIRED = 0.1
# [1] of the measure of falloff.py, of what is stated over that of a hypothesis. Mirrored: 91 right
# recordings had -0.02 or less, and 0.03 or more once mirrored. Turned by a part of a turn: a ball
# that fills the image had 0.14, all other right recordings 0.07 or less
MIRRORED_GAIN, TURNED_GAIN = 0.015, 0.15
# [1] of that measure: right orders had 0.98 or less; above, a hypothesis explains nothing itself,
# as where surfaces wrap
EXPLAINS = 0.99


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """An assignment of shifts to the raw frames of a cycle at its first frequency."""

    order: tuple[int, ...]
    """Raw frame k has the stated shift of raw frame ``order[k]``."""
    shifts: Float[np.ndarray, "k"]
    """Its shifts [rad]."""
    unexplained: float
    """Median over bright pixels of what no cosine explains, over the amplitude [1]."""
    falloff: float
    """Measure of falloff.py, 1 if it says nothing."""
    lenient: float
    """The same with more exponents, for what is stated."""
    mirrored: bool
    """Whether its phases are those of the stated order with the other sign, turned or not."""
    distance: Float[np.ndarray, "H W"]
    """Closed form [m] of one instant."""

    @property
    def score(self) -> float:
        """Lower is better."""
        return self.falloff + min(self.unexplained, 1.0)

    @property
    def degrees(self) -> str:
        """Shifts in time order, for messages."""
        return ", ".join(f"{d:.0f}" for d in np.degrees(self.shifts) % 360.0)

    @property
    def evidence(self) -> str:
        """Both measures, for messages."""
        return f"{self.unexplained:.0%} unexplained, fall-off {self.falloff:.3f}"

    def option(self, sequence: Sequence, form: str) -> str:
        """What to state instead, if the hypothesis is right."""
        if sequence.from_phasors:
            return f"re and im of the phasors belong to shifts {self.degrees} degrees"
        degrees = f"{self.degrees} degrees in turn"
        if form == "ftorf":
            turns = np.round(2.0 * self.shifts / math.pi).astype(int) % FRAMES_PER_QUARTET
            channel = np.array([0, 2, 1, 3])[turns]  # of a shift of 0, 90, 180, 270 degrees
            stated = specs.location(form, "permutation")
            return f"{stated} = {np.argsort(channel).tolist()}, {degrees}"
        return f"{specs.location(form, 'shift')}, {degrees}"

    def beats(self, stated: Hypothesis) -> bool:
        """Whether the evidence for it, instead of what is stated, is more than noise."""
        if stated.unexplained - self.unexplained > PAIRED:
            return True
        gain = stated.lenient - self.falloff
        as_paired = self.unexplained - stated.unexplained < PAIRED
        enough = gain > (MIRRORED_GAIN if self.mirrored else TURNED_GAIN)
        return as_paired and enough and self.falloff < EXPLAINS


def hypotheses(sequence: Sequence) -> list[Hypothesis]:
    """All hypotheses, that of the recording first, then the others, best first."""
    slots = _slots(sequence)
    stated, images = sequence.shifts[slots], _instants(sequence, slots)
    judged = [_judged(sequence, images, stated, order) for order in _orders(len(slots))]
    return [judged[0], *sorted(judged[1:], key=lambda one: one.score)]


def stated_pairs(sequence: Sequence) -> Pairs | None:
    """Pairs of neighbours with the stated order; None if there are too few."""
    slots = _slots(sequence)
    return pairs_of([_phasor(q, sequence.shifts[slots]) for q in _instants(sequence, slots)])


def offset_by_falloff(sequence: Sequence) -> tuple[float, float, float] | None:
    """Phase offset [rad] at which the amplitude falls best with distance, its measure, and that of
    the offset in use; None if there are too few pixels.
    """
    pairs, used = stated_pairs(sequence), sequence.calibration.phase_offset
    if pairs is None:
        return None
    offsets = used + 2.0 * math.pi * np.arange(OFFSETS) / OFFSETS
    measures = [pairs.measure(float(offset)) for offset in offsets]
    best = int(np.argmin(measures))
    nearest = math.remainder(offsets[best], 2.0 * math.pi)
    return nearest, measures[best], pairs.measure(used, LENIENT)


def _slots(sequence: Sequence) -> np.ndarray:
    """Raw frames of a cycle at its first frequency."""
    first = sequence.cycle * sequence.complete_quartets[0]
    frequencies = sequence.frame_frequencies[first : first + sequence.cycle]
    return np.flatnonzero(frequencies == sequence.frequencies[0])


def _instants(sequence: Sequence, slots: np.ndarray) -> list[Float[np.ndarray, "k H W"]]:
    """Quads of these raw frames of a cycle: their median over time, of a moving camera those of a
    few quartets.
    """
    most = MEDIAN_OF if camera_rests(sequence) else MOVING_QUARTETS
    chosen = spread(sequence.complete_quartets, most)
    quads = [sequence.quads[sequence.cycle * i + slots].astype(np.float64) for i in chosen]
    return [np.median(quads, axis=0)] if camera_rests(sequence) else quads


def _orders(count: int) -> list[tuple[int, ...]]:
    """Assignments to try, the stated one first."""
    same = tuple(range(count))
    if count <= ALL_ORDERS:
        return list(itertools.permutations(same))
    slips = [same[k:] + same[:k] for k in range(count)]
    return slips + [slip[::-1] for slip in slips]


def _phasor(
    quads: Float[np.ndarray, "k H W"], shifts: Float[np.ndarray, "k"]
) -> Complex[np.ndarray, "H W"]:
    rows = solution(shifts)
    assert rows is not None, "checked by complete_quartets and decode"
    re, im = np.tensordot(rows, quads, axes=1)
    return re + 1j * im


def _judged(
    sequence: Sequence,
    instants: list[Float[np.ndarray, "k H W"]],
    stated: Float[np.ndarray, "k"],
    order: tuple[int, ...],
) -> Hypothesis:
    shifts = stated[list(order)]
    phasors = [_phasor(quads, shifts) for quads in instants]
    left = [_unexplained(quads, z, shifts) for quads, z in zip(instants, phasors, strict=True)]
    pairs: Pairs | None = pairs_of(phasors)
    offset = sequence.calibration.phase_offset
    frequency = sequence.frequencies[0]
    return Hypothesis(
        order=order,
        shifts=shifts,
        unexplained=float(np.median(left)),
        falloff=1.0 if pairs is None else pairs.measure(offset),
        lenient=1.0 if pairs is None else pairs.measure(offset, LENIENT),
        mirrored=_mirrored(phasors[0], _phasor(instants[0], stated)),
        distance=distance_from_phase(np.angle(phasors[len(phasors) // 2]), sequence, frequency),
    )


def _mirrored(phasor: Complex[np.ndarray, "H W"], stated: Complex[np.ndarray, "H W"]) -> bool:
    """Whether the phases of one follow those of the other backwards."""
    return bool(abs((phasor * stated).sum()) > abs((phasor * stated.conj()).sum()))


def _unexplained(
    quads: Float[np.ndarray, "k H W"],
    phasor: Complex[np.ndarray, "H W"],
    shifts: Float[np.ndarray, "k"],
) -> float:
    """Median over bright pixels of the RMS that a cosine and a constant leave, over amplitude."""
    wave = 0.5 * (phasor * np.exp(-1j * shifts[:, None, None])).real
    rest = quads - wave
    rms = np.sqrt(np.square(rest - rest.mean(axis=0)).mean(axis=0))
    # of all orders the same pixels: the spread of the quads does not depend on their order
    light = quads.std(axis=0)
    bright = light >= np.quantile(light, BRIGHT)
    return float(np.median((rms / np.maximum(light, np.finfo(np.float64).tiny))[bright]))
