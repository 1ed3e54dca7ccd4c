"""Lens distortion, its derivative, its inverse, and covariances of splats.

The formulas, also outside the image, are those of scene/distortion.py.
"""

import warp as wp

from .geometry import CameraView, ellipse_of

STEPS_MAX = wp.constant(20)  # of Newton; a lens that the host could undo needs a handful
# [1] of image coordinates, a ten-thousandth of a pixel and float32's own rounding
CLOSE = wp.constant(1.0e-7)


@wp.func
def inside(view: CameraView, x: float, y: float) -> wp.vec2:
    """The point (x, y) [1], or, if it is outside the disc of the lens, the point on its edge."""
    square = view.radius * view.radius
    share = wp.sqrt(square / wp.max(x * x + y * y, square))
    return wp.vec2(share * x, share * y)


@wp.func
def bent(view: CameraView, x: float, y: float) -> wp.vec2:
    """Where the polynomial images what a pinhole would have at (x, y) [1]."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (view.k1 + r2 * (view.k2 + r2 * view.k3))
    return wp.vec2(
        x * radial + 2.0 * view.p1 * x * y + view.p2 * (r2 + 2.0 * x * x),
        y * radial + view.p1 * (r2 + 2.0 * y * y) + 2.0 * view.p2 * x * y,
    )


@wp.func
def derivative(view: CameraView, x: float, y: float) -> wp.vec3:
    """Of the polynomial [1]: d x'/dx, d x'/dy = d y'/dx, d y'/dy."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (view.k1 + r2 * (view.k2 + r2 * view.k3))
    bend = 2.0 * (view.k1 + r2 * (2.0 * view.k2 + 3.0 * view.k3 * r2))
    return wp.vec3(
        radial + bend * x * x + 2.0 * view.p1 * y + 6.0 * view.p2 * x,
        bend * x * y + 2.0 * view.p1 * x + 2.0 * view.p2 * y,
        radial + bend * y * y + 6.0 * view.p1 * y + 2.0 * view.p2 * x,
    )


@wp.func
def distorted(view: CameraView, x: float, y: float) -> wp.vec2:
    """Image slopes of the pinhole point (x, y) [1]; linearised outside the lens' disc."""
    near = inside(view, x, y)
    image = bent(view, near[0], near[1])
    slope = derivative(view, near[0], near[1])
    dx = x - near[0]
    dy = y - near[1]
    return wp.vec2(
        image[0] + (slope[0] * dx + slope[1] * dy), image[1] + (slope[1] * dx + slope[2] * dy)
    )


@wp.func
def undistorted(view: CameraView, x: float, y: float) -> wp.vec2:
    """Pinhole slopes of the image slopes (x, y) [1] inside the image, by Newton's iteration."""
    point = wp.vec2(x, y)
    missing = float(1.0)
    step = int(0)
    while missing > CLOSE and step < STEPS_MAX:
        image = bent(view, point[0], point[1])
        slope = derivative(view, point[0], point[1])
        dx = x - image[0]
        dy = y - image[1]
        area = slope[0] * slope[2] - slope[1] * slope[1]
        point = point + wp.vec2(dx * slope[2] - dy * slope[1], dy * slope[0] - dx * slope[1]) / area
        missing = wp.max(wp.abs(dx), wp.abs(dy))
        step += 1
    return point


@wp.func
def bent_covariance(view: CameraView, local: wp.vec3, axes: wp.mat33, scale: wp.vec3) -> wp.vec4:
    """As ``screen_covariance``, with the derivative of the lens times that of the pinhole."""
    inverse_z = 1.0 / local[2]
    slope_x = wp.clamp(local[0] * inverse_z, -view.guard_x, view.guard_x)
    slope_y = wp.clamp(local[1] * inverse_z, -view.guard_y, view.guard_y)
    near = inside(view, slope_x, slope_y)
    slope = derivative(view, near[0], near[1])
    along_x = wp.cw_mul(scale, axes * wp.vec3(inverse_z, 0.0, -inverse_z * slope_x))
    along_y = wp.cw_mul(scale, axes * wp.vec3(0.0, inverse_z, -inverse_z * slope_y))
    return ellipse_of(
        view.fx * (slope[0] * along_x + slope[1] * along_y),
        view.fy * (slope[1] * along_x + slope[2] * along_y),
        view.low_pass,
    )
