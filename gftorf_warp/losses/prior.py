"""Regularisers of motion: agreement with the optical flow, and small displacements.

The third prior, depth distortion, is an output of the renderer: ``Rendering.distortion`` (method,
section 2.7).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def image_motion(
    surface: Float[Tensor, "H W 3"],
    displacement: Float[Tensor, "3 H W"],
    project: Callable[[Tensor], Tensor],
    project_later: Callable[[Tensor], Tensor] | None = None,
) -> Float[Tensor, "2 H W"]:
    """Optical flow F2 = project_later(P + F3) - project(P) [px] that a moving surface causes
    (method, section 5).

    Args:
        surface: Points P seen by the pixels [m]; gradients through them are cut.
        displacement: Composited motion F3 of the scene [m], not divided by the opacity.
        project: World points [..., 3] to image positions [..., 2] in px, for example
            ``Camera.project``.
        project_later: The same for the camera at the end of the flow; None: it has not moved.
    """
    start = surface.detach()
    end = start + displacement.permute(1, 2, 0)
    return ((project_later or project)(end) - project(start)).permute(2, 0, 1)


def flow_error(
    rendered: Float[Tensor, "2 H W"], measured: Float[Tensor, "2 H W"]
) -> tuple[Float[Tensor, "2 H W"], Bool[Tensor, "H W"]]:
    """Squared difference of optical flows [px^2] and the pixels where the measured one is known.

    Unknown pixels (NaN in either component of ``measured``) have error 0 and pass no gradient.
    """
    known = measured.isfinite().all(dim=0)
    return torch.where(known, rendered - measured, 0.0).square(), known


def motion_size(displacement: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Length of the displacement of every Gaussian [m]; its derivative at rest is zero."""
    squared = displacement.square().sum(dim=-1)
    moving = squared > 0
    return torch.where(moving, torch.where(moving, squared, 1.0).sqrt(), 0.0)
