"""The quadrature component of a rendered phasor, corrected by raw frames before and after it.

A raw frame measures one component of the phasor, in phase with its shift. Those of other shifts
measure the other one, in quadrature, but of surfaces that moved on. So the Gaussians of its quartet
are rendered at their times, and what they fail to explain there is moved back with its surface and
interpolated in time: where outlines of the Gaussians are a little wrong, they are so in all these
raw frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..scene.measured import displaced, frame_period
from .other_frames import FLOW_WEIGHT_MIN
from .phasors import MeasuredPhasors

TURNED = 0.7  # [1] sine between the shifts of two raw frames, from which one tells of the other
FLOW_SIDE = 5  # [px] side of the box over which the velocity of a surface is averaged


def quadrature_residual(
    measured: MeasuredPhasors,
    n: int,
    frames: list[int],
    phasor: Float[Tensor, "3 H W"],
    rendered: Callable[[float], Float[Tensor, "3 H W"]],
    moving: Float[Tensor, "3 H W"],
) -> Float[Tensor, "H W"] | None:
    """How much too small the component in quadrature with the shift of a raw frame is rendered
    [quad units].

    Args:
        measured: What a sequence tells.
        n: Number of the raw frame.
        frames: Numbers of the other raw frames that may be used, in order.
        phasor: Phasor and amplitude as rendered for raw frame n [quad units].
        rendered: The same of its Gaussians so many raw frames later.
        moving: Weight of moving Gaussians [1], and their velocity (x, y) times it [px per raw
            frame].

    Returns:
        None if no raw frame tells it, or with a DC offset, since a quad is no component then.
    """
    sequence = measured.sequence
    if sequence.calibration.dc_offset != 0.0:
        return None
    turns = {m: float(sequence.shifts[m] - sequence.shifts[n]) for m in frames}
    telling = [m for m in frames if abs(math.sin(turns[m])) > TURNED]
    before, after = [m for m in telling if m < n], [m for m in telling if m > n]
    nearest = before[-1:] + after[:1]
    if not nearest:
        return None

    weight, *flow = avg_pool2d(moving, FLOW_SIDE, 1, FLOW_SIDE // 2, count_include_pad=False)
    velocity = torch.stack(flow) / weight.clamp_min(FLOW_WEIGHT_MIN)
    in_phase = measured.residual(phasor[0], phasor[1], n)
    times = [float(sequence.times[m] - sequence.times[n]) for m in nearest]
    result = torch.zeros_like(in_phase)
    for m, time in zip(nearest, times, strict=True):
        later = time / frame_period(sequence)
        re, im, _ = rendered(later)
        there = measured.residual(re, im, m)
        back = displaced(there[None, None], later * velocity[None])[0, 0]
        share = 1.0 if len(times) == 1 else 1.0 - abs(time) / (times[1] - times[0])
        result += share * (back - math.cos(turns[m]) * in_phase) / math.sin(turns[m])
    return result
