"""What was fitted, rendered at the raw frames of its sequence."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import Any, Protocol

import torch

from ..data.resources import RENDERINGS_KEPT_MAX, RENDERINGS_OF_PIXEL
from ..data.sequence import Sequence
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import Sensor


class Fitted(Protocol):
    """What is needed of a :class:`gftorf_warp.recon.run.Run`."""

    @property
    def config(self) -> dict:
        """Content of config.json."""

    @property
    def camera(self) -> Camera:
        """The camera of raw frame 0 at the sequence's own resolution."""

    @property
    def sensor(self) -> Sensor:
        """The sensor, with the four canonical shifts."""

    def renderer(
        self, images: Iterable[str], *, f_mod_hz: float | None, corrected: bool
    ) -> Callable[[float, Camera], Rendering]:
        """A function of time [s] and camera."""


class RawFrames:
    """Renderings of a run before fallback and outlines, each raw frame at its own time and pose."""

    def __init__(
        self,
        run: Fitted,
        sequence: Sequence,
        images: Iterable[str],
        *,
        kept: Collection[int] = (),
    ):
        """Prepare a renderer for each frequency.

        Args:
            run: What was fitted.
            sequence: Whose raw frames, at any size.
            images: Names as in :meth:`gftorf_warp.Run.renderer`.
            kept: Raw frames that are wanted twice: their images stay, if all of them fit into
                ``RENDERINGS_KEPT_MAX``; every call overwrites those of others.
        """
        self.sequence = sequence
        """Whose raw frames."""
        self.camera = run.camera.resized(sequence.width, sequence.height)
        """The camera of raw frame 0."""
        names = tuple(images)
        self._render = {
            f: run.renderer(names, f_mod_hz=f, corrected=False) for f in sequence.frequencies
        }
        size = RENDERINGS_OF_PIXEL * len(kept) * sequence.width * sequence.height
        self._stays = frozenset(kept) if size <= RENDERINGS_KEPT_MAX else frozenset()
        self._kept: dict[tuple[int, float], Rendering] = {}

    def camera_at(self, n: int) -> Camera:
        """The camera of raw frame n."""
        return self.camera.at(self.sequence.camera_from_world[n])

    def __call__(self, n: int, f_mod_hz: float) -> Rendering:
        """Raw frame n at one of the frequencies of the sequence [Hz]."""
        if (n, f_mod_hz) in self._kept:
            return self._kept[n, f_mod_hz]
        rendering = self._render[f_mod_hz](float(self.sequence.times[n]), self.camera_at(n))
        # residuals need a raw frame at its own frequency only
        if n in self._stays and f_mod_hz == self.sequence.frame_frequencies[n]:
            images = {name: _copied(image) for name, image in vars(rendering).items()}
            self._kept[n, f_mod_hz] = rendering = replace(rendering, **images)
        return rendering


def _copied(image: Any) -> Any:
    return image.clone() if isinstance(image, torch.Tensor) else image
