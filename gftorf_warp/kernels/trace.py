"""Rays through meshes, balls and endless planes: what a pixel sees first, and the light that comes back from there.

With d the distance from the camera, d_e that from the emitter, and i the angle of incidence of the emitter's light,

    amplitude = rho cos(i) / d_e^2          light_h = amplitude exp(i 2 pi h f (d + d_e) / c)

averaged over the sub-samples of a pixel and the instants of an exposure (sensor notes, 1.4 and 2.2). Indirect light
goes on from the first hit in directions of density cos / pi, which leaves the product of the reflectances as the weight
of a path; every further surface adds what the emitter sends there, at the length of the whole path. The fraction of
h f (d + d_e) / c is taken before it becomes an angle, so that float32 holds at any frequency. Nothing here is shared
with the splats: another geometry, another order, other sums.

Surfaces are seen, lit and in the way on the side of their normals only: a room can be looked into from outside. Endless
planes have a normal on either side.
"""

import warp as wp

from .geometry import CameraView

NOTHING = -1  # the body where a ray hits none
FAR = wp.constant(1.0e6)  # [m] the end of the world
SHADOW_GAP = wp.constant(2.0e-4)  # [1] of the emitter's distance: what is met this near to a point is the point itself
ON_PLANE = wp.constant(1.0e-5)  # [1] of 1 m plus the origin's distance: a ray from so near to a plane starts on it
STEP = wp.constant(1.0e-5)  # [m] beyond a face that is seen from behind
SLACK = wp.constant(1.001)  # [1] on bounding balls: rounding must not cut a body
HASH = wp.constant(2654435761 & 0xFFFF)  # the last factor of the hash, as far as it reaches the bits that count
TEXTURE_ORIGIN = wp.constant(37.0001)  # [m] see sim/world.py, whose hash this is
_NOTHING = wp.constant(NOTHING)


@wp.struct
class Solid:
    """One piece of a rigid body, in the body's axes: a mesh, a ball or an endless plane."""

    mesh: wp.uint64  # its triangles, counter-clockwise as seen; unused by the others
    radius: float  # of a ball [m]; 0: no ball
    centre: wp.vec3  # of a ball [m]; the origin for the others
    reach: float  # distance of the farthest point from the centre [m]; unused by a plane
    normal: wp.vec3  # of a plane; zero: no plane
    height: float  # of a plane over the origin, along the normal [m]
    low: float  # smallest reflectance [1]
    high: float  # largest reflectance [1]
    cell: float  # edge of a texture cell [m]


@wp.struct
class Hit:
    """The first surface on a ray."""

    body: int  # index; NOTHING: none
    distance: float  # along the ray [m]
    point: wp.vec3  # in the axes of the body [m]
    normal: wp.vec3  # in the axes of the body


@wp.func
def reflectance_of(solid: Solid, point: wp.vec3) -> float:
    """Reflectance [1] in hashed cells of a grid: the lower 16 bits of the hash, which need no more of its factors."""
    x = wp.uint32(int(wp.floor((point[0] + TEXTURE_ORIGIN) / solid.cell)))
    y = wp.uint32(int(wp.floor((point[1] + TEXTURE_ORIGIN) / solid.cell)))
    z = wp.uint32(int(wp.floor((point[2] + TEXTURE_ORIGIN) / solid.cell)))
    mixed = (x * wp.uint32(73856093)) ^ (y * wp.uint32(19349663)) ^ (z * wp.uint32(83492791))
    bits = (mixed * wp.uint32(HASH)) & wp.uint32(0xFFFF)
    return solid.low + (solid.high - solid.low) * float(bits) / 65535.0


@wp.func
def meet_plane(solid: Solid, origin: wp.vec3, ray: wp.vec3, limit: float) -> Hit:
    """Hit of an endless plane from either side, nearer than ``limit`` [m]; what starts on the plane leaves it."""
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
    """First hit of one body, nearer than ``limit`` [m]; all in its axes. ``body`` is 0 if there is one."""
    if wp.length_sq(solid.normal) > 0.0:
        return meet_plane(solid, origin, ray, limit)
    hit = Hit()
    hit.body = _NOTHING
    start = origin - solid.centre
    along = -wp.dot(start, ray)
    closest = start + along * ray  # not a difference of squares, which would cancel for small bodies far away
    across = wp.length_sq(closest)
    if across > solid.reach * solid.reach * SLACK:
        return hit
    if solid.radius > 0.0:
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
    """First hit over all bodies at one instant; ``origin`` [m] and ``ray`` in camera axes, moved into each body's."""
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
def ray_through(view: CameraView, x: float, y: float) -> wp.vec3:
    """Unit vector in camera axes through the image point (x, y) [px]."""
    return wp.normalize(wp.vec3((x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0))


@wp.struct
class Emitter:
    """A point of light that shines evenly into a pyramid about the z axis of the camera."""

    place: wp.vec3  # in camera axes [m]; zero: at the camera, where nothing that it sees can be in a shadow
    spread: wp.vec2  # tangents of half the angles across and down [1]; 0: into all directions
    cycles: float  # modulation frequency over the speed of light [1/m]


@wp.func
def received(
    emitter: Emitter,
    solids: wp.array[Solid],
    rotation: wp.array2d[wp.mat33],
    translation: wp.array2d[wp.vec3],
    instant: int,
    hit: Hit,
    point: wp.vec3,  # the hit in camera axes [m]
    may_be_hidden: bool,
) -> wp.vec2:
    """Amplitude that a surface returns of the emitter's light, and its distance from it [m], both at ``point``."""
    towards = point - emitter.place
    reach = wp.length(towards)
    cosine = -wp.dot(rotation[instant, hit.body] * towards, hit.normal) / reach
    across = emitter.spread[0] * towards[2]
    down = emitter.spread[1] * towards[2]
    if emitter.spread[0] > 0.0 and (wp.abs(towards[0]) > across or wp.abs(towards[1]) > down):
        cosine = float(0.0)
    if cosine > 0.0 and may_be_hidden:
        limit = reach * (1.0 - SHADOW_GAP)
        if nearest(solids, rotation, translation, instant, emitter.place, towards / reach, limit).body >= 0:
            cosine = float(0.0)
    if cosine > 0.0:
        return wp.vec2(reflectance_of(solids[hit.body], hit.point) * cosine / (reach * reach), reach)
    return wp.vec2(0.0, reach)


@wp.func
def turned(turns: float, weight: float) -> wp.vec2:
    """A weight times exp(i 2 pi turns), of the fraction of the turns: a large angle would lose digits."""
    phase = 6.283185307179586 * (turns - wp.floor(turns))
    return weight * wp.vec2(wp.cos(phase), wp.sin(phase))


@wp.kernel(enable_backward=False)
def trace_light(
    # In:
    view: CameraView,  # intrinsics [px]
    emitter: Emitter,  # [m]
    harmonics: wp.array[int],  # [h] multiples of the modulation frequency
    solids: wp.array[Solid],  # [B]
    rotation: wp.array2d[wp.mat33],  # [T, B] body from camera
    translation: wp.array2d[wp.vec3],  # [T, B] body from camera [m]
    side: int,  # sub-samples per pixel and axis [1]
    first: int,  # row of thread (0, x) [px]
    stride: int,  # rows from one thread to the next [px]
    # Out:
    light: wp.array3d[wp.vec2],  # [h, H, W] (re, im) of the mean light
    amplitude: wp.array2d[float],  # [H, W] mean amplitude
):
    """Mean light of one pixel over all sub-samples and instants, for a source intensity of 1."""
    i, x = wp.tid()
    y = first + stride * i
    total = float(0.0)
    for h in range(harmonics.shape[0]):
        light[h, y, x] = wp.vec2(0.0, 0.0)
    for t in range(rotation.shape[0]):
        for k in range(side * side):
            image_x = float(x) + (float(k % side) + 0.5) / float(side)
            image_y = float(y) + (float(k // side) + 0.5) / float(side)
            ray = ray_through(view, image_x, image_y)
            hit = nearest(solids, rotation, translation, t, wp.vec3(0.0, 0.0, 0.0), ray, FAR)
            if hit.body >= 0:
                beside = wp.length_sq(emitter.place) > 0.0
                got = received(emitter, solids, rotation, translation, t, hit, hit.distance * ray, beside)
                total += got[0]
                turns = emitter.cycles * (hit.distance + got[1])
                for h in range(harmonics.shape[0]):
                    light[h, y, x] += turned(float(harmonics[h]) * turns, got[0])
    share = 1.0 / float(rotation.shape[0] * side * side)
    amplitude[y, x] = share * total
    for h in range(harmonics.shape[0]):
        light[h, y, x] = share * light[h, y, x]


@wp.kernel(enable_backward=False)
def trace_bounces(
    # In:
    view: CameraView,  # intrinsics [px]
    emitter: Emitter,  # [m]
    harmonics: wp.array[int],  # [h] multiples of the modulation frequency
    solids: wp.array[Solid],  # [B]
    rotation: wp.array2d[wp.mat33],  # [T, B] body from camera
    translation: wp.array2d[wp.vec3],  # [T, B] body from camera [m]
    bounces: int,  # after the first surface [1]
    paths: int,  # per pixel, shared out among the instants [1]
    seed: int,  # of this image [1]
    first: int,  # row of thread (0, x) [px]
    stride: int,  # rows from one thread to the next [px]
    # Out:
    light: wp.array3d[wp.vec2],  # [h, H, W] (re, im), added to
    amplitude: wp.array2d[float],  # [H, W] added to
):
    """Add the mean of random paths of one pixel: light that met more than one surface."""
    i, x = wp.tid()
    y = first + stride * i
    random = wp.rand_init(seed, y * light.shape[2] + x)
    share = 1.0 / float(paths)
    total = float(0.0)
    for p in range(paths):
        t = p % rotation.shape[0]
        image_x = float(x) + wp.randf(random)
        image_y = float(y) + wp.randf(random)
        ray = ray_through(view, image_x, image_y)
        hit = nearest(solids, rotation, translation, t, wp.vec3(0.0, 0.0, 0.0), ray, FAR)
        point = hit.distance * ray
        length = hit.distance
        weight = share
        for _bounce in range(bounces):
            if hit.body >= 0:
                weight = weight * reflectance_of(solids[hit.body], hit.point)
                normal = wp.transpose(rotation[t, hit.body]) * hit.normal
                ray = wp.normalize(normal + wp.sample_unit_sphere_surface(random))
                hit = nearest(solids, rotation, translation, t, point, ray, FAR)
            if hit.body >= 0:
                point = point + hit.distance * ray
                length += hit.distance
                got = received(emitter, solids, rotation, translation, t, hit, point, True)
                total += weight * got[0]
                turns = emitter.cycles * (length + got[1])
                for h in range(harmonics.shape[0]):
                    light[h, y, x] += turned(float(harmonics[h]) * turns, weight * got[0])
    amplitude[y, x] += total


@wp.kernel(enable_backward=False)
def trace_hits(
    # In:
    view: CameraView,  # intrinsics [px] and rotation
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
    ray = ray_through(view, float(x) + 0.5, float(y) + 0.5)
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
