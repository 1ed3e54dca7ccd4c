"""A finished run rendered many times: memory is kept, the motion at a key is computed once, nothing
is read back.

On CUDA the second and all further renderings of one size are one CUDA graph, whatever the camera,
so that an image costs the host two launches. Memory is reserved for as many (tile, splat) pairs as
:class:`PairCapacity` says; a rendering that needed more is repeated. Graph and launches give the
same bits.
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

from ..kernels.motion.move import note_largest
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from ..scene.sensor import Sensor
from . import launch, runtime
from .api import Rendering
from .bridge import ALIGNED, array_over, left_out
from .buffers import Buffers, RenderSettings
from .cuda import stream_of, without_garbage_collection
from .inputs import CHOICES, DIFFERENTIABLE, Images, View, names_of, shapes_of, wanted_images
from .moved import MovedGaussians
from .pair_capacity import PairCapacity

Memory = TypeVar("Memory", Tensor, np.ndarray)


@dataclass(kw_only=True, eq=False)
class Target:
    """Workspace and images of all renderings of one size."""

    buffers: Buffers
    view: View
    packed: Tensor  # [L] all images, then, as int32, their number of pairs
    places: dict[str, tuple[int, tuple[int, ...]]]  # first element and shape of every image in it
    tensors: dict[str, Tensor]
    images: Images
    pairs: wp.array  # last element of ``packed``
    used: bool = False
    graph: wp.Graph | None = None


class Replay:
    """A field and its motion, rendered at any time from any camera; without gradients.

    ``replay(time, camera)`` returns images that the next call overwrites.
    """

    def __init__(
        self,
        field: GaussianField,
        motion: Motion,
        binding: Tensor,
        sensor: Sensor,
        settings: RenderSettings,
        optimised: Camera,
        images: Iterable[str] = (*DIFFERENTIABLE, "colour"),
        *,
        colour_scale: float = 1.0,
    ):
        """Allocate what does not depend on the size of images.

        Args:
            field: The undisplaced Gaussians, float32.
            motion: Their motion.
            binding: What ``motion.bind`` returned for them.
            sensor: With the shifts of the quads.
            settings: How to render; the pair capacity is adapted.
            optimised: The camera at the size of the optimisation, whose low-pass filter widened the
                Gaussians.
            images: Names of the images to compute, of quads, phasor, colour, distance, opacity,
                distortion and distance_median.
            colour_scale: Colour is divided by this.

        Raises:
            ValueError: If an image has an unknown name.
        """
        runtime.start()
        self.settings, self.colour_scale = settings, colour_scale
        colour = {"colour"} & set(images) if field.colour_sh is not None else set()
        self.names, self._like = wanted_images(set(images) - {"colour"}) | colour, field.mean
        self.device = wp.device_from_torch(field.device)
        self.graphs = self.device.is_cuda
        """Whether renderings are captured."""
        shifts = [(math.cos(shift), math.sin(shift)) for shift in sensor.shifts]
        self._shifts = wp.array(shifts, dtype=wp.vec2, device=self.device)
        calibration = field.mean.new_tensor([float(value) for value in sensor.calibration])
        self._gaussians = MovedGaussians(field, motion, binding, calibration, optimised, settings)
        self._targets: dict[tuple[int, int, bool], Target] = {}
        self._largest = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._capacity = PairCapacity()  # on a CPU pairs are always counted first

    def __call__(self, time: float, camera: Camera, *, checked: bool = True) -> Rendering:
        """The images at one time, in memory that the next call overwrites.

        Args:
            time: Seconds since raw frame 0, any number; motion is constant outside the keys.
            camera: Pose, intrinsics and size.
            checked: Whether to synchronise and repeat a rendering whose pairs exceeded the
                capacity. Otherwise far splats are missing in such images; :meth:`fits` returns
                whether there was one.
        """
        target = self.draw(time, camera)
        if checked and not self.fits():
            self.grow()
            target = self.draw(time, camera)
        return self.rendering(target.tensors, camera)

    def rendering(self, tensors: Mapping[str, Tensor], camera: Camera) -> Rendering:
        """Images by name as a rendering; those that are absent have no elements."""
        size = camera.height, camera.width
        images = {
            name: tensors[name] if name in tensors else left_out(name, self._like, *size)
            for name in CHOICES
        }
        return Rendering(**images, colour=tensors.get("colour"), extra=None, screen=None)

    def fits(self) -> bool:
        """Whether no rendering exceeded the pair capacity since it last changed; synchronises."""
        return self._capacity.pairs is None or self._capacity.fits(self.largest)

    def grow(self) -> None:
        """Adapt the pair capacity to the largest number of pairs; release memory and graphs."""
        if self.graphs:
            is_sorted = not all(target.buffers.marks for target in self._targets.values())
            self._capacity.learn(self.largest, is_sorted=is_sorted)
        self._targets.clear()

    def reserve(self, pairs: int) -> None:
        """Set the pair capacity of the next renderings; release memory and graphs."""
        self._capacity.pairs = pairs
        self._targets.clear()

    @property
    def capacity(self) -> int | None:
        """(tile, splat) pairs with memory in a rendering; None: as many as it has."""
        return self._capacity.pairs

    @property
    def largest(self) -> int:
        """Largest number of (tile, splat) pairs of a rendering so far; synchronises."""
        with stream_of(self._like):
            return int(self._largest.numpy()[0])

    @torch.no_grad()
    def draw(self, time: float, camera: Camera) -> Target:
        """Images at one time, overwritten by the next call, with unchecked number of pairs."""
        size = camera.height, camera.width, bool(camera.distortion)
        if size not in self._targets:
            self._targets[size] = self._target(*size)
        target = self._targets[size]
        known = self.graphs and self._capacity.pairs is not None
        if known and target.used and target.graph is None:
            target.graph = self.capture(target)
        self._gaussians.move(time, camera)
        with stream_of(self._like):
            if target.graph is None:
                self.launch_kernels(target)
            else:
                self.launch(target.graph)
        target.used = True
        if self.graphs and self._capacity.pairs is None:
            self.grow()
        if "colour" in target.tensors:
            target.tensors["colour"].div_(self.colour_scale)
        return target

    def capture(self, target: Target) -> wp.Graph:
        """Capture a rendering on Warp's stream: torch's default stream cannot be captured."""
        with runtime.LAUNCHING, without_garbage_collection():
            with wp.ScopedCapture(device=self.device) as capture:
                self.launch_kernels(target)
        return capture.graph

    def launch(self, graph: wp.Graph) -> None:
        """Launch a graph on the current stream, which is torch's."""
        wp.capture_launch(graph, stream=self.device.stream)

    def launch_kernels(self, target: Target) -> None:
        """The launches of a rendering, and of storing its number of pairs."""
        inputs, buffers = self._gaussians.inputs, target.buffers
        launch.forward(inputs, target.view, buffers, target.images, differentiable=False)
        if len(self._like):
            counts, where = [self._largest, target.pairs], {"device": self.device}
            runtime.launch(note_largest, 1, [buffers.total], counts, **where)

    def _target(self, height: int, width: int, lens: bool) -> Target:
        """Memory for renderings of one size, through a lens or not."""
        shapes = shapes_of(len(self._shifts), height, width)
        places, length = {}, 0
        for name in (name for name in shapes if name in self.names):
            places[name] = length, shapes[name]
            length += -(-math.prod(shapes[name]) // ALIGNED) * ALIGNED
        packed = self._like.new_zeros(length + ALIGNED)
        tensors = {name: part(packed, *span) for name, span in places.items()}
        settings = replace(self.settings, pair_capacity=self._capacity.pairs)
        with stream_of(self._like):
            buffers = Buffers(len(self._like), width, height, settings, self.device)
        return Target(
            buffers=buffers,
            view=View(camera=self._gaussians.view, shifts=self._shifts, lens=lens),
            packed=packed,
            places=places,
            tensors=tensors,
            images=Images(**{name: array_over(tensors.get(name)) for name in names_of(Images)}),
            pairs=array_over(packed[-1:].view(torch.int32), wp.int32),
        )


def part(packed: Memory, start: int, shape: tuple[int, ...]) -> Memory:
    """One image in the memory of many: its first element and shape."""
    return packed[start : start + math.prod(shape)].reshape(shape)
