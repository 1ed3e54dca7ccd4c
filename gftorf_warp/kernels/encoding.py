"""Positions as a network in half precision reads them: gamma(x) = [x, sin 2^0 x, cos 2^0 x, .., sin 2^9 x, cos 2^9 x].

Sine and cosine are those of float32, good to two units in the last place for any argument: 2^9 x is hundreds of
radians, where the fast ones of a GPU are wrong by more than a half can show.
"""

import warp as wp


@wp.kernel(enable_backward=False, grid_stride=False)
def encode(
    # In:
    mean: wp.array2d[float],  # [N, 3] positions [m]
    length: float,  # what they are divided by [m]
    powers: wp.array[float],  # [F] 2^0, 2^1, .. [1]
    # Out:
    place: wp.array2d[wp.float16],  # [N, columns] gamma(x) / [m / length], zeros behind it
):
    """One thread per value, so that neighbours write side by side."""
    n, column = wp.tid()
    value = float(0.0)
    if column < 3:
        value = mean[n, column] / length
    elif column < 3 + 6 * powers.shape[0]:
        wave = column // 3 - 1  # of three values, sine and cosine in turn
        angle = mean[n, column % 3] / length * powers[wave // 2]
        if wave % 2 == 0:
            value = wp.sin(angle)
        else:
            value = wp.cos(angle)
    place[n, column] = wp.float16(value)
