"""The C-ToF sensor as data: modulation, timing, offsets, and what turns light into numbers.

A point at distance d that reflects r gives the quad of shift theta (method, sections 1 and 2.4)

    a (cos(psi - theta) + b),   a = s r / d^2,   psi = kappa d + phase_offset,   kappa = 4 pi f / c

in *relative units*. Section 2.4 of the sensor notes adds the electrons: the noise fields below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, SPEED_OF_LIGHT

Scalar = float | Tensor
SHIFT_TOLERANCE = 1e-5  # [rad] shifts are stored as float32 at worst


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One C-ToF sensor. The four ``Scalar`` fields accept 0-d tensors, which receive gradients from the renderer."""

    f_mod_hz: Scalar = SPEED_OF_LIGHT / 15.0
    """Modulation frequency [Hz]; the default, 19.986 MHz, is that of the public F-ToeRF files (depth_range 15 m)."""
    shifts: tuple[float, ...] = CANONICAL_SHIFTS
    """Phase shifts of the quads that a rendering returns, in this order [rad]."""
    phase_offset: Scalar = 0.0
    """Measured minus true phase [rad]: rendering adds it, decoding subtracts it."""
    dc_offset: Scalar = 0.0
    """Constant part b of a quad as a multiple of its amplitude [1]; 0 for differential sensors."""
    source_intensity: Scalar = 1.0
    """Source intensity s [1]; only s times reflectivity can be known from one sequence."""
    frame_period_s: float = 1.0 / FRAME_RATE_HZ
    """Time from one raw frame to the next [s]; frame n is taken at n times this."""
    exposure_s: float = 2.34e-3
    """Length of one exposure [s]; OPT8241 at 18/64 duty. Scales the number of electrons."""
    unipolar: bool = False
    """False: difference of two taps, signed. True: one tap, never negative; needs dc_offset >= 1."""
    noise: bool = False
    """Whether shot noise, read noise, full well and ADC apply; without, quads are exact."""
    electrons_per_unit: float = 3.144e5
    """Modulated electrons, both taps together, of one unit (r = 1 at d = 1 m) in 2.34 ms [e-]; OPT8241-like."""
    contrast: float = 0.45
    """Demodulation contrast C of a differential sensor [1]; a unipolar one has 1 / dc_offset."""
    ambient_electrons: float = 0.0
    """Unmodulated electrons per exposure, both taps together [e-]."""
    dark_electrons_per_s: float = 5.0e4
    """Dark current per tap [e-/s]; assumed for the OPT8241."""
    read_noise_electrons: float = 80.0
    """Standard deviation of the read noise per tap [e-]; assumed for the OPT8241."""
    full_well_electrons: float = 1.0e5
    """A tap holds no more than this [e-]: saturation; assumed for the OPT8241."""
    adc_bits: int | None = 12
    """Bits of the signed ADC; None: no quantisation."""
    electrons_per_code: float = 32.0
    """Electrons per step of the ADC [e-/DN]."""

    def __post_init__(self):
        for name in ("f_mod_hz", "phase_offset", "dc_offset", "source_intensity"):
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.ndim != 0:
                raise ValueError(f"{name} must be a number or a 0-d tensor, got shape {tuple(value.shape)}")
        # numbers are checked; tensors belong to an optimiser, and looking into one could make a GPU wait
        if not isinstance(self.f_mod_hz, Tensor) and not self.f_mod_hz > 0:
            raise ValueError(f"f_mod_hz must be above 0, got {self.f_mod_hz}")
        if len(self.shifts) < 1:
            raise ValueError("shifts: a sensor needs at least one phase shift")
        for name in ("frame_period_s", "exposure_s", "electrons_per_unit", "electrons_per_code", "full_well_electrons"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("ambient_electrons", "dark_electrons_per_s", "read_noise_electrons"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 0 < self.contrast <= 1:
            raise ValueError(f"contrast must be in (0, 1], got {self.contrast}")
        if self.adc_bits is not None and not 1 <= self.adc_bits <= 24:
            raise ValueError(f"adc_bits must be in 1..24 or None, got {self.adc_bits}")
        if self.unipolar and not isinstance(self.dc_offset, Tensor) and self.dc_offset < 1.0:
            raise ValueError(f"a unipolar tap cannot hold negative light: dc_offset >= 1 needed, got {self.dc_offset}")

    @property
    def phase_slope(self) -> Scalar:
        """Phase per distance kappa = 4 pi f / c [rad/m]: light travels the distance twice."""
        return 4.0 * math.pi / SPEED_OF_LIGHT * self.f_mod_hz

    @property
    def unambiguous_range(self) -> float:
        """Range c / 2f [m]: distances are known modulo this."""
        f_mod_hz = self.f_mod_hz.detach() if isinstance(self.f_mod_hz, Tensor) else self.f_mod_hz
        return SPEED_OF_LIGHT / (2.0 * float(f_mod_hz))

    def with_shifts(self, shifts: tuple[float, ...]) -> Sensor:
        """The same sensor reading other phase shifts [rad]."""
        return replace(self, shifts=tuple(float(s) for s in shifts))


def channel_of(shifts: Sequence[float], shift: float) -> int | None:
    """Index of a phase shift [rad] among others, whole turns aside; None if it is none of them."""
    turns = [abs(math.remainder(other - shift, 2.0 * math.pi)) for other in shifts]
    nearest = min(range(len(turns)), key=turns.__getitem__)
    return nearest if turns[nearest] <= SHIFT_TOLERANCE else None


def distance_from_phasor(re: Tensor, im: Tensor, sensor: Sensor) -> Tensor:
    """Distance [m] in [0, c/2f) of a phasor, ((atan2(im, re) - phase_offset) mod 2 pi) / kappa (method, 2.9)."""
    phase = torch.remainder(torch.atan2(im, re) - sensor.phase_offset, 2.0 * math.pi)
    wrapped = torch.where(phase >= 2.0 * math.pi, torch.zeros_like(phase), phase)  # remainder can round up to 2 pi
    return wrapped / sensor.phase_slope


def phasor_from_quads(quads: Tensor, shifts: tuple[float, ...] | Tensor) -> tuple[Tensor, Tensor]:
    """(re, im) of quads [Q, ...] by least squares over equally spaced shifts [rad]: 4/K sum_j Q_j exp(i theta_j).

    For the four canonical shifts these are the differences of opposite quads, of length 2a.
    """
    theta = torch.as_tensor(shifts, dtype=quads.dtype, device=quads.device).reshape(-1, *[1] * (quads.ndim - 1))
    if len(theta) < 3:
        raise ValueError(f"shifts: a phase needs at least 3 quads, got {len(theta)}")
    factor = 4.0 / len(theta)
    return factor * (quads * theta.cos()).sum(0), factor * (quads * theta.sin()).sum(0)
