"""Compositing of samples along rays (neural_volumes.md, section 1).

    alpha_k = 1 - exp(-sigma_k |x_{k+1} - x_k|),   sigma_k = relu(raw)
    T_k     = prod_{j<k} (1 - alpha_j)
    quad    = sum alpha T^2 p_k / 2 (cos(psi_k - shift) + b),   p_k = |r_k| falloff / d_k^2
    phasor  = sum alpha T^2 p_k (cos psi_k, sin psi_k, 1),      psi_k = kappa d_k + phase_offset

The last interval has no end, so the volume is closed behind: there is no background. Distance,
opacity, colour and flow have weight alpha T, as in every renderer here (CONVENTIONS.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...scene.sensor import Sensor

OPAQUE = 1e-10  # [1] kept of the light behind an opaque sample, so that its logarithm exists


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """S samples of each of R rays, or of the same rays several times."""

    distance: Float[Tensor, "R S"]
    """Distance from the camera [m]."""
    alpha: Float[Tensor, "*b R S"]
    """Share of the light that a sample stops [1]."""
    strength: Float[Tensor, "*b R S"]
    """p of the samples, times alpha [optimised units]."""
    colour: Float[Tensor, "*b R S 3"] | None = None
    """Colours times alpha [1]; None: not evaluated."""

    @property
    def transmittance(self) -> Float[Tensor, "*b R S"]:
        """T of the samples [1]."""
        # the gradient of a cumulative product asks for zeros, for which the host would wait
        passed = torch.exp(torch.cumsum(torch.log(1.0 - self.alpha + OPAQUE), dim=-1))
        return torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], dim=-1)


def opacities(
    raw: Float[Tensor, "*b R S"], interval: Float[Tensor, "R S"], length: Float[Tensor, "R"]
) -> Float[Tensor, "*b R S"]:
    """Alpha of densities before their ReLU [1/m] that stand for intervals of z-depth [m], on rays
    of length |D| [1].
    """
    return 1.0 - torch.exp(-torch.relu(raw) * interval * length[:, None])


def quads(
    samples: Samples, sensor: Sensor, transmittance: Float[Tensor, "R S"]
) -> Float[Tensor, "Q R"]:
    """Quads of the shifts of a sensor [optimised units]."""
    shifts = transmittance.new_tensor(sensor.shifts)[:, None, None]
    return modulated(samples, sensor, transmittance, shifts, sensor.phase_slope)


def modulated(
    samples: Samples,
    sensor: Sensor,
    transmittance: Float[Tensor, "*b R S"],
    shift: Float[Tensor, "B 1 1"],
    slope: Float[Tensor, "B 1 1"] | float | Tensor,
) -> Float[Tensor, "B R"]:
    """Quads [optimised units] of any phase shifts [rad] and phases per distance [rad/m], of a
    sensor with this phase offset and DC offset.
    """
    weight = 0.5 * transmittance.square() * samples.strength
    phase = slope * samples.distance + sensor.phase_offset
    return (weight * (torch.cos(phase - shift) + sensor.dc_offset)).sum(dim=-1)


def phasor(
    samples: Samples,
    sensor: Sensor,
    transmittance: Float[Tensor, "R S"],
    slope: Float[Tensor, "1"] | None = None,
) -> Float[Tensor, "3 R"]:
    """(re, im, amplitude) [optimised units]; ``slope`` is the phase per distance [rad/m], None:
    that of the sensor.
    """
    weight = transmittance.square() * samples.strength
    phase = (sensor.phase_slope if slope is None else slope) * samples.distance
    phase = phase + sensor.phase_offset
    waves = torch.cos(phase), torch.sin(phase), torch.ones_like(phase)
    return torch.stack([(weight * wave).sum(dim=-1) for wave in waves])


def colour(samples: Samples, transmittance: Float[Tensor, "R S"]) -> Float[Tensor, "3 R"]:
    """Linear RGB [1].

    Raises:
        ValueError: If it was not evaluated.
    """
    if samples.colour is None:
        raise ValueError("samples without colour")
    return (transmittance[..., None] * samples.colour).sum(dim=1).T


def expected(
    samples: Samples, transmittance: Float[Tensor, "R S"], value: Float[Tensor, "R S *d"]
) -> Float[Tensor, "R *d"]:
    """Sum of alpha T times a value of the samples, not divided by the opacity."""
    weight = samples.alpha * transmittance
    return (weight.reshape(*weight.shape, *[1] * (value.ndim - 2)) * value).sum(dim=1)


def opacity(samples: Samples, transmittance: Float[Tensor, "*b R S"]) -> Float[Tensor, "*b R"]:
    """Share of the light that is stopped [1]."""
    return (samples.alpha * transmittance).sum(dim=-1)


def distortion(samples: Samples, transmittance: Float[Tensor, "*b R S"]) -> Float[Tensor, "*b R"]:
    """Sum over pairs of samples k, l of w_k w_l (d_k - d_l)^2, w = alpha T [m^2]."""
    weight = samples.alpha * transmittance
    total = weight.sum(dim=-1)
    mean, square = ((weight * samples.distance**power).sum(dim=-1) for power in (1, 2))
    return (2.0 * (total * square - mean.square())).clamp_min(0.0)


def median_distance(samples: Samples, transmittance: Float[Tensor, "R S"]) -> Float[Tensor, "R"]:
    """Distance of the sample at which the transmittance falls below one half [m], 0 where it does
    not.
    """
    behind = transmittance * (1.0 - samples.alpha)
    first = torch.argmax((behind < 0.5).to(torch.uint8), dim=-1, keepdim=True)
    there = torch.gather(samples.distance, 1, first)
    return torch.where(torch.gather(behind, 1, first) < 0.5, there, torch.zeros_like(there))[:, 0]
