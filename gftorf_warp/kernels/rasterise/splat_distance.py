"""Distance inside a splat: the plane of a Gaussian's peaks along the rays.

Along the unit ray r, a Gaussian of mean mu and P = covariance^-1, in camera axes, is largest at the
distance t(r) = (r' P mu) / (r' P r). With n = mu / |mu| and w = P n / (n' P n), to first order
around the centre these peaks are on the plane through mu of normal w. The inverse of a plane's
distance is nearly linear in the image (its inverse z-depth is), so it is what is linearised:

    1 / d = 1 / d_k + clamp(g . (u - u_k), -bound, bound),   g = z / d_k^2 (w - n) / f  (x and y)

at pixel u, and light is that of this distance. g belongs to the covariance itself, without the
low-pass of the image. The bound keeps d within L = min(3 max sigma, d_k / 2) of d_k: it is for
needles and sheets that are seen edge-on, whose footprint is wider than they are, by the low-pass,
while g has no limit. Where a pixel is clamped it has no derivative by g; the bound never has one.
"""

from types import SimpleNamespace

import warp as wp

from .. import making
from ..geometry import CameraView
from ..lens import derivative, inside
from .simd import elementwise, make_lanes
from .splat import Splat

# slots of a record, and of its gradient
SLOPE_X, SLOPE_Y, BOUND = wp.constant(12), wp.constant(13), wp.constant(15)
SIGMAS = wp.constant(3.0)  # of a Gaussian's longest axis: the footprint ends at 3.3
SHARE_OF_DISTANCE = wp.constant(0.5)  # so that no pixel has light from the sensor itself

# cos and sin of whole turns; on a CPU polynomials of half turns, error 2e-7, whose sign is that of
# the parity of the half turns left out. Adding 1.5 * 2^23 rounds to an integer.
_OF_TURNS = """
#if defined(__CUDA_ARCH__)
    return __{name}f(6.283185307f * (turns - ((turns + 12582912.0f) - 12582912.0f)));
#else
    return {name}f(6.283185307f * turns);
#endif
"""
_OF_TURNS_WIDE = """
    const F half = turns + turns, shifted = half + 12582912.0f, f = half - (shifted - 12582912.0f);
    const F y = f * f;
    {polynomial}
    I sign, bits;
    __builtin_memcpy(&sign, &shifted, sizeof(sign));
    __builtin_memcpy(&bits, &p, sizeof(p));
    bits ^= sign << 31;
    __builtin_memcpy(&p, &bits, sizeof(p));
    return p;
"""
_POLYNOMIALS = {
    "cos": """F p = y * 2.196967986e-1f - 1.331880161f;
    p = p * y + 4.058411914f;
    p = p * y - 4.934792859f;
    p = p * y + 1.0f;""",
    "sin": """F p = y * 7.722012901e-2f - 5.980451742e-1f;
    p = p * y + 2.550031377f;
    p = p * y - 5.167706879f;
    p = (p * y + 3.141592580f) * f;""",
}


@making.once
def make_slopes(K: int) -> SimpleNamespace:
    """What a sloped splat adds to the operations on the K pixels of a thread."""
    V = make_lanes(K).V

    def of_turns(name: str) -> str:
        """C++ of the cosine or the sine."""
        text = _OF_TURNS if K == 1 else _OF_TURNS_WIDE
        return text.format(name=name, polynomial=_POLYNOMIALS[name])

    @wp.func_native(
        elementwise(
            K,
            "dx dy",
            "const F t = -(gx * dx + gy * dy), low = t < -bound ? (F)(-bound) : t; "
            "return low > bound ? (F)(bound) : low;",
        )
    )
    def offset_of(dx: V, dy: V, gx: float, gy: float, bound: float) -> V: ...
    @wp.func_native(
        elementwise(K, "a offset", "((offset > -bound) & (offset < bound)) ? a : (F)(0.0f)")
    )
    def where_free(a: V, offset: V, bound: float) -> V: ...
    @wp.func_native(elementwise(K, "turns", of_turns("cos")))
    def cos_of(turns: V) -> V: ...
    @wp.func_native(elementwise(K, "turns", of_turns("sin")))
    def sin_of(turns: V) -> V: ...

    return SimpleNamespace(offset_of=offset_of, where_free=where_free, cos_of=cos_of, sin_of=sin_of)


@wp.func
def plane_of(local: wp.vec3, axes: wp.mat33, scale: wp.vec3) -> wp.vec2:
    """Derivative of the inverse distance of the peak by the slopes (x/z, y/z) of the ray [1/m]:
    z / d^2 (w - n), x and y. ``axes``: own axes in camera axes, as rows.
    """
    n = wp.normalize(local)
    along = axes * n
    smallest = wp.min(scale)
    # P times the smallest variance: for a sheet, P itself would leave the range of floats
    share = wp.vec3(smallest / scale[0], smallest / scale[1], smallest / scale[2])
    weighted = wp.cw_mul(wp.cw_mul(share, share), along)
    w = wp.transpose(axes) * weighted / wp.dot(along, weighted)
    factor = local[2] / wp.length_sq(local)
    return wp.vec2(factor * (w[0] - n[0]), factor * (w[1] - n[1]))


@wp.func
def slope_of(view: CameraView, local: wp.vec3, axes: wp.mat33, scale: wp.vec3) -> wp.vec2:
    """Derivative of the inverse distance by the image position, of a pinhole [1/(m px)]."""
    plane = plane_of(local, axes, scale)
    return wp.vec2(plane[0] / view.fx, plane[1] / view.fy)


@wp.func
def bent_slope_of(view: CameraView, local: wp.vec3, axes: wp.mat33, scale: wp.vec3) -> wp.vec2:
    """The same of a camera whose lens distorts, by the inverse of the lens' derivative."""
    plane = plane_of(local, axes, scale)
    near = inside(view, local[0] / local[2], local[1] / local[2])
    lens = derivative(view, near[0], near[1])
    area = lens[0] * lens[2] - lens[1] * lens[1]
    return wp.vec2(
        (plane[0] * lens[2] - plane[1] * lens[1]) / (area * view.fx),
        (plane[1] * lens[0] - plane[0] * lens[1]) / (area * view.fy),
    )


@wp.func
def bound_of(distance: float, scale: wp.vec3) -> float:
    """How far a pixel's inverse distance may be from the centre's [1/m]: 1 / d - 1 / (d + L)."""
    most = wp.min(SIGMAS * wp.max(scale), SHARE_OF_DISTANCE * distance)
    return most / (distance * (distance + most))


@wp.kernel(enable_backward=False)
def finish_slopes(
    # In:
    splats: wp.array[Splat],  # [N] records, see splat.py
    # Out:
    grad_splats: wp.array[Splat],  # [N] moments in slots 12, 13 and 15, replaced by gradients
):
    """One thread per splat: moments of the derivative by 1/d to gradients of slope and centre.

    The moments are of (centre - pixel), of pixels that are not clamped.
    """
    n = wp.tid()
    g = grad_splats[n]
    if g[6] > 0.0:  # as in ``finish_moments``
        q = splats[n]
        g[0] = g[0] - q[SLOPE_X] * g[BOUND]
        g[1] = g[1] - q[SLOPE_Y] * g[BOUND]
        g[SLOPE_X] = -g[SLOPE_X]
        g[SLOPE_Y] = -g[SLOPE_Y]
        g[BOUND] = 0.0
        grad_splats[n] = g


@wp.kernel(enable_backward=False)
def sum_phases(
    # In:
    phases: wp.array2d[float],  # [2 segments, pixels] derivatives by offset and by slope of phase
    pixels: int,  # of a tile [1]
    # Out:
    of_tiles: wp.array2d[wp.float64],  # [2, tiles] sums over the pixels of a tile
):
    """One thread per tile."""
    tile = wp.tid()
    offset = wp.float64(0.0)
    slope = wp.float64(0.0)
    for plane in range(0, phases.shape[0], 2):
        for p in range(pixels):
            offset += wp.float64(phases[plane, tile * pixels + p])
            slope += wp.float64(phases[plane + 1, tile * pixels + p])
    of_tiles[0, tile] = offset
    of_tiles[1, tile] = slope


@wp.kernel(enable_backward=False)
def add_phases(
    # In:
    of_tiles: wp.array2d[wp.float64],  # [2, tiles] see :func:`sum_phases`
    # Out:
    grad_calibration: wp.array[float],  # [4] phase offset and phase slope are added to
):
    """One thread in all: tiles are summed in order, so that the result is deterministic."""
    offset = wp.float64(0.0)
    slope = wp.float64(0.0)
    for tile in range(of_tiles.shape[1]):
        offset += of_tiles[0, tile]
        slope += of_tiles[1, tile]
    grad_calibration[1] = grad_calibration[1] + float(offset)
    grad_calibration[0] = grad_calibration[0] + float(slope)
