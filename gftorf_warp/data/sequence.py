"""A recorded sequence in memory: raw frames with shift, time and pose, calibration, and where each value is from."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from .cycles import find_cycle, frequencies_by_order, frequencies_decoded


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence:
    """F raw frames of one C-ToF camera. Nothing here is truth: see :class:`Truth`."""

    quads: Float[np.ndarray, "F H W"]
    """What each raw frame recorded, float32, in the units of the file; rows that were not measured are zero."""
    measured: Bool[np.ndarray, "F"]
    """Whether a raw frame exists; an absent one is 'not measured', never zero light."""
    shifts: Float[np.ndarray, "F"]
    """Phase shift of each raw frame [rad]."""
    times: Float[np.ndarray, "F"]
    """Time of each raw frame since the first [s]."""
    f_mod_hz: float
    """Modulation frequency [Hz]; the first of the cycle if there are several."""
    frequencies_hz: Float[np.ndarray, "F"] | None = None
    """Modulation frequency of each raw frame [Hz]; None: ``f_mod_hz`` throughout."""
    cycle_length: int | None = None
    """Raw frames K of a cycle, if the recording states it; None: see :attr:`cycle`."""
    phase_offset: float = 0.0
    """Measured minus true phase [rad]."""
    dc_offset: float = 0.0
    """Constant part of a quad as a multiple of its amplitude [1]."""
    fx: float
    """Focal length, x [px]."""
    fy: float
    """Focal length, y [px]."""
    cx: float
    """Principal point, x [px], in the convention of the program: pixel centres at i + 0.5."""
    cy: float
    """Principal point, y [px], likewise."""
    distortion: tuple[float, float, float, float, float] | None = None
    """k1, k2, p1, p2, k3 of the lens as OpenCV names them [1]; None: a pinhole."""
    camera_from_world: Float[np.ndarray, "F 4 4"]
    """Pose of each raw frame, world to camera [m]."""
    quad_scale: float | None = None
    """The file's own factor for the quads; None if it states none. Never applied by a reader."""
    from_phasors: bool = False
    """Whether the camera delivered phasors, each as if taken at one instant: the four raw frames of a quartet are then
    re/2, -re/2, im/2, -im/2 of one phasor, with one time and one pose."""
    colour: dict[int, Float[np.ndarray, "h w 3"]] = field(default_factory=dict)
    """Colour images by raw frame, linear, float32; empty if there are none."""
    colour_intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy of the colour images [px], pixel centres at i + 0.5; None: the colour camera is not known."""
    colour_from_world: Float[np.ndarray, "F 4 4"] | None = None
    """Pose of the colour camera at each raw frame, world to camera [m]; None: the colour camera is not known."""
    novel_from_world: Float[np.ndarray, "M 4 4"] | None = None
    """Poses of views that nobody took, world to camera [m], to be rendered for looking at; None if there are none."""
    forward_flow: dict[int, Float[np.ndarray, "2 H W"]] = field(default_factory=dict)
    """Optical flow (dx, dy) [px] by raw frame n, from n to n + K; NaN: unknown pixel."""
    backward_flow: dict[int, Float[np.ndarray, "2 H W"]] = field(default_factory=dict)
    """Optical flow (dx, dy) [px] by raw frame n, from n to n - K; NaN: unknown pixel."""
    exposures: Float[np.ndarray, "F"] | None = None
    """Length of each exposure [s]; None: not known."""
    sensor: dict[str, Any] = field(default_factory=dict)
    """Further settings of the sensor by name, numbers and texts, as the recording states them."""
    sources: dict[str, str] = field(default_factory=dict)
    """Where each value is from, by field name: 'file ...', 'default ...', 'inferred ...' or 'setting ...'."""
    path: Path | None = None
    """The folder this was read from; None for a sequence that lives in memory only."""

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
        """Raw frames K of a cycle, after which the sensor begins anew: quartet i is raw frames K i .. K (i + 1) - 1.

        As stated, else the period of shifts and frequencies: four for a sensor of four shifts at one frequency.
        """
        return self.cycle_length or find_cycle(self.shifts, self.frame_frequencies)

    @functools.cached_property
    def frequencies(self) -> tuple[float, ...]:
        """The modulation frequencies of a cycle [Hz], in the order in which it has them."""
        return frequencies_by_order(self.frame_frequencies[: self.cycle])

    @functools.cached_property
    def quads_per_phasor(self) -> int:
        """How many raw frames of a cycle have its first frequency."""
        return int((self.frame_frequencies[: self.cycle] == self.frequencies[0]).sum())

    @property
    def complete_quartets(self) -> list[int]:
        """Indices i of the quartets whose raw frames K i .. K (i + 1) - 1 were all measured, at three or more each."""
        step, frequencies = self.cycle, self.frame_frequencies
        whole = [i for i in range(self.frames // step) if self.measured[step * i : step * (i + 1)].all()]
        return [i for i in whole if frequencies_decoded(frequencies[step * i : step * (i + 1)], self.frequencies)]

    def quartet_frames(self, quartet: int) -> slice:
        """The raw frames of a quartet."""
        return slice(self.cycle * quartet, self.cycle * (quartet + 1))

    @property
    def frame_frequencies(self) -> Float[np.ndarray, "F"]:
        """Modulation frequency of each raw frame [Hz]."""
        return np.full(self.frames, self.f_mod_hz) if self.frequencies_hz is None else self.frequencies_hz

    @classmethod
    def open(cls, path: str | Path, *, frame_rate_hz: float | None = None) -> Sequence:
        """Read a sequence from a folder.

        Args:
            path: A capture, an F-ToeRF folder of raw quads, or a ToeRF folder of phasors.
            frame_rate_hz: Raw frames per second, or phasors per second of a ToeRF folder; overrides what the folder
                says or the default of 120, or 30. A capture has none: it states every time.

        Raises:
            InputError: If the folder or a file in it is not what data_specs/ describes.
        """
        return _reader(path).read(path, frame_rate_hz=frame_rate_hz)

    def truth(self) -> Truth | None:
        """Ground truth stored beside the sequence, read now; None if there is none."""
        return None if self.path is None else _reader(self.path).read_truth(self.path, frames=self.frames)


def _reader(path: str | Path) -> ModuleType:
    """The module that reads a folder."""
    from . import capture, folder, ftorf, torf

    return {"capture": capture, "ftorf": ftorf, "torf": torf}[folder.format_of(Path(path))]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What the scene really was. Only simulation knows it, and only evaluation may read it."""

    distance: Float[np.ndarray, "F H W"]
    """Distance along the ray through each pixel centre at each raw frame [m], float32; NaN: unknown."""
    known: Bool[np.ndarray, "F"]
    """Whether a raw frame has a distance at all."""
    phasor_distance: Float[np.ndarray, "F H W"] | None = None
    """Static-phasor distance [m], float32, in [0, c/2f) of the raw frame's frequency: what the closed form would decode
    if all quads at it were taken without noise at the very time of the raw frame, indirect light included; NaN:
    unknown. None: not stored."""
    amplitude: Float[np.ndarray, "F H W"] | None = None
    """Mean amplitude without noise [relative units], float32; None: not stored."""
    body: Int[np.ndarray, "F H W"] | None = None
    """Which object the ray through each pixel centre meets, counted from 0; -1: none. None: not stored."""
    layers: dict[str, Float[np.ndarray, "F C H W"]] = field(default_factory=dict)
    """Whatever else a simulator knows, float32, by the names and with the channels of data_specs/capture.toml: light by
    harmonic, its direct part and standard error, ambient light, z-depth, normals. Only a capture has a place for it."""
