"""Renderings that leave out what nobody asked for, and extra images that hold the weights fixed."""

import math
from dataclasses import replace

import pytest
import torch
from cases import CASES, SENSOR_SCALARS, cotangents
from comparison import DEVICES
from torch.testing import assert_close

from gftorf_warp.render import api, buffers, reference
from gftorf_warp.render.inputs import CHOICES

ALWAYS = ("colour", "extra")
MAPPINGS = [(device, "own") for device in DEVICES] + [("cpu", "cuda")]  # device, whose tiles


@pytest.fixture(params=MAPPINGS, ids="-".join)
def device(request, monkeypatch) -> str:
    """Where the kernels run; the mapping of CUDA runs on the CPU, too."""
    where, mapping = request.param
    if mapping != "own":
        monkeypatch.setitem(buffers.TILE_SHAPES, where, buffers.TILE_SHAPES[mapping])
        monkeypatch.setitem(buffers.SEGMENTS, where, 4)
        # then two groups of channels share a pass
        monkeypatch.setattr(buffers, "available_threads", lambda: 1)
    return where


def rendered(case, device, rasterize=api.rasterize, dtype=torch.float32, **options):
    """Return the inputs and the images of a case."""
    inputs = case.inputs(dtype, device)
    return inputs, case.outputs(rasterize, inputs, **options)


def gradients(inputs, images, names, seed=0):
    """Return gradients by all inputs, under random derivatives of the named images."""
    nothing = torch.zeros(next(iter(images.values())).shape[-2:], dtype=torch.bool)
    seeds = cotangents({name: images[name] for name in names}, nothing, seed)
    total = sum((images[name] * seeds[name].to(images[name])).sum() for name in names)
    found = torch.autograd.grad(
        total, list(inputs.values()), allow_unused=True, materialize_grads=True
    )
    return dict(zip(inputs, found, strict=True))


def check(got, want, tolerance=2e-5):
    """Compare gradients, each as a part of its largest element."""
    for name, value in want.items():
        scale = float(value.abs().max()) if value.numel() else 0.0
        assert_close(got[name].to(value), value, rtol=0, atol=tolerance * scale + 1e-7, msg=name)


@pytest.mark.parametrize(
    "wanted", [("quads",), ("phasor", "opacity"), ("quads", "distance"), ("distortion",), ()]
)
@pytest.mark.parametrize("name", ["posed", "released"])
def test_what_is_left_out_changes_nothing_else(name, wanted, device):
    """Images that were asked for, and their gradients, are those of a full rendering;
    the others have no elements.
    """
    case = CASES[name]()
    full_inputs, full = rendered(case, device)
    inputs, images = rendered(case, device, images=wanted)
    kept = [key for key in full if key in wanted or key in ALWAYS]
    assert kept
    for key, image in images.items():
        if key in kept:
            assert_close(image, full[key], rtol=1e-6, atol=1e-6)
        else:
            assert image.numel() == 0
            assert image.ndim == full[key].ndim
    want = gradients(full_inputs, full, kept)
    check(gradients(inputs, images, kept), want)
    assert want["mean"].abs().max() > 1e-2


def test_the_oracle_leaves_out_the_same():
    """Shapes of images that nobody asked for are those of the kernels."""
    case = CASES["posed"]()
    got, want = (
        rendered(case, "cpu", rasterize, images=("opacity",))[1]
        for rasterize in (api.rasterize, reference.rasterize)
    )
    assert {name: image.shape for name, image in got.items()} == {
        name: image.shape for name, image in want.items()
    }


@pytest.mark.parametrize(
    "rasterize", [api.rasterize, reference.rasterize], ids=["kernels", "oracle"]
)
def test_an_image_that_does_not_exist_is_named(rasterize):
    """A typo must not silently leave out an image."""
    with pytest.raises(ValueError, match=r"'depth'.*quads, phasor, distance, opacity, distortion"):
        rendered(CASES["posed"](), "cpu", rasterize, images=("depth",))


def with_extra(coloured):
    """Return a case with six extra channels, which ride with the light unless there is colour."""
    case = CASES["posed"]()
    extra = torch.randn(len(case.field), 6, generator=torch.Generator().manual_seed(4))
    field = case.field if coloured else replace(case.field, colour_sh=None)
    return replace(case, field=field, extra=extra)


def names_in(images):
    """Return every image that has elements."""
    return [name for name in (*CHOICES, *ALWAYS) if name in images]


@pytest.mark.parametrize("coloured", [False, True])
def test_detached_extra_equals_a_second_rendering_of_a_detached_field(coloured, device):
    """One rendering gives the images and the gradients of two: of the field,
    and of its detached twin with channels.
    """
    case = with_extra(coloured)
    inputs, images = rendered(case, device, extra_detached=True)
    got = gradients(inputs, images, names_in(images))

    twins = case.inputs(torch.float32, device)
    alone = case.outputs(api.rasterize, {name: t for name, t in twins.items() if name != "extra"})
    fixed = {name: t if name == "extra" else t.detach() for name, t in twins.items()}
    second = case.outputs(api.rasterize, fixed)["extra"]
    both = {**alone, "extra": second}
    for name, image in images.items():
        assert_close(image, both[name], rtol=1e-6, atol=1e-6)
    want = gradients(twins, both, names_in(both))
    check(got, want)
    assert want["extra"].abs().max() > 0.1
    attached, whole = rendered(case, device)
    difference = gradients(attached, whole, names_in(whole))["mean"] - got["mean"]
    assert difference.abs().max() > 0.01 * got["mean"].abs().max(), "attached weights would pass"


@pytest.mark.parametrize("coloured", [False, True])
def test_detached_extra_matches_the_oracle(coloured, device):
    """Under derivatives of all images, and of the extra ones alone:
    then nothing but the channels has a gradient.
    """
    case = with_extra(coloured)
    inputs, images = rendered(case, device, extra_detached=True)
    exact, oracle = rendered(case, "cpu", reference.rasterize, torch.float64, extra_detached=True)
    wrong = reference.undecided_pixels(case.field, case.camera, case.settings)
    assert wrong.sum() == 0, "choose a case that float32 decides alike"
    want = gradients(exact, oracle, names_in(oracle))
    check(gradients(*rendered(case, device, extra_detached=True), names_in(images)), want, 1e-4)
    only = gradients(inputs, images, ["extra"])
    check(
        only,
        gradients(*rendered(case, "cpu", reference.rasterize, torch.float64), ["extra"])
        | {name: torch.zeros_like(tensor) for name, tensor in exact.items() if name != "extra"},
    )


@pytest.mark.parametrize("coloured", [False, True])
def test_detached_extra_leaves_screen_gradients_alone(coloured, device):
    """Densification hears of the light and nothing of the extra images."""
    case = with_extra(coloured)
    screens = []
    for weight in (0.0, 1.0):
        inputs = case.inputs(torch.float32, device)
        rendering = case.render(api.rasterize, inputs, extra_detached=True, screen_gradient=True)
        (rendering.quads.sum() + weight * rendering.extra.square().sum()).backward()
        screens.append(rendering.screen)
    assert screens[0].gradient.abs().max() > 1e-3
    assert_close(screens[1].gradient, screens[0].gradient, rtol=1e-5, atol=1e-5)
    assert_close(screens[1].pixels, screens[0].pixels, rtol=0, atol=0)


@pytest.mark.parametrize("detached", [False, True])
def test_ordered_sums_are_the_sums(detached, device):
    """Pairs with records of their own give the same images and, to rounding, gradients;
    twice the same to the bit.
    """
    case = with_extra(True)
    inputs, images = rendered(case, device, extra_detached=detached)
    want = gradients(inputs, images, names_in(images))
    ordered = replace(case, settings=replace(case.settings, deterministic=True))
    twice = []
    for _ in range(2):
        found, seen = rendered(ordered, device, extra_detached=detached)
        for name, image in images.items():
            assert_close(seen[name], image, rtol=0, atol=0, msg=name)
        twice.append(gradients(found, seen, names_in(seen)))
    check(twice[0], want)
    for name, value in twice[0].items():
        if name not in SENSOR_SCALARS:  # those are sums over all Gaussians, by atomic additions
            assert torch.equal(value, twice[1][name]), name


def test_ordered_sums_need_no_count_of_pairs(device):
    """With a reserve, as in a captured step: what lies behind the last pair is never read."""
    case = with_extra(False)
    inputs, images = rendered(case, device)
    want = gradients(inputs, images, names_in(images))
    reserved = replace(case.settings, deterministic=True, pair_capacity=60_000)
    found, seen = rendered(replace(case, settings=reserved), device, workspace=buffers.Workspace())
    check(gradients(found, seen, names_in(seen)), want)


@pytest.mark.parametrize("value", [0.0, -0.1, float("nan"), float("inf")])
def test_a_low_pass_filter_without_width_is_refused(value):
    """Of no variance a splat may fall between pixels."""
    with pytest.raises(ValueError, match=f"low_pass must be above 0 and finite, got {value}"):
        buffers.RenderSettings(low_pass=value)
    assert buffers.RenderSettings().low_pass == 0.3


@pytest.mark.parametrize(
    "change", [{"phasor_factor": math.nan}, {"phasor_factor": -math.inf}, {"pair_capacity": -1}]
)
def test_settings_without_a_meaning_are_refused(change):
    """By the name of the setting and the value."""
    ((name, value),) = change.items()
    with pytest.raises(ValueError, match=f"{name} must be .*, got {value}"):
        buffers.RenderSettings(**change)
