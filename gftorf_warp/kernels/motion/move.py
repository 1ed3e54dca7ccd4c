"""Gaussians of a finished run at one time, widened for cameras that resolve more than that of the optimisation."""

import functools

import warp as wp

from ...constants import LOW_PASS
from .displace import OPTIONS, make_interpolation, product

LOW_PASS_PX2 = wp.constant(float(LOW_PASS))  # [px^2]


@wp.func
def footprint(row: wp.vec4, point: wp.vec3) -> float:
    """Width of a pixel at a point [m]: its z-depth over the focal length, both from one row."""
    return row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]


@functools.cache
def make_move(K: int) -> wp.Kernel:
    """The kernel ``move_gaussians`` for times that depend on K keys; unused keys have weight zero."""
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
        optimised: wp.vec4,  # row of the camera of the optimisation that gives a footprint [m]
        index: Indices,  # [K] keys of the time [index]
        weight: Weights,  # [K] interpolation weights of the time [1]
        here: wp.vec4,  # row of this camera that gives a footprint [m]
        # Out:
        mean: wp.array[wp.vec3],  # [N] [m]
        log_scale: wp.array[wp.vec3],  # [N] [log m]
        quaternion: wp.array[wp.vec4],  # [N] orientations wxyz; empty: no rotation
    ):
        """One thread per Gaussian."""
        i = wp.tid()
        point = initial_mean[i] + interpolated(offset, index, weight, i)
        scale = initial_log_scale[i]
        wide = footprint(optimised, point)
        narrow = footprint(here, point)
        missing = LOW_PASS_PX2 * (wide * wide - narrow * narrow)
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
    largest: wp.array[int],  # [1] of all so far [1]
    latest: wp.array[int],  # [1] the same, beside the images that it belongs to [1]
):
    """One thread."""
    largest[0] = wp.max(largest[0], total[0])
    latest[0] = total[0]
