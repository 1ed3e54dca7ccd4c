"""Gaussians of a finished run at one time, widened for cameras of higher resolution.

The low-pass filter of the renderer widens every Gaussian by ``low_pass`` pixels^2. With z the
z-depth and f the focal length of the camera of the optimisation, and z', f' those of this camera,

    exp(2 log_scale') = exp(2 log_scale) + low_pass max(0, (z / f)^2 - (z' / f')^2)
"""

import warp as wp

from .. import making
from ..geometry import CameraView
from .displace import OPTIONS, make_interpolation, product


@wp.func
def squared_footprint(camera: CameraView, point: wp.vec3) -> float:
    """Area that a pixel covers at a point [m^2]: (z-depth / focal length)^2."""
    z = wp.dot(camera.rotation[2], point) + camera.translation[2]
    return z * z / (camera.fx * camera.fy)


@making.once
def make_move(K: int) -> wp.Kernel:
    """The kernel ``move_gaussians`` for times with K keys; unused keys have weight zero."""
    sums = make_interpolation(K)
    Indices, Weights, interpolated = sums.Indices, sums.Weights, sums.interpolated

    @wp.kernel(**OPTIONS)
    def move_gaussians(
        # In:
        initial_mean: wp.array[wp.vec3],  # [N] undisplaced centres [m]
        initial_log_scale: wp.array[wp.vec3],  # [N] [log m]
        initial_quaternion: wp.array[wp.vec4],  # [N] orientations wxyz; empty: no rotation
        offset: wp.array2d[wp.vec3],  # [T, N] displacements at all keys [m]
        rotation: wp.array2d[wp.vec4],  # [T, N] rotations wxyz at all keys; empty: no rotation
        optimised: CameraView,  # camera of the optimisation [struct]
        camera: CameraView,  # camera of the image [struct]
        index: Indices,  # [K] keys of the time [index]
        weight: Weights,  # [K] interpolation weights of the time [1]
        # Out:
        mean: wp.array[wp.vec3],  # [N] [m]
        log_scale: wp.array[wp.vec3],  # [N] [log m]
        quaternion: wp.array[wp.vec4],  # [N] orientations wxyz; empty: no rotation
        view: wp.array[CameraView],  # [1] ``camera``, for the kernels of the rendering
    ):
        """One thread per Gaussian, at least one."""
        i = wp.tid()
        if i == 0:
            view[0] = camera
        if i >= initial_mean.shape[0]:
            return
        point = initial_mean[i] + interpolated(offset, index, weight, i)
        scale = initial_log_scale[i]
        finer = squared_footprint(optimised, point) - squared_footprint(camera, point)
        missing = optimised.low_pass * finer
        if missing > 0.0:
            for axis in range(3):
                scale[axis] = 0.5 * wp.log(wp.exp(2.0 * scale[axis]) + missing)
        mean[i] = point
        log_scale[i] = scale
        if quaternion.shape[0] > 0:
            turn = wp.normalize(interpolated(rotation, index, weight, i))
            quaternion[i] = product(turn, initial_quaternion[i])

    return move_gaussians


@wp.kernel(enable_backward=False)
def note_largest(
    # In:
    total: wp.array[int],  # [1] pairs of this rendering [1]
    # Out:
    largest: wp.array[int],  # [1] of all renderings so far [1]
    latest: wp.array[int],  # [1] the same as ``total``, in the memory of the images [1]
):
    """One thread."""
    largest[0] = wp.max(largest[0], total[0])
    latest[0] = total[0]
