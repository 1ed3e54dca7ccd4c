"""The closed form as a method: what a camera computes by itself, behind the interface of a reconstruction.

Every quartet is decoded as if its raw frames had been taken at once (method, sections 2.9 and 7, row ``ctof``).
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

from ..data.decode import decode_quartet, quartet_phasors
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
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """The measured quartet nearest to a time, as if it had been taken at that instant.

        Quads are the measured ones in canonical order, computed from the phasor where the sensor has another shift; the
        distance is what all frequencies together decode to, and nothing is transparent. There is no colour and no
        distortion, and extra channels are zero.

        Args:
            time: Seconds since raw frame 0, any number; during a quartet its own, else the nearest complete one.
            camera: None, or the sequence's own at the time.
            extra: Channels per Gaussian, of which there are none.
            f_mod_hz: Modulation frequency of quads and phasor [Hz]; None: the first of the sensor.

        Raises:
            InputError: If the sequence cannot be read again, or none of its quartets is complete.
            UsageError: If it is asked for from another camera.
        """
        sequence = self._measured
        quartet = nearest_quartet(sequence, time)
        self._check(camera, sequence, quartet, time)
        decoded = decode_quartet(sequence, quartet)
        which = 0 if f_mod_hz is None else sequence.frequencies.index(f_mod_hz)
        re, im = decoded.phasors[which]
        size = (sequence.height, sequence.width)

        def tensor(image: np.ndarray) -> Tensor:
            return torch.tensor(image, dtype=torch.float32, device=self.field.device)

        return Rendering(
            quads=tensor(quads_of(sequence, quartet, self.sensor.shifts, which)),
            phasor=tensor(np.stack([re, im, np.hypot(re, im)])),
            colour=None,
            distance=tensor(decoded.distance),
            opacity=tensor(np.ones(size)),
            distortion=tensor(np.zeros(size)),
            extra=None if extra is None else tensor(np.zeros((extra.shape[1], *size))),
            screen=None,
        )

    def renderer(
        self,
        images: Iterable[str] = (),  # noqa: ARG002
        *,
        f_mod_hz: float | None = None,
    ) -> Callable[[float, Camera], Rendering]:
        """:meth:`render`: there is nothing that images share."""
        return functools.partial(self.render, f_mod_hz=f_mod_hz)

    def _check(self, camera: Camera | None, sequence: Sequence, quartet: int, time: float) -> None:
        """Refuse every camera but the sequence's own."""
        if camera is None:
            return
        frames = [*range(sequence.cycle * quartet, sequence.cycle * (quartet + 1))]
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
                why="a closed form needs all raw frames of a cycle in a row",
                fix="check the sequence with `gftorf check`, or record longer",
            )
        return sequence


def nearest_quartet(sequence: Sequence, time: float) -> int:
    """The complete quartet during which ``time`` [s] lies, else the one that ends or begins nearest to it."""

    def away(quartet: int) -> float:
        first = sequence.cycle * quartet
        start, end = sequence.times[first], sequence.times[first + sequence.cycle - 1]
        return max(float(start - time), float(time - end), 0.0)

    return min(sequence.complete_quartets, key=away)


def quads_of(
    sequence: Sequence, quartet: int, shifts: Iterable[float], frequency: int = 0
) -> Float[np.ndarray, "Q H W"]:
    """The raw frames of a quartet with these shifts [rad], at one of its frequencies.

    If these are not all that was measured there, they are a (cos(psi - shift) + dc_offset) of the decoded phasor:
    some of the measured ones decode to another phase than all of them.
    """
    frames, (re, im) = quartet_phasors(sequence, quartet)[frequency]
    shifts = list(shifts)
    slots = [channel_of(sequence.shifts[frames].tolist(), shift) for shift in shifts]
    if any(slot is None for slot in slots) or len(frames) != len(slots):
        constant = sequence.calibration.dc_offset * np.hypot(re, im)
        return np.stack([0.5 * (re * math.cos(shift) + im * math.sin(shift) + constant) for shift in shifts])
    return np.stack([sequence.quads[frames[slot]] for slot in slots if slot is not None])
