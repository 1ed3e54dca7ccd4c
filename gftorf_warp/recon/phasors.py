"""The phasor of a pixel as well as it is known: rendered, and corrected by what was measured.

Gaussians explain a pixel that mixes two surfaces only in part, and every pixel a little wrong. Seen
from the sequence's own camera, more is known of it:

* where a quartet agrees with the temporal mean, or measured the same as a neighbour in time
  (data/temporal.py), the phasor of their mean; where the fallback has taken the closed form, that
  of the quartet;
* at the time of a raw frame, one of the two components of the phasor: without a DC offset, twice
  the quad is the component along its shift. The other one stays rendered, and the residuals of the
  quad nearby tell how wrong a rendered component is.

Measurements are noisy and renderings smooth. What a residual exceeds its noise by, in the mean over
3x3 pixels, is the error of the rendering: its share of both is the share of the residual that is
taken over (a Wiener filter). So recordings without noise give the measured phasor, and noisy ones
the rendered one where it is right.

A mixed pixel is wrong by more than those around it, and outlines.py knows what noise does to its
decision. So where other raw frames tell the component in quadrature too, see quadrature.py, it gets
a phasor with all of every residual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from ..constants import SOURCES
from ..data.cycles import solution
from ..data.decode import quartet_phasors
from ..data.noise import median_amplitudes, quad_noise
from ..data.sequence import Sequence
from ..data.temporal import averaged_or_locally
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import Sensor, distance_from_phasor, quad_from_phasor
from . import closed_form

MODEL_ERROR = 0.01  # of a rendered component at least, of the largest amplitude within 3x3 pixels
CLOSED_FORM = SOURCES.index("closed_form")
LEAST = 1e-30  # instead of a division by zero
MEDIAN_SQUARE = 0.4549  # of a standard normal distribution


@dataclass(frozen=True, kw_only=True, eq=False)
class Phasor:
    """Phasors of an image, with the covariance of their errors [quad units^2]."""

    value: Complex[Tensor, "H W"]
    """Of length 2a [quad units]."""
    variance_re: Float[Tensor, "H W"]
    """Of the real parts."""
    variance_im: Float[Tensor, "H W"]
    """Of the imaginary parts."""
    covariance: Float[Tensor, "H W"]
    """Of both."""

    def within(self, rendering: Rendering, sensor: Sensor) -> Rendering:
        """A rendering with this phasor, and quads of the sensor that decode to it."""
        re, im, amplitude = rendering.phasor
        value = self.value
        longer = value.abs() - torch.hypot(re, im)
        constant = float(sensor.dc_offset) * longer
        quads = rendering.quads
        if quads.numel():
            change = value.real - re, value.imag - im, constant
            quads = quads + torch.stack([quad_from_phasor(*change, s) for s in sensor.shifts])
        phasor = torch.stack([value.real, value.imag, amplitude + longer])
        return replace(rendering, quads=quads, phasor=phasor)

    def decoded(self, near: Float[Tensor, "H W"], sensor: Sensor) -> Float[Tensor, "H W"]:
        """Distances of these phasors [m], whole ranges of the sensor's first frequency away so that
        they are nearest to given ones [m].
        """
        alone = distance_from_phasor(self.value.real, self.value.imag, sensor)
        period = 2.0 * math.pi / sensor.phase_slope
        return (alone + period * torch.round((near - alone) / period)).clamp_min(0.0)


def rendered_phasor(rendering: Rendering) -> Phasor:
    """The phasor of a rendering alone, with the same error in all directions."""
    value = torch.complex(rendering.phasor[0], rendering.phasor[1])
    nearby = max_pool2d(value.abs()[None], 3, stride=1, padding=1)[0]
    variance = (MODEL_ERROR * nearby).square()
    return Phasor(
        value=value,
        variance_re=variance,
        variance_im=variance,
        covariance=torch.zeros_like(variance),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPhasors:
    """What a sequence tells of the phasors of its Q complete quartets, at its own size."""

    sequence: Sequence
    """What was measured."""
    camera: Camera
    """The camera of raw frame 0."""
    value: Complex[Tensor, "Q f H W"]
    """Phasor of each quartet at each frequency, the mean over those that measured the same."""
    variance: Float[Tensor, "Q H W"]
    """Of each of its components, from the noise [quad units^2]."""
    averaged: Bool[Tensor, "Q H W"]
    """Where it is a mean of several quartets."""
    of_quads: Float[Tensor, "K H W"]
    """Variance of the quad of every slot, from the noise [quad units^2]."""

    @classmethod
    def of(cls, sequence: Sequence, camera: Camera, device: torch.device) -> MeasuredPhasors | None:
        """The phasors of a sequence on a device; None if no quartet is complete.

        Args:
            sequence: What was measured.
            camera: The camera of raw frame 0, at the size of the sequence.
            device: Where images are rendered.
        """
        noise = quad_noise(sequence)
        if noise is None:
            return None
        quartets, (mean, count) = sequence.complete_quartets, averaged_or_locally(sequence)
        value = [[re + 1j * im for _, (re, im) in quartet_phasors(mean, i)] for i in quartets]
        frames = quartet_phasors(sequence, quartets[0])[0][0]
        rows = solution(sequence.shifts[frames])
        assert rows is not None  # or the quartet would have no phasor
        of_quads = np.square(noise.sigma(median_amplitudes(sequence)))
        variance = 0.5 * np.square(rows).sum() * of_quads.mean(axis=0) / count

        def tensor(image: np.ndarray, kind: torch.dtype) -> Tensor:
            return torch.as_tensor(image, device=device, dtype=kind)

        return cls(
            sequence=sequence,
            camera=camera,
            value=tensor(np.array(value), torch.complex64),
            variance=tensor(variance, torch.float32),
            averaged=tensor(count > 1, torch.bool),
            of_quads=tensor(of_quads, torch.float32),
        )

    def corrected(
        self,
        rendering: Rendering,
        time: float,
        camera: Camera,
        f_mod_hz: float,
        *,
        averaged: Bool[Tensor, "H W"] | None = None,
        quadrature: Float[Tensor, "H W"] | None = None,
    ) -> Phasor:
        """The phasor of a rendering, corrected where more is known.

        Args:
            rendering: With its phasor at that frequency, and the map of sources of the fallback.
            time: Of the rendering [s].
            camera: Of the rendering.
            f_mod_hz: Modulation frequency [Hz].
            averaged: Where the mean of several quartets may replace what is rendered; None:
                wherever there is one.
            quadrature: How much too small the component in quadrature with the shift of the raw
                frame is rendered [quad units]. With it, residuals are taken over whole; None: the
                share of them that exceeds their noise.
        """
        rendered, sequence = rendered_phasor(rendering), self.sequence
        row = closed_form.row_of(sequence, time, camera, self.camera)
        if row is None or f_mod_hz not in sequence.frequencies:
            return rendered
        n = int(np.abs(sequence.times - time).argmin())
        at_frame = abs(sequence.times[n] - time) <= closed_form.TIME_S
        phasor, one_tap = rendered, sequence.calibration.dc_offset != 0.0
        if at_frame and not one_tap and sequence.measured[n]:
            if sequence.frame_frequencies[n] == f_mod_hz:
                phasor = self._with_quad(rendered, n, quadrature)
        there = self.averaged[row] if averaged is None else averaged
        if rendering.source is not None:
            there = there | (rendering.source == CLOSED_FORM)
        residual = self.value[row, sequence.frequencies.index(f_mod_hz)] - rendered.value
        variance = self.variance[row]
        share = torch.ones_like(variance)
        if quadrature is None:
            share = _share_of_error(0.5 * residual.abs().square(), variance, there)
        variance = rendered.variance_re + share * variance
        return Phasor(
            value=torch.where(there, rendered.value + share * residual, phasor.value),
            variance_re=torch.where(there, variance, phasor.variance_re),
            variance_im=torch.where(there, variance, phasor.variance_im),
            covariance=phasor.covariance.masked_fill(there, 0.0),
        )

    def _with_quad(
        self, rendered: Phasor, n: int, quadrature: Float[Tensor, "H W"] | None
    ) -> Phasor:
        """With the component of raw frame n, in phase with its shift.

        Its error is noise, if its residual is taken over whole; otherwise that of the median
        residual of the image: noise, and light that the model lacks everywhere. The error of the
        component in quadrature is that of the residuals around it.
        """
        shift = float(self.sequence.shifts[n])
        residual = self.residual(rendered.value.real, rendered.value.imag, n)
        square, noise = residual.square(), 4.0 * self.of_quads[n % self.sequence.cycle]
        if quadrature is None:
            residual = _share_of_error(square, noise) * residual
            quadrature = torch.zeros_like(residual)
            noise = square.median() / MEDIAN_SQUARE
        in_phase, in_quadrature = rendered.variance_re + noise, rendered.variance_re + _mean(square)
        cosine, sine = math.cos(shift), math.sin(shift)
        return Phasor(
            value=rendered.value + torch.complex(residual, quadrature) * complex(cosine, sine),
            variance_re=in_phase * cosine**2 + in_quadrature * sine**2,
            variance_im=in_phase * sine**2 + in_quadrature * cosine**2,
            covariance=(in_phase - in_quadrature) * cosine * sine,
        )

    def residual(
        self, re: Float[Tensor, "H W"], im: Float[Tensor, "H W"], n: int
    ) -> Float[Tensor, "H W"]:
        """How much too small a rendered phasor is along the shift of raw frame n [quad units], for
        a sensor without DC offset.
        """
        measured = torch.as_tensor(self.sequence.quads[n], device=re.device, dtype=re.dtype)
        shift = float(self.sequence.shifts[n])
        return 2.0 * (measured - quad_from_phasor(re, im, torch.zeros_like(re), shift))


def _share_of_error(
    square: Float[Tensor, "H W"],
    noise: Float[Tensor, "H W"],
    where: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W"]:
    """Share of squared residuals that is error of the rendering [1], the rest being noise, in the
    mean over 3x3 pixels; of those ``where`` something was measured.
    """
    excess = square - noise
    if where is not None:
        excess = _mean(excess * where) / _mean(where.to(excess)).clamp_min(LEAST)
    else:
        excess = _mean(excess)
    excess = excess.clamp_min(0.0)
    return excess / (excess + noise).clamp_min(LEAST)


def _mean(image: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Means over 3x3 pixels."""
    return avg_pool2d(image[None], 3, stride=1, padding=1, count_include_pad=False)[0]
