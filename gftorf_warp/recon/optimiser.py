"""Adam over Gaussians and motion; every rate is set here, by one schedule (method, section 6.5)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict

import torch
from jaxtyping import Int
from torch import Tensor

from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from .adam import MOMENTS, Adam
from .settings import Batch, BatchRule, Input, ReconSettings

BETAS = (0.9, 0.999)  # of steps of one image
EPSILON = 1e-15  # far below any gradient here, so that a step depends on the direction of a gradient, not on its size
MOTION = "motion"  # the group of everything that is not of the field


def rates_at(
    settings: ReconSettings,
    images: int,
    factor: float = 1.0,
    *,
    reset_at: int | None = None,
    revived_at: int | None = None,
) -> dict[str, float]:
    """Learning rate of every group after ``images`` optimised images; 0 where a group rests.

    Log-linear from ``rates`` to ``rates_last`` at the end of the run. The motion rests during the warm-up and for a
    while after a reset of the opacities; then its rate rises from none. The Gaussians rest once they are frozen.

    Args:
        settings: Rates and schedule.
        images: Progress.
        factor: Multiplies all rates; below 1 after the run had to go back to a checkpoint.
        reset_at: Progress at the last reset of the opacities; None: there was none.
        revived_at: Progress when the motion was last drawn anew; None: it never was.
    """
    schedule = settings.schedule
    first, last = asdict(settings.rates), asdict(settings.rates_last)
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
    """Decays of both moments per step: as much is forgotten per image, whatever the batch, if its rule says so."""
    images = _images(settings)
    return BETAS[0] ** images, BETAS[1] ** images


def _images(settings: ReconSettings) -> int:
    """Images of a step as far as Adam is concerned; a last batch that is cut short counts as a whole one."""
    schedule = settings.schedule
    joint = schedule.batch == Batch.QUARTET and settings.input != Input.PHASOR and settings.weights.quads > 0
    return settings.cycle if joint and schedule.batch_rule != BatchRule.NONE else 1


def frozen(settings: ReconSettings, images: int) -> bool:
    """Whether only the motion is optimised after ``images`` optimised images."""
    schedule = settings.schedule
    return schedule.freeze_from is not None and images >= schedule.freeze_from * schedule.images


def _between(first: float, last: float, share: float) -> float:
    """Log-linear between two rates; a rate of 0 at either end is 0 all along."""
    return first * (last / first) ** share if first > 0 and last > 0 else 0.0


class Optimiser:
    """Adam with one group per tensor of the field and one for the motion.

    The harmonics of the colour are two tensors, ``colour_constant`` and ``colour_rest``, since their rates differ.
    """

    def __init__(
        self,
        field: GaussianField,
        motion: Motion,
        state: dict | None = None,
        *,
        betas: tuple[float, float] = BETAS,
    ):
        """Take copies of the tensors of a field, which become leaves, and the parameters of a motion.

        Args:
            field: The Gaussians.
            motion: Their motion.
            state: ``adam.state_dict()`` of an earlier optimiser of the same tensors, whose decays go on; None starts
                at zero.
            betas: Decays of both moments per step.
        """
        self.layer = field.layer
        parts = field.parameters()
        colour = parts.pop("colour_sh", None)
        if colour is not None:
            parts |= {"colour_constant": colour[:, :1], "colour_rest": colour[:, 1:]}
        groups = {name: [value.detach().clone().requires_grad_()] for name, value in parts.items()}
        movable = [parameter for parameter in motion.parameters() if parameter.numel()]
        self.adam = Adam(groups | ({MOTION: movable} if movable else {}), betas, EPSILON)
        if state is not None:
            self.adam.load_state_dict(state)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The tensors of the field by name of their group."""
        return {name: group[0] for name, group in self.adam.groups.items() if name != MOTION}

    @property
    def motion(self) -> list[Tensor]:
        """The parameters of the motion."""
        return self.adam.groups.get(MOTION, [])

    @property
    def field(self) -> GaussianField:
        """The Gaussians as they are; their tensors are the leaves, those of the colour joined."""
        parts = self.tensors
        if "colour_rest" in parts:
            parts["colour_sh"] = torch.cat([parts.pop("colour_constant"), parts.pop("colour_rest")], dim=1)
        return GaussianField(**parts, layer=self.layer)

    @property
    def betas(self) -> tuple[float, float]:
        """Decays of both moments per step."""
        return self.adam.betas

    @property
    def leaves(self) -> list[Tensor]:
        """Everything that is optimised: the tensors of the field, then the motion."""
        return self.adam.tensors

    def step(self, gradients: list[Tensor | None], rates: dict[str, float], motion_gradient_max: float | None) -> None:
        """One step of Adam.

        Args:
            gradients: Of ``leaves``; None is zero.
            rates: From :func:`rates_at`. A group of rate 0 is left alone, its moments included.
            motion_gradient_max: Longest gradient of the motion; a longer one is shortened. None: no limit.
        """
        of_motion = [gradient for gradient in gradients[len(self.tensors) :] if gradient is not None]
        if of_motion and motion_gradient_max is not None:
            _shorten(of_motion, motion_gradient_max)
        self.adam.step(gradients, rates)

    def moments_of(self, leaf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(step, first moment, second moment) of a leaf; zeros, as torch's Adam would begin, if it has none yet."""
        state = self.adam.remembered(leaf)
        return state["step"], state["exp_avg"], state["exp_avg_sq"]

    def settle(self, name: str, value: Tensor, moments: tuple[Tensor, Tensor, Tensor]) -> None:
        """Let one tensor of the field live elsewhere, with the moments that it has had so far."""
        self.adam.put(name, value, dict(zip(("step", *MOMENTS), moments, strict=True)))

    def replace(self, rows: Int[Tensor, "M"], old: int, change: Callable[[str, Tensor], None]) -> None:
        """Rebuild every tensor of the field from rows of the present one, moments alike.

        Args:
            rows: Which present Gaussian each new one comes from.
            old: So many, the first ones, go on; the moments of all others start at zero.
            change: Given a name and the selected rows, makes them the new values, in place.
        """
        fresh = []
        for name, before in self.tensors.items():
            new = before.detach().index_select(0, rows)
            change(name, new)
            state = self.adam.state.get(before)
            if state is not None:
                for moment in MOMENTS:
                    state[moment] = state[moment].index_select(0, rows)
                    fresh.append(state[moment][old:])
            self.adam.put(name, new.requires_grad_(), state)
        if fresh and old < len(rows):
            torch._foreach_zero_(fresh)
        if self.layer is not None:
            self.layer = self.layer.index_select(0, rows)

    def forget(self, name: str) -> None:
        """Zero the moments of one tensor of the field."""
        for key, value in self.adam.state.get(self.tensors[name], {}).items():
            if key in MOMENTS:
                value.zero_()

    def forget_motion(self) -> None:
        """Zero the moments of the motion and the number of its steps, as at the start."""
        for leaf in self.motion:
            for value in self.adam.state.get(leaf, {}).values():
                value.zero_()


def _shorten(gradients: list[Tensor], longest: float) -> None:
    """Scale gradients together, in place, so that they are at most as long as ``longest``."""
    length = torch.nn.utils.get_total_norm(gradients)
    share = (longest / (length + 1e-6)).clamp(max=1.0)  # the device need not be asked
    for gradient in gradients:
        gradient.mul_(share)
