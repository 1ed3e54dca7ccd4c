"""Clouds of moving points, one per view of a moving camera, and where their objects go from one to the next.

A cloud is what the other views see through. It needs no optical flow to be followed: in the world only what moves
moves, so an object is found near to where it was going, by its centroid as long as as much of it is seen as before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .fusion import Layer, Verdict, Views
from .tracks import unproject

CLOUD_SIZE, OBJECT_SIZE = 2000, 300  # points of a cloud and of an object that are compared, evenly thinned
ROUNDS = 6  # of finding an object's points and moving to their centroid
AS_MUCH = 0.75  # least ratio of visible areas, now and before, at which two centroids are those of the same thing
AS_MUCH_CUT = 0.95  # the same if the border of the image cuts the object: what leaves has a centroid that lags
GATE = 2.0  # an object's points are sought no farther from it than this many times its root mean square radius


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Moving points of one view."""

    mask: Bool[Tensor, "H W"]
    """The pixels that see them."""
    distance: Float[Tensor, "H W"]
    """Distances [m], those far from the median of their moving neighbourhood replaced by it."""


def cloud_of(views: Views, view: int, verdict: Verdict) -> Cloud:
    """The moving points of a view: lonely ones, as mixtures at outlines are, are dropped."""
    mask = verdict.moving & (windows(verdict.moving.float()).mean(dim=0) > 0.5)
    distance = views.distance[view].clone()
    median = windows(torch.where(mask, distance, torch.nan))[:, mask].nanmedian(dim=0).values
    distance[mask] = torch.where((distance[mask] - median).abs() > views.margin[view][mask], median, distance[mask])
    return Cloud(mask=mask, distance=distance)


def reference(clouds: list[Cloud]) -> int:
    """The view from which to start: the one nearest to the middle that sees at least half of the most that any does."""
    sizes = [int(cloud.mask.sum()) for cloud in clouds]
    middle = len(clouds) // 2
    return min((j for j, size in enumerate(sizes) if 2 * size >= max(sizes)), key=lambda j: (abs(j - middle), j))


def moving_layer(
    views: Views, view: int, cloud: Cloud, grid: Float[Tensor, "h w 2"], fellows: int
) -> tuple[Layer, Int[Tensor, "P"]]:
    """The points of a grid that lie on a cloud, and the number of the object that each belongs to.

    Neighbours of the grid belong to one object if their distances differ by no more than noise allows; what has fewer
    than ``fellows`` points is dropped.
    """
    column, row = grid.long().unbind(dim=2)
    mask, distance = cloud.mask[row, column], cloud.distance[row, column]
    label = _connected(mask, distance, views.margin[view][row, column])
    names, index, count = label[mask].unique(return_inverse=True, return_counts=True)
    kept = (count >= fellows)[index]
    place, far = grid[mask][kept], distance[mask][kept]
    amplitude = views.amplitude[view][row, column][mask][kept]
    layer = Layer(mean=unproject(views.cameras[view], place, far), distance=far, amplitude=amplitude)
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
    """Positions [m] of moving points at ``times`` [s].

    The points of one object move alike, and then each of them by what it and its fellows, in the median, lack to the
    surface that is seen: what turns, turns its surface. Beyond the views that see an object, it goes on as in the last
    known step.

    Args:
        views: When and from where clouds were seen.
        clouds: One per view.
        start: The view in which the points are given.
        points: Where they are there [m].
        objects: Which object each belongs to, counted from 0.
        times: Key times.
        fellows: How many nearest points share the last bit of a shift.
    """
    count = int(objects.max()) + 1 if len(objects) else 0
    groups = [objects == number for number in range(count)]
    shifts = [{views.times[start]: torch.zeros(int(group.sum()), 3)} for group in groups]
    seen = [_sightings(views, view, cloud) for view, cloud in enumerate(clouds)]
    for step in (1, -1) if count else ():
        tracks = [
            _Track(points[group], known, views, start, fellows) for group, known in zip(groups, shifts, strict=True)
        ]
        for view in range(start + step, len(seen) if step > 0 else -1, step):
            _find(tracks, seen[view], views.times[view])
    positions = points.repeat(len(times), 1, 1)
    for group, known in zip(groups, shifts, strict=True):
        positions[:, group] += _at(known, times)
    return positions


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sightings:
    """Points of a cloud."""

    points: Float[Tensor, "P 3"]
    weight: Float[Tensor, "P"]  # distance squared: points per area of a surface are as many as its light is weak
    at_border: Bool[Tensor, "P"]


def _sightings(views: Views, view: int, cloud: Cloud) -> _Sightings:
    height, width = cloud.mask.shape
    row, column = cloud.mask.nonzero().unbind(dim=1)
    thin = _thin(len(row), CLOUD_SIZE)
    share = len(row) / max(len(thin), 1)
    row, column = row[thin], column[thin]
    border = (row == 0) | (row == height - 1) | (column == 0) | (column == width - 1)
    distance = cloud.distance[row, column]
    points = unproject(views.cameras[view], torch.stack([column, row], dim=1) + 0.5, distance)
    return _Sightings(points=points, weight=share * distance.square(), at_border=border)


class _Track:
    """An object on its way from one view to the next."""

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
        self.fellows = torch.cdist(points, points).topk(min(fellows, len(points)), dim=1, largest=False).indices
        self.some = points[_thin(len(points), OBJECT_SIZE)]
        self.centroid = _centroid(points, (points - centre).square().sum(dim=1))
        self.gate = GATE * float((points - self.centroid).square().sum(dim=1).mean().sqrt())
        self.time = views.times[start]
        self.shift = self.velocity = torch.zeros(3)
        self.area: float | None = None

    def predicted(self, time: float) -> Float[Tensor, "3"]:
        """The shift [m] if it goes on as in the last known step."""
        return self.shift + (time - self.time) * self.velocity

    def found(self, seen: Float[Tensor, "Q 3"], shift: Float[Tensor, "3"], area: float, time: float) -> None:
        """Note where it is [m], and how much of it is seen [m^2 up to a factor]."""
        self.velocity = (shift - self.shift) / (time - self.time)
        self.shift, self.time, self.area = shift, time, area
        moved = self.points + shift
        lacking = seen[torch.cdist(moved, seen).argmin(dim=1)] - moved
        self.shifts[time] = shift + lacking[self.fellows].median(dim=1).values


def _find(tracks: list[_Track], seen: _Sightings, time: float) -> None:
    """Move every object to the centroid of the points that are nearest to it, if they are as many as before."""
    if not len(seen.points):
        return
    shifts = [track.predicted(time) for track in tracks]
    for _ in range(ROUNDS):
        apart = [
            torch.cdist(seen.points, t.some + shift).min(dim=1).values / t.gate
            for t, shift in zip(tracks, shifts, strict=True)
        ]
        nearest, owner = torch.stack(apart).min(dim=0)
        mine = [(owner == number) & (nearest <= 1.0) for number in range(len(tracks))]
        shifts = [
            _centroid(seen.points[of], seen.weight[of]) - track.centroid if of.any() else shift
            for track, of, shift in zip(tracks, mine, shifts, strict=True)
        ]
    for track, of, shift in zip(tracks, mine, shifts, strict=True):
        area = float(seen.weight[of].sum())
        least = AS_MUCH_CUT if bool(seen.at_border[of].any()) else AS_MUCH
        if area > 0.0 and (track.area is None or least <= area / track.area <= 1.0 / least):
            track.found(seen.points[of], shift, area, time)


def _centroid(points: Float[Tensor, "P 3"], weight: Float[Tensor, "P"]) -> Float[Tensor, "3"]:
    return (points * weight[:, None]).sum(dim=0) / weight.sum()


def _thin(count: int, most: int) -> Int[Tensor, "n"]:
    """Indices of at most ``most`` of ``count`` things, evenly spread."""
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
        label = torch.where(mask, label.flatten()[label], label)  # and so on to the least of the least
        if torch.equal(label, before):
            return label


def windows(image: Float[Tensor, "H W"]) -> Float[Tensor, "25 H W"]:
    """The 5x5 neighbourhood of every pixel; beyond the border, NaN for floats that have any and else zero."""
    return torch.nn.functional.unfold(image[None, None], 5, padding=2).view(25, *image.shape)


def _at(known: dict[float, Float[Tensor, "P 3"]], times: Float[Tensor, "T"]) -> Float[Tensor, "T P 3"]:
    """Shifts at ``times`` [s], linear in between, and beyond as in the outermost step."""
    at = torch.tensor(sorted(known), dtype=torch.float64)
    value = torch.stack([known[float(time)] for time in at])
    if len(at) == 1:
        return value.expand(len(times), -1, -1)
    after = torch.searchsorted(at, times.double()).clamp(1, len(at) - 1)
    share = (times.double() - at[after - 1]) / (at[after] - at[after - 1])
    return torch.lerp(value[after - 1], value[after], share.to(value)[:, None, None])
