"""Densification: statistics, cloning, splitting, pruning, opacity resets (method, section 6.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..scene.gaussians import GaussianField
from .optimiser import Optimiser
from .settings import DensifySettings, Schedule

SPLIT_SHRINK = 1.6  # the two halves of a split Gaussian are smaller by this
SHRINK = math.log(SPLIT_SHRINK)
RESET_MARGIN = 1e-5  # relative: a hundred roundings of a sigmoid in float32
# no reset in the last tenth before densification ends: opacities could not recover
RESET_QUIET_SHARE = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """Statistics of densification, summed over images since the last one."""

    gradient: Float[Tensor, "N"]
    """Sum of pixels times screen gradient, in half image sizes."""
    pixels: Float[Tensor, "N"]
    """Sum of the pixels each Gaussian contributed to."""
    weight: Float[Tensor, "N"]
    """Sum of the weights in these pixels [px]."""
    earlier: Float[Tensor, "N"]
    """The same sum before that, since the last visibility pruning [px]."""

    @property
    def mean_gradient(self) -> Float[Tensor, "N"]:
        """Pixel-weighted mean of the screen gradient."""
        return self.gradient / self.pixels.clamp_min(1.0)


STATISTICS = [field.name for field in fields(Statistics)]


def start(field: GaussianField) -> Statistics:
    """Zeros."""
    zeros = field.opacity_logit.detach().new_zeros(len(STATISTICS), len(field)).unbind()
    return Statistics(**dict(zip(STATISTICS, zeros, strict=True)))


def crossed(before: int, after: int, every: int | None) -> bool:
    """Whether a multiple of ``every`` images lies in (before, after]."""
    return every is not None and after // every > before // every


def densification_is_due(
    before: int, after: int, settings: DensifySettings, schedule: Schedule
) -> bool:
    """Whether a step from ``before`` to ``after`` images ends with densification."""
    inside = settings.start < after < settings.stop_share * schedule.images
    return inside and crossed(before, after, settings.every)


def densification_remains(images: int, settings: DensifySettings, schedule: Schedule) -> bool:
    """Whether there may be densification after ``images`` images."""
    return settings.every is not None and images < settings.stop_share * schedule.images


def reset_is_due(before: int, after: int, settings: DensifySettings, schedule: Schedule) -> bool:
    """Whether a step from ``before`` to ``after`` images ends with an opacity reset."""
    share = min(settings.stop_share, 1.0 if schedule.freeze_from is None else schedule.freeze_from)
    end = (1.0 - RESET_QUIET_SHARE) * share * schedule.images
    every = settings.reset_every
    if settings.reset_faster is not None and after >= settings.reset_faster[0]:
        every = settings.reset_faster[1]
    return settings.every is not None and after < end and crossed(before, after, every)


def resets(settings: DensifySettings, schedule: Schedule) -> list[int]:
    """At which images a run that counts every image resets the opacities."""
    images = range(1, schedule.images + 1)
    return [n for n in images if reset_is_due(n - 1, n, settings, schedule)]


def densify(
    optimiser: Optimiser,
    statistics: Statistics,
    settings: DensifySettings,
    generator: torch.Generator,
    *,
    prunes_scale: bool,
    unseen_weight: float | None = None,
) -> tuple[dict[str, int], Statistics]:
    """Clone small Gaussians and split large ones where the screen gradient is large, then prune.

    A split draws the centres of both halves from the Gaussian and replaces it. Copies keep opacity
    and layer; their moments start at zero.

    Args:
        optimiser: Its tensors and moments are rebuilt.
        statistics: Since the last densification.
        settings: Thresholds.
        generator: For the centres of halves.
        prunes_scale: Whether too small and too large Gaussians are pruned.
        unseen_weight: Visibility pruning: Gaussians of at most this weight since the last one are
            pruned, and the sum restarts [px]; None: no visibility pruning.

    Returns:
        Numbers of cloned, split and pruned Gaussians, and statistics of the remaining ones.
    """
    field = optimiser.field.map(torch.Tensor.detach)
    count, scale = len(field), field.scale
    largest = scale.amax(dim=1)
    seen = statistics.earlier + statistics.weight
    keeps = field.opacity >= settings.opacity_min
    if unseen_weight is not None:
        keeps = keeps & (seen > unseen_weight)
    if prunes_scale:
        shortest, longest = settings.scale_range
        of_half = (field.log_scale - SHRINK).exp().amax(dim=1)
        whole, half = (
            keeps & (size >= shortest) & (size <= longest) for size in (largest, of_half)
        )
        keeps = torch.stack([whole, whole, half, half])
    wanted, capacity = _wanted(statistics, settings), max(settings.gaussians_max - count, 0)
    small = largest <= settings.clone_scale_max
    plan = _plan(wanted, small, keeps)
    if plan.added > capacity:
        gradient = torch.where(wanted, statistics.mean_gradient, -1.0)
        order = torch.argsort(gradient, descending=True, stable=True)
        wanted = torch.zeros_like(wanted)
        wanted[order[:capacity]] = True
        plan = _plan(wanted, small, keeps)
    kept, order = plan.kept, plan.order
    if sum(kept) < settings.gaussians_min:
        kept, order = plan.offered, _first(plan.parts)
    rows, old, (_, cloned, split, _) = order[: sum(kept)] % count, kept[0], plan.offered
    drawn = torch.randn(2 * split, 3, generator=generator)
    if plan.added or len(rows) < count:
        halves = 2 * kept[2]
        offset = None
        if halves:
            of = rows[len(rows) - kept[2] :]
            quaternion, scale, rank = (
                value.index_select(0, of) for value in (field.quaternion, scale, plan.rank)
            )
            shares = drawn.to(field.device).view(2, split, 3).index_select(1, rank)
            offset = _rotated(quaternion, shares * scale).flatten(0, 1)

        def change(name: str, value: Tensor) -> None:
            if offset is not None and name == "mean":
                value[-halves:] += offset
            if offset is not None and name == "log_scale":
                value[-halves:] -= SHRINK

        optimiser.replace(rows, old, change)
        seen = seen.index_select(0, rows)
    counts = {"cloned": cloned, "split": split, "pruned": sum(plan.offered) - len(rows)}
    after = start(optimiser.field)
    return counts, replace(after, earlier=seen) if unseen_weight is None else after


@dataclass(frozen=True, kw_only=True, eq=False)
class _Plan:
    """Gaussians after densification in four parts: not split, copies, first and second halves."""

    parts: Bool[Tensor, "4 N"]
    """Which Gaussians have one in each part, before pruning."""
    order: Int[Tensor, "4*N"]
    """Indices into the parts, kept ones first, in their order."""
    rank: Int[Tensor, "N"]
    """Number of split Gaussians before each one."""
    offered: list[int]
    """Number in each part before pruning."""
    kept: list[int]
    """Number in each part after pruning."""

    @property
    def added(self) -> int:
        """Number of added Gaussians before pruning."""
        return self.offered[1] + self.offered[2]


def _plan(wanted: Bool[Tensor, "N"], small: Bool[Tensor, "N"], keeps: Tensor) -> _Plan:
    """Clone the small ones of ``wanted``, split the others, keep ``keeps`` [N] or [4, N].

    Waits for the device once.
    """
    split = wanted & ~small
    parts = torch.stack([~split, wanted & small, split, split])
    kept = parts & keeps
    order, rank = _first(kept), split.cumsum(dim=0) - 1
    offered, left = torch.stack([parts, kept]).sum(dim=2).tolist()
    return _Plan(parts=parts, order=order, rank=rank, offered=offered, kept=left)


def _first(mask: Bool[Tensor, "4 N"]) -> Int[Tensor, "4*N"]:
    """Indices of all elements, true ones first: unlike ``nonzero`` it does not wait."""
    return torch.argsort(mask.flatten().view(torch.uint8), descending=True, stable=True)


def reset_opacity(optimiser: Optimiser, settings: DensifySettings) -> None:
    """Clamp all opacities to just below ``opacity_min`` and zero their moments.

    Just below, so that Gaussians without a gradient are pruned next time, however it is rounded.
    """
    below = (1.0 - RESET_MARGIN) * settings.opacity_min
    highest = math.log(below / (1.0 - below))
    with torch.no_grad():
        optimiser.tensors["opacity_logit"].clamp_(max=highest)
    optimiser.forget("opacity_logit")


def _wanted(statistics: Statistics, settings: DensifySettings) -> Bool[Tensor, "N"]:
    """Gaussians to clone or split: each adds one."""
    gradient = statistics.mean_gradient
    if settings.gradient_min is None:
        return torch.zeros_like(gradient, dtype=torch.bool)
    return gradient >= settings.gradient_min


def _rotated(
    quaternion: Float[Tensor, "N 4"], local: Float[Tensor, "k N 3"]
) -> Float[Tensor, "k N 3"]:
    """Vectors in the axes of Gaussians, rotated to world axes."""
    wxyz = torch.nn.functional.normalize(quaternion, dim=1)[None]
    w, axis = wxyz[..., :1], wxyz[..., 1:]
    turn = 2.0 * torch.linalg.cross(axis, local)
    return local + w * turn + torch.linalg.cross(axis, turn)
