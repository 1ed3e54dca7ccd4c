"""The raw frames of one quartet along candidates of its motion, and the phasor that explains them
best in every pixel.

Slot k is read where a candidate says that the surface was at that time. Candidates are no motion,
optical flow, and translations of the whole image; opposite quads cancel along the right one. All
work is torch's, on the device of the images, a row of translations at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from ..data.flow import sample
from ..data.sequence import Sequence
from .measured import displaced

POOL = 5  # [px] side of the box over which squared residuals are averaged
# squared difference from the background over noise, from which a raw frame shows something else
DIFFERS = 4.0
RELATIVE = 0.1  # allowed share of the amplitude: phase and amplitude change during a quartet
# penalties of a flow: towards the background, and of a translation beside optical flow
TO_BACKGROUND, TRANSLATED = 4.0, 0.3
GAIN = 0.8  # a later candidate must have less than this share of the score
REACH = 0.08  # [width] largest translation during a quartet
STEPS = 6  # translations from the middle to the reach
OPPOSITE = -0.999  # cosine of the difference of two phase shifts that are half a turn apart


@dataclass(frozen=True, kw_only=True, eq=False)
class AlongFlow:
    """A quartet, decoded along the best candidate of every pixel."""

    flow: Float[Tensor, "2 h w"]
    """Displacement during the quartet [px]."""
    phasors: Float[Tensor, "f 2 h w"]
    """Phasors by least squares, at each frequency [quad units]."""
    residual: Float[Tensor, "h w"]
    """Mean squared residual over what is allowed [1]."""
    moves: Bool[Tensor, "h w"]
    """Whether the raw frames differ from the background as those of another surface do, see
    :attr:`Slots.differing`."""


@torch.no_grad()
def along_best(
    sequence: Sequence,
    quartet: int,
    images: Float[Tensor, "2 K h w"],
    box: tuple[slice, slice],
    noise: float,
) -> AlongFlow:
    """Decode a quartet along the best candidate of every pixel.

    Args:
        sequence: What was measured.
        quartet: Number of a complete quartet.
        images: Its quads, and their squared difference from the background over noise.
        box: Rows and columns of the image that these are.
        noise: Standard deviation of quads.
    """
    slots = Slots.of(sequence, quartet)
    best = _Best(images)
    for flow, along, penalty in _candidates(sequence, quartet, slots, images, box):
        phasors, squares = slots.phasors(along[0])
        allowed = noise**2 + RELATIVE**2 * 0.25 * phasors[:, :2].square().sum(dim=1)
        residual = _pooled(squares / allowed, POOL)
        moves = slots.moves(along[1] > DIFFERS).to(residual)
        score = residual + TO_BACKGROUND * (1.0 - moves) + penalty
        known = flow.expand(-1, -1, *residual.shape[1:]), phasors
        best.update(score, (*known, residual[:, None], moves[:, None]))
    chosen, decoded, residual, moves = best.images
    return AlongFlow(
        flow=chosen,
        phasors=decoded.unflatten(0, (-1, 2)),
        residual=residual[0],
        moves=moves[0] > 0,
    )


class _Best:
    """The images of the best candidate of every pixel."""

    def __init__(self, like: Tensor):
        self.images: tuple[Float[Tensor, "_ h w"], ...] = ()
        self._score = like.new_full(like.shape[2:], math.inf)

    def update(
        self, scores: Float[Tensor, "B h w"], images: tuple[Float[Tensor, "B _ h w"], ...]
    ) -> None:
        """Take the pixels in which candidates, one after the other, are clearly better."""
        chosen = torch.full(scores.shape[1:], -1, device=scores.device)
        for number, score in enumerate(scores):
            better = score < GAIN * self._score
            self._score = torch.where(better, score, self._score)
            chosen.masked_fill_(better, number)
        index, better = chosen.clamp_min(0), chosen >= 0
        new = [i.gather(0, index.expand(1, *i.shape[1:]))[0] for i in images]
        old = self.images or new
        pairs = zip(new, old, strict=True)
        self.images = tuple(torch.where(better, *pair) for pair in pairs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Slots:
    """Raw frames of a quartet: when they were taken, and the phasor that explains them best."""

    share: Float[np.ndarray, "K"]
    """Time from the middle of the quartet, in units of its duration; 0 if all have one time."""
    fit: Float[np.ndarray, "m K"]
    """Phasor of each frequency (re, im) by least squares from the quads."""
    rest: Float[np.ndarray, "free K"]
    """Orthonormal combinations of the quads that are zero for any phasors."""
    differing: Bool[np.ndarray, "g K"]
    """Alternatives of slots that differ from the background where another surface is: all but one,
    since its quad may be the same by chance; without a DC offset the opposite one is then, too. But
    consecutive slots alone differ where a surface leaves, arrives or passes quickly."""

    @property
    def decide(self) -> bool:
        """Whether one flow may explain the raw frames better than another: not those of three
        shifts, nor those that have one time, as those of a phasor.
        """
        return len(self.rest) > 0 and bool(self.share.any())

    @classmethod
    def of(cls, sequence: Sequence, quartet: int) -> Slots:
        """Those of a complete quartet."""
        frames = sequence.quartet_frames(quartet)
        times, shifts = sequence.times[frames], sequence.shifts[frames]
        duration = (times[-1] - times[0]) * len(times) / (len(times) - 1)
        constant = float(sequence.calibration.dc_offset) != 0.0
        fit: list[np.ndarray] = []
        rest: list[np.ndarray] = []
        for f in sequence.frequencies:
            mask = sequence.frame_frequencies[frames] == f
            columns = [np.cos(shifts[mask]), np.sin(shifts[mask])]
            if constant or mask.sum() == 3:
                columns.append(np.ones(mask.sum()))
            model = np.stack(columns, axis=1)
            left = np.linalg.svd(model)[0][:, model.shape[1] :]
            for rows, values in ((fit, 2.0 * np.linalg.pinv(model)[:2]), (rest, left.T)):
                rows.append(np.zeros((len(values), len(times)), np.float32))
                rows[-1][:, mask] = values
        at_once = sequence.from_phasors or duration == 0.0
        share = np.zeros(len(times)) if at_once else (times - times.mean()) / duration
        same = np.eye(len(times), dtype=bool)
        if not constant:
            frequencies = sequence.frame_frequencies[frames]
            apart = np.cos(shifts[:, None] - shifts)
            same |= (apart < OPPOSITE) & (frequencies[:, None] == frequencies)
        for k, others in enumerate(~same):
            if (np.diff(np.flatnonzero(others)) == 1).all():
                same[k] = np.arange(len(times)) == k
        return cls(share=share, fit=np.concatenate(fit), rest=np.concatenate(rest), differing=~same)

    def moves(self, differs: Bool[Tensor, "B K h w"]) -> Bool[Tensor, "B h w"]:
        """Whether all slots of an alternative of :attr:`differing` do."""
        moves = torch.zeros_like(differs[:, 0])
        for slots in np.unique(self.differing, axis=0):
            moves |= differs[:, np.flatnonzero(slots).tolist()].all(dim=1)
        return moves

    def phasors(
        self, quads: Float[Tensor, "B K h w"]
    ) -> tuple[Float[Tensor, "B m h w"], Float[Tensor, "B h w"]]:
        """Phasors by least squares, and the mean squared residual per degree of freedom, zero if
        there is none.
        """
        both = torch.as_tensor(np.concatenate([self.fit, self.rest]), device=quads.device)
        values = torch.einsum("mk,bkyx->bmyx", both, quads)
        squares = values[:, len(self.fit) :].square().sum(dim=1)
        return values[:, : len(self.fit)], squares / max(len(self.rest), 1)


def _candidates(
    sequence: Sequence,
    quartet: int,
    slots: Slots,
    images: Float[Tensor, "2 K h w"],
    box: tuple[slice, slice],
) -> Iterator[tuple[Float[Tensor, "B 2 _ _"], Float[Tensor, "2 B K h w"], float]]:
    """Batches of candidates: their displacements during a quartet [px] of what is there in its
    middle, the images along them, and the penalty of their score.

    No motion, optical flow between the starts of neighbouring quartets, then translations. No
    motion comes after optical flow if the raw frames fit every flow equally well.
    """
    still = images[0, :1].expand(2, -1, -1)[None] * 0.0
    flows = [
        torch.as_tensor(np.ascontiguousarray(flow[:, box[0], box[1]]), device=images.device)
        for flow in _optical_flows(sequence, quartet, slots)
    ]
    fields = torch.cat([still, *(flow[None] for flow in flows)])
    if not slots.decide:
        fields = fields.roll(-1, dims=0)
    yield fields, _along_fields(images, fields, slots.share), 0.0
    if slots.share.any():
        pitch = max(REACH * sequence.width / STEPS, 1.0)
        yield from _translations(images, slots.share, pitch)


def _optical_flows(
    sequence: Sequence, quartet: int, slots: Slots
) -> Iterator[Float[np.ndarray, "2 H W"]]:
    """Optical flow from and to the starts of a quartet and of the next one, as it is there in the
    middle, and as stored.
    """
    cycle, forward, backward = sequence.cycle, sequence.flow.forward, sequence.flow.backward
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
            yield sample(flow, flow, step - middle)
            yield flow


def _along_fields(
    images: Float[Tensor, "2 K h w"],
    fields: Float[Tensor, "B 2 h w"],
    share: Float[np.ndarray, "K"],
) -> Float[Tensor, "2 B K h w"]:
    """Images of every slot at x + share flow(x), bilinear, edges repeated."""
    along = []
    for k, s in enumerate(share.tolist()):
        image = images[:, k].expand(len(fields), -1, -1, -1)
        along.append(displaced(image, s * fields))
    return torch.stack(along, dim=2).transpose(0, 1).contiguous()


def _translations(
    images: Float[Tensor, "2 K h w"], share: Float[np.ndarray, "K"], pitch: float
) -> Iterator[tuple[Float[Tensor, "B 2 1 1"], Float[Tensor, "2 B K h w"], float]]:
    """Translations within ``STEPS`` steps of ``pitch`` pixels, a row of them at a time."""
    height, width = images.shape[2:]
    margin = math.ceil(float(np.abs(share).max()) * STEPS * pitch) + 1
    padded = pad(images, (margin,) * 4, mode="replicate")
    grid = range(-STEPS, STEPS + 1)
    rows = images.new_empty(2, len(share), height, width + 2 * margin)
    every = images.new_empty(2, len(grid), *images.shape[1:])  # overwritten by the next row
    for y in grid:
        for k, s in enumerate(share.tolist()):
            _shift(padded[:, k], s * pitch * y, margin, 1, out=rows[:, k])
        columns = [x for x in grid if 0 < math.hypot(x, y) <= STEPS + 0.5]
        along = every[:, : len(columns)]
        for b, x in enumerate(columns):
            for k, s in enumerate(share.tolist()):
                _shift(rows[:, k], s * pitch * x, margin, 2, out=along[:, b, k])
        steps = images.new_tensor([[pitch * x, pitch * y] for x in columns])
        yield steps[:, :, None, None], along, TRANSLATED


def _shift(image: Tensor, by: float, margin: int, dim: int, *, out: Tensor) -> None:
    """Write an image, padded by ``margin`` pixels along ``dim``, at x + by to ``out``."""
    first = math.floor(by)
    low, high = (image.narrow(dim, margin + first + i, out.shape[dim]) for i in (0, 1))
    torch.lerp(low, high, by - first, out=out)


def _pooled(images: Float[Tensor, "B h w"], side: int) -> Float[Tensor, "B h w"]:
    """Means over boxes of ``side`` pixels, edges repeated."""
    half = side // 2
    padded = pad(images[None], (half,) * 4, mode="replicate")[0]
    height, width = images.shape[1:]
    rows = sum(padded.narrow(1, i, height) for i in range(side))
    assert isinstance(rows, Tensor)
    both = sum(rows.narrow(2, i, width) for i in range(side))
    assert isinstance(both, Tensor)
    return both / side**2
