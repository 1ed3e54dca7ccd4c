"""Positions as a network in half precision reads them: gamma(x) = [x, sin 2^0 x, cos 2^0 x, .., sin
2^9 x, cos 2^9 x].

Sine and cosine are those of float32 for any argument, none of the fast ones of a GPU: 2^9 x is
hundreds of radians.
"""

import warp as wp


def threads(count: int, frequencies: int) -> int:
    """How many encode so many positions."""
    return count * (3 * frequencies + 1)


@wp.kernel(enable_backward=False, grid_stride=False)
def encode(
    # In:
    mean: wp.array2d[float],  # [N, 3] positions [m]
    length: float,  # what they are divided by [m]
    powers: wp.array[float],  # [F] 2^0, 2^1, .. [1]
    # Out:
    position: wp.array2d[wp.float16],  # [N, columns] gamma(x) [1], zeros behind it
):
    """One thread per sine and cosine of an argument; the last of a row also writes the padding."""
    lanes = 3 * powers.shape[0] + 1
    n = wp.tid() // lanes
    wave = wp.tid() % lanes
    if wave == lanes - 1:
        for i in range(3):
            position[n, i] = wp.float16(mean[n, i] / length)
        for i in range(3 + 6 * powers.shape[0], position.shape[1]):
            position[n, i] = wp.float16(0.0)
        return
    column = 3 + wave // 3 * 6 + wave % 3
    angle = mean[n, wave % 3] / length * powers[wave // 3]
    position[n, column] = wp.float16(wp.sin(angle))
    position[n, column + 3] = wp.float16(wp.cos(angle))
