"""What was measured, ready to be compared with renderings: scaled, reduced, on the device.
Nothing here is truth.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..data.constant import without_constant
from ..data.decode import closed_form_distance, quad_scale, quartet_phasors
from ..data.sequence import Flow, Sequence
from ..errors import InputError
from ..scene.camera import Camera
from ..scene.initialise import Init
from ..scene.measured import camera_of, colour_camera_of, sensor_of
from ..scene.sensor import Sensor
from .settings import Batch, FlowSource, Input, ReconSettings

HASHED = ("quads", "measured", "shifts", "times", "frequencies_hz", "camera_from_world")


@dataclass(frozen=True, eq=False)
class ImageStack:
    """Images of one kind in one tensor on the device, so that a kernel can select one by its
    row.
    """

    images: Float[Tensor, "R *image"]
    """All images; R = 0 if there are none."""
    rows: Mapping[int, int]
    """Row of each image by its raw frame or, where a docstring says so, by its quartet."""

    @classmethod
    def of(cls, images: Mapping[int, np.ndarray], device: torch.device | str) -> ImageStack:
        """Stack images of one shape in the order of their keys."""
        keys = sorted(images)
        stacked = (
            np.stack([images[key] for key in keys], dtype=np.float32)
            if keys
            else np.zeros(0, np.float32)
        )
        return cls(torch.from_numpy(stacked).to(device), {key: row for row, key in enumerate(keys)})

    def __contains__(self, key: object) -> bool:
        return key in self.rows

    def __bool__(self) -> bool:
        return bool(self.rows)

    def __getitem__(self, key: int) -> Tensor:
        return self.images[self.rows[key]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Raw frames in the units and at the size of the optimisation."""

    sequence: Sequence
    """The prepared sequence: quads multiplied by ``quad_scale``, reduced images, flow filled in."""
    quads: Float[Tensor, "F H W"]
    """Its quads on the device; rows that were not measured are never read."""
    phasors: ImageStack
    """[R, 2, H, W] phasors (re, im) by the raw frame that represents them, the first of their
    frequency in the quartet; empty if quads are compared."""
    colour: ImageStack
    """[R, 3, h, w] colour images by raw frame, divided by the largest value of all; may be
    empty."""
    colour_cameras: dict[int, Camera]
    """The camera of every colour image, at its size."""
    colour_scale: float | None
    """Units of colour in the file times this are those of the optimisation; None without colour."""
    closed_form: ImageStack
    """[R, 1, H, W] closed-form distances [m] by quartet; may be empty."""
    cameras: list[Camera]
    """The camera of every raw frame."""
    sensor: Sensor
    """The sensor, with the canonical shifts, at all frequencies."""
    batches: list[list[int]]
    """The raw frames of every possible step; each measured frame is in one of them."""
    flow: ImageStack
    """[R, 2, 2, H, W] optical flow [px] by quartet, to the next quartet and to the previous one;
    NaN: unknown."""
    quad_scale: float
    """Units in the file times this are those of the optimisation."""
    quad_scale_source: str
    """Where that number is from."""
    flow_source: str
    """'file', 'computed' or 'none'."""

    def sensor_at(self, frame: int) -> Sensor:
        """The sensor of one raw frame: its modulation frequency and its phase shift only."""
        alone = self.sensor.with_shifts((float(self.sequence.shifts[frame]),))
        if not self.sensor.further_hz:
            return alone
        frequency = float(self.sequence.frame_frequencies[frame])
        return replace(alone, f_mod_hz=frequency, further_hz=())

    def time_at(self, frame: int) -> float:
        """Time of a raw frame [s], or the mean time of the frames of its phasor."""
        times = self.sequence.times
        if not self.phasors:
            return float(times[frame])
        frames = self.sequence.quartet_frames(frame // self.sequence.cycle)
        frequencies = self.sequence.frame_frequencies
        return float(times[frames][frequencies[frames] == frequencies[frame]].mean())


def input_of(sequence: Sequence, wanted: Input) -> Input:
    """What is compared with the sensor: quads or phasors, never 'auto'."""
    if wanted != Input.AUTO:
        return wanted
    return Input.PHASOR if sequence.from_phasors else Input.QUADS


def as_compared(sequence: Sequence, wanted: Input) -> Sequence:
    """The sequence, without a constant part if its phasors are compared, which have none."""
    phasors = input_of(sequence, wanted) == Input.PHASOR and not sequence.from_phasors
    return without_constant(sequence) if phasors else sequence


def observe(
    sequence: Sequence, settings: ReconSettings, device: torch.device | str
) -> Observations:
    """Prepare a sequence.

    Raises:
        InputError: If no raw frame was measured, all quads are zero, nothing is to be compared, or
            the modulation frequencies have no common range.
    """
    if not sequence.measured.any() or not np.abs(sequence.quads[sequence.measured]).max() > 0:
        why = "no raw frame exists, or all of them are zero"
        raise _nothing_to_compare(sequence, "nothing was measured", why)
    if settings.quad_scale is None:
        scale, scale_source = quad_scale(sequence)
    else:
        scale, scale_source = settings.quad_scale, "setting"
    prepared = as_compared(reduced(sequence, settings.width_max), settings.input)
    source = settings.flow if reads_flow(settings) else FlowSource.NONE
    prepared, flow_source = with_flow(prepared, source)
    prepared = replace(prepared, quads=(prepared.quads * np.float32(scale)).astype(np.float32))

    phasors: dict[int, np.ndarray] = {}
    if input_of(sequence, settings.input) == Input.PHASOR and settings.weights.quads > 0:
        for quartet in prepared.complete_quartets:
            phasors |= {frames[0]: phasor for frames, phasor in quartet_phasors(prepared, quartet)}
        if not phasors:
            why = "a phasor needs all raw frames of one quartet"
            raise _nothing_to_compare(sequence, "no complete quartet", why)
    decoded = prepared.complete_quartets if settings.weights.depth > 0 else []
    closed_form = {i: closed_form_distance(prepared, i)[None] for i in decoded}
    colour, colour_scale = _colour(prepared, settings)
    return Observations(
        sequence=prepared,
        quads=torch.tensor(prepared.quads, device=device),
        phasors=ImageStack.of(phasors, device),
        colour=ImageStack.of({n: np.moveaxis(image, -1, 0) for n, image in colour.items()}, device),
        colour_cameras={
            n: camera for n in colour if (camera := colour_camera_of(prepared, n)) is not None
        },
        colour_scale=colour_scale,
        closed_form=ImageStack.of(closed_form, device),
        cameras=[camera_of(prepared, n) for n in range(prepared.frames)],
        sensor=sensor_of(prepared),
        batches=_batches(prepared, settings, list(phasors), list(colour)),
        flow=ImageStack.of(_flow_by_quartet(prepared), device),
        quad_scale=float(scale),
        quad_scale_source=scale_source,
        flow_source=flow_source,
    )


def _flow_by_quartet(sequence: Sequence) -> dict[int, np.ndarray]:
    """[2, 2, H, W] forward and backward flow [px] of quartets with any; NaN: unknown."""
    result: dict[int, np.ndarray] = {}
    for direction, flows in enumerate((sequence.flow.forward, sequence.flow.backward)):
        for frame, flow in flows.items():
            shape = (2, 2, sequence.height, sequence.width)
            quartet = frame // sequence.cycle
            result.setdefault(quartet, np.full(shape, np.nan, np.float32))[direction] = flow
    return result


def reads_flow(settings: ReconSettings) -> bool:
    """Whether a reconstruction reads optical flow, for its loss or to start from phase."""
    return settings.weights.flow > 0 or settings.init.kind != Init.RANDOM


def _batches(
    sequence: Sequence, settings: ReconSettings, phasors: list[int], colour: list[int]
) -> list[list[int]]:
    """The raw frames of every possible step; phasors and colour images are single."""
    if phasors:
        return [[n] for n in phasors]
    if settings.weights.quads == 0:
        return [[n] for n in colour]
    measured = [n for n in range(sequence.frames) if sequence.measured[n]]
    if settings.schedule.batch == Batch.FRAME:
        return [[n] for n in measured]
    quartets = sorted({n // sequence.cycle for n in measured})
    return [[n for n in measured if n // sequence.cycle == i] for i in quartets]


def _colour(
    sequence: Sequence, settings: ReconSettings
) -> tuple[dict[int, np.ndarray], float | None]:
    """Colour images in the units of the optimisation, and the factor that brought them there."""
    if settings.weights.colour == 0:
        return {}, None
    if colour_camera_of(sequence, 0) is None:
        # colour is an addition: a recording without it is compared without it
        if settings.weights.quads > 0:
            return {}, None
        why = "this preset compares colour images and nothing else"
        raise _nothing_to_compare(sequence, "no colour", why)
    images = sequence.colour.images
    largest = max(float(np.abs(image).max()) for image in images.values())
    if not largest > 0:
        raise _nothing_to_compare(sequence, "colour is black", "all colour images are zero")
    return {n: image / np.float32(largest) for n, image in images.items()}, 1.0 / largest


def _nothing_to_compare(sequence: Sequence, what: str, why: str) -> InputError:
    fix = "check the folder with `gftorf check`"
    return InputError(what, where=sequence.path or "sequence", why=why, fix=fix)


def reduced(sequence: Sequence, width_max: int | None) -> Sequence:
    """The sequence with images of at most ``width_max`` columns, by area averaging.

    Intrinsics and flow are scaled alike; colour images stay, since they are of another camera.
    """
    if width_max is None or sequence.width <= width_max:
        return sequence
    import cv2

    width = width_max
    height = max(round(sequence.height * width / sequence.width), 1)
    sx, sy = width / sequence.width, height / sequence.height

    def shrink(image: np.ndarray) -> np.ndarray:
        image = np.ascontiguousarray(image, dtype=np.float32)
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    def shrink_flow(flows: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
        return {n: np.stack([shrink(x) * sx, shrink(y) * sy]) for n, (x, y) in flows.items()}

    flow = sequence.flow
    return replace(
        sequence,
        quads=np.stack([shrink(quad) for quad in sequence.quads]),
        tap_sums={n: shrink(image) for n, image in sequence.tap_sums.items()},
        intrinsics=sequence.intrinsics.scaled(sx, sy),
        flow=Flow(forward=shrink_flow(flow.forward), backward=shrink_flow(flow.backward)),
    )


def with_flow(sequence: Sequence, source: FlowSource) -> tuple[Sequence, str]:
    """The sequence with the optical flow that the settings choose, and where it is from."""
    given = bool(sequence.flow.forward or sequence.flow.backward)
    if source == FlowSource.NONE:
        return replace(sequence, flow=Flow()), "none"
    if source == FlowSource.FILE or (source == FlowSource.AUTO and given):
        return sequence, "file" if given else "none"
    from ..data.flow import compute_flow

    flow = compute_flow(sequence, method=source.matcher)
    return replace(sequence, flow=flow), "computed" if flow.forward else "none"


def data_hash(sequence: Sequence) -> str:
    """SHA-256 of everything that a reconstruction reads from a sequence."""
    return _data_hash(sequence, colour_lens=True)


def former_hash(sequence: Sequence) -> str | None:
    """What runs stated before their hash had the lens of the colour camera; None without such a
    camera, of which nothing has changed.
    """
    if sequence.colour.intrinsics is None:
        return None
    return _data_hash(sequence, colour_lens=False)


def _data_hash(sequence: Sequence, *, colour_lens: bool) -> str:
    digest = hashlib.sha256()
    arrays = {name: getattr(sequence, name) for name in HASHED}
    for name, array in (arrays | {"colour_from_world": sequence.colour.camera_from_world}).items():
        if array is not None:
            digest.update(f"{name} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    stated, tof, colour = sequence.calibration, sequence.intrinsics, sequence.colour.intrinsics
    numbers: list = [stated.f_mod_hz, stated.phase_offset, stated.dc_offset]
    numbers += [tof.fx, tof.fy, tof.cx, tof.cy]
    numbers += [stated.quad_scale, colour and (colour.fx, colour.fy, colour.cx, colour.cy)]
    digest.update(repr(numbers).encode())
    if tof.distortion is not None:
        digest.update(repr(tof.distortion).encode())
    if colour is not None and colour_lens:  # None too: former hashes of other lenses differ then
        digest.update(repr(colour.distortion).encode())
    images = {"forward_flow": sequence.flow.forward, "backward_flow": sequence.flow.backward}
    images |= {"tap_sums": sequence.tap_sums}
    for name, by_frame in (images | {"colour": sequence.colour.images}).items():
        for frame, image in sorted(by_frame.items()):
            digest.update(f"{name} {frame}".encode() + np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()
