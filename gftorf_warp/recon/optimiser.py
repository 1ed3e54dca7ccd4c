"""Learning rates of all groups by one schedule (method, section 6.5), and the state of Adam."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from .settings import Batch, BatchRule, Input, ReconSettings

BETAS = (0.9, 0.999)  # of steps of one image
# far below any gradient here, so that a step depends on the direction of a gradient, not on its
# size
EPSILON = 1e-15
MOTION = "motion"  # group of the parameters of the motion
STORED = ("step", "exp_avg", "exp_avg_sq")  # keys of ``torch.optim.Adam``
Moments = tuple[Tensor, Tensor, Tensor]
"""Number of steps, first and second moment of a tensor."""


def rates_at(
    settings: ReconSettings,
    images: int,
    factor: float = 1.0,
    *,
    reset_at: int | None = None,
    revived_at: int | None = None,
) -> dict[str, float]:
    """Learning rate of every group after ``images`` optimised images; 0: the group is not
    optimised.

    Log-linear from ``rates`` to ``rates_last`` at the end of the run. That of the motion is 0
    during the warm-up and for a while after an opacity reset, then it rises linearly. Those of
    frozen Gaussians are 0.

    Args:
        settings: Rates and schedule.
        images: Progress.
        factor: Multiplies all rates; below 1 after a return to a checkpoint.
        reset_at: Progress at the last opacity reset; None: there was none.
        revived_at: Progress when the motion was last reinitialised; None: never.
    """
    schedule = settings.schedule
    first, last = vars(settings.rates), vars(settings.rates_last)
    share = min(images / schedule.images, 1.0)
    begin = schedule.motion_decay_from
    shares = dict.fromkeys(first, share)
    shares["motion"] = min(max(images - begin, 0) / max(schedule.images - begin, 1), 1.0)
    images_of_step = _images(settings)
    linear = settings.schedule.batch_rule == BatchRule.LINEAR
    factor *= images_of_step if linear else math.sqrt(images_of_step)
    rates = {name: factor * _between(first[name], last[name], shares[name]) for name in first}
    paused = reset_at is not None and images < reset_at + schedule.pause_after_reset
    if images < schedule.warm_up or paused:
        rates["motion"] = 0.0
    elif schedule.motion_ramp:
        learnt = images - max(schedule.warm_up, revived_at or 0)
        rates["motion"] *= min((learnt + images_of_step) / schedule.motion_ramp, 1.0)
    if frozen(settings, images):
        rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
    return rates


def betas_of(settings: ReconSettings) -> tuple[float, float]:
    """Decays of both moments per step; per image they do not depend on the batch,
    if the batch rule says so.
    """
    images = _images(settings)
    return BETAS[0] ** images, BETAS[1] ** images


def _images(settings: ReconSettings) -> int:
    """Images of a step in learning-rate scaling; a last batch that is cut short counts as a whole
    one.
    """
    schedule = settings.schedule
    joint = (
        schedule.batch == Batch.QUARTET
        and settings.input != Input.PHASOR
        and settings.weights.quads > 0
    )
    return settings.cycle if joint and schedule.batch_rule != BatchRule.NONE else 1


def frozen(settings: ReconSettings, images: int) -> bool:
    """Whether only the motion is optimised after ``images`` optimised images."""
    schedule = settings.schedule
    return schedule.freeze_from is not None and images >= schedule.freeze_from * schedule.images


def _between(first: float, last: float, share: float) -> float:
    """Log-linear between two rates; a rate of 0 at either end is 0 all along."""
    return first * (last / first) ** share if first > 0 and last > 0 else 0.0


class Optimiser:
    """The optimised tensors and their moments, one group per tensor of the field and one for the
    motion.

    A step of Adam is render/descent.py. The harmonics of the colour are two tensors,
    ``colour_constant`` and ``colour_rest``, because their rates differ.
    """

    def __init__(
        self,
        field: GaussianField,
        motion: Motion,
        state: Mapping[str, Any] | None = None,
        *,
        betas: tuple[float, float] = BETAS,
    ):
        """Copy the tensors of a field, which become leaves; take the parameters of a motion.

        Args:
            field: The Gaussians.
            motion: Their motion.
            state: :meth:`state_dict` of an earlier optimiser of the same tensors, which continues
                with its decays; None: moments are zero.
            betas: Decays of both moments per step.
        """
        self.layer, self.betas = field.layer, betas
        parts = field.parameters()
        colour = parts.pop("colour_sh", None)
        if colour is not None:
            parts |= {"colour_constant": colour[:, :1], "colour_rest": colour[:, 1:]}
        self.tensors = {
            name: value.detach().clone().requires_grad_() for name, value in parts.items()
        }
        """Tensors of the field by name of their group."""
        self.motion = [parameter for parameter in motion.parameters() if parameter.numel()]
        """Parameters of the motion."""
        self._moments: dict[Tensor, Moments] = {}
        if state is not None:
            self._load(state)

    @property
    def field(self) -> GaussianField:
        """The Gaussians; their tensors are the leaves, those of the colour joined."""
        return field_of(self.tensors, self.layer)

    @property
    def leaves(self) -> list[Tensor]:
        """Everything that is optimised: the tensors of the field, then the motion."""
        return [*self.tensors.values(), *self.motion]

    @property
    def groups(self) -> list[str]:
        """Group of every leaf."""
        return [*self.tensors] + [MOTION] * len(self.motion)

    def moments_of(self, leaf: Tensor) -> Moments:
        """(step, first moment, second moment) of a leaf, zero at first."""
        if leaf not in self._moments:
            first, second = torch.zeros_like(leaf), torch.zeros_like(leaf)
            self._moments[leaf] = (
                torch.zeros((), device=leaf.device),
                first.detach(),
                second.detach(),
            )
        return self._moments[leaf]

    def put(self, name: str, value: Tensor, moments: Moments | None) -> None:
        """Replace one tensor of the field and its moments; None: zero."""
        self._moments.pop(self.tensors[name], None)
        self.tensors[name] = value
        if moments is not None:
            self._moments[value] = moments

    def replace(
        self, rows: Int[Tensor, "M"], old: int, change: Callable[[str, Tensor], None]
    ) -> None:
        """Rebuild every tensor of the field from rows of the present one, moments alike.

        Args:
            rows: Row of the present tensor that each new row is copied from.
            old: The first so many rows keep their moments; those of all others start at zero.
            change: Gets the name and the selected rows and changes them in place.
        """
        fresh = []
        for name, before in self.tensors.items():
            new = before.detach().index_select(0, rows)
            change(name, new)
            moments = self._moments.get(before)
            if moments is not None:
                step, *both = moments
                first, second = (moment.index_select(0, rows) for moment in both)
                fresh += [first[old:], second[old:]]
                moments = step, first, second
            self.put(name, new.requires_grad_(), moments)
        if fresh and old < len(rows):
            torch._foreach_zero_(fresh)
        if self.layer is not None:
            self.layer = self.layer.index_select(0, rows)

    def forget(self, name: str) -> None:
        """Zero the moments of one tensor of the field, not its number of steps."""
        _, *both = self.moments_of(self.tensors[name])
        torch._foreach_zero_(both)

    def forget_motion(self) -> None:
        """Zero the moments of the motion and its number of steps."""
        for leaf in self.motion:
            torch._foreach_zero_([*self.moments_of(leaf)])

    def state_dict(self) -> dict[str, Any]:
        """Moments in the layout of ``torch.optim.Adam``:
        tensors are numbered in the order of the groups.
        """
        numbers = {leaf: n for n, leaf in enumerate(self.leaves)}
        groups: dict[str, list[int]] = {}
        for n, name in enumerate(self.groups):
            groups.setdefault(name, []).append(n)
        shared = {"betas": self.betas, "eps": EPSILON}
        return {
            "state": {
                numbers[leaf]: dict(zip(STORED, moments, strict=True))
                for leaf, moments in self._moments.items()
            },
            "param_groups": [{"name": name, **shared, "params": of} for name, of in groups.items()],
        }

    def _load(self, stored: Mapping[str, Any]) -> None:
        """Take decays and moments from :meth:`state_dict`.

        Raises:
            ValueError: If its groups differ.
        """
        sizes = Counter(self.groups)
        groups = {group["name"]: len(group["params"]) for group in stored["param_groups"]}
        if sizes != groups:
            raise ValueError(f"tensors per group are {groups}, not {dict(sizes)}")
        self.betas = tuple(stored["param_groups"][0]["betas"])
        leaves = self.leaves
        for n, moments in stored["state"].items():
            step, first, second = (moments[name].to(leaves[n].device) for name in STORED)
            self._moments[leaves[n]] = step, first, second


def field_of(tensors: Mapping[str, Tensor], layer: Tensor | None) -> GaussianField:
    """A field of tensors by name of their group."""
    parts = dict(tensors)
    if "colour_rest" in parts:
        parts["colour_sh"] = torch.cat(
            [parts.pop("colour_constant"), parts.pop("colour_rest")], dim=1
        )
    return GaussianField(**parts, layer=layer)
