"""Truncated signed distance of the nodes of a grid, averaged over distance images.

A camera that sees distance d on the ray through a node at distance r knows that the node is d - r
in front of the surface. What is far in front counts as 1; what is behind counts the less the
farther, since another camera may see that the body is thin there:

    s = (d - r) / truncation
    f = sum of w min(1, s) / sum of w,   w = min(1, 1 + s), over the cameras with s > -1

The surface is where f is 0. A node that no camera tells of is *hidden*.
"""

import warp as wp

from ..geometry import CameraView
from ..lens import distorted

CLOSE = wp.constant(0.02)  # [m] z-depth below which a node is not projected


@wp.func
def seen_at(distance: wp.array3d[float], camera: int, x: float, y: float, step: float) -> float:
    """Distance [m] at an image position [px], NaN outside: interpolated, or that of the nearest
    pixel where the four around differ by more than ``step`` [m].
    """
    height = distance.shape[1]
    width = distance.shape[2]
    if not (x >= 0.0 and y >= 0.0 and x < float(width) and y < float(height)):
        return wp.nan
    column = wp.clamp(int(wp.floor(x - 0.5)), 0, wp.max(width - 2, 0))
    row = wp.clamp(int(wp.floor(y - 0.5)), 0, wp.max(height - 2, 0))
    right = wp.min(column + 1, width - 1)
    below = wp.min(row + 1, height - 1)
    a = distance[camera, row, column]
    b = distance[camera, row, right]
    c = distance[camera, below, column]
    d = distance[camera, below, right]
    low = wp.min(wp.min(a, b), wp.min(c, d))
    high = wp.max(wp.max(a, b), wp.max(c, d))
    known = not (wp.isnan(a) or wp.isnan(b) or wp.isnan(c) or wp.isnan(d))
    if not known or high - low > step:
        return distance[camera, int(wp.floor(y)), int(wp.floor(x))]
    across = wp.clamp(x - 0.5 - float(column), 0.0, 1.0)
    down = wp.clamp(y - 0.5 - float(row), 0.0, 1.0)
    return wp.lerp(wp.lerp(a, b, across), wp.lerp(c, d, across), down)


@wp.kernel(enable_backward=False)
def fuse(
    # In:
    views: wp.array[CameraView],  # [V]
    lens: bool,  # whether the cameras are no pinholes [flag]
    distance: wp.array3d[float],  # [V, H, W] along the ray [m]; NaN: unknown
    low: wp.vec3,  # node [0, 0, 0] in the world [m]
    voxel: float,  # distance of neighbouring nodes [m]
    truncation: float,  # largest distance behind a surface that counts [m]
    # Out:
    field: wp.array3d[float],  # [X, Y, Z] signed distance over the truncation [1], free if hidden
    hidden: wp.array3d[wp.uint8],  # [X, Y, Z] whether no camera knows of a node [flag]
):
    """One node of the grid, in all images."""
    i, j, k = wp.tid()
    node = low + voxel * wp.vec3(float(i), float(j), float(k))
    total = float(0.0)
    count = float(0.0)
    for camera in range(views.shape[0]):
        view = views[camera]
        local = view.rotation * node + view.translation
        if local[2] > CLOSE:
            slope = wp.vec2(local[0] / local[2], local[1] / local[2])
            if lens:
                slope = distorted(view, slope[0], slope[1])
            x = view.fx * slope[0] + view.cx
            y = view.fy * slope[1] + view.cy
            ahead = seen_at(distance, camera, x, y, truncation) - wp.length(local)
            if ahead > -truncation:  # false where the distance is unknown
                weight = wp.min(1.0, 1.0 + ahead / truncation)
                total += weight * wp.min(1.0, ahead / truncation)
                count += weight
    if count > 0.0:
        field[i, j, k] = total / count
        hidden[i, j, k] = wp.uint8(0)
    else:
        field[i, j, k] = 1.0
        hidden[i, j, k] = wp.uint8(1)
