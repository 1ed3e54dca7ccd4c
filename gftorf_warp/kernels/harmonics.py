"""Real spherical harmonics to degree 3, in the order by degree and the signs that published
Gaussian splats use.
"""

import warp as wp

Harmonics = wp.types.vector(length=16, dtype=wp.float32)


@wp.func
def harmonics(n: wp.vec3) -> Harmonics:
    """Y_0 .. Y_15 for the unit direction ``n`` (method, section 2.3)."""
    x = n[0]
    y = n[1]
    z = n[2]
    xx = x * x
    yy = y * y
    zz = z * z
    return Harmonics(
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    )
