"""Moving Gaussians that are rendered again and again: nothing is allocated, looked up or read back twice.

Displacements are computed once per key time and interpolated on the device. Cameras, calibration and the arrays of a
rendering are kept. On CUDA a camera that is used a second time has its rendering captured as a graph, so that an image
costs the host two launches, and the number of pairs is not read back but reserved; images that would need more are
rendered again. A replay runs the very launches of a call, so it gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ..kernels.motion import move
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from ..scene.sensor import Sensor
from . import launch
from .api import Rendering
from .bridge import ALIGNED, array_over, left_out
from .buffers import Frame, RenderSettings
from .cuda import stream_of, without_garbage_collection
from .inputs import CHOICES, Images, View, names_of, shapes_of, wanted_images
from .moved import MovedGaussians, footprint_row
from .pair_capacity import PairCapacity

CAMERAS_MAX = 16  # that are kept, with their graphs
Memory = TypeVar("Memory", Tensor, np.ndarray)


@dataclass(kw_only=True, eq=False)
class Target:
    """The arrays of all renderings of one size."""

    frame: Frame
    packed: Tensor  # [L] all images, one after the other, so that they move at once; last, as int32, their pairs
    places: dict[str, tuple[int, tuple[int, ...]]]  # where in it each of them starts, and its shape
    tensors: dict[str, Tensor]
    images: Images
    pairs: wp.array  # the last one of ``packed``


@dataclass(kw_only=True, eq=False)
class _View:
    """A camera that was used before."""

    view: View
    target: Target
    footprint: wp.vec4
    used: int = 0
    graph: wp.Graph | None = None


class Replay:
    """A field and its motion, ready to be rendered at any time from any camera; without gradients.

    ``replay(time, camera)`` returns images that the next call overwrites.
    """

    def __init__(
        self,
        field: GaussianField,
        motion: Motion,
        attachment: Tensor,
        sensor: Sensor,
        settings: RenderSettings,
        optimised: Camera,
        images: Iterable[str] = (*CHOICES, "colour"),
        *,
        colour_scale: float = 1.0,
    ):
        """Take a copy of what changes, and share the rest.

        Args:
            field: The Gaussians where nothing has moved, float32.
            motion: Where they are at which time.
            attachment: How they hang on it.
            sensor: With the shifts of the quads.
            settings: How to render; pairs are reserved as needed.
            optimised: The camera at the size of the optimisation, whose low-pass filter widened the Gaussians.
            images: Names of what is wanted of quads, phasor, colour, distance, opacity and distortion; others have no
                elements and cost nothing.
            colour_scale: What colour is divided by.

        Raises:
            ValueError: If there is no such image.
        """
        wp.init()
        self.settings, self.colour_scale = settings, colour_scale
        colour = {"colour"} & set(images) if field.colour_sh is not None else set()
        self.names, self._like = wanted_images(set(images) - {"colour"}) | colour, field.mean
        self.shifts = tuple(float(shift) for shift in sensor.shifts)
        self.device = wp.device_from_torch(field.device)
        self.graphs = self.device.is_cuda
        self.count = len(field)
        values = sensor.phase_slope, sensor.phase_offset, sensor.source_intensity, sensor.dc_offset
        calibration = torch.tensor([float(v) for v in values], dtype=torch.float32, device=field.device)
        self._gaussians = MovedGaussians(field, motion, attachment, calibration, optimised)
        self._views: dict[tuple, _View] = {}
        self._targets: dict[tuple[int, int], Target] = {}
        self._largest = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._capacity = PairCapacity()  # on a CPU pairs are always counted first

    def __call__(self, time: float, camera: Camera, *, checked: bool = True) -> Rendering:
        """The images at one instant, in memory that the next call overwrites.

        Args:
            time: Seconds since raw frame 0, any number; held constant outside the keys.
            camera: Where from, and how many pixels.
            checked: Whether to wait for the device and see that all pairs fitted. Without, ask :meth:`fits` later: far
                splats are missing in images for which the reserve was too small.
        """
        target = self.draw(time, camera)
        if checked and not self.fits():
            self.grow()
            target = self.draw(time, camera)
        return self.rendering(target.tensors, camera)

    def rendering(self, tensors: Mapping[str, Tensor], camera: Camera) -> Rendering:
        """Images by name as a rendering, without elements where there is none."""
        images = {name: tensors[name] if name in tensors else self._left_out(name, camera) for name in CHOICES}
        return Rendering(**images, colour=tensors.get("colour"), extra=None, screen=None)

    def fits(self) -> bool:
        """Whether the reserve of pairs sufficed since it was made; waits for the device."""
        return self._capacity.pairs is None or self._capacity.fits(self.largest)

    def grow(self) -> None:
        """Adapt the pair capacity to the largest number of pairs so far; graphs are captured anew."""
        if self.graphs:
            is_sorted = not all(target.frame.marks for target in self._targets.values())
            self._capacity.learn(self.largest, is_sorted=is_sorted)
        self._views.clear()
        self._targets.clear()

    @property
    def largest(self) -> int:
        """The largest number of (tile, splat) pairs of a rendering so far; waits for the device."""
        with stream_of(self._like):
            return int(self._largest.numpy()[0])

    @torch.no_grad()
    def draw(self, time: float, camera: Camera) -> Target:
        """The images at one instant, without a look at whether their pairs fitted; the next one overwrites them."""
        seen = self._view(camera)
        if self.graphs and self._capacity.pairs is not None and seen.used and seen.graph is None:
            seen.graph = self._captured(seen)
        self._gaussians.move(time, seen.footprint)
        with stream_of(self._like):
            if seen.graph is None:
                self._draw(seen)
            else:
                self._launch(seen.graph)
        seen.used += 1
        if self.graphs and self._capacity.pairs is None:
            self.grow()
        if "colour" in seen.target.tensors:
            seen.target.tensors["colour"].div_(self.colour_scale)
        return seen.target

    def _left_out(self, name: str, camera: Camera) -> Tensor:
        return left_out(name, self._like, camera.height, camera.width)

    def _captured(self, seen: _View) -> wp.Graph:
        """The rendering of a camera that was drawn before, on Warp's own stream: torch's default one cannot capture."""
        with without_garbage_collection(), wp.ScopedCapture(device=self.device) as capture:
            self._draw(seen)
        return capture.graph

    def _launch(self, graph: wp.Graph) -> None:
        """Replay on the stream that is current, which is torch's."""
        wp.capture_launch(graph, stream=self.device.stream)

    def _draw(self, seen: _View) -> None:
        """What a graph holds: a rendering, and the number of its pairs."""
        frame = seen.target.frame
        launch.forward(self._gaussians.inputs, seen.view, frame, seen.target.images, differentiable=False)
        if self.count:
            noted = [self._largest, seen.target.pairs]
            wp.launch(move.note_largest, 1, [frame.total], noted, device=self.device, record_tape=False)

    def _view(self, camera: Camera) -> _View:
        """What is kept for a camera; the one that came first leaves when there are too many."""
        lens = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion
        name = (*lens, camera.camera_from_world.tobytes())
        if name not in self._views:
            if len(self._views) >= CAMERAS_MAX:
                if self._views[first := next(iter(self._views))].graph is not None:
                    wp.synchronize_device(self.device)  # it may be at work
                self._views.pop(first)
            size = camera.height, camera.width
            if size not in self._targets:
                self._targets[size] = self._target(*size)
            view = launch.uploaded(camera, self.shifts, self.settings, self.device)
            self._views[name] = _View(view=view, target=self._targets[size], footprint=footprint_row(camera))
        return self._views[name]

    def _target(self, height: int, width: int) -> Target:
        shapes = shapes_of(len(self.shifts), height, width)
        places, length = {}, 0
        for name in (name for name in shapes if name in self.names):
            places[name] = length, shapes[name]
            length += -(-math.prod(shapes[name]) // ALIGNED) * ALIGNED
        packed = self._like.new_zeros(length + ALIGNED)
        tensors = {name: part(packed, *place) for name, place in places.items()}
        settings = replace(self.settings, pair_capacity=self._capacity.pairs)
        with stream_of(self._like):
            frame = Frame(self.count, width, height, settings, self.device)
        images = Images(**dict.fromkeys(names_of(Images)) | {name: array_over(tensors[name]) for name in tensors})
        pairs = array_over(packed[-1:].view(torch.int32), wp.int32)
        return Target(frame=frame, packed=packed, places=places, tensors=tensors, images=images, pairs=pairs)


def part(packed: Memory, start: int, shape: tuple[int, ...]) -> Memory:
    """The image of a shape that starts at an element of a memory of many."""
    return packed[start : start + math.prod(shape)].reshape(shape)
