"""The kernels against the float64 oracle: every output, every input, every setting,
and scenes nobody chose.
"""

from dataclasses import replace

import pytest
import torch
from cases import (
    CASES,
    SENSOR_SCALARS,
    SMALL,
    UNDECIDED_SHARE,
    Case,
    channels,
    cotangents,
    gaussians,
    light,
    moved_world,
)
from comparison import DEVICES, FULL, TOLERANCE, Comparison, magnitude
from hypothesis import assume, given
from hypothesis import settings as profile
from hypothesis import strategies as st
from torch.testing import assert_close

from gftorf_warp.render import api, buffers, reference
from gftorf_warp.render.api import Rendering
from gftorf_warp.render.buffers import (
    ClampGradient,
    Distortion,
    RenderSettings,
    SplatDistance,
    Stop,
    Support,
)
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


@pytest.mark.parametrize("name", CASES)
def test_images_and_gradients_match_the_oracle(name, device):
    """All outputs together, with a random cotangent for every channel of every pixel,
    by all inputs.
    """
    comparison = Comparison(CASES[name](), device)
    comparison.check_images()
    gradients = comparison.check_gradients(*comparison.want)
    for key, gradient in gradients.items():
        if gradient.numel() and (name != "empty" or key.startswith("background")):
            assert magnitude(key, gradient, comparison.exact[key]) > 1e-2, (
                f"{key}: a vanished gradient would pass"
            )


@pytest.mark.parametrize(
    "output", ["quads", "phasor", "colour", "distance", "opacity", "distortion", "extra"]
)
@pytest.mark.parametrize("name", FULL)
def test_each_output_alone_has_the_oracles_gradient(name, output, device):
    """One output at a time, so that none hides behind a larger one;
    inputs it cannot depend on get zero.
    """
    comparison = Comparison(CASES[name](), device)
    gradients = comparison.check_gradients(output)
    expected = {"mean", "log_scale", "quaternion", "opacity_logit"}
    expected |= {
        "quads": {"reflectivity_sh", "background.quads", *SENSOR_SCALARS},
        "phasor": {
            "reflectivity_sh",
            "background.phasor",
            "f_mod_hz",
            "phase_offset",
            "source_intensity",
        },
        "colour": {"colour_sh", "background.colour"},
        "extra": {"extra"},
    }.get(output, set())
    for key, gradient in gradients.items():
        if key in expected:
            assert magnitude(key, gradient, comparison.exact[key]) > 1e-2, key
        else:
            assert gradient.abs().max() == 0, key


@pytest.mark.parametrize("name", ["posed", "opaque", "released", "sloped"])
def test_the_cuda_mapping_is_right_on_the_cpu_too(name, monkeypatch):
    """One pixel per thread and tiles of 8 x 4, what CUDA compiles but for the warp shuffles,
    against the oracle.
    """
    monkeypatch.setitem(buffers.TILE_SHAPES, "cpu", buffers.TILE_SHAPES["cuda"])
    monkeypatch.setitem(buffers.SEGMENTS, "cpu", 4)
    comparison = Comparison(CASES[name](), "cpu")
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


SWITCHES = {
    "exclusive": ("saturated", {"stop": Stop.EXCLUSIVE}, "distance"),
    "exclusive_opaque": ("opaque", {"stop": Stop.EXCLUSIVE}, "distance"),
    "ellipse": ("tiles", {"support": Support.ALPHA}, "opacity"),
    "straight": ("saturated", {"clamp_gradient": ClampGradient.STRAIGHT}, None),
    "exact": ("released", {"clamp_gradient": ClampGradient.EXACT}, None),
    "zeta": ("opaque", {"distortion": Distortion.RELEASED, "near": 0.5, "far": 8.0}, "distortion"),
    "metres": ("released", {"distortion": Distortion.PAPER}, "distortion"),
    "plane": ("translucent", {"splat_distance": SplatDistance.PLANE}, "distance"),
    "centre": ("sloped", {"splat_distance": SplatDistance.CENTRE}, "quads"),
    "single_phasor": ("translucent", {"phasor_factor": 1.0}, "phasor"),
    "degree_0": ("posed", {"sh_degree": 0}, "quads"),
    "degree_1": ("posed", {"sh_degree": 1}, "colour"),
    "degree_2": ("posed", {"sh_degree": 2}, "quads"),
    "slice": ("translucent", {"near": 2.0, "far": 3.5}, "opacity"),
    "low_pass": ("needles", {"low_pass": 0.1}, "opacity"),
    "low_pass_lens": ("distorted", {"low_pass": 0.1}, "opacity"),
    "low_pass_plane": ("sloped", {"low_pass": 0.1}, "distance"),
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
    """Where alpha is clamped everywhere, opacity and position have no influence;
    the released code pretends they do.
    """
    field = gaussians(
        1, SMALL, seed=0, z=(2.0, 2.0), scale=(50.0, 60.0), opacity=(0.9999, 0.9999), spread=0.0
    )
    for clamp_gradient in ClampGradient:
        case = Case(
            field=field, camera=SMALL, settings=RenderSettings(clamp_gradient=clamp_gradient)
        )
        inputs = case.inputs(torch.float32, device)
        opacity = case.outputs(api.rasterize, inputs)["opacity"]
        assert_close(opacity.detach().cpu(), torch.full((20, 24), 0.99), rtol=0, atol=1e-6)
        (gradient,) = torch.autograd.grad(opacity.sum(), inputs["opacity_logit"])
        if clamp_gradient is ClampGradient.EXACT:
            assert gradient.item() == 0
        else:
            assert gradient.item() == pytest.approx(480 * 0.9999 * 1e-4, rel=0.02)


def test_gradients_behind_a_surface_keep_their_digits(device):
    """Of Gaussians seen at T down to 1e-3, each gradient is good to 1e-3 of its own size,
    not only of the largest.
    """
    comparison = Comparison(CASES["behind_surface"](), device)
    for outputs in (("quads", "phasor"), ("distance", "colour")):
        for key in ("opacity_logit", "log_scale", "mean"):
            want, got = (
                torch.autograd.grad(
                    sum(
                        (images[name] * comparison.weight[name].to(images[name])).sum()
                        for name in outputs
                    ),
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
            assert size.max() > 20 * size[21:].median(), (
                "the last ones must be small for this to mean something"
            )
            assert error.median() < 1e-5, (outputs, key)
            assert error.max() < 1e-3, (outputs, key)


@st.composite
def scenes(draw) -> Case:
    """Any small scene: sizes, poses, densities, channels and shifts."""
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 30))
    camera = Camera.from_fov(
        max(width, height, 8), max(width, height, 8), draw(st.sampled_from([30.0, 60.0, 100.0]))
    )
    camera = replace(
        camera, width=width, height=height, cx=width * draw(st.floats(0.2, 0.8)), cy=height / 2
    )
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
    sensor = Sensor(
        shifts=shifts,
        f_mod_hz=draw(st.sampled_from([5e6, 2e7, 6e7])),
        dc_offset=draw(st.floats(0.0, 1.0)),
    )
    extra = draw(st.sampled_from([None, 0, 1, 3, 6, 7]))
    case = replace(
        case,
        field=field,
        sensor=sensor,
        settings=replace(
            case.settings, sh_degree=draw(st.integers(0, 3)), stop=draw(st.sampled_from(Stop))
        ),
        background=draw(st.sampled_from([None, light(camera, len(shifts), seed=3)])),
        extra=None if extra is None else channels(field, extra),
    )
    return moved_world(case, (0.5, 1.0, -0.3), draw(st.floats(-3.0, 3.0)), (0.3, -0.5, 0.2))


@pytest.mark.parametrize("device_name", DEVICES)
@profile(max_examples=60, deadline=None, derandomize=True, database=None)
@given(case=scenes())
def test_random_scenes_match_the_oracle(device_name, case):
    """Images and gradients of scenes nobody chose; pixels on a jump are left out."""
    undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
    # else: an image of a few pixels, one of them on a jump
    assume(undecided.double().mean() <= UNDECIDED_SHARE)
    comparison = Comparison(case, device_name)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


def test_random_scenes_are_mostly_decided():
    """The assumption above is rare: of many scenes, fewer than one in ten has too many pixels on a
    jump.
    """
    left_out = []

    @profile(max_examples=40, deadline=None, derandomize=True, database=None)
    @given(case=scenes())
    def count(case):
        undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
        left_out.append(undecided.double().mean().item() > UNDECIDED_SHARE)

    count()
    assert sum(left_out) <= 0.1 * len(left_out)


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
    assert want.weight.max() > 5
    margin = 1e-4 * want.weight.max() + undecided.sum() / 255
    assert ((got.weight.cpu() - want.weight).abs() <= margin).all()
