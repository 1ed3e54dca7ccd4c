"""The control block of a step: everything that differs between two steps of one kind, as device
data.

The host writes frame numbers, key numbers, interpolation weights, cameras, weights of the terms and
learning rates into one buffer and uploads it before the step; kernels read it. So one CUDA graph
serves every raw frame, pose, modulation frequency, phase shift and progress of the run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..render import fused
from ..render.buffers import RenderSettings
from ..render.control import DeviceCamera, packed
from ..render.cuda import DeviceUpload
from ..render.descent import RESULTS
from ..scene.motion import Motion
from .blending import Blending
from .keys import GraphKey, GraphKeys
from .observations import Observations
from .settings import ReconSettings
from .terms import Term, View

ROWS = ("light", "depth", "colour", "flow")  # row numbers of an image, see ``BatchImage.rows``
NUMBERS = len(ROWS) + 2  # integers of an image: its rows, seed and number of its random background
FLOWS = 2  # of a quartet: to the next one and to the previous one


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageControl:
    """Device memory of one image of the batch."""

    rows: dict[str, Int[Tensor, "1"]]
    """Rows of the measured images by name of ``ROWS``."""
    noise_origin: Int[Tensor, "2"]
    """Seed and number of its random background."""
    blend: dict[View, Float[Tensor, "D K"]]
    """Interpolation weights of the motion keys: first of the time of the view; where there is flow,
    then differences of weights between the end and the start of either flow."""
    camera: dict[View, DeviceCamera]
    """Camera, calibration and phase shift."""
    flow_cameras: Float[Tensor, "2 V"]
    """Cameras at the ends of both flows."""

    @classmethod
    def over(
        cls, ints: Tensor, parts: dict[tuple[str, View], Tensor], keys: int, *, flow: bool
    ) -> ImageControl:
        """Views of the integers and floats of one image, of K ``keys``, with or without flow."""
        blend = {}
        for view in View:
            rows = 1 + FLOWS if view != View.COLOUR and flow else 1
            blend[view] = parts["blend", view][: rows * keys].view(rows, keys)
        cameras = {
            view: DeviceCamera.over(parts["camera", view]) for view in (View.TOF, View.COLOUR)
        }
        return cls(
            rows={name: ints[k : k + 1] for k, name in enumerate(ROWS)},
            noise_origin=ints[len(ROWS) :],
            blend=blend,
            camera=cameras | {View.FLOW: cameras[View.TOF]},
            flow_cameras=parts["camera", View.FLOW].view(FLOWS, -1),
        )


class ControlBlock:
    """Layout, host values and device memory of the control block of one run."""

    def __init__(
        self,
        observations: Observations,
        settings: ReconSettings,
        terms: Sequence[Term],
        motion: Motion,
        groups: Sequence[str],
    ):
        """Reserve memory.

        Args:
            observations: What is compared.
            settings: Of the run.
            terms: All terms of the loss.
            motion: The motion model.
            groups: Learning-rate group of every optimised tensor.
        """
        self.observations, self.settings = observations, settings
        self.terms, self.groups = terms, groups
        self.images = max(len(batch) for batch in observations.batches)
        self._blending = Blending(observations, motion)
        keys, first = self._blending.counts[True], observations.batches[0][0]
        camera = len(camera_at(observations, settings.render, View.TOF, first))
        flow_cameras = flow_cameras_at(observations, first)
        self._parts: dict[tuple[str, View], tuple[int, ...]] = {
            ("camera", View.TOF): (camera,),
            ("camera", View.COLOUR): (camera,),
            ("camera", View.FLOW): flow_cameras.shape,
            ("blend", View.TOF): (1 + FLOWS, keys),
            ("blend", View.COLOUR): (1, keys),
            ("blend", View.FLOW): (1 + FLOWS, keys),
        }
        self.graph_keys = GraphKeys(observations, terms, self._blending)
        """Which operations a step consists of."""
        self._constants: dict[tuple, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        results = self.images * len(terms) * RESULTS
        sizes = len(groups) + 1, results, self.images * self._image_floats
        ints = keys + self.images * NUMBERS
        self._upload = DeviceUpload(
            [(ints, torch.int32), (sum(sizes), torch.float32)], observations.quads.device
        )
        self._ints, floats = self._upload.parts
        scalars, weights, constants = floats.split(sizes)
        self.rates: Float[Tensor, "G"] = scalars[: len(groups)]
        """Learning rate of every optimised tensor."""
        self.compared: Float[Tensor, "1"] = scalars[-1:]
        """Number of images of the batch that are compared at all."""
        self.weights: Float[Tensor, "B T 3"] = weights.view(self.images, len(terms), RESULTS)
        """Weights of all results; 0 where an image has no such term."""
        self._floats = constants.view(self.images, -1)

    # -- host --------------------------------------------------------------------------------------

    def write(
        self,
        key: GraphKey,
        frames: list[int],
        first: int,
        seed: int,
        weights: tuple[float, ...],
        rates: dict[str, float],
    ) -> None:
        """Upload the values of the next step, asynchronously.

        Args:
            key: Of the step.
            frames: Raw frames of the batch.
            first: Number of its first image, counted over the run.
            seed: Of random backgrounds.
            weights: Of all terms.
            rates: Learning rate by group.
        """
        name = (*frames, key)
        if name not in self._constants:
            self._constants[name] = self._constants_of(key, frames)
        ints, present, constants = self._constants[name]
        origins = ints[-self.images * NUMBERS :].reshape(self.images, NUMBERS)[:, len(ROWS) :]
        origins[:, 0], origins[:, 1] = seed, np.arange(first, first + self.images)
        scale = np.ones((len(self.terms), RESULTS), np.float32)
        scale[:, 0] = weights
        compared = sum(bool(image.terms) for image in key.images)
        scalars = [*(rates[name] for name in self.groups), compared]
        factors = (present * scale).ravel()
        self._upload.send(ints, np.concatenate([scalars, factors, constants], dtype=np.float32))

    def _constants_of(
        self, key: GraphKey, frames: list[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What frames and key of a batch decide, in the layout of the device.

        Returns:
            Integers; factors [B, T, 3] of the results; other floats.
        """
        flow = key.has_flow
        keys = self._blending.keys_of(frames, flow=flow) if key.keys else []
        keys += keys[-1:] * (key.keys - len(keys))  # a repeated key of weight 0
        ints = np.zeros(self._blending.counts[True] + self.images * NUMBERS, np.int32)
        ints[: len(keys)] = keys
        rows = ints[-self.images * NUMBERS :].reshape(self.images, NUMBERS)
        factors = np.zeros((self.images, len(self.terms), RESULTS), np.float32)
        constants = np.zeros((self.images, self._image_floats), np.float32)
        for n, (frame, image) in enumerate(zip(frames, key.images, strict=True)):
            rows[n, : len(ROWS)] = rows_of(self.observations, frame)
            terms = [(k, term) for k, term in enumerate(self.terms) if term.name in image.terms]
            for k, _ in terms:
                factors[n, k, 0] = 1.0
            logged = [(k, term.channels) for k, term in terms if term.channels is not None][:1]
            for k, channels in logged:
                factors[n, k, 1:] = 1.0, channels(self.observations)
            start = 0
            for (kind, view), shape in self._parts.items():
                part = constants[n, start : start + math.prod(shape)]
                start += math.prod(shape)
                if kind == "blend" and keys and (flow or view != View.FLOW):
                    blend = self._blending.weights(view, frame, keys, flow=flow)
                    part[: blend.size] = blend.ravel()  # of as many keys as the graph has
                elif kind == "camera" and view == View.FLOW:
                    part[:] = flow_cameras_at(self.observations, frame).ravel()
                elif kind == "camera" and (view == View.TOF or frame in self.observations.colour):
                    part[:] = camera_at(self.observations, self.settings.render, view, frame)
        return ints, factors, constants.ravel()

    @property
    def _image_floats(self) -> int:
        return sum(math.prod(shape) for shape in self._parts.values())

    # -- device ------------------------------------------------------------------------------------

    def keys(self, count: int) -> Int[Tensor, "K"]:
        """Numbers of the motion keys."""
        return self._ints[:count]

    def image(self, n: int, key: GraphKey) -> ImageControl:
        """Device memory of image ``n`` of the batch."""
        begin = self._blending.counts[True] + n * NUMBERS
        ints = self._ints[begin : begin + NUMBERS]
        parts = dict(
            zip(
                self._parts,
                self._floats[n].split([*map(math.prod, self._parts.values())]),
                strict=True,
            )
        )
        return ImageControl.over(ints, parts, key.keys, flow=bool(key.images[n].flow_terms))


def rows_of(observations: Observations, frame: int) -> list[int]:
    """Rows of the measured images of a raw frame in the order of ``ROWS``; 0 where there is no such
    image, which no term reads then.
    """
    shown, quartet = observations, frame // observations.sequence.cycle
    light = shown.phasors.rows.get(frame, 0) if shown.phasors else frame
    depth, flow = (stack.rows.get(quartet, 0) for stack in (shown.closed_form, shown.flow))
    return [light, depth, shown.colour.rows.get(frame, 0), flow]


def camera_at(
    observations: Observations, render: RenderSettings, view: View, frame: int
) -> Float[np.ndarray, " P"]:
    """Camera, calibration and phase shift of a view, as :func:`packed`."""
    colour = view == View.COLOUR
    camera = (observations.colour_cameras if colour else observations.cameras)[frame]
    return packed(camera, observations.sensor_at(frame), render)


def flow_cameras_at(observations: Observations, frame: int) -> Float[np.ndarray, "2 V"]:
    """Cameras at the ends of both flows of a raw frame, within the recording."""
    cameras, cycle = observations.cameras, observations.sequence.cycle
    last = len(cameras) - 1
    ends = [cameras[min(max(frame + step * cycle, 0), last)] for step in (1, -1)]
    return fused.flow_cameras(cameras[frame], ends)
