"""The kernels against physics, symmetries and their own finite differences:
evidence that needs no oracle.
"""

import math
from dataclasses import replace

import pytest
import torch
from cases import (
    CASES,
    SMALL,
    Case,
    channels,
    cotangents,
    gaussians,
    light,
    moved_world,
)
from comparison import DEVICES, FULL, TOLERANCE
from torch.testing import assert_close

from gftorf_warp.constants import LOW_PASS, SPEED_OF_LIGHT
from gftorf_warp.render import api, reference
from gftorf_warp.render.api import Background
from gftorf_warp.render.buffers import RenderSettings, Stop, Support
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


def test_finite_differences_of_the_kernel_itself(device):
    """Central differences in float32 along each gradient, where no jump is near:
    evidence without the oracle.
    """
    case = CASES["smooth"]()
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    weight = cotangents(images, torch.zeros(20, 24, dtype=torch.bool))

    def loss(values):
        images = case.outputs(api.rasterize, values)
        return sum((images[name].double() * weight[name]).sum() for name in images)

    gradients = torch.autograd.grad(loss(inputs), [*inputs.values()])
    for (key, value), gradient in zip(inputs.items(), gradients, strict=True):
        unit = value.detach().item() if key == "f_mod_hz" else 1.0
        direction, step = unit * gradient / gradient.norm(), 0.03
        with torch.no_grad():
            ahead, behind = (
                loss({**inputs, key: value + sign * step * direction}).item() for sign in (1, -1)
            )
        want = unit * gradient.double().norm().item()
        assert (ahead - behind) / (2 * step) == pytest.approx(want, rel=1e-2), key
        assert want > 0.1, f"{key}: too little to be measured"


@pytest.mark.parametrize("name", ["translucent", "opaque", "posed"])
def test_order_in_memory_does_not_matter(name, device):
    """Gaussians are sorted by z-depth, whatever their order; the gradients follow them."""
    case = CASES[name]()
    shuffle = torch.randperm(len(case.field), generator=torch.Generator().manual_seed(0))
    extra = None if case.extra is None else case.extra[shuffle]
    other = replace(case, field=case.field.map(lambda tensor: tensor[shuffle]), extra=extra)
    inputs, shuffled = case.inputs(torch.float32, device), other.inputs(torch.float32, device)
    want, got = case.outputs(api.rasterize, inputs), other.outputs(api.rasterize, shuffled)
    weight = cotangents(want, torch.zeros(want["opacity"].shape, dtype=torch.bool))
    for output in want:
        assert torch.equal(got[output], want[output]), output
    for key in ("mean", "opacity_logit", "reflectivity_sh"):
        one, two = (
            torch.autograd.grad(
                sum((images[k] * weight[k]).sum() for k in images), tensors[key], retain_graph=True
            )[0]
            for images, tensors in ((want, inputs), (got, shuffled))
        )
        assert_close(two, one[shuffle.to(device)], rtol=1e-4, atol=1e-5 * one.abs().max().item())


@pytest.mark.parametrize("name", FULL)
def test_moving_world_and_camera_together_changes_nothing(name, device):
    """Images stay; gradients by centres turn with the world."""
    case = CASES[name]()
    undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
    axis, angle, translation = (0.3, -1.0, 0.8), 1.1, (0.5, -1.0, 0.7)
    other = moved_world(case, axis, angle, translation)
    rotation = torch.from_numpy(
        other.camera.camera_from_world[:3, :3].T @ case.camera.camera_from_world[:3, :3]
    )
    results = []
    for one in (case, other):
        inputs = one.inputs(torch.float32, device)
        images = one.outputs(api.rasterize, inputs)
        weight = cotangents(images, undecided)
        loss = sum((images[name] * weight[name]).sum() for name in images)
        results.append((images, torch.autograd.grad(loss, inputs["mean"])[0].cpu()))
    (want, by_mean), (got, by_moved) = results
    for name, image in want.items():
        error = ((got[name] - image).abs().cpu() * ~undecided).max()
        assert error < TOLERANCE.image * max(1.0, image.abs().max().item()), name
    assert_close(
        by_moved.double(),
        by_mean.double() @ rotation.T,
        rtol=0,
        atol=2e-4 * by_mean.abs().max().item(),
    )
    assert (by_moved - by_mean).abs().max() > 0.1 * by_mean.abs().max(), (
        "unturned gradients must not pass"
    )


def on_axis(distance, opacity, device: str, reflectivity=0.5, scale: float = 30.0) -> GaussianField:
    """Round Gaussians on the optical axis; wide ones fill the image evenly."""
    d = torch.as_tensor(distance, dtype=torch.float32)
    n = len(d)
    return GaussianField(
        mean=torch.stack([0 * d, 0 * d, d], 1),
        log_scale=torch.full((n, 3), math.log(scale)),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4),
        opacity_logit=torch.logit(torch.as_tensor(opacity, dtype=torch.float32).expand(n)),
        reflectivity_sh=constant_sh(torch.as_tensor(reflectivity, dtype=torch.float32).expand(n)),
    ).map(lambda tensor: tensor.to(device))


ODD = Camera.from_fov(25, 21, 60.0)  # the optical axis meets the centre of pixel [10, 12]

AXIS = (..., 10, 12)


def test_single_gaussian_is_its_closed_form(device):
    """On the axis alpha is the opacity, and the paper's sensor equations say the rest."""
    o, d, r, bg = 0.6, 3.0, 0.4, 0.25
    sensor = Sensor(shifts=(0.2, 1.7, 4.0), phase_offset=0.3, dc_offset=1.2, source_intensity=1.7)
    background = Background(
        quads=torch.tensor(bg, device=device), phasor=torch.tensor(-bg, device=device)
    )
    image = api.rasterize(on_axis([d], o, device, r, 0.2), ODD, sensor, background=background)
    a, psi = 1.7 * r / d**2, 4 * math.pi / 15.0 * d + 0.3
    quads = [o * a * (math.cos(psi - shift) + 1.2) + (1 - o) * bg for shift in sensor.shifts]
    phasor = [2 * o * a * part - (1 - o) * bg for part in (math.cos(psi), math.sin(psi), 1.0)]
    assert_close(image.quads[AXIS].cpu(), torch.tensor(quads), rtol=1e-5, atol=1e-6)
    assert_close(image.phasor[AXIS].cpu(), torch.tensor(phasor), rtol=1e-5, atol=1e-6)
    assert image.distance[AXIS].item() == pytest.approx(o * d, rel=1e-5)
    assert image.opacity[AXIS].item() == pytest.approx(o, rel=1e-5)
    assert image.distortion.abs().max().item() < 1e-5
    assert image.colour is None
    assert image.extra is None
    assert image.screen is None


def test_one_range_farther_is_dimmer_but_in_phase(device):
    """Phase wraps at c/2f, 7.5 m; amplitude falls off with the square of the distance;
    decoding gives 2 m for both.
    """
    sensor = Sensor(f_mod_hz=SPEED_OF_LIGHT / 15.0, phase_offset=0.7)
    near, far = (
        api.rasterize(on_axis([d], 0.9, device), ODD, sensor).phasor[AXIS].cpu() for d in (2.0, 9.5)
    )
    assert_close(far / far[2], near / near[2], rtol=1e-4, atol=1e-5)
    assert (near[2] / far[2]).item() == pytest.approx((9.5 / 2.0) ** 2, rel=1e-5)
    for phasor in (near, far):
        assert distance_from_phasor(phasor[0], phasor[1], sensor).item() == pytest.approx(
            2.0, abs=1e-4
        )


def test_opposite_quads_cancel_but_for_the_constant_part(device):
    """Q(0) + Q(pi) is the DC offset times twice the amplitude;
    Q(0) - Q(pi) is the phasor's real part.
    """
    case = replace(CASES["translucent"](), background=None)
    image = case.render(api.rasterize, case.inputs(torch.float32, device, grad=False))
    for i in (0, 2):
        assert_close(
            image.quads[i] + image.quads[i + 1], 0.3 * image.phasor[2], rtol=1e-5, atol=1e-6
        )
        assert_close(
            image.quads[i] - image.quads[i + 1], image.phasor[i // 2], rtol=1e-5, atol=1e-6
        )
    assert image.phasor[2].max() > 0.1


def test_early_stop_drops_or_adds_the_gaussian_that_crosses(device):
    """T is 0.5, 0.005, 5e-5: the third Gaussian is the crossing one; the fourth is never seen,
    and gets no gradient.
    """
    field = on_axis([1.0, 2.0, 3.0, 4.0], torch.tensor([0.5, 0.9999, 0.9999, 0.9]), device)
    third = {Stop.INCLUSIVE: 0.00495, Stop.EXCLUSIVE: 0.0}
    for stop, weight in third.items():
        extra = torch.eye(4, device=device).requires_grad_()
        image = api.rasterize(field, ODD, Sensor(), RenderSettings(stop=stop), extra=extra)
        want = torch.tensor([0.5, 0.495, weight, 0.0])
        assert_close(image.extra[AXIS].detach().cpu(), want, rtol=1e-4, atol=1e-7)
        assert image.distance[AXIS].item() == pytest.approx(
            (want * torch.arange(1, 5)).sum().item(), rel=1e-5
        )
        (gradient,) = torch.autograd.grad(image.extra.sum(), extra)
        assert (gradient[3] == 0).all()
        assert (gradient[2, 2] > 0) == (stop is Stop.INCLUSIVE)


@pytest.mark.parametrize(
    ("centre", "exact", "parity"),
    [(48.0, (15, 80), (16, 79)), (47.2, (14, 79), (14, 79)), (46.0, (13, 78), (13, 78))],
)
def test_parity_support_cuts_at_tiles_and_the_exact_one_does_not(centre, exact, parity, device):
    """Standard deviation 10 px: alpha = 1/255 lies at 33 px, the square of half-width 31 px ends at
    a tile's edge.

    Counted from integer pixel centres, 47.5 - 31 lies in the second tile and 46.7 - 31 in the
    first.
    """
    camera = Camera(width=96, height=1, fx=96.0, fy=96.0, cx=centre, cy=0.5)
    field = on_axis([1.0], 0.9999, device, scale=math.sqrt(100 - LOW_PASS) / 96.0)
    for support, (first, last) in ((Support.ALPHA, exact), (Support.SIGMA3_TILE16, parity)):
        row = api.rasterize(field, camera, Sensor(), RenderSettings(support=support)).opacity[0]
        touched = row.nonzero()[:, 0]
        assert (touched.min(), touched.max()) == (first, last)


def test_culled_gaussians_have_zero_finite_gradients(device):
    """Behind, in the camera's plane, too far, off-screen or too faint: nothing is seen,
    nothing is learned.
    """
    field = gaussians(15, SMALL, seed=0)
    field.mean[:3, 2] *= -1
    field.mean[3:6, 2] = 0.0
    field.mean[6:9, 2] = 1e4
    field.mean[9:12, 0] = 50.0
    field.opacity_logit[12:] = -6.0
    case = Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=0), extra=channels(field, 3)
    )
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    for name in ("distance", "opacity", "distortion", "extra"):
        assert (images[name] == 0).all(), name
    for name in ("quads", "phasor", "colour"):
        assert_close(images[name], inputs[f"background.{name}"])
    gradients = torch.autograd.grad(
        sum(image.sum() for image in images.values()), [*inputs.values()]
    )
    for name, gradient in zip(inputs, gradients, strict=True):
        assert (gradient == (1.0 if name.startswith("background") else 0.0)).all(), name


def test_screen_gradient_is_that_of_the_principal_point(device):
    """Moving the principal point moves all image positions alike:
    the sum of the screen gradients is its derivative.
    """
    case = CASES["smooth"]()
    inputs = case.inputs(torch.float32, device)
    rendering = case.render(api.rasterize, inputs, screen_gradient=True)
    weight = torch.randn(4, 20, 24, generator=torch.Generator().manual_seed(0)).to(device)
    (rendering.quads * weight).sum().backward()
    for axis, key in enumerate(("cx", "cy")):
        step, value = 0.5, getattr(case.camera, key)
        ahead, behind = (
            (replace(case, camera=replace(case.camera, **{key: value + sign * step})))
            .render(api.rasterize, case.inputs(torch.float32, device, grad=False))
            .quads.double()
            for sign in (1, -1)
        )
        want = ((ahead - behind) * weight).sum().item() / (2 * step)
        assert rendering.screen.gradient[:, axis].sum().item() == pytest.approx(want, rel=2e-2)
        assert abs(want) > 1e-3


def test_any_number_of_shifts_is_one_model(device):
    """Quads of seven shifts, two of them equal, are those of seven renderings of one shift."""
    shifts = (0.0, 0.4, 2.2, 0.4, -1.0, 9.0, 4.4)
    case = replace(CASES["translucent"](), background=None)
    inputs = case.inputs(torch.float32, device, grad=False)
    together = (
        replace(case, sensor=case.sensor.with_shifts(shifts)).render(api.rasterize, inputs).quads
    )
    for quad, shift in zip(together, shifts, strict=True):
        alone = (
            replace(case, sensor=case.sensor.with_shifts((shift,)))
            .render(api.rasterize, inputs)
            .quads
        )
        assert_close(quad, alone[0], rtol=1e-6, atol=1e-7)
    assert torch.equal(together[1], together[3])
