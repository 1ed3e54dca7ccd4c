"""What a volume is compared with, pixel by pixel and on its device, and how pixels are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...data.decode import closed_form_distance, quartet_phasor
from ..observations import ImageStack, Observations
from .rays import Views, mean_pose

NEARER, FARTHER = 0.9, 1.1  # [1] bounds reach so far beyond the distances in them
OUTLIERS = 0.005  # share of decoded distances at either end that does not count
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Around:
    """B measured raw frames less than a cycle from the start of a quartet."""

    frames: tuple[int, ...]
    """Their numbers: the start, then those before it, then those after it."""
    before: tuple[float, ...]
    """Cycles from the b before it to the start [1]."""
    after: tuple[float, ...]
    """Cycles from the start to the a after it [1]."""
    shift: tuple[float, ...]
    """Their phase shifts [rad]."""
    slope: tuple[float, ...]
    """Their phases per distance [rad/m]."""

    def some(self, count: int | None, draw: Draw) -> Around:
        """The start and at most ``count`` raw frames in a row before it and after it, at random;
        None: all.
        """
        b, a = len(self.before), len(self.after)
        if count is None or (count >= b and count >= a):
            return self
        before, after = draw.part_of(b, count), draw.part_of(a, count)

        def rows(values: tuple[T, ...]) -> tuple[T, ...]:
            ahead, behind = values[1 : 1 + b], values[1 + b :]
            return values[:1] + ahead[before] + behind[after]

        return Around(
            frames=rows(self.frames),
            before=self.before[before],
            after=self.after[after],
            shift=rows(self.shift),
            slope=rows(self.slope),
        )


class Targets:
    """Measurements by pixel, numbered row by row, and the rays through them."""

    def __init__(self, observations: Observations):
        """Take what is compared from the observations of a run."""
        sequence, device = observations.sequence, observations.quads.device
        self.observations, self.cycle = observations, sequence.cycle
        self._around: dict[tuple[int, bool], Around] = {}
        self.quads: Float[Tensor, "F P"] = observations.quads.flatten(1)
        """Raw frames."""
        self.phasors: Float[Tensor, "r 2 P"] = _by_pixel(observations.phasors)
        """Phasors, in the order of ``phasor_frames``; empty if quads are compared."""
        self.phasor_frames = list(observations.phasors.rows)
        """The raw frame that represents each phasor."""
        sensors = [observations.sensor_at(n) for n in self.phasor_frames]
        self.phasor_slopes = [float(sensor.phase_slope) for sensor in sensors]
        """Their phases per distance [rad/m]."""
        self.flow: Float[Tensor, "r 2 2 P"] = _by_pixel(observations.flow)
        """Optical flow [px] in the order of ``flow_quartets``, forward and backward; NaN:
        unknown."""
        self.flow_rows = observations.flow.rows
        """Row of each quartet in it."""
        self.volume_from_world = mean_pose(sequence.camera_from_world)
        """Axes of the volume."""
        own = observations.cameras[0].camera_from_world @ np.linalg.inv(self.volume_from_world)
        self.camera = observations.cameras[0].at(own)
        """The camera of raw frame 0 in the axes of the volume, at the size of the optimisation."""
        self.views = Views(observations.cameras, self.volume_from_world, device)
        """Rays of raw frames."""
        self.colour_frames = list(observations.colour.rows)
        """Raw frames with a colour image."""
        self.colour: Float[Tensor, "r 3 p"] | None = None
        """Colour images, in that order."""
        self.colour_views: Views | None = None
        """Rays of colour images, in that order."""
        if self.colour_frames:
            cameras = [observations.colour_cameras[n] for n in self.colour_frames]
            self.colour = _by_pixel(observations.colour)
            self.colour_views = Views(cameras, self.volume_from_world, device)

    def around(self, quartet: int, *, after_only: bool = False) -> Around:
        """The raw frames around the start of a quartet, or only its own."""
        if (quartet, after_only) not in self._around:
            start, cycle = self.cycle * quartet, self.cycle
            first = start if after_only else max(0, start - cycle + 1)
            known = self.observations.sequence.measured
            measured = [n for n in range(first, min(start + cycle, len(known))) if known[n]]
            before, after = [n for n in measured if n < start], [n for n in measured if n > start]
            frames = (start, *before, *after)
            sensors = [self.observations.sensor_at(n) for n in frames]
            self._around[quartet, after_only] = Around(
                frames=frames,
                before=tuple((start - n) / cycle for n in before),
                after=tuple((n - start) / cycle for n in after),
                shift=tuple(sensor.shifts[0] for sensor in sensors),
                slope=tuple(float(sensor.phase_slope) for sensor in sensors),
            )
        return self._around[quartet, after_only]

    @property
    def quartet_times(self) -> list[float]:
        """Time of the first raw frame of every quartet [s]."""
        return self.observations.sequence.times[:: self.cycle].tolist()

    def bounds(self) -> tuple[float, float]:
        """z-depths [m] that hold what was decoded where there is light: 0.9 of the smallest, 1.1 of
        the largest.
        """
        sequence = self.observations.sequence
        cosine = self.camera.directions()[..., 2]
        quartets = sequence.complete_quartets
        decoded = torch.from_numpy(np.stack([closed_form_distance(sequence, i) for i in quartets]))
        lit = np.stack([np.hypot(*quartet_phasor(sequence, i)) > 0.0 for i in quartets])
        z = (decoded * cosine)[torch.from_numpy(lit)].float()
        z = z[:: max(1, len(z) // 1_000_000)]  # as many as a quantile takes
        near, far = torch.quantile(z, torch.tensor([OUTLIERS, 1.0 - OUTLIERS])).tolist()
        return NEARER * near, FARTHER * far


def picked(
    images: Float[Tensor, "r *c P"], row: Int[Tensor, "1"], pixels: Int[Tensor, "R"]
) -> Float[Tensor, "*c R"]:
    """Some pixels of one of several images, whose number is on the device."""
    return images.index_select(0, row)[0][..., pixels]


def _by_pixel(stack: ImageStack) -> Float[Tensor, "r *c P"] | Float[Tensor, "0"]:
    """Images with one axis of pixels; an empty stack as it is."""
    return stack.images.flatten(-2) if stack else stack.images


class Draw:
    """The random numbers of a run: on the host what decides about launches, else on the device."""

    def __init__(self, seed: int, device: torch.device):
        """Seed both generators."""
        self.host = torch.Generator().manual_seed(seed)
        self.device = torch.Generator(device).manual_seed(seed)

    def one_of(self, choices: Sequence[T]) -> T:
        """One of them, all alike."""
        return choices[int(torch.randint(len(choices), (), generator=self.host))]

    def part_of(self, length: int, count: int) -> slice:
        """``count`` neighbours out of so many, or all if there are no more."""
        first = int(torch.randint(max(1, length - count + 1), (), generator=self.host))
        return slice(first, first + count)

    def pixels(self, count: int, of: int) -> Int[Tensor, "R"]:
        """Numbers of pixels."""
        return torch.randint(of, (count,), generator=self.device, device=self.device.device)

    def noise(self, like: Tensor, deviation: float) -> Tensor:
        """Normal noise of the shape of a tensor."""
        return deviation * torch.randn(
            like.shape, generator=self.device, device=like.device, dtype=like.dtype
        )

    def states(self) -> dict[str, Tensor]:
        """Both states, for a checkpoint."""
        return {"host": self.host.get_state(), "device": self.device.get_state()}

    def restore(self, states: dict[str, Tensor]) -> None:
        """Go on where a checkpoint was written; on another kind of device with other numbers."""
        self.host.set_state(states["host"].cpu())
        state = states["device"].cpu()
        if len(state) == len(self.device.get_state()):
            self.device.set_state(state)
        else:
            self.device.manual_seed(int(torch.randint(1 << 62, (), generator=self.host)))
