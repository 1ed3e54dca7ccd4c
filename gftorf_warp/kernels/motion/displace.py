"""Displaced Gaussians: sums over K keys with interpolation weights w, and their adjoint.

    moved     = mean + sum_k w_0k o_k
    turned    = n q,   n = s / |s|,   s = sum_k w_0k r_k
    channel_j = sum_k w_jk o_k,   j = 1 .. D

o are displacements and r rotations (quaternions wxyz) of a Gaussian at the keys, q is its
quaternion. Row 0 of the weights is of the time of an image, each further row the weights of the end
of a flow minus those of its start. K is a constant: loops are unrolled.

    dL/do_k = w_0k dL/dmoved + sum_j w_jk dL/dchannel_j
    dL/dq   = n* dL/dturned,   dL/dr_k = w_0k dL/ds
    dL/ds   = (g - n (n . g)) / |s|,   g = dL/dturned q*
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from .. import making

OPTIONS = {"enable_backward": False, "module": "unique", "grid_stride": False}


@making.once
def make_interpolation(K: int) -> SimpleNamespace:
    """Vectors of K indices and of K weights, and the weighted sum of K rows of an array."""
    Indices, Weights = wp.types.vector(length=K, dtype=int), wp.types.vector(length=K, dtype=float)

    @wp.func
    def interpolated(values: wp.array2d[Any], index: Indices, weight: Weights, i: int):
        total = weight[0] * values[index[0], i]
        for k in range(1, wp.static(K)):
            total = total + weight[k] * values[index[k], i]
        return total

    return SimpleNamespace(Indices=Indices, Weights=Weights, interpolated=interpolated)


@wp.func
def product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Product of two quaternions wxyz."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def conjugate(a: wp.vec4) -> wp.vec4:
    """Conjugate of a quaternion wxyz."""
    return wp.vec4(a[0], -a[1], -a[2], -a[3])


@making.once
def make_displace(K: int) -> SimpleNamespace:
    """The kernels ``displace`` and ``displace_backward`` for K keys."""
    sums = make_interpolation(K)
    Indices, Weights, interpolated = sums.Indices, sums.Weights, sums.interpolated

    @wp.func
    def all_keys() -> Indices:
        """0 .. K - 1."""
        index = Indices()
        for k in range(wp.static(K)):
            index[k] = k
        return index

    @wp.func
    def row_of(weights: wp.array2d[float], row: int) -> Weights:
        """One row of a table of weights."""
        weight = Weights()
        for k in range(wp.static(K)):
            weight[k] = weights[row, k]
        return weight

    @wp.kernel(**OPTIONS)
    def displace(
        # In:
        mean: wp.array[wp.vec3],  # [N] undisplaced centres [m]
        quaternion: wp.array[wp.vec4],  # [N] orientations wxyz; empty: no rotation
        offset: wp.array2d[wp.vec3],  # [K, N] displacements at the keys [m]
        rotation: wp.array2d[wp.vec4],  # [K, N] rotations wxyz at the keys; empty: no rotation
        weights: wp.array2d[float],  # [1 + D, K] or more rows [1]
        # Out:
        moved: wp.array[wp.vec3],  # [N] centres [m]
        turned: wp.array[wp.vec4],  # [N] orientations wxyz; empty: no rotation
        channels: wp.array2d[wp.vec3],  # [N, D] displacements between times [m], or empty
    ):
        """One thread per Gaussian."""
        i = wp.tid()
        index = all_keys()
        weight = row_of(weights, 0)
        moved[i] = mean[i] + interpolated(offset, index, weight, i)
        if turned.shape[0] > 0:
            turn = wp.normalize(interpolated(rotation, index, weight, i))
            turned[i] = product(turn, quaternion[i])
        for j in range(channels.shape[1]):
            channels[i, j] = interpolated(offset, index, row_of(weights, j + 1), i)

    @wp.kernel(**OPTIONS)
    def displace_backward(
        # In:
        quaternion: wp.array[wp.vec4],  # [N] as above; empty: no rotation
        rotation: wp.array2d[wp.vec4],  # [K, N] as above; empty: no rotation
        weights: wp.array2d[float],  # [1 + D, K] or more rows [1]
        by_moved: wp.array[wp.vec3],  # [N] cotangent of ``moved``; empty: zero
        by_turned: wp.array[wp.vec4],  # [N] cotangent of ``turned``; empty: zero
        by_channels: wp.array2d[wp.vec3],  # [N, D] cotangent of ``channels``; empty: zero
        # Out:
        grad_offset: wp.array2d[wp.vec3],  # [K, N] gradient w.r.t. ``offset``; empty: not computed
        grad_rotation: wp.array2d[wp.vec4],  # [K, N] gradient w.r.t. ``rotation``, or empty
        grad_quaternion: wp.array[wp.vec4],  # [N] gradient w.r.t. ``quaternion``, or empty
    ):
        """One thread per Gaussian."""
        i = wp.tid()
        weight = row_of(weights, 0)
        if grad_offset.shape[0] > 0:
            cotangent = wp.vec3(0.0)
            if by_moved.shape[0] > 0:
                cotangent = by_moved[i]
            gradient = wp.outer(weight, cotangent)
            for j in range(by_channels.shape[1]):
                gradient = gradient + wp.outer(row_of(weights, j + 1), by_channels[i, j])
            for k in range(wp.static(K)):
                grad_offset[k, i] = gradient[k]
        if by_turned.shape[0] > 0:
            total = interpolated(rotation, all_keys(), weight, i)
            length = wp.length(total)
            unit = total / length
            if grad_quaternion.shape[0] > 0:
                grad_quaternion[i] = product(conjugate(unit), by_turned[i])
            if grad_rotation.shape[0] > 0:
                by_unit = product(by_turned[i], conjugate(quaternion[i]))
                by_total = (by_unit - unit * wp.dot(unit, by_unit)) / length
                for k in range(wp.static(K)):
                    grad_rotation[k, i] = weight[k] * by_total

    return SimpleNamespace(displace=displace, displace_backward=displace_backward)
