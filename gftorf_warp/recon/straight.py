"""What the pixels along an outline tell of a mixed one among them.

Beside a mixed pixel the same outline goes on. It is nearly straight over three pixels, so its
position in a pixel is the mean of its positions in the next pixels on both sides: along a line
across it, the shares of the surface before it add up to where it is. And what makes the surface in
front darker or brighter there than farther in, such as a narrow side, goes on along the outline:
a gain of its amplitude that explains one pixel is likely in the next one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

CURVE = 0.25  # [pixels] from the straight line through the neighbours' positions
SAME_GAIN = 0.7  # [1] of a neighbour's evidence for a gain counts: textures differ
PURE_VARIANCE = 0.01  # [1] of the share in a pixel that shows one of both surfaces
VARIANCE_MIN = 1e-4  # [1] of a share: they have steps of 0.05
WITHIN = 0.02  # [pixels] a position this near to the end of three pixels may lie beyond
LEAST = 1e-30  # instead of the logarithm of zero


class Outline(NamedTuple):
    """P mixed pixels of an image, each between two surfaces in one direction."""

    across: tuple[int, int]
    """Rows and columns from one pixel to the next, from the first surface to the second."""
    pixels: tuple[Int[Tensor, "P"], ...]
    """Rows and columns."""
    first: Float[Tensor, "P"]
    """Distance of the first surface [m]."""
    second: Float[Tensor, "P"]
    """Distance of the second one [m]."""
    distance: Float[Tensor, "H W"]
    """Of every pixel of the image [m]."""
    smooth: float
    """Distances on one surface differ by less [steps]."""


def along_outline(
    likelihood: Float[Tensor, "g s P"], chances: Float[Tensor, "g"], own: float, outline: Outline
) -> Float[Tensor, "s P"]:
    """Likelihood of each share in each pixel, with what its neighbours along the outline tell.

    Args:
        likelihood: Of the pixel's own phasor for each gain of the surface in front and each share
            of the first surface, from 0 to 1; its sum over shares is that of the gain.
        chances: Of each gain, before anything is known.
        own: Likelihood that a pixel is no mixture.
        outline: The pixels.
    """
    shares = torch.linspace(0.0, 1.0, likelihood.shape[1], device=likelihood.device)[:, None]
    of_gain = likelihood.sum(dim=1)
    total = of_gain.clamp_min(LEAST)
    mean = (likelihood * shares).sum(dim=1) / total
    variance = (likelihood * shares.square()).sum(dim=1) / total - mean.square()
    beside = _Beside.of(outline)
    position, spread, known = beside.position(mean, variance.clamp_min(VARIANCE_MIN))
    straight = -0.5 * (shares - position[:, None]).square() / spread[:, None]
    straight = torch.softmax(straight, dim=1) * len(shares)
    evidence = torch.log((of_gain + own) / ((chances[:, None] * of_gain).sum(dim=0) + own))
    gains = torch.softmax(torch.log(chances)[:, None] + SAME_GAIN * beside.summed(evidence), dim=0)
    straight = torch.where(known[:, None], straight, torch.ones_like(straight))
    return (gains[:, None] * likelihood * straight).sum(dim=0)


class _Beside(NamedTuple):
    """Two lines of three pixels across the outline, on both sides of each of P pixels."""

    at: Int[Tensor, "2 3 P"]
    """Index among the P pixels, where it is one."""
    same: Bool[Tensor, "2 3 P"]
    """Whether it is a mixed pixel of the same two surfaces."""
    first: Bool[Tensor, "2 3 P"]
    """Whether it is nearer to the first surface than to the second one."""
    known: Bool[Tensor, "2 P"]
    """Whether all three are on one surface, or mixtures of both."""

    @classmethod
    def of(cls, outline: Outline) -> _Beside:
        """Those of an outline; pixels beyond the border are those at it."""
        (height, width), device = outline.distance.shape, outline.distance.device
        line = torch.tensor([-1, 1], device=device)[:, None, None]
        column = torch.tensor([-1, 0, 1], device=device)[:, None]
        down, right = outline.across
        y = (outline.pixels[0] - line * right + column * down).clamp(0, height - 1)
        x = (outline.pixels[1] + line * down + column * right).clamp(0, width - 1)
        index = torch.full(outline.distance.shape, -1, dtype=torch.long, device=device)
        index[outline.pixels] = torch.arange(len(outline.first), device=device)
        at, distance = index[y, x], outline.distance[y, x]
        limit = outline.smooth * (outline.first - outline.second).abs()
        apart = [(distance - surface).abs() for surface in (outline.first, outline.second)]
        same = at >= 0
        for surface in (outline.first, outline.second):
            same &= (surface[at] - surface).abs() < limit
        known = same | (torch.minimum(*apart) < limit)
        return cls(at=at, same=same, first=apart[0] < apart[1], known=known.all(dim=1))

    def position(
        self, mean: Float[Tensor, "g P"], variance: Float[Tensor, "g P"]
    ) -> tuple[Float[Tensor, "g P"], Float[Tensor, "g P"], Bool[Tensor, "g P"]]:
        """Where a straight outline is in each pixel [pixels], the variance of that and whether it
        is known, from means and variances of shares.
        """
        pure = torch.full_like(variance[:, self.at], PURE_VARIANCE)
        share = torch.where(self.same, mean[:, self.at], self.first.to(mean))
        spread = torch.where(self.same, variance[:, self.at], pure).sum(dim=(1, 2))
        there = share.sum(dim=2) - 1.0
        inside = (there > WITHIN - 1.0) & (there < 2.0 - WITHIN)
        known = (self.known & inside).all(dim=1)
        return there.mean(dim=1), 0.25 * spread + CURVE**2, known

    def summed(self, value: Float[Tensor, "g P"]) -> Float[Tensor, "g P"]:
        """A value of all neighbours that are mixtures of the same surfaces, added up."""
        return (value[:, self.at] * self.same).sum(dim=(1, 2))
