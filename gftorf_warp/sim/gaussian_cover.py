"""Covers: shapes as flat Gaussians, dense enough that a rendering of them is the surface.

A splat at a pixel has the profile exp(-r^2 / 2v), v = its own variance on the image plus the
renderer's low-pass. Neighbours overlap, and those nearer to the camera come first, so a cover
differs from its surface in three ways, which :func:`overlap` and :func:`spread` compute from the
compositing rule:

* it returns only the share  sum alpha T^2 < 1  of the light, hence reflectivity = rho
  cos(incidence) / share;
* it extends ``spread`` pixels beyond its outermost centres, hence grids end that far inside of
  possible outlines;
* on a slanted surface the near side of the footprint counts more, so the mean distance is too short
  by ``lead`` pixels of slope. Splats of still bodies are moved back along their rays by that much;
  covers of moving bodies are rigid, while the view of them changes, and keep this error.

Still bodies are covered along the rays of the camera, one splat a pixel, which avoids moire with
the pixel grid; a moving camera gets a new cover at every instant. Moving bodies get a regular grid
on each face, fine enough for the nearest approach of body and camera. Reflectivity is the same in
all directions; the cosine of the angle of incidence is evaluated at every instant, so that the data
obey Lambert's law, and not the model that is fitted to them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache, cached_property

import numpy as np
import torch
from jaxtyping import Float

from ..constants import ALPHA_MAX, ALPHA_MIN, LOW_PASS
from ..scene.camera import Camera, Guard
from ..scene.distortion import inside
from ..scene.gaussians import GaussianField, constant_sh
from .assembly import Assembly
from .world import Body, albedo, first_hit

RADIUS = 0.2  # [px] of a splat before the low-pass: small, because overlap blurs the surface
SPACING = 0.8  # [px] of the grid on moving bodies; the low-pass closes gaps up to about 1 px
MARGIN = 3  # [px] of cover beyond the image, more than a splat reaches
OPACITY_LOGIT = 9.0  # opacity 0.9999, above the clamp of alpha
THICKNESS = 1e-4  # [m] of the discs
COSINE_MIN = 0.1  # splats grow no longer than this on surfaces met at a glancing angle


@cache
def overlap(spacing: float, variance: float, aligned: bool) -> tuple[float, float]:
    """(Share of the light that a cover returns [1], lead of the near side [px]) at a pixel.

    Splats are ``spacing`` [px] apart, of ``variance`` v [px^2] on the image, and ``aligned``,
    centred on pixels, or else averaged over all alignments.
    """
    index = np.arange(-8, 9) * spacing
    # x: from near to far
    x, y = (axis.ravel() for axis in np.meshgrid(index, index, indexing="ij"))
    phases = [0.0] if aligned else (np.arange(6) / 6 * spacing).tolist()
    shares, leads = [], []
    for dx in phases:
        for dy in phases:
            alpha = np.minimum(ALPHA_MAX, np.exp(-((x + dx) ** 2 + (y + dy) ** 2) / (2 * variance)))
            alpha[alpha < ALPHA_MIN] = 0.0
            before = np.concatenate([[1.0], np.cumprod(1.0 - alpha)[:-1]])
            shares.append(np.sum(alpha * before**2))
            leads.append(-np.sum(alpha * before * (x + dx)) / np.sum(alpha * before))
    return float(np.mean(shares)), float(np.mean(leads))


@cache
def spread(spacing: float, variance: float) -> float:
    """How far a cover that ends at a straight row of splats extends beyond that row [px].

    The opaque half-plane that stops as much light ends there. Arguments as in :func:`overlap`.
    """
    rows, columns = np.meshgrid(-np.arange(12) * spacing, np.arange(-12, 13) * spacing)
    step = 0.05
    x = np.arange(-4.0, 4.0, step)[:, None, None, None] + step / 2
    y = np.arange(4)[None, :, None, None] / 4 * spacing
    alpha = np.minimum(ALPHA_MAX, np.exp(-((x - rows) ** 2 + (y - columns) ** 2) / (2 * variance)))
    alpha[alpha < ALPHA_MIN] = 0.0
    covered = 1.0 - np.prod(1.0 - alpha, axis=(2, 3)).mean(1)
    return float(covered.sum() * step) - 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """The splats of one body, or of all still bodies together (then its axes are the world's)."""

    point: Float[np.ndarray, "N 3"]
    """Centres in the axes of the body [m]."""
    normal: Float[np.ndarray, "N 3"]
    """Unit normals, likewise."""
    other: Float[np.ndarray, "N 3"]
    """Normals of the other face at an edge: visible only if both faces are; else an outline."""
    limb: float
    """Visible only if the cosine of incidence exceeds this [1]."""
    frame: Float[np.ndarray, "N 3 3"]
    """Orientation of each disc, likewise: columns are its two axes and its normal."""
    scale: Float[np.ndarray, "N 3"]
    """Standard deviations along those axes [m]."""
    reflectance: Float[np.ndarray, "N"]
    """Reflectance rho over the share of the light that the cover returns [1]."""
    albedo: Float[np.ndarray, "N 3"]
    """Albedo in linear RGB [1]; not corrected: weights alpha T of colour sum to the opacity."""
    body: Body | None
    """The moving body; None for the cover of the still bodies."""

    def __len__(self) -> int:
        return len(self.point)

    def facing(
        self, centre: Float[np.ndarray, "3"], time: float, *, colour: bool = False
    ) -> GaussianField:
        """The splats facing a camera at ``centre`` [m] at ``time`` [s], shaded by incidence.

        The others are occluded by their own body. ``colour`` adds the albedo, which is not shaded.
        """
        pose = np.eye(4) if self.body is None else self.body.path.world_from_body(time)
        rotation = pose[:3, :3]
        mean = self.point @ rotation.T + pose[:3, 3]
        ray = mean - centre
        length = np.sqrt(_dot(ray, ray))
        sides = (self.normal, self.other)
        cosine, cosine_other = (-_dot(n @ rotation.T, ray) / length for n in sides)
        shown = (cosine > self.limb) & (cosine_other > self.limb)
        cosine = 0.5 * (cosine + cosine_other)
        count = int(shown.sum())
        if self.body is None:
            turns = self._at_rest[shown]
        else:
            turns = quaternions(rotation @ self.frame[shown])
        return GaussianField(
            mean=_tensor(mean[shown]),
            log_scale=_tensor(np.log(self.scale[shown])),
            quaternion=_tensor(turns),
            opacity_logit=torch.full((count,), OPACITY_LOGIT),
            reflectivity_sh=constant_sh(_tensor(self.reflectance[shown] * cosine[shown])),
            colour_sh=constant_sh(_tensor(self.albedo[shown])).mT if colour else None,
        )

    @cached_property
    def _at_rest(self) -> Float[np.ndarray, "N 4"]:
        """Quaternions of all discs as they are stored; still ones are the same at all times."""
        return quaternions(np.eye(3) @ self.frame)


def cover_still(bodies: tuple[Body, ...], camera: Camera) -> Cover:
    """One splat on the ray of every pixel, and of a margin, that meets a still body.

    Each is a disc in the surface, stretched along the slope so that its image is round, and moved
    back, see above.
    """
    wide = _wider(camera)
    hits = first_hit(bodies, wide, 0.0)
    hit = np.isfinite(hits.distance)
    normal, distance = hits.normal[hit], hits.distance[hit]
    ray = wide.rays(dtype=torch.float64).numpy()[hit]
    cosine = np.clip(-np.sum(normal * ray, axis=1), COSINE_MIN, 1.0)
    share, lead = overlap(1.0, LOW_PASS + RADIUS**2, True)

    # axis of the disc that is not foreshortened; any at normal incidence
    across = np.cross(normal, ray)
    level = np.linalg.norm(across, axis=1) < 1e-9
    across[level] = np.cross(normal[level], [1.0, 0.0, 0.0])
    across[level & (np.linalg.norm(across, axis=1) < 1e-9)] = [0.0, 1.0, 0.0]
    footprint = RADIUS * distance / camera.fx
    if camera.distortion:
        footprint /= np.sqrt(wide.area(torch.from_numpy(hits.point[hit])).numpy())
    return Cover(
        point=hits.point[hit] + ray * (lead * depth_slope(normal, distance, ray, wide))[:, None],
        normal=normal,
        other=normal,
        limb=0.0,
        frame=_frame(across, normal),
        scale=np.stack([footprint, footprint / cosine, np.full(len(distance), THICKNESS)], axis=1),
        reflectance=hits.reflectance[hit] / share,
        albedo=albedo(bodies, hits, 0.0)[hit],
        body=None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Wide(Camera):
    """A camera with a margin around its image, where its lens is extrapolated."""

    inner: Camera

    @property
    def guard(self) -> Guard:
        """That of the image alone: the polynomial of a lens may fold in the margin."""
        return self.inner.guard


def _wider(camera: Camera) -> Camera:
    """The same camera with a margin as wide as the reach of a splat."""
    values = {f.name: getattr(camera, f.name) for f in fields(camera)}
    values |= {"width": camera.width + 2 * MARGIN, "height": camera.height + 2 * MARGIN}
    return _Wide(**{**values, "cx": camera.cx + MARGIN, "cy": camera.cy + MARGIN}, inner=camera)


def cover_moving(
    body: Body,
    camera: Camera,
    times: Float[np.ndarray, "F"],
    centres: Float[np.ndarray, "F 3"] | None = None,
) -> Cover:
    """Grids of discs on the faces, ``SPACING`` pixels apart at the nearest of ``times`` [s].

    ``centres`` [m] are positions of the camera at those times; None: that of ``camera``.
    """
    distances = _distances(body, camera.centre if centres is None else centres, times)
    nearest, typical = distances.min(), distances.mean() + body.shape.reach
    if nearest <= 0:
        why = f"clearance {nearest:.3f} m must be above 0"
        raise ValueError(f"a moving body reaches the camera: {why}")
    focal = camera.fx * magnification(camera)
    spacing, variance = SPACING * nearest / focal, LOW_PASS + RADIUS**2
    inset = spread(SPACING * nearest / typical, variance) * typical / focal - spacing / 2
    point, normal, other, limb = body.shape.grid(spacing, inset)
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(normal, helper)
    radius = RADIUS / SPACING * spacing
    share, _ = overlap(SPACING, variance, False)
    return Cover(
        point=point,
        normal=normal,
        other=other,
        limb=limb,
        frame=_frame(across, normal),
        scale=np.tile([radius, radius, THICKNESS], (len(point), 1)),
        reflectance=body.texture(point) / share,
        albedo=body.texture.albedo(point),
        body=body,
    )


def splats_of(
    body: Body,
    camera: Camera,
    times: Float[np.ndarray, "F"],
    centres: Float[np.ndarray, "F 3"],
) -> float:
    """About how many splats :func:`cover_moving` makes, where there are many."""
    nearest = _distances(body, centres, times).min()
    return body.shape.grid_area * (camera.fx * magnification(camera) / (SPACING * nearest)) ** 2


def _distances(
    body: Body, centres: Float[np.ndarray, "*frames 3"], times: Float[np.ndarray, "F"]
) -> Float[np.ndarray, "F"]:
    """Distance [m] of a body from a camera, for which a grid is fine enough."""
    local = _in_its_axes(body, centres, times)
    distances = body.shape.clearance(local)
    outside = np.linalg.norm(local, axis=1) - body.shape.reach
    if outside.min() > 0 and not isinstance(body.shape, Assembly):
        return outside  # from the bounding sphere: a grid that is finer than it has to be
    return distances


def clearance(
    body: Body, camera: Float[np.ndarray, "*frames 3"], times: Float[np.ndarray, "F"]
) -> Float[np.ndarray, "F"]:
    """Lower bound of the distance [m] of a camera from a body at ``times`` [s], see
    :meth:`Shape.clearance`; ``camera`` is its position [m], or one for each of the times.
    """
    return body.shape.clearance(_in_its_axes(body, camera, times))


def _in_its_axes(
    body: Body, camera: Float[np.ndarray, "*frames 3"], times: Float[np.ndarray, "F"]
) -> Float[np.ndarray, "F 3"]:
    """Positions of a camera in the axes of a body at ``times`` [s]."""
    poses = np.array([body.path.world_from_body(float(t)) for t in times])
    return np.einsum("fji,fj->fi", poses[:, :3, :3], camera - poses[:, :3, 3])


def _frame(across: np.ndarray, normal: np.ndarray) -> Float[np.ndarray, "N 3 3"]:
    """Orientation of discs with these normals, of which one axis is along ``across``."""
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(normal, across), normal], axis=2)


def depth_slope(normal, distance, ray, camera: Camera) -> Float[np.ndarray, "N"]:
    """Growth of distance [m/px] on the tangent plane, where z-depth grows fastest.

    With the normal n, the direction f = (x/z, y/z, 1) and n . f z constant, grad z = -z n / (n . f)
    / focal length and d = z |f|. Zero where z-depth, which orders splats, is constant: then no side
    leads.
    """
    camera_from_world = camera.camera_from_world[:3, :3]
    local_ray, local_normal = ray @ camera_from_world.T, normal @ camera_from_world.T
    flat = local_ray / local_ray[:, 2:]  # (x/z, y/z, 1)
    along = np.sum(local_normal * flat, axis=1)
    z = distance * local_ray[:, 2]
    gradient_z = -z[:, None] * local_normal[:, :2] / along[:, None] / [camera.fx, camera.fy]
    length = np.linalg.norm(flat, axis=1)
    gradient_length = flat[:, :2] / length[:, None] / [camera.fx, camera.fy]
    if camera.distortion:
        gradient_z = _per_pixel(gradient_z, flat, camera)
        gradient_length = _per_pixel(gradient_length, flat, camera)
    gradient = gradient_z * length[:, None] + z[:, None] * gradient_length
    steepness = np.linalg.norm(gradient_z, axis=1)
    slanted = steepness > 1e-5 * z
    slope = np.sum(gradient * gradient_z, axis=1) / np.where(slanted, steepness, 1.0)
    limit = distance / camera.fx / COSINE_MIN
    return np.where(slanted, np.clip(slope, -limit, limit), 0.0)


def _per_pixel(gradient, flat, camera: Camera) -> Float[np.ndarray, "N 2"]:
    """A gradient per pixel of a pinhole as one per pixel of a lens, whose Jacobian is symmetric."""
    xx, xy, yy = camera.distortion.slope(*inside(flat[:, 0], flat[:, 1], camera.guard.radius))
    focal = np.array([camera.fx, camera.fy])
    x, y = (gradient * focal).T
    turned = np.stack([x * yy - y * xy, y * xx - x * xy], axis=1)
    return turned / (xx * yy - xy * xy)[:, None] / focal


def magnification(camera: Camera) -> float:
    """Largest magnification in the image by the distortion of a lens [1]."""
    if not camera.distortion:
        return 1.0
    flat = camera.directions().flatten(0, 1).numpy()
    xx, xy, yy = camera.distortion.slope(*(flat[:, :2] / flat[:, 2:]).T)
    return float((0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)).max())


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products of rows of three, whose reductions are slow."""
    x, y, z = (a * b).T
    return x + y + z


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def quaternions(rotation: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions (wxyz) of rotations, from the largest of the four components."""
    r = rotation
    trace = np.trace(r, axis1=1, axis2=2)
    squares = np.stack([trace, r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]], axis=1)
    squares[:, 1:] = 2.0 * squares[:, 1:] - trace[:, None]  # now (4 component^2 - 1)
    products = np.empty((len(r), 4, 4))  # 4 times the products of components
    products[:, range(4), range(4)] = squares + 1.0
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        products[:, 0, i] = products[:, i, 0] = r[:, j, k] - r[:, k, j]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        products[:, i + 1, j + 1] = products[:, j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    row = products[np.arange(len(r)), squares.argmax(axis=1)]
    return row / np.linalg.norm(row, axis=1, keepdims=True)
