"""The closed form as a method: what a camera computes by itself, behind the interface of a reconstruction.

Every quartet is decoded as if its four raw frames had been taken at once (method, sections 2.9 and 7, row ``ctof``).
Nothing was fitted, so there is one distance per quartet and one place to look from.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..data.decode import distance_from_phase, quartet_phasor
from ..data.sequence import Sequence
from ..errors import InputError, UsageError
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField, constant_sh
from ..scene.motion import Still
from ..scene.sensor import Sensor, channel_of
from .run import Run

POSE_TOLERANCE = 1e-6  # [m], [1] poses are stored as float32 at worst


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedForm(Run):
    """A run without Gaussians, which renders its own measurements."""

    @classmethod
    def of(cls, path: Path, config: dict[str, Any], camera: Camera, sensor: Sensor, device: torch.device | str):
        """The closed form of the sequence that a config names.

        Args:
            path: The folder of the run.
            config: Content of its ``config.json``.
            camera: The camera of raw frame 0.
            sensor: The sensor, with the four canonical shifts.
            device: Where images are wanted.
        """
        none = torch.zeros(0, device=device)
        triple = none.reshape(0, 3)
        field = GaussianField(
            mean=triple,
            log_scale=triple,
            quaternion=none.reshape(0, 4),
            opacity_logit=none,
            reflectivity_sh=constant_sh(none),
        )
        motion = Still(torch.tensor([0.0, 1.0])).to(device)
        attachment = motion.attach(field)
        return cls(
            path=path,
            config=config,
            camera=camera,
            sensor=sensor,
            quad_scale=1.0,
            field=field,
            motion=motion,
            attachment=attachment,
        )

    def render(
        self, time: float, camera: Camera | None = None, *, extra: Float[Tensor, "0 D"] | None = None
    ) -> Rendering:
        """The measured quartet nearest to a time, as if it had been taken at that instant.

        Quads are the measured ones in canonical order, the distance is what they decode to, and nothing is transparent.
        There is no colour and no distortion, and extra channels are zero.

        Args:
            time: Seconds since raw frame 0, any number; during a quartet its own, else the nearest complete one.
            camera: None, or the sequence's own at the time.
            extra: Channels per Gaussian, of which there are none.

        Raises:
            InputError: If the sequence cannot be read again, or none of its quartets is complete.
            UsageError: If it is asked for from another camera.
        """
        sequence = self._measured
        quartet = nearest_quartet(sequence, time)
        self._check(camera, sequence, quartet, time)
        re, im = quartet_phasor(sequence, quartet)
        distance = distance_from_phase(np.arctan2(im, re), sequence)
        size = (sequence.height, sequence.width)

        def tensor(image: np.ndarray) -> Tensor:
            return torch.tensor(image, dtype=torch.float32, device=self.field.device)

        return Rendering(
            quads=tensor(np.stack([quad(sequence, quartet, shift) for shift in self.sensor.shifts])),
            phasor=tensor(np.stack([re, im, np.hypot(re, im)])),
            colour=None,
            distance=tensor(distance),
            opacity=tensor(np.ones(size)),
            distortion=tensor(np.zeros(size)),
            extra=None if extra is None else tensor(np.zeros((extra.shape[1], *size))),
            screen=None,
        )

    def renderer(self, images: Iterable[str] = ()) -> Callable[[float, Camera], Rendering]:  # noqa: ARG002
        """:meth:`render`: there is nothing that images share."""
        return self.render

    def _check(self, camera: Camera | None, sequence: Sequence, quartet: int, time: float) -> None:
        """Refuse every camera but the sequence's own."""
        if camera is None:
            return
        frames = [*range(FRAMES_PER_QUARTET * quartet, FRAMES_PER_QUARTET * (quartet + 1))]
        frames.append(int(np.abs(sequence.times - time).argmin()))
        apart = np.abs(sequence.camera_from_world[frames] - camera.camera_from_world).max(axis=(1, 2)).min()
        names = ("width", "height", "fx", "fy", "cx", "cy")
        differ = [name for name in names if not math.isclose(getattr(camera, name), getattr(self.camera, name))]
        if apart > POSE_TOLERANCE or differ:
            raise UsageError(
                "a closed form has one view",
                where=self.path,
                why="asked for another " + (", ".join(differ) or f"pose, {apart:.3g} away from that of the quartet"),
                fix="render other views from a run of Gaussians, for example --preset demo",
            )

    @functools.cached_property
    def _measured(self) -> Sequence:
        sequence = self.sequence()
        if not sequence.complete_quartets:
            raise InputError(
                "no complete quartet",
                where=sequence.path or "sequence",
                why="a closed form needs four measured raw frames in a row",
                fix="check the sequence with `gftorf check`, or record longer",
            )
        return sequence


def nearest_quartet(sequence: Sequence, time: float) -> int:
    """The complete quartet during which ``time`` [s] lies, else the one that ends or begins nearest to it."""

    def away(quartet: int) -> float:
        first = FRAMES_PER_QUARTET * quartet
        start, end = sequence.times[first], sequence.times[first + FRAMES_PER_QUARTET - 1]
        return max(float(start - time), float(time - end), 0.0)

    return min(sequence.complete_quartets, key=away)


def quad(sequence: Sequence, quartet: int, shift: float) -> Float[np.ndarray, "H W"]:
    """The raw frame of a quartet with a shift [rad]; if none has it, a cos(psi - shift) of the decoded phasor."""
    first = FRAMES_PER_QUARTET * quartet
    slot = channel_of(sequence.shifts[first : first + FRAMES_PER_QUARTET].tolist(), shift)
    if slot is not None:
        return sequence.quads[first + slot]
    re, im = quartet_phasor(sequence, quartet)
    return 0.5 * (re * math.cos(shift) + im * math.sin(shift))
