"""Rays through pixels, and samples along them.

A ray is o + z D, where D has a z-component of 1 in camera axes: z is a depth, the distance of a
point is z |D|. Everything is in the axes of the *volume*, which are those of the mean camera
(neural_volumes.md, section 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...scene.camera import Camera

CLOSED = 1e10  # [m] interval of the last sample, behind which is nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """R rays."""

    origin: Float[Tensor, "R 3"]
    """Where they begin [m]."""
    direction: Float[Tensor, "R 3"]
    """D: the point at z-depth z is origin + z direction [1]."""

    @property
    def length(self) -> Float[Tensor, "R"]:
        """Distance per z-depth, |D| [1]."""
        return self.direction.norm(dim=-1)

    def at(self, z: Float[Tensor, "R *S"]) -> Float[Tensor, "R *S 3"]:
        """Points [m] at z-depths [m]."""
        along = (len(z), *[1] * (z.ndim - 1), 3)
        return self.origin.reshape(along) + z[..., None] * self.direction.reshape(along)

    def part(self, which: slice) -> Rays:
        """Some of them."""
        return Rays(origin=self.origin[which], direction=self.direction[which])


@dataclass(frozen=True, kw_only=True, eq=False)
class Depths:
    """Where the S samples of R rays are."""

    z: Float[Tensor, "R S"]
    """Their z-depths [m]."""
    interval: Float[Tensor, "R S"]
    """The z-depths [m] that each stands for."""

    @classmethod
    def between(cls, z: Float[Tensor, "R S"]) -> Depths:
        """Samples that stand for the way to the next one; the last one has no end."""
        end = torch.full_like(z[:, :1], CLOSED)
        return cls(z=z, interval=torch.cat([z[:, 1:] - z[:, :-1], end], dim=-1))


class Views:
    """The rays of V cameras of one size and lens, on a device."""

    def __init__(self, cameras: Sequence[Camera], volume_from_world: np.ndarray, device):
        """Take note of cameras.

        Args:
            cameras: They differ in their poses alone.
            volume_from_world: Pose of the volume, 4x4.
            device: Where rays are wanted.
        """
        unit = cameras[0].directions()
        self._local = (unit / unit[..., 2:]).reshape(-1, 3).to(device, torch.float32)
        self.pixels = len(self._local)
        """Number of pixels of an image."""
        poses = np.stack(
            [volume_from_world @ np.linalg.inv(camera.camera_from_world) for camera in cameras]
        )
        self._volume_from_camera = torch.tensor(poses, dtype=torch.float32, device=device)

    def spread(self, bounds: tuple[float, float]) -> tuple[float, float]:
        """Largest |x / z| and |y / z| of the points of all rays between two z-depths [m]."""
        ends = torch.tensor(bounds, device=self._local.device).expand(self.pixels, 2)
        poses = torch.unique(self._volume_from_camera, dim=0)
        extents = []
        for pose in poses:
            direction = self._local @ pose[:3, :3].T
            at = pose[:3, 3] + ends[..., None] * direction[:, None]
            ratio = at[..., :2] / at[..., 2:].clamp_min(0.5 * bounds[0])
            extents.append(ratio.abs().amax((0, 1)))
        x, y = torch.stack(extents).amax(0).tolist()
        return x, y

    def rays(self, view: Int[Tensor, "1"] | int, pixels: Int[Tensor, "R"] | None = None) -> Rays:
        """The rays of some pixels, numbered row by row, or of all; a view whose number is on the
        device is one that CUDA graphs may change.
        """
        poses = self._volume_from_camera
        pose = poses[view] if isinstance(view, int) else poses.index_select(0, view)[0]
        local = self._local if pixels is None else self._local[pixels]
        direction = local @ pose[:3, :3].T
        return Rays(origin=pose[:3, 3].expand_as(direction), direction=direction)


def mean_pose(camera_from_world: Float[np.ndarray, "F 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The world-to-volume matrix of axes in the middle of all cameras: their mean position, and
    the rotation nearest to the mean of theirs.
    """
    world_from_camera = np.linalg.inv(camera_from_world)
    u, _, v = np.linalg.svd(world_from_camera[:, :3, :3].mean(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    middle = np.eye(4)
    middle[:3, :3], middle[:3, 3] = rotation, world_from_camera[:, :3, 3].mean(axis=0)
    return np.linalg.inv(middle)


def evenly(
    bounds: tuple[float, float],
    rays: int,
    samples: int,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> Depths:
    """Samples evenly from the first bound to the last.

    Args:
        bounds: z-depths of the first and the last sample [m].
        rays: Their number R.
        samples: Their number S on each.
        device: Where they are wanted.
        generator: Each sample moves within its cell, at random; None: none does.
    """
    z = torch.linspace(*bounds, samples, device=device).expand(rays, samples)
    if generator is None:
        return Depths.between(z)
    middle = 0.5 * (z[:, 1:] + z[:, :-1])
    lower = torch.cat([z[:, :1], middle], dim=1)
    upper = torch.cat([middle, z[:, -1:]], dim=1)
    share = torch.rand(rays, samples, device=device, generator=generator)
    return Depths.between(lower + share * (upper - lower))
