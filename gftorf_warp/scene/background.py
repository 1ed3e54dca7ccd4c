"""The static background of a recording with a static camera: one phasor per pixel and frequency.

The phasors of a pixel in all quartets form clusters, one for each surface that it saw at rest. The
background is the farthest cluster of enough quartets, and its phasor is their mean, so its noise
falls with the root of their number. Truth is never read.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from ..data.sequence import Sequence
from .measured import (
    ROUNDING,
    Change,
    FarLayer,
    decoded_phasors,
    distance_noise,
    fill,
    sensor_of,
)
from .unwrap import distance_from_phasors

WITHIN = 3.5  # [standard deviations] radius of a cluster, per component
SHARE = 0.3  # least share of the quartets in a cluster that is background
LEAST = 3  # and their least number, if there are as many
CONTRADICTED = 0.2  # share of the quartets that are farther from which a surface has moved slowly
FARTHER = 0.05  # [m] least difference of distances, besides noise
ITERATIONS = 3  # of moving a cluster to the mean of its members
NOISE_MAX = 0.3  # [m] largest noise of a mean distance that is used


def background(sequence: Sequence, change: Change, device: torch.device | str = "cpu") -> FarLayer:
    """Distance and amplitude of the farthest surface that each pixel saw at rest, computed on
    ``device``, in the CPU's memory.
    """
    sensor = sensor_of(sequence)
    phasors = decoded_phasors(sequence, change.quartets).to(device)  # [f, J, 2, H, W]
    count = phasors.shape[1]
    values = phasors.transpose(0, 1).flatten(1, 2)  # [J, 2 f, H, W]
    # of one component of a phasor
    noise = max(2.0**0.5 * change.noise, ROUNDING * float(values.abs().max()), 1e-12)
    radius = WITHIN * noise * (2.0 * values.shape[1]) ** 0.5
    least = min(max(LEAST, round(SHARE * count)), count)

    def members(centre: Tensor) -> Bool[Tensor, "J H W"]:
        return (values - centre).square().sum(dim=1) < radius**2

    def distance_of(value: Tensor) -> Tensor:
        pairs = value.unflatten(0, (-1, 2))
        return distance_from_phasors([(p[0], p[1]) for p in pairs], sensor)

    best = torch.zeros_like(values[0])
    reach = values.new_full(values.shape[2:], -1.0)
    support = torch.zeros_like(reach, dtype=torch.long)
    for value in values:
        centre = value
        for _ in range(ITERATIONS):
            inside = members(centre)
            total = inside.sum(dim=0)
            mean = (values * inside[:, None]).sum(dim=0) / total.clamp_min(1)
            centre = torch.where(total > 0, mean, centre)
        number = members(centre).sum(dim=0)
        distance = distance_of(centre)
        amplitude = 0.5 * torch.hypot(centre[0], centre[1])
        error = distance_noise(amplitude, change.noise, sequence) / number.clamp_min(1).sqrt()
        better = (number >= least) & (error < NOISE_MAX)
        # noise does not decide between two estimates of one surface
        same = (distance - reach).abs() < 4.0 * error
        better &= torch.where(same, number > support, distance > reach)
        best = torch.where(better, centre, best)
        reach = torch.where(better, distance, reach)
        support = torch.where(better, number, support)
    each = torch.stack([distance_of(value) for value in values])
    amplitudes = 0.5 * torch.hypot(values[:, 0], values[:, 1])
    margin = FARTHER + 4.0 * distance_noise(amplitudes, change.noise, sequence)
    farther = ((each > reach + margin) & (margin < 1.0)).sum(dim=0)
    known = (support > 0) & (farther < max(LEAST, round(CONTRADICTED * count)))
    fields = torch.stack([reach, 0.5 * torch.hypot(best[0], best[1])]).cpu()
    known = known.cpu()
    distance, amplitude = fill(fields, known)
    return FarLayer(distance=distance, amplitude=amplitude, known=known)
