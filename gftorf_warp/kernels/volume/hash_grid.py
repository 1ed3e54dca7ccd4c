"""Features of points, interpolated trilinearly in the levels of a hash grid (Mueller et al. 2022),
and their adjoint.

    p = R x,   c = min(floor p, R - 1),   f = p - c,   x clamped to the unit cube
    feature = sum_v w_v e_v,   w_v = prod_i (f_i if v_i = 1 else 1 - f_i),   v in {0, 1}^3

A level of R cells along every axis has (R + 1)^3 vertices at each of M times. If its rows suffice
they are numbered in order of x, y, z, time; else a vertex has the row

    (x xor 2654435761 y xor 805459861 z xor 3674653429 time) mod the rows of the level,

a power of two, and vertices share rows. There is no interpolation over time.

    dL/de_v += w_v dL/dfeature,   dL/dx_i += R sum_v (dw_v / df_i) (e_v . dL/dfeature)
"""

import warp as wp

OPTIONS = {"enable_backward": False}
PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))
PRIME_TIME = wp.constant(wp.uint32(3674653429))


@wp.struct
class Cell:
    """The cell of a level in which a point is."""

    first: wp.vec3i  # its vertex with the smallest numbers [index]
    share: wp.vec3  # how far the point is towards the opposite vertex [1]


@wp.func
def cell_of(point: wp.vec3, cells: int) -> Cell:
    """The cell of a point, which is clamped to the unit cube."""
    along = wp.max(wp.min(point, wp.vec3(1.0)), wp.vec3(0.0)) * float(cells)
    cell = Cell()
    cell.first = wp.vec3i(
        wp.min(int(along[0]), cells - 1),
        wp.min(int(along[1]), cells - 1),
        wp.min(int(along[2]), cells - 1),
    )
    cell.share = along - wp.vec3(float(cell.first[0]), float(cell.first[1]), float(cell.first[2]))
    return cell


@wp.func
def row_of(vertex: wp.vec3i, time: int, cells: int, times: int, rows: int) -> int:
    """Row of a vertex in its level."""
    x, y, z = vertex[0], vertex[1], vertex[2]
    side = wp.int64(cells + 1)
    if side * side * side * wp.int64(times) <= wp.int64(rows):
        return ((time * (cells + 1) + z) * (cells + 1) + y) * (cells + 1) + x
    mixed = wp.uint32(x) ^ (wp.uint32(y) * PRIME_Y) ^ (wp.uint32(z) * PRIME_Z)
    mixed = mixed ^ (wp.uint32(time) * PRIME_TIME)
    return int(mixed & wp.uint32(rows - 1))


@wp.func
def towards(share: float, far: int) -> float:
    """Weight of the near or the far vertex along one axis."""
    return wp.where(far == 1, share, 1.0 - share)


@wp.kernel(**OPTIONS)
def interpolate(
    # In:
    points: wp.array2d[wp.vec3],  # [T, P] positions in the unit cube [1]
    times: wp.array[int],  # [T] time of each row of points [index]
    table: wp.array[wp.vec2],  # [E] features of all levels [1]
    cells: wp.array[int],  # [L] cells along an axis of each level [1]
    starts: wp.array[int],  # [L] first row of each level in the table [index]
    rows: wp.array[int],  # [L] rows of each level [1]
    M: int,  # number of times [1]
    # Out:
    features: wp.array3d[wp.vec2],  # [T, P, L] [1]
):
    """One thread per level, time and point."""
    level, t, n = wp.tid()
    R = cells[level]
    cell = cell_of(points[t, n], R)
    total = wp.vec2(0.0)
    for corner in range(8):
        dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = towards(cell.share[0], dx) * towards(cell.share[1], dy)
        weight = weight * towards(cell.share[2], dz)
        row = row_of(cell.first + wp.vec3i(dx, dy, dz), times[t], R, M, rows[level])
        total = total + weight * table[starts[level] + row]
    features[t, n, level] = total


@wp.kernel(**OPTIONS)
def interpolate_backward(
    # In:
    points: wp.array2d[wp.vec3],  # [T, P] positions in the unit cube [1]
    times: wp.array[int],  # [T] time of each row of points [index]
    table: wp.array[wp.vec2],  # [E] features of all levels [1]
    cells: wp.array[int],  # [L] cells along an axis of each level [1]
    starts: wp.array[int],  # [L] first row of each level in the table [index]
    rows: wp.array[int],  # [L] rows of each level [1]
    M: int,  # number of times [1]
    by_features: wp.array3d[wp.vec2],  # [T, P, L] cotangent of ``features``
    # Out:
    grad_table: wp.array[wp.vec2],  # [E] gradient w.r.t. ``table``, added to
    grad_points: wp.array2d[wp.vec3],  # [T, P] w.r.t. ``points``, added to; empty: not computed
):
    """One thread per level, time and point."""
    level, t, n = wp.tid()
    R = cells[level]
    cotangent = by_features[t, n, level]
    cell = cell_of(points[t, n], R)
    slope = wp.vec3(0.0)
    for corner in range(8):
        dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
        wx, wy = towards(cell.share[0], dx), towards(cell.share[1], dy)
        wz = towards(cell.share[2], dz)
        row = row_of(cell.first + wp.vec3i(dx, dy, dz), times[t], R, M, rows[level])
        wp.atomic_add(grad_table, starts[level] + row, wx * wy * wz * cotangent)
        if grad_points.shape[0] > 0:
            value = wp.dot(table[starts[level] + row], cotangent)
            slope[0] += wp.where(dx == 1, value, -value) * wy * wz
            slope[1] += wp.where(dy == 1, value, -value) * wx * wz
            slope[2] += wp.where(dz == 1, value, -value) * wx * wy
    if grad_points.shape[0] > 0:
        for axis in range(3):  # beyond the cube nothing changes
            if points[t, n][axis] < 0.0 or points[t, n][axis] > 1.0:
                slope[axis] = 0.0
        wp.atomic_add(grad_points, t, n, float(R) * slope)
