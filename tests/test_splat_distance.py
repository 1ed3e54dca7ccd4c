"""Distance inside a splat: the first-order form against the peak of the Gaussian along the ray, and
a tilted wall, which splats of one distance each cannot explain.
"""

import math
from dataclasses import replace

import pytest
import torch
from cases import BENT, CASES, PLANES, POSED, Case, cotangents, gaussians
from comparison import DEVICES, Comparison
from torch.testing import assert_close

from gftorf_warp.render import api, buffers, reference
from gftorf_warp.render.api import Background
from gftorf_warp.render.buffers import Distortion, RenderSettings, SplatDistance
from gftorf_warp.render.splat_distance_reference import peak_distances, plane_distances
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor

SIDES = ["sloped", "sloped_distorted"]


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


def sloped(case):
    """The same case with a distance of its own for every pixel of a splat."""
    return replace(case, settings=replace(case.settings, splat_distance=SplatDistance.PLANE))


def offsets_of(splats, camera, shift):
    """Exact and first-order distances, less the centre's, ``shift`` [px] away from each centre."""
    pixel = splats.centre + shift
    flat = camera.slopes(pixel)
    rays = torch.cat([flat, torch.ones_like(flat[:, :1])], 1)
    rays = rays / rays.norm(dim=1, keepdim=True)
    free = torch.full_like(splats.bound, math.inf)
    exact = peak_distances(rays, splats.point, splats.precision)
    plane = plane_distances(pixel, splats.centre, splats.distance, splats.slope, free)
    return [found.diagonal() - splats.distance for found in (exact, plane)]


@pytest.mark.parametrize("camera", [POSED, BENT], ids=["pinhole", "lens"])
@pytest.mark.parametrize("axis", [0, 1])
def test_first_order_agrees_with_the_peak_to_second_order(camera, axis):
    """Half of the way from the centre, a quarter of the error, which is small beside the change."""
    field = gaussians(50, camera, seed=3, z=(1.0, 3.0), scale=(0.1, 0.4)).map(torch.Tensor.double)
    splats = reference.project(field, camera, PLANES)
    shift = torch.zeros(2, dtype=torch.float64)
    shift[axis] = 0.02
    errors = []
    for part in (1.0, 0.5):
        exact, plane = offsets_of(splats, camera, part * shift)
        errors.append((exact - plane).abs())
        assert errors[-1].max() < 0.01 * plane.abs().max()
    assert plane.abs().median() > 1e-5
    curved = errors[0] > 1e-9  # the others are good to rounding
    assert curved.sum() > 20
    assert (errors[0] / errors[1])[curved].median() == pytest.approx(4.0, rel=0.05)
    assert (errors[0] / errors[1])[curved].min() > 3.0


def test_a_sheet_has_the_distances_of_its_plane(device):
    """One thin, opaque disc at 45 degrees: the rendered distance over the opacity is that of the
    plane through it at every pixel near its centre; with the centre's distance it is not.
    """
    camera = Camera.from_fov(96, 72, 60.0)
    half = math.radians(45.0) / 2
    field = GaussianField(
        mean=torch.tensor([[0.1, -0.05, 3.0]]),
        log_scale=torch.tensor([[0.1, 0.1, 1e-4]]).log(),
        quaternion=torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]]),
        opacity_logit=torch.tensor([2.0]),
        reflectivity_sh=constant_sh(torch.tensor([0.5])),
    ).map(lambda tensor: tensor.to(device))
    normal = torch.tensor([math.sin(2 * half), 0.0, math.cos(2 * half)], dtype=torch.float64)
    rays = camera.directions()
    want = (field.mean[0].cpu().double() @ normal) / (rays @ normal)
    errors = {}
    for kind in SplatDistance:
        settings = RenderSettings(splat_distance=kind)
        seen = api.rasterize(field, camera, Sensor(), settings)
        opacity = seen.opacity.cpu().double()
        error = (seen.distance.cpu().double() / opacity.clamp_min(1e-9) - want).abs()
        errors[kind] = error[opacity > 0.3]
        decoded = torch.atan2(seen.phasor[1], seen.phasor[0]).cpu() % (2 * math.pi)
        decoded = decoded.double() / Sensor().phase_slope
        assert_close(
            decoded[opacity > 0.3],
            (seen.distance.cpu() / opacity)[opacity > 0.3],
            rtol=1e-6,
            atol=1e-6,
        )
    assert len(errors[SplatDistance.PLANE]) > 20
    assert errors[SplatDistance.PLANE].max() < 0.005  # d (u / f)^2 / 2, 1.5 sigma off
    assert errors[SplatDistance.CENTRE].max() > 0.08


def test_spheres_have_the_distance_of_their_centre(device):
    """To first order the peaks of an isotropic Gaussian are on a sphere around the camera."""
    field = gaussians(40, POSED, seed=5)
    field = replace(field, log_scale=field.log_scale[:, :1].expand(-1, 3).clone())
    base = Case(field=field, camera=POSED)
    want, got = (
        case.outputs(api.rasterize, case.inputs(torch.float32, device))
        for case in (base, sloped(base))
    )
    for name, image in want.items():
        assert_close(got[name], image, rtol=1e-5, atol=2e-5 * image.abs().max().item(), msg=name)


@pytest.mark.parametrize("name", ["needles", "outside", "opaque", "saturated", "tiles", "released"])
def test_clamped_and_hidden_splats_match_the_oracle(name, device):
    """Also where a pixel's distance is clamped: no derivative by the slope there."""
    comparison = Comparison(sloped(CASES[name]()), device)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


@pytest.mark.parametrize("name", [*SIDES, "released", "needles"])
def test_the_cuda_mapping_of_slopes_on_the_cpu(name, monkeypatch):
    """One pixel per thread, lists in segments without a distortion."""
    monkeypatch.setitem(buffers.TILE_SHAPES, "cpu", buffers.TILE_SHAPES["cuda"])
    monkeypatch.setitem(buffers.SEGMENTS, "cpu", 4)
    comparison = Comparison(sloped(CASES[name]()), "cpu")
    comparison.check_images()
    comparison.check_gradients(*comparison.want)
    comparison.check_gradients("quads", "distance", "opacity")


def test_distortion_on_the_released_scale(device):
    """Its derivative by the distance depends on the pixel, too."""
    case = CASES["sloped"]()
    settings = replace(case.settings, distortion=Distortion.RELEASED, near=0.5, far=8.0)
    comparison = Comparison(replace(case, settings=settings), device)
    comparison.check_images()
    comparison.check_gradients("distortion")


def test_an_edge_on_needle_stays_within_its_bound(device):
    """A needle nearly along the ray, whose footprint is the low-pass: its distances stay within
    three of its standard deviations, and gradients are finite.
    """
    camera = Camera.from_fov(24, 20, 60.0)
    field = GaussianField(
        mean=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scale=torch.tensor([[1e-4, 1e-4, 0.1]]).log(),
        quaternion=torch.tensor([[1.0, 0.0, 0.002, 0.0]]),
        opacity_logit=torch.tensor([4.0]),
        reflectivity_sh=constant_sh(torch.tensor([0.5])),
    ).map(lambda tensor: tensor.to(device))
    for tensor in field.parameters().values():
        tensor.requires_grad_()
    settings = RenderSettings(splat_distance=SplatDistance.PLANE)
    seen = api.rasterize(field, camera, Sensor(), settings)
    lit = seen.opacity > 0.01
    distance = (seen.distance / seen.opacity)[lit].detach()
    assert lit.sum() >= 4
    assert (distance - 2.0).abs().max() <= 0.3 * 1.001
    assert (distance - 2.0).abs().max() > 0.29, "the bound was not reached: the test is void"
    (seen.quads.sum() + seen.distance.sum()).backward()
    for name, tensor in field.parameters().items():
        assert torch.isfinite(tensor.grad).all(), name


def test_finite_differences_of_the_kernels(device):
    """Float32 images along a random direction of every input, good to 1 %."""
    case = sloped(CASES["smooth"]())
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    decided = reference.undecided_pixels(case.field, case.camera, case.settings)
    weight = cotangents(images, decided)

    def loss(values):
        found = case.outputs(api.rasterize, values)
        return sum((found[key].double() * weight[key]).sum() for key in ("quads", "distance"))

    total = loss(inputs)
    names = ["mean", "log_scale", "quaternion", "f_mod_hz", "phase_offset", "source_intensity"]
    gradients = torch.autograd.grad(total, [inputs[name] for name in names])
    generator = torch.Generator().manual_seed(4)
    for name, gradient in zip(names, gradients, strict=True):
        direction = torch.randn(inputs[name].shape, generator=generator).to(device)
        step = 3e-4 * max(1.0, inputs[name].detach().abs().max().item())
        with torch.no_grad():
            ahead, behind = (
                loss({**inputs, name: inputs[name] + sign * step * direction}) for sign in (1, -1)
            )
        want = ((ahead - behind) / (2 * step)).item()
        got = (gradient * direction).sum().item()
        scale = (gradient.double().norm() * direction.double().norm()).item()
        assert scale > 1e-9, name
        assert got == pytest.approx(want, abs=0.02 * scale), name


@pytest.mark.parametrize("mapping", ["cpu", "cuda"])
@pytest.mark.parametrize("name", ["posed", "sloped", "opaque", "released", "three_shifts", "empty"])
def test_the_median_distance_is_that_of_the_oracle(name, mapping, device, monkeypatch):
    """Also where lists are walked in segments; 0 where half of the light passes, no gradient."""
    if device == "cpu":
        monkeypatch.setitem(buffers.TILE_SHAPES, "cpu", buffers.TILE_SHAPES[mapping])
        monkeypatch.setitem(buffers.SEGMENTS, "cpu", buffers.SEGMENTS[mapping])
    case, names = CASES[name](), ("quads", "distance", "distance_median", "opacity")
    want = case.render(reference.rasterize, case.inputs(torch.float64), images=names)
    got = case.render(api.rasterize, case.inputs(torch.float32, device), images=names)
    median, error = want.distance_median, got.distance_median.cpu() - want.distance_median
    # a float32 may be on the other side of one half
    same = error.abs() < 1e-5 * median.max() + 1e-6
    assert same.double().mean() > 0.995
    assert not got.distance_median.requires_grad
    crossed = want.opacity.detach() > 0.5
    assert (median > 0).equal(crossed)
    if name in ("sloped", "opaque"):
        assert crossed.double().mean() > 0.3
        apart = (median - want.distance.detach() / want.opacity.detach())[crossed]
        assert apart.abs().median() > 1e-2, "the mean would pass"


def test_the_median_distance_of_two_layers(device):
    """A veil of opacity 0.4 before an opaque layer: the median is the layer, the mean between."""
    camera = Camera.from_fov(8, 8, 20.0)
    field = GaussianField(
        mean=torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]]),
        log_scale=torch.full((2, 3), math.log(20.0)),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        opacity_logit=torch.logit(torch.tensor([0.4, 0.99])),
        reflectivity_sh=constant_sh(torch.tensor([0.5, 0.5])),
    ).map(lambda tensor: tensor.to(device))
    for opacity, want in ((0.4, 4.0), (0.6, 2.0)):
        field.opacity_logit[0] = torch.logit(torch.tensor(opacity))
        seen = api.rasterize(field, camera, Sensor(), images=("distance", "distance_median"))
        assert_close(seen.distance_median.cpu(), torch.full((8, 8), want))
        mean = 2.0 * opacity + 4.0 * (1 - opacity) * 0.99
        assert_close(seen.distance.cpu(), torch.full((8, 8), mean), rtol=2e-3, atol=0)
    assert api.rasterize(field, camera, Sensor()).distance_median.numel() == 0


def fitted_wall(kind: SplatDistance, *, seed: int = 0, steps: int = 300) -> tuple[float, float]:
    """Root mean square errors [m] of d and of the decoded distance, of splats that were fitted to
    exact quads of a wall at 45 degrees with a depth distortion of 0.1.
    """
    camera, sensor = Camera.from_fov(32, 24, 60.0), Sensor(shifts=(0.0, math.pi / 2))
    generator = torch.Generator().manual_seed(seed)
    rays = camera.rays()
    normal = torch.tensor([math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4)])
    truth = 3.0 * normal[2] / (rays @ normal)
    phase = sensor.phase_slope * truth
    want = 0.5 / truth**2 * torch.stack([phase.cos(), phase.sin()])
    start = (rays * truth[..., None]).reshape(-1, 3)
    start = start[torch.randperm(len(start), generator=generator)[:230]]
    sigma = 1.5 * start[:, 2:] / camera.fx
    noise = torch.randn(230, 5, generator=generator)
    field = GaussianField(
        mean=start * (1 + 0.03 * noise[:, :1]),
        log_scale=(sigma * torch.tensor([1.0, 1.0, 0.5])).log(),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.01 * noise[:, 1:],
        opacity_logit=torch.zeros(230),
        reflectivity_sh=constant_sh(torch.full((230,), 0.4)),
    ).map(torch.Tensor.requires_grad_)
    rates = {"mean": 4e-3, "log_scale": 2e-2, "quaternion": 2e-2, "opacity_logit": 6e-2}
    rates |= {"reflectivity_sh": 14e-3}
    groups = [{"params": [getattr(field, name)], "lr": rate} for name, rate in rates.items()]
    descent = torch.optim.Adam(groups, eps=1e-15)
    settings = RenderSettings(splat_distance=kind, sh_degree=0)
    for _ in range(steps):
        light = 0.05 * (2 * torch.rand(want.shape, generator=generator) - 1)
        seen = api.rasterize(
            field,
            camera,
            sensor,
            settings,
            background=Background(quads=light),
            images=("quads", "distortion"),
        )
        error = (seen.quads - want).square().mean() / want.square().mean()
        descent.zero_grad()
        (error + 0.1 * seen.distortion.mean()).backward()
        descent.step()
    with torch.no_grad():
        seen = api.rasterize(field, camera, sensor, settings)
    decoded = torch.atan2(seen.quads[1], seen.quads[0]) % (2 * math.pi) / sensor.phase_slope
    errors = [seen.distance / seen.opacity - truth, decoded - truth]
    return tuple(float(e[3:-3, 3:-3].square().mean().sqrt()) for e in errors)


def test_a_wall_at_45_degrees():
    """The mean distance of a fitted wall is right to 10 mm with a distance per pixel, and several
    times worse with one per splat.
    """
    d, d_tof = fitted_wall(SplatDistance.PLANE)
    worse, _ = fitted_wall(SplatDistance.CENTRE)
    assert d <= 0.010
    assert d_tof <= 0.010
    assert worse > 3 * d
