"""What was measured, ready to be compared with renderings: scaled, reduced, on the device. Nothing here is truth."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..data.sequence import Sequence
from ..errors import InputError
from ..scene.camera import Camera
from ..scene.measured import camera_of, sensor_of
from ..scene.sensor import Sensor
from .settings import Batch, FlowSource, ReconSettings

HASHED = ("quads", "measured", "shifts", "times", "camera_from_world")
HASHED_NUMBERS = ("f_mod_hz", "phase_offset", "dc_offset", "fx", "fy", "cx", "cy", "quad_scale")


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Raw frames in the units and at the size of the optimisation."""

    sequence: Sequence
    """The prepared sequence: quads multiplied by ``quad_scale``, reduced images, flow filled in."""
    quads: Float[Tensor, "F H W"]
    """Its quads on the device; rows that were not measured are never read."""
    cameras: list[Camera]
    """The camera of every raw frame."""
    sensor: Sensor
    """The sensor, with the canonical shifts."""
    batches: list[list[int]]
    """The raw frames of every possible step; each measured frame is in one of them."""
    flow: dict[tuple[int, int], Float[Tensor, "2 H W"]]
    """Optical flow [px] by (quartet, step), step 1 or -1."""
    quad_scale: float
    """The file's units times this are the units of the optimisation."""
    quad_scale_source: str
    """Where that number is from."""
    flow_source: str
    """'file', 'computed' or 'none'."""

    def sensor_at(self, frame: int) -> Sensor:
        """The sensor reading only the shift of one raw frame."""
        return self.sensor.with_shifts((float(self.sequence.shifts[frame]),))


def observe(sequence: Sequence, settings: ReconSettings, device: torch.device | str) -> Observations:
    """Prepare a sequence.

    Raises:
        InputError: If no raw frame was measured or all quads are zero.
    """
    from ..data.decode import quad_scale

    if not sequence.measured.any() or not np.abs(sequence.quads[sequence.measured]).max() > 0:
        raise InputError(
            "nothing was measured",
            where=sequence.path or "sequence",
            why="no raw frame exists, or all of them are zero",
            fix="check the folder with `gftorf check`",
        )
    scale, scale_source = quad_scale(sequence)
    prepared = reduced(sequence, settings.width_max)
    prepared, flow_source = with_flow(prepared, settings.flow)
    prepared = replace(prepared, quads=(prepared.quads * np.float32(scale)).astype(np.float32))
    measured = [n for n in range(prepared.frames) if prepared.measured[n]]
    if settings.schedule.batch == Batch.FRAME:
        batches = [[n] for n in measured]
    else:
        quartets = sorted({n // FRAMES_PER_QUARTET for n in measured})
        batches = [[n for n in measured if n // FRAMES_PER_QUARTET == i] for i in quartets]
    steps = {1: prepared.forward_flow, -1: prepared.backward_flow}
    return Observations(
        sequence=prepared,
        quads=torch.tensor(prepared.quads, device=device),
        cameras=[camera_of(prepared, n) for n in range(prepared.frames)],
        sensor=sensor_of(prepared),
        batches=batches,
        flow={
            (n // FRAMES_PER_QUARTET, step): torch.tensor(flow, dtype=torch.float32, device=device)
            for step, flows in steps.items()
            for n, flow in flows.items()
        },
        quad_scale=float(scale),
        quad_scale_source=scale_source,
        flow_source=flow_source,
    )


def reduced(sequence: Sequence, width_max: int | None) -> Sequence:
    """The sequence with images of at most ``width_max`` columns, every new pixel the mean of what it covers.

    Sides shrink to whole numbers of pixels, intrinsics and flow with them. Smaller images stay as they are.
    """
    if width_max is None or sequence.width <= width_max:
        return sequence
    import cv2

    width = width_max
    height = max(round(sequence.height * width / sequence.width), 1)
    sx, sy = width / sequence.width, height / sequence.height

    def shrink(image: np.ndarray) -> np.ndarray:
        return cv2.resize(np.ascontiguousarray(image, dtype=np.float32), (width, height), interpolation=cv2.INTER_AREA)

    def shrink_flow(flows: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
        return {n: np.stack([shrink(flow[0]) * sx, shrink(flow[1]) * sy]) for n, flow in flows.items()}

    return replace(
        sequence,
        quads=np.stack([shrink(quad) for quad in sequence.quads]),
        fx=sequence.fx * sx,
        fy=sequence.fy * sy,
        cx=sequence.cx * sx,
        cy=sequence.cy * sy,
        forward_flow=shrink_flow(sequence.forward_flow),
        backward_flow=shrink_flow(sequence.backward_flow),
    )


def with_flow(sequence: Sequence, source: FlowSource) -> tuple[Sequence, str]:
    """The sequence with the optical flow that the settings ask for, and where it is from."""
    given = bool(sequence.forward_flow or sequence.backward_flow)
    if source == FlowSource.NONE:
        return replace(sequence, forward_flow={}, backward_flow={}), "none"
    if source == FlowSource.FILE or (source == FlowSource.AUTO and given):
        return sequence, "file" if given else "none"
    from ..data.flow import compute_flow

    flow = compute_flow(sequence, method="deepflow" if source == FlowSource.DEEPFLOW else "dis")
    found = replace(sequence, forward_flow=flow.forward, backward_flow=flow.backward)
    return found, "computed" if flow.forward else "none"


def data_hash(sequence: Sequence) -> str:
    """SHA-256 of everything a reconstruction reads from a sequence: frames, calibration, poses and flow."""
    digest = hashlib.sha256()
    for name in HASHED:
        digest.update(f"{name} {getattr(sequence, name).shape}".encode())
        digest.update(np.ascontiguousarray(getattr(sequence, name)).tobytes())
    digest.update(repr([getattr(sequence, name) for name in HASHED_NUMBERS]).encode())
    for name in ("forward_flow", "backward_flow"):
        for frame, flow in sorted(getattr(sequence, name).items()):
            digest.update(f"{name} {frame}".encode() + np.ascontiguousarray(flow).tobytes())
    return digest.hexdigest()
