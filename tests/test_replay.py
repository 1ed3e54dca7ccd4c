"""Many images of one run: the same as one by one, from kept arrays and, on CUDA, from a graph."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from cases import gaussians

from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.recon.run import Run
from gftorf_warp.render import replay as module
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.motion import MotionSettings
from gftorf_warp.scene.network import Network
from gftorf_warp.scene.sensor import Sensor

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
CAMERA = Camera.from_fov(40, 30, 60.0)
NEAR = {"near": 0.1, "far": 20.0, "support": "alpha", "stop": "inclusive"}
IMAGES = ("quads", "phasor", "colour", "distance", "opacity", "distortion")
PLAIN = ("quads", "phasor", "distance", "opacity", "distortion")
# before the first key, on keys, between them, behind the last
TIMES = (-1.0, 0.0, 0.011, 0.04, 0.0667, 0.5)


@pytest.fixture(params=DEVICES)
def run(request, tmp_path):
    """A run whose network moves Gaussians by decimetres, optimised at half the size."""
    field = gaussians(60, CAMERA, seed=3).map(lambda tensor: tensor.to(request.param))
    shape = MotionSettings(kind="network", layers=3, width=16, skip_after=2, position_frequencies=3)
    keys = torch.arange(3, dtype=torch.float64) / 30
    motion = Network(
        keys, shape, duration=0.1, length=5.0, generator=torch.Generator().manual_seed(1)
    )
    with torch.no_grad():
        motion.head.weight.mul_(1e4)
    motion = motion.to(request.param)
    render = NEAR | {"clamp_gradient": "exact", "distortion": "paper"}
    return Run(
        path=tmp_path,
        config={"settings": {"render": render}, "size_optimised": [20, 15], "colour_scale": 0.5},
        camera=CAMERA,
        sensor=Sensor(
            phase_offset=0.2, dc_offset=0.1, source_intensity=1.5, shifts=CANONICAL_SHIFTS
        ),
        quad_scale=3.0,
        field=field,
        motion=motion,
        binding=motion.bind(field),
    )


def counting(function, calls):
    """The function, which adds its first argument to a list."""
    return lambda first, *rest, **named: calls.append(first) or function(first, *rest, **named)


def aside(x):
    """The camera, moved by x [m]."""
    pose = np.eye(4)
    pose[0, 3] = x
    return CAMERA.at(pose)


def compare(got, want):
    """To rounding, of the largest pixel."""
    for name in IMAGES:
        image, other = getattr(got, name), getattr(want, name)
        torch.testing.assert_close(
            image, other, rtol=1e-4, atol=2e-5 * float(other.abs().max()), msg=name
        )


def test_images_are_those_of_render(run):
    """At any time, from any camera and size, in any order; Gaussians do move, and are widened."""
    render = run.renderer()
    cameras = [CAMERA, aside(0.1), CAMERA.resized(20, 15), CAMERA]
    for camera in cameras:
        for time in TIMES:
            compare(render(time, camera), run.render(time, camera))
    first = render(0.0, CAMERA).distance.clone()
    assert float((render(0.0667, CAMERA).distance - first).abs().max()) > 0.1
    thin = replace(run, config=run.config | {"size_optimised": [40, 30]})
    assert (
        float((thin.renderer()(0.0, CAMERA).opacity - run.render(0.0).opacity).abs().max()) > 1e-3
    )


def test_colour_only_where_it_is_wanted(run):
    """Without it the other images stay."""
    got, want = run.renderer(PLAIN)(0.02, CAMERA), run.render(0.02)
    assert got.colour is None
    torch.testing.assert_close(got.quads, want.quads, rtol=1e-4, atol=1e-5)


def test_only_what_is_wanted(run):
    """Other images are empty; those that are computed are the same."""
    got, want = run.renderer(("quads", "distance", "opacity"))(0.02, CAMERA), run.render(0.02)
    assert got.phasor.numel() == got.distortion.numel() == 0
    for name in ("quads", "distance", "opacity"):
        torch.testing.assert_close(
            getattr(got, name), getattr(want, name), rtol=1e-4, atol=1e-4, msg=name
        )
    with pytest.raises(ValueError, match="no image 'depth'"):
        run.renderer(("quads", "depth"))


def test_every_key_is_computed_once(run, monkeypatch):
    """However many images lie between them."""
    asked = []
    right = run.motion.at_keys
    monkeypatch.setattr(run.motion, "at_keys", lambda a, keys: asked.extend(keys) or right(a, keys))
    render = run.renderer(PLAIN)
    for time in np.linspace(0.0, 0.06, 20):
        render(float(time), CAMERA)
    assert sorted(asked) == [0, 1, 2]


def test_an_empty_field_renders_black(run):
    """N = 0."""
    none = slice(0, 0)
    empty = replace(run, field=run.field.map(lambda t: t[none]), binding=run.binding[none])
    rendering = empty.renderer()(0.01, CAMERA)
    assert float(rendering.opacity.abs().max()) == 0.0
    assert float(rendering.quads.abs().max()) == 0.0


def test_cameras_of_one_size_share_memory(run):
    """Poses and focal lengths are data; another size, or a lens, has memory of its own."""
    render, bent = run.renderer(PLAIN), replace(CAMERA, distortion=Distortion(k1=-0.1))
    memory = set()
    long = replace(aside(0.1), fx=1.3 * CAMERA.fx, cy=0.4 * CAMERA.height)
    for camera in (CAMERA, aside(0.2), bent, long, CAMERA.resized(20, 15), bent, CAMERA):
        got, want = render(0.02, camera), run.render(0.02, camera)
        torch.testing.assert_close(got.distance, want.distance, rtol=1e-4, atol=1e-4)
        memory.add(got.distance.data_ptr())
    assert len(memory) == 3


@pytest.mark.parametrize("run", ["cpu"], indirect=True)
def test_a_size_is_captured_when_it_comes_again(run, monkeypatch):
    """When a rendering is captured, with plain renderings instead of graphs;
    images are right throughout.
    """
    captured, launched = [], []
    monkeypatch.setattr(
        module.Replay, "capture", lambda _, target: captured.append(target) or target
    )
    monkeypatch.setattr(
        module.Replay,
        "launch",
        lambda self, target: launched.append(target) or self.launch_kernels(target),
    )
    render = run.renderer(PLAIN)
    render.graphs = True
    for number, (time, camera) in enumerate([(t, c) for t in TIMES for c in (CAMERA, aside(0.1))]):
        got, want = render(time, camera), run.render(time, camera)
        torch.testing.assert_close(got.distance, want.distance, rtol=1e-4, atol=1e-4)
        assert render.fits()
        if number == 0:
            first = render.capacity
            assert first >= 1.5 * render.largest
    assert len(captured) == 1, "once per size"
    assert len(launched) == 2 * len(TIMES) - 2, (
        "not the one that counts pairs, nor the first one after it"
    )
    assert render.capacity == first, "pairs fitted"
    monkeypatch.setattr(module.Replay, "largest", 10 * first)
    assert not render.fits()
    render(0.01, CAMERA)
    assert render.capacity >= 15 * first


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("run", ["cuda"], indirect=True)
def test_a_replay_is_a_call_to_the_bit(run, monkeypatch):
    """Graph and launches give the same images; the graph was used."""
    graphs, calls = run.renderer(PLAIN), run.renderer(PLAIN)
    calls.graphs = False
    launched = []
    monkeypatch.setattr(wp, "capture_launch", counting(wp.capture_launch, launched))
    for time in (*TIMES, *TIMES):
        got = graphs(time, CAMERA)
        count = len(launched)
        want = calls(time, CAMERA)
        assert len(launched) == count
        for name in ("quads", "phasor", "distance", "opacity", "distortion"):
            torch.testing.assert_close(
                getattr(got, name), getattr(want, name), rtol=0, atol=0, msg=name
            )
    assert len(launched) == 2 * len(TIMES) - 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("run", ["cuda"], indirect=True)
def test_pairs_that_do_not_fit_are_rendered_again(run):
    """A checked image is whole whatever was reserved; an unchecked one is not,
    and the replay says so.
    """
    render = run.renderer(PLAIN)
    render(0.0, CAMERA)
    render.reserve(10)
    render(0.02, CAMERA, checked=False)
    assert not render.fits()
    got, want = render(0.02, CAMERA), run.render(0.02)
    torch.testing.assert_close(got.distance, want.distance, rtol=1e-4, atol=1e-4)
    assert render.fits()
