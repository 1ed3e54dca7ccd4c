"""Clouds of moving points, one per view of a moving camera, and tracks of their objects.

A cloud holds the points that other views see through. Tracking needs no optical flow: in world
coordinates static points do not move, so an object is found near its predicted position, by its
centroid as long as its visible area does not change much.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .fusion import Layer, Views
from .tracks import interpolated, nearest, unproject

# points of a cloud and of an object that are compared, evenly thinned
CLOUD_SIZE, OBJECT_SIZE = 2000, 300
ITERATIONS = 6  # of assigning points to objects and moving these to the centroids
AREA_RATIO = 0.75  # least ratio of visible areas, now and before, at which centroids are comparable
# likewise if the border of the image cuts the object, whose centroid then lags
AREA_RATIO_CUT = 0.95
# largest distance of an object's points from it, in root mean square radii of the object
GATE = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Moving points of one view."""

    mask: Bool[Tensor, "H W"]
    """Whether a pixel sees a moving point."""
    distance: Float[Tensor, "H W"]
    """Distances [m], without outliers."""


def cloud_of(
    moving: Bool[Tensor, "H W"], distance: Float[Tensor, "H W"], margin: Float[Tensor, "H W"]
) -> Cloud:
    """The moving points of an image, without isolated ones, as mixtures at outlines are.

    Distances [m] that differ by more than ``margin`` [m] from the median of their moving
    neighbourhood become it.
    """
    mask, distance = moving & (_windows(moving.float()).mean(dim=0) > 0.5), distance.clone()
    median = _windows(torch.where(mask, distance, torch.nan))[:, mask].nanmedian(dim=0).values
    outlying = (distance[mask] - median).abs() > margin[mask]
    distance[mask] = torch.where(outlying, median, distance[mask])
    return Cloud(mask=mask, distance=distance)


def reference(clouds: list[Cloud]) -> int:
    """The view nearest to the middle with at least half as many points as the largest cloud."""
    sizes = [int(cloud.mask.sum()) for cloud in clouds]
    middle = len(clouds) // 2
    large = [j for j, size in enumerate(sizes) if 2 * size >= max(sizes)]
    return min(large, key=lambda j: (abs(j - middle), j))


def moving_layer(
    views: Views, view: int, cloud: Cloud, grid: Float[Tensor, "h w 2"], fellows: int
) -> tuple[Layer, Int[Tensor, "P"]]:
    """The points of a grid that are in a cloud, and the number of the object that each belongs to.

    Neighbours of the grid belong to one object if their distances differ by no more than the noise;
    objects of fewer than ``fellows`` points are dropped.
    """
    column, row = grid.long().unbind(dim=2)
    mask, distance = cloud.mask[row, column], cloud.distance[row, column]
    label = _connected(mask, distance, views.margin[view][row, column])
    names, index, count = label[mask].unique(return_inverse=True, return_counts=True)
    kept = (count >= fellows)[index]
    pixel, far = grid[mask][kept], distance[mask][kept]
    amplitude = views.amplitude[view][row, column][mask][kept]
    mean = unproject(views.cameras[view], pixel, far)
    layer = Layer(mean=mean, distance=far, amplitude=amplitude)
    return layer, torch.unique(names[index[kept]], return_inverse=True)[1]


def follow_clouds(
    views: Views,
    clouds: list[Cloud],
    start: int,
    points: Float[Tensor, "P 3"],
    objects: Int[Tensor, "P"],
    times: Float[Tensor, "T"],
    *,
    fellows: int,
) -> Float[Tensor, "T P 3"]:
    """Positions [m] at ``times`` [s] of moving points [m] of the view ``start`` and of ``objects``.

    The points of an object move by one shift, and then each of them by the median displacement of
    its ``fellows`` nearest points to the visible surface, which follows rotations. Beyond the views
    that see an object, its last step is extrapolated.
    """
    count = int(objects.max()) + 1 if len(objects) else 0
    groups = [objects == number for number in range(count)]
    shifts = [{views.times[start]: torch.zeros(int(group.sum()), 3)} for group in groups]
    visible = [_visible(views, view, cloud) for view, cloud in enumerate(clouds)]
    for step in (1, -1) if count else ():
        tracks = [
            _Track(points[group], known, views, start, fellows)
            for group, known in zip(groups, shifts, strict=True)
        ]
        for view in range(start + step, len(visible) if step > 0 else -1, step):
            _find(tracks, visible[view], views.times[view])
    positions = points.repeat(len(times), 1, 1)
    for group, known in zip(groups, shifts, strict=True):
        positions[:, group] += interpolated(known, times, outer=1)
    return positions


@dataclass(frozen=True, kw_only=True, eq=False)
class _Visible:
    """Points of a cloud."""

    points: Float[Tensor, "P 3"]
    weight: Float[Tensor, "P"]  # area per point, up to a factor: distance squared
    at_border: Bool[Tensor, "P"]


def _visible(views: Views, view: int, cloud: Cloud) -> _Visible:
    height, width = cloud.mask.shape
    row, column = cloud.mask.nonzero().unbind(dim=1)
    thin = _thin(len(row), CLOUD_SIZE)
    share = len(row) / max(len(thin), 1)
    row, column = row[thin], column[thin]
    border = (row == 0) | (row == height - 1) | (column == 0) | (column == width - 1)
    distance = cloud.distance[row, column]
    points = unproject(views.cameras[view], torch.stack([column, row], dim=1) + 0.5, distance)
    return _Visible(points=points, weight=share * distance.square(), at_border=border)


class _Track:
    """An object that is tracked from view to view."""

    def __init__(
        self,
        points: Float[Tensor, "P 3"],
        shifts: dict[float, Float[Tensor, "P 3"]],
        views: Views,
        start: int,
        fellows: int,
    ):
        centre = torch.tensor(views.cameras[start].centre).to(points)
        self.points = points
        self.shifts = shifts  # by time; grows
        self.fellows = nearest(points, fellows)
        self.some = points[_thin(len(points), OBJECT_SIZE)]
        self.centroid = _centroid(points, (points - centre).square().sum(dim=1))
        self.gate = GATE * float((points - self.centroid).square().sum(dim=1).mean().sqrt())
        self.time = views.times[start]
        self.shift = self.velocity = torch.zeros(3)
        self.area: float | None = None

    def predicted(self, time: float) -> Float[Tensor, "3"]:
        """The shift [m], extrapolated from the last known step."""
        return self.shift + (time - self.time) * self.velocity

    def update(
        self, surface: Float[Tensor, "Q 3"], shift: Float[Tensor, "3"], area: float, time: float
    ) -> None:
        """Add the shift [m] of a view, by its visible points [m] and their area [m^2]."""
        self.velocity = (shift - self.shift) / (time - self.time)
        self.shift, self.time, self.area = shift, time, area
        moved = self.points + shift
        lacking = surface[torch.cdist(moved, surface).argmin(dim=1)] - moved
        self.shifts[time] = shift + lacking[self.fellows].median(dim=1).values


def _find(tracks: list[_Track], visible: _Visible, time: float) -> None:
    """Move objects to the centroids of the points nearest to them, if areas hardly changed."""
    if not len(visible.points):
        return
    shifts = [track.predicted(time) for track in tracks]
    for _ in range(ITERATIONS):
        apart = [
            torch.cdist(visible.points, t.some + shift).min(dim=1).values / t.gate
            for t, shift in zip(tracks, shifts, strict=True)
        ]
        nearest, owner = torch.stack(apart).min(dim=0)
        mine = [(owner == number) & (nearest <= 1.0) for number in range(len(tracks))]
        for number, (track, of) in enumerate(zip(tracks, mine, strict=True)):
            if of.any():
                centroid = _centroid(visible.points[of], visible.weight[of])
                shifts[number] = centroid - track.centroid
    for track, of, shift in zip(tracks, mine, shifts, strict=True):
        area = float(visible.weight[of].sum())
        least = AREA_RATIO_CUT if bool(visible.at_border[of].any()) else AREA_RATIO
        if area > 0.0 and (track.area is None or least <= area / track.area <= 1.0 / least):
            track.update(visible.points[of], shift, area, time)


def _centroid(points: Float[Tensor, "P 3"], weight: Float[Tensor, "P"]) -> Float[Tensor, "3"]:
    return (points * weight[:, None]).sum(dim=0) / weight.sum()


def _thin(count: int, most: int) -> Int[Tensor, "n"]:
    """Indices of at most ``most`` of ``count`` points, evenly spread."""
    return torch.arange(0, count, max(-(-count // most), 1))


def _connected(
    mask: Bool[Tensor, "h w"], distance: Float[Tensor, "h w"], margin: Float[Tensor, "h w"]
) -> Int[Tensor, "h w"]:
    """A number for every cell, the same for neighbours in ``mask`` whose distances [m] agree."""
    height, width = mask.shape
    label = torch.arange(height * width).view(height, width)
    pairs = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one = (slice(0, height - dy), slice(max(-dx, 0), width - max(dx, 0)))
        other = (slice(dy, height), slice(max(dx, 0), width + min(dx, 0)))
        alike = (distance[one] - distance[other]).abs() <= torch.maximum(margin[one], margin[other])
        pairs.append((one, other, mask[one] & mask[other] & alike))
    while True:
        before = label.clone()
        for one, other, joined in pairs:
            least = torch.minimum(label[one], label[other])
            label[one] = torch.where(joined, least, label[one])
            label[other] = torch.where(joined, torch.minimum(least, label[other]), label[other])
        label = torch.where(mask, label.flatten()[label], label)  # follows chains of labels
        if torch.equal(label, before):
            return label


def _windows(image: Float[Tensor, "H W"]) -> Float[Tensor, "25 H W"]:
    """The 5x5 neighbourhood of every pixel, padded with zeros."""
    return torch.nn.functional.unfold(image[None, None], 5, padding=2).view(25, *image.shape)
