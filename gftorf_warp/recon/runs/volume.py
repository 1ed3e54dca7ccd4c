"""Runs of neural volumes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from ...render.api import Rendering
from ...scene.camera import Camera
from ..read_back import ReadBack
from ..settings import Method
from ..volume.models import volume_from_dict
from ..volume.render import rendering_of
from ..volume.settings import settings_of
from ..volume.volume import Volume
from .base import newest
from .empty import WithoutGaussians, with_empty_extra
from .stored import at_frequency


@dataclass(frozen=True, kw_only=True, eq=False)
class VolumeRun(WithoutGaussians):
    """A run of a neural volume."""

    volume: Volume
    """What is seen."""

    @classmethod
    def _opened(cls, path: Path, described: ReadBack, device: torch.device | str) -> Self:
        stored, described = newest(path, described, device)
        settings = described.config["settings"]
        known, method = settings_of(settings["volume"]), Method(settings["method"])
        volume = volume_from_dict(path, method, known, stored, device)
        return cls._empty(path, described, device, volume=volume)

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.volume.box.colour

    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """What the sensor would see at one instant; as :meth:`Run.render`, extra channels are 0.

        Args:
            time: Seconds since raw frame 0, any number; beyond the recording as at its ends.
            camera: Where from, and how many pixels; None is the sequence's own.
            extra: Channels per Gaussian, of which there are none.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.
        """
        camera = camera or self.camera
        rendering = rendering_of(
            self.volume,
            time,
            camera,
            at_frequency(self.sensor, f_mod_hz),
            quad_scale=self.quad_scale,
            colour_scale=self.colour_scale,
        )
        return with_empty_extra(rendering, extra)
