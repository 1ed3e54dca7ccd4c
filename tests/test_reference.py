"""The oracle against physics, closed forms and central differences:
it is what the kernels are measured with.
"""

import math
from dataclasses import replace

import pytest
import torch
from cases import CASES, SMALL, TOLERANCES, Case, cotangents, gaussians, light, moved_world, sphere
from torch.testing import assert_close

from gftorf_warp.constants import LOW_PASS, SPEED_OF_LIGHT
from gftorf_warp.render import reference
from gftorf_warp.render.api import Background
from gftorf_warp.render.buffers import Distortion, RenderSettings, Stop, Support
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor

ODD = Camera.from_fov(25, 21, 60.0)  # the optical axis meets the centre of pixel [10, 12]
AXIS = (..., 10, 12)
LONG = Sensor(f_mod_hz=SPEED_OF_LIGHT / 15.0)  # depth_range 15 m, as in the method's examples


def layers(distance, opacity, reflectivity, scale=30.0) -> GaussianField:
    """Round Gaussians on the optical axis, by default so wide that each fills the image evenly."""
    d = torch.as_tensor(distance, dtype=torch.float64)
    n = len(d)
    return GaussianField(
        mean=torch.stack([0 * d, 0 * d, d], 1),
        log_scale=torch.full((n, 3), math.log(scale), dtype=torch.float64),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(n, 4),
        opacity_logit=torch.logit(torch.as_tensor(opacity, dtype=torch.float64).expand(n)),
        reflectivity_sh=constant_sh(torch.as_tensor(reflectivity, dtype=torch.float64).expand(n)),
    )


def closed_form(d, r, sensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Quads and (2a cos, 2a sin, 2a) of one opaque point: the paper's sensor equations,
    typed again.
    """
    a = sensor.source_intensity * r / d**2
    psi = 4 * math.pi * sensor.f_mod_hz * d / SPEED_OF_LIGHT + sensor.phase_offset
    quads = [a * (math.cos(psi - shift) + sensor.dc_offset) for shift in sensor.shifts]
    phasor = [2 * a * math.cos(psi), 2 * a * math.sin(psi), 2 * a]
    return torch.tensor(quads, dtype=torch.float64), torch.tensor(phasor, dtype=torch.float64)


def test_single_gaussian_is_its_closed_form():
    """At the pixel its centre falls on, alpha is the opacity; beside it,
    a Gaussian of the projected variance.
    """
    o, d, r, sigma, bg = 0.6, 3.0, 0.4, 0.2, 0.25
    sensor = Sensor(shifts=(0.2, 1.7, 4.0), phase_offset=0.3, dc_offset=1.2, source_intensity=1.7)
    field = layers([d], o, r, scale=sigma)
    background = Background(quads=torch.tensor(bg), phasor=torch.tensor(-bg))
    image = reference.rasterize(
        field, ODD, sensor, background=background, extra=torch.tensor([[2.0, -1.0]])
    )
    quads, phasor = closed_form(d, r, sensor)
    assert_close(image.quads[AXIS], o * quads + (1 - o) * bg)
    assert_close(image.phasor[AXIS], o * phasor - (1 - o) * bg)
    assert image.distance[AXIS].item() == pytest.approx(o * d, rel=1e-12)
    assert image.opacity[AXIS].item() == pytest.approx(o, rel=1e-12)
    assert image.distortion.abs().max() < 1e-12
    assert_close(image.extra[AXIS], torch.tensor([2 * o, -o], dtype=torch.float64))

    variance = (sigma * ODD.fx / d) ** 2 + LOW_PASS
    dx, dy = torch.arange(25) - 12.0, torch.arange(21) - 10.0
    want = o * torch.exp(-(dx**2 + dy[:, None] ** 2).double() / (2 * variance))
    assert_close(image.opacity, torch.where(want >= 1 / 255, want, 0.0))
    assert (image.opacity == 0).any(), (
        "the footprint must end inside the image for this to mean something"
    )


def test_quads_do_not_determine_the_mean_distance():
    """One surface at 3 m and two layers at 2 m and 4.5 m give the same quads,
    mean distance 3.75 m (method, 2.5).
    """
    alpha = torch.tensor([[0.3, 1.0]], dtype=torch.float64)
    d = torch.tensor([2.0, 4.5], dtype=torch.float64)
    r = torch.tensor([[0.3254], [0.7881]], dtype=torch.float64)  # the method's four digits
    w, T, _ = reference.compositing_weights(alpha, Stop.INCLUSIVE)
    two = (w * T) @ reference.correlate(d, r, LONG, 2.0)
    one = reference.correlate(
        torch.tensor([3.0]).double(), torch.tensor([[0.2]]).double(), LONG, 2.0
    )
    assert_close(two[:, :4], one[:, :4], rtol=0, atol=1e-5)
    assert (w @ d).item() == pytest.approx(3.75)


def test_null_space_survives_the_whole_renderer():
    """The same with alpha clamped at 0.99, reflectivities solved for: d_ToF is 3 m,
    the distance is not.
    """
    rear = torch.tensor([2.0, 4.5], dtype=torch.float64)
    psi, three = LONG.phase_slope * rear, 3.0 * LONG.phase_slope
    weight = torch.tensor([0.3, 0.99 * 0.7**2], dtype=torch.float64) / rear**2
    matrix = torch.stack([psi.cos(), psi.sin()]) * weight
    target = 0.99 * 0.2 / 9 * torch.tensor([math.cos(three), math.sin(three)], dtype=torch.float64)
    r = torch.linalg.solve(matrix, target)
    surface = reference.rasterize(layers([3.0], 1 - 1e-9, 0.2), ODD, LONG)
    pair = reference.rasterize(layers(rear, torch.tensor([0.3, 1 - 1e-9]), r), ODD, LONG)
    assert_close(pair.quads[AXIS], surface.quads[AXIS], rtol=1e-5, atol=1e-8)
    assert distance_from_phasor(*pair.phasor[:2], LONG)[AXIS].item() == pytest.approx(3.0, abs=1e-5)
    assert (pair.distance / pair.opacity)[AXIS].item() > surface.distance[AXIS].item() + 0.7


@pytest.mark.parametrize("alpha", [0.01, 0.1, 0.5, 0.99])
def test_fog_reflects_between_half_and_all_of_a_surface(alpha):
    """Of constant alpha, sum alpha T^2 = 1/(2 - alpha) while sum alpha T = 1 (method, 2.5)."""
    fog = torch.full((1, 2000), alpha, dtype=torch.float64)
    w, T, T_end = reference.compositing_weights(fog, Stop.INCLUSIVE)
    assert w.sum().item() == pytest.approx(1.0, abs=1e-4)
    assert (w * T).sum().item() == pytest.approx(1 / (2 - alpha), abs=1e-6)
    assert 0 < T_end.item() < 1e-4


def test_rendered_fog_has_half_the_amplitude():
    """Forty layers at one distance, through the whole renderer: amplitude 2a/(2 - alpha),
    distance d.
    """
    image = reference.rasterize(layers([2.0] * 100, 0.1, 0.8), ODD, LONG)
    assert image.phasor[2][AXIS].item() == pytest.approx(2 * 0.8 / 4 / 1.9, rel=1e-4)
    assert image.distance[AXIS].item() == pytest.approx(2.0, rel=2e-4)


def test_early_stop_drops_or_adds_the_gaussian_that_crosses():
    """T is 0.5, 0.005, 5e-5: the third Gaussian is the crossing one, the fourth is never seen."""
    field = layers([1.0, 2.0, 3.0, 4.0], torch.tensor([0.5, 1 - 1e-9, 1 - 1e-9, 0.9]), 0.5)
    inclusive = reference.rasterize(field, ODD, LONG)
    exclusive = reference.rasterize(field, ODD, LONG, RenderSettings(stop=Stop.EXCLUSIVE))
    assert inclusive.opacity[AXIS].item() == pytest.approx(1 - 5e-5, rel=1e-9)
    assert inclusive.distance[AXIS].item() == pytest.approx(0.5 + 0.495 * 2 + 0.00495 * 3, rel=1e-6)
    assert exclusive.opacity[AXIS].item() == pytest.approx(0.995, rel=1e-9)
    assert exclusive.distance[AXIS].item() == pytest.approx(0.5 + 0.495 * 2, rel=1e-6)


def test_one_range_farther_is_dimmer_but_in_phase():
    """Phase wraps at c/2f, 7.5 m at depth_range 15 m; amplitude falls off with the square of the
    distance.
    """
    near, far = (
        reference.rasterize(layers([d], 0.9, 0.5), ODD, LONG).phasor[AXIS] for d in (2.0, 9.5)
    )
    assert_close(far / far[2], near / near[2])
    assert (near[2] / far[2]).item() == pytest.approx((9.5 / 2.0) ** 2)


def test_opposite_quads_cancel_but_for_the_constant_part():
    """Q(0) + Q(pi) is twice the DC offset times the amplitude;
    Q(0) - Q(pi) is the phasor's real part.
    """
    case = CASES["translucent"]()
    case = replace(case, background=None)
    image = case.render(reference.rasterize, case.inputs(torch.float64))
    b = float(torch.tensor(case.sensor.dc_offset))
    for i in (0, 2):
        assert_close(
            image.quads[i] + image.quads[i + 1], b * image.phasor[2], rtol=1e-9, atol=1e-12
        )
        assert_close(
            image.quads[i] - image.quads[i + 1], image.phasor[i // 2], rtol=1e-9, atol=1e-12
        )
    assert image.phasor[2].max() > 0.1
    assert (image.phasor[2] - image.phasor[:2].norm(dim=0)).min() > -1e-12, (
        "the amplitude is at least the length"
    )


def test_harmonics_are_orthonormal():
    """The integral of Y_i Y_j over the sphere is 1 for i = j and 0 otherwise."""
    points, weight = sphere()
    basis = reference.spherical_harmonics(points, 3)
    gram = basis.T @ (weight[:, None] * basis)
    assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)
    y = reference.spherical_harmonics(torch.tensor([[0.0, 0.0, 1.0]]).double(), 3)[0]
    signs = reference.spherical_harmonics(torch.tensor([[0.6, 0.48, 0.64]]).double(), 1)[0]
    assert_close(y[:4], torch.tensor([0.2820948, 0.0, 0.4886025, 0.0]).double(), rtol=0, atol=1e-6)
    assert_close(
        signs[1:], 0.4886025 * torch.tensor([-0.48, 0.64, -0.6]).double(), rtol=0, atol=1e-6
    )


def test_distortion_is_the_double_sum():
    """2 (A V - M^2) equals the sum over all pairs, in metres,
    and half of it on zeta if the settings say so.
    """
    d, o = torch.tensor([1.5, 2.0, 4.0]).double(), torch.tensor([0.3, 0.5, 0.7]).double()
    w = o * torch.tensor([1.0, 0.7, 0.35]).double()
    settings = RenderSettings(near=0.5, far=8.0)
    zeta = 8.0 / 7.5 * (1 - 0.5 / d)
    for kind, value, factor in ((Distortion.PAPER, d, 1.0), (Distortion.RELEASED, zeta, 0.5)):
        pairs = factor * (w[:, None] * w * (value[:, None] - value) ** 2).sum()
        image = reference.rasterize(
            layers(d, o, 0.5), ODD, LONG, replace(settings, distortion=kind)
        )
        assert image.distortion[AXIS].item() == pytest.approx(pairs.item(), rel=1e-5)


@pytest.mark.parametrize(
    ("centre", "exact", "parity"),
    [(48.0, (15, 80), (16, 79)), (47.2, (14, 79), (14, 79)), (46.0, (13, 78), (13, 78))],
)
def test_parity_support_cuts_at_tiles_and_the_exact_one_does_not(centre, exact, parity):
    """Standard deviation 10 px: alpha = 1/255 lies at 33 px, the square of half-width 31 px ends at
    a tile's edge.

    Counted from integer pixel centres, 47.5 - 31 lies in the second tile and 46.7 - 31 in the
    first.
    """
    camera = Camera(width=96, height=1, fx=96.0, fy=96.0, cx=centre, cy=0.5)
    sigma = math.sqrt(100 - LOW_PASS) / 96.0
    field = layers([1.0], 1 - 1e-9, 0.5, scale=sigma)
    row = {
        support: reference.rasterize(field, camera, LONG, RenderSettings(support=support)).opacity[
            0
        ]
        for support in Support
    }
    touched = {support: image.nonzero()[:, 0] for support, image in row.items()}
    assert (touched[Support.ALPHA].min(), touched[Support.ALPHA].max()) == exact
    assert (touched[Support.SIGMA3_TILE16].min(), touched[Support.SIGMA3_TILE16].max()) == parity
    assert_close(row[Support.ALPHA][16:79], row[Support.SIGMA3_TILE16][16:79])


@pytest.mark.parametrize("name", ["translucent", "posed", "outside"])
def test_moving_world_and_camera_together_changes_nothing(name):
    """Centres, orientations and harmonics turn with the world: the image stays."""
    case = CASES[name]()
    case = replace(case, field=case.field.map(torch.Tensor.double))
    axis, angle, translation = (0.3, -1.0, 0.8), 1.1, (0.5, -2.0, 0.7)
    want = reference.rasterize(case.field, case.camera, case.sensor, case.settings)
    turned = moved_world(case, axis, angle, translation)
    got = reference.rasterize(turned.field, turned.camera, case.sensor, case.settings)
    for output in ("quads", "phasor", "colour", "distance", "distortion"):
        assert_close(getattr(got, output), getattr(want, output), rtol=1e-9, atol=1e-10)
    assert (turned.field.mean - case.field.mean).abs().min() > 1e-3


@pytest.mark.parametrize("name", ["translucent", "posed", "opaque"])
def test_order_in_memory_does_not_matter(name):
    """Gaussians are sorted by z-depth, whatever their order."""
    case = CASES[name]()
    shuffle = torch.randperm(len(case.field), generator=torch.Generator().manual_seed(0))
    extra = None if case.extra is None else case.extra[shuffle]
    other = replace(case, field=case.field.map(lambda tensor: tensor[shuffle]), extra=extra)
    want = case.outputs(reference.rasterize, case.inputs(torch.float64))
    got = other.outputs(reference.rasterize, other.inputs(torch.float64))
    for output, image in want.items():
        scale = max(1.0, image.abs().max().item())
        assert (got[output] - image).abs().max() < TOLERANCES[torch.float64].image * scale * 10, (
            output
        )


def test_behind_the_camera_is_nothing_with_zero_gradients():
    """Everything behind, too near or too far: an empty image,
    gradients that are zero and finite.
    """
    field = gaussians(9, SMALL, seed=0)
    field.mean[:3, 2] *= -1
    field.mean[3:6, 2] = 0.0
    field.mean[6:, 2] = 1e4
    case = Case(field=field, camera=SMALL, background=light(SMALL, 4, seed=0))
    inputs = case.inputs(torch.float64)
    images = case.outputs(reference.rasterize, inputs)
    assert all(images[name].abs().max() == 0 for name in ("distance", "opacity", "distortion"))
    assert_close(images["quads"], inputs["background.quads"])
    gradients = torch.autograd.grad(
        sum(image.sum() for image in images.values()), [*inputs.values()]
    )
    for name, gradient in zip(inputs, gradients, strict=True):
        assert (
            (gradient.abs().max() > 0.5) if name.startswith("background") else (gradient == 0).all()
        ), name


def test_alpha_gradient_follows_the_suffix_recursions():
    """dC/dalpha and dQ/dalpha of method 3.1, suffix form with background,
    against autograd of the compositor.
    """
    generator = torch.Generator().manual_seed(0)
    alpha = (0.6 * torch.rand(1, 12, generator=generator)).double().requires_grad_()
    c, beta = torch.rand(12, generator=generator).double(), 0.7
    w, T, T_end = reference.compositing_weights(alpha, Stop.INCLUSIVE)
    (one_way,) = torch.autograd.grad((w @ c + T_end * beta).sum(), alpha, retain_graph=True)
    (two_way,) = torch.autograd.grad(((w * T) @ c + T_end * beta).sum(), alpha)
    a, t, t_end = alpha.detach()[0], T.detach()[0], T_end.item()
    A = B = 0.0
    for k in reversed(range(12)):
        assert one_way[0, k].item() == pytest.approx(
            (t[k] * (c[k] - A) - t_end * beta / (1 - a[k])).item(), rel=1e-9
        )
        want = t[k] ** 2 * (c[k] - 2 * (1 - a[k]) * B) - t_end * beta / (1 - a[k])
        assert two_way[0, k].item() == pytest.approx(want.item(), rel=1e-9)
        A = a[k] * c[k] + (1 - a[k]) * A
        B = a[k] * c[k] + (1 - a[k]) ** 2 * B


def test_sensor_gradient_follows_the_chain_of_one_gaussian():
    """Derivatives by r, s, phase offset, DC offset and d of method 3.3, against autograd."""
    generator = torch.Generator().manual_seed(1)
    d, r, f, phi, b, s = (
        torch.tensor(value, dtype=torch.float64, requires_grad=True)
        for value in (2.3, 0.4, 2e7, 0.3, 0.8, 1.4)
    )
    sensor = Sensor(f_mod_hz=f, phase_offset=phi, dc_offset=b, source_intensity=s)
    v = torch.randn(7, generator=generator).double()
    out = reference.correlate(d[None], r[None, None], sensor, 2.0)[0]
    got = torch.autograd.grad((v * out).sum(), [d, r, f, phi, b, s])
    kappa = 4 * math.pi * f / SPEED_OF_LIGHT
    psi, a = kappa * d + phi, s * r / d**2
    cos, sin = psi.cos(), psi.sin()
    v_a = v[:4] @ (torch.stack([cos, -cos, sin, -sin]) + b) + 2 * v[4:] @ torch.stack(
        [cos, sin, cos * 0 + 1]
    )
    v_psi = a * (
        v[:4] @ torch.stack([-sin, sin, cos, -cos]) + 2 * v[4:6] @ torch.stack([-sin, cos])
    )
    want = [
        kappa * v_psi - 2 * a / d * v_a,
        v_a * s / d**2,
        v_psi * d * 4 * math.pi / SPEED_OF_LIGHT,
        v_psi,
        a * v[:4].sum(),
        v_a * r / d**2,
    ]
    assert_close(torch.stack(got), torch.stack(want).detach(), rtol=1e-11, atol=0)


@pytest.mark.parametrize("name", CASES)
def test_central_differences(name):
    """Autograd of the oracle against central differences along a random direction of every input,
    1e-5 relative.

    The step, 1e-6 of an input's size, is too short to carry a decided pixel over a jump.
    """
    case = CASES[name]()
    case = replace(
        case, settings=replace(case.settings, clamp_gradient=RenderSettings().clamp_gradient)
    )
    inputs = case.inputs(torch.float64)
    images = case.outputs(reference.rasterize, inputs)
    weight = cotangents(images, reference.undecided_pixels(case.field, case.camera, case.settings))

    def loss(values):
        images = case.outputs(reference.rasterize, values)
        return sum((images[key] * weight[key]).sum() for key in images)

    gradients = dict(
        zip(inputs, torch.autograd.grad(loss(inputs), [*inputs.values()]), strict=True)
    )
    generator = torch.Generator().manual_seed(3)
    for key, value in inputs.items():
        if value.numel() == 0:
            continue
        direction = torch.randn(value.shape, generator=generator).double()
        if name == "coplanar" and key == "mean":
            direction[:, 2] = 0.0  # any step along the axis would reorder centres of equal z-depth
        size = max(1.0, value.abs().max().item())
        step = 1e-6 * size
        with torch.no_grad():
            ahead, behind = (
                loss({**inputs, key: value + sign * step * direction}) for sign in (1, -1)
            )
        want = (gradients[key] * direction).sum().item()
        got = ((ahead - behind) / (2 * step)).item()
        noise = 1e-15 * abs(ahead.item()) / step * 50
        assert got == pytest.approx(want, rel=1e-5, abs=noise), key
        assert abs(want) * size > 1e-3 or name == "empty", f"{key}: a vanished gradient would pass"


@pytest.mark.parametrize("name", ["translucent", "posed", "outside"])
def test_screen_gradient_is_that_of_the_principal_point(name):
    """Moving the principal point moves all image positions alike:
    the sum of the screen gradients is its derivative.
    """
    case = CASES[name]()
    inputs = case.inputs(torch.float64)
    undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
    rendering = case.render(reference.rasterize, inputs, screen_gradient=True)
    weight = cotangents({"quads": rendering.quads}, undecided)["quads"]
    assert (rendering.screen.gradient == 0).all()
    (rendering.quads * weight).sum().backward()

    def loss(**shift):
        moved = replace(case, camera=replace(case.camera, **shift))
        return (moved.render(reference.rasterize, inputs).quads * weight).sum().item()

    for axis, key in enumerate(("cx", "cy")):
        value = getattr(case.camera, key)
        want = (loss(**{key: value + 1e-6}) - loss(**{key: value - 1e-6})) / 2e-6
        assert rendering.screen.gradient[:, axis].sum().item() == pytest.approx(
            want, rel=1e-5, abs=1e-7
        )
        assert abs(want) > 1e-2
    lit = case.render(reference.rasterize, inputs).opacity > 0
    assert rendering.screen.pixels.max() <= lit.sum()
    assert rendering.screen.pixels.max() > 10


def test_blocks_of_pixels_change_nothing(monkeypatch):
    """The image is computed in blocks only to save memory."""
    case = CASES["posed"]()
    want = case.outputs(reference.rasterize, case.inputs(torch.float64))
    monkeypatch.setattr(reference, "BLOCK", 7000)
    got = case.outputs(reference.rasterize, case.inputs(torch.float64))
    for name in want:
        assert_close(got[name], want[name], rtol=1e-12, atol=1e-13)
