"""A recorded sequence and its ground truth in memory, as plain values."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..constants import SPEED_OF_LIGHT
from .cycles import find_cycle, frequencies_by_order, frequencies_decoded

# [m] c / f of 10 GHz to 10 kHz: outside, the number is another quantity or unit
DEPTH_RANGES_M = (0.03, 30_000.0)


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Intrinsics of a camera [px], in the convention of the program: pixel centres at i + 0.5."""

    fx: float
    """Focal length, x [px]."""
    fy: float
    """Focal length, y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    distortion: tuple[float, float, float, float, float] | None = None
    """k1, k2, p1, p2, k3 of the lens in OpenCV's model [1]; None: a pinhole."""

    def scaled(self, sx: float, sy: float) -> Intrinsics:
        """Intrinsics for images resized by these factors; the distortion stays."""
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Constants of the sensor, as the recording states them."""

    f_mod_hz: float
    """Modulation frequency [Hz]; the first of the cycle if there are several."""
    phase_offset: float = 0.0
    """Measured minus true phase [rad]."""
    dc_offset: float = 0.0
    """Constant part of a quad as a multiple of its amplitude [1]."""
    adc_zero: float = 0.0
    """What the recording stores without light [quad units]: stored number = adc_zero + quad.
    Readers subtract it and writers add it; :attr:`Sequence.quads` is without it."""
    quad_scale: float | None = None
    """Factor for the quads that the file states; None if it states none. Never applied by a
    reader."""
    cycle_length: int | None = None
    """Raw frames K of a cycle, if the recording states it; None: see :attr:`Sequence.cycle`."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Further settings of the sensor by name, numbers and texts."""

    def __post_init__(self):
        least, most = (SPEED_OF_LIGHT / depth_range for depth_range in DEPTH_RANGES_M[::-1])
        # NaN stands for what a reader could not read, and reports
        if not (least <= self.f_mod_hz <= most or math.isnan(self.f_mod_hz)):
            limits = f"between {least:.3g} and {most:.3g} Hz, 20e6 for 20 MHz"
            raise ValueError(f"f_mod_hz must be {limits}, got {self.f_mod_hz}")


@dataclass(frozen=True, kw_only=True, eq=False)
class ColourCamera:
    """Images of a colour camera beside the ToF camera."""

    images: dict[int, Float[np.ndarray, "h w 3"]] = field(default_factory=dict)
    """Colour images by raw frame, linear, float32; empty if there are none."""
    intrinsics: Intrinsics | None = None
    """Intrinsics of the images; None if unknown."""
    camera_from_world: Float[np.ndarray, "F 4 4"] | None = None
    """Pose at each raw frame, world to camera [m]; None if unknown."""

    @property
    def size(self) -> tuple[int, int] | None:
        """Rows h and columns w of the images; None if there are none."""
        return next(((image.shape[0], image.shape[1]) for image in self.images.values()), None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Flow:
    """Optical flow between raw frames one cycle of K frames apart."""

    forward: dict[int, Float[np.ndarray, "2 H W"]] = field(default_factory=dict)
    """Flow (dx, dy) [px] by raw frame n, from n to n + K; NaN: unknown pixel."""
    backward: dict[int, Float[np.ndarray, "2 H W"]] = field(default_factory=dict)
    """Flow (dx, dy) [px] by raw frame n, from n to n - K; NaN: unknown pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence:
    """F raw frames of one C-ToF camera. Contains no ground truth: see :class:`Truth`.

    ``Sequence.open(path)`` reads a folder and ``sequence.truth()`` its ground truth;
    :mod:`gftorf_warp.data.read` binds both.

    >>> from gftorf_warp import Sequence, simulate
    >>> sequence = Sequence.open(simulate("demo", "demo", frames=8, size=(24, 18)))
    >>> sequence.quads.shape, sequence.cycle, sequence.complete_quartets
    ((8, 18, 24), 4, [0, 1])
    """

    quads: Float[np.ndarray, "F H W"]
    """Values of each raw frame, float32, in the units of the file; zero in frames that were not
    measured."""
    measured: Bool[np.ndarray, "F"]
    """Whether a raw frame was measured; an absent one is 'not measured', never zero light."""
    shifts: Float[np.ndarray, "F"]
    """Phase shift of each raw frame [rad]."""
    times: Float[np.ndarray, "F"]
    """Time of each raw frame since the first [s]."""
    frequencies_hz: Float[np.ndarray, "F"] | None = None
    """Modulation frequency of each raw frame [Hz]; None: ``calibration.f_mod_hz`` throughout."""
    exposures: Float[np.ndarray, "F"] | None = None
    """Exposure time of each raw frame [s]; None: unknown."""
    camera_from_world: Float[np.ndarray, "F 4 4"]
    """Pose of each raw frame, world to camera [m]."""
    intrinsics: Intrinsics
    """Intrinsics of the ToF camera."""
    calibration: Calibration
    """Constants of the sensor."""
    from_phasors: bool = False
    """Whether the camera delivered phasors, each of one instant: the four raw frames of a quartet
    are then re/2, -re/2, im/2, -im/2 of one phasor, with one time and one pose."""
    tap_sums: dict[int, Float[np.ndarray, "H W"]] = field(default_factory=dict)
    """Sum of both taps of a pixel by raw frame, float32, in the units of quads: an image of all its
    light, without phase; empty if only their difference is known."""
    colour: ColourCamera = field(default_factory=ColourCamera)
    """The colour camera, without images if there is none."""
    flow: Flow = field(default_factory=Flow)
    """Optical flow, empty if there is none."""
    novel_from_world: Float[np.ndarray, "M 4 4"] | None = None
    """Poses of novel views to be rendered, world to camera [m]; None if there are none."""
    sources: dict[str, str] = field(default_factory=dict)
    """Source of each value by name: 'file ...', 'default ...', 'inferred ...' or 'setting ...'."""
    path: Path | None = None
    """The folder this was read from; None for a sequence that exists in memory only."""
    excerpt: range | None = None
    """The raw frames of the folder that these are; None: all of them."""

    @property
    def frames(self) -> int:
        """Number F of raw frames, measured or not."""
        return len(self.measured)

    @property
    def height(self) -> int:
        """Rows H."""
        return self.quads.shape[1]

    @property
    def width(self) -> int:
        """Columns W."""
        return self.quads.shape[2]

    @functools.cached_property
    def cycle(self) -> int:
        """Number K of raw frames in a cycle: as stated, or the period of shifts and frequencies.

        Quartet i is raw frames K i .. K (i + 1) - 1.
        """
        return self.calibration.cycle_length or find_cycle(self.shifts, self.frame_frequencies)

    @functools.cached_property
    def frequencies(self) -> tuple[float, ...]:
        """The modulation frequencies of a cycle [Hz], in order of appearance."""
        return frequencies_by_order(self.frame_frequencies[: self.cycle])

    @functools.cached_property
    def complete_quartets(self) -> list[int]:
        """Indices i of the quartets whose raw frames were all measured, three or more at each
        frequency.
        """

        def complete(frames: slice) -> bool:
            frequencies = self.frame_frequencies[frames]
            measured = bool(self.measured[frames].all())
            return measured and frequencies_decoded(frequencies, self.frequencies)

        quartets = range(self.frames // self.cycle)
        return [i for i in quartets if complete(self.quartet_frames(i))]

    def quartet_frames(self, quartet: int) -> slice:
        """The raw frames of a quartet."""
        return slice(self.cycle * quartet, self.cycle * (quartet + 1))

    @property
    def frame_frequencies(self) -> Float[np.ndarray, "F"]:
        """Modulation frequency of each raw frame [Hz]."""
        if self.frequencies_hz is not None:
            return self.frequencies_hz
        return np.full(self.frames, self.calibration.f_mod_hz)


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """Ground truth of a sequence, from simulation; for evaluation only.

    >>> from gftorf_warp import Sequence, simulate
    >>> truth = Sequence.open(simulate("demo", "demo", frames=8, size=(24, 18))).truth()
    >>> truth.distance.shape, bool(truth.known.all())
    ((8, 18, 24), True)
    """

    distance: Float[np.ndarray, "F H W"]
    """Distance along the ray through each pixel centre at each raw frame [m], float32; NaN:
    unknown."""
    known: Bool[np.ndarray, "F"]
    """Whether a raw frame has a distance."""
    phasor_distance: Float[np.ndarray, "F H W"] | None = None
    """Static-phasor distance [m], float32, in [0, c/2f) of the raw frame's frequency: the closed
    form of quads without noise, all taken at the time of the raw frame, indirect light included;
    NaN: unknown. None: not stored."""
    amplitude: Float[np.ndarray, "F H W"] | None = None
    """Mean amplitude without noise [relative units], float32; None: not stored."""
    body: Int[np.ndarray, "F H W"] | None = None
    """Index of the object that the ray through each pixel centre meets, from 0; -1: none. None: not
    stored."""
    layers: dict[str, Float[np.ndarray, "F C H W"]] = field(default_factory=dict)
    """Further layers, float32, with the names and channels of data_specs/capture.toml: light by
    harmonic, its direct part and standard error, ambient light, z-depth, normals. Only captures
    store them."""
