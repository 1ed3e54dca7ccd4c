"""Where Gaussians are between two keys, and how far they go to the next key and come from the one before.

    moved = mean + (1 - s) o_0 + s o_1,   channels = (o_1 - o_0, o_2 - o_0)

with offsets o at this key, the next, and, where channels are wanted, the one before (method, section 4).
"""

import warp as wp


@wp.kernel(enable_backward=False)
def displace(
    # In:
    mean: wp.array[wp.vec3],  # [N] centres where nothing has moved [m]
    offsets: wp.array2d[wp.vec3],  # [K, N] displacements at two keys, or three [m]
    share: wp.array[float],  # [1] of the way from the first key to the second [1]
    # Out:
    moved: wp.array[wp.vec3],  # [N] centres [m]
    channels: wp.array2d[wp.vec3],  # [N, K - 1] from the first key to each other one [m]; empty: not wanted
):
    """One thread per Gaussian."""
    i = wp.tid()
    start = offsets[0, i]
    moved[i] = mean[i] + (start + share[0] * (offsets[1, i] - start))
    if channels.shape[0] > 0:
        for k in range(channels.shape[1]):
            channels[i, k] = offsets[k + 1, i] - start


@wp.kernel(enable_backward=False)
def displace_backward(
    # In:
    share: wp.array[float],  # [1] as above [1]
    by_moved: wp.array[wp.vec3],  # [N] cotangent of ``moved``; empty: zero
    by_channels: wp.array2d[wp.vec3],  # [N, K - 1] cotangent of ``channels``; empty: zero
    # Out:
    grad: wp.array2d[wp.vec3],  # [K, N] by the offsets
):
    """One thread per Gaussian."""
    i = wp.tid()
    moved = wp.vec3(0.0)
    if by_moved.shape[0] > 0:
        moved = by_moved[i]
    start = (1.0 - share[0]) * moved
    for k in range(1, grad.shape[0]):
        value = wp.vec3(0.0)
        if k == 1:
            value = share[0] * moved
        if by_channels.shape[0] > 0:
            value = value + by_channels[i, k - 1]
            start = start - by_channels[i, k - 1]
        grad[k, i] = value
    grad[0, i] = start
