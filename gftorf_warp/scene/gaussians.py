"""A field of Gaussians: raw tensors by name, and their activations as properties."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..constants import SH_BIAS, SH_COEFFICIENTS, SH_Y0


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianField:
    """N Gaussians. All tensors share a device and float32 (float64 is for the oracle).

    Example: a ball of 20 cm, half opaque, 3 m before the camera.

    >>> import torch
    >>> from gftorf_warp import GaussianField
    >>> from gftorf_warp.scene.gaussians import constant_sh
    >>> ball = GaussianField(
    ...     mean=torch.tensor([[0.0, 0.0, 3.0]]),
    ...     log_scale=torch.full((1, 3), 0.2).log(),
    ...     quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
    ...     opacity_logit=torch.zeros(1),
    ...     reflectivity_sh=constant_sh(torch.tensor([0.8])),
    ... )
    >>> len(ball), float(ball.opacity[0])
    (1, 0.5)
    """

    mean: Float[Tensor, "N 3"]
    """Centre in the world [m]."""
    log_scale: Float[Tensor, "N 3"]
    """Natural logarithm of the standard deviations along the principal axes [log m]."""
    quaternion: Float[Tensor, "N 4"]
    """Orientation, wxyz; any length but zero."""
    opacity_logit: Float[Tensor, "N"]
    """Opacity before the sigmoid [1]."""
    reflectivity_sh: Float[Tensor, "N 16"]
    """Harmonics of the reflectivity seen from a direction [m^2 in quad units]."""
    colour_sh: Float[Tensor, "N 16 3"] | None = None
    """Harmonics of linear RGB; None if there is no colour."""
    layer: Int[Tensor, "N"] | None = None
    """Label of the motion layer that a Gaussian belongs to (0: static); never optimised."""

    def __post_init__(self):
        n = len(self.mean)
        want = {
            "mean": (n, 3),
            "log_scale": (n, 3),
            "quaternion": (n, 4),
            "opacity_logit": (n,),
            "reflectivity_sh": (n, SH_COEFFICIENTS),
            "colour_sh": (n, SH_COEFFICIENTS, 3),
            "layer": (n,),
        }
        for name, shape in want.items():
            value = getattr(self, name)
            if value is not None and tuple(value.shape) != shape:
                wanted = f"{shape} for N = {n}, the length of mean"
                raise ValueError(f"{name} {tuple(value.shape)} must be {wanted}")

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def scale(self) -> Float[Tensor, "N 3"]:
        """Standard deviations along the principal axes [m]."""
        return self.log_scale.exp()

    @property
    def opacity(self) -> Float[Tensor, "N"]:
        """Opacity at the peak [1]."""
        return self.opacity_logit.sigmoid()

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.mean.device

    def tensors(self) -> dict[str, Tensor]:
        """All tensors that are present, by name, the layer included."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def parameters(self) -> dict[str, Tensor]:
        """The tensors that can be optimised, by name."""
        return {name: value for name, value in self.tensors().items() if name != "layer"}

    def check_finite(self) -> None:
        """Check every parameter; on CUDA this waits for the device.

        Raises:
            ValueError: If one is NaN or infinite.
        """
        with torch.no_grad():
            sums = [value.sum() for value in self.parameters().values()]
            if bool(torch.stack(sums).isfinite().all()):  # otherwise one of them overflowed, or is
                return
            for name, value in self.parameters().items():
                wrong = ~value.reshape(len(self), -1).isfinite().all(dim=1)
                if (count := int(wrong.sum())) > 0:
                    first = int(wrong.nonzero()[0])
                    others = f", and of {count - 1} more" if count > 1 else ""
                    raise ValueError(
                        f"{name} of Gaussian {first}{others} is not finite: "
                        f"{_briefly(value[first])}"
                    )

    def map(self, function) -> GaussianField:
        """A field with ``function`` applied to every tensor: selection, device, detaching."""
        return replace(self, **{name: function(value) for name, value in self.tensors().items()})

    def moved(
        self, offset: Float[Tensor, "N 3"], rotation: Float[Tensor, "N 4"] | None = None
    ) -> GaussianField:
        """Every centre displaced [m], and covariances rotated by quaternions wxyz of any length."""
        quaternion = self.quaternion if rotation is None else product(rotation, self.quaternion)
        return replace(self, mean=self.mean + offset, quaternion=quaternion)


def _briefly(values: Tensor) -> str:
    """The first numbers of a tensor that are not finite."""
    flat = values.reshape(-1)
    return ", ".join(f"{x:g}" for x in flat[~flat.isfinite()][:3].tolist())


def concatenated(parts: list[GaussianField]) -> GaussianField:
    """One field of several, in their order."""
    tensors = [part.tensors() for part in parts]
    joined = {name: torch.cat([part[name] for part in tensors]) for name in tensors[0]}
    return GaussianField(**joined)


def product(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Product of quaternions wxyz: rotate by ``b``, then by ``a``, which is normalised first."""
    w, u = (a / a.norm(dim=-1, keepdim=True)).split([1, 3], dim=-1)
    v = b[..., 1:]
    real = w * b[..., :1] - (u * v).sum(dim=-1, keepdim=True)
    return torch.cat([real, w * v + b[..., :1] * u + torch.linalg.cross(u, v)], dim=-1)


def constant_sh(value: Float[Tensor, "*n"]) -> Float[Tensor, "*n 16"]:
    """Harmonics that give ``value`` in every direction: h_0 = (value - 0.5) / Y_0, the rest 0."""
    coefficients = value.new_zeros(*value.shape, SH_COEFFICIENTS)
    coefficients[..., 0] = (value - SH_BIAS) / SH_Y0
    return coefficients
