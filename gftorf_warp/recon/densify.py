"""Where Gaussians are added and removed: statistics, clone, split, prune, opacity reset (method, section 6.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..render.api import ScreenGradient
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from .optimiser import Optimiser
from .settings import DensifySettings, Schedule

SPLIT_SHRINK = 1.6  # the two halves of a split Gaussian are smaller by this
RESET_MARGIN = 1e-5  # relative: a hundred roundings of a sigmoid in float32
RESET_QUIET_SHARE = 0.1  # no reset in the last tenth before the rounds end: what it dims could not recover


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """What the rounds look at, summed over images since the last one."""

    gradient: Float[Tensor, "N"]
    """Sum of pixels times screen gradient, in half image sizes."""
    pixels: Float[Tensor, "N"]
    """Sum of the pixels each Gaussian contributed to."""
    weight: Float[Tensor, "N"]
    """Sum of the weights in these pixels [px]."""
    earlier: Float[Tensor, "N"]
    """The same sum before that, back to when the unseen were last looked for [px]."""

    @property
    def mean_gradient(self) -> Float[Tensor, "N"]:
        """Pixel-weighted mean of the screen gradient."""
        return self.gradient / self.pixels.clamp_min(1.0)


STATISTICS = [field.name for field in fields(Statistics)]


def start(field: GaussianField) -> Statistics:
    """Nothing observed yet."""
    zero = field.opacity_logit.new_zeros(len(field))
    return Statistics(gradient=zero, pixels=zero.clone(), weight=zero.clone(), earlier=zero.clone())


def observe(statistics: Statistics, screen: ScreenGradient, camera: Camera) -> Statistics:
    """Add one image, after its backward pass."""
    x, y = screen.gradient.unbind(dim=1)  # two numbers as a tensor would be an upload, which makes a GPU wait
    length = torch.hypot(0.5 * camera.width * x, 0.5 * camera.height * y)
    return replace(
        statistics,
        gradient=statistics.gradient + screen.pixels * length,
        pixels=statistics.pixels + screen.pixels,
        weight=statistics.weight + screen.weight,
    )


def crossed(before: int, after: int, every: int | None) -> bool:
    """Whether a multiple of ``every`` images lies in (before, after]."""
    return every is not None and after // every > before // every


def round_is_due(before: int, after: int, settings: DensifySettings, schedule: Schedule) -> bool:
    """Whether a step from ``before`` to ``after`` images ends with a round."""
    inside = settings.start < after < settings.stop_share * schedule.images
    return inside and crossed(before, after, settings.every)


def reset_is_due(before: int, after: int, settings: DensifySettings, schedule: Schedule) -> bool:
    """Whether a step from ``before`` to ``after`` images ends with an opacity reset."""
    share = settings.stop_share if schedule.freeze_from is None else min(settings.stop_share, schedule.freeze_from)
    end = (1.0 - RESET_QUIET_SHARE) * share * schedule.images
    every = settings.reset_every
    if settings.reset_faster is not None and after >= settings.reset_faster[0]:
        every = settings.reset_faster[1]
    return settings.every is not None and after < end and crossed(before, after, every)


def resets(settings: DensifySettings, schedule: Schedule) -> list[int]:
    """At which images a run that counts every image resets the opacities."""
    intervals = [settings.reset_every, None if settings.reset_faster is None else settings.reset_faster[1]]
    multiples = {n for every in intervals if every for n in range(every, schedule.images + 1, every)}
    return [n for n in sorted(multiples) if reset_is_due(n - 1, n, settings, schedule)]


def round_of(
    optimiser: Optimiser,
    statistics: Statistics,
    settings: DensifySettings,
    generator: torch.Generator,
    *,
    judge_scale: bool,
    unseen_weight: float | None = None,
) -> tuple[dict[str, int], Statistics]:
    """Clone small Gaussians and split large ones where the screen gradient is large, then prune.

    A split draws both halves from the Gaussian itself and replaces it. Copies keep opacity and layer, and their moments
    start at zero.

    Args:
        optimiser: Whose tensors and moments are rebuilt.
        statistics: Since the last round.
        settings: Thresholds.
        generator: For the positions of halves.
        judge_scale: Whether too small and too large Gaussians are removed in this round.
        unseen_weight: Gaussians of at most so much weight since the last time are, too, and from here on it is summed
            anew [px]; None: nobody is.

    Returns:
        How many were cloned, split and pruned, and what is known of those that remain.
    """
    field = optimiser.field
    count = len(field)
    wanted = _wanted(field, statistics, settings)
    largest = field.scale.detach().amax(dim=1)
    clone, split = wanted & (largest <= settings.clone_scale_max), wanted & (largest > settings.clone_scale_max)
    seen = statistics.earlier + statistics.weight  # copies have been seen as much as what they are copies of
    every = torch.arange(count, device=field.device)
    rows = torch.cat([every[~split], every[clone], every[split], every[split]])
    halves = torch.zeros(len(rows), dtype=torch.bool, device=field.device)
    halves[len(rows) - 2 * int(split.sum()) :] = True
    fresh = torch.zeros_like(halves)
    fresh[count - int(split.sum()) :] = True
    if len(rows) > count:
        offset = _draw(field.map(lambda value: value.detach()[rows]), halves, generator)
        shrink = math.log(SPLIT_SHRINK)

        def change(name: str, value: Tensor) -> Tensor:
            if name == "mean":
                return value + offset
            return torch.where(halves[:, None], value - shrink, value) if name == "log_scale" else value

        optimiser.replace(rows, fresh, change)
        seen = seen[rows]
    heavy = None if unseen_weight is None else seen > unseen_weight
    kept = prune(optimiser, settings, judge_scale=judge_scale, wanted=heavy)
    counts = {"cloned": int(clone.sum()), "split": int(split.sum()), "pruned": len(rows) - len(kept)}
    after = start(optimiser.field)
    return counts, replace(after, earlier=seen[kept]) if unseen_weight is None else after


def prune(
    optimiser: Optimiser, settings: DensifySettings, *, judge_scale: bool, wanted: Bool[Tensor, "N"] | None = None
) -> Int[Tensor, "M"]:
    """Remove faint Gaussians, those of an unwanted size and all but the ``wanted``; none if too few would remain.

    Returns:
        Numbers of those that were kept.
    """
    field = optimiser.field
    every = torch.arange(len(field), device=field.device)
    keep = field.opacity.detach() >= settings.opacity_min
    if judge_scale:
        largest = field.scale.detach().amax(dim=1)
        keep &= (largest >= settings.scale_range[0]) & (largest <= settings.scale_range[1])
    if wanted is not None:
        keep &= wanted
    rows = every[keep]
    if len(rows) == len(every) or len(rows) < settings.gaussians_min:
        return every
    optimiser.replace(rows, torch.zeros_like(rows, dtype=torch.bool), lambda _, value: value)
    return rows


def reset_opacity(optimiser: Optimiser, settings: DensifySettings) -> None:
    """Dim every Gaussian to just below ``opacity_min`` and forget those moments: what is needed grows back.

    Just below, so that what no pixel has asked for by the next round is removed whichever way a sigmoid is rounded.
    """
    below = (1.0 - RESET_MARGIN) * settings.opacity_min
    highest = math.log(below / (1.0 - below))
    with torch.no_grad():
        optimiser.tensors["opacity_logit"].clamp_(max=highest)
    optimiser.forget("opacity_logit")


def _wanted(field: GaussianField, statistics: Statistics, settings: DensifySettings) -> Bool[Tensor, "N"]:
    """Gaussians to clone or split: each adds one, and those of the largest gradients come first if room is short."""
    gradient = statistics.mean_gradient
    if settings.gradient_min is None:
        return torch.zeros_like(gradient, dtype=torch.bool)
    wanted = gradient >= settings.gradient_min
    room = max(settings.gaussians_max - len(field), 0)
    if int(wanted.sum()) > room:
        order = torch.argsort(torch.where(wanted, gradient, -1.0), descending=True, stable=True)
        wanted = torch.zeros_like(wanted)
        wanted[order[:room]] = True
    return wanted


def _draw(field: GaussianField, halves: Bool[Tensor, "N"], generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """A random vector [m] from each Gaussian that is a half, zero for the others."""
    drawn = torch.randn(int(halves.sum()), 3, generator=generator).to(field.device)
    offset = torch.zeros_like(field.mean)
    wxyz = torch.nn.functional.normalize(field.quaternion[halves], dim=1)
    w, axis, local = wxyz[:, :1], wxyz[:, 1:], drawn * field.scale[halves]
    turn = 2.0 * torch.linalg.cross(axis, local)
    offset[halves] = local + w * turn + torch.linalg.cross(axis, turn)
    return offset
