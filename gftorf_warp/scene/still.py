"""Which pixels of a camera at rest never change, by the evidence of raw quads alone.

Values of one phase shift in one pixel are compared with each other: the same shift of the same matter is the same value
up to noise, whatever its phase wraps to and whatever light there is besides. So the mean over some cycles in a row must
be the mean over all cycles. A test that fails anywhere in time makes a pixel one that changes.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..constants import LOW_PASS
from ..data.sequence import Sequence
from .camera import Camera
from .gaussians import GaussianField

SMOOTHED = 3  # [px] side of the window whose mean is compared: small, since motion at its edge wakes all of it
FALSE_ALARMS = 0.1  # pixels of a whole sequence at rest that are expected to be taken for changing ones
LEVELS = 16  # classes of brightness in which noise is estimated
FLOOR = 1e-4  # of the largest quad: less noise than this is not believed, rounding is as large
MAD = 1.4826  # standard deviation of a normal distribution over its median absolute value
NEGATIVE = 0.02  # share of all light that may be below zero where quads are counts: noise around none
SIGMAS = 1.0  # of a splat make up its footprint: what its core shows would change first if it moved


def still_pixels(sequence: Sequence, margin: int = 1) -> Bool[Tensor, "H W"]:
    """Pixels in whose neighbourhood no quad changes over all measured raw frames.

    For each phase shift, means over windows of 1, 2, 4, .. cycles up to half of all, every start, differ from the mean
    over all n cycles by noise of standard deviation s sqrt(1/w - 1/n). The threshold is where a normal distribution
    leaves FALSE_ALARMS in all tests together, which overstates their number: windows overlap.

    Args:
        sequence: Of a camera at rest; phasors count as the quads that they are.
        margin: Pixels within so many rows and columns of one that changes are not still either [px].

    Returns:
        On the CPU. All False if no shift was measured twice: then nothing is known.
    """
    groups = [_smooth(group) for group in _by_shift(sequence)]
    height, width = sequence.quads.shape[1:]
    if not groups:
        return torch.zeros(height, width, dtype=torch.bool)
    border = 1.0 / _whole(height, width).sqrt()
    windows = [
        (group, noise, w) for group, noise in zip(groups, noise_of(groups), strict=True) for w in _lengths(len(group))
    ]
    tests = height * width * sum(len(group) - w + 1 for group, _, w in windows)
    limit = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARMS / tests)
    changed = torch.zeros(height, width, dtype=torch.bool)
    for group, noise, w in windows:
        sums = torch.cat([torch.zeros_like(group[:1]), (group - group.mean(dim=0)).cumsum(dim=0)])
        largest = ((sums[w:] - sums[:-w]) / w).abs().amax(dim=0)
        changed |= ~(largest <= limit * border * noise * math.sqrt(1.0 / w - 1.0 / len(group)))
    return ~_grown(changed, margin)


def noise_of(groups: list[Float[Tensor, "n H W"]]) -> list[Float[Tensor, "H W"]]:
    """Standard deviation of a value in each pixel, from differences in time: variance = a + b level, a and b >= 0.

    The noise of counts grows with the count, that of differences of counts with all light: the level is the mean of
    one shift where nothing is negative, else the mean absolute value over all shifts. In each class of brightness the
    variance is from the median absolute difference of neighbouring cycles; the line through the classes is by medians,
    too, so that a class which a moving object fills does not decide.

    Args:
        groups: Values of each shift, at least two each.
    """
    size = groups[0].shape[1:]
    means = torch.stack([group.mean(dim=0) for group in groups]).flatten(1)
    counts = means.clamp_max(0.0).sum() >= -NEGATIVE * means.abs().sum()
    level = means.clamp_min(0.0) if counts else means.abs().mean(dim=0).expand_as(means)
    differences = [group.diff(dim=0).flatten(1).abs() / math.sqrt(2.0) for group in groups]
    rank = level.flatten().argsort().argsort().view(level.shape) * LEVELS // level.numel()
    classes = rank.unique().tolist()
    at = torch.stack([level[rank == c].mean() for c in classes])
    medians = [
        torch.cat([apart[:, row == c].flatten() for apart, row in zip(differences, rank, strict=True)]).median()
        for c in classes
    ]
    variance = (MAD * torch.stack(medians)).square()
    one, other = torch.triu_indices(len(classes), len(classes), offset=1)
    slopes = (variance[other] - variance[one]) / (at[other] - at[one]).clamp_min(1e-12)
    slope = slopes.median().clamp_min(0.0) if len(slopes) else at.new_zeros(())
    constant = (variance - slope * at).median().clamp_min(0.0)
    floor = FLOOR * max(float(group.abs().max()) for group in groups)
    return [(constant + slope * row).sqrt().clamp_min(floor).view(size) for row in level]


def rests(field: GaussianField, still: Bool[Tensor, "H W"], camera: Camera) -> Bool[Tensor, "N"]:
    """Gaussians that only still pixels see: centre in the image, and nothing that changes within their footprint.

    That is the box around SIGMAS standard deviations of the splat; what of it lies outside of the image is not looked
    at.

    Args:
        field: Where they are.
        still: From :func:`still_pixels`.
        camera: Of these pixels.
    """
    height, width = still.shape
    mean = field.mean.detach()
    place, reach = camera.project(mean), SIGMAS * _deviations(field, camera)
    pose = torch.as_tensor(camera.camera_from_world).to(mean)
    size = place.new_tensor([width, height])
    seen = (mean @ pose[2, :3] + pose[2, 3] > 0) & ((place >= 0) & (place < size)).all(dim=1)
    seen &= reach.isfinite().all(dim=1)
    place, reach = (torch.where(seen[:, None], value, 0.0) for value in (place, reach))
    first, end = (
        (place + sign * reach).floor().clamp_min(0.0).minimum(size - 1.0).long() + step
        for sign, step in ((-1, 0), (1, 1))
    )
    sums = torch.zeros(height + 1, width + 1, dtype=torch.int64, device=still.device)
    sums[1:, 1:] = (~still).long().cumsum(dim=0).cumsum(dim=1)
    (x0, y0), (x1, y1) = first.unbind(dim=1), end.unbind(dim=1)
    return seen & (sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0] == 0)


def _deviations(field: GaussianField, camera: Camera) -> Float[Tensor, "N 2"]:
    """Standard deviations of the splats along columns and rows [px], as they are rendered by a pinhole."""
    field = field.map(torch.Tensor.detach)
    pose = torch.as_tensor(camera.camera_from_world).to(field.mean)
    local = field.mean @ pose[:3, :3].T + pose[:3, 3]
    z, focal = local[:, 2:], local.new_tensor([camera.fx, camera.fy])
    slope = (pose[:2, :3] - (local[:, :2] / z)[..., None] * pose[2, :3]) * (focal / z)[
        ..., None
    ]  # [N, 2, 3] in the world
    wxyz = torch.nn.functional.normalize(field.quaternion, dim=1)[:, None]
    w, axis = wxyz[..., :1], -wxyz[..., 1:].expand_as(slope)  # the other way round: from the world to the own axes
    turn = 2.0 * torch.linalg.cross(axis, slope)
    own = slope + w * turn + torch.linalg.cross(axis, turn)
    return ((own * field.scale[:, None]).square().sum(dim=2) + LOW_PASS).sqrt()


def _by_shift(sequence: Sequence) -> list[Float[Tensor, "n H W"]]:
    """Measured quads of each shift at each frequency, in their order, of those that were measured at least twice."""
    kinds = np.stack([np.round(np.mod(sequence.shifts, 2.0 * math.pi), 6), sequence.frame_frequencies])
    rows = [np.flatnonzero(sequence.measured & (kinds.T == kind).all(axis=1)) for kind in np.unique(kinds, axis=1).T]
    return [torch.tensor(sequence.quads[row], dtype=torch.float64) for row in rows if len(row) > 1]


def _lengths(count: int) -> list[int]:
    """1, 2, 4, .. up to half of ``count``."""
    return [1 << n for n in range(max(count // 2, 1).bit_length())]


def _smooth(images: Float[Tensor, "n H W"]) -> Float[Tensor, "n H W"]:
    """Means over small windows; at the border over what there is of them."""
    half = SMOOTHED // 2
    return torch.nn.functional.avg_pool2d(images[:, None], SMOOTHED, 1, half, count_include_pad=False)[:, 0]


def _whole(height: int, width: int) -> Float[Tensor, "H W"]:
    """Share of the window of each pixel that lies in the image [1]: the mean of fewer pixels is noisier."""
    ones = torch.ones(1, height, width, dtype=torch.float64)
    return torch.nn.functional.avg_pool2d(ones, SMOOTHED, 1, SMOOTHED // 2)[0]


def _grown(mask: Bool[Tensor, "H W"], margin: int) -> Bool[Tensor, "H W"]:
    """A mask and all within ``margin`` rows and columns of it."""
    return torch.nn.functional.max_pool2d(mask.float()[None, None], 2 * margin + 1, 1, margin)[0, 0] > 0
