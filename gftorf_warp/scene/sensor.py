"""The C-ToF sensor as data: modulation, timing, offsets, and what turns light into numbers.

A point at distance d that reflects r gives the quad of shift theta (method, sections 1 and 2.4)

    a (cos(psi - theta) + b),   a = s r / d^2,   psi = kappa d + phase_offset,   kappa = 4 pi f / c

in *relative units*. Sections 2.3 and 2.4 of the sensor notes add harmonics, electrons and patterns:
fields that are off by default. Values of the OPT8241 are of its datasheet, SBAS704B, those of the
MLX75027 of its datasheet, 1.0; *assumed* values are not published.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, SPEED_OF_LIGHT
from ..data.cycles import SAME_RAD, solution
from .pattern import Pattern
from .waveform import peak

T = TypeVar("T", np.ndarray, Tensor)

Scalar = float | Tensor
EVEN = SAME_RAD  # [1] means of exp(i theta), exp(2 i theta) of equally spaced shifts are below
ELECTRONS = ("electrons_per_unit", "electrons_per_code", "full_well_electrons")
POSITIVE = ("f_mod_hz", "frame_period_s", "contrast_cutoff_hz", *ELECTRONS)
NON_NEGATIVE = (
    "ambient_electrons",
    "dark_electrons_per_s",
    "read_noise_electrons",
    "source_intensity",
    "row_time_s",
)
# off unless they are set
EFFECTS = (
    *("further_hz", "harmonic_contrast", "contrast_cutoff_hz", "pattern", "row_time_s"),
    "adc_zero",
)


class RawFrame(NamedTuple):
    """Settings of one raw frame."""

    f_mod_hz: Scalar
    """Modulation frequency [Hz]."""
    shift: float
    """Phase shift [rad]."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Sensor:
    """One C-ToF sensor. The ``Scalar`` fields accept 0-d tensors, which receive gradients.

    >>> from gftorf_warp import Sensor
    >>> sensor = Sensor(f_mod_hz=20e6, further_hz=(50e6,))
    >>> len(sensor.cycle), round(sensor.unambiguous_range, 3)
    (8, 7.495)
    """

    f_mod_hz: Scalar = SPEED_OF_LIGHT / 15.0
    """Modulation frequency [Hz]; default: 19.986 MHz, of public F-ToeRF files (range 15 m)."""
    shifts: tuple[float, ...] = CANONICAL_SHIFTS
    """Phase shifts of the quads that a rendering returns, in this order [rad]: any number, in any
    order. A recording takes them one after the other; a phase needs three different ones. Default:
    that of the synthetic F-ToeRF files."""
    further_hz: tuple[float, ...] = ()
    """Modulation frequencies that follow in every cycle [Hz], each with all shifts."""
    phase_offset: Scalar = 0.0
    """Measured minus true phase [rad]: rendering adds it, decoding subtracts it."""
    dc_offset: Scalar = 0.0
    """Constant part b of a quad as a multiple of its amplitude [1]; 0 for differential sensors."""
    adc_zero: float = 0.0
    """What a recording holds without light [relative units]: stored number = adc_zero + quad. Only
    files have it: readers subtract it, and the range of the ADC lies around it."""
    source_intensity: Scalar = 1.0
    """Source intensity s [1]; only s times reflectivity can be known from one sequence."""
    frame_period_s: float = 1.0 / FRAME_RATE_HZ
    """Time from one raw frame to the next [s]; frame n is taken at n times this."""
    exposure_s: float = 2.34e-3
    """Length of one exposure [s]; OPT8241 at 18/64 duty. Scales electrons; 0 only without noise."""
    row_time_s: float = 0.0
    """Delay from one row to the next [s]; 0: global shutter, as both makers say. A raw frame has
    the time of its first row. Engine mesh simulates it; nothing is reconstructed row by row."""
    unipolar: bool = False
    """False: difference of two taps, signed. True: one tap, never negative; dc_offset >= 1."""
    noise: bool = False
    """Whether shot noise, read noise, full well and ADC apply; without, quads are exact."""
    electrons_per_unit: float = 3.144e5
    """Modulated electrons of one unit (r = 1 at 1 m) in 2.34 ms, both taps [e-]; OPT8241-like."""
    contrast: float = 0.45
    """Contrast C of a differential sensor [1]; OPT8241 at 50 MHz. A unipolar one: 1 / dc_offset."""
    contrast_cutoff_hz: float | None = None
    """Frequency f_c at which the contrast has halved [Hz], as C / (1 + (f / f_c)^2); None: it has
    one value. 303e6 fits the MLX75027."""
    harmonic_contrast: tuple[float, ...] = ()
    """Contrast of harmonics 2, 3, ... over that of the first [1]; see scene/waveform.py."""
    ambient_electrons: float = 0.0
    """Unmodulated electrons per exposure, both taps together [e-]: of every pixel with engine
    gaussian, per unit of reflectance with engine mesh. A ninth of direct sunlight is 3.1e5 from
    reflectance .5, 6.3e5 from white (notes, 3)."""
    dark_electrons_per_s: float = 5.0e4
    """Dark current per tap [e-/s]; assumed for the OPT8241."""
    read_noise_electrons: float = 80.0
    """Standard deviation of the read noise per tap [e-]; assumed for the OPT8241."""
    full_well_electrons: float = 1.0e5
    """A tap holds no more than this [e-]: saturation; assumed for the OPT8241. inf: any number."""
    adc_bits: int | None = 12
    """Bits of the signed ADC; OPT8241 and MLX75027 have 12. None: no quantisation."""
    electrons_per_code: float = 32.0
    """Electrons per step of the ADC [e-/DN]; assumed for the OPT8241."""
    pattern: Pattern = field(default_factory=Pattern)
    """How much pixels differ: phase, response to light, dark current; default: not at all."""

    def __post_init__(self):
        for name in ("f_mod_hz", "phase_offset", "dc_offset", "source_intensity"):
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.ndim != 0:
                shape = tuple(value.shape)
                raise ValueError(f"{name} must be a number or a 0-d tensor, got shape {shape}")
        # tensors are not checked: reading one would synchronise a GPU
        numbers = {
            f.name: getattr(self, f.name) for f in fields(self) if f.name != "full_well_electrons"
        }
        for name, value in numbers.items():
            for one in value if isinstance(value, tuple) else (value,):
                if isinstance(one, int | float) and not math.isfinite(one):
                    raise ValueError(f"{name} must be finite, got {value}")
        for name in POSITIVE + NON_NEGATIVE:
            value, zero = getattr(self, name), name in NON_NEGATIVE
            if value is None or isinstance(value, Tensor):
                continue
            if not (value > 0 or (zero and value == 0)):
                wanted = "0 or more" if zero else "above 0"
                raise ValueError(f"{name} must be {wanted}, got {value}")
        if len(self.shifts) < 1:
            raise ValueError("shifts: a sensor needs at least one phase shift")
        if not all(f > 0 for f in self.further_hz):
            raise ValueError(f"further_hz must be above 0, got {self.further_hz}")
        if self.exposure_s < 0 or (self.noise and self.exposure_s == 0):
            wanted = "above 0, or 0 without noise"
            raise ValueError(f"exposure_s must be {wanted}, got {self.exposure_s}")
        if not 0 < self.contrast <= 1:
            raise ValueError(f"contrast must be in (0, 1], got {self.contrast}")
        most = self.contrast * peak(self.harmonic_contrast) if self.harmonic_contrast else 0.0
        if most > 1 + 1e-6:
            raise ValueError(
                f"harmonic_contrast {self.harmonic_contrast} and contrast {self.contrast} make a "
                f"wave with a peak of {most:.4g}, more than all light: at most 1"
            )
        if self.adc_bits is not None and not 1 <= self.adc_bits <= 24:
            raise ValueError(f"adc_bits must be in 1..24 or None, got {self.adc_bits}")
        if self.unipolar and not isinstance(self.dc_offset, Tensor) and self.dc_offset < 1.0:
            raise ValueError(
                f"a unipolar tap cannot hold negative light: dc_offset >= 1 needed, "
                f"got {self.dc_offset}"
            )
        if self.unipolar and self.contrast_cutoff_hz is not None:
            raise ValueError(
                "contrast_cutoff_hz: the contrast of a unipolar sensor is 1 / dc_offset at all "
                "frequencies"
            )

    def __repr__(self) -> str:
        """That of a dataclass without effects that are off: data cards hash this text."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        off = {name for name in EFFECTS if values[name] == getattr(PLAIN, name)}
        shown = [f"{name}={value!r}" for name, value in values.items() if name not in off]
        return f"Sensor({', '.join(shown)})"

    @property
    def phase_slope(self) -> Scalar:
        """Phase per distance kappa = 4 pi f / c [rad/m]."""
        return 4.0 * math.pi / SPEED_OF_LIGHT * self.f_mod_hz

    @property
    def calibration(self) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Phase slope [rad/m], phase offset in [-pi, pi] [rad], source intensity, DC offset."""
        offset = within_half_turn(self.phase_offset)
        return self.phase_slope, offset, self.source_intensity, self.dc_offset

    @property
    def unambiguous_range(self) -> float:
        """Range c / 2f [m]: distances are known modulo this."""
        f_mod_hz = self.f_mod_hz.detach() if isinstance(self.f_mod_hz, Tensor) else self.f_mod_hz
        return SPEED_OF_LIGHT / (2.0 * float(f_mod_hz))

    @property
    def cycle(self) -> tuple[RawFrame, ...]:
        """The raw frames of one cycle: all shifts at the first frequency, then at the others."""
        return tuple(
            RawFrame(f, shift) for f in (self.f_mod_hz, *self.further_hz) for shift in self.shifts
        )

    @property
    def harmonics(self) -> tuple[int, ...]:
        """Multiples of the modulation frequency with contrast, the first included."""
        return (1, *(h for h, ratio in enumerate(self.harmonic_contrast, start=2) if ratio != 0.0))

    def contrast_ratio(self, harmonic: int) -> float:
        """Contrast of a harmonic as a multiple of that of the first [1]."""
        return 1.0 if harmonic == 1 else self.harmonic_contrast[harmonic - 2]

    def at_frame(self, n: int) -> Sensor:
        """The sensor as set for raw frame ``n`` of a recording: one frequency and one shift."""
        frame = self.cycle[n % len(self.cycle)]
        return replace(self, f_mod_hz=frame.f_mod_hz, shifts=(float(frame.shift),), further_hz=())

    def with_shifts(self, shifts: tuple[float, ...]) -> Sensor:
        """The same sensor reading other phase shifts [rad]."""
        return replace(self, shifts=tuple(float(s) for s in shifts))


def channel_of(shifts: Sequence[float], shift: float) -> int | None:
    """Index of a phase shift [rad] among others, whole turns aside; None if it is none of them."""
    turns = [abs(math.remainder(other - shift, 2.0 * math.pi)) for other in shifts]
    nearest = min(range(len(turns)), key=turns.__getitem__)
    return nearest if turns[nearest] <= SAME_RAD else None


def within_half_turn(angle: Scalar) -> Scalar:
    """The same angle in [-pi, pi] [rad], reduced in float64: float32 would lose 5e-4 of 1e4 rad."""
    if not isinstance(angle, Tensor):
        return math.remainder(angle, 2.0 * math.pi)
    turns = (angle.detach().double() / (2.0 * math.pi)).round()
    return (angle.double() - 2.0 * math.pi * turns).to(angle.dtype)


def distance_from_phasor(re: Tensor, im: Tensor, sensor: Sensor) -> Tensor:
    """Distance [m] of a phasor: ((atan2(im, re) - phase_offset) mod 2 pi) / kappa."""
    offset = within_half_turn(sensor.phase_offset)
    phase = torch.remainder(torch.atan2(im, re) - offset, 2.0 * math.pi)
    # remainder can round up to 2 pi
    wrapped = torch.where(phase >= 2.0 * math.pi, torch.zeros_like(phase), phase)
    return wrapped / sensor.phase_slope


@functools.lru_cache(maxsize=256)
@torch.inference_mode(False)  # of a rendering in that mode, others that need gradients have it, too
def uploaded(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers [n] on a device, uploaded once: an upload synchronises a GPU."""
    return torch.tensor(values, dtype=dtype, device=device)


def phasor_from_quads(quads: Tensor, shifts: tuple[float, ...] | Tensor) -> tuple[Tensor, Tensor]:
    """(re, im) of quads [Q, ...] by least squares over three or more shifts [rad], in any order.

    For equally spaced ones that is 4/K sum_j Q_j exp(i theta_j); for the four canonical shifts, the
    differences of opposite quads, of length 2a.

    Raises:
        ValueError: If the shifts do not determine a phase. Shifts in a tensor are taken to be
            equally spaced.
    """
    known = shifts
    if not isinstance(known, Tensor):
        known = uploaded(tuple(known), quads.dtype, quads.device)
    theta = known.to(quads).reshape(-1, *[1] * (quads.ndim - 1))
    if len(theta) < 3:
        raise ValueError(f"shifts: a phase needs at least 3 quads, got {len(theta)}")
    if not isinstance(shifts, Tensor) and not _evenly(np.array(shifts, dtype=np.float64)):
        solved = solution(np.array(shifts, dtype=np.float64))
        if solved is None:
            degrees = np.degrees(shifts).tolist()
            raise ValueError(f"shifts: a phase needs three different ones, got {degrees} degrees")
        rows = torch.as_tensor(solved, dtype=quads.dtype, device=quads.device)
        re, im = (rows @ quads.reshape(len(theta), -1)).reshape(2, *quads.shape[1:])
        return re, im
    factor = 4.0 / len(theta)
    return factor * (quads * theta.cos()).sum(0), factor * (quads * theta.sin()).sum(0)


def quad_from_phasor(re: T, im: T, constant: T, shift: float) -> T:
    """Quad of one shift [rad] of a phasor; ``constant`` is dc_offset times its length."""
    return 0.5 * (re * math.cos(shift) + im * math.sin(shift) + constant)


def _evenly(shifts: np.ndarray) -> bool:
    """Whether the plain sum over these shifts [rad] is the least-squares solution."""
    return all(abs(np.exp(1j * turns * shifts).mean()) < EVEN for turns in (1, 2))


PLAIN = Sensor()  # the default
