"""Points followed through a sequence: sideways by optical flow, along the ray by measured phase.

The result starts the keys of a motion model. Steps of single points are noisy, so every step is the median over the
nearest fellows of a point, which is right wherever neighbours on one object move alike.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..data.sequence import Sequence
from .camera import Camera
from .measured import camera_of, decode_along_flow, flow_at, key_times


def follow(
    sequence: Sequence, quartet: int, points: Float[Tensor, "P 2"], distance: Float[Tensor, "P"], *, fellows: int
) -> Float[Tensor, "T P 3"]:
    """Positions in the world [m] of points at every key time.

    Beyond the quartets that flow and measurements reach, points go on as in the last known step.

    Args:
        sequence: Raw frames and optical flow of a camera at rest; without flow the points stay.
        quartet: Where the points are given; all of its raw frames are measured.
        points: Image positions (x, y) at its start [px].
        distance: Distances decoded there [m].
        fellows: How many nearest points share a step.
    """
    times = key_times(sequence)
    if not len(points):
        return torch.zeros(len(times), 0, 3)
    camera = camera_of(sequence, sequence.cycle * quartet)
    group = _nearest(unproject(camera, points, distance), fellows)
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
    place, far = (_at({float(times[i]): value for i, value in known.items()}, times) for known in (places, distances))
    return unproject(camera, place, far)


def unproject(camera: Camera, points: Float[Tensor, "*n 2"], distance: Float[Tensor, "*n"]) -> Float[Tensor, "*n 3"]:
    """Points in the world [m] at image positions (x, y) [px] and distances along the ray [m]."""
    x = (points[..., 0] - camera.cx) / camera.fx
    y = (points[..., 1] - camera.cy) / camera.fy
    if camera.distortion:
        x, y = camera.slopes(points).unbind(-1)
    ray = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    pose = torch.as_tensor(camera.camera_from_world).to(ray)
    return (ray / ray.norm(dim=-1, keepdim=True) * distance[..., None] - pose[:3, 3]) @ pose[:3, :3]


def _nearest(points: Float[Tensor, "P 3"], count: int) -> Int[Tensor, "P G"]:
    """Indices of the nearest points of each point, itself included."""
    return torch.cdist(points, points).topk(min(count, len(points)), dim=1, largest=False).indices


def _shared(step: Float[Tensor, "P D"], group: Int[Tensor, "P G"]) -> Float[Tensor, "P D"]:
    """Median over the fellows; unknown (NaN) steps do not vote, and a group without a vote rests."""
    return step[group].nanmedian(dim=1).values.nan_to_num(0.0)


def _at(known: dict[float, Tensor], times: Float[Tensor, "T"]) -> Tensor:
    """Values at ``times``, linear in between; beyond the known ones with the mean slope of the two outer intervals."""
    at = sorted(known)
    if len(at) == 1:
        return known[at[0]].expand(len(times), *known[at[0]].shape)
    values = []
    for time in times.tolist():
        if time < at[0]:
            start, end, anchor = at[0], at[min(2, len(at) - 1)], at[0]
        elif time > at[-1]:
            start, end, anchor = at[max(len(at) - 3, 0)], at[-1], at[-1]
        else:
            after = next(n for n in range(1, len(at)) if at[n] >= time)
            start, end, anchor = at[after - 1], at[after], at[after - 1]
        values.append(known[anchor] + (time - anchor) / (end - start) * (known[end] - known[start]))
    return torch.stack(values)
