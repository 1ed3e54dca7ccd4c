"""Lists of tiles walked back in parts: the gradients of one walk, for lists of any length,
wherever pixels end.
"""

from dataclasses import replace

import pytest
import torch
from comparison import TOLERANCE

from gftorf_warp.kernels.rasterise import list_segments
from gftorf_warp.kernels.rasterise.shared_batches import ROUND
from gftorf_warp.render import api, buffers, reference
from gftorf_warp.render.buffers import RenderSettings, Stop, Workspace
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor

WIDTH, HEIGHT = 13, 9  # tiles of 8 x 4: five of six stick out of the image
CAMERA = Camera.from_fov(WIDTH, HEIGHT, 60.0)
SENSOR = Sensor(shifts=(0.3,), phase_offset=0.2, dc_offset=0.4, source_intensity=1.3)
IMAGES = ("quads", "distance", "opacity")
WHERE = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]


@pytest.fixture(params=WHERE)
def device(request, monkeypatch) -> str:
    """On a CPU by the mapping of CUDA."""
    if request.param == "cpu":
        monkeypatch.setitem(buffers.TILE_SHAPES, "cpu", buffers.TILE_SHAPES["cuda"])
    return request.param


def scene(count, opacity, device, dtype=torch.float32):
    """Gaussians one behind the other, that all pixels or some of them see."""
    generator = torch.Generator().manual_seed(count)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = 1.0 + 4.0 * draw(count)
    mean = torch.stack([z * (0.9 * draw(count) - 0.45), z * (0.6 * draw(count) - 0.3), z], 1)
    logit = torch.logit(torch.full((count,), opacity, dtype=torch.float64)) + draw(count)
    field = GaussianField(
        mean=mean,
        log_scale=(0.05 + 0.5 * draw(count, 3)).log(),
        quaternion=draw(count, 4) + 0.1,
        opacity_logit=logit,
        reflectivity_sh=constant_sh(0.3 + draw(count)),
    )
    return field.map(lambda value: value.to(device, dtype).requires_grad_())


def outcome(rasterize, field, settings, extra=None):
    """Images, and gradients of all tensors under random derivatives."""
    workspace = Workspace()
    channels = None if extra is None else extra.to(field.mean)
    rendering = rasterize(
        field,
        CAMERA,
        SENSOR,
        settings,
        images=IMAGES,
        extra=channels,
        extra_detached=True,
        screen_gradient=True,
        workspace=workspace,
    )
    found = {name: getattr(rendering, name) for name in IMAGES}
    if extra is not None:
        found["extra"] = rendering.extra
    generator = torch.Generator().manual_seed(1)
    total = sum(
        (image * torch.rand(image.shape, generator=generator).to(image)).sum()
        for image in found.values()
    )
    total.backward()
    gradients = {name: value.grad.cpu().double() for name, value in field.parameters().items()}
    gradients["screen"] = rendering.screen.values.cpu().double()
    return (
        {name: image.detach().cpu().double() for name, image in found.items()},
        gradients,
        workspace,
    )


def far(one, other):
    """Largest difference over the largest value."""
    return float((one - other).abs().max() / other.abs().max().clamp_min(1e-12))


@pytest.mark.parametrize("stop", Stop)
@pytest.mark.parametrize(
    ("count", "opacity"), [(1, 0.5), (40, 0.1), (65, 0.9), (200, 0.02), (900, 0.01), (900, 0.3)]
)
def test_parts_are_one_walk(count, opacity, stop, device, monkeypatch):
    """No list, none that needs parts, a part of one round, all parts;
    pixels that end in every one of them.
    """
    settings = RenderSettings(near=0.1, far=20.0, stop=stop)
    results = {}
    for wanted in (1, 4):
        monkeypatch.setitem(buffers.SEGMENTS, device, wanted)
        field = scene(count, opacity, device)
        *results[wanted], workspace = outcome(api.rasterize, field, settings)
        assert workspace.last.segments == wanted
    exact = outcome(reference.rasterize, scene(count, opacity, "cpu", torch.float64), settings)
    for one, other, want in zip(results[4], results[1], exact, strict=False):
        for name, value in one.items():
            assert far(value, other[name]) < 1e-5, name
            if name != "screen":  # of which pixels are counted, some by a hair
                assert far(value, want[name]) < TOLERANCE.gradient, name


def test_channels_with_fixed_weights_take_part(device, monkeypatch):
    """As optical flow does: three or six further channels, whose gradient is theirs alone."""
    settings = RenderSettings(near=0.1, far=20.0)
    for number in (3, 6):
        extra = torch.rand(300, number, generator=torch.Generator().manual_seed(2))
        results = []
        for wanted in (1, 4):
            monkeypatch.setitem(buffers.SEGMENTS, device, wanted)
            field = scene(300, 0.05, device)
            results.append(outcome(api.rasterize, field, settings, extra)[:2])
        for one, other in zip(*results, strict=True):
            for name in one:
                assert far(one[name], other[name]) < 1e-5, name


def test_what_cannot_be_split_is_not(device, monkeypatch):
    """Distortion is a sum over pairs of entries; colour has weights that learn."""
    for change, images in (
        ({}, (*IMAGES, "distortion")),
        ({"colour_sh": torch.rand(100, 16, 3)}, IMAGES),
    ):
        found = []
        for wanted in (1, 4):
            monkeypatch.setitem(buffers.SEGMENTS, device, wanted)
            field, workspace = scene(100, 0.1, device), Workspace()
            field = replace(
                field, **{name: value.to(device).requires_grad_() for name, value in change.items()}
            )
            rendering = api.rasterize(
                field, CAMERA, SENSOR, RenderSettings(), images=images, workspace=workspace
            )
            terms = [rendering.quads.sum(), rendering.distortion.sum()]
            terms += [] if rendering.colour is None else [rendering.colour.square().sum()]
            sum(terms).backward()
            found.append(field.mean.grad.cpu())
        assert far(found[1], found[0]) < 1e-5


def test_what_nobody_differentiates_is_one_sum(device, monkeypatch):
    """As a replay renders it, to the bit: what a way back would need is not left."""
    settings, fields = RenderSettings(near=0.1, far=20.0), []
    for wanted in (1, 4):
        monkeypatch.setitem(buffers.SEGMENTS, device, wanted)
        field, workspace = scene(300, 0.05, device).map(torch.Tensor.detach), Workspace()
        fields.append(
            api.rasterize(field, CAMERA, SENSOR, settings, images=IMAGES, workspace=workspace)
        )
        assert workspace.last.segments == 1
    assert all(torch.equal(getattr(fields[0], name), getattr(fields[1], name)) for name in IMAGES)


@pytest.mark.parametrize("walks", [1, 4])
def test_memory_is_used_again_where_lists_are_read_in_parts_too(walks, device, monkeypatch):
    """Of so many Gaussians several warps read the list of a tile,
    whatever walks it back afterwards.
    """
    monkeypatch.setitem(buffers.SEGMENTS, device, walks)
    field, workspace, seen = scene(20_000, 0.01, device), Workspace(), []
    for _ in range(2):
        rendering = api.rasterize(
            field, CAMERA, SENSOR, RenderSettings(), images=IMAGES, workspace=workspace
        )
        seen.append(rendering.distance.detach().clone())
    assert workspace.last.segments == walks
    assert workspace.last.parts > 1
    assert torch.equal(*seen)


def test_parts_are_whole_rounds_and_hold_every_list():
    """Of any length."""
    length = (
        list_segments.segment_length.func
        if hasattr(list_segments.segment_length, "func")
        else list_segments.segment_length
    )
    for count in (0, 1, 15, 16, 64, 65, 255, 256, 257, 1000, 4469):
        found = length(count, 4)
        assert found % int(ROUND) == 0
        assert 4 * found >= count
        assert found == int(list_segments.SHORTEST) or 4 * (found - int(ROUND)) < count
