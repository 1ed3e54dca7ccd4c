"""What other raw frames tell of a moving outline in a mixed pixel.

The outline of a moving surface in front is in other pixels at other times: some raw frames before
and after. Its velocity across itself is known from the rendered flow of the Gaussians and from the
slope of the rendered distance, and so is what it covers, from the static layer rendered alone. So
its position in a pixel, and with it the share s of the pixel's area that the first of two surfaces
covers (outlines.py), says what every other raw frame should have measured along the line across
the outline: in a pixel of which the surface in front covers the share c, and the strip of it that
is within a pixel of its outline the share w,

    quad = (c - w + g w) quad of the surface in front + (1 - c) quad of what is behind

with the unknown gain g of outlines.py, here normal about each of its values. In every raw frame,
the three pixels nearest to the outline are compared. All of them share the errors of one velocity
and of two amplitudes, and the nearest ones are used a second time by quadrature.py: so these are
wide, positions are the less certain the longer the time between, and only a part of the logarithm
of the likelihood counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from ..scene.sensor import Sensor, quad_from_phasor
from .straight import Outline

SPAN = 3  # [raw frames] before and after that are compared
NEAREST = (-1, 0, 1)  # [steps across] pixels beside the one that the outline is in
WEIGHT = 0.3  # [1] of the logarithm of the likelihood that counts
FRONT_SPREAD = 0.3  # [1] standard deviation of the amplitude in front, relative
BACK_SPREAD = 0.3  # [1] the same of what is behind
DRIFT = 0.1  # [steps across per raw frame] standard deviation of the velocity of an outline
GAIN_SPREAD = 0.6  # [1] standard deviation about each gain of outlines.py, relative
MODEL_ERROR = 0.01  # [1] of a quad, of the larger one of both amplitudes
MOVING = 0.5  # [1] weight of moving Gaussians above which a surface moves
FLOW_WEIGHT_MIN = 0.05  # [1] flow is divided by the weight of moving Gaussians, at least by this
SOLID = 0.9  # [1] opacity of the static layer above which it is known what is behind
FACING = 0.5  # [1] cosine between the normal of an outline and the line across it, at least
FASTEST = 4.0  # [steps across per raw frame] outlines that are faster are left out
SLOPE_MIN = 1e-9  # [m/px], [1] instead of a division by zero
CORNER_MIN = 1e-6  # [1] likewise


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherFrames:
    """What other raw frames measured of outlines that pass through one raw frame."""

    quads: Float[Tensor, "M H W"]
    """Of M other raw frames [quad units]."""
    variance: Float[Tensor, "M H W"]
    """Of their noise [quad units^2]."""
    shifts: Float[Tensor, "M"]
    """Their phase shifts [rad]."""
    later: Float[Tensor, "M"]
    """How much later they were taken [raw frames]; negative: earlier."""
    moving: Float[Tensor, "H W"]
    """Weight of moving Gaussians [1], rendered at the time of the raw frame."""
    flow: Float[Tensor, "2 H W"]
    """Velocity (x, y) of moving Gaussians in the image, times their weight [px per raw frame]."""
    behind: Complex[Tensor, "H W"]
    """Phasor of the static layer alone, of length 2a [quad units]."""
    opacity: Float[Tensor, "H W"]
    """Of the static layer alone [1]."""
    normals: Float[Tensor, "2 H W"]
    """Unit vectors (x, y) across outlines, see :func:`normals_of`."""
    quadrature: Float[Tensor, "H W"] | None = None
    """How much too small the component in quadrature with the shift of the raw frame is rendered
    [quad units], see quadrature.py; None: unknown."""


def normals_of(distance: Float[Tensor, "H W"]) -> Float[Tensor, "2 H W"]:
    """Unit vectors (x, y) along the slope of a rendered distance, by Sobel's filter: those of one
    that outlines.py has resolved would be of an outline in whole pixels.
    """
    padded = torch.nn.functional.pad(distance[None, None], (1, 1, 1, 1), mode="replicate")
    smooth, slope = distance.new_tensor([[1.0, 2.0, 1.0], [-1.0, 0.0, 1.0]])
    filters = torch.stack([smooth[:, None] * slope, slope[:, None] * smooth])
    gradient = torch.nn.functional.conv2d(padded, filters[:, None])[0]
    return gradient / gradient.norm(dim=0).clamp_min(SLOPE_MIN)


def log_likelihood(
    others: OtherFrames,
    outline: Outline,
    amplitudes: tuple[Float[Tensor, "P"], Float[Tensor, "P"]],
    gains: Float[Tensor, "g"],
    shares: Float[Tensor, "s"],
    sensor: Sensor,
) -> Float[Tensor, "g s P"]:
    """Logarithm of the likelihood of each gain and share, which is one in the mean over them, and
    everywhere in pixels where no outline of a moving surface is followed.

    Args:
        others: What other raw frames measured.
        outline: Mixed pixels.
        amplitudes: Of the phasors of the first and second surface, without gain [quad units].
        gains: Of the strip of the surface in front beside its outline [1].
        shares: Of the first surface [1].
        sensor: Whose first frequency is that of the quads.
    """
    result = outline.first.new_zeros(len(gains), len(shares), len(outline.first))
    index, moving = _moving(others, outline, amplitudes, sensor)
    if not len(index):
        return result
    samples = _sampled(others, moving, outline)
    likelihood = _of_gains_and_shares(others, moving, samples, gains, shares, sensor)
    mean = likelihood.flatten(0, 1).logsumexp(dim=0) - math.log(len(gains) * len(shares))
    result[:, :, index] = likelihood - mean
    return result


class _Moving(NamedTuple):
    """P mixed pixels at outlines of moving surfaces in front."""

    row: Int[Tensor, "P"]
    """Of the pixel."""
    column: Int[Tensor, "P"]
    """Of the pixel."""
    first: Bool[Tensor, "P"]
    """Whether the first surface is in front."""
    normal: Float[Tensor, "2 P"]
    """Of the outline, absolute values of x and y [1]."""
    facing: Float[Tensor, "P"]
    """How far one step across goes along the normal [px]."""
    velocity: Float[Tensor, "P"]
    """Of the outline [steps across per raw frame]."""
    front: Complex[Tensor, "P"]
    """Phasor of the surface in front, without gain [quad units]."""
    back: Complex[Tensor, "P"]
    """Phasor of the one behind it, as the neighbours show it [quad units]."""
    still: Bool[Tensor, "P"]
    """Whether the one behind does not move."""


def _moving(
    others: OtherFrames,
    outline: Outline,
    amplitudes: tuple[Float[Tensor, "P"], Float[Tensor, "P"]],
    sensor: Sensor,
) -> tuple[Int[Tensor, "m"], _Moving]:
    """Which of P pixels are at outlines that can be followed, and what is known of them."""
    first = outline.first < outline.second
    weight, x, y = _beside(torch.cat([others.moving[None], others.flow]), outline, first)
    weight_behind = _beside(others.moving[None], outline, ~first)[0]
    row, column = outline.pixels
    normal = others.normals[:, row, column]
    down, right = outline.across
    facing = right * normal[0] + down * normal[1]
    normal = torch.where(facing < 0.0, -normal, normal)
    facing = facing.abs()
    velocity = (x * normal[0] + y * normal[1]) / weight.clamp_min(FLOW_WEIGHT_MIN)
    velocity = velocity / facing.clamp_min(SLOPE_MIN)
    followed = (weight > MOVING) & (facing > FACING * math.hypot(down, right))
    followed &= velocity.abs() < FASTEST
    phasors = [
        torch.polar(amplitude, sensor.phase_slope * distance + sensor.phase_offset)
        for amplitude, distance in zip(amplitudes, (outline.first, outline.second), strict=True)
    ]
    index = torch.nonzero(followed)[:, 0]
    return index, _Moving(
        row=row[index],
        column=column[index],
        first=first[index],
        normal=normal.abs()[:, index],
        facing=facing[index],
        velocity=velocity[index],
        front=torch.where(first, *phasors)[index],
        back=torch.where(first, *reversed(phasors))[index],
        still=(weight_behind < MOVING)[index],
    )


def _beside(
    images: Float[Tensor, "C H W"], outline: Outline, first: Bool[Tensor, "P"]
) -> Float[Tensor, "C P"]:
    """Images at the neighbours on the side of the first surface, or else of the second one."""
    height, width = images.shape[1:]
    step = torch.where(first, -1, 1)
    row = (outline.pixels[0] + step * outline.across[0]).clamp(0, height - 1)
    column = (outline.pixels[1] + step * outline.across[1]).clamp(0, width - 1)
    return images[:, row, column]


class _Samples(NamedTuple):
    """Three pixels per raw frame around each of P outlines: L = 3 M in all."""

    frame: Int[Tensor, "L"]
    """Which of the M raw frames."""
    row: Int[Tensor, "L P"]
    """Of the pixel."""
    column: Int[Tensor, "L P"]
    """Of the pixel."""
    inside: Bool[Tensor, "L P"]
    """Whether it is in the image."""
    beyond: Float[Tensor, "L P"]
    """How much farther the outline is from its centre than it was from that of the mixed pixel
    [steps across]."""


def _sampled(others: OtherFrames, moving: _Moving, outline: Outline) -> _Samples:
    """The three pixels nearest to the outline in every raw frame."""
    (height, width), device = others.moving.shape, others.moving.device
    travelled = others.later[:, None, None] * moving.velocity
    steps = travelled.round() + torch.tensor(NEAREST, device=device)[:, None]
    beyond, steps = (travelled - steps).flatten(0, 1), steps.flatten(0, 1).long()
    row = moving.row + steps * outline.across[0]
    column = moving.column + steps * outline.across[1]
    frame = torch.arange(len(others.later), device=device).repeat_interleave(len(NEAREST))
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return _Samples(frame, row.clamp(0, height - 1), column.clamp(0, width - 1), inside, beyond)


def _of_gains_and_shares(
    others: OtherFrames,
    moving: _Moving,
    samples: _Samples,
    gains: Float[Tensor, "g"],
    shares: Float[Tensor, "s"],
    sensor: Sensor,
) -> Float[Tensor, "g s P"]:
    """Of each gain and share: the residuals of all samples are normal, and gains are about each."""
    shift = others.shifts[samples.frame][:, None]
    front = _quads(moving.front, shift, sensor)
    known = moving.still & (others.opacity[samples.row, samples.column] > SOLID)
    layer = others.behind[samples.row, samples.column]
    back = _quads(torch.where(known, layer, moving.back), shift, sensor)
    covered, strip = _covered(moving, samples.beyond, shares)
    drift = DRIFT * others.later[samples.frame][:, None]
    at = (samples.frame[:, None], samples.row, samples.column)
    fixed = others.variance[at] + (drift * (front - back)).square()
    fixed = fixed + (MODEL_ERROR * torch.maximum(moving.front.abs(), moving.back.abs())).square()
    front, back, fixed = front[:, None], back[:, None], fixed[:, None]
    variance = fixed + (FRONT_SPREAD * covered * front).square()
    variance = variance + (BACK_SPREAD * (1.0 - covered) * back).square()
    residual = others.quads[at][:, None] - (covered - strip) * front - (1.0 - covered) * back
    lit = strip * front
    counts = WEIGHT * samples.inside[:, None] / variance
    square = (counts * residual.square()).sum(dim=0)
    product, lit = (counts * residual * lit).sum(dim=0), (counts * lit.square()).sum(dim=0)
    spread = WEIGHT * (samples.inside[:, None] * variance.log()).sum(dim=0)
    gain = gains[:, None, None]
    prior = (GAIN_SPREAD * gain).square()
    wider = 1.0 + prior * lit
    best = (prior * product.square() + 2.0 * gain * product - gain.square() * lit) / wider
    return -0.5 * (square - best + spread + wider.log())


def _quads(
    phasor: Complex[Tensor, "*n"], shift: Float[Tensor, "*n"], sensor: Sensor
) -> Float[Tensor, "*n"]:
    """Quads of shifts [rad] of a surface."""
    turned = phasor * torch.polar(torch.ones_like(shift), -shift)
    return quad_from_phasor(turned.real, turned.imag, sensor.dc_offset * phasor.abs(), 0.0)


def _covered(
    moving: _Moving, beyond: Float[Tensor, "L P"], shares: Float[Tensor, "s"]
) -> tuple[Float[Tensor, "L s P"], Float[Tensor, "L s P"]]:
    """Share of each pixel that the surface in front covers, and share of its strip beside the
    outline, if the first surface covers each share of the mixed pixel.
    """
    normal = moving.normal
    position = _position(shares[:, None], normal) + (beyond * moving.facing)[:, None]
    inwards = torch.where(moving.first, -1.0, 1.0)  # by a pixel, towards the surface in front
    of_first = _share(position, normal), _share(position + inwards, normal)
    covered, deep = (torch.where(moving.first, share, 1.0 - share) for share in of_first)
    return covered, covered - deep


def _share(position: Float[Tensor, "*n P"], normal: Float[Tensor, "2 P"]) -> Float[Tensor, "*n P"]:
    """Share of a unit square on the near side of a straight line.

    Args:
        position: How far the line is beyond the centre of the square, along its normal [px].
        normal: Absolute values of x and y of the normal [1].
    """
    short, long = normal.amin(dim=0), normal.amax(dim=0)
    apart = position.abs()
    corner = (0.5 * (short + long) - apart).clamp_min(0.0).square() / _corner(normal)
    rest = torch.where(apart <= 0.5 * (long - short), 0.5 - apart / long, corner)
    return torch.where(position < 0.0, rest, 1.0 - rest)


def _position(share: Float[Tensor, "*n P"], normal: Float[Tensor, "2 P"]) -> Float[Tensor, "*n P"]:
    """The inverse of :func:`_share`."""
    short, long = normal.amin(dim=0), normal.amax(dim=0)
    rest = torch.minimum(share, 1.0 - share)
    corner = 0.5 * (short + long) - (rest * _corner(normal)).sqrt()
    apart = torch.where(rest >= 0.5 * short / long, (0.5 - rest) * long, corner)
    return torch.where(share < 0.5, -apart, apart)


def _corner(normal: Float[Tensor, "2 P"]) -> Float[Tensor, "P"]:
    """Squared distance of a line from a corner, per area that it cuts off there [1]."""
    return (2.0 * normal[0] * normal[1]).clamp_min(CORNER_MIN)
