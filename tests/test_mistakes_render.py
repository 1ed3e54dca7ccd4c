"""Known mistakes in the image formation (method, section 10): weights, depth, pixel centres,
phasors, clamps, wraps.

Each test is named after the number of the mistake it would fail at; design/mistakes.md lists all of
them.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import POSED, SMALL, Case, gaussians, pose
from mistakes import centres, dots, surface
from torch.testing import assert_close

from gftorf_warp.constants import LOW_PASS, SPEED_OF_LIGHT
from gftorf_warp.evaluate.metrics import distance_from_quads
from gftorf_warp.render import api, fused, reference
from gftorf_warp.render.api import Background, rasterize
from gftorf_warp.render.buffers import RenderSettings
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.motion import Nodes
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor, phasor_from_quads
from gftorf_warp.scene.tracks import unproject

WIDE = Camera.from_fov(41, 31, 90.0)  # d / z is 1.4 at the left and right edge
SENSOR = Sensor(f_mod_hz=SPEED_OF_LIGHT / 15.0)


def test_mistake_05_the_background_is_weighed_by_one_way_transmittance():
    """Image and derivative: T_e b and -T_e b / (1 - alpha),
    where T_e^2 would give half and a quarter here.
    """
    field = dots([[0, 0, 2.0], [0, 0, 3.0]], scale=200.0, opacity=[0.5, 0.5], reflectivity=0.0)
    field.opacity_logit.requires_grad_()
    light = Background(quads=torch.tensor(0.8), phasor=torch.tensor(-0.6))
    image = rasterize(field, SMALL, SENSOR, background=light)
    assert_close(image.quads, torch.full_like(image.quads, 0.25 * 0.8), rtol=1e-3, atol=0)
    assert_close(image.phasor, torch.full_like(image.phasor, 0.25 * -0.6), rtol=1e-3, atol=0)
    (gradient,) = torch.autograd.grad(image.quads[0].mean(), field.opacity_logit)
    assert_close(gradient, torch.full((2,), -0.25 * 0.8 / 0.5 * 0.25), rtol=2e-3, atol=0)


def test_mistake_05_light_is_weighed_twice_and_distance_once():
    """Two layers: T before the second is 0.5, so it counts 0.25 in quads and 0.5 in distance,
    colour and opacity.
    """
    field = dots(
        [[0, 0, 2.0], [0, 0, 3.0]], scale=200.0, opacity=[0.5, 0.6], reflectivity=0.4, colour=0.7
    )
    image = rasterize(field, SMALL, SENSOR, extra=torch.tensor([[0.0], [1.0]]))
    single = [rasterize(field.map(lambda t, n=n: t[n : n + 1]), SMALL, SENSOR) for n in (0, 1)]
    assert single[1].quads.abs().max() > 1e-3
    assert_close(image.quads, single[0].quads + 0.25 * single[1].quads, rtol=1e-3, atol=1e-6)
    assert_close(image.phasor, single[0].phasor + 0.25 * single[1].phasor, rtol=1e-3, atol=1e-6)
    for name in ("distance", "opacity", "colour"):
        near, far = (getattr(one, name) for one in single)
        assert_close(getattr(image, name), near + 0.5 * far, rtol=1e-3, atol=1e-6)
    assert_close(image.extra[0], 0.5 * single[1].opacity, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("pixel", [(15, 20), (15, 0), (0, 40), (30, 3)])
def test_mistake_06_phase_falloff_and_distance_follow_the_ray(pixel):
    """At 3 m along the ray, wherever in the image: z-depth would be 2.1 m at the edge."""
    y, x = pixel
    point = unproject(WIDE, torch.tensor([x + 0.5, y + 0.5]), torch.tensor(3.0))
    image = rasterize(dots(point, scale=0.3, opacity=0.9, reflectivity=0.5), WIDE, SENSOR)
    decoded = distance_from_phasor(*image.phasor[:2], SENSOR)
    assert decoded[y, x].item() == pytest.approx(3.0, rel=1e-4)
    assert (image.distance / image.opacity)[y, x].item() == pytest.approx(3.0, rel=1e-4)
    assert (image.phasor[2] / image.opacity)[y, x].item() == pytest.approx(
        2 * 0.5 / 3.0**2, rel=1e-3
    )
    if x in (0, 40):
        assert point[2] < 2.4, "the ray must be oblique for this to mean something"


def test_mistake_06_every_output_is_sorted_by_z_depth():
    """One of two Gaussians is nearer in z and farther along its ray: it is the front one,
    for quads and distance.
    """
    points = torch.tensor([[2.4, 0.0, 2.0], [0.0, 0.0, 2.2]])  # distances 3.1 m and 2.2 m
    field = dots(points, scale=[1.5, 1.5], opacity=[0.7, 0.7], reflectivity=[0.4, 0.9], colour=0.6)
    for order in ([0, 1], [1, 0]):
        image = rasterize(field.map(lambda t, order=order: t[order]), WIDE, SENSOR)
        front, back = (
            rasterize(field.map(lambda t, n=n: t[n : n + 1]), WIDE, SENSOR) for n in (0, 1)
        )
        left = 1.0 - front.opacity
        assert (front.opacity * back.opacity).max() > 0.3, "they must overlap"
        assert_close(image.distance, front.distance + left * back.distance, rtol=1e-4, atol=1e-5)
        assert_close(image.colour, front.colour + left * back.colour, rtol=1e-4, atol=1e-5)
        assert_close(image.quads, front.quads + left**2 * back.quads, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("camera", [SMALL, POSED], ids=["plain", "posed"])
@pytest.mark.parametrize("pixel", [(3, 4), (17, 20), (10, 11)])
def test_mistake_08_pixel_centres_are_the_same_for_renderer_rays_and_back_projection(camera, pixel):
    """A Gaussian on the ray through a pixel's centre is symmetric about that pixel."""
    y, x = pixel
    middle = torch.tensor([x + 0.5, y + 0.5])
    point = unproject(camera, middle, torch.tensor(2.0))
    ray = camera.rays()[y, x]
    assert_close(
        torch.tensor(camera.centre, dtype=torch.float32) + 2.0 * ray, point, rtol=1e-5, atol=1e-5
    )
    assert_close(camera.project(point), middle, rtol=1e-5, atol=1e-3)
    opacity = rasterize(dots(point, scale=1e-3, opacity=0.9), camera, SENSOR).opacity
    row, column = opacity[y, x - 1 : x + 2], opacity[y - 1 : y + 2, x]
    assert row[1] == opacity.max()
    assert_close(
        torch.stack([row[0], column[0]]), torch.stack([row[2], column[2]]), rtol=2e-3, atol=0
    )
    assert row[0] > 0.1


def wall_flow(camera, step, half=0.0):
    """[2, H, W] flow of a wall at z = 2 m that moves by ``step`` in camera axes;
    pixel centres at i + 0.5 - half.
    """
    x, y = (centres(camera) - half).unbind(dim=-1)
    dx, dy, dz = step
    u = (camera.cx + ((x - camera.cx) * 2.0 + camera.fx * dx) / (2.0 + dz)) - x
    v = (camera.cy + ((y - camera.cy) * 2.0 + camera.fy * dy) / (2.0 + dz)) - y
    return torch.stack([u, v])


def flow_loss_of(camera, step, flow, later=None):
    """Flow loss [px^2] of a wall at z = 2 m that moves by ``step``, in camera axes,
    while the camera may move, too.
    """
    x, y = (
        (centres(camera) - torch.tensor([camera.cx, camera.cy]))
        / torch.tensor([camera.fx, camera.fy])
    ).unbind(-1)
    field = surface(camera, 2.0 * (1.0 + x.square() + y.square()).sqrt(), opacity=0.98)
    field = replace(field, layer=torch.ones(len(field), dtype=torch.long))
    world = torch.from_numpy(camera.camera_from_world[:3, :3].T @ np.array(step)).float()
    offset = torch.stack([torch.zeros(1, 3), world[None]])
    motion = Nodes(
        torch.tensor([0.0, 1.0]), torch.zeros(1, 3), torch.ones(1, dtype=torch.long), offset
    )
    start, end = (motion.at(motion.bind(field), time).offset for time in (0.0, 1.0))
    seen = rasterize(field, camera, SENSOR, extra=end - start, extra_detached=True)
    cameras = torch.from_numpy(fused.flow_cameras(camera, [later or camera]))
    loss = fused.flow_loss(seen.distance, seen.extra, flow.float()[None, None], cameras)
    (gradient,) = torch.autograd.grad(loss, motion.offset)
    assert gradient.isfinite().all()
    return float(loss.detach())


def test_mistake_08_flow_counts_pixels_as_the_renderer_does():
    """Approaching spreads from the principal point: half a pixel beside it the flow is another
    one.
    """
    step = (0.0, 0.0, -1.0)
    right = flow_loss_of(SMALL, step, wall_flow(SMALL, step))
    wrong = flow_loss_of(SMALL, step, wall_flow(SMALL, step, half=0.5))
    assert wrong > 0.3, "half a pixel is worth as much again at twice the size, in two components"
    assert right < 0.1 * wrong


def test_mistake_20_flow_and_surface_use_the_pose_and_not_its_inverse():
    """For a camera that is turned and moved; the same wall and motion as seen from it."""
    step = (0.1, -0.15, -0.2)
    camera = POSED.resized(25, 18)
    still = flow_loss_of(camera, step, torch.zeros(2, 18, 25))
    assert still > 1.0
    assert flow_loss_of(camera, step, wall_flow(camera, step)) < 0.01 * still


def test_mistake_20_a_moving_camera_moves_the_image_the_other_way():
    """Flow of a wall at rest between two poses: what the second camera sees where,
    and not the inverse of that.
    """
    camera = POSED.resized(25, 18)
    moved = pose((0.2, 1.0, 0.1), 0.04, (0.05, -0.08, 0.1))
    flows = []
    for later_from_camera in (moved, np.linalg.inv(moved)):
        x, y = centres(camera).unbind(-1)
        local = torch.stack(
            [(x - camera.cx) / camera.fx * 2.0, (y - camera.cy) / camera.fy * 2.0, 0 * x + 2.0], -1
        )
        flows.append(
            (camera.at(later_from_camera).project(local) - centres(camera)).permute(2, 0, 1)
        )
    later = camera.at(moved @ camera.camera_from_world)
    right, wrong = (flow_loss_of(camera, (0.0, 0.0, 0.0), flow, later) for flow in flows)
    assert wrong > 1.0
    assert right < 0.01 * wrong


def test_mistake_20_back_projection_is_the_inverse_of_rendering():
    """Points 2 m along the rays of a turned camera appear at their pixels, 2 m away;
    light from where the camera is.
    """
    pixels = torch.tensor([[5.5, 7.5], [40.5, 9.5], [22.5, 30.5]])
    assert np.abs(POSED.camera_from_world - POSED.camera_from_world.T).max() > 0.5, (
        "a transpose must matter"
    )
    points = unproject(POSED, pixels, torch.full((3,), 2.0))
    for point, (x, y) in zip(points, pixels.long(), strict=True):
        image = rasterize(dots(point, scale=0.05), POSED, SENSOR)
        assert divmod(int(image.opacity.argmax()), POSED.width) == (int(y), int(x))
        assert (image.distance / image.opacity)[y, x].item() == pytest.approx(2.0, rel=1e-5)
    centre = torch.tensor(POSED.centre, dtype=torch.float32)
    assert_close((points - centre).norm(dim=1), torch.full((3,), 2.0), rtol=1e-5, atol=0)
    assert_close(
        POSED.camera_from_world @ np.append(POSED.centre, 1.0), np.array([0.0, 0.0, 0.0, 1.0])
    )


def test_mistake_10_a_phasor_is_twice_a_quad():
    """Rendered, decoded from quads, and in the one setting that says otherwise."""
    field = gaussians(30, SMALL, seed=21)
    image = rasterize(field, SMALL, SENSOR)
    re, im = phasor_from_quads(image.quads, SENSOR.shifts)
    assert_close(torch.stack([re, im]), image.phasor[:2], rtol=1e-4, atol=1e-6)
    assert_close(image.quads[0] - image.quads[1], image.phasor[0], rtol=1e-4, atol=1e-6)
    one = rasterize(dots([0, 0, 2.0], scale=1.0, opacity=0.9, reflectivity=0.6), SMALL, SENSOR)
    assert (one.phasor[2] / one.opacity).max().item() == pytest.approx(2 * 0.6 / 4.0, rel=1e-3)
    assert one.quads.abs().max().item() <= 0.9 * 0.6 / 4.0 * 1.001
    single = rasterize(field, SMALL, SENSOR, RenderSettings(phasor_factor=1.0))
    assert_close(2.0 * single.phasor, image.phasor)
    assert_close(single.quads, image.quads, rtol=0, atol=0)


@pytest.mark.parametrize("offset", [-5.0, -0.6, -1e-3, 0.0, 2.5, 9.0])
def test_mistake_18_decoding_takes_the_modulo(offset):
    """At any phase offset every decoder returns the true distance, and nothing outside [0,
    c/2f).
    """
    sensor = replace(SENSOR, phase_offset=offset)
    distance = torch.cat([torch.tensor([1e-3, 7.49]), torch.linspace(0.05, 7.45, 40)]).double()
    phase = sensor.phase_slope * distance + offset
    quads = torch.stack([torch.cos(phase - shift) for shift in sensor.shifts])
    for decoded in (
        distance_from_phasor(torch.cos(phase), torch.sin(phase), sensor),
        distance_from_quads(quads, sensor),
    ):
        assert ((decoded >= 0) & (decoded < sensor.unambiguous_range)).all()
        assert_close(decoded, distance, rtol=0, atol=1e-9)
    anything = torch.linspace(-math.pi, math.pi, 1001)
    decoded = distance_from_phasor(torch.cos(anything), torch.sin(anything), sensor)
    assert ((decoded >= 0) & (decoded < sensor.unambiguous_range)).all()


def outside_the_guard():
    """Wide Gaussians far off both sides of the image, whose shape is linearised at the guard."""
    field = dots(
        [[2.6, 0.1, 1.5], [-2.8, 0.6, 1.6], [0.1, -2.5, 1.4], [0.3, 2.7, 1.7]],
        scale=1.0,
        opacity=0.6,
    )
    return Case(field=field, camera=SMALL)


def test_mistake_19_the_guard_has_its_own_derivative():
    """By z, outside the guard: a factor 2 in place of 1 is off by tens of per cent."""
    case = outside_the_guard()
    x, y, z = case.field.mean.unbind(1)
    limit = 1.3 * torch.tensor([SMALL.width, SMALL.height]) / (2 * SMALL.fx)
    assert (torch.maximum((x / z).abs() / limit[0], (y / z).abs() / limit[1]) > 1.0).all()
    exact = case.inputs(torch.float64)
    weight = torch.randn(20, 24, generator=torch.Generator().manual_seed(2)).double()
    decided = ~reference.undecided_pixels(case.field, case.camera)

    def loss(render, inputs):
        return (
            case.outputs(render, inputs)["distance"] * (weight * decided).to(inputs["mean"])
        ).sum()

    (by_kernel,) = torch.autograd.grad(
        loss(api.rasterize, fast := case.inputs(torch.float32)), fast["mean"]
    )
    for n in range(4):
        step = torch.zeros_like(exact["mean"])
        step[n, 2] = 1e-6
        with torch.no_grad():
            ahead, behind = (
                loss(reference.rasterize, {**exact, "mean": exact["mean"] + s * step})
                for s in (1, -1)
            )
        want = ((ahead - behind) / 2e-6).item()
        assert abs(want) > 1e-2
        assert by_kernel[n, 2].item() == pytest.approx(want, rel=1e-4)


def test_mistake_19_nothing_is_added_to_determinants():
    """The footprint of a dot is its low-pass filter to the last digits:
    1e-7 on the determinant shows in the sixth.
    """
    camera = replace(SMALL, cx=12.5, cy=10.5)
    field = dots([0, 0, 2.0], scale=1e-6, opacity=0.9).map(torch.Tensor.double)
    x, y = (centres(camera).double() - torch.tensor([12.5, 10.5], dtype=torch.float64)).unbind(-1)
    want = field.opacity * torch.exp(-(x.square() + y.square()) / (2 * LOW_PASS))
    want = torch.where(want >= 1 / 255, want, 0.0)
    exact = reference.rasterize(field, camera, SENSOR).opacity
    assert_close(exact, want, rtol=1e-7, atol=0)
    got = rasterize(field.map(torch.Tensor.float), camera, SENSOR).opacity
    assert (want > 0).sum() == 9
    assert_close(got.double(), want, rtol=1e-6, atol=0)


def test_mistake_19_a_clamped_alpha_is_flat():
    """Where alpha is 0.99 everywhere, opacity and shape have no influence;
    a straight-through gradient has.
    """
    field = dots([0, 0, 2.0], scale=200.0, opacity=0.99999)
    field.opacity_logit.requires_grad_()
    image = rasterize(field, SMALL, SENSOR)
    assert_close(image.opacity.detach(), torch.full((20, 24), 0.99))
    (gradient,) = torch.autograd.grad(image.distance.sum(), field.opacity_logit)
    assert gradient.item() == 0.0
