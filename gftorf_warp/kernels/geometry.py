"""Rotations, the camera as kernels see it, and the linearised projection of a covariance."""

import warp as wp

from ..constants import GUARD


@wp.struct
class CameraView:
    """A camera; the centre of pixel [0, 0] is at (0.5, 0.5)."""

    rotation: wp.mat33  # camera_from_world, upper left
    translation: wp.vec3  # camera_from_world, last column [m]
    centre: wp.vec3  # position in the world [m]
    fx: float  # focal length [px]
    fy: float  # focal length [px]
    cx: float  # principal point [px]
    cy: float  # principal point [px]
    width: int  # columns [px]
    height: int  # rows [px]
    near: float  # smallest z-depth [m]
    far: float  # largest z-depth [m]
    low_pass: float  # variance added to every splat [px^2]
    radius: float  # of the disc in which a lens follows its polynomial [1]; unused by a pinhole
    guard_x: float  # largest slope x/z at which such a lens has its derivative taken [1]
    guard_y: float  # largest slope y/z likewise [1]
    k1: float  # of the lens, as OpenCV names them [1]
    k2: float  # likewise
    p1: float  # likewise
    p2: float  # likewise
    k3: float  # likewise


@wp.func
def camera_of(view: wp.array[CameraView]) -> CameraView:
    """The one camera of an array."""
    return view[0]


@wp.func_grad(camera_of)
def adj_camera_of(view: wp.array[CameraView], adj_ret: CameraView):
    """No derivative: what the generated adjoint computes for the camera is dead code."""


@wp.func
def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x)) [1], zero where the exponential overflows."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func_grad(sigmoid)
def adj_sigmoid(x: float, adj_ret: float):
    """Derivative y (1 - y); that of the formula is zero times infinity below -88.7."""
    y = sigmoid(x)
    wp.adjoint[x] += adj_ret * y * (1.0 - y)


@wp.func
def rotation_of(wxyz: wp.vec4) -> wp.mat33:
    """Rotation matrix of a quaternion in the order of the program; it need not have unit length."""
    q = wp.normalize(wxyz)
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def axes_of(view: CameraView, wxyz: wp.vec4) -> wp.mat33:
    """Own axes of a Gaussian in camera axes, as rows."""
    return wp.transpose(view.rotation * rotation_of(wxyz))


@wp.func
def screen_covariance(view: CameraView, local: wp.vec3, axes: wp.mat33, scale: wp.vec3) -> wp.vec4:
    """Covariance (xx, xy, yy) [px^2] of a Gaussian on the image, and its determinant.

    It is J R Sigma R^T J^T plus low-pass. The Jacobian J is taken at ``local`` [m, camera axes],
    clamped to 1.3 half fields of view (method, section 2.2). The determinant is a sum of
    squares: xx yy - xy^2 would cancel for long ellipses.
    """
    inverse_z = 1.0 / local[2]
    limit_x = 0.5 * GUARD * float(view.width) / view.fx
    limit_y = 0.5 * GUARD * float(view.height) / view.fy
    slope_x = wp.clamp(local[0] * inverse_z, -limit_x, limit_x)
    slope_y = wp.clamp(local[1] * inverse_z, -limit_y, limit_y)
    ray_x = wp.vec3(view.fx * inverse_z, 0.0, -view.fx * inverse_z * slope_x)
    ray_y = wp.vec3(0.0, view.fy * inverse_z, -view.fy * inverse_z * slope_y)
    along_x = wp.cw_mul(scale, axes * ray_x)
    along_y = wp.cw_mul(scale, axes * ray_y)
    return ellipse_of(along_x, along_y, view.low_pass)


@wp.func
def ellipse_of(along_x: wp.vec3, along_y: wp.vec3, low_pass: float) -> wp.vec4:
    """Covariance (xx, xy, yy) [px^2] and determinant from each axis' extent along x and y [px]."""
    xx = wp.dot(along_x, along_x) + low_pass
    xy = wp.dot(along_x, along_y)
    yy = wp.dot(along_y, along_y) + low_pass
    area = wp.length_sq(wp.cross(along_x, along_y))
    widths = low_pass * (wp.dot(along_x, along_x) + wp.dot(along_y, along_y))
    determinant = area + widths + low_pass * low_pass
    return wp.vec4(xx, xy, yy, determinant)
