"""Consistency of the decoded quartets of a moving camera: which points are static.

Each point of a quartet is compared with other quartets, its witnesses. A witness *supports* a point
in its view if it decodes the same distance in that direction, and *sees through* it if everything
around there is farther; if it decodes a smaller distance, the point is occluded and the witness
does not count. Points that are rarely seen through are static. The others move, or are mixtures of
two surfaces in a pixel at an outline.

A body that moves by less than its width is seen through along its outline only; the rest of it
counts as static. Only measured quads and poses are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..data.decode import unambiguous_range
from ..data.sequence import Sequence
from .camera import Camera
from .measured import (
    DISTANCE_TRUSTED,
    camera_of,
    decoded_phasors,
    distance_noise,
    fill,
    quads_gain,
    sensor_of,
)
from .tracks import unproject
from .unwrap import distance_from_phasors

# quartets that a point is compared with, spread evenly: more cost time and add little
WITNESSES = 32
SEEN_THROUGH = 0.3  # share of the witnesses that count beyond which a point is not static
CHUNK = 1 << 20  # points times witnesses at once: some ten megabytes per intermediate
CLOSE = 0.02  # [m] z-depth below which nothing is projected
# radius that a point covers [spacings]: half a diagonal is 0.71, and less adds mixed outlines
COVERS = 0.75


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """The complete quartets of a sequence, decoded as if taken at once in their middle."""

    quartets: list[int]
    """Their numbers."""
    times: list[float]
    """Time of each [s]."""
    cameras: list[Camera]
    """Camera of each: that of the second of its raw frames."""
    distance: Float[Tensor, "J H W"]
    """Distance in [0, c/2f) [m]; in pixels too dark to decode, that of their neighbours."""
    amplitude: Float[Tensor, "J H W"]
    """Amplitude [quad units]."""
    margin: Float[Tensor, "J H W"]
    """Largest difference between equal distances [m]."""
    unambiguous_range: float
    """Unambiguous range [m]."""

    def points(self, view: int) -> Float[Tensor, "H W 3"]:
        """Points in the world that the pixels of a view decode [m]."""
        camera = self.cameras[view]
        centre = torch.tensor(camera.centre, dtype=torch.float32)
        return centre + self.distance[view, ..., None] * camera.rays()


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """Counts and means over the witnesses, for the pixels of one view."""

    supports: Int[Tensor, "H W"]
    """Number of witnesses that support the point."""
    through: Int[Tensor, "H W"]
    """Number of witnesses that see through it."""
    distance: Float[Tensor, "H W"]
    """Mean distance over the view and its supporting witnesses [m]."""
    reflectivity: Float[Tensor, "H W"]
    """Mean amplitude times distance squared, likewise [m^2 in quad units]."""

    @property
    def moving(self) -> Bool[Tensor, "H W"]:
        """Whether a point is seen through too often to be static."""
        return self.through > SEEN_THROUGH * (self.supports + self.through)


def views_of(sequence: Sequence, nearer: float) -> Views:
    """Decode every complete quartet of a sequence, of which it has at least one.

    The noise is estimated by the median difference of neighbouring quartets in the same direction,
    which is right as long as most of the scene is static. ``nearer`` is the least significant
    difference of distances, besides noise [m].
    """
    sensor = sensor_of(sequence)
    quartets = sequence.complete_quartets
    phasors = decoded_phasors(sequence, quartets)
    amplitude = 0.5 * phasors[0].norm(dim=1)
    frames = [sequence.cycle * i + (sequence.cycle - 1) // 2 for i in quartets]
    views = Views(
        quartets=quartets,
        times=[float(sequence.times[n]) for n in frames],
        cameras=[camera_of(sequence, n) for n in frames],
        distance=distance_from_phasors([(p[:, 0], p[:, 1]) for p in phasors], sensor),
        amplitude=amplitude,
        margin=torch.full_like(amplitude, nearer),
        unambiguous_range=unambiguous_range(sequence),
    )
    noise = _noise(views, float(sensor.phase_slope), quads_gain(sequence))
    deviation = distance_noise(amplitude, noise, sequence)
    dark = deviation > DISTANCE_TRUSTED
    views.margin.add_(4.0 * deviation)
    for view in dark.any(dim=2).any(dim=1).nonzero()[:, 0].tolist():
        views.distance[view] = fill(views.distance[view, None], ~dark[view])[0]
    return views


def _noise(views: Views, phase_slope: float, gain: float) -> float:
    """Standard deviation of the noise of one quad, from distances of neighbouring views."""
    differences = [torch.zeros(0)]
    for view in range(len(views.quartets) - 1):
        other = _projected(views, views.points(view).flatten(0, 1), [view + 1])
        apart = _wrapped(other.decoded - other.expected, views.unambiguous_range)[0]
        weak = torch.minimum(views.amplitude[view].flatten(), other.amplitude[0])
        differences.append((apart.abs() * weak)[other.inside[0]])
    values = torch.cat(differences)
    one = gain / 2.0**0.5  # both views are noisy; for four quads this is 1
    return one * 1.4826 * phase_slope * float(values.median()) if len(values) else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Projected:
    """Points projected into some views."""

    inside: Bool[Tensor, "J P"]
    pixel: Int[Tensor, "J P"]
    expected: Float[Tensor, "J P"]
    decoded: Float[Tensor, "J P"]
    amplitude: Float[Tensor, "J P"]
    margin: Float[Tensor, "J P"]


def _projected(views: Views, points: Float[Tensor, "P 3"], of: list[int]) -> _Projected:
    """Pixels and distances of points in the views ``of``, and what these decode there."""
    camera = views.cameras[0]
    stacked = np.stack([views.cameras[j].camera_from_world for j in of])
    poses = torch.tensor(stacked, dtype=torch.float32)
    x, y, z = (torch.matmul(poses[:, :3, :3], points.T) + poses[:, :3, 3:]).unbind(dim=1)
    ahead = z > CLOSE
    across, down = camera.fx * x / z, camera.fy * y / z
    if camera.distortion:
        across, down = camera.distortion.apply(x / z, y / z, camera.guard.radius)
        across, down = camera.fx * across, camera.fy * down
    column = (across + camera.cx).where(ahead, -torch.ones(())).floor()
    row = (down + camera.cy).where(ahead, -torch.ones(())).floor()
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = torch.where(inside, row * camera.width + column, 0.0).long()
    images = (views.distance, views.amplitude, views.margin)
    decoded, amplitude, margin = (image[of].flatten(1).gather(1, pixel) for image in images)
    return _Projected(
        inside=inside,
        pixel=pixel,
        expected=(x.square() + y.square() + z.square()).sqrt(),
        decoded=decoded,
        amplitude=amplitude,
        margin=margin,
    )


def _wrapped(difference: Tensor, unambiguous_range: float) -> Tensor:
    """Differences of distances [m] in [-c/4f, c/4f)."""
    half = 0.5 * unambiguous_range
    return torch.remainder(difference + half, unambiguous_range) - half


def verdicts(views: Views) -> Iterator[Verdict]:
    """The comparison of each view with its witnesses, in order."""
    count = len(views.quartets)
    spread = np.unique(np.linspace(0, count - 1, min(count, WITNESSES)).round().astype(int))
    farther = torch.nn.functional.max_pool2d(-views.distance[:, None], 3, stride=1, padding=1)
    nearest = -farther[:, 0]
    for view in range(count):
        witnesses = [j for j in spread.tolist() if j != view]
        yield _verdict(views, view, witnesses, nearest)


def _verdict(
    views: Views, view: int, witnesses: list[int], nearest: Float[Tensor, "J H W"]
) -> Verdict:
    size = views.distance.shape[1:]
    margins, near = views.margin[view].flatten(), views.distance[view].flatten()
    reflectivity = views.amplitude[view].flatten() * near.square()
    parts = []
    step = max(CHUNK // max(len(witnesses), 1), 1)
    points = views.points(view).flatten(0, 1)
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        supports = through = torch.zeros(len(near[rows]), dtype=torch.long)
        apart = bright = torch.zeros(len(near[rows]))
        if witnesses:
            seen = _projected(views, points[rows], witnesses)
            margin = torch.maximum(seen.margin, margins[rows])
            difference = _wrapped(seen.decoded - seen.expected, views.unambiguous_range)
            supporting = seen.inside & (difference.abs() <= margin)
            behind = nearest[witnesses].flatten(1).gather(1, seen.pixel) > seen.expected + margin
            supports = supporting.sum(dim=0)
            through = (seen.inside & behind & ~supporting).sum(dim=0)
            apart = torch.where(supporting, difference, 0.0).sum(dim=0)
            bright = torch.where(supporting, seen.amplitude * seen.decoded.square(), 0.0).sum(dim=0)
        share = 1.0 / (1.0 + supports)
        means = near[rows] + share * apart, share * (reflectivity[rows] + bright)
        parts.append((supports, through, *means))
    supports, through, distance, reflectivity = (
        torch.cat(part).view(size) for part in zip(*parts, strict=True)
    )
    return Verdict(supports=supports, through=through, distance=distance, reflectivity=reflectivity)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """Points that become Gaussians."""

    mean: Float[Tensor, "P 3"]
    """Positions in the world [m]."""
    distance: Float[Tensor, "P"]
    """Distance from the camera of the view that each is from [m]."""
    amplitude: Float[Tensor, "P"]
    """Amplitude in that view [quad units]."""


def static_layer(
    views: Views, judged: list[Verdict], grid: Float[Tensor, "P 2"], spacing: float
) -> Layer:
    """Points about ``spacing`` pixels apart on all static surfaces of all views, each surface once.

    In turn, beginning with the middle one, each view adds the points of its ``grid`` [px] that no
    earlier point covers.
    """
    column, row = grid.long().unbind(dim=1)
    layer = Layer(mean=torch.zeros(0, 3), distance=torch.zeros(0), amplitude=torch.zeros(0))
    for view in _outwards(len(views.quartets)):
        verdict = judged[view]
        alone = verdict.supports + verdict.through == 0
        typical = ~outlying(views.distance[view], views.margin[view])
        confirmed = torch.where(alone, typical, verdict.supports > 0)
        wanted = (confirmed & ~verdict.moving & ~_covered(views, view, layer, spacing))[row, column]
        distance = verdict.distance[row, column][wanted]
        amplitude = verdict.reflectivity[row, column][wanted] / distance.square().clamp_min(1e-12)
        mean = unproject(views.cameras[view], grid[wanted], distance)
        layer = Layer(
            mean=torch.cat([layer.mean, mean]),
            distance=torch.cat([layer.distance, distance]),
            amplitude=torch.cat([layer.amplitude, amplitude]),
        )
    return layer


def _outwards(count: int) -> list[int]:
    """The middle of ``count`` views, both ends, then the middles in between."""
    order = [count // 2, 0, count - 1]
    gaps = [(0, count // 2), (count // 2, count - 1)]
    for start, end in gaps:  # grows
        middle = (start + end) // 2
        if start < middle:
            order.append(middle)
            gaps += [(start, middle), (middle, end)]
    return list(dict.fromkeys(order))


def _covered(views: Views, view: int, layer: Layer, spacing: float) -> Bool[Tensor, "H W"]:
    """Pixels of a view that see a surface covered by a point of the layer."""
    height, width = views.distance.shape[1:]
    covered = torch.zeros(height, width)
    if not len(layer.mean):
        return covered.bool()
    seen = _projected(views, layer.mean, [view])
    apart = _wrapped(seen.decoded - seen.expected, views.unambiguous_range).abs()
    here = (seen.inside & (apart <= seen.margin))[0]
    radius = (COVERS * spacing * layer.distance / seen.expected[0]).round().long()
    radius = radius.clamp(0, min(height, width) // 4)
    for size in radius[here].unique().tolist():
        marks = torch.zeros(height * width)
        marks[seen.pixel[0][here & (radius == size)]] = 1.0
        pooled = torch.nn.functional.max_pool2d(
            marks.view(1, height, width), 2 * size + 1, stride=1, padding=size
        )
        covered = torch.maximum(covered, pooled[0])
    return covered.bool()


def outlying(distance: Float[Tensor, "H W"], margin: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels whose distance differs from the median of their 3x3 neighbourhood."""
    padded = torch.nn.functional.pad(distance[None, None], (1, 1, 1, 1), mode="replicate")
    median = torch.nn.functional.unfold(padded, 3).view(9, *distance.shape).median(dim=0).values
    return (distance - median).abs() > margin
