"""Rays through meshes, balls and endless planes: what a ray meets first.

Surfaces are visible, lit and opaque from the side of their normals only; endless planes have a
normal on either side. light_paths.py has the light.
"""

import warp as wp

from ..geometry import CameraView
from ..lens import undistorted

NOTHING = -1  # the body where a ray hits none
FAR = wp.constant(1.0e6)  # [m] the end of the world
# [1] of 1 m plus the origin's distance: a ray from so near to a plane starts on it
ON_PLANE = wp.constant(1.0e-5)
STEP = wp.constant(1.0e-5)  # [m] beyond a face that is seen from behind
SLACK = wp.constant(1.001)  # [1] on bounding balls: rounding must not cut a body
# the last factor of the hash, as far as it reaches the bits that count
HASH = wp.constant(2654435761 & 0xFFFF)
TEXTURE_ORIGIN = wp.constant(37.0001)  # [m] see sim/texture.py, whose hash this is
_NOTHING = wp.constant(NOTHING)
MESH, BALL, PLANE = range(3)  # shapes of a solid
_BALL, _PLANE = wp.constant(BALL), wp.constant(PLANE)


@wp.struct
class Solid:
    """One piece of a rigid body, in the body's axes: a mesh, a ball or an endless plane."""

    shape: int  # MESH, BALL or PLANE
    mesh: wp.uint64  # its triangles, counter-clockwise as seen; unused by the others
    radius: float  # of a ball [m]; unused by the others
    centre: wp.vec3  # of a ball [m]; the origin for the others
    reach: float  # distance of the farthest point from the centre [m]; unused by a plane
    normal: wp.vec3  # of a plane; unused by the others
    height: float  # of a plane over the origin, along the normal [m]
    low: float  # smallest reflectance [1]
    high: float  # largest reflectance [1]
    cell: float  # edge of a texture cell [m]
    gloss: float  # share of the reflectance that is mirrored into a lobe [1]
    shininess: float  # exponent of that lobe [1]


@wp.struct
class Hit:
    """The first surface on a ray."""

    body: int  # index; NOTHING: none
    distance: float  # along the ray [m]
    point: wp.vec3  # in the axes of the body [m]
    normal: wp.vec3  # in the axes of the body


@wp.func
def reflectance_of(solid: Solid, point: wp.vec3) -> float:
    """Reflectance [1] in hashed cells of a grid, from the lower 16 bits of the hash."""
    x = wp.uint32(int(wp.floor((point[0] + TEXTURE_ORIGIN) / solid.cell)))
    y = wp.uint32(int(wp.floor((point[1] + TEXTURE_ORIGIN) / solid.cell)))
    z = wp.uint32(int(wp.floor((point[2] + TEXTURE_ORIGIN) / solid.cell)))
    mixed = (x * wp.uint32(73856093)) ^ (y * wp.uint32(19349663)) ^ (z * wp.uint32(83492791))
    bits = (mixed * wp.uint32(HASH)) & wp.uint32(0xFFFF)
    return solid.low + (solid.high - solid.low) * float(bits) / 65535.0


@wp.func
def meet_plane(solid: Solid, origin: wp.vec3, ray: wp.vec3, limit: float) -> Hit:
    """Hit of an endless plane from either side, nearer than ``limit`` [m];
    what starts on the plane leaves it.
    """
    hit = Hit()
    hit.body = _NOTHING
    height = wp.dot(solid.normal, origin) - solid.height
    falling = -wp.dot(solid.normal, ray)
    if falling * height > 0.0 and wp.abs(height) > ON_PLANE * (1.0 + wp.length(origin)):
        distance = height / falling
        if distance < limit:
            hit.body = 0
            hit.distance = distance
            hit.point = origin + distance * ray
            hit.normal = wp.sign(height) * solid.normal
    return hit


@wp.func
def meet(solid: Solid, origin: wp.vec3, ray: wp.vec3, limit: float) -> Hit:
    """First hit of one body within ``limit`` [m], in its axes; ``body`` is 0 if there is one."""
    if solid.shape == _PLANE:
        return meet_plane(solid, origin, ray, limit)
    hit = Hit()
    hit.body = _NOTHING
    start = origin - solid.centre
    along = -wp.dot(start, ray)
    # not a difference of squares, which would cancel for small bodies far away
    closest = start + along * ray
    across = wp.length_sq(closest)
    if across > solid.reach * solid.reach * SLACK:
        return hit
    if solid.shape == _BALL:
        if across < solid.radius * solid.radius:
            distance = along - wp.sqrt(solid.radius * solid.radius - across)
            if distance > 0.0 and distance < limit:
                hit.body = 0
                hit.distance = distance
                hit.point = origin + distance * ray
                hit.normal = wp.normalize(start + distance * ray)
        return hit
    travelled = float(0.0)
    searching = bool(True)
    while searching:
        query = wp.mesh_query_ray(solid.mesh, origin + travelled * ray, ray, limit - travelled)
        searching = query.result
        if query.result:
            travelled += query.t
            if query.sign > 0.0:
                searching = False
                hit.body = 0
                hit.distance = travelled
                hit.point = origin + travelled * ray
                hit.normal = query.normal
            else:
                travelled += STEP
    return hit


@wp.func
def nearest(
    solids: wp.array[Solid],
    rotation: wp.array2d[wp.mat33],
    translation: wp.array2d[wp.vec3],
    instant: int,
    origin: wp.vec3,
    ray: wp.vec3,
    limit: float,
) -> Hit:
    """First hit over all bodies at one instant; ``origin`` [m] and ``ray`` in camera axes."""
    best = Hit()
    best.body = _NOTHING
    best.distance = limit
    for b in range(solids.shape[0]):
        turn = rotation[instant, b]
        hit = meet(solids[b], turn * origin + translation[instant, b], turn * ray, best.distance)
        if hit.body >= 0:
            best = hit
            best.body = b
    return best


@wp.func
def ray_through(view: CameraView, lens: bool, x: float, y: float) -> wp.vec3:
    """Unit vector in camera axes through the image point (x, y) [px]; a ``lens`` is undone."""
    slope = wp.vec2((x - view.cx) / view.fx, (y - view.cy) / view.fy)
    if lens:
        slope = undistorted(view, slope[0], slope[1])
    return wp.normalize(wp.vec3(slope[0], slope[1], 1.0))


@wp.kernel(enable_backward=False)
def trace_hits(
    # In:
    view: CameraView,  # intrinsics [px] and rotation
    lens: bool,  # whether the camera is no pinhole [flag]
    solids: wp.array[Solid],  # [B]
    rotation: wp.array2d[wp.mat33],  # [1, B] body from camera
    translation: wp.array2d[wp.vec3],  # [1, B] body from camera [m]
    first: int,  # row of thread (0, x) [px]
    stride: int,  # rows from one thread to the next [px]
    # Out:
    distance: wp.array2d[float],  # [H, W] along the ray [m]; NaN: nothing is hit
    z_depth: wp.array2d[float],  # [H, W] third camera coordinate [m]; NaN likewise
    normal: wp.array2d[wp.vec3],  # [H, W] unit normal in world axes; NaN likewise
    body: wp.array2d[int],  # [H, W] index of the body; -1 likewise
):
    """The first surface on the ray through the centre of one pixel."""
    i, x = wp.tid()
    y = first + stride * i
    ray = ray_through(view, lens, float(x) + 0.5, float(y) + 0.5)
    hit = nearest(solids, rotation, translation, 0, wp.vec3(0.0, 0.0, 0.0), ray, FAR)
    body[y, x] = hit.body
    if hit.body >= 0:
        distance[y, x] = hit.distance
        z_depth[y, x] = hit.distance * ray[2]
        normal[y, x] = wp.transpose(rotation[0, hit.body] * view.rotation) * hit.normal
    else:
        distance[y, x] = wp.nan
        z_depth[y, x] = wp.nan
        normal[y, x] = wp.vec3(wp.nan, wp.nan, wp.nan)
