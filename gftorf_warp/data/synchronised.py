"""The raw frames of a cycle brought to one time by optical flow, before they are decoded: the
method ``flow2d`` (method, section 7).

Slot k was measured at t0 and, a cycle later, at t1. With F the optical flow from the first to the
second and B the one back, its image at t = t0 + s (t1 - t0) is made of both,

    the first, every pixel x at x + s F(x), with weight 1 - s
    the second, every pixel x at x + (1 - s) B(x), with weight s

by softmax splatting: a pixel is shared by the four around its target, with weight exp(z), z =
-``MISMATCH`` times the brightness by which it differs from what its flow leads to, and every target
is divided by the sum of its weights. Flow is known where forward and backward flow agree. Where
they do not, a pixel is covered in one of the two images: it moves with the median flow of its image
and counts only where nothing of known flow arrives. Pixels where nothing at all arrives keep the
nearer image.

The brightness of a quad changes with distance and incidence of light, of which optical flow knows
nothing: motion along the rays is where this fails.

Where a recording has the sums of both taps, which have no phase, any two raw frames can be matched.
Then F and B lead to the raw frame nearest to t, at most a cycle away, and a pixel is moved by the
share of it that lies between its own time and t.

Where flow is wrong, the slots of a pixel see different surfaces. Of one frequency that is an error
of centimetres; of several, their phases disagree and may decode to a distance some metres away. So
a pixel whose phases agree less than those of the nearest quartet keeps what was measured there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError
from . import flow as optical_flow
from .decode import decode_quartet
from .flow import Method, compute_flow, flow_between, sample
from .kept import kept
from .sequence import Flow, Sequence
from .temporal import nearest_quartet, one_quartet

MISMATCH = 20.0  # [1] per brightness range of the image: half a grey level of sixteen costs a half
COVERED = 1e-3  # [1] weight of pixels of unknown flow: any pixel of known flow outweighs it
LEAST = 1e-12  # [1] a target with less weight got nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Synchronised:
    """A cycle as if all of its raw frames were of one instant."""

    sequence: Sequence
    """One quartet of K raw frames, all with the time and the pose of that instant."""
    filled: Bool[np.ndarray, "K H W"]
    """Where a pixel of known flow arrived; elsewhere the value is a guess."""


def synchronised(sequence: Sequence, time: float, method: Method = "dis") -> Synchronised:
    """All slots of the cycle at a time [s], at most those of the first and the last raw frame.

    The pose is that of the raw frame nearest to the time: optical flow contains the motion of the
    camera. Beyond the two measurements of a slot its motion is continued.

    Args:
        sequence: What was measured, see :func:`check_flow`.
        time: Seconds since raw frame 0.
        method: Of the optical flow, ``dis`` or ``deepflow``.
    """
    check_flow(sequence)
    first = sequence.complete_quartets[0] * sequence.cycle
    time = float(np.clip(time, sequence.times[0], sequence.times[-1]))
    images = [slot_at(sequence, first + k, time, method) for k in range(sequence.cycle)]
    one = one_quartet(sequence, np.stack([image for image, _ in images]), first)
    if len(sequence.frequencies) > 1:
        one = _consistent(one, sequence, nearest_quartet(sequence, time))
    nearest = int(np.abs(sequence.times - time).argmin())
    one = replace(
        one,
        times=np.full(sequence.cycle, time),
        camera_from_world=np.repeat(
            sequence.camera_from_world[nearest : nearest + 1], sequence.cycle, 0
        ),
    )
    return Synchronised(sequence=one, filled=np.stack([filled for _, filled in images]))


def _consistent(one: Sequence, measured: Sequence, quartet: int) -> Sequence:
    """One quartet of several frequencies with its quads, or those of a measured quartet in pixels
    whose phases agree better there.
    """
    ours, theirs = decode_quartet(one, 0).confidence, decode_quartet(measured, quartet).confidence
    assert ours is not None, "there are several frequencies"
    assert theirs is not None, "there are several frequencies"
    frames = measured.quartet_frames(quartet)
    return replace(one, quads=np.where(theirs > ours, measured.quads[frames], one.quads))


def unfilled_share(sequence: Sequence, method: Method = "dis") -> float:
    """Share of pixels of all slots [1] where optical flow brings nothing, at all raw frames."""
    measured = sequence.times[sequence.measured]
    return float(np.mean([~synchronised(sequence, t, method).filled for t in measured]))


def check_flow(sequence: Sequence) -> None:
    """Refuse what cannot be synchronised.

    Raises:
        InputError: If the recording has phasors, no complete quartet, no slot that was measured
            twice in a row, or images too small to match.
    """
    where, fix = sequence.path or "sequence", "use --preset ctof, the closed form of every quartet"
    if sequence.from_phasors:
        why = "the camera delivered phasors, each of one instant: nothing is left to synchronise"
        raise InputError("no raw frames", where=where, why=why, fix=fix)
    if not sequence.complete_quartets:
        why = "expected all raw frames of a cycle in a row, at least once"
        fix = "check the sequence with `gftorf check`, or record longer"
        raise InputError("no complete quartet", where=where, why=why, fix=fix)
    if not has_tap_sums(sequence) and not pairs_of(sequence):
        why = "expected two raw frames one cycle apart, found none that were both measured"
        raise InputError("no optical flow", where=where, why=why, fix=fix)
    optical_flow.check_size(sequence)


def has_tap_sums(sequence: Sequence) -> bool:
    """Whether the sum of both taps is known of all measured raw frames."""
    measured = np.flatnonzero(sequence.measured).tolist()
    return len(measured) > 1 and sequence.tap_sums.keys() >= {*measured}


@kept
def flow_of_frames(sequence: Sequence, method: Method) -> Flow:
    """Optical flow of every raw frame whose partner a cycle away was measured too."""
    return compute_flow(sequence, method=method, every=1)


def pairs_of(sequence: Sequence) -> list[int]:
    """Raw frames n for which n and n + K were measured."""
    step = sequence.cycle
    return np.flatnonzero(sequence.measured[:-step] & sequence.measured[step:]).tolist()


class Source(NamedTuple):
    """A measurement of a slot, and how it gets to the time of an image."""

    quad: Float[np.ndarray, "H W"]
    """What was measured."""
    before: Float[np.ndarray, "H W"]
    """The image in which its flow begins."""
    after: Float[np.ndarray, "H W"]
    """The image in which it ends."""
    flow: Float[np.ndarray, "2 H W"]
    """Flow between them [px]; NaN: unknown."""
    moved: float
    """How much of it a pixel moves [1]."""
    counts: float
    """Weight in the image [1]."""


def slot_at(
    sequence: Sequence, slot: int, time: float, method: Method
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Image of one slot at a time [s] and where it was filled.

    Args:
        sequence: What was measured.
        slot: Any raw frame of the slot.
        time: Seconds since raw frame 0.
        method: Of the optical flow.
    """
    find = _by_taps if has_tap_sums(sequence) else _by_quads
    sources = find(sequence, slot, time, method)
    size = sequence.quads.shape[1:]
    total, weight, filled = np.zeros(size), np.zeros(size), np.zeros(size, dtype=bool)
    for source in sources:
        known, flow = _known(source.flow)
        importance = np.exp(-MISMATCH * _mismatch(source.before, source.after, flow))
        importance *= np.where(known, 1.0, COVERED)
        summed, arrived, reliable = splatted(
            np.stack([importance * source.quad, importance, known.astype(np.float64)]),
            source.moved * flow,
        )
        total += source.counts * summed
        weight += source.counts * arrived
        filled |= reliable > 0.5  # of a pixel
    measured = np.flatnonzero(sequence.measured[slot % sequence.cycle :: sequence.cycle])
    measured = measured * sequence.cycle + slot % sequence.cycle
    nearest = sequence.quads[measured[np.abs(sequence.times[measured] - time).argmin()]]
    image = np.where(weight > LEAST, total / np.maximum(weight, LEAST), nearest)
    return image.astype(np.float32), filled


def _by_quads(sequence: Sequence, slot: int, time: float, method: Method) -> list[Source]:
    """The measurements before and after a time, each with its flow to the other."""
    step, times, quads = sequence.cycle, sequence.times, sequence.quads
    pairs = [n for n in pairs_of(sequence) if (n - slot) % step == 0]
    if not pairs:
        return []
    flow = flow_of_frames(sequence, method)

    def away(n: int) -> float:
        return max(times[n] - time, time - times[n + step], 0.0)

    n = min(pairs, key=away)
    m, share = n + step, float((time - times[n]) / (times[n + step] - times[n]))
    sources = [
        Source(quads[n], quads[n], quads[m], flow.forward[n], share, 1.0 - share),
        Source(quads[m], quads[m], quads[n], flow.backward[m], 1.0 - share, share),
    ]
    return [source for source in sources if source.counts > 0.0]  # beyond a pair, the nearer alone


def _by_taps(sequence: Sequence, slot: int, time: float, method: Method) -> list[Source]:
    """The same with the flow of tap sums to the raw frame nearest to the time."""
    times, sums = sequence.times, sequence.tap_sums
    of_slot = [n for n in sorted(sums) if (n - slot) % sequence.cycle == 0]
    before = [n for n in of_slot if times[n] <= time][-1:]
    after = [n for n in of_slot if times[n] > time][:1]
    apart = sum(times[n] for n in after) - sum(times[n] for n in before)
    sources = []
    for n in before + after:
        counts = 1.0 - abs(time - times[n]) / apart if before and after else 1.0
        others = [m for m in sums if times[m] != times[n]]
        m = min(others, key=lambda m: abs(times[m] - time))
        moved = float((time - times[n]) / (times[m] - times[n]))
        there = (
            flow_between(sums[n], sums[m], method=method)
            if moved != 0.0
            else np.zeros((2, *sums[n].shape), dtype=np.float32)
        )
        sources.append(Source(sequence.quads[n], sums[n], sums[m], there, moved, counts))
    return [source for source in sources if source.counts > 0.0]


def splatted(
    images: Float[np.ndarray, "C H W"], flow: Float[np.ndarray, "2 H W"]
) -> Float[np.ndarray, "C H W"]:
    """Sums of what arrives at every pixel when pixels move by ``flow`` [px], each shared by the
    four pixels around its target.
    """
    height, width = flow.shape[1:]
    y, x = np.indices((height, width))
    x, y = x + flow[0], y + flow[1]
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    result = np.zeros((len(images), height * width))
    for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - right - (x - left)) * np.abs(1 - below - (y - top))
        column, row = left + right, top + below
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        target = row[inside] * width + column[inside]
        for k, image in enumerate(images):
            result[k] += np.bincount(target, (share * image)[inside], minlength=height * width)
    return result.reshape(len(images), height, width)


def _known(flow: Float[np.ndarray, "2 H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Where a flow is known, and the flow with its median [px] where it is not."""
    known = np.isfinite(flow).all(axis=0)
    usual = np.median(flow[:, known], axis=1) if known.any() else np.zeros(2)
    return known, np.where(known, flow, usual[:, None, None])


def _mismatch(
    source: Float[np.ndarray, "H W"],
    target: Float[np.ndarray, "H W"],
    flow: Float[np.ndarray, "2 H W"],
) -> Float[np.ndarray, "H W"]:
    """Difference of the source to the target at the end of its flow, over the range of both [1]."""
    low, high = optical_flow.brightness_range(source, target)
    sampled = sample(target[None], flow.astype(np.float32))[0].astype(np.float64)
    return np.abs(sampled - source) / (high - low) if high > low else np.zeros(source.shape)
