"""Runs without Gaussians."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from ...render.api import Rendering
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField, constant_sh
from ...scene.motion import Still
from ..read_back import ReadBack
from .base import Run


class WithoutGaussians(Run, abc.ABC):
    """A run of another method, whose field is empty."""

    @classmethod
    def _opened(cls, path: Path, described: ReadBack, device: torch.device | str) -> Self:
        return cls._empty(path, described, device)

    @classmethod
    def _empty(
        cls, path: Path, described: ReadBack, device: torch.device | str, **more: Any
    ) -> Self:
        field, motion = no_gaussians(device), Still(torch.tensor([0.0, 1.0])).to(device)
        return cls._of(path, described, field, motion, motion.bind(field), **more)

    def renderer(
        self,
        images: Iterable[str] = (),  # noqa: ARG002
        *,
        f_mod_hz: float | None = None,
        corrected: bool = True,  # noqa: ARG002
    ) -> Callable[[float, Camera], Rendering]:
        """:meth:`render`: there is nothing that images share."""
        return functools.partial(self.render, f_mod_hz=f_mod_hz)


def with_empty_extra(rendering: Rendering, extra: Float[Tensor, "0 D"] | None) -> Rendering:
    """A rendering without Gaussians, whose extra channels are zero if they are wanted."""
    if extra is None:
        return rendering
    size = rendering.distance.shape
    return replace(rendering, extra=rendering.distance.new_zeros(extra.shape[1], *size))


def no_gaussians(device: torch.device | str) -> GaussianField:
    """A field of N = 0 Gaussians."""
    none = torch.zeros(0, device=device)
    triple = none.reshape(0, 3)
    return GaussianField(
        mean=triple,
        log_scale=triple,
        quaternion=none.reshape(0, 4),
        opacity_logit=none,
        reflectivity_sh=constant_sh(none),
    )
