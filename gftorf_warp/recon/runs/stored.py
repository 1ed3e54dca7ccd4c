"""A finished run as its folder states it: configuration, Gaussians, and the sequence it was
made from.
"""

from __future__ import annotations

import dataclasses
import functools
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from jaxtyping import Float
from torch import Tensor

from ...data.sequence import Sequence
from ...render.buffers import RenderSettings
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from ...scene.motion import Motion
from ...scene.sensor import Sensor
from .. import source
from ..read_back import ReadBack, render_settings


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredRun:
    """What the folder of a run stores."""

    path: Path
    """The folder of the run."""
    config: dict
    """Content of ``config.json``."""
    camera: Camera
    """The camera of raw frame 0 at the sequence's own resolution."""
    sensor: Sensor
    """The sensor, with the four canonical shifts, at all its frequencies."""
    quad_scale: float
    """The sequence's units times this are those of the optimisation."""
    field: GaussianField
    """The Gaussians where nothing has moved, in the units of the optimisation."""
    motion: Motion
    """Where they are at which time."""
    binding: Float[Tensor, "N M"] = dataclasses.field(repr=False)
    """What the motion needs of each Gaussian, see :meth:`Motion.bind`."""

    @classmethod
    def _of(
        cls,
        path: Path,
        described: ReadBack,
        field: GaussianField,
        motion: Motion,
        binding: Float[Tensor, "N M"],
        **more: Any,
    ) -> Self:
        """The run that a config describes, with further fields of the class."""
        return cls(
            path=path,
            config=described.config,
            camera=described.camera,
            sensor=described.sensor,
            quad_scale=described.config.get("quad_scale", 1.0),
            field=field,
            motion=motion,
            binding=binding,
            **more,
        )

    @property
    def gaussians(self) -> int:
        """Number N of Gaussians."""
        return len(self.field)

    @property
    def has_colour(self) -> bool:
        """Whether colour can be rendered."""
        return self.field.colour_sh is not None

    @property
    def colour_scale(self) -> float:
        """The units of the sequence's colour images times this are those of the optimisation."""
        return float(self.config.get("colour_scale") or 1.0)

    @property
    def render_settings(self) -> RenderSettings:
        """How the run was rendered while it was optimised."""
        return render_settings(self.config)

    @functools.cached_property
    def _held(self) -> weakref.WeakValueDictionary[str, Sequence]:
        """The sequence, as long as another object refers to it."""
        return weakref.WeakValueDictionary()

    def sequence(self) -> Sequence:
        """The sequence it was made from, read again unless it is still in use.

        Raises:
            InputError: If it was never on disk, is gone, cannot be read, or is another one by now.
        """
        if (held := self._held.get("sequence")) is not None:
            return held
        self._held["sequence"] = sequence = source.sequence_of(self.path, self.config)
        return sequence

    def linked(self, sequence: str | Path) -> Self:
        """The run with its sequence in another folder, which is then stored in config.json.

        Raises:
            InputError: If the folder holds no sequence, or another one.
            BusyError: If a process works on the run.
        """
        return replace(self, config=source.link(self.path, self.config, sequence))


def at_frequency(sensor: Sensor, f_mod_hz: float | None) -> Sensor:
    """A sensor at one modulation frequency [Hz]; None: as it is."""
    return sensor if f_mod_hz is None else replace(sensor, f_mod_hz=f_mod_hz, further_hz=())
