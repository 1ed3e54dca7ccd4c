"""Tracks of points: across the image by optical flow, along the ray by measured phase.

They initialise the keys of a motion model. Steps of single points are noisy, so each step is the
median over the nearest neighbours of a point, which is right wherever neighbours belong to one
object.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..data.sequence import Sequence
from .camera import Camera
from .measured import camera_of, decode_along_flow, flow_at, key_times


def follow(
    sequence: Sequence,
    quartet: int,
    points: Float[Tensor, "P 2"],
    distance: Float[Tensor, "P"],
    *,
    fellows: int,
) -> Float[Tensor, "T P 3"]:
    """Positions in the world [m] of points at every key time, extrapolated beyond known quartets.

    ``points`` [px] of a static camera are decoded at ``distance`` [m] at the start of a complete
    quartet; ``fellows`` nearest ones share a step. Without flow they stay.
    """
    times = key_times(sequence)
    if not len(points):
        return torch.zeros(len(times), 0, 3)
    camera = camera_of(sequence, sequence.cycle * quartet)
    group = nearest(unproject(camera, points, distance), fellows)
    places, distances = {quartet: points}, {quartet: distance}
    complete = set(sequence.complete_quartets)
    last = (sequence.frames - 1) // sequence.cycle
    for step in (1, -1):
        i, here, far = quartet, points, distance
        while 0 <= i + step <= last and (flow := flow_at(sequence, i, step, here)) is not None:
            i += step
            here = here + _shared(flow, group)
            places[i] = here
            if i in complete:
                ahead, behind = (flow_at(sequence, i, to, here) for to in (1, -1))
                along = [None if flow is None else _shared(flow, group) for flow in (ahead, behind)]
                decoded, _ = decode_along_flow(sequence, i, here, *along)
                far = far + _shared((decoded - far)[:, None], group)[:, 0]
                distances[i] = far
    known = ({float(times[i]): value for i, value in each.items()} for each in (places, distances))
    position, far = (interpolated(each, times, outer=2) for each in known)
    return unproject(camera, position, far)


def unproject(
    camera: Camera, points: Float[Tensor, "*n 2"], distance: Float[Tensor, "*n"]
) -> Float[Tensor, "*n 3"]:
    """Points in the world [m] at image positions (x, y) [px] and distances along the ray [m]."""
    x = (points[..., 0] - camera.cx) / camera.fx
    y = (points[..., 1] - camera.cy) / camera.fy
    if camera.distortion:
        x, y = camera.slopes(points).unbind(-1)
    ray = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    pose = torch.as_tensor(camera.camera_from_world).to(ray)
    return (ray / ray.norm(dim=-1, keepdim=True) * distance[..., None] - pose[:3, 3]) @ pose[:3, :3]


def nearest(points: Float[Tensor, "P 3"], count: int) -> Int[Tensor, "P G"]:
    """Indices of the nearest points of each point, itself included."""
    return torch.cdist(points, points).topk(min(count, len(points)), dim=1, largest=False).indices


def _shared(step: Float[Tensor, "P D"], group: Int[Tensor, "P G"]) -> Float[Tensor, "P D"]:
    """Median over each group without NaN; 0 for a group of NaN."""
    return step[group].nanmedian(dim=1).values.nan_to_num(0.0)


def interpolated(known: dict[float, Tensor], times: Float[Tensor, "T"], *, outer: int) -> Tensor:
    """Linear interpolation at ``times`` [s]; extrapolation by the slope of ``outer`` intervals."""
    at = sorted(known)
    last = len(at) - 1
    if not last:
        return known[at[0]].expand(len(times), *known[at[0]].shape)
    values = []
    for time in times.tolist():
        if time < at[0]:
            start, end, anchor = at[0], at[min(outer, last)], at[0]
        elif time > at[-1]:
            start, end, anchor = at[max(last - outer, 0)], at[-1], at[-1]
        else:
            after = next(n for n in range(1, len(at)) if at[n] >= time)
            start, end, anchor = at[after - 1], at[after], at[after - 1]
        values.append(known[anchor] + (time - anchor) / (end - start) * (known[end] - known[start]))
    return torch.stack(values)
