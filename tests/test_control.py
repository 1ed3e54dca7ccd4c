"""Camera, calibration and shifts in device memory: the same bits as without,
and whatever is written there later.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import SMALL, gaussians
from comparison import DEVICES

from gftorf_warp.render.api import rasterize
from gftorf_warp.render.buffers import RenderSettings, Workspace
from gftorf_warp.render.control import DeviceCamera, packed
from gftorf_warp.render.cuda import capture
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.sensor import Sensor

SETTINGS = RenderSettings(near=0.1, far=20.0, pair_capacity=20_000)
SENSORS = (
    Sensor(shifts=(0.3, 2.0, 4.4), phase_offset=0.2, dc_offset=0.4),
    Sensor(f_mod_hz=30e6, shifts=(1.0, 0.1, 5.0), source_intensity=1.7),
)
NAMES = "quads", "phasor", "distance", "opacity", "distortion"


def cameras(lens=False):
    """Two cameras of one size that differ in everything else."""
    turned = np.eye(4)
    turned[:3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
    turned[:3, 3] = 0.1, -0.05, 0.2
    bends = (
        (Distortion(k1=-0.1, p1=0.01), Distortion(k1=0.05, k2=0.01))
        if lens
        else (Distortion(), Distortion())
    )
    first, second = (replace(SMALL, distortion=bend) for bend in bends)
    return first, replace(second, camera_from_world=turned, fx=SMALL.fx * 1.1, cx=SMALL.cx + 2.5)


def rendered(device, camera, sensor, control=None):
    """Images, and gradients of the Gaussians and of the calibration."""
    field = gaussians(60, SMALL, seed=3).map(lambda t: t.to(device, torch.float32).requires_grad_())
    images = rasterize(field, camera, sensor, SETTINGS, control=control)
    seeds = [torch.linspace(-1, 1, getattr(images, n).numel(), device=device) for n in NAMES]
    sum(
        (getattr(images, n).flatten() * seed).sum() for n, seed in zip(NAMES, seeds, strict=True)
    ).backward()
    return [getattr(images, n).detach() for n in NAMES], [
        t.grad for t in field.parameters().values()
    ]


@pytest.mark.parametrize("lens", [False, True], ids=["pinhole", "lens"])
@pytest.mark.parametrize("device", DEVICES)
def test_a_rendering_reads_pose_calibration_and_shifts_from_the_device(device, lens):
    """With the row of a second camera and sensor in memory,
    the call with the first ones renders the second.
    """
    (first, second), row = cameras(lens), None
    want = rendered(device, second, SENSORS[1])
    for camera, sensor in ((first, SENSORS[0]), (second, SENSORS[1])):
        bits = torch.from_numpy(packed(camera, sensor, SETTINGS)).to(device)
        row = bits if row is None else row.copy_(bits)
        control = DeviceCamera.over(row)
        images, gradients = rendered(device, first, SENSORS[0], control)
    assert (images[0] - rendered(device, first, SENSORS[0])[0][0]).abs().max() > 1e-2
    for got, image in zip(images, want[0], strict=True):
        torch.testing.assert_close(got, image, rtol=0, atol=0)
    for got, gradient in zip(gradients, want[1], strict=True):
        torch.testing.assert_close(
            got, gradient, rtol=1e-5, atol=1e-5 * float(gradient.abs().max())
        )


def test_the_calibration_of_a_control_has_the_gradient_of_the_sensors():
    """As if its four numbers were tensors of the sensor."""
    field, camera = gaussians(60, SMALL, seed=3).map(lambda t: t.float()), cameras()[0]
    numbers = [torch.tensor(float(v), requires_grad=True) for v in (0.8, 0.2, 1.1, 0.4)]
    names = "f_mod_hz", "phase_offset", "source_intensity", "dc_offset"
    sensor = Sensor(**dict(zip(names, [numbers[0] * 3e7, *numbers[1:]], strict=True)))
    rasterize(field, camera, sensor, SETTINGS).quads[0].square().sum().backward()
    control = DeviceCamera.over(torch.from_numpy(packed(camera, sensor, SETTINGS)))
    calibration = control.calibration.clone().requires_grad_()
    control = replace(control, calibration=calibration)
    rasterize(field, camera, Sensor(), SETTINGS, control=control).quads[0].square().sum().backward()
    slope = float((sensor.phase_slope / numbers[0]).detach())
    want = torch.stack([n.grad for n in numbers]) / torch.tensor([slope, 1, 1, 1])
    assert want.abs().min() > 1e-4
    torch.testing.assert_close(calibration.grad, want, rtol=1e-4, atol=1e-6)


@pytest.mark.contract
def test_a_control_that_does_not_fit_is_an_error():
    """Another number of shifts than the sensor's, or numbers of another kind."""
    field, camera = gaussians(5, SMALL, seed=3).map(lambda t: t.float()), cameras()[0]
    control = DeviceCamera.over(torch.from_numpy(packed(camera, SENSORS[0], SETTINGS)))
    with pytest.raises(ValueError, match=r"control.shifts is \(3, 2\) .* must be \(4, 2\)"):
        rasterize(field, camera, Sensor(), SETTINGS, control=control)
    with pytest.raises(ValueError, match=r"control.view is .* must be"):
        rasterize(
            field,
            camera,
            SENSORS[0],
            SETTINGS,
            control=replace(control, view=control.view.double()),
        )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("lens", [False, True], ids=["pinhole", "lens"])
def test_one_graph_serves_any_pose_frequency_and_shifts(lens):
    """A graph captured with one camera and sensor replays with another that was written to its
    memory.
    """
    (first, second), workspace = cameras(lens), Workspace()
    field = gaussians(60, SMALL, seed=3).map(lambda t: t.to("cuda", torch.float32))
    row = torch.from_numpy(packed(first, SENSORS[0], SETTINGS)).cuda()
    control, found = DeviceCamera.over(row), []

    def render():
        images = rasterize(field, first, SENSORS[0], SETTINGS, workspace=workspace, control=control)
        found[:] = [images.quads, images.distance]

    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    with torch.cuda.stream(stream):
        render()
    with capture(graph, stream):
        render()
    row.copy_(torch.from_numpy(packed(second, SENSORS[1], SETTINGS)))
    graph.replay()
    want = rasterize(field, second, SENSORS[1], SETTINGS)
    torch.testing.assert_close(found[0], want.quads, rtol=0, atol=0)
    torch.testing.assert_close(found[1], want.distance, rtol=0, atol=0)
