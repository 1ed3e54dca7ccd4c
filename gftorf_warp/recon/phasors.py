"""The phasor of a pixel as well as it is known: rendered, and corrected by what was measured.

Gaussians explain a pixel that mixes two surfaces only in part. Seen from the sequence's own camera,
more is known of it:

* where a quartet agrees with the temporal mean (data/temporal.py), the phasor of that mean;
* at the time of a raw frame, one of the two components of the phasor: twice the quad is the
  component along its shift. The other one stays rendered, and the residuals of the quad nearby tell
  how wrong a rendered component is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from ..data import temporal
from ..data.cycles import solution
from ..data.decode import quartet_phasors
from ..data.noise import amplitudes_of, quad_noise
from ..data.sequence import Sequence
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import quad_from_phasor
from . import closed_form

MODEL_ERROR = 0.01  # of a rendered component at least, of the largest amplitude within 3x3 pixels
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
    mean: Complex[Tensor, "f H W"]
    """Temporal mean of the quartets that agree, at each frequency; 0 where none does."""
    variance: Float[Tensor, "H W"]
    """Of each component of that mean [quad units^2], from the noise."""
    agrees: Bool[Tensor, "Q H W"]
    """Which quartets agree."""

    @classmethod
    def of(cls, sequence: Sequence, camera: Camera, device: torch.device) -> MeasuredPhasors | None:
        """The temporal means of a sequence on a device; None if no quartet is complete.

        Args:
            sequence: What was measured.
            camera: The camera of raw frame 0, at the size of the sequence.
            device: Where images are rendered.
        """
        noise = quad_noise(sequence)
        if noise is None:
            return None
        agrees, quartets = temporal.agreement(sequence), sequence.complete_quartets
        count = np.maximum(agrees.sum(axis=0), 1)
        mean = np.zeros((len(sequence.frequencies), *count.shape), dtype=np.complex64)
        for i, there in zip(quartets, agrees, strict=True):
            for k, (_, (re, im)) in enumerate(quartet_phasors(sequence, i)):
                mean[k] += there * (re + 1j * im) / count
        frames = quartet_phasors(sequence, quartets[0])[0][0]
        rows = solution(sequence.shifts[frames])
        assert rows is not None  # or the quartet would have no phasor
        light = np.median([amplitudes_of(sequence, i) for i in quartets], axis=0)
        of_quad = np.square(noise.sigma(light)).mean(axis=0)
        variance = 0.5 * np.square(rows).sum() * of_quad / count
        return cls(
            sequence=sequence,
            camera=camera,
            mean=torch.as_tensor(mean, device=device),
            variance=torch.as_tensor(variance, device=device, dtype=torch.float32),
            agrees=torch.as_tensor(agrees.copy(), device=device),
        )

    def corrected(
        self, rendering: Rendering, time: float, camera: Camera, f_mod_hz: float
    ) -> Phasor:
        """The phasor of a rendering, corrected where more is known.

        Args:
            rendering: With its phasor at that frequency.
            time: Of the rendering [s].
            camera: Of the rendering.
            f_mod_hz: Modulation frequency [Hz].
        """
        phasor, sequence = rendered_phasor(rendering), self.sequence
        row = closed_form.row_of(sequence, time, camera, self.camera)
        if row is None or f_mod_hz not in sequence.frequencies:
            return phasor
        n = int(np.abs(sequence.times - time).argmin())
        at_frame = abs(sequence.times[n] - time) <= closed_form.TIME_S
        if at_frame and sequence.measured[n] and sequence.frame_frequencies[n] == f_mod_hz:
            phasor = self._with_quad(phasor, rendering, n)
        there, mean = self.agrees[row], self.mean[sequence.frequencies.index(f_mod_hz)]
        error = torch.minimum(phasor.variance_re, phasor.variance_im)
        variance = self.variance + error
        return Phasor(
            value=torch.where(there, mean, phasor.value),
            variance_re=torch.where(there, variance, phasor.variance_re),
            variance_im=torch.where(there, variance, phasor.variance_im),
            covariance=phasor.covariance.masked_fill(there, 0.0),
        )

    def _with_quad(self, phasor: Phasor, rendering: Rendering, n: int) -> Phasor:
        """With the component of raw frame n.

        Its error is that of the median residual of the image: noise, and light that the model lacks
        everywhere.
        """
        re, im, amplitude = rendering.phasor
        shift, offset = float(self.sequence.shifts[n]), self.sequence.calibration.dc_offset
        measured = torch.as_tensor(self.sequence.quads[n], device=re.device, dtype=re.dtype)
        residual = 2.0 * (measured - quad_from_phasor(re, im, offset * amplitude, shift))
        square = residual.square()
        nearby = avg_pool2d(square[None], 3, stride=1, padding=1, count_include_pad=False)[0]
        along = phasor.variance_re + square.median() / MEDIAN_SQUARE
        across = phasor.variance_re + nearby
        cosine, sine = math.cos(shift), math.sin(shift)
        return Phasor(
            value=phasor.value + torch.complex(residual * cosine, residual * sine),
            variance_re=along * cosine**2 + across * sine**2,
            variance_im=along * sine**2 + across * cosine**2,
            covariance=(along - across) * cosine * sine,
        )
