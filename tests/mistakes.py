"""What the tests of known mistakes share: Gaussians at given places,
recordings of given distances.
"""

import math

import numpy as np
import torch
from ftorf_folder import scene

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.tracks import unproject

DEPTH_RANGE = 15.0  # [m] c / f of the recordings below, twice the unambiguous range


def dots(points, *, scale, opacity=0.9, reflectivity=0.5, colour=None):
    """Round Gaussians at points [N, 3] in the world; the other arguments are one for all,
    or one for each.
    """
    points = torch.as_tensor(np.asarray(points), dtype=torch.float32).reshape(-1, 3)
    n = len(points)

    def each(value):
        return torch.as_tensor(value, dtype=torch.float32).expand(n).clone()

    return GaussianField(
        mean=points,
        log_scale=each(scale).log()[:, None].repeat(1, 3),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logit=torch.logit(each(opacity)),
        reflectivity_sh=constant_sh(each(reflectivity)),
        colour_sh=None
        if colour is None
        else constant_sh(torch.as_tensor(colour).expand(n, 3)).mT.contiguous(),
    )


def centres(camera: Camera) -> torch.Tensor:
    """[H, W, 2] image positions (x, y) of the pixel centres [px]."""
    x, y = torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def surface(camera: Camera, distance, **options) -> GaussianField:
    """A closed surface: one small opaque Gaussian per pixel, at ``distance`` [H,
    W] along its ray [m].
    """
    distance = torch.as_tensor(distance, dtype=torch.float32).expand(camera.height, camera.width)
    points = unproject(camera, centres(camera), distance).reshape(-1, 3)
    scale = 0.7 * distance.flatten() / math.sqrt(camera.fx * camera.fy)
    return dots(points, scale=scale, **{"opacity": 0.95, **options})


def ramp(height, width):
    """[H, W] distances [m], no two pixels alike."""
    return 2.0 + 0.02 * np.arange(width) + 0.7 * np.arange(height)[:, None] / height


def wall(distance, *, frames=8, **changes):
    """A noise-free recording of a scene at rest, distance [H, W] or [F, H, W] [m],
    and the phase of every pixel.
    """
    distance = np.asarray(distance, dtype=np.float64)
    height, width = distance.shape[-2:]
    return scene(frames, height, width, distance=distance, **changes)[0]


def phase_of(distance):
    """Phase [rad] of a distance [m] at the frequency of the recordings."""
    return 4.0 * math.pi * np.asarray(distance) / DEPTH_RANGE


F_MOD_HZ = SPEED_OF_LIGHT / DEPTH_RANGE
