"""Outlines: which of two surfaces the ray through the centre of a mixed pixel meets.

A pixel at an outline sees two surfaces, and its phasor is their sum: a distance decoded from it, or
rendered by Gaussians that explain it, lies between the two, or outside of both where their phases
are far apart. What the neighbours on both sides measure tells the shares: with amplitudes a and
phases psi of both and the share s of the pixel's area that the first one covers,

    P = s a_1 exp(i psi_1) + (1 - s) a_2 exp(i psi_2)

The ray through the centre meets the first one if s > 1/2, for a straight outline. The surface
behind goes on behind the other one: its amplitude is that of its neighbour, within some 20 %. The
one in front may turn away at its outline, or show a narrow side there: its amplitude is
extrapolated from two neighbours, times a gain that is unknown but goes on along the outline, as
its position does, see straight.py. So every share has a likelihood, and the distance is the mean of
both surfaces' distances, weighted by the odds that the centre is on them. Pairs of neighbours in
four directions vote with their likelihoods, against a surface of the pixel's own, of which any
phasor is as likely: its distance is the rendered one. The phasor is not only rendered, see
phasors.py, and of a moving outline other raw frames tell more, see other_frames.py.

A neighbour may be mixed itself, so only its own neighbour has to be nearer to it than the other
side is. Steep slopes fulfil this, too: there the distance of a pixel is a mean of what both sides
continue to, weighted by the same likelihoods.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..data.steps import STEP_M
from ..render.api import Rendering
from ..scene.measured import extremes
from ..scene.sensor import Sensor
from .other_frames import OtherFrames, log_likelihood
from .phasors import CLOSED_FORM, Phasor, rendered_phasor
from .straight import Outline, along_outline

OUTLINE = 3  # in a map of sources, see fallback.py
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (rows, columns)
PASSES = 3  # later ones see neighbours that are no mixtures any more
SHARES = 21  # of the area of a pixel, from 0 to 1
BLUR = 0.065  # [pixels] outlines are not straight: how sure the share makes of the centre
SMOOTH = 1.0  # [steps] two neighbours on one side of a mixed pixel differ by less: one may be mixed
SAME_SURFACE = 0.4  # [steps] two pixels on one surface differ by less
GAINS = (0.6, 1.0, 1.4)  # [1] of an extrapolated amplitude all along an outline: a side face
GAIN_CHANCES = (0.15, 0.7, 0.15)  # [1] of each
FRONT_SPREAD = 0.25  # [1] standard deviation of an extrapolated amplitude after its gain, relative
BACK_SPREAD = 0.17  # [1] the same of a surface that goes on behind another one
EXTRAPOLATION = 0.3  # [1] at most, of the logarithm of the amplitude
HALF = 0.5  # [1] of the change of a closed form that is kept
QUARTER = 0.25  # [1] of the fit in a closed form that it is averaged with
ANY = 1.0 / math.pi  # density of any phasor in a unit disc
LEAST = 1e-12  # [quad units] below it a neighbour is black
MARGIN = 3  # [pixels] to the farthest neighbour


def resolved(
    rendering: Rendering,
    sensor: Sensor,
    phasor: Phasor | None = None,
    *,
    camera_moves: bool = False,
    fitted: Float[Tensor, "H W"] | None = None,
    others: OtherFrames | None = None,
) -> Rendering:
    """A rendering with the distances of its mixed pixels resolved.

    Args:
        rendering: With distance and phasor. What a fallback has replaced already stays.
        sensor: Whose first frequency the phasor has.
        phasor: The phasor as well as it is known; None: as it is rendered.
        camera_moves: Whether the closed form of a fallback is resolved too, by half: what
            ``phasor`` decodes to has less noise than the closed form, and where the odds are wrong,
            a distance between two surfaces costs less than the wrong one of them.
        fitted: Distance before a fallback, of which a quarter is in those resolved closed forms, as
            far as it is within the distances around a pixel: its errors are others. None: none.
        others: What other raw frames tell of moving outlines; None: nothing.

    Returns:
        ``source`` is ``OUTLINE`` where the distance changed by more than a hundredth of the step.
    """
    phasor = phasor or rendered_phasor(rendering)
    fit, source = rendering.distance, rendering.source
    source = torch.zeros_like(fit, dtype=torch.uint8) if source is None else source
    lit = rendering.phasor[2] > 0.0
    where = (source == 0) & lit  # the others are measured, or black
    closed_form = (source == CLOSED_FORM) & lit & camera_moves
    if camera_moves:
        fit = torch.where(closed_form, phasor.decoded(fit, sensor), fit)
        where |= closed_form
    distance = fit
    for _ in range(PASSES):
        distance = _resolved(distance, phasor, where, sensor, others)
    distance = torch.where(closed_form, torch.lerp(fit, distance, HALF), distance)
    changed = (distance - fit).abs() > 0.01 * STEP_M
    if fitted is not None:
        low, high = extremes(distance)
        within = torch.minimum(torch.maximum(fitted, low), high)
        distance = torch.where(closed_form, torch.lerp(distance, within, QUARTER), distance)
    return replace(rendering, distance=distance, source=source.masked_fill(changed, OUTLINE))


def at_outlines(distance: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels between two surfaces, in any of the four directions."""
    padded, outline_pixels = _padded(distance), torch.zeros_like(distance, dtype=torch.bool)
    for rows, columns in DIRECTIONS:
        towards = (-rows, -columns), (rows, columns)
        outline_pixels |= _between_two_surfaces(padded, *towards, SAME_SURFACE)
    return outline_pixels


class _Side(NamedTuple):
    """What P pixels have on one side."""

    distance: Float[Tensor, "P"]
    """Of the surface there [m]."""
    amplitude: Float[Tensor, "P"]
    """Of the phasor if the surface filled the pixel."""
    spread: Float[Tensor, "P"]
    """Standard deviation of that amplitude over it [1]."""


def _resolved(
    distance: Float[Tensor, "H W"],
    phasor: Phasor,
    where: Bool[Tensor, "H W"],
    sensor: Sensor,
    others: OtherFrames | None,
) -> Float[Tensor, "H W"]:
    """One pass over the pixels ``where`` a distance may change."""
    amplitude = phasor.value.abs().clamp_min(LEAST)
    nearby = torch.nn.functional.max_pool2d(amplitude[None], 3, stride=1, padding=1)[0]
    total = torch.full_like(distance, ANY)
    weighted = total * distance
    beyond, light = _padded(distance), _padded(torch.log(amplitude))
    chances = torch.tensor(GAIN_CHANCES, device=distance.device)
    gains, shares = torch.tensor(GAINS, device=distance.device), _shares(distance.device)
    on_first = torch.special.ndtr((shares - 0.5) / BLUR)
    for direction in DIRECTIONS:
        before, after = (-direction[0], -direction[1]), direction
        mixed = where & _between_two_surfaces(beyond, before, after, SMOOTH)
        pixels = torch.nonzero(mixed, as_tuple=True)
        first, second = _sides(beyond, light, pixels, (before, after))
        unit, of_gains = nearby[pixels], [_with_gain(first, second, gain) for gain in GAINS]
        each = [_likelihood(phasor, pixels, unit, sides, sensor) for sides in of_gains]
        outline = Outline(after, pixels, first.distance, second.distance, distance, SAME_SURFACE)
        alone = torch.stack(each) / SHARES
        if others is not None:
            amplitudes = first.amplitude, second.amplitude
            alone *= log_likelihood(others, outline, amplitudes, gains, shares, sensor).exp()
        likelihood = along_outline(alone, chances, ANY, outline)
        odds = (likelihood * on_first[:, None]).sum(dim=0)
        both = likelihood.sum(dim=0)
        mean = odds * first.distance + (both - odds) * second.distance
        weighted = weighted.index_put(pixels, mean, accumulate=True)
        total = total.index_put(pixels, both, accumulate=True)
    return weighted / total


def _shares(device: torch.device) -> Float[Tensor, "s"]:
    return torch.linspace(0.0, 1.0, SHARES, device=device)


def _between_two_surfaces(
    distance: Float[Tensor, "h w"],
    before: tuple[int, int],
    after: tuple[int, int],
    smooth: float,
) -> Bool[Tensor, "H W"]:
    """Pixels with a step between the neighbours on both sides, each of which differs by less than
    ``smooth`` of that step from the next one on its side.
    """
    jump = (_neighbour(distance, before) - _neighbour(distance, after)).abs()
    between = jump > STEP_M
    for towards in (before, after):
        beside = _neighbour(distance, towards) - _neighbour(distance, towards, 2)
        between &= beside.abs() < smooth * jump
    return between


def _padded(image: Float[Tensor, "H W"]) -> Float[Tensor, "h w"]:
    """The image, continued by its border pixels."""
    return torch.nn.functional.pad(image[None], (MARGIN,) * 4, mode="replicate")[0]


def _neighbour(
    padded: Float[Tensor, "h w"], towards: tuple[int, int], steps: int = 1
) -> Float[Tensor, "H W"]:
    """The image at every pixel's neighbour, the pixel at the border beyond it; a view."""
    top, left = (MARGIN + steps * along for along in towards)
    height, width = (size - 2 * MARGIN for size in padded.shape)
    return padded[top : top + height, left : left + width]


def _sides(
    distance: Float[Tensor, "h w"],
    light: Float[Tensor, "h w"],
    pixels: tuple[Int[Tensor, "P"], ...],
    towards: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[_Side, _Side]:
    """The surfaces on both sides of some pixels, from padded distances and logarithms of
    amplitudes.
    """
    first, second = (_neighbour(distance, direction)[pixels] for direction in towards)
    amplitudes, spreads = [], []
    for direction, in_front in zip(towards, (first < second, second < first), strict=True):
        once, twice = (_neighbour(light, direction, steps)[pixels] for steps in (1, 2))
        beyond = (once - twice).clamp(-EXTRAPOLATION, EXTRAPOLATION)
        amplitudes.append(torch.exp(torch.where(in_front, once + beyond, once)))
        spreads.append(torch.full_like(once, BACK_SPREAD).masked_fill(in_front, FRONT_SPREAD))
    first, second = (_brought_near(distance, pixels, direction) for direction in towards)
    return _Side(first, amplitudes[0], spreads[0]), _Side(second, amplitudes[1], spreads[1])


def _with_gain(first: _Side, second: _Side, gain: float) -> tuple[_Side, _Side]:
    """Both sides, the amplitude of the one in front times the gain."""
    first_gain = torch.where(first.distance < second.distance, gain, 1.0)
    second_gain = torch.where(first.distance < second.distance, 1.0, gain)
    return (
        first._replace(amplitude=first.amplitude * first_gain),
        second._replace(amplitude=second.amplitude * second_gain),
    )


def _brought_near(
    distance: Float[Tensor, "h w"],
    pixels: tuple[Int[Tensor, "P"], ...],
    towards: tuple[int, int],
) -> Float[Tensor, "P"]:
    """The distance of a surface at some pixels: their own, if it is between the neighbour's and its
    continuation along the slope there; else the nearer one of both.
    """
    own = _neighbour(distance, (0, 0))[pixels]
    once, thrice = (_neighbour(distance, towards, steps)[pixels] for steps in (1, 3))
    slope = 0.5 * (once - thrice)
    low, high = slope.clamp_max(0.0), slope.clamp_min(0.0)
    return once + torch.minimum(torch.maximum(own - once, low), high)


def _likelihood(
    phasor: Phasor,
    pixels: tuple[Int[Tensor, "P"], ...],
    unit: Float[Tensor, "P"],
    sides: tuple[_Side, _Side],
    sensor: Sensor,
) -> Float[Tensor, "s P"]:
    """Density of the phasors of some pixels over ``unit`` if the first surface covers each share.

    The density is normal: both amplitudes are uncertain along their phases, and the phasor is.
    """
    shares = _shares(unit.device)[:, None]
    apart = -phasor.value[pixels] / unit
    variance_re, variance_im, covariance = (
        image[pixels] / unit.square()
        for image in (phasor.variance_re, phasor.variance_im, phasor.covariance)
    )
    for share, side in zip((shares, 1.0 - shares), sides, strict=True):
        phase = sensor.phase_slope * side.distance + sensor.phase_offset
        direction = torch.polar(torch.ones_like(phase), phase)
        length = share * side.amplitude / unit
        spread = (side.spread * length).square()
        apart = apart + length * direction
        variance_re = variance_re + spread * direction.real.square()
        variance_im = variance_im + spread * direction.imag.square()
        covariance = covariance + spread * direction.real * direction.imag
    determinant = variance_re * variance_im - covariance.square()
    square = (
        variance_im * apart.real.square()
        - 2.0 * covariance * apart.real * apart.imag
        + variance_re * apart.imag.square()
    ) / determinant
    return torch.exp(-0.5 * square) / (2.0 * math.pi * determinant.sqrt())
