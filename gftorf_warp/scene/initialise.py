"""Initial Gaussians and motion: from measured phase, or random (the control).

Phase: a static layer at the largest distance at which each pixel was static, and a moving layer of
nearer points in the middle of the sequence; for a moving camera, points that are consistent over
its views, and others that are not. Reflectivity is amplitude times distance squared. Only measured
quads, poses and flow are read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.sequence import Sequence
from ..data.steps import STEP_M
from ..data.temporal import camera_rests
from ..errors import InputError
from .background import background
from .camera import CHECKED, Camera
from .changes import require
from .clouds import cloud_of, follow_clouds, moving_layer, reference
from .fusion import Layer, static_layer, verdicts, views_of
from .gaussians import GaussianField, concatenated, constant_sh
from .measured import (
    Change,
    FarLayer,
    camera_of,
    change_of,
    decode_along_flow,
    distance_noise,
    extremes,
    far_layer,
    flow_at,
    key_times,
)
from .per_quartet import moving_points
from .tracks import follow, unproject

STATIC, MOVING = 0, 1  # labels of the two layers
EXACT_TREE = 4  # OpenCV's constant for an exact k-d tree


class Init(StrEnum):
    """Origin of the first Gaussians."""

    PHASE = "phase"
    """Distance and amplitude decoded from measured quads."""
    QUARTETS = "quartets"
    """The same for what is static; what moves is measured in every quartet, see per_quartet.py."""
    RANDOM = "random"
    """Uniform in the frusta, all moving."""


@dataclass(frozen=True, kw_only=True)
class InitSettings:
    """Initialisation of the Gaussians."""

    kind: Init = Init.PHASE
    """Origin of the Gaussians."""
    opacity: float = 0.9
    """Of every Gaussian [1]."""
    static_spacing: float = 2.5
    """Phase: distance between Gaussians of the static layer [px]."""
    edge_spacing: float = 1.0
    """Quartets: the same where the distance has steps [px]."""
    moving_spacing: float = 1.2
    """Phase: distance between Gaussians of the moving layer [px]."""
    footprint: float = 0.6
    """Phase: standard deviation of a Gaussian as a multiple of the spacing [1]."""
    nearer: float = 0.1
    """Phase: least distance in front of the background of points of the moving layer [m]."""
    fellows: int = 16
    """Phase: number of neighbouring points that share one step along the flow."""
    count: int = 3000
    """Random: number of Gaussians."""
    reflectivity: float = 0.1
    """Random: of every Gaussian [m^2 in quad units]."""
    bounds: tuple[float, float] = (0.15, 6.75)
    """Random: nearest and farthest z-depth [m]."""

    def __post_init__(self):
        require(self, "static_spacing", "edge_spacing", "moving_spacing", "footprint", above=0)
        require(self, "nearer", "reflectivity", at_least=0)
        require(self, "fellows", "count", at_least=1)
        require(self, "bounds", above=0)
        if not 0 < self.opacity < 1:
            raise ValueError(f"opacity must be in (0, 1), got {self.opacity}")
        if not self.bounds[0] < self.bounds[1]:
            raise ValueError(f"bounds must be a nearer and a farther one, got {self.bounds}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Initial state of an optimisation."""

    field: GaussianField
    """Gaussians of the static and the moving layer at the start of ``quartet``."""
    positions: Float[Tensor, "T M 3"] | None
    """Positions of the Gaussians of the moving layer at every key time [m]; None: unknown."""
    quartet: int
    """The quartet at whose start the moving layer was measured."""
    velocity: Float[Tensor, "M 3"] | None = None
    """Displacements of the moving Gaussians during their quartet [m]; None: unknown."""


def from_phase(sequence: Sequence, settings: InitSettings = InitSettings()) -> Start:
    """A static and a moving layer from decoded quads.

    Raises:
        InputError: If no quartet is complete.
    """
    _needs_quartet(sequence)
    if not camera_rests(sequence):
        return _from_views(sequence, settings)
    change = change_of(sequence)
    far = far_layer(sequence, change)
    static = _static_layer(sequence, far, settings)
    half = sequence.frames / 2
    middle = min(change.quartets, key=lambda i: abs(sequence.cycle * (i + 0.5) - half))
    points, distance, amplitude = _nearer(sequence, middle, change, far, settings)
    positions = follow(sequence, middle, points, distance, fellows=settings.fellows)
    near = Layer(mean=positions[middle], distance=distance, amplitude=amplitude)
    moving = _layer(near, MOVING, settings.moving_spacing, camera_of(sequence, 0), settings)
    return Start(field=concatenated([static, moving]), positions=positions, quartet=middle)


def _needs_quartet(sequence: Sequence) -> None:
    if not len(sequence.complete_quartets):
        raise InputError(
            "no complete quartet",
            where=sequence.path or "sequence",
            why="phase initialisation decodes the raw frames of one quartet; every quartet lacks "
            "at least one",
            fix="record more frames, or start from random Gaussians",
        )


def from_quartets(
    sequence: Sequence,
    settings: InitSettings = InitSettings(),
    device: torch.device | str = "cpu",
) -> Start:
    """A static layer, and moving Gaussians of every quartet, labelled 1 + its number; computed on
    ``device``, in the CPU's memory.

    Raises:
        InputError: If no quartet is complete, or the camera moves.
    """
    _needs_quartet(sequence)
    if not camera_rests(sequence):
        raise InputError(
            "the camera moves",
            where=sequence.path or "sequence",
            why="init.kind = quartets compares the raw frames of each pixel over time",
            fix="use --preset best without --set init.kind, or --set init.kind=phase "
            "--set motion.kind=nodes",
        )
    change = change_of(sequence)
    far = background(sequence, change, device)
    camera = camera_of(sequence, 0)
    parts, velocities = _static_parts(sequence, change, far, settings), [torch.zeros(0, 3)]
    for points in moving_points(sequence, change, far, settings.moving_spacing, device):
        layer = Layer(mean=points.mean, distance=points.distance, amplitude=points.amplitude)
        label = MOVING + points.quartet
        parts.append(_layer(layer, label, settings.moving_spacing, camera, settings))
        velocities.append(points.velocity)
    return Start(
        field=concatenated(parts), positions=None, quartet=0, velocity=torch.cat(velocities)
    )


def _static_parts(
    sequence: Sequence, change: Change, far: FarLayer, settings: InitSettings
) -> list[GaussianField]:
    """Static Gaussians: on a grid where the distance is smooth, on a finer one along its steps."""
    noise = distance_noise(far.amplitude, change.noise, sequence) / len(change.quartets) ** 0.5
    step, parts = _near_steps(far.distance, STEP_M + 4.0 * noise), []
    camera = camera_of(sequence, 0)
    for spacing, wanted in ((settings.static_spacing, ~step), (settings.edge_spacing, step)):
        points = _grid(sequence.width, sequence.height, spacing).flatten(0, 1)
        x, y = points.long().unbind(dim=1)
        points, x, y = (value[wanted[y, x]] for value in (points, x, y))
        distance = far.distance[y, x]
        mean = unproject(camera, points, distance)
        layer = Layer(mean=mean, distance=distance, amplitude=far.amplitude[y, x])
        parts.append(_layer(layer, STATIC, spacing, camera, settings))
    return parts


def _near_steps(distance: Float[Tensor, "H W"], least: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels at most two from a step of the distance of at least ``least`` [m] within 3x3."""
    low, high = extremes(distance)
    return extremes((high - low > least).float())[1] > 0


def _from_views(sequence: Sequence, settings: InitSettings) -> Start:
    """The same for a moving camera, whose views are compared in world coordinates."""
    views = views_of(sequence, settings.nearer)
    judged = list(verdicts(views))
    size = (sequence.width, sequence.height)
    spacing = settings.static_spacing
    still = static_layer(views, judged, _grid(*size, spacing).flatten(0, 1), spacing)
    images = zip(judged, views.distance, views.margin, strict=True)
    clouds = [cloud_of(verdict.moving, *image) for verdict, *image in images]
    view = reference(clouds)
    grid = _grid(*size, settings.moving_spacing)
    near, objects = moving_layer(views, view, clouds[view], grid, settings.fellows)
    keys = key_times(sequence)
    start, fellows = near.mean, settings.fellows
    positions = follow_clouds(views, clouds, view, start, objects, keys, fellows=fellows)
    quartet, camera = views.quartets[view], views.cameras[view]
    near = replace(near, mean=positions[quartet])
    static = _layer(still, STATIC, spacing, camera, settings)
    moving = _layer(near, MOVING, settings.moving_spacing, camera, settings)
    return Start(field=concatenated([static, moving]), positions=positions, quartet=quartet)


def from_random(sequence: Sequence, settings: InitSettings, generator: torch.Generator) -> Start:
    """Moving Gaussians, uniform over the volume of all frusta (method, section 6.1).

    The scale of each is the root mean square distance to its three nearest neighbours.
    """
    _, first = np.unique(sequence.camera_from_world, axis=0, return_index=True)
    cameras = [camera_of(sequence, int(n)) for n in np.sort(first)]  # each pose once
    mean = in_frusta(cameras, settings, generator)
    reflectivity = torch.full((settings.count,), settings.reflectivity)
    field = _field(mean, _spacing(mean), reflectivity, MOVING, settings.opacity)
    return Start(field=field, positions=None, quartet=0)


def in_frusta(
    cameras: list[Camera], settings: InitSettings, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Points distributed uniformly over the union of the cameras' frusta between two z-depths.

    A point is drawn in the frustum of a random camera and kept with one over the number of frusta
    that contain it.
    """
    near, far = settings.bounds
    kept: list[Tensor] = []
    missing = settings.count
    while missing > 0:
        u = torch.rand(missing, 5, generator=generator)
        which = (u[:, 4] * len(cameras)).long().clamp_max(len(cameras) - 1)
        z = (near**3 + (far**3 - near**3) * u[:, 2]) ** (1.0 / 3.0)
        points = torch.empty(missing, 3)
        for number in which.unique().tolist():
            rows, camera = which == number, cameras[number]
            pixel = u[rows, :2] * torch.tensor([camera.width, camera.height])
            slopes = camera.slopes(pixel)
            pose = torch.as_tensor(camera.camera_from_world, dtype=torch.float32)
            local = torch.cat([slopes, torch.ones(len(slopes), 1)], dim=1) * z[rows, None]
            points[rows] = (local - pose[:3, 3]) @ pose[:3, :3]
        drawn = [_holds(camera, points, near, far) for camera in cameras]
        holders = torch.stack(drawn).sum(dim=0).clamp_min(1)
        if cameras[0].distortion:  # points were drawn on the sensor: more where the lens magnifies
            drawn = [held * c.area(points) for held, c in zip(drawn, cameras, strict=True)]
            holders = torch.stack(drawn).sum(dim=0) / _least_area(cameras[0])
        kept.append(points[u[:, 3] * holders < 1.0])
        missing = settings.count - sum(map(len, kept))
    return torch.cat(kept)


def _least_area(camera: Camera) -> float:
    """Smallest area magnification by the distortion over the image [1]."""
    size = camera.width, camera.height
    axes = (torch.linspace(0, side, CHECKED, dtype=torch.float64) for side in size)
    slopes = camera.slopes(torch.cartesian_prod(*axes))
    xx, xy, yy = camera.distortion.slope(*slopes.unbind(dim=1))
    return float((xx * yy - xy * xy).min())


def _holds(
    camera: Camera, points: Float[Tensor, "N 3"], near: float, far: float
) -> Bool[Tensor, "N"]:
    """Which points are in the frustum of a camera."""
    pose = torch.as_tensor(camera.camera_from_world, dtype=torch.float32)
    z = points @ pose[2, :3] + pose[2, 3]
    x, y = camera.project(points).unbind(dim=1)
    inside = (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
    return inside & (z >= near) & (z <= far)


def _spacing(points: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Root mean square distance [m] to the three nearest neighbours; 1 for a point alone."""
    if len(points) < 2:
        return torch.ones(len(points))
    import cv2

    known = points.contiguous().numpy()
    tree = cv2.flann.Index(known, {"algorithm": EXACT_TREE, "leaf_max_size": 10})
    _, squared = tree.knnSearch(known, min(4, len(points)), params={"checks": -1})
    # the nearest of all is the point itself
    return torch.from_numpy(squared[:, 1:]).mean(dim=1).sqrt()


def _static_layer(sequence: Sequence, far: FarLayer, settings: InitSettings) -> GaussianField:
    """Gaussians on the background, one per cell of the static grid."""
    grid = _grid(sequence.width, sequence.height, settings.static_spacing).flatten(0, 1)
    x, y = grid.long().unbind(dim=1)
    camera, distance = camera_of(sequence, 0), far.distance[y, x]
    mean = unproject(camera, grid, distance)
    layer = Layer(mean=mean, distance=distance, amplitude=far.amplitude[y, x])
    return _layer(layer, STATIC, settings.static_spacing, camera, settings)


def _nearer(
    sequence: Sequence, quartet: int, change: Change, far: FarLayer, settings: InitSettings
) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Points [px], distances [m], amplitudes in front of the background, at a quartet's start.

    A point has to be in front of it in the neighbouring quartets as well, along the flow: pixels
    that seem to be near because an outline passes within the quartet are not. Isolated points and
    outliers are removed, see ``cloud_of``.
    """
    grid = _grid(sequence.width, sequence.height, settings.moving_spacing)
    size = grid.shape[:2]
    points = grid.flatten(0, 1)
    near, distance, amplitude, noise = _in_front(sequence, quartet, points, change, far, settings)
    for step in (-1, 1):
        flow = flow_at(sequence, quartet, step, points)
        if flow is not None and quartet + step in change.quartets:
            there = points + flow.nan_to_num(0.0)
            near &= _in_front(sequence, quartet + step, there, change, far, settings)[0]
    images = (value.view(size) for value in (near, distance, amplitude, noise))
    near, distance, amplitude, noise = images
    cloud = cloud_of(near, distance, settings.nearer + 4.0 * noise)
    return grid[cloud.mask], cloud.distance[cloud.mask], amplitude[cloud.mask]


def _in_front(
    sequence: Sequence,
    quartet: int,
    points: Float[Tensor, "P 2"],
    change: Change,
    far: FarLayer,
    settings: InitSettings,
) -> tuple[Bool[Tensor, "P"], Float[Tensor, "P"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Whether points are before the background; distance [m], amplitude, its noise [m]."""
    ahead, behind = (flow_at(sequence, quartet, step, points) for step in (1, -1))
    distance, amplitude = decode_along_flow(sequence, quartet, points, ahead, behind)
    noise = distance_noise(amplitude, change.noise, sequence)
    x = points[:, 0].long().clamp(0, sequence.width - 1)
    y = points[:, 1].long().clamp(0, sequence.height - 1)
    nearer = distance < far.distance[y, x] - settings.nearer - 4.0 * noise
    return nearer, distance, amplitude, noise


def _grid(width: int, height: int, spacing: float) -> Float[Tensor, "h w 2"]:
    """Image positions (x, y) [px] about ``spacing`` apart, evenly distributed over the image."""
    columns, rows = max(round(width / spacing), 1), max(round(height / spacing), 1)
    x = (torch.arange(columns) + 0.5) * (width / columns)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def _layer(
    layer: Layer, label: int, spacing: float, camera: Camera, settings: InitSettings
) -> GaussianField:
    scale = settings.footprint * spacing * layer.distance / math.sqrt(camera.fx * camera.fy)
    if camera.distortion:
        scale = scale / camera.area(layer.mean).sqrt()
    reflectivity = layer.amplitude * layer.distance.square()
    return _field(layer.mean, scale, reflectivity, label, settings.opacity)


def _field(
    mean: Tensor, scale: Tensor, reflectivity: Tensor, label: int, opacity: float
) -> GaussianField:
    n = len(mean)
    return GaussianField(
        mean=mean.float(),
        log_scale=scale.clamp_min(1e-4).log()[:, None].repeat(1, 3),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logit=torch.full((n,), math.log(opacity / (1.0 - opacity))),
        reflectivity_sh=constant_sh(reflectivity),
        layer=torch.full((n,), label),
    )
