"""Runs of long recordings, whose windows are runs of their own."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...errors import InputError
from ...render.api import Rendering
from ...render.inputs import DIFFERENTIABLE
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from .. import source
from ..joined import Joined, Window, folder_of, refused
from ..read_back import ReadBack, read_back
from ..settings import Method
from . import gaussians
from .base import CORRECTED, Run, newest
from .empty import WithoutGaussians, with_empty_extra


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowedRun(WithoutGaussians):
    """A run of a long recording, whose windows are runs of their own, see joined.py.

    Times are those of the recording. Two windows are in memory at a time. Where they overlap, their
    fits are blended, and what is shown is the blended image after the settings ``fallback`` and
    ``outlines``.
    """

    joined: Joined[Run]
    """Its windows."""

    @classmethod
    def _opened(cls, path: Path, described: ReadBack, device: torch.device | str) -> Self:
        config = described.config
        source.check_windows(path, config)

        def opened(number: int) -> Run:
            gc.collect()  # a window that was closed may still refer to itself
            window = Run.open(folder_of(path, number), device)
            return replace(window, config=window.config | {"sequence": config["sequence"]})

        windows = [Window.of(stored) for stored in config["windows"]]
        reached = replace(described, config=config | _reached(path, len(windows)))
        return cls._empty(path, reached, device, joined=Joined(windows, opened))

    @property
    def gaussians(self) -> int:
        """Number of Gaussians of all windows."""
        return int(self.config["gaussians"])

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.config.get("colour_scale") is not None

    @torch.no_grad()
    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """What the sensor would see at one instant; as :meth:`Run.render`, extra channels are 0."""
        fits = Method(self.config["settings"].get("method", Method.GAUSSIANS)).fits
        if fits:
            camera = camera or self.camera

        def fitted(window: Run, local: float) -> Rendering:
            if isinstance(window, WithoutGaussians):
                return window.render(local, camera, f_mod_hz=f_mod_hz)
            view = camera or self.camera
            return gaussians.rendering_of(window, local, view, extra=None, f_mod_hz=f_mod_hz)

        rendering = self.joined.rendered(time, fitted)
        rendering = self.corrected(rendering, time, camera or self.camera, f_mod_hz)
        return with_empty_extra(rendering, extra)

    def renderer(
        self,
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
        *,
        f_mod_hz: float | None = None,
        corrected: bool = True,
    ) -> Callable[[float, Camera], Rendering]:
        """As :meth:`Run.renderer`."""
        names = frozenset(images)
        settings = self.config["settings"]
        corrects = settings.get("outlines") or settings.get("fallback")
        corrects = corrects and corrected and bool(names & CORRECTED)
        needed = names | {"distance", "phasor"} if corrects else names
        renderers: Joined[Callable[[float, Camera], Rendering]] = self.joined.mapped(
            lambda window: window.renderer(needed, f_mod_hz=f_mod_hz, corrected=False)
        )

        def shown(time: float, camera: Camera) -> Rendering:
            fit = renderers.rendered(time, lambda render, local: render(local, camera))
            return self.corrected(fit, time, camera, f_mod_hz) if corrects else fit

        return shown

    def corrected(
        self,
        rendering: Rendering,
        time: float,
        camera: Camera,
        f_mod_hz: float | None = None,
        *,
        light_only: bool = False,
    ) -> Rendering:
        """As :meth:`Run.corrected`, by the windows of the time."""
        return self.joined.rendered(
            time,
            lambda window, local: window.corrected(
                rendering, local, camera, f_mod_hz, light_only=light_only
            ),
        )

    def edited(self, field: GaussianField, rows: Int[Tensor, "N"] | None = None) -> Run:  # noqa: ARG002
        """Refused.

        Raises:
            UsageError: Always: each window has Gaussians of its own.
        """
        raise refused(self.path)

    def save(self, out: str | Path) -> Run:  # noqa: ARG002
        """Refused, as :meth:`edited`."""
        raise refused(self.path)


def _reached(path: Path, count: int) -> dict[str, Any]:
    """What the configs of all windows come to, with how far their newest readable checkpoints are:
    sums, damaged checkpoints, and attempts by window.
    """
    configs = {}
    for number in range(count):
        window = folder_of(path, number)
        described = read_back(window)
        # closed forms have no checkpoint; without a readable one, the window is refused when needed
        with suppress(InputError):
            described = newest(window, described, "cpu")[1]
        configs[window.relative_to(path).as_posix()] = described.config
    sums = ("images_optimised", "seconds_reconstruct")
    reached = {name: sum(config[name] for config in configs.values()) for name in sums}
    damaged = [
        f"{window}/{name}"
        for window, config in configs.items()
        for name in config.get("damaged_checkpoints", ())
    ]
    tried = {
        window: config["attempts"] for window, config in configs.items() if config.get("attempts")
    }
    return reached | {"damaged_checkpoints": damaged, "attempts_of_windows": tried}
