"""Camera pose, intrinsics, calibration and shifts in device memory,
so that one CUDA graph serves all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.camera import Camera
from ..scene.sensor import Sensor
from .buffers import RenderSettings
from .launch import VIEW_DTYPE, view_bits

VIEW = VIEW_DTYPE.itemsize // 4  # numbers of 32 bits of a ``CameraView``
CALIBRATION = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class DeviceCamera:
    """Device data of camera and sensor; sizes and the kind of lens stay those of ``rasterize``."""

    view: Float[Tensor, " V"]
    """The bits of a ``CameraView``."""
    calibration: Float[Tensor, "4"]
    """Phase slope [rad/m], phase offset [rad], source intensity, DC offset; may require a
    gradient."""
    shifts: Float[Tensor, "Q 2"]
    """(cos, sin) of the phase shifts."""

    @classmethod
    def over(cls, row: Float[Tensor, " P"]) -> DeviceCamera:
        """Views of a row of :func:`packed` on a device, which may be overwritten later."""
        view, calibration, shifts = row.split([VIEW, CALIBRATION, len(row) - VIEW - CALIBRATION])
        return cls(view=view, calibration=calibration, shifts=shifts.view(-1, 2))


def packed(camera: Camera, sensor: Sensor, settings: RenderSettings) -> Float[np.ndarray, " P"]:
    """Camera, calibration and shifts as a row, P = V + 4 + 2 Q; copy bits, do no arithmetic."""
    numbers = [float(v.detach() if isinstance(v, Tensor) else v) for v in sensor.calibration]
    numbers += [part for shift in sensor.shifts for part in (math.cos(shift), math.sin(shift))]
    return np.concatenate(
        [view_bits(camera, settings).view(np.float32), np.array(numbers, dtype=np.float32)]
    )


def check(control: DeviceCamera, shifts: int, device: torch.device) -> None:
    """Whether a rendering can read these tensors.

    Raises:
        ValueError: If one has another shape or kind or lives elsewhere.
    """
    for name, shape in (
        ("view", (VIEW,)),
        ("calibration", (CALIBRATION,)),
        ("shifts", (shifts, 2)),
    ):
        tensor = getattr(control, name)
        if tensor.shape != shape or tensor.dtype != torch.float32 or tensor.device != device:
            actual = f"{tuple(tensor.shape)} of {tensor.dtype} on {tensor.device}"
            raise ValueError(
                f"control.{name} is {actual}, must be {shape} of torch.float32 on {device}"
            )
        if not tensor.is_contiguous():
            raise ValueError(f"control.{name} must be contiguous")
