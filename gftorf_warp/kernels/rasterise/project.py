"""Gaussians to splats: activation, projection, reflectivity and light of each, and its place in the
depth order.

There is no loop that carries a value, so Warp's own adjoint of this kernel is exact (method,
sections 3.3-3.5).
"""

import warp as wp

from ...constants import ALPHA_MIN, SH_BIAS
from .. import making
from ..correlation import PHASE_OFFSET, PHASE_SLOPE, SOURCE_INTENSITY, light_of
from ..geometry import CameraView, axes_of, camera_of, screen_covariance, sigmoid
from ..harmonics import harmonics
from ..lens import bent_covariance, distorted
from .splat import Splat
from .splat_distance import bent_slope_of, bound_of, slope_of

# [px] from the middle of a block of 4 x 4 pixels to its farthest centre, 1.5 sqrt(2)
BLOCK_RADIUS = wp.constant(2.1214)


@wp.func
def visit_of(opacity: float, cov: wp.vec4) -> wp.vec2:
    """(low, limit) of a record: power at alpha 1/255, and bound for visiting a block.

    With K the conic, sqrt(v K v) is a norm, which changes by at most sqrt(largest eigenvalue) times
    the distance; so does the bound between the middle of a block and its pixel centres.
    """
    cutoff = 2.0 * wp.log(opacity / ALPHA_MIN)
    middle = 0.5 * (cov[0] + cov[2])
    # variance of the narrow axis
    smallest = cov[3] / (middle + wp.sqrt(wp.max(middle * middle - cov[3], 0.0)))
    reach = wp.sqrt(wp.max(cutoff, 0.0) + 1.0e-5) + BLOCK_RADIUS / wp.sqrt(smallest)
    return wp.vec2(-0.5 * cutoff, -0.50005 * reach * reach - 1.0e-3)


@wp.func
def box_of(view: CameraView, x: float, y: float, cov: wp.vec4, cutoff: float) -> wp.vec4i:
    """Pixels [x0, y0, x1, y1) with centres in the bounding box of the ellipse alpha >= 1/255."""
    reach_x = wp.sqrt(wp.max(cutoff, 0.0) * cov[0]) * 1.0001 + 1.0e-3
    reach_y = wp.sqrt(wp.max(cutoff, 0.0) * cov[2]) * 1.0001 + 1.0e-3
    w = float(view.width)
    h = float(view.height)
    # clamped as floats: an integer from a float that does not fit is undefined
    x0 = int(wp.clamp(wp.ceil(x - reach_x - 0.5), 0.0, w))
    y0 = int(wp.clamp(wp.ceil(y - reach_y - 0.5), 0.0, h))
    x1 = int(wp.clamp(wp.floor(x + reach_x - 0.5) + 1.0, 0.0, w))
    y1 = int(wp.clamp(wp.floor(y + reach_y - 0.5) + 1.0, 0.0, h))
    return wp.vec4i(x0, y0, x1, y1)


@wp.func
def square_of(view: CameraView, x: float, y: float, cov: wp.vec4) -> wp.vec4i:
    """Pixels [x0, y0, x1, y1) of the 3-sigma square rounded out to 16-pixel tiles, as the released
    code has it.

    Its pixel centres are integers: ``x`` and ``y`` are image positions less half a pixel.
    """
    middle = 0.5 * (cov[0] + cov[2])
    determinant = cov[3]
    radius = wp.ceil(3.0 * wp.sqrt(middle + wp.sqrt(wp.max(0.1, middle * middle - determinant))))
    tiles_x = (view.width + 15) // 16
    tiles_y = (view.height + 15) // 16
    x0 = wp.clamp(int(wp.floor((x - radius) / 16.0)), 0, tiles_x)
    y0 = wp.clamp(int(wp.floor((y - radius) / 16.0)), 0, tiles_y)
    x1 = wp.clamp(int(wp.floor((x + radius + 15.0) / 16.0)), 0, tiles_x)
    y1 = wp.clamp(int(wp.floor((y + radius + 15.0) / 16.0)), 0, tiles_y)
    return wp.vec4i(16 * x0, 16 * y0, 16 * x1, 16 * y1)


@wp.func
def common(a: wp.vec4i, b: wp.vec4i) -> wp.vec4i:
    """Pixels that are in both of two boxes."""
    return wp.vec4i(wp.max(a[0], b[0]), wp.max(a[1], b[1]), wp.min(a[2], b[2]), wp.min(a[3], b[3]))


@wp.func
def veil_of(view: CameraView) -> Splat:
    """What a Gaussian without a finite position, size or opacity becomes: NaN in every pixel.

    Drawn as it is, it would be hidden: comparisons with NaN are false, and its box is empty.
    """
    w = float(view.width)
    h = float(view.height)
    flat = -0.5 / ((w + h) * (w + h))  # opaque to the corners
    visit = visit_of(1.0, wp.vec4(-0.5 / flat, 0.0, -0.5 / flat, 0.25 / (flat * flat)))
    return Splat(
        0.5 * w, 0.5 * h, flat, 0.0, flat,
        1.0, visit[0], visit[1],
        wp.nan, wp.nan, wp.nan, wp.nan, wp.nan, wp.nan, wp.nan, wp.nan,
    )  # fmt: skip


@making.once
def make_project(
    colour: bool, square: bool, lens: bool = False, sloped: bool = False, adjoint: bool = False
):
    """The kernel for a field with or without colour.

    Args:
        colour: Whether slots 8-10 hold colour, from its own harmonics.
        square: Whether splats are cut by the 3-sigma square (parity with the released code).
        lens: Whether the camera is no pinhole.
        sloped: Whether the distance varies inside a splat: other slots 11-15, see splat.py.
        adjoint: Whether its adjoint is launched, which reads in ``box_px`` what the forward pass
            culled. A Gaussian that is not finite is no case of its own: the image is NaN already.
    """

    # __sinf would lose the phase beyond +-pi
    @wp.kernel(module="unique", enable_backward=adjoint, module_options={"fast_math": False})
    def project(
        # In:
        view: wp.array[CameraView],  # [1] the camera [m, px]
        calibration: wp.array[float],  # [4] phase slope [rad/m], offset [rad], source, DC offset
        degree: int,  # harmonics above it are ignored [0..3]
        depth_shift: int,  # lowest bits of a z-depth that its key leaves out [1]
        depth_culled: int,  # depth key of what is culled, behind all others [1]
        mean: wp.array[wp.vec3],  # [N] centre in the world [m]
        log_scale: wp.array[wp.vec3],  # [N] log of the standard deviations [log m]
        quaternion: wp.array[wp.vec4],  # [N] orientation, wxyz
        opacity_logit: wp.array[float],  # [N] opacity before the sigmoid
        reflectivity_sh: wp.array2d[float],  # [N, 16] harmonics of the reflectivity
        colour_sh: wp.array2d[wp.vec3],  # [N, 16] harmonics of RGB; [0, 0] without colour
        # Out:
        splats: wp.array[Splat],  # [N] records, see splat.py; undefined where culled
        box_px: wp.array[wp.vec4i],  # [N] x0, y0, x1, y1 of touched pixels [px]; x1 = 0: culled
        depth_key: wp.array[wp.int32],  # [>= N] floats from ``near`` to the z-depth, high bits
        order: wp.array[wp.int32],  # [>= N] 0, 1, 2, ...
    ):
        """One thread per Gaussian."""
        n = wp.tid()
        camera = camera_of(view)
        if wp.static(adjoint):
            if box_px[n][2] == 0:  # culled
                return
        else:
            order[n] = n
            depth_key[n] = depth_culled
            box_px[n] = wp.vec4i(0, 0, 0, 0)
            placed = wp.isfinite(mean[n]) and wp.isfinite(quaternion[n])
            if not (placed and wp.isfinite(log_scale[n]) and wp.isfinite(opacity_logit[n])):
                depth_key[n] = 0
                box_px[n] = wp.vec4i(0, 0, camera.width, camera.height)
                splats[n] = veil_of(camera)
                return
        opacity = sigmoid(opacity_logit[n])
        local = camera.rotation * mean[n] + camera.translation
        if wp.static(not adjoint):
            if local[2] < camera.near or local[2] > camera.far or opacity < ALPHA_MIN:
                return
        log_sizes = log_scale[n]
        scale = wp.vec3(wp.exp(log_sizes[0]), wp.exp(log_sizes[1]), wp.exp(log_sizes[2]))
        axes = axes_of(camera, quaternion[n])
        if wp.static(lens):
            cov = bent_covariance(camera, local, axes, scale)
            image = distorted(camera, local[0] / local[2], local[1] / local[2])
            x = camera.fx * image[0] + camera.cx
            y = camera.fy * image[1] + camera.cy
        else:
            cov = screen_covariance(camera, local, axes, scale)
            x = camera.fx * local[0] / local[2] + camera.cx
            y = camera.fy * local[1] / local[2] + camera.cy
        determinant = cov[3]
        visit = wp.vec2(0.0, 0.0)
        if wp.static(not adjoint):
            visit = visit_of(opacity, cov)
            box = box_of(camera, x, y, cov, -2.0 * visit[0])
            if wp.static(square):
                box = common(box, square_of(camera, x - 0.5, y - 0.5, cov))
            if box[2] <= box[0] or box[3] <= box[1]:
                return
            box_px[n] = box
            # bits of positive floats order like the floats
            behind_near = wp.cast(local[2], wp.int32) - wp.cast(camera.near, wp.int32)
            depth_key[n] = behind_near >> depth_shift

        distance = wp.length(local)
        direction = (mean[n] - camera.centre) / distance
        basis = harmonics(direction)
        active = (degree + 1) * (degree + 1)
        reflectivity = float(SH_BIAS)
        for h in range(16):
            reflectivity += wp.where(h < active, basis[h] * reflectivity_sh[n, h], 0.0)
        reflectivity = wp.where(reflectivity <= 0.0, 0.0, reflectivity)  # a maximum hides NaN
        bound = float(0.0)
        along_ray = distance  # or its inverse
        if wp.static(sloped):
            if wp.static(lens):
                slope = bent_slope_of(camera, local, axes, scale)
            else:
                slope = slope_of(camera, local, axes, scale)
            strength = calibration[wp.static(SOURCE_INTENSITY)] * reflectivity
            light = wp.vec3(strength, slope[0], slope[1])
            bound = bound_of(distance, scale)
            along_ray = 1.0 / distance
        else:
            light = light_of(
                distance,
                reflectivity,
                calibration[wp.static(PHASE_SLOPE)],
                calibration[wp.static(PHASE_OFFSET)],
                calibration[wp.static(SOURCE_INTENSITY)],
            )
        red = float(0.0)
        green = float(0.0)
        blue = float(0.0)
        if wp.static(colour):
            rgb = wp.vec3(SH_BIAS, SH_BIAS, SH_BIAS)
            for h in range(16):
                rgb += wp.where(h < active, basis[h], 0.0) * colour_sh[n, h]
            red = wp.where(rgb[0] <= 0.0, 0.0, rgb[0])
            green = wp.where(rgb[1] <= 0.0, 0.0, rgb[1])
            blue = wp.where(rgb[2] <= 0.0, 0.0, rgb[2])
        splats[n] = Splat(
            x, y, -0.5 * cov[2] / determinant, cov[1] / determinant, -0.5 * cov[0] / determinant,
            opacity, visit[0], visit[1],
            red, green, blue, light[0], light[1], light[2], along_ray, bound,
        )  # fmt: skip

    return project
