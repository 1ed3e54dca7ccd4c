"""The oracle of distances inside a splat, in plain torch: the peak of a Gaussian along a ray, and
its first-order form, which kernels compute (kernels/rasterise/splat_distance.py): 1/t linear in the
image.

In camera axes, with mean mu and P = covariance^-1, the Gaussian along t r is exp(-1/2 (t r - mu)' P
(t r - mu)), largest at t(r) = (r' P mu) / (r' P r).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.camera import Camera
from ..scene.distortion import inside

SIGMAS, SHARE_OF_DISTANCE = 3.0, 0.5  # of the bound, as in the kernels


def precision_of(
    rotation: Float[Tensor, "M 3 3"], scale: Float[Tensor, "M 3"]
) -> Float[Tensor, "M 3 3"]:
    """Inverse covariances [1/m^2]; the columns of ``rotation`` are the Gaussians' own axes."""
    return (rotation / scale[:, None, :] ** 2) @ rotation.mT


def peak_distances(
    rays: Float[Tensor, "P 3"], point: Float[Tensor, "M 3"], precision: Float[Tensor, "M 3 3"]
) -> Float[Tensor, "P M"]:
    """Distance [m] at which each Gaussian is largest along each unit ray, in camera axes."""
    along = rays @ (precision @ point[:, :, None])[:, :, 0].T
    return along / torch.einsum("pi,mij,pj->pm", rays, precision, rays)


def slope_of(
    camera: Camera, point: Float[Tensor, "M 3"], precision: Float[Tensor, "M 3 3"]
) -> Float[Tensor, "M 2"]:
    """Derivative of the peak's inverse distance by the image position, at the centre
    [1/(m px)].
    """
    distance = point.norm(dim=1, keepdim=True)
    n = point / distance
    normal = (precision @ n[:, :, None])[:, :, 0]
    # t = b / a with b = r' P mu, a = r' P r, and b = |mu| a at the centre
    by_ray = -distance * normal / (n * normal).sum(1, keepdim=True)
    # the unit ray of (x/z, y/z, 1) moves across itself only, z / |mu| times as far
    across = (by_ray - (by_ray * n).sum(1, keepdim=True) * n) * point[:, 2:] / distance
    by_x, by_y, _ = (-across / distance**2).unbind(1)
    if camera.distortion:
        x, y, z = point.unbind(1)
        xx, xy, yy = camera.distortion.slope(*inside(x / z, y / z, camera.guard.radius))
        area = xx * yy - xy * xy
        by_x, by_y = (by_x * yy - by_y * xy) / area, (by_y * xx - by_x * xy) / area
    return torch.stack([by_x / camera.fx, by_y / camera.fy], 1)


def bound_of(distance: Float[Tensor, "M"], scale: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """How far a pixel's inverse distance may be from the centre's [1/m]; without a derivative."""
    most = torch.minimum(SIGMAS * scale.amax(1), SHARE_OF_DISTANCE * distance)
    return (1.0 / distance - 1.0 / (distance + most)).detach()


def plane_distances(
    pixel: Float[Tensor, "P 2"],
    centre: Float[Tensor, "M 2"],
    distance: Float[Tensor, "M"],
    slope: Float[Tensor, "M 2"],
    bound: Float[Tensor, "M"],
) -> Float[Tensor, "P M"]:
    """Distance of each splat at each pixel [m]; its inverse is linear, at most ``bound`` off."""
    offset = ((pixel[:, None] - centre) * slope).sum(2)
    return 1.0 / (1.0 / distance + torch.minimum(torch.maximum(offset, -bound), bound))
