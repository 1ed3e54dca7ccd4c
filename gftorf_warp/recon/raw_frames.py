"""What was fitted, rendered at the raw frames of its sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Protocol

import torch

from ..data.sequence import Sequence
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import Sensor

PLANES = 10  # [images] of all that `compare` needs of a rendering
KEPT_BYTES_MAX = 1 << 30  # [bytes] of renderings


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
        self, run: Fitted, sequence: Sequence, images: Iterable[str], *, kept: bool = False
    ):
        """Prepare a renderer for each frequency.

        Args:
            run: What was fitted.
            sequence: Whose raw frames, at any size.
            images: Names as in :meth:`gftorf_warp.Run.renderer`.
            kept: Whether a second call for the same raw frame returns the same images, if those of
                all raw frames fit into a gigabyte; otherwise every call overwrites the last ones.
        """
        self.sequence = sequence
        """Whose raw frames."""
        self.camera = run.camera.resized(sequence.width, sequence.height)
        """The camera of raw frame 0."""
        names = tuple(images)
        self._render = {
            f: run.renderer(names, f_mod_hz=f, corrected=False) for f in sequence.frequencies
        }
        count = sequence.frames * len(sequence.frequencies)
        size = 4 * PLANES * count * sequence.width * sequence.height
        self._kept: dict[tuple[int, float], Rendering] | None = None
        if kept and size <= KEPT_BYTES_MAX:
            self._kept = {}

    def camera_at(self, n: int) -> Camera:
        """The camera of raw frame n."""
        return self.camera.at(self.sequence.camera_from_world[n])

    def __call__(self, n: int, f_mod_hz: float) -> Rendering:
        """Raw frame n at one of the frequencies of the sequence [Hz]."""
        known = self._kept
        if known is not None and (n, f_mod_hz) in known:
            return known[n, f_mod_hz]
        rendering = self._render[f_mod_hz](float(self.sequence.times[n]), self.camera_at(n))
        if known is not None:
            images = {name: _copied(image) for name, image in vars(rendering).items()}
            known[n, f_mod_hz] = rendering = replace(rendering, **images)
        return rendering


def _copied(image: Any) -> Any:
    return image.clone() if isinstance(image, torch.Tensor) else image
