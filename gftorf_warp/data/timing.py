"""Findings of ``gftorf check`` in the order of raw frames: units of time, gaps, jitter, repeats."""

from __future__ import annotations

import hashlib
import itertools

import numpy as np

from .decode import quartet_phasor
from .report import Report
from .sequence import Sequence

# [s] between raw frames: recordings of motion have 2 to 20 000 a second
INTERVALS_S = (5e-5, 0.5)
DROPPED = 1.5  # intervals that are missing at least half a raw frame
# [1] of the interval: what moves is misplaced by as much of its way between two raw frames
JITTER = 0.05
# [1] of the raw frames: more repeats than this are a scene at rest without noise
REPEATED_SHARE = 0.34
# [1] change of the phasor over its length that the median bright pixel has: a slip by one shift
# turns all phasors by 60 degrees or more, a moving body covers less than half of the image
SLIP, SLIP_OVER_TYPICAL = 0.5, 5.0
USUAL = 0.25  # quantile of the changes: one slip makes two of them large, even of four
SHOWN = 6  # numbers in a message


def time_unit(sequence: Sequence, report: Report) -> None:
    """Interval of raw frames that is no interval of a recording."""
    steps = np.diff(np.unique(sequence.times))
    if not len(steps):
        return
    low, high = INTERVALS_S
    interval = float(np.median(steps))
    if low <= interval <= high:
        return
    unit, factor = ("milliseconds", 1e3) if interval > high else ("kiloseconds", 1e-3)
    for unit_below, further in (("microseconds", 1e6), ("nanoseconds", 1e9)):
        if interval / factor > high:
            unit, factor = unit_below, further
    report.warn(
        "time unit",
        f"raw frames are {interval:.4g} s apart, recordings of motion {low:g} to {high:g} s: times "
        f"in {unit}? then multiply them by {1 / factor:g}",
    )


def exposure(sequence: Sequence, report: Report) -> None:
    """Exposures longer than the interval of raw frames."""
    steps = np.diff(sequence.times)
    if sequence.exposures is None or not len(steps) or not steps.min() > 0.0:
        return
    longest, interval = float(sequence.exposures.max()), float(np.median(steps))
    if longest > interval:
        report.warn(
            "exposure",
            f"an exposure of {longest:.4g} s does not fit into {interval:.4g} s from one raw frame "
            "to the next: milliseconds, or times in another unit?",
        )


def gaps(sequence: Sequence, report: Report) -> None:
    """Missing raw frames and irregular times, by the times."""
    steps, cycle = np.diff(sequence.times), sequence.cycle
    if len(steps) < 2 * cycle - 1:  # less than two cycles, of which nothing repeats
        steps, cycle = np.diff(np.unique(sequence.times)), 1
    if len(steps) < 3 or not (steps > 0.0).any():
        return
    # the interval may depend on the slot of a cycle, whose raw frames may also share their time
    of_slots = [np.quantile(steps[k::cycle], 0.5, method="lower") for k in range(cycle)]
    usual = np.resize(of_slots, len(steps))
    typical = float(np.median(steps[steps > 0.0]))
    late = np.flatnonzero(steps - usual > (DROPPED - 1.0) * typical)
    if len(late):
        report.warn(
            "frame drops",
            f"{len(late)} intervals are {DROPPED:g} times as long as usual or more, after raw "
            f"frame {_shown(late)}: if raw frames are missing, state them as not measured, or "
            "their shifts are those of others",
        )
    others = np.maximum(steps, usual) > 0.0
    others[late] = False
    apart = np.square((steps - usual)[others])
    jitter = float(np.sqrt(apart.mean())) / typical if len(apart) else 0.0
    if jitter > JITTER:
        report.warn(
            "trigger jitter",
            f"intervals vary by {jitter:.0%} (rms): if that is the clock of the computer and not "
            "that of the camera, state evenly spaced times",
        )


def repeats(sequence: Sequence, report: Report) -> None:
    """Raw frames that equal an earlier one in every bit."""
    frames = np.flatnonzero(sequence.measured).tolist()
    seen: dict[bytes, int] = {}
    again = []
    for n in frames:
        digest = hashlib.sha256(sequence.quads[n].tobytes()).digest()
        if digest in seen and sequence.quads[n].any():
            again.append((n, seen[digest]))
        seen.setdefault(digest, n)
    if not again or len(again) > REPEATED_SHARE * len(frames):
        return
    pairs = ", ".join(f"{n} = {first}" for n, first in again[:SHOWN])
    report.warn(
        "repeated frame",
        f"{len(again)} raw frames equal an earlier one in every bit: {pairs}"
        f"{' ..' if len(again) > SHOWN else ''}; noise does not repeat: state them as not measured",
    )


def slip(sequence: Sequence, report: Report) -> None:
    """Moment at which most of the image changes at once: shifts slipped by a raw frame."""
    quartets = sequence.complete_quartets
    if len(quartets) < 4:
        return
    changes = np.array([_change(sequence, i, j) for i, j in itertools.pairwise(quartets)])
    typical = float(np.quantile(changes, USUAL))
    sudden = np.flatnonzero((changes > SLIP) & (changes > SLIP_OVER_TYPICAL * typical))
    if len(sudden):
        first = sequence.cycle * quartets[int(sudden[0]) + 1]
        report.warn(
            "slip",
            f"from raw frame {first - sequence.cycle} to {first} the phasor of the median bright "
            f"pixel changes by {changes[sudden[0]]:.0%}, usually by {typical:.0%}: a raw frame was "
            "lost there and the shifts of all later ones slipped, or settings changed",
        )


def _change(sequence: Sequence, i: int, j: int) -> float:
    """Median change of the phasor over its length, from quartet i to j."""
    before, after = quartet_phasor(sequence, i), quartet_phasor(sequence, j)
    length = np.hypot(*before)
    bright = length >= np.median(length)
    change = np.hypot(*(after - before)) / np.maximum(length, np.finfo(np.float64).tiny)
    return float(np.median(change[bright]))


def _shown(numbers: np.ndarray) -> str:
    return ", ".join(map(str, numbers[:SHOWN].tolist())) + (" .." if len(numbers) > SHOWN else "")
