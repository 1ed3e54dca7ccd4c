"""The oracle: the renderer in plain torch, dense [pixels, Gaussians], in any precision,
differentiated by autograd.

Here a physicist checks the model (method, section 2). Gaussian k, its centre X in the world, the
pose (Rc, t):

    camera axes      X_c = Rc X + t = (x, y, z),  distance d = |X_c|,
                     direction n = (X - camera centre) / d
    image            u = fx x / z + cx,  v = fy y / z + cy;  a lens images (x / z, y / z) elsewhere
                     and has its own J
    footprint        cov2D = U Sigma U^T + 0.3 I,  U = J Rc,  Sigma = Gamma Gamma^T,
                     Gamma = R(quaternion) diag(scale)
    response         G = exp(-1/2 (k1 dx^2 + k3 dy^2) - k2 dx dy),  [[k1, k2], [k2, k3]] = cov2D^-1
    alpha            alpha = min(0.99, o G), none below 1/255,  T_k = prod_{l < k} (1 - alpha_l),
                     w_k = alpha_k T_k
    amplitude        a = s r / d^2,  r = max(0, Y(n) . h + 1/2),  phase psi = kappa d + phase_offset
    quad             Q = sum w_k T_k a_k (cos(psi_k - shift) + b)  +  T_e background
    phasor           P = sum w_k T_k eta a_k (cos psi_k, sin psi_k, 1)  +  T_e background
    colour           C = sum w_k c_k  +  T_e background
    distance         D = sum w_k d_k, opacity A = sum w_k, extra F = sum w_k f_k, without background

With ``SplatDistance.PLANE`` d_k, and with it a_k and psi_k, is that of the pixel: see
splat_distance_reference.py. Light crosses every Gaussian in front twice, hence T^2 in quads and
phasor; the background carries T_e, first power. Cost grows with pixels times Gaussians: this is
for tests and small images, the kernels are for work.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..constants import ALPHA_MAX, ALPHA_MIN, SH_BIAS, TRANSMITTANCE_MIN
from ..scene.camera import Camera
from ..scene.distortion import inside
from ..scene.gaussians import GaussianField
from ..scene.sensor import Sensor
from .api import Background, Rendering, ScreenGradient
from .buffers import (
    ClampGradient,
    Distortion,
    RenderSettings,
    SplatDistance,
    Stop,
    Support,
    Workspace,
)
from .control import DeviceCamera
from .inputs import DIFFERENTIABLE, wanted_images
from .splat_distance_reference import bound_of, plane_distances, precision_of, slope_of

# [px] side of the released code's tiles, to which Support.SIGMA3_TILE16 rounds out
_PARITY_TILE = 16
BLOCK = 4_000_000  # (pixel, Gaussian) pairs worked on at once: bounds the memory of a forward pass


@dataclass(frozen=True, kw_only=True)
class _Splats:
    """The M Gaussians that are not culled, near to far, as the image sees them."""

    index: Int[Tensor, "M"]
    """Which Gaussian of the field."""
    z_depth: Float[Tensor, "M"]
    """Third camera coordinate [m]."""
    distance: Float[Tensor, "M"]
    """Along the ray [m]."""
    direction: Float[Tensor, "M 3"]
    """Unit vector from the camera, in world axes."""
    centre: Float[Tensor, "M 2"]
    """Image position (u, v) [px]."""
    covariance: Float[Tensor, "M 3"]
    """xx, xy, yy of cov2D, low pass included [px^2]."""
    opacity: Float[Tensor, "M"]
    """At the peak [1]."""
    point: Float[Tensor, "M 3"]
    """Centre in camera axes [m]."""
    precision: Float[Tensor, "M 3 3"]
    """Inverse of the covariance, in camera axes [1/m^2]."""
    slope: Float[Tensor, "M 2"]
    """Change of the inverse distance along x and y [1/(m px)]."""
    bound: Float[Tensor, "M"]
    """How far a pixel's inverse distance may be from the centre's [1/m]."""


def rasterize(
    field: GaussianField,
    camera: Camera,
    sensor: Sensor,
    settings: RenderSettings = RenderSettings(),
    *,
    background: Background | None = None,
    extra: Float[Tensor, "N D"] | None = None,
    extra_detached: bool = False,
    images: Collection[str] = DIFFERENTIABLE,
    screen_gradient: bool = False,
    workspace: Workspace | None = None,  # noqa: ARG001
    control: DeviceCamera | None = None,  # noqa: ARG001
) -> Rendering:
    """Oracle of :func:`gftorf_warp.render.api.rasterize`; computes in the dtype of the field.

    ``Rendering.screen`` is filled by ``backward()``, not by ``torch.autograd.grad`` with respect to
    tensors the image positions do not depend on. ``workspace``, ``control``, and ``pair_capacity``
    and ``threads`` of the settings are ignored.
    """
    background = background or Background()
    height, width, q = camera.height, camera.width, len(sensor.shifts)
    splats = project(field, camera, settings)
    screen = None
    if screen_gradient:
        screen = ScreenGradient(values=field.mean.new_zeros(len(field), 4))
    lights = [background.quads, background.phasor, background.colour]
    inputs: list[object] = [*field.parameters().values(), extra, *lights, *_numbers(sensor)]
    centre, seen_of = _watched(splats, screen, inputs)

    # What Gaussian k carries: columns weighted by T (colour, distance, 1, extra) and by T^2 (quads,
    # phasor)
    basis = spherical_harmonics(splats.direction, settings.sh_degree)  # [M, K]
    reflectivity = shade(basis, field.reflectivity_sh[splats.index])
    d = splats.distance
    one_way = [torch.ones_like(d)[:, None]]
    if field.colour_sh is not None:
        one_way.append(shade(basis, field.colour_sh[splats.index].flatten(1), channels=3))
    more = d.new_zeros(len(d), 0) if extra is None else extra[splats.index].to(d)
    sloped = settings.splat_distance is SplatDistance.PLANE
    carried = torch.cat(one_way, 1)

    pixel = _pixel_centres(camera, d)  # [P, 2]
    blocks = []
    for block in pixel.split(max(1, BLOCK // max(1, len(d)))):
        w, T, T_end = compositing_weights(_alpha(block, splats, centre, settings), settings.stop)
        seen_at = d  # [M], or [P, M] if pixels of a splat differ
        if sloped:
            seen_at = plane_distances(block, centre, d, splats.slope, splats.bound)
        two_way = correlate(seen_at, reflectivity, sensor, settings.phasor_factor)
        zeta = seen_at
        if settings.distortion is Distortion.RELEASED:
            zeta = _normalised(zeta, settings)
        moments = [_blend(w, (zeta**n)[..., None]) for n in (0, 1, 2)]  # A, M, V
        half_sum = moments[0] * moments[2] - moments[1] ** 2
        seen = (w.detach() if extra_detached else w) @ more
        blocks.append(
            torch.cat(
                [
                    _blend(w, seen_at[..., None]),
                    w @ carried,
                    seen,
                    _blend(w * T, two_way),
                    half_sum,
                    _median(w, T, seen_at)[:, None],
                    T_end[:, None],
                ],
                1,
            )
        )
        seen_of += torch.stack([(w > 0).sum(0), w.detach().sum(0)], 1)
    image = torch.cat(blocks).T.reshape(-1, height, width)

    colours = 0 if field.colour_sh is None else 3
    sizes = [1, 1, colours, more.shape[1], q, 3, 1, 1, 1]
    distance, opacity, colour, more, quads, phasor, half_sum, median, T_end = image.split(sizes)
    by_name = {
        "quads": quads + _behind(background.quads, T_end, q),
        "phasor": phasor + _behind(background.phasor, T_end, 3),
        "distance": distance[0],
        "opacity": opacity[0],
        "distance_median": median[0].detach(),
        "distortion": half_sum[0] * (2.0 if settings.distortion is Distortion.PAPER else 1.0),
    }
    wanted = wanted_images(images)
    return Rendering(
        **{name: image if name in wanted else image[:0] for name, image in by_name.items()},
        colour=None if field.colour_sh is None else colour + _behind(background.colour, T_end, 3),
        extra=None if extra is None else more,
        screen=screen,
    )


def _blend(w: Float[Tensor, "P M"], values: Tensor) -> Float[Tensor, "P C"]:
    """Sums of ``values`` [M, C], or [P, M, C] if they differ from pixel to pixel."""
    return w @ values if values.ndim == 2 else (w[:, None] @ values)[:, 0]


def _median(
    w: Float[Tensor, "P M"], T: Float[Tensor, "P M"], d: Float[Tensor, "*P M"]
) -> Float[Tensor, "P"]:
    """Distance of the splat at which the transmittance falls below one half; 0: it does not."""
    return torch.where((T >= 0.5) & (T - w < 0.5), d, 0.0).sum(1).detach()


def undecided_pixels(
    field: GaussianField, camera: Camera, settings: RenderSettings = RenderSettings()
) -> Bool[Tensor, "H W"]:
    """Pixels where float32 may decide a rule differently from float64; comparisons leave them out.

    Rules: alpha >= 1/255, the clamp at 0.99, the stop at T = 1e-4, the depth order, and the
    rounding of a square to tiles.
    """
    with torch.no_grad():
        exact = field.map(lambda t: t.detach().double() if t.is_floating_point() else t)
        splats = project(exact, camera, settings)
        pixels = _pixel_centres(camera, splats.distance)
        blocks = pixels.split(max(1, BLOCK // max(1, len(splats.index))))
        undecided = torch.cat([_undecided(block, splats, settings) for block in blocks])
    return undecided.reshape(camera.height, camera.width)


def _undecided(pixel: Tensor, splats: _Splats, settings: RenderSettings) -> Bool[Tensor, "P"]:
    power, rounding = _power(pixel, splats.centre, splats.covariance)
    raw = splats.opacity * power.exp()
    alpha = _alpha(pixel, splats, splats.centre, settings)
    hit = alpha > 0
    T = torch.cumprod(1.0 - alpha, 1)
    # behind the stop nothing is decided any more
    live = T / (1.0 - alpha) >= (1.0 - 1e-3) * TRANSMITTANCE_MIN

    jump = (raw / ALPHA_MIN - 1.0).abs() < 1e-4
    jump |= hit & ((raw / ALPHA_MAX - 1.0).abs() < 1e-4)
    jump |= hit & ((T / TRANSMITTANCE_MIN - 1.0).abs() < 1e-3)
    # a needle: its power may come out above zero
    jump |= (power.abs() < 1e-6 * rounding) & (raw >= ALPHA_MIN)
    if settings.support is Support.SIGMA3_TILE16:
        ellipses = pixel, splats.centre, splats.covariance
        wide, narrow = (_inside_tiles(*ellipses, margin=margin) for margin in (1e-3, -1e-3))
        jump |= (wide ^ narrow) & (raw >= (1.0 - 1e-4) * ALPHA_MIN)
    undecided = (jump & live).any(1)

    z = splats.z_depth
    nearest, farthest = (
        _depth_key(z * (1.0 + rounding), settings)[:, None] for rounding in (-5e-7, 5e-7)
    )
    in_memory = splats.index[:, None] < splats.index
    # [k, j]: k comes before j in any case
    first = (farthest < nearest.T) | ((farthest <= nearest.T) & in_memory)
    either = ~(first | first.T) & (z[:, None] != z)
    for k, j in either.triu(1).nonzero().tolist():
        undecided |= hit[:, k] & hit[:, j] & live[:, k]
    return undecided


def project(field: GaussianField, camera: Camera, settings: RenderSettings) -> _Splats:
    """EWA projection (method, 2.2): cull, sort near to far, linearise at each centre."""
    pose = torch.as_tensor(camera.camera_from_world, dtype=field.mean.dtype, device=field.device)
    rotation, translation = pose[:3, :3], pose[:3, 3]
    z_all = (field.mean @ rotation.T + translation)[:, 2]
    seen = (z_all >= settings.near) & (z_all <= settings.far) & (field.opacity >= ALPHA_MIN)
    index = seen.nonzero()[:, 0]
    # The order is decided by keys of float32, as in the kernels; equal ones keep their order in
    # memory
    index = index[_depth_key(z_all.detach()[index], settings).sort(stable=True).indices]

    point = field.mean[index] @ rotation.T + translation
    x, y, z = point.unbind(1)
    distance = point.norm(dim=1)
    limit_x, limit_y, radius = camera.guard
    x_guarded = z * (x / z).clamp(-limit_x, limit_x)
    y_guarded = z * (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    along_u = torch.stack([camera.fx / z, zero, -camera.fx * x_guarded / z**2], 1)
    along_v = torch.stack([zero, camera.fy / z, -camera.fy * y_guarded / z**2], 1)
    jacobian = torch.stack([along_u, along_v], 1)
    flat = x / z, y / z
    if camera.distortion:
        near = inside(x_guarded / z, y_guarded / z, radius)
        xx, xy, yy = camera.distortion.slope(*near)
        aspect = camera.fx / camera.fy
        bend = torch.stack([xx, xy * aspect, xy / aspect, yy], 1).unflatten(1, (2, 2))
        jacobian, flat = bend @ jacobian, camera.distortion.apply(*flat, radius)
    # Gamma, columns in metres
    turned = _rotation(field.quaternion[index])
    axes = turned * field.scale[index][:, None, :]
    precision = precision_of(rotation @ turned, field.scale[index])
    projected = jacobian @ rotation @ axes  # [M, 2, 3]
    cov = projected @ projected.mT + settings.low_pass * torch.eye(
        2, dtype=z.dtype, device=z.device
    )
    return _Splats(
        index=index,
        z_depth=z,
        distance=distance,
        direction=point @ rotation / distance[:, None],  # Rc^T X_c = X - camera centre
        centre=torch.stack([camera.fx * flat[0] + camera.cx, camera.fy * flat[1] + camera.cy], 1),
        covariance=torch.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], 1),
        opacity=field.opacity[index],
        point=point,
        precision=precision,
        slope=slope_of(camera, point, precision),
        bound=bound_of(distance, field.scale[index]),
    )


def _depth_key(z: Float[Tensor, "M"], settings: RenderSettings) -> Int[Tensor, "M"]:
    """Floats from ``near`` to each z-depth, without the lowest bits: what splats are ordered by."""
    bits, near = (depth.float().view(torch.int32) for depth in (z, torch.tensor(settings.near)))
    return (bits - near.to(bits.device)) >> settings.depth_shift


def _rotation(wxyz: Float[Tensor, "M 4"]) -> Float[Tensor, "M 3 3"]:
    """Rotation matrices of quaternions of any length."""
    w, x, y, z = (wxyz / wxyz.norm(dim=1, keepdim=True)).unbind(1)
    entries = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    entries += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    entries += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(entries, 1).unflatten(1, (3, 3))


def spherical_harmonics(n: Float[Tensor, "M 3"], degree: int) -> Float[Tensor, "M K"]:
    """Real harmonics Y_0 .. Y_{K-1}, K = (degree + 1)^2, of unit vectors (method, 2.3)."""
    x, y, z = n.unbind(1)
    one = torch.ones_like(x)
    root = [math.sqrt(value / math.pi) for value in (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16)]
    cubic = [math.sqrt(value / math.pi) for value in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)]
    columns = [
        root[0] * one,
        -root[1] * y,
        root[1] * z,
        -root[1] * x,
        root[2] * x * y,
        -root[2] * y * z,
        root[3] * (2 * z * z - x * x - y * y),
        -root[2] * x * z,
        root[4] * (x * x - y * y),
        -cubic[0] * y * (3 * x * x - y * y),
        cubic[1] * x * y * z,
        -cubic[2] * y * (4 * z * z - x * x - y * y),
        cubic[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -cubic[2] * x * (4 * z * z - x * x - y * y),
        cubic[4] * z * (x * x - y * y),
        -cubic[0] * x * (x * x - 3 * y * y),
    ]
    return torch.stack(columns[: (degree + 1) ** 2], 1)


def shade(
    basis: Float[Tensor, "M K"], sh: Float[Tensor, "M KC"], channels: int = 1
) -> Float[Tensor, "M C"]:
    """Value seen from the camera, max(0, sum_i Y_i h_i + 1/2); no gradient where it is clamped."""
    coefficients = sh.reshape(len(sh), sh.shape[1] // channels, channels)[:, : basis.shape[1]]
    return torch.relu((basis[:, :, None] * coefficients).sum(1) + SH_BIAS)


def correlate(
    d: Float[Tensor, "*P M"],
    reflectivity: Float[Tensor, "M 1"],
    sensor: Sensor,
    phasor_factor: float,
) -> Float[Tensor, "*P M light"]:
    """Light of each Gaussian alone: its Q quads, then its phasor (method, 2.4)."""
    slope, phase_offset, source, dc_offset, shift = (
        torch.as_tensor(value, dtype=d.dtype, device=d.device)
        for value in (*sensor.calibration, sensor.shifts)
    )
    a = source * reflectivity / d[..., None] ** 2
    psi = (slope * d + phase_offset)[..., None]
    quads = a * ((psi - shift).cos() + dc_offset)
    phasor = phasor_factor * a * torch.cat([psi.cos(), psi.sin(), torch.ones_like(psi)], -1)
    return torch.cat([quads, phasor], -1)


def _normalised(d: Float[Tensor, "*n"], settings: RenderSettings) -> Float[Tensor, "*n"]:
    """The released code's zeta: 0 at the near plane, 1 at the far plane, of the distance."""
    return settings.far / (settings.far - settings.near) * (1.0 - settings.near / d)


def _pixel_centres(camera: Camera, like: Tensor) -> Float[Tensor, "P 2"]:
    """Image positions (x, y) of all pixel centres, row by row [px]."""
    x, y = (
        torch.arange(size, dtype=like.dtype, device=like.device) + 0.5
        for size in (camera.width, camera.height)
    )
    return torch.stack([x.repeat(camera.height), y.repeat_interleave(camera.width)], 1)


def _power(
    pixel: Float[Tensor, "P 2"], centre: Float[Tensor, "M 2"], covariance: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "P M"], Float[Tensor, "P M"]]:
    """Exponent of the response, and the sum of its terms' magnitudes, which scales its rounding."""
    xx, xy, yy = covariance.unbind(1)
    determinant = xx * yy - xy**2
    k1, k2, k3 = yy / determinant, -xy / determinant, xx / determinant
    dx, dy = (centre - pixel[:, None, :]).unbind(2)
    terms = -0.5 * k1 * dx**2, -0.5 * k3 * dy**2, -k2 * dx * dy
    return terms[0] + terms[1] + terms[2], terms[2].abs() - terms[0] - terms[1]


def _alpha(
    pixel: Float[Tensor, "P 2"],
    splats: _Splats,
    centre: Float[Tensor, "M 2"],
    settings: RenderSettings,
) -> Float[Tensor, "P M"]:
    """What each Gaussian takes of a pixel's light; exactly 0 where it takes no part."""
    power, _ = _power(pixel, centre, splats.covariance)
    raw = splats.opacity * power.exp()
    alpha = raw.clamp(max=ALPHA_MAX)
    touches = (alpha >= ALPHA_MIN) & (power <= 0.0)
    if settings.support is Support.SIGMA3_TILE16:
        touches &= _inside_tiles(pixel, centre, splats.covariance)
    if settings.clamp_gradient is ClampGradient.STRAIGHT:
        alpha = raw + (alpha - raw).detach()
    return torch.where(touches, alpha, torch.zeros_like(alpha))


def _inside_tiles(
    pixel: Float[Tensor, "P 2"],
    centre: Float[Tensor, "M 2"],
    covariance: Float[Tensor, "M 3"],
    margin: float = 0.0,
) -> Bool[Tensor, "P M"]:
    """The released support: a square of half-width ceil(3 sqrt(lambda_max)) plus ``margin`` [px],
    rounded out to whole tiles (method, 2.2), of pixels with integer centres, hence the half pixel.
    """
    xx, xy, yy = covariance.detach().unbind(1)
    middle = 0.5 * (xx + yy)
    widest = middle + (middle**2 - (xx * yy - xy**2)).clamp(min=0.1).sqrt()
    half_width = (3.0 * widest.sqrt() + margin).ceil()[:, None] + margin
    position = centre.detach() - 0.5
    first = ((position - half_width) / _PARITY_TILE).floor()
    end = ((position + half_width + _PARITY_TILE - 1) / _PARITY_TILE).floor()
    tile = (pixel[:, None, :] / _PARITY_TILE).floor()
    return ((tile >= first) & (tile < end)).all(2)


def compositing_weights(
    alpha: Float[Tensor, "P M"], stop: Stop
) -> tuple[Float[Tensor, "P M"], Float[Tensor, "P M"], Float[Tensor, "P"]]:
    """Weights w = alpha T, T before each Gaussian, and T_e behind the last (method, 2.5)."""
    T = _transmittance(alpha)
    # is the Gaussian that crosses the limit still added?
    added = T[:, :-1] if stop is Stop.INCLUSIVE else T[:, 1:]
    alpha = torch.where(added >= TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    T = _transmittance(alpha)
    return alpha * T[:, :-1], T[:, :-1], T[:, -1]


def _transmittance(alpha: Float[Tensor, "P M"]) -> Float[Tensor, "P M+1"]:
    """T before each Gaussian, and behind the last."""
    return torch.cat([alpha.new_ones(len(alpha), 1), torch.cumprod(1.0 - alpha, 1)], 1)


def _behind(
    light: Tensor | float | None, T_end: Float[Tensor, "1 H W"], channels: int
) -> Tensor | float:
    """T_e times the background, first power in every channel; zero for a missing background."""
    if light is None:
        return 0.0
    values = torch.as_tensor(light, dtype=T_end.dtype, device=T_end.device)
    return T_end * values.expand(channels, *T_end.shape[1:])


def _numbers(sensor: Sensor) -> tuple[float | Tensor, ...]:
    """What a calibration may optimise."""
    return sensor.f_mod_hz, sensor.phase_offset, sensor.dc_offset, sensor.source_intensity


def _watched(
    splats: _Splats, screen: ScreenGradient | None, inputs: list[object]
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]]:
    """Image positions with a hook that fills ``screen``; pixels and weights to be filled in.

    A zero that needs a gradient is added, so that the hook runs even with fixed means.
    """
    seen, centre = torch.zeros_like(splats.centre), splats.centre
    optimised = any(isinstance(value, Tensor) and value.requires_grad for value in inputs)
    if screen is not None and optimised and torch.is_grad_enabled():
        centre = centre + torch.zeros_like(centre).requires_grad_()

        def note(grad: Tensor) -> None:
            # like a parameter's .grad, it adds up over passes
            screen.gradient.index_add_(0, splats.index, grad)
            screen.values[splats.index, 2:] = seen

        centre.register_hook(note)
    return centre, seen
