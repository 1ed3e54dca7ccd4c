"""The camera: intrinsics of the stored resolution, one pose, and a pinhole or a distortion."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import GUARD
from .distortion import Distortion, inside

CHECKED = 33  # positions per axis at which the lens of a new camera is checked


class Guard(NamedTuple):
    """Limits of the projection, as x/z and y/z of a point [1]."""

    x: float
    """Half the width of the view times 1.3: beyond it derivatives are those at it (method, 2.2)."""
    y: float
    """Half its height times 1.3, likewise."""
    radius: float
    """Radius beyond which a distortion is extrapolated by its tangent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A camera with axes x right, y down, z forward; pixel [0, 0] is centred at (0.5, 0.5).

    >>> import torch
    >>> from gftorf_warp import Camera
    >>> camera = Camera.from_fov(64, 48, horizontal_fov_deg=90.0)
    >>> camera.project(torch.tensor([0.5, 0.0, 1.0])).tolist()
    [48.0, 24.0]
    """

    width: int
    """Columns W of the image."""
    height: int
    """Rows H of the image."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]; W/2 is the middle of the image."""
    cy: float
    """Principal point, y [px]."""
    camera_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Pose, 4x4 on column vectors, world to camera [m]."""
    distortion: Distortion = field(default_factory=Distortion)
    """Distortion of the lens; the default is a pinhole."""

    def __post_init__(self):
        pose = np.asarray(self.camera_from_world, dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"camera_from_world {pose.shape} must be (4, 4)")
        if not np.isfinite(pose).all():
            raise ValueError(f"camera_from_world must be finite, got {pose.tolist()}")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(value := getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {value}")
        rotation = pose[:3, :3]
        orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-4
        if not orthogonal or np.linalg.det(rotation) < 0:
            raise ValueError(
                f"camera_from_world: its upper left 3x3 is not a rotation: {rotation.tolist()}"
            )
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"a camera needs pixels and focal lengths above 0, got {self.width}x{self.height}, "
                f"fx {self.fx}, fy {self.fy}"
            )
        object.__setattr__(self, "camera_from_world", pose)
        _ = self.guard  # raises ValueError if the lens cannot be inverted inside the image

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov_deg: float, **pose: Any) -> Camera:
        """A camera with square pixels, a centred principal point and a field of view [deg]."""
        focal = 0.5 * width / math.tan(math.radians(horizontal_fov_deg) / 2)
        cx, cy = width / 2, height / 2
        return cls(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, **pose)

    @property
    def centre(self) -> np.ndarray:
        """Position of the camera [3] in the world [m]."""
        pose = self.camera_from_world
        return -pose[:3, :3].T @ pose[:3, 3]

    @functools.cached_property
    def guard(self) -> Guard:
        """Limits of the derivatives of the projection, and of the polynomial of the lens."""
        if not self.distortion:
            x, y = (0.5 * GUARD * side for side in (self.width, self.height))
            return Guard(x / self.fx, y / self.fy, math.inf)
        return _guard(self.distortion, self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def at(self, camera_from_world: np.ndarray) -> Camera:
        """The same camera at another pose."""
        return replace(self, camera_from_world=camera_from_world)

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution: intrinsics scale with the image."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def finer(self, n: int) -> Camera:
        """The same view with n x n pixels for each."""
        return self.resized(n * self.width, n * self.height)

    def row(self, number: int) -> Camera:
        """The camera of one row of the image."""
        return replace(self, height=1, cy=self.cy - number)

    def area(self, point: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Area magnification of the distortion [1] at points in the world [m]."""
        if not self.distortion:
            return torch.ones_like(point[..., 0])
        pose = torch.from_numpy(self.camera_from_world).to(point)
        x, y, z = (point @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
        xx, xy, yy = self.distortion.slope(*inside(x / z, y / z, self.guard.radius))
        return xx * yy - xy * xy

    def slopes(self, points: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """x/z and y/z [1] of rays at image positions (x, y) [px], without distortion.

        Raises:
            ValueError: If the lens cannot be inverted at a position far outside the image.
        """
        principal, focal = points.new_tensor([[self.cx, self.cy], [self.fx, self.fy]])
        flat = (points - principal) / focal
        if not self.distortion:
            return flat
        x, y = flat.detach().double().cpu().numpy().reshape(-1, 2).T
        x, y = self.distortion.undo(x, y, self.guard.radius)
        return torch.from_numpy(np.stack([x, y], axis=-1)).to(points).reshape(points.shape)

    def directions(self) -> Float[Tensor, "H W 3"]:
        """Unit vectors through the pixel centres, in camera axes, float64, without distortion."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height)[:, None] + 0.5 - self.cy) / self.fy
        if self.distortion:
            x, y = self.distortion.undo(x, y, self.guard.radius)
        shape = (self.height, self.width)
        flat = [torch.from_numpy(np.broadcast_to(axis, shape).copy()) for axis in (x, y)]
        directions = torch.stack([*flat, torch.ones(shape, dtype=torch.float64)], dim=-1)
        return directions / directions.norm(dim=-1, keepdim=True)

    def rays(
        self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> Float[Tensor, "H W 3"]:
        """World unit vectors through the pixel centres: point = centre + distance * ray."""
        world_from_camera = torch.from_numpy(self.camera_from_world[:3, :3].T.copy())
        return (self.directions() @ world_from_camera.T).to(device=device, dtype=dtype)

    def project(self, point: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2"]:
        """Image position (x, y) [px] of points in the world [m], in front of the camera."""
        kind = point.device, point.dtype
        if kind not in self._sent:
            numbers = (self.camera_from_world, (self.fx, self.fy), (self.cx, self.cy))
            with torch.inference_mode(False):  # later points may need gradients
                self._sent[kind] = tuple(torch.from_numpy(np.array(n)).to(point) for n in numbers)
        pose, focal, principal = self._sent[kind]
        local = point @ pose[:3, :3].T + pose[:3, 3]
        flat = local[..., :2] / local[..., 2:]
        if self.distortion:
            x, y = flat.unbind(-1)
            flat = torch.stack(self.distortion.apply(x, y, self.guard.radius), dim=-1)
        return flat * focal + principal

    @functools.cached_property
    def _sent(self) -> dict[tuple[torch.device, torch.dtype], tuple[Tensor, ...]]:
        """Pose and intrinsics by device and dtype: an upload synchronises a GPU."""
        return {}


@functools.lru_cache(maxsize=256)
def _guard(
    lens: Distortion, width: int, height: int, fx: float, fy: float, cx: float, cy: float
) -> Guard:
    """Guard of a lens, for all poses of a camera."""
    x, y = np.linspace(0, width, CHECKED), np.linspace(0, height, CHECKED)[:, None]
    x, y = lens.undo((x - cx) / fx, (y - cy) / fy)
    corner = float(np.hypot(x, y).max())
    radius = lens.radius(corner, GUARD * corner)
    return Guard(0.5 * GUARD * float(np.ptp(x)), 0.5 * GUARD * float(np.ptp(y)), radius)
