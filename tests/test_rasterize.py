"""The kernels against the float64 oracle, against their own finite differences, and against physics."""

import math
from dataclasses import replace

import pytest
import torch
from cases import (
    CASES,
    SENSOR_SCALARS,
    SMALL,
    TOLERANCES,
    UNDECIDED_SHARE,
    Case,
    channels,
    cotangents,
    gaussians,
    light,
    moved_world,
)
from hypothesis import assume, given
from hypothesis import settings as profile
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.render import api, reference
from gftorf_warp.render.api import Background, Rendering
from gftorf_warp.render.buffers import ClampGradient, Distortion, RenderSettings, Stop, Support
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
TOLERANCE = TOLERANCES[torch.float32]
FULL = ("translucent", "posed", "outside")  # cases in which every output and every input exists


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


class Comparison:
    """One case by kernel and by oracle, from equal inputs."""

    def __init__(self, case: Case, device: str):
        """Render both."""
        self.case = case
        undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
        assert undecided.double().mean() <= UNDECIDED_SHARE
        self.exact, self.inputs = case.inputs(torch.float64), case.inputs(torch.float32, device)
        self.want, self.got = case.outputs(reference.rasterize, self.exact), case.outputs(api.rasterize, self.inputs)
        self.weight, self.decided = cotangents(self.want, undecided), ~undecided

    def check_images(self) -> None:
        """Every image, at every pixel that does not sit on a jump."""
        assert self.got.keys() == self.want.keys()
        for name, want in self.want.items():
            got = self.got[name].detach().cpu()
            assert got.dtype == torch.float32
            assert got.shape == want.shape, name
            if want.numel() == 0:
                continue
            bound = TOLERANCE.image * want.abs().max().item()
            if name == "distortion":
                metric = self.case.settings.distortion is Distortion.PAPER
                bound = TOLERANCE.distortion * (self.want["distance"].max().item() ** 2 if metric else 1.0)
            assert torch.isfinite(got).all(), name
            assert ((got - want).abs() * self.decided).max() <= bound, name

    def check_gradients(self, *outputs: str) -> dict[str, Tensor]:
        """Derivatives of the randomly weighted ``outputs`` by every input; those of the oracle are returned."""
        results = []
        for images, inputs in ((self.want, self.exact), (self.got, self.inputs)):
            loss = sum((images[name] * self.weight[name].to(images[name])).sum() for name in outputs)
            gradients = torch.autograd.grad(loss, [*inputs.values()], retain_graph=True, allow_unused=True)
            results.append(
                {
                    name: torch.zeros_like(value) if gradient is None else gradient
                    for (name, value), gradient in zip(inputs.items(), gradients, strict=True)
                }
            )
        for name, want in results[0].items():
            check_gradient(name, results[1][name], want, self.exact[name])
        return results[0]


def check_gradient(name: str, got: Tensor, want: Tensor, value: Tensor) -> None:
    """One gradient, element by element and as a whole."""
    assert got.dtype == torch.float32
    assert got.shape == want.shape, name
    if want.numel() == 0:
        return
    assert torch.isfinite(got).all(), name
    scale = value.detach().item() if name == "f_mod_hz" else 1.0  # by the logarithm of the frequency
    want, error = want * scale, (got.cpu() - want) * scale
    scalar = name in SENSOR_SCALARS
    part = TOLERANCE.scalar if scalar else TOLERANCE.gradient
    assert error.abs().max() <= part * want.abs().max() + TOLERANCE.floor, name
    if not scalar:
        assert error.norm() <= TOLERANCE.gradient_norm * want.norm() + TOLERANCE.floor, name


def magnitude(name: str, gradient: Tensor, value: Tensor) -> float:
    """Largest element, in a unit in which every gradient of the cases is of the order of 1."""
    return (gradient.abs().max() * (value.detach().abs().max() if name == "f_mod_hz" else 1.0)).item()


@pytest.mark.parametrize("name", CASES)
def test_images_and_gradients_match_the_oracle(name, device):
    """All outputs together, with a random cotangent for every channel of every pixel, by all inputs."""
    comparison = Comparison(CASES[name](), device)
    comparison.check_images()
    gradients = comparison.check_gradients(*comparison.want)
    for key, gradient in gradients.items():
        if gradient.numel() and (name != "empty" or key.startswith("background")):
            assert magnitude(key, gradient, comparison.exact[key]) > 1e-2, f"{key}: a vanished gradient would pass"


@pytest.mark.parametrize("output", ["quads", "phasor", "colour", "distance", "opacity", "distortion", "extra"])
@pytest.mark.parametrize("name", FULL)
def test_each_output_alone_has_the_oracles_gradient(name, output, device):
    """One output at a time, so that none hides behind a larger one; inputs it cannot depend on get zero."""
    comparison = Comparison(CASES[name](), device)
    gradients = comparison.check_gradients(output)
    expected = {"mean", "log_scale", "quaternion", "opacity_logit"}
    expected |= {
        "quads": {"reflectivity_sh", "background.quads", *SENSOR_SCALARS},
        "phasor": {"reflectivity_sh", "background.phasor", "f_mod_hz", "phase_offset", "source_intensity"},
        "colour": {"colour_sh", "background.colour"},
        "extra": {"extra"},
    }.get(output, set())
    for key, gradient in gradients.items():
        if key in expected:
            assert magnitude(key, gradient, comparison.exact[key]) > 1e-2, key
        else:
            assert gradient.abs().max() == 0, key


SWITCHES = {
    "exclusive": ("saturated", {"stop": Stop.EXCLUSIVE}, "distance"),
    "exclusive_opaque": ("opaque", {"stop": Stop.EXCLUSIVE}, "distance"),
    "ellipse": ("tiles", {"support": Support.ALPHA}, "opacity"),
    "straight": ("saturated", {"clamp_gradient": ClampGradient.STRAIGHT}, None),
    "exact": ("released", {"clamp_gradient": ClampGradient.EXACT}, None),
    "zeta": ("opaque", {"distortion": Distortion.RELEASED, "near": 0.5, "far": 8.0}, "distortion"),
    "metres": ("released", {"distortion": Distortion.PAPER}, "distortion"),
    "single_phasor": ("translucent", {"phasor_factor": 1.0}, "phasor"),
    "degree_0": ("posed", {"sh_degree": 0}, "quads"),
    "degree_1": ("posed", {"sh_degree": 1}, "colour"),
    "degree_2": ("posed", {"sh_degree": 2}, "quads"),
    "slice": ("translucent", {"near": 2.0, "far": 3.5}, "opacity"),
}


@pytest.mark.parametrize("switch", SWITCHES)
def test_every_setting_matches_the_oracle(switch, device):
    """Each setting away from its default or from the released one, and it makes a difference."""
    name, change, changes = SWITCHES[switch]
    base = CASES[name]()
    case = replace(base, settings=replace(base.settings, **change))
    comparison = Comparison(case, device)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)
    if changes is not None:
        other = base.outputs(reference.rasterize, base.inputs(torch.float64))
        assert (other[changes] - comparison.want[changes]).abs().max() > 20 * TOLERANCE.image


def test_a_clamped_alpha_passes_a_gradient_only_straight_through(device):
    """Where alpha is clamped everywhere, opacity and position have no influence; the released code pretends they do."""
    field = gaussians(1, SMALL, seed=0, z=(2.0, 2.0), scale=(50.0, 60.0), opacity=(0.9999, 0.9999), spread=0.0)
    for clamp_gradient in ClampGradient:
        case = Case(field=field, camera=SMALL, settings=RenderSettings(clamp_gradient=clamp_gradient))
        inputs = case.inputs(torch.float32, device)
        opacity = case.outputs(api.rasterize, inputs)["opacity"]
        assert_close(opacity.detach().cpu(), torch.full((20, 24), 0.99), rtol=0, atol=1e-6)
        (gradient,) = torch.autograd.grad(opacity.sum(), inputs["opacity_logit"])
        if clamp_gradient is ClampGradient.EXACT:
            assert gradient.item() == 0
        else:
            assert gradient.item() == pytest.approx(480 * 0.9999 * 1e-4, rel=0.02)


def test_gradients_behind_a_surface_keep_their_digits(device):
    """Of Gaussians seen at T down to 1e-3, each gradient is good to 1e-3 of its own size, not only of the largest."""
    comparison = Comparison(CASES["behind_surface"](), device)
    for outputs in (("quads", "phasor"), ("distance", "colour")):
        for key in ("opacity_logit", "log_scale", "mean"):
            want, got = (
                torch.autograd.grad(
                    sum((images[name] * comparison.weight[name].to(images[name])).sum() for name in outputs),
                    inputs[key],
                    retain_graph=True,
                )[0].reshape(len(inputs["mean"]), -1)
                for images, inputs in (
                    (comparison.want, comparison.exact),
                    (comparison.got, comparison.inputs),
                )
            )
            size = want.norm(dim=1)
            error = (got.cpu() - want).norm(dim=1) / size
            assert size.max() > 20 * size[21:].median(), "the last ones must be small for this to mean something"
            assert error.median() < 1e-5, (outputs, key)
            assert error.max() < 1e-3, (outputs, key)


def test_finite_differences_of_the_kernel_itself(device):
    """Central differences in float32 along each gradient, where no jump is near: evidence without the oracle."""
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
            ahead, behind = (loss({**inputs, key: value + sign * step * direction}).item() for sign in (1, -1))
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
            torch.autograd.grad(sum((images[k] * weight[k]).sum() for k in images), tensors[key], retain_graph=True)[0]
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
    rotation = torch.from_numpy(other.camera.camera_from_world[:3, :3].T @ case.camera.camera_from_world[:3, :3])
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
        assert error < 5 * TOLERANCE.image * max(1.0, image.abs().max().item()), name  # another rounding of positions
    assert_close(by_moved.double(), by_mean.double() @ rotation.T, rtol=0, atol=2e-4 * by_mean.abs().max().item())
    assert (by_moved - by_mean).abs().max() > 0.1 * by_mean.abs().max(), "unturned gradients must not pass"


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
    background = Background(quads=torch.tensor(bg, device=device), phasor=torch.tensor(-bg, device=device))
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
    """Phase wraps at c/2f, 7.5 m; amplitude falls off with the square of the distance; decoding gives 2 m for both."""
    sensor = Sensor(f_mod_hz=SPEED_OF_LIGHT / 15.0, phase_offset=0.7)
    near, far = (api.rasterize(on_axis([d], 0.9, device), ODD, sensor).phasor[AXIS].cpu() for d in (2.0, 9.5))
    assert_close(far / far[2], near / near[2], rtol=1e-4, atol=1e-5)
    assert (near[2] / far[2]).item() == pytest.approx((9.5 / 2.0) ** 2, rel=1e-5)
    for phasor in (near, far):
        assert distance_from_phasor(phasor[0], phasor[1], sensor).item() == pytest.approx(2.0, abs=1e-4)


def test_opposite_quads_cancel_but_for_the_constant_part(device):
    """Q(0) + Q(pi) is the DC offset times twice the amplitude; Q(0) - Q(pi) is the phasor's real part."""
    case = replace(CASES["translucent"](), background=None)
    image = case.render(api.rasterize, case.inputs(torch.float32, device, grad=False))
    for i in (0, 2):
        assert_close(image.quads[i] + image.quads[i + 1], 0.3 * image.phasor[2], rtol=1e-5, atol=1e-6)
        assert_close(image.quads[i] - image.quads[i + 1], image.phasor[i // 2], rtol=1e-5, atol=1e-6)
    assert image.phasor[2].max() > 0.1


def test_early_stop_drops_or_adds_the_gaussian_that_crosses(device):
    """T is 0.5, 0.005, 5e-5: the third Gaussian is the crossing one; the fourth is never seen, and gets no gradient."""
    field = on_axis([1.0, 2.0, 3.0, 4.0], torch.tensor([0.5, 0.9999, 0.9999, 0.9]), device)
    third = {Stop.INCLUSIVE: 0.00495, Stop.EXCLUSIVE: 0.0}
    for stop, weight in third.items():
        extra = torch.eye(4, device=device).requires_grad_()
        image = api.rasterize(field, ODD, Sensor(), RenderSettings(stop=stop), extra=extra)
        want = torch.tensor([0.5, 0.495, weight, 0.0])
        assert_close(image.extra[AXIS].detach().cpu(), want, rtol=1e-4, atol=1e-7)
        assert image.distance[AXIS].item() == pytest.approx((want * torch.arange(1, 5)).sum().item(), rel=1e-5)
        (gradient,) = torch.autograd.grad(image.extra.sum(), extra)
        assert (gradient[3] == 0).all()
        assert (gradient[2, 2] > 0) == (stop is Stop.INCLUSIVE)


def test_culled_gaussians_have_zero_finite_gradients(device):
    """Behind, in the camera's plane, too far, off-screen or too faint: nothing is seen, nothing is learned."""
    field = gaussians(15, SMALL, seed=0)
    field.mean[:3, 2] *= -1
    field.mean[3:6, 2] = 0.0
    field.mean[6:9, 2] = 1e4
    field.mean[9:12, 0] = 50.0
    field.opacity_logit[12:] = -6.0
    case = Case(field=field, camera=SMALL, background=light(SMALL, 4, seed=0), extra=channels(field, 3))
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    for name in ("distance", "opacity", "distortion", "extra"):
        assert (images[name] == 0).all(), name
    for name in ("quads", "phasor", "colour"):
        assert_close(images[name], inputs[f"background.{name}"])
    gradients = torch.autograd.grad(sum(image.sum() for image in images.values()), [*inputs.values()])
    for name, gradient in zip(inputs, gradients, strict=True):
        assert (gradient == (1.0 if name.startswith("background") else 0.0)).all(), name


@st.composite
def scenes(draw) -> Case:
    """Any small scene: sizes, poses, densities, channels and shifts."""
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 30))
    camera = Camera.from_fov(max(width, height, 8), max(width, height, 8), draw(st.sampled_from([30.0, 60.0, 100.0])))
    camera = replace(camera, width=width, height=height, cx=width * draw(st.floats(0.2, 0.8)), cy=height / 2)
    case = Case(field=gaussians(0, camera, seed=0), camera=camera)
    low = draw(st.sampled_from([0.02, 0.1, 0.5]))
    faint = draw(st.sampled_from([0.01, 0.3, 0.9]))
    field = gaussians(
        draw(st.integers(1, 40)),
        camera,
        seed=draw(st.integers(0, 10**6)),
        scale=(low, 5 * low),
        opacity=(faint, min(0.9999, 3 * faint)),
        reflectivity=(-0.1, 0.9),
        spread=draw(st.sampled_from([0.5, 1.0, 2.0])),
        colour=draw(st.booleans()),
    )
    shifts = tuple(draw(st.lists(st.floats(-7.0, 7.0), min_size=1, max_size=6)))
    sensor = Sensor(shifts=shifts, f_mod_hz=draw(st.sampled_from([5e6, 2e7, 6e7])), dc_offset=draw(st.floats(0.0, 1.0)))
    extra = draw(st.sampled_from([None, 0, 1, 3, 6, 7]))
    case = replace(
        case,
        field=field,
        sensor=sensor,
        settings=replace(case.settings, sh_degree=draw(st.integers(0, 3)), stop=draw(st.sampled_from(Stop))),
        background=draw(st.sampled_from([None, light(camera, len(shifts), seed=3)])),
        extra=None if extra is None else channels(field, extra),
    )
    return moved_world(case, (0.5, 1.0, -0.3), draw(st.floats(-3.0, 3.0)), (0.3, -0.5, 0.2))


@pytest.mark.parametrize("device_name", DEVICES)
@profile(max_examples=25, deadline=None, derandomize=True, database=None)
@given(case=scenes())
def test_random_scenes_match_the_oracle(device_name, case):
    """Images and gradients of scenes nobody chose; pixels on a jump are left out."""
    undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
    assume(undecided.double().mean() <= UNDECIDED_SHARE)  # else: an image of a few pixels, one of them on a jump
    comparison = Comparison(case, device_name)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


def test_random_scenes_are_mostly_decided():
    """The assumption above is rare: of many scenes, fewer than one in ten has too many pixels on a jump."""
    left_out = []

    @profile(max_examples=40, deadline=None, derandomize=True, database=None)
    @given(case=scenes())
    def count(case):
        undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
        left_out.append(undecided.double().mean().item() > UNDECIDED_SHARE)

    count()
    assert sum(left_out) <= 0.1 * len(left_out)


def gradients_of(images: dict[str, Tensor], inputs: dict[str, Tensor], seed: int = 0, **options) -> dict[str, Tensor]:
    """Gradients of randomly weighted images by all inputs that need them."""
    decided_everywhere = torch.zeros(images["opacity"].shape, dtype=torch.bool)
    weight = cotangents(images, decided_everywhere, seed)
    wanted = {name: value for name, value in inputs.items() if value.requires_grad}
    loss = sum((images[name] * weight[name]).sum() for name in images)
    return dict(zip(wanted, torch.autograd.grad(loss, [*wanted.values()], **options), strict=True))


def same(got: dict[str, Tensor], want: dict[str, Tensor], exact: bool) -> None:
    """Equal gradients: to the bit on the CPU; on CUDA atomics add in any order."""
    assert got.keys() == want.keys()
    for name, value in want.items():
        if exact:
            assert torch.equal(got[name], value), name
        else:
            assert_close(got[name], value, rtol=1e-4, atol=1e-5 * value.abs().max().item() + 1e-12)


def test_two_forwards_before_one_backward(device):
    """A rendering keeps what its backward pass needs, whatever is rendered in between."""
    case, other = CASES["translucent"](), CASES["opaque"]()
    inputs, others = case.inputs(torch.float32, device), other.inputs(torch.float32, device)
    want = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    first = case.outputs(api.rasterize, inputs)
    second = other.outputs(api.rasterize, others)
    kept = {name: image.detach().clone() for name, image in first.items()}
    gradients_of(second, others)
    same(gradients_of(first, inputs), want, exact=device == "cpu")
    for name, image in first.items():
        assert torch.equal(image.detach(), kept[name]), name


def test_one_graph_can_be_differentiated_twice(device):
    """With retain_graph, a second backward pass gives the same; another cotangent, another gradient."""
    case = CASES["saturated"]()
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    first = gradients_of(images, inputs, retain_graph=True)
    other = gradients_of(images, inputs, seed=1, retain_graph=True)
    same(gradients_of(images, inputs), first, exact=device == "cpu")
    assert not torch.equal(other["mean"], first["mean"])


def test_gradients_accumulate_in_leaves(device):
    """Two calls of backward() add up in .grad, as torch promises."""
    case = CASES["single"]()
    inputs = case.inputs(torch.float32, device)
    for _ in range(2):
        case.outputs(api.rasterize, inputs)["quads"].square().sum().backward()
    twice = inputs["mean"].grad.clone()
    inputs["mean"].grad = None
    case.outputs(api.rasterize, inputs)["quads"].square().sum().backward()
    assert twice.abs().max() > 1e-3
    assert_close(twice, 2 * inputs["mean"].grad, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["posed", "opaque"])
def test_threads_change_sums_by_rounding_only(name):
    """On the CPU the images of one, two and five threads are the same to the bit; gradients are to rounding."""
    results = []
    for threads in (1, 2, 5):
        case = CASES[name]()
        case = replace(case, settings=replace(case.settings, threads=threads))
        inputs = case.inputs(torch.float32)
        images = case.outputs(api.rasterize, inputs)
        results.append(({k: v.detach().clone() for k, v in images.items()}, gradients_of(images, inputs)))
    for images, gradients in results[1:]:
        same(images, results[0][0], exact=True)
        same(gradients, results[0][1], exact=False)


def test_same_call_same_bytes():
    """On the CPU a rendering and its gradients can be repeated to the bit."""
    case = CASES["posed"]()
    results = []
    for _ in range(2):
        inputs = case.inputs(torch.float32)
        images = case.outputs(api.rasterize, inputs)
        results.append({**images, **{f"grad {k}": v for k, v in gradients_of(images, inputs).items()}})
    same(results[1], results[0], exact=True)


@pytest.mark.parametrize("wanted", [("mean",), ("colour_sh",), ("background.quads",), ("f_mod_hz",), ("extra", "mean")])
def test_a_gradient_may_be_wanted_of_some_inputs_only(wanted, device):
    """The same numbers as when all are wanted."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    want = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    inputs = case.inputs(torch.float32, device, grad=False)
    for name in wanted:
        inputs[name].requires_grad_()
    got = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    same(got, {name: want[name] for name in wanted}, exact=device == "cpu")


def test_without_gradients_nothing_is_recorded(device):
    """Frozen inputs or no_grad: the same images, without a graph."""
    case = CASES["translucent"]()
    want = case.outputs(api.rasterize, case.inputs(torch.float32, device))
    frozen = case.outputs(api.rasterize, case.inputs(torch.float32, device, grad=False))
    with torch.no_grad():
        quiet = case.outputs(api.rasterize, case.inputs(torch.float32, device))
    for name, image in want.items():
        assert image.requires_grad
        assert not frozen[name].requires_grad
        assert not quiet[name].requires_grad
        assert torch.equal(frozen[name], image)
        assert torch.equal(quiet[name], image)


def test_strided_inputs_and_cotangents_are_welcome(device):
    """Views of larger tensors, transposed ones and expanded ones give what their copies give."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    want = gradients_of(images, inputs)
    strided = {}
    for name, value in inputs.items():
        if value.ndim:
            holder = torch.zeros(*value.shape[:-1], 2 * value.shape[-1], device=device)
            holder[..., ::2] = value.detach()
            strided[name] = holder[..., ::2].requires_grad_()
            assert not strided[name].is_contiguous() or value.shape[-1] == 1
        else:
            strided[name] = value
    got = case.outputs(api.rasterize, strided)
    for name, image in images.items():
        assert torch.equal(got[name], image), name
    same(gradients_of(got, strided), want, exact=device == "cpu")

    fresh = case.outputs(api.rasterize, inputs)
    weight = torch.randn(24, 20, generator=torch.Generator().manual_seed(0)).to(device).T
    (loose,) = torch.autograd.grad(fresh["distance"], inputs["mean"], weight, retain_graph=True)
    (tight,) = torch.autograd.grad(fresh["distance"], inputs["mean"], weight.contiguous(), retain_graph=True)
    (spread,) = torch.autograd.grad(fresh["opacity"].sum(), inputs["mean"])  # an expanded cotangent
    assert_close(loose, tight, rtol=1e-5, atol=1e-6)
    assert spread.abs().max() > 0.1


@pytest.mark.parametrize("kind", ["number", "channel", "image"])
def test_backgrounds_broadcast(kind, device):
    """A number, one value per channel or an image: the same light, and the gradient of the given shape."""
    case = CASES["translucent"]()
    shape = {"number": (), "channel": (4, 1, 1), "image": (4, 20, 24)}[kind]
    value = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    inputs = case.inputs(torch.float32, device, grad=False)
    quads = [
        replace(case, background=Background(quads=light)).render(
            api.rasterize, {**{k: v for k, v in inputs.items() if "." not in k}, "background.quads": light}
        )
        for light in (value, value.detach().expand(4, 20, 24).contiguous())
    ]
    assert_close(quads[0].quads, quads[1].quads)
    weight = torch.randn(4, 20, 24, generator=torch.Generator().manual_seed(1)).to(device)
    (gradient,) = torch.autograd.grad(quads[0].quads, value, weight)
    want = (weight * (1 - quads[0].opacity)).sum_to_size(shape)
    assert_close(gradient, want, rtol=1e-4, atol=1e-4)
    assert gradient.abs().max() > 0.5


@pytest.mark.parametrize("name", [*FULL, "saturated", "opaque", "empty"])
def test_screen_gradients_and_pixel_counts(name, device):
    """What densification looks at, against the oracle; zero before the backward pass."""
    case = CASES[name]()
    undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
    found = []
    for rasterize, inputs in (
        (reference.rasterize, case.inputs(torch.float64)),
        (api.rasterize, case.inputs(torch.float32, device)),
    ):
        rendering: Rendering = case.render(rasterize, inputs, screen_gradient=True)
        assert rendering.screen.gradient.shape == (len(case.field), 2)
        assert rendering.screen.pixels.shape == (len(case.field),)
        assert not rendering.screen.gradient.any()
        assert not rendering.screen.pixels.any()
        quads, distance = rendering.quads, rendering.distance
        weight = cotangents({"quads": quads, "distance": distance}, undecided)
        ((quads * weight["quads"]).sum() + (distance * weight["distance"]).sum()).backward()
        assert not rendering.screen.gradient.requires_grad
        found.append(rendering.screen)
    want, got = found
    if name == "empty":
        return
    scale = want.gradient.abs().max().item()
    assert scale > 1e-2
    assert (got.gradient.cpu() - want.gradient).abs().max() <= TOLERANCE.gradient * scale
    assert want.pixels.max() > 20
    assert ((got.pixels.cpu() - want.pixels).abs() <= undecided.sum()).all()


def test_screen_gradient_is_that_of_the_principal_point(device):
    """Moving the principal point moves all image positions alike: the sum of the screen gradients is its derivative."""
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
    together = replace(case, sensor=case.sensor.with_shifts(shifts)).render(api.rasterize, inputs).quads
    for quad, shift in zip(together, shifts, strict=True):
        alone = replace(case, sensor=case.sensor.with_shifts((shift,))).render(api.rasterize, inputs).quads
        assert_close(quad, alone[0], rtol=1e-6, atol=1e-7)
    assert torch.equal(together[1], together[3])


def test_sensor_numbers_and_tensors_agree(device):
    """A sensor of plain numbers renders what one of 0-d tensors renders."""
    case = CASES["posed"]()
    inputs = case.inputs(torch.float32, device, grad=False)
    numbers = {name: value for name, value in inputs.items() if name not in SENSOR_SCALARS}
    want, got = case.render(api.rasterize, inputs), case.render(api.rasterize, numbers)
    assert_close(got.quads, want.quads, rtol=1e-5, atol=1e-6)
    assert_close(got.phasor, want.phasor, rtol=1e-5, atol=1e-6)


def test_reserved_pairs_change_nothing(device):
    """With room reserved in advance the host need not wait, and the images are the same to the bit."""
    case = CASES["posed"]()
    inputs = case.inputs(torch.float32, device)
    want = case.outputs(api.rasterize, inputs)
    case = replace(case, settings=replace(case.settings, pair_capacity=20_000))
    got = case.outputs(api.rasterize, inputs)
    for name, image in want.items():
        assert torch.equal(got[name], image), name
    assert gradients_of(got, inputs)["mean"].abs().max() > 1


@pytest.mark.contract
@pytest.mark.parametrize("name", ["mean", "opacity_logit", "colour_sh", "extra"])
def test_wrong_dtype_is_named(name, device):
    """The error says which tensor, what it is, and what it must be."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    inputs[name] = inputs[name].detach().double()
    with pytest.raises(ValueError, match=rf"{name} is torch.float64.* must be float32"):
        case.render(api.rasterize, inputs)


@pytest.mark.contract
def test_wrong_device_is_named(device):
    """Likewise for a tensor that lives elsewhere."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    inputs["quaternion"] = inputs["quaternion"].detach().to("meta")
    with pytest.raises(ValueError, match=rf"quaternion .*meta.* {device}"):
        case.render(api.rasterize, inputs)


@pytest.mark.contract
def test_wrong_shapes_are_named(device):
    """Extra channels for another number of Gaussians, a background of another size."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    with pytest.raises(ValueError, match=r"extra \(39, 3\).* 40"):
        case.render(api.rasterize, {**inputs, "extra": inputs["extra"][1:].detach()})
    with pytest.raises(ValueError, match=r"background.colour \(3, 20, 23\).*\(3, 20, 24\)"):
        case.render(api.rasterize, {**inputs, "background.colour": inputs["background.colour"][..., 1:].detach()})
