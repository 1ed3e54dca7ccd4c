"""Light by rays: what a lamp sends to a pixel from the first surface, and by random paths from
those behind it.

With d the distance from the camera, d_e that from the emitter, and i the angle of incidence of the
emitter's light,

    amplitude = rho cos(i) / d_e^2          light_h = amplitude exp(i 2 pi h f (d + d_e) / c)

averaged over the sub-samples of a pixel and the instants of an exposure (sensor notes, 1.4 and
2.2). The amplitude is pi times the radiance, so that Lambert's factor is rho. A share g of rho may
be mirrored into a lobe about the mirrored direction of the light (the normalised Phong lobe of
Lafortune and Willems, 1994), a the angle between it and the view:

    rho  becomes  rho [1 - g + g (n + 2) / 2 max(0, cos a)^n]

which is reciprocal. Paths go on with probability 1 - g in directions of density cos / pi, with g in
those of the lobe's density; their weight is the product of the reflectances, in the second case
times (n + 2) / (n + 1) cos(exit). Every further surface adds what the emitter sends there. The
fraction of h f (d + d_e) / c is taken before it becomes an angle, for float32.
"""

import warp as wp

from ..geometry import CameraView
from .rays import FAR, Hit, Solid, nearest, ray_through, reflectance_of

# [1] of the emitter's distance: what is met this near to a point is the point itself
SHADOW_GAP = wp.constant(2.0e-4)
ONE_PATH = wp.constant(float("nan"))  # the standard error of a single path


@wp.struct
class Emitter:
    """A point of light that shines into a pyramid about the z axis of the camera."""

    position: wp.vec3  # in camera axes [m]; zero: at the camera, without shadows
    limited: bool  # whether it shines into the pyramid only, not into all directions
    spread: wp.vec2  # tangents of half the angles across and down [1]; unused if not limited
    cycles: float  # modulation frequency over the speed of light [1/m]
    power: float  # exponent of the cosine to the z axis [1]; 0: even light
    factor: float  # of its light along the axis [1]; unused where it shines evenly
    least: float  # cosine beyond which the beam stays as it is [1]; likewise


@wp.func
def mirrored(ray: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Where a ray goes on from a mirror."""
    return ray - 2.0 * wp.dot(ray, normal) * normal


@wp.func
def shine(solid: Solid, view: wp.vec3, towards: wp.vec3, normal: wp.vec3) -> float:
    """Factor [1] on the reflectance: light that came along the unit vector ``towards``,
    seen along ``view``.
    """
    factor = float(1.0)
    if solid.gloss > 0.0:
        cosine = wp.max(-wp.dot(mirrored(towards, normal), view), 0.0)
        lobe = 0.5 * (solid.shininess + 2.0) * wp.pow(cosine, solid.shininess)
        factor += solid.gloss * (lobe - 1.0)
    return factor


@wp.func
def around(axis: wp.vec3, shininess: float, first: float, second: float) -> wp.vec3:
    """Unit vector about a unit ``axis``, of density cos^shininess, from two numbers in [0, 1)."""
    cosine = wp.pow(1.0 - first, 1.0 / (shininess + 1.0))
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    helper = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(axis[0]) > 0.7:
        helper = wp.vec3(0.0, 1.0, 0.0)
    u = wp.normalize(wp.cross(axis, helper))
    angle = 6.283185307179586 * second
    across = wp.cos(angle) * u + wp.sin(angle) * wp.cross(axis, u)
    return wp.normalize(cosine * axis + sine * across)


@wp.func
def received(
    emitter: Emitter,
    solids: wp.array[Solid],
    rotation: wp.array2d[wp.mat33],
    translation: wp.array2d[wp.vec3],
    instant: int,
    hit: Hit,
    point: wp.vec3,  # the hit in camera axes [m]
    view: wp.vec3,  # unit vector along which it was met, in camera axes
    may_be_hidden: bool,
) -> wp.vec2:
    """Returned amplitude of the emitter's light and its distance [m], both at ``point``."""
    towards = point - emitter.position
    reach = wp.length(towards)
    turn = rotation[instant, hit.body]
    cosine = -wp.dot(turn * towards, hit.normal) / reach
    across = emitter.spread[0] * towards[2]
    down = emitter.spread[1] * towards[2]
    if emitter.limited and (wp.abs(towards[0]) > across or wp.abs(towards[1]) > down):
        cosine = float(0.0)
    if cosine > 0.0 and may_be_hidden:
        limit = reach * (1.0 - SHADOW_GAP)
        ray = towards / reach
        first = nearest(solids, rotation, translation, instant, emitter.position, ray, limit)
        if first.body >= 0:
            cosine = float(0.0)
    if cosine > 0.0 and emitter.power != 0.0:
        straight = towards[2] / reach
        if straight > 0.0:
            cosine *= emitter.factor * wp.pow(wp.max(straight, emitter.least), emitter.power)
        else:
            cosine = float(0.0)
    if cosine > 0.0:
        factor = shine(solids[hit.body], turn * view, turn * towards / reach, hit.normal)
        reflectance = reflectance_of(solids[hit.body], hit.point)
        return wp.vec2(reflectance * factor * cosine / (reach * reach), reach)
    return wp.vec2(0.0, reach)


@wp.func
def turned(turns: float, weight: float) -> wp.vec2:
    """A weight times exp(i 2 pi turns), of the turns' fraction: a large angle loses digits."""
    phase = 6.283185307179586 * (turns - wp.floor(turns))
    return weight * wp.vec2(wp.cos(phase), wp.sin(phase))


@wp.kernel(enable_backward=False)
def trace_light(
    # In:
    view: CameraView,  # intrinsics [px]
    lens: bool,  # whether the camera is no pinhole [flag]
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
    ambient: wp.array2d[float],  # [H, W] mean reflectance
):
    """Mean direct light of a pixel over sub-samples and instants, for a source intensity of 1."""
    i, x = wp.tid()
    y = first + stride * i
    total = float(0.0)
    even = float(0.0)
    beside = wp.length_sq(emitter.position) > 0.0
    for h in range(harmonics.shape[0]):
        light[h, y, x] = wp.vec2(0.0, 0.0)
    for t in range(rotation.shape[0]):
        for k in range(side * side):
            image_x = float(x) + (float(k % side) + 0.5) / float(side)
            image_y = float(y) + (float(k // side) + 0.5) / float(side)
            ray = ray_through(view, lens, image_x, image_y)
            hit = nearest(solids, rotation, translation, t, wp.vec3(0.0, 0.0, 0.0), ray, FAR)
            if hit.body >= 0:
                point = hit.distance * ray
                got = received(emitter, solids, rotation, translation, t, hit, point, ray, beside)
                total += got[0]
                even += reflectance_of(solids[hit.body], hit.point)
                turns = emitter.cycles * (hit.distance + got[1])
                for h in range(harmonics.shape[0]):
                    light[h, y, x] += turned(float(harmonics[h]) * turns, got[0])
    share = 1.0 / float(rotation.shape[0] * side * side)
    amplitude[y, x] = share * total
    ambient[y, x] = share * even
    for h in range(harmonics.shape[0]):
        light[h, y, x] = share * light[h, y, x]


@wp.kernel(enable_backward=False)
def trace_bounces(
    # In:
    view: CameraView,  # intrinsics [px]
    lens: bool,  # whether the camera is no pinhole [flag]
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
    light: wp.array3d[wp.vec2],  # [h, H, W] (re, im) of the mean light
    amplitude: wp.array2d[float],  # [H, W] mean amplitude
    error: wp.array2d[float],  # [H, W] standard error of the first harmonic, re and im together
):
    """Mean indirect light of a pixel over random paths, for a source intensity of 1."""
    i, x = wp.tid()
    y = first + stride * i
    random = wp.rand_init(seed, y * light.shape[2] + x)
    total = float(0.0)
    squares = float(0.0)
    for h in range(harmonics.shape[0]):
        light[h, y, x] = wp.vec2(0.0, 0.0)
    for p in range(paths):
        t = p % rotation.shape[0]
        image_x = float(x) + wp.randf(random)
        image_y = float(y) + wp.randf(random)
        ray = ray_through(view, lens, image_x, image_y)
        hit = nearest(solids, rotation, translation, t, wp.vec3(0.0, 0.0, 0.0), ray, FAR)
        point = hit.distance * ray
        length = hit.distance
        weight = float(1.0)
        of_path = wp.vec2(0.0, 0.0)
        for _bounce in range(bounces):
            if hit.body >= 0:
                solid = solids[hit.body]
                weight = weight * reflectance_of(solid, hit.point)
                normal = wp.transpose(rotation[t, hit.body]) * hit.normal
                lobe = bool(False)
                if solid.gloss > 0.0:
                    lobe = wp.randf(random) < solid.gloss
                if lobe:
                    axis = mirrored(ray, normal)
                    ray = around(axis, solid.shininess, wp.randf(random), wp.randf(random))
                    # 0: into the surface, where the path ends
                    straight = wp.max(wp.dot(ray, normal), 0.0)
                    weight = weight * (solid.shininess + 2.0) / (solid.shininess + 1.0) * straight
                else:
                    ray = wp.normalize(normal + wp.sample_unit_sphere_surface(random))
                hit = nearest(solids, rotation, translation, t, point, ray, FAR)
            if hit.body >= 0 and weight > 0.0:
                point = point + hit.distance * ray
                length += hit.distance
                got = received(emitter, solids, rotation, translation, t, hit, point, ray, True)
                total += weight * got[0]
                turns = emitter.cycles * (length + got[1])
                of_path += turned(float(harmonics[0]) * turns, weight * got[0])
                for h in range(1, harmonics.shape[0]):
                    light[h, y, x] += turned(float(harmonics[h]) * turns, weight * got[0])
        light[0, y, x] += of_path
        squares += wp.length_sq(of_path)
    share = 1.0 / float(paths)
    amplitude[y, x] = share * total
    for h in range(harmonics.shape[0]):
        light[h, y, x] = share * light[h, y, x]
    spread = wp.max(share * squares - wp.length_sq(light[0, y, x]), 0.0)
    error[y, x] = ONE_PATH
    if paths > 1:
        error[y, x] = wp.sqrt(spread / float(paths - 1))
