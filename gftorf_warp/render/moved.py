"""Gaussians of a finished run at any time, in memory that stays: the motion at a key is computed once."""

from __future__ import annotations

import math

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ..kernels.motion.move import make_move
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import KeyMotion, Motion
from .bridge import array_over
from .cuda import stream_of
from .inputs import Inputs

INDEX, WEIGHT, HERE = 6, 7, 8  # parameters of ``move_gaussians`` that :meth:`MovedGaussians.move` sets


class MovedGaussians:
    """The arrays that a rendering reads, filled by :meth:`move`; without gradients."""

    inputs: Inputs
    """The Gaussians, where they were moved last."""

    @torch.no_grad()
    def __init__(
        self, field: GaussianField, motion: Motion, attachment: Tensor, calibration: Tensor, optimised: Camera
    ):
        """Allocate.

        Args:
            field: The undisplaced Gaussians, float32.
            motion: Their motion.
            attachment: What ``motion.attach`` returned for them.
            calibration: Of the sensor, as ``Inputs`` has it.
            optimised: The camera at the size of the optimisation, whose low-pass filter widened the Gaussians.
        """
        field = field.map(lambda tensor: tensor.detach().contiguous())
        first = motion.at_keys(attachment, [0])
        tables = [None if t is None else t.new_zeros(len(motion.times), *t.shape[1:]) for t in first]
        mean, log_scale = torch.empty_like(field.mean), torch.empty_like(field.log_scale)
        turned = None if first.rotation is None else torch.empty_like(field.quaternion)
        self._motion, self._attachment, self._tables = motion, attachment, tables
        self._known: set[int] = set()
        self._store(0, first)
        self._kept = field, calibration, mean, log_scale, turned  # Warp arrays do not own their memory
        offset, rotation = array_over(tables[0], wp.vec3), array_over(tables[1], wp.vec4)
        initial = [array_over(tensor, wp.vec3) for tensor in (field.mean, field.log_scale)]
        quaternion = array_over(field.quaternion, wp.vec4)
        outputs = [array_over(mean, wp.vec3), array_over(log_scale, wp.vec3), array_over(turned, wp.vec4)]
        self.inputs = Inputs(
            mean=outputs[0],
            log_scale=outputs[1],
            quaternion=quaternion if turned is None else outputs[2],
            opacity_logit=array_over(field.opacity_logit),
            reflectivity_sh=array_over(field.reflectivity_sh),
            colour_sh=array_over(field.colour_sh, wp.vec3),
            calibration=array_over(calibration),
        )
        kernel = make_move(motion.support)
        self._indices, self._weights = (kernel.adj.args[n].type for n in (INDEX, WEIGHT))
        row = footprint_row(optimised)
        inputs = [*initial, quaternion, offset, rotation, row, self._indices(), self._weights(), row]
        where = {"device": wp.device_from_torch(field.device), "record_tape": False}
        self._launch = wp.launch(kernel, len(field), inputs, outputs, record_cmd=True, **where)  # None for N = 0

    @torch.no_grad()
    def move(self, time: float, here: wp.vec4) -> None:
        """Fill ``inputs``.

        Args:
            time: Seconds since raw frame 0, any number.
            here: :func:`footprint_row` of the camera.
        """
        keys = self._motion.keys_at(time)
        for key in set(keys.index) - self._known:
            self._store(key, self._motion.at_keys(self._attachment, [key]))
        if self._launch is not None:
            unused = self._motion.support - len(keys.index)
            self._launch.set_param_at_index(INDEX, self._indices(*keys.index, *keys.index[:1] * unused))
            self._launch.set_param_at_index(WEIGHT, self._weights(*keys.weight, *(0.0,) * unused))
            self._launch.set_param_at_index(HERE, here)
            with stream_of(self._attachment):
                self._launch.launch()

    def _store(self, key: int, motion: KeyMotion) -> None:
        for table, values in zip(self._tables, motion, strict=True):
            if table is not None and values is not None:
                table[key] = values[0]
        self._known.add(key)


def footprint_row(camera: Camera) -> wp.vec4:
    """The row of a pose that gives z-depth, divided by the focal length: the width of a pixel at a point [m]."""
    row = np.asarray(camera.camera_from_world[2], dtype=np.float64) / math.sqrt(camera.fx * camera.fy)
    return wp.vec4(*(float(value) for value in row))
