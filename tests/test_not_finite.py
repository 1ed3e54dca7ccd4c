"""Parameters that are NaN or infinite are refused, or visible in the images: never hidden."""

from dataclasses import replace

import pytest
import torch
from cases import CASES
from comparison import DEVICES

from gftorf_warp.render import api, buffers
from gftorf_warp.render.buffers import SplatDistance

CASE = CASES["tiles"]()
ROOM_FOR_PAIRS = 100_000
NOWHERE = ("mean", "log_scale", "quaternion", "opacity_logit")  # without them nothing has a place


@pytest.fixture(params=[*DEVICES, "tiles of CUDA"])
def device(request, monkeypatch) -> str:
    """Where the kernels run; the mapping of CUDA runs on the CPU, too."""
    if request.param in DEVICES:
        return request.param
    monkeypatch.setitem(buffers.TILE_SHAPES, "cpu", buffers.TILE_SHAPES["cuda"])
    return "cpu"


def spoiled(name, value, device="cpu"):
    """Return the field of a case with one number of one Gaussian replaced."""
    field = CASE.field.map(lambda tensor: tensor.clone().to(device))
    getattr(field, name).view(len(field), -1)[3, -1] = value
    return field


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", list(CASE.field.parameters()))
def test_a_field_that_is_not_finite_is_refused_by_name(name, value):
    """The message names the tensor, the Gaussian and the number."""
    with pytest.raises(ValueError, match=rf"{name} of Gaussian 3 is not finite: {value:g}"):
        api.rasterize(spoiled(name, value), CASE.camera, CASE.sensor, CASE.settings)


def test_large_numbers_are_not_taken_for_infinite_ones():
    """The sum of a tensor overflows, none of its elements did."""
    field = spoiled("colour_sh", 3e38)
    field.colour_sh[4:6] = 3e38
    field.check_finite()


@pytest.mark.parametrize("splat_distance", list(SplatDistance))
@pytest.mark.parametrize("capacity", [ROOM_FOR_PAIRS, None])
@pytest.mark.parametrize("name", NOWHERE)
def test_a_gaussian_without_a_place_makes_every_pixel_nan(name, capacity, splat_distance, device):
    """In one of many renderings an image is NaN instead of finite and wrong."""
    settings = replace(CASE.settings, pair_capacity=capacity, splat_distance=splat_distance)
    workspace = None if capacity else buffers.Workspace()
    field = spoiled(name, float("nan"), device)
    rendering = api.rasterize(field, CASE.camera, CASE.sensor, settings, workspace=workspace)
    for image in ("quads", "phasor", "colour", "distance", "distortion"):
        assert getattr(rendering, image).isnan().all(), image


@pytest.mark.parametrize(
    ("name", "images"), [("reflectivity_sh", ("quads", "phasor")), ("colour_sh", ("colour",))]
)
def test_light_that_is_nan_is_nan_where_it_is(name, images, device):
    """Not black, not zero; other pixels and images stay as they were, the gradient is NaN."""
    settings = replace(CASE.settings, pair_capacity=ROOM_FOR_PAIRS)
    whole = CASE.field.map(lambda tensor: tensor.to(device))
    field = spoiled(name, float("nan"), device)
    getattr(field, name).requires_grad_()
    rendering = api.rasterize(field, CASE.camera, CASE.sensor, settings)
    right = api.rasterize(whole, CASE.camera, CASE.sensor, settings)
    assert torch.equal(rendering.distance, right.distance)
    for image in images:
        found, wanted = getattr(rendering, image), getattr(right, image)
        bad = found.isnan()
        assert 0 < bad.sum() < bad.numel()
        assert torch.equal(found[~bad], wanted[~bad])
    getattr(rendering, images[0]).square().sum().backward()
    assert getattr(field, name).grad[3].isnan().any()


@pytest.mark.parametrize("logit", [-88.0, -89.0, -200.0, 200.0])
def test_gradient_of_an_extreme_opacity_is_zero(logit, device):
    """The exponential in the derivative of the sigmoid overflows below -88.7."""
    field = spoiled("opacity_logit", logit, device)
    field.opacity_logit.requires_grad_()
    rendering = api.rasterize(field, CASE.camera, CASE.sensor, CASE.settings)
    rendering.quads.sum().backward()
    assert field.opacity_logit.grad.isfinite().all()
    assert field.opacity_logit.grad[3] == 0.0
    assert field.opacity_logit.grad.any()
