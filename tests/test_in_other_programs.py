"""What a program may do that imports this package: modes and threads of torch, forks, stdout."""

import importlib
import importlib.metadata
import math
import multiprocessing
import pkgutil
import subprocess
import sys
import threading
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from cases import CASES
from comparison import DEVICES
from torch.testing import assert_close

import gftorf_warp
from gftorf_warp.data.exr import read_parts, write_parts
from gftorf_warp.errors import InputError
from gftorf_warp.evaluate.compare import installed_versions
from gftorf_warp.losses.image import similarity
from gftorf_warp.render import api, cuda, reference, runtime
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor, phasor_from_quads

HERE = Path(__file__).parent
CASE = CASES["tiles"]()
LONG_S = 60.0  # of a process that would otherwise hang
NOT_FINITE = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("device", DEVICES)
def test_training_works_after_a_rendering_in_inference_mode(device):
    """Cached constants are shared by all modes."""
    # of sizes and constants that no other test has, so that nothing is cached yet
    sensor = replace(CASE.sensor, phase_offset=0.123, shifts=(0.1, 1.7, 3.1, 4.9))
    camera = CASE.camera.resized(CASE.camera.width + 3, CASE.camera.height + 5)
    field = CASE.field.map(lambda tensor: tensor.clone().to(device))

    def loss(field):
        quads = api.rasterize(field, camera, sensor, CASE.settings).quads
        distance = distance_from_phasor(*phasor_from_quads(quads, sensor.shifts), sensor)
        alike = similarity(distance[None], torch.ones_like(distance)[None])
        return alike.mean() + camera.project(field.mean).sum()

    with torch.inference_mode():
        expected = loss(field)
    field = field.map(lambda tensor: tensor.requires_grad_())
    found = loss(field)
    found.backward()
    assert_close(found.detach(), expected.clone())
    assert field.mean.grad.abs().sum() > 0


TWO_THREADS = replace(CASE.settings, threads=2)
LARGE = 1 << 20  # elements: more than torch leaves to one thread


def rendered_in_threads():
    """Quads, and a tensor, both computed by more than one thread."""
    field, grown = CASE.field, torch.ones(LARGE).exp()
    return api.rasterize(field, CASE.camera, CASE.sensor, TWO_THREADS).quads.numpy(), float(
        grown[0]
    )


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_forked_process_renders():
    """Neither the threads of the tiles nor those of torch exist in it; it would wait for ever."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    try:
        here = rendered_in_threads()
        child = context.Process(target=lambda: sender.send(rendered_in_threads()))
        child.start()
        arrived = receiver.poll(LONG_S)
        there = receiver.recv() if arrived else None
        child.kill()
        child.join()
    finally:
        torch.set_num_threads(threads)
    assert there is not None, "the forked process did not finish"
    assert np.array_equal(there[0], here[0])


def work(case):
    """Return quads and a gradient of a case."""
    inputs = case.inputs(torch.float32)
    quads = case.outputs(api.rasterize, inputs)["quads"]
    quads.square().sum().backward()
    return quads.detach(), inputs["mean"].grad


def render_in_threads():
    """Render cases in threads that start together, then one after the other, and compare."""
    cases = [CASES[name]() for name in ("translucent", "sloped", "tiles") for _ in range(2)]
    found = [[] for _ in cases]
    threads = [
        threading.Thread(target=lambda n=n: found[n].append(work(cases[n])))
        for n in range(len(cases))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG_S)
    for case, results in zip(cases, found, strict=True):
        ((quads, gradient),) = results
        expected_quads, expected_gradient = work(case)
        assert torch.equal(quads, expected_quads)
        assert_close(gradient, expected_gradient)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no second device")
def test_devices_of_a_program_are_rendered_on_at_the_same_time():
    """The CPU and every GPU, of which one only is the current one."""
    devices = ["cpu", *(f"cuda:{n}" for n in range(torch.cuda.device_count()))]
    found = {device: [] for device in devices}

    def repeat(device):
        case = CASES["translucent"]()
        for _ in range(10):
            inputs = case.inputs(torch.float32, device)
            quads = case.outputs(api.rasterize, inputs)["quads"]
            quads.square().sum().backward()
            found[device].append((quads.detach().cpu(), inputs["mean"].grad.cpu()))

    threads = [threading.Thread(target=repeat, args=(device,)) for device in devices]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG_S)
    expected = found["cpu"][0]
    for device, results in found.items():
        assert len(results) == 10, device
        for result in results:
            assert_close(result, expected, rtol=1e-3, atol=1e-4)


def import_everything():
    """Import every module of the package."""
    for module in pkgutil.walk_packages(gftorf_warp.__path__, "gftorf_warp."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def test_threads_of_a_new_process_render_at_the_same_time_and_print_nothing():
    """Each gets its own images and gradients, also while kernels are loaded: that crashed. Warp
    greets and reports every module on stdout unless it has another logger.
    """
    code = "import test_in_other_programs as t; t.import_everything(); t.render_in_threads()"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(HERE)!r}); {code}"],
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_cpu_threads_render_at_the_same_time():
    """The lock is for the first launch of a kernel: the images of a batch have a thread each."""

    def step():
        field = CASE.field.map(lambda tensor: tensor.clone().requires_grad_())
        api.rasterize(
            field, CASE.camera, CASE.sensor, CASE.settings
        ).quads.square().sum().backward()
        steps.append(field.mean.grad)

    steps: list[torch.Tensor] = []
    step()
    with runtime.LAUNCHING:
        other = threading.Thread(target=step, daemon=True)
        other.start()
        other.join(LONG_S)
        assert not other.is_alive()
    assert_close(*steps)


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
def test_a_camera_refuses_intrinsics_that_are_not_finite(name, value):
    """Comparisons with NaN are false, and infinity is above 0."""
    with pytest.raises(ValueError, match=rf"{name} must be finite, got {value}"):
        replace(CASE.camera, **{name: value})


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("at", [(0, 0), (1, 3), (3, 3)])
def test_a_camera_refuses_a_pose_that_is_not_finite(at, value):
    """A translation that is NaN is orthogonal to nothing, and would hide every Gaussian."""
    pose = np.eye(4)
    pose[at] = value
    with pytest.raises(ValueError, match="camera_from_world must be finite"):
        Camera.from_fov(24, 20, 60.0, camera_from_world=pose)


@pytest.mark.parametrize("offset", [1e4, -1e4, torch.tensor(1e4)])
def test_whole_turns_of_the_phase_offset_cost_no_digits(offset):
    """float32 has steps of 1e-3 at 1e4 rad."""
    sensor = replace(CASE.sensor, phase_offset=offset)
    field = CASE.field.map(lambda tensor: tensor.double())
    exact = replace(CASE.sensor, phase_offset=math.remainder(float(offset), 2 * math.pi))
    wanted = reference.rasterize(field, CASE.camera, exact, CASE.settings).quads
    found = api.rasterize(CASE.field, CASE.camera, sensor, CASE.settings).quads
    assert (found - wanted).abs().max() < 1e-6 * wanted.abs().max()


def test_gradient_of_a_reduced_phase_offset_is_its_own():
    """Whole turns are constant."""
    gradients = []
    for offset in (0.5, 0.5 + 200 * math.pi):
        tensor = torch.tensor(offset, dtype=torch.float64, requires_grad=True)
        sensor = Sensor(phase_offset=tensor)
        distance_from_phasor(torch.tensor(0.3), torch.tensor(0.4), sensor).backward()
        gradients.append(tensor.grad)
    assert gradients[0] != 0
    assert_close(*gradients)


def test_a_damaged_exr_prints_nothing(tmp_path, capsys):
    """OpenEXR prints a warning on stdout for every part that it cannot read."""
    image = np.random.default_rng(0).random((32, 48)).astype(np.float32)
    path = tmp_path / "000000.exr"
    write_parts(path, {name: {"V": image} for name in ("one", "two")})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError):
        read_parts(path)
    print("heard")
    assert capsys.readouterr().out == "heard\n"


def test_versions_of_packages_without_metadata(monkeypatch):
    """A source tree on the path has none."""

    def nothing(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", nothing)
    assert "warp-lang of unknown version" in installed_versions()


def test_the_backward_pass_of_a_capture_may_launch(monkeypatch):
    """On CUDA autograd runs it in a thread of its own, while the capturing one waits for it."""
    monkeypatch.setattr(torch.cuda, "graph", lambda *_, **__: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", object)
    monkeypatch.setattr(wp, "ScopedCapture", lambda **_: nullcontext())
    monkeypatch.setattr(wp, "stream_from_torch", lambda _: None)
    got = []

    def launch():
        got.append(runtime.LAUNCHING.acquire(timeout=10))
        if got[-1]:
            runtime.LAUNCHING.release()

    with cuda.capture(None):
        backward = threading.Thread(target=launch)
        backward.start()
        backward.join()
    assert got == [True]
