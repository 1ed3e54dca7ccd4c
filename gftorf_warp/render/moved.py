"""Gaussians of a finished run at any time, in memory that stays:
the motion at a key is computed once.
"""

from __future__ import annotations

import functools

import torch
import warp as wp
from torch import Tensor

from ..kernels.geometry import CameraView
from ..kernels.motion.move import make_move
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import KeyMotion, Motion
from . import runtime
from .bridge import array_over
from .buffers import RenderSettings
from .cuda import stream_of
from .inputs import Inputs
from .launch import view_of

# parameters of ``move_gaussians`` that :meth:`MovedGaussians.move` sets
CAMERA, INDEX, WEIGHT = 6, 7, 8


class MovedGaussians:
    """The arrays that a rendering reads, filled by :meth:`move`; without gradients."""

    inputs: Inputs
    """The Gaussians at the time of the last :meth:`move`."""
    view: wp.array
    """[1] its camera, as ``View`` has it."""

    @torch.no_grad()
    def __init__(
        self,
        field: GaussianField,
        motion: Motion,
        binding: Tensor,
        calibration: Tensor,
        optimised: Camera,
        settings: RenderSettings,
    ):
        """Allocate.

        Args:
            field: The undisplaced Gaussians, float32.
            motion: Their motion.
            binding: What ``motion.bind`` returned for them.
            calibration: Of the sensor, as ``Inputs`` has it.
            optimised: The camera at the size of the optimisation, whose low-pass filter widened the
                Gaussians.
            settings: How to render.
        """
        field = field.map(lambda tensor: tensor.detach().contiguous())
        first = motion.at_keys(binding, [0])
        tables = [None if t is None else t.new_zeros(motion.key_count, *t.shape[1:]) for t in first]
        mean, log_scale = torch.empty_like(field.mean), torch.empty_like(field.log_scale)
        turned = None if first.rotation is None else torch.empty_like(field.quaternion)
        self._motion, self._binding, self._tables = motion, binding, tables
        self._known: set[int] = set()
        self._store(0, first)
        # Warp arrays do not own their memory
        self._kept = field, calibration, mean, log_scale, turned
        device = wp.device_from_torch(field.device)
        self.view = wp.zeros(1, dtype=CameraView, device=device)
        offset, rotation = array_over(tables[0], wp.vec3), array_over(tables[1], wp.vec4)
        initial = [array_over(tensor, wp.vec3) for tensor in (field.mean, field.log_scale)]
        quaternion = array_over(field.quaternion, wp.vec4)
        outputs = [array_over(mean, wp.vec3), array_over(log_scale, wp.vec3)]
        outputs.append(array_over(turned, wp.vec4))
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
        # slow on the host
        self._camera = functools.lru_cache(maxsize=1024)(lambda camera: view_of(camera, settings))
        camera = view_of(optimised, settings)
        inputs = [*initial, quaternion, offset, rotation, camera, camera]
        inputs += [self._indices(), self._weights()]
        where = {"device": device, "record_cmd": True}
        # packed once: that is most of what a launch costs a host
        with stream_of(field.mean):
            self._launch = runtime.launch(
                kernel, max(len(field), 1), inputs, [*outputs, self.view], **where
            )

    @torch.no_grad()
    def move(self, time: float, camera: Camera) -> None:
        """Fill ``inputs`` and ``view`` for a time [s], any number, and a camera."""
        keys = self._motion.keys_at(time)
        for key in set(keys.index) - self._known:
            self._store(key, self._motion.at_keys(self._binding, [key]))
        unused = self._motion.support - len(keys.index)
        self._launch.set_param_at_index(CAMERA, self._camera(camera))
        self._launch.set_param_at_index(INDEX, self._indices(*keys.index, *keys.index[:1] * unused))
        self._launch.set_param_at_index(WEIGHT, self._weights(*keys.weight, *(0.0,) * unused))
        with stream_of(self._binding):
            self._launch.launch()

    def _store(self, key: int, motion: KeyMotion) -> None:
        for table, values in zip(self._tables, motion, strict=True):
            if table is not None and values is not None:
                table[key] = values[0]
        self._known.add(key)
