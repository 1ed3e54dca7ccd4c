"""Gaussians of a finished run at a time: between two keys, and as wide as they looked while they were optimised."""

import warp as wp

from ...constants import LOW_PASS

LOW_PASS_PX2 = wp.constant(float(LOW_PASS))  # [px^2]


@wp.func
def footprint(row: wp.vec4, point: wp.vec3) -> float:
    """Width of a pixel at a point [m]: its z-depth over the focal length, both from one row."""
    return row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]


@wp.kernel(enable_backward=False)
def move_gaussians(
    # In:
    rest_mean: wp.array[wp.vec3],  # [N] where nothing has moved [m]
    rest_log_scale: wp.array[wp.vec3],  # [N] [log m]
    offset: wp.array2d[wp.vec3],  # [T, N] displacement at every key [m]
    key: int,  # at or before the time [index]
    share: float,  # of the way to the next key, 0 at the last one [1]
    optimised: wp.vec4,  # row of the camera of the optimisation that gives a footprint [m]
    here: wp.vec4,  # row of this camera [m]
    # Out:
    mean: wp.array[wp.vec3],  # [N] [m]
    log_scale: wp.array[wp.vec3],  # [N] [log m]
):
    """One thread per Gaussian."""
    i = wp.tid()
    displacement = offset[key, i]
    if share > 0.0:
        displacement = (1.0 - share) * displacement + share * offset[key + 1, i]
    point = rest_mean[i] + displacement
    scale = rest_log_scale[i]
    wide = footprint(optimised, point)
    narrow = footprint(here, point)
    missing = LOW_PASS_PX2 * (wide * wide - narrow * narrow)
    if missing > 0.0:
        for axis in range(3):
            scale[axis] = 0.5 * wp.log(wp.exp(2.0 * scale[axis]) + missing)
    mean[i] = point
    log_scale[i] = scale


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
