"""The renderer from a Warp program: gradients through wp.Tape,
and the CUDA mapping of the kernels run on the CPU.
"""

import gc
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from gftorf_warp.render import buffers as sizes
from gftorf_warp.render import launch
from gftorf_warp.render.api import Background, rasterize
from gftorf_warp.render.buffers import Buffers, RenderSettings, Workspace
from gftorf_warp.render.cuda import capture, without_garbage_collection
from gftorf_warp.render.launch import Images, Inputs
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
COUNT, WIDTH, HEIGHT, EXTRA = 40, 29, 19, 4
SHIFTS = (0.3, 2.0, 4.4)
SETTINGS = RenderSettings(near=0.1, far=20.0)
SENSOR = Sensor(shifts=SHIFTS, phase_offset=0.2, dc_offset=0.4, source_intensity=1.3)
CAMERA = Camera.from_fov(WIDTH, HEIGHT, 60)
VECTORS = {"mean": wp.vec3, "log_scale": wp.vec3, "quaternion": wp.vec4, "colour_sh": wp.vec3}


def scene(device="cpu"):
    """Return a field, extra channels and a background of noise."""
    rng = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=rng)

    mean = torch.rand(COUNT, 3, generator=rng) * torch.tensor([2.0, 1.4, 2.0]) + torch.tensor(
        [-1.0, -0.7, 1.5]
    )
    field = GaussianField(
        mean=mean,
        log_scale=math.log(0.1) + 0.4 * normal(COUNT, 3),
        quaternion=normal(COUNT, 4),
        opacity_logit=2.0 * normal(COUNT),
        reflectivity_sh=constant_sh(torch.rand(COUNT, generator=rng)) + 0.05 * normal(COUNT, 16),
        colour_sh=0.2 * normal(COUNT, 16, 3),
    )
    extra, background = normal(COUNT, EXTRA), normal(len(SHIFTS), HEIGHT, WIDTH)
    return field.map(lambda t: t.to(device)), extra.to(device), background.to(device)


def cotangents(device="cpu"):
    """Return a random derivative of the loss by every image."""
    rng = torch.Generator().manual_seed(1)
    size = HEIGHT, WIDTH
    shapes = {
        "quads": (len(SHIFTS), *size),
        "phasor": (3, *size),
        "colour": (3, *size),
        "extra": (EXTRA, *size),
    }
    shapes |= dict.fromkeys(("distance", "opacity", "distortion"), size)
    return {name: torch.randn(*shape, generator=rng).to(device) for name, shape in shapes.items()}


def torch_gradients(device="cpu"):
    """Return images and gradients by torch.autograd."""
    field, extra, background = scene(device)
    named = {**field.parameters(), "extra": extra, "background_quads": background}
    for tensor in named.values():
        tensor.requires_grad_()
    rendering = rasterize(
        field, CAMERA, SENSOR, SETTINGS, extra=extra, background=Background(quads=background)
    )
    images = {name: getattr(rendering, name) for name in cotangents()}
    outputs, grads = list(images.values()), [cotangents(device)[name] for name in images]
    return images, dict(
        zip(named, torch.autograd.grad(outputs, list(named.values()), grads), strict=True)
    )


@pytest.mark.parametrize("device", DEVICES)
def test_tape_and_torch_agree_and_the_tape_accumulates(device):
    """A Warp program that records a tape gets torch's gradients;
    a second backward adds the same again.
    """
    wanted_images, wanted = torch_gradients(device)
    field, extra, background = scene(device)
    named = {**field.parameters(), "extra": extra, "background_quads": background}
    arrays = {
        name: wp.from_torch(t.clone(), dtype=VECTORS.get(name, wp.float32), requires_grad=True)
        for name, t in named.items()
    }
    values = [
        float(v)
        for v in (
            SENSOR.phase_slope,
            SENSOR.phase_offset,
            SENSOR.source_intensity,
            SENSOR.dc_offset,
        )
    ]
    wp_device = arrays["mean"].device
    calibration = wp.array(values, dtype=float, device=wp_device, requires_grad=True)
    shapes = {name: tuple(t.shape) for name, t in cotangents().items()}
    images = Images(
        **{
            name: wp.zeros(s, dtype=float, device=wp_device, requires_grad=True)
            for name, s in shapes.items()
        }
    )
    inputs = Inputs(**arrays, calibration=calibration)
    buffers = Buffers(COUNT, WIDTH, HEIGHT, SETTINGS, wp_device)
    with wp.Tape() as tape:
        launch.render(inputs, launch.uploaded(CAMERA, SHIFTS, SETTINGS, wp_device), buffers, images)
    for name, image in wanted_images.items():
        torch.testing.assert_close(wp.to_torch(getattr(images, name)), image.detach())

    seeds = {getattr(images, name): wp.from_torch(t) for name, t in cotangents(device).items()}
    tape.backward(grads=seeds)
    once = {name: wp.to_torch(array.grad).clone() for name, array in arrays.items()}
    for name, want in wanted.items():
        assert want.abs().max() > 1e-3, name
        torch.testing.assert_close(
            once[name].reshape(want.shape), want, rtol=1e-5, atol=1e-5, msg=name
        )
    assert np.abs(calibration.grad.numpy()).min() > 1e-2
    tape.backward(grads=seeds)
    for name, array in arrays.items():
        torch.testing.assert_close(
            wp.to_torch(array.grad), 2.0 * once[name], rtol=1e-5, atol=1e-5, msg=name
        )


def test_one_thread_per_pixel_gives_the_same_on_the_cpu(monkeypatch):
    """The instance that CUDA runs, one pixel per thread in tiles of 8 x 4,
    agrees with the 16-lane one.
    """
    images, wanted = torch_gradients()
    monkeypatch.setitem(sizes.TILE_SHAPES, "cpu", sizes.TILE_SHAPES["cuda"])
    other_images, other = torch_gradients()
    for name, image in images.items():
        torch.testing.assert_close(other_images[name], image, rtol=1e-5, atol=2e-6, msg=name)
    for name, want in wanted.items():
        torch.testing.assert_close(
            other[name], want, rtol=1e-4, atol=2e-5 * float(want.abs().max()), msg=name
        )


def test_a_fixed_capacity_gives_the_same_and_reports_what_did_not_fit():
    """A reserve of pairs changes nothing as long as it suffices;
    one that does not is an error with both numbers.
    """
    field, _, _ = scene()
    free = rasterize(field, CAMERA, SENSOR, SETTINGS)
    roomy = RenderSettings(near=0.1, far=20.0, pair_capacity=5000)
    torch.testing.assert_close(
        rasterize(field, CAMERA, SENSOR, roomy).quads, free.quads, rtol=0, atol=0
    )
    with pytest.raises(
        ValueError, match=r"pair_capacity = 10 is too small: this rendering has \d+"
    ):
        rasterize(field, CAMERA, SENSOR, RenderSettings(near=0.1, far=20.0, pair_capacity=10))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_reserved_rendering_never_waits_for_the_host():
    """With a reserve of pairs, forward and backward can be captured in a CUDA graph,
    and its replay sees new inputs.
    """
    field, _, _ = scene("cuda")
    settings = RenderSettings(near=0.1, far=20.0, pair_capacity=20_000)
    device = wp.get_device("cuda:0")
    view = launch.uploaded(CAMERA, SHIFTS, settings, device)
    tensors = {name: t.clone() for name, t in field.parameters().items()}
    arrays = {
        name: wp.from_torch(t, dtype=VECTORS.get(name, wp.float32)) for name, t in tensors.items()
    }
    values = [
        float(v)
        for v in (
            SENSOR.phase_slope,
            SENSOR.phase_offset,
            SENSOR.source_intensity,
            SENSOR.dc_offset,
        )
    ]
    inputs = Inputs(**arrays, calibration=wp.array(values, dtype=float, device=device))
    wanted = Inputs(**{name: wp.zeros_like(a) for name, a in arrays.items()}, calibration=None)
    shapes = {name: tuple(t.shape) for name, t in cotangents().items() if name != "extra"}
    images = Images(
        **{name: wp.zeros(shape, dtype=float, device=device) for name, shape in shapes.items()}
    )
    seeds = Images(**{name: wp.from_torch(cotangents("cuda")[name]) for name in shapes})
    buffers = Buffers(COUNT, WIDTH, HEIGHT, settings, device)

    def both():
        launch.forward(inputs, view, buffers, images)
        launch.backward(inputs, view, buffers, seeds, wanted)

    both()
    with wp.ScopedCapture(device=device) as capture:
        both()
    tensors["mean"] += 0.01
    wanted.mean.zero_()
    wp.capture_launch(capture.graph)
    replayed, gradient = wp.to_torch(images.quads).clone(), wp.to_torch(wanted.mean).clone()
    wanted.mean.zero_()
    both()
    buffers.check_capacity()
    torch.testing.assert_close(replayed, wp.to_torch(images.quads), rtol=0, atol=0)
    torch.testing.assert_close(gradient, wp.to_torch(wanted.mean), rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_torch_does_not_wait_for_the_host_either():
    """With a reserve of pairs, nothing that torch does around the kernels synchronises."""
    field, extra, background = scene("cuda")
    settings = RenderSettings(near=0.1, far=20.0, pair_capacity=20_000)
    for tensor in field.parameters().values():
        tensor.requires_grad_()
    for mode in ("default", "error"):  # the first pass uploads calibration and loads kernels
        torch.cuda.set_sync_debug_mode(mode)
        try:
            images = rasterize(
                field,
                CAMERA,
                SENSOR,
                settings,
                extra=extra,
                background=Background(quads=background),
            )
            (images.quads.square().sum() + images.distance.sum()).backward()
        finally:
            torch.cuda.set_sync_debug_mode("default")


def rendered_in(workspace, device="cpu", shift=0.0):
    """Return images and gradients of a rendering in ``workspace``, all with a random derivative."""
    field, extra, background = scene(device)
    field = field.map(lambda t: t.detach().requires_grad_())
    moved = field.moved(torch.full((1, 3), shift, device=device))
    backdrop = Background(quads=background)
    rendering = rasterize(
        moved,
        CAMERA,
        SENSOR,
        SETTINGS,
        extra=extra,
        background=backdrop,
        screen_gradient=True,
        workspace=workspace,
    )
    seeds = cotangents(device)
    images = {name: getattr(rendering, name) for name in seeds}
    grads = torch.autograd.grad(
        list(images.values()), list(field.parameters().values()), list(seeds.values())
    )
    return [*images.values(), *grads, rendering.screen.gradient]


@pytest.mark.parametrize("device", DEVICES)
def test_a_workspace_changes_nothing_and_allocates_once(device, monkeypatch):
    """Renderings in one workspace equal those in memory of their own,
    and the second one finds all memory there.
    """
    workspace = Workspace()
    for shift in (0.0, 0.05, 0.0):
        for got, want in zip(
            rendered_in(workspace, device, shift), rendered_in(None, device, shift), strict=True
        ):
            torch.testing.assert_close(
                got, want, rtol=0 if device == "cpu" else 1e-4, atol=0 if device == "cpu" else 1e-4
            )
    kind = COUNT, WIDTH, HEIGHT, SETTINGS, wp.get_device(device)
    buffers = workspace.buffers(*kind)
    made, empty = [], wp.empty
    monkeypatch.setattr(wp, "empty", lambda *a, **k: made.append(empty(*a, **k)) or made[-1])
    rendered_in(workspace, device)
    assert workspace.buffers(*kind) is buffers
    assert not any(array.size for array in made)
    rendered_in(None, device)
    assert sum(array.size > 0 for array in made) > 12
    assert workspace.buffers(COUNT + 1, *kind[1:]) is not buffers


def test_backward_after_the_next_rendering_in_a_workspace_is_an_error():
    """Its memory holds the next rendering by then."""
    field, _, _ = scene()
    workspace = Workspace()
    mean = field.mean.clone().requires_grad_()
    first = rasterize(replace(field, mean=mean), CAMERA, SENSOR, SETTINGS, workspace=workspace)
    rasterize(field, CAMERA, SENSOR, SETTINGS, workspace=workspace)
    with pytest.raises(ValueError, match="rendered again since"):
        first.quads.sum().backward()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_torch_captures_a_rendering_and_its_backward_pass():
    """A graph of torch holds both passes; its replay sees new inputs,
    and a stream survives all renderings on it.
    """
    field, extra, background = scene("cuda")
    settings, workspace = RenderSettings(near=0.1, far=20.0, pair_capacity=20_000), Workspace()
    mean = field.mean.clone().requires_grad_()
    grad = torch.zeros_like(mean)

    def both():
        moving, backdrop = replace(field, mean=mean), Background(quads=background)
        rendering = rasterize(
            moving, CAMERA, SENSOR, settings, extra=extra, background=backdrop, workspace=workspace
        )
        grad.copy_(
            torch.autograd.grad(rendering.quads.square().sum() + rendering.extra.sum(), mean)[0]
        )
        return rendering.quads

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            both()
    stream.synchronize()
    graph = torch.cuda.CUDAGraph()
    with capture(graph, stream):
        quads = both()
    with torch.no_grad():
        mean += 0.01
    graph.replay()
    replayed = quads.clone(), grad.clone()
    called = both()
    workspace.check_capacity()
    torch.testing.assert_close(replayed[0], called, rtol=0, atol=0)
    torch.testing.assert_close(replayed[1], grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("enabled", [True, False])
def test_nothing_is_looked_for_during_a_capture(enabled):
    """Whatever was the case before is so again, after an error too."""
    before = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        seen = []
        with pytest.raises(KeyError), without_garbage_collection():
            {}[seen.append(gc.isenabled())]
        assert seen == [False]
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if before else gc.disable)()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_an_old_graph_in_a_cycle_breaks_no_capture():
    """Its memory may only be given back when the new one is there."""

    def graph_of(value):
        made, there = torch.cuda.CUDAGraph(), torch.zeros(1 << 20, device="cuda")
        there.add_(value)
        torch.cuda.synchronize()
        with capture(made):
            holds = [made, there + value]
            for _ in range(1000):
                holds.append([holds])  # objects that the collector counts, in a cycle
        return holds

    threshold = gc.get_threshold()
    try:
        gc.set_threshold(1, 1, 1)
        for value in range(4):
            graph_of(value)[0].replay()
        torch.cuda.synchronize()
    finally:
        gc.set_threshold(*threshold)
