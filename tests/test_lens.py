"""A lens that distorts, in both engines and in a reconstruction: rays, splats, what lies outside,
what comes of it.
"""

import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import warp as wp
from cases import BENT
from sequences import changed
from small_runs import demo
from test_engines import agree_on_the_demo, apart, phasors
from test_optics import BARREL, PINCUSHION
from test_simulate import inside, slider

from gftorf_warp import Sequence
from gftorf_warp.data.check import check
from gftorf_warp.errors import UsageError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.kernels.geometry import CameraView
from gftorf_warp.kernels.lens import distorted
from gftorf_warp.kernels.tracing.rays import ray_through
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.buffers import RenderSettings
from gftorf_warp.render.launch import view_of
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.initialise import InitSettings, in_frusta
from gftorf_warp.scene.optics import Lens
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim import gaussian_cover
from gftorf_warp.sim.assembly import Level
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Texture, first_hit

SEVERE = Distortion(k1=-0.3, k2=0.12, p1=0.01, p2=-0.02, k3=-0.02)
LENSES = pytest.mark.parametrize(
    "lens", [BARREL, PINCUSHION, SEVERE], ids=["barrel", "pincushion", "severe"]
)


def wide(lens):
    """A camera of 70 degrees with two focal lengths and a principal point off the middle."""
    return Camera(width=320, height=240, fx=229.0, fy=225.0, cx=163.0, cy=117.0, distortion=lens)


@wp.kernel(enable_backward=False)
def look(view: CameraView, at: wp.array[wp.vec2], rays: wp.array[wp.vec3], seen: wp.array[wp.vec2]):
    """Rays through image points, and where the lens images the points one step of a pinhole
    away.
    """
    i = wp.tid()
    rays[i] = ray_through(view, True, at[i][0], at[i][1])
    slope = distorted(view, at[i][0], at[i][1])
    seen[i] = wp.vec2(view.fx * slope[0] + view.cx, view.fy * slope[1] + view.cy)


def looked(camera, points):
    """What ``look`` finds for image points, or slopes, [N, 2]."""
    at = wp.array(points.astype(np.float32), dtype=wp.vec2, device="cpu")
    rays, seen = (
        wp.zeros(len(points), dtype=wp.vec3, device="cpu"),
        wp.zeros(len(points), dtype=wp.vec2, device="cpu"),
    )
    wp.launch(
        look, len(points), [view_of(camera, RenderSettings()), at], [rays, seen], device="cpu"
    )
    return rays.numpy(), seen.numpy()


@LENSES
def test_rays_of_kernels_are_those_of_the_camera_and_of_opencv(lens):
    """At any place in a pixel, to 1e-6 of a focal length."""
    camera = wide(lens)
    points = np.random.default_rng(0).uniform([0, 0], [320, 240], (500, 2)).astype(np.float32)
    rays, _ = looked(camera, points)
    got = rays[:, :2] / rays[:, 2:]
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        got, camera.slopes(torch.from_numpy(points).double()).numpy(), atol=1e-6
    )
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    want = cv2.undistortPoints(
        points.astype(np.float64)[:, None],
        matrix,
        coefficients,
        R=np.eye(3),
        P=np.eye(3),
        criteria=stop,
    )[:, 0]
    np.testing.assert_allclose(got, want, atol=1e-6)
    y, x = np.mgrid[:240, :320] + 0.5
    centres, _ = looked(camera, np.stack([x, y], -1).reshape(-1, 2))
    np.testing.assert_allclose(centres.reshape(240, 320, 3), camera.directions().numpy(), atol=1e-6)


@LENSES
def test_what_is_far_outside_stays_outside(lens):
    """Where the polynomial would turn back, its tangent goes on: outwards,
    alike in kernels and camera.
    """
    camera = wide(lens)
    radius = camera.guard.radius
    angle, far = np.meshgrid(np.linspace(0, 2 * np.pi, 41), np.linspace(0.2, 6.0, 400))
    slopes = np.stack([far * np.cos(angle), far * np.sin(angle)], -1)
    flat = torch.from_numpy(np.concatenate([slopes, np.ones((*angle.shape, 1))], -1))
    seen = camera.project(flat).numpy()
    outwards = np.sum(np.diff(seen, axis=0) * slopes[:-1], -1)
    assert outwards.min() > 0
    outside = far > 1.001 * radius
    assert outside.sum() > 1000
    assert ((seen[outside] < 0) | (seen[outside] > [320, 240])).any(-1).all()
    _, got = looked(camera, slopes.reshape(-1, 2))
    np.testing.assert_allclose(got, seen.reshape(-1, 2), rtol=2e-5, atol=2e-4)
    np.testing.assert_allclose(camera.slopes(torch.from_numpy(seen)).numpy(), slopes, atol=1e-6)
    # and without a radius it is OpenCV's polynomial, which comes back into the image
    if lens is BARREL:
        x, _ = lens.apply(np.linspace(radius, 3.0, 200), np.zeros(200))
        assert np.abs(x).min() < 0.1


def test_a_lens_that_folds_beside_its_image_is_refused():
    """Its tangent would have to begin inside the image; the message says how far it can see."""
    # folds at .48 to the right of the axis, far later to its left
    lens = Distortion(k1=-0.4, p2=-0.25)
    options = {"width": 40, "height": 4, "fx": 50.0, "fy": 50.0, "cy": 2.0, "distortion": lens}
    Camera(cx=30.0, **options)
    with pytest.raises(ValueError, match=r"folds the image 0\.\d+ focal lengths"):
        Camera(cx=39.0, **options)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_light_is_that_of_the_bent_rays(lens):
    """Nine rays a pixel: quads of engine mesh are those of the analytic hits,
    first hits are the truth.
    """
    scene = slider(lens=Lens(distortion=lens), subsamples=3, sensor=Sensor(dc_offset=0.2))
    recording = record(scene, frames=4, engine="mesh")
    sequence = recording.sequence
    camera = scene.camera()
    for n, time in enumerate(sequence.times):
        hit = first_hit(
            scene.bodies, camera.resized(3 * camera.width, 3 * camera.height), float(time)
        )
        psi = hit.distance * scene.sensor.phase_slope
        fine = hit.amplitude * (np.cos(psi - sequence.shifts[n]) + 0.2)
        want = fine.reshape(camera.height, 3, camera.width, 3).mean((1, 3))
        off = np.abs(sequence.quads[n] - want) > 1e-4 * np.abs(want).mean()
        assert off.mean() < 1e-2  # a ray on a border of two cells
    assert recording.gap.max < 2e-5
    plain = record(
        slider(subsamples=3, sensor=Sensor(dc_offset=0.2)), frames=4, engine="mesh"
    ).sequence
    assert np.abs(plain.quads - sequence.quads).max() > 0.05 * np.abs(plain.quads).max()


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_engines_agree_through_a_lens(lens):
    """On the demo, away from edges, within the bounds that a pinhole has."""
    scene, size = replace(SCENES["demo"], lens=Lens(distortion=lens)), (192, 144)
    gaussian, mesh = (
        record(scene, frames=4, size=size, noise=False, sync=True, engine=e)
        for e in ("gaussian", "mesh")
    )
    np.testing.assert_array_equal(gaussian.truth.distance, mesh.truth.distance)
    distance, amplitude = apart(phasors(gaussian)[0], phasors(mesh)[0], scene.sensor)
    hit = first_hit(scene.bodies, scene.camera(size), 0.0)
    still, moving = inside(hit, 0), inside(hit, 1)
    assert still.sum() > 5000
    assert moving.sum() > 100
    agree_on_the_demo(distance, amplitude, still, moving)
    assert -0.010 < amplitude[still].mean() < -0.006, (
        "splats as round and as large on the image as a pinhole's"
    )


def test_covers_know_how_a_lens_stretches():
    """Growth of distance per pixel towards where z-depth grows fastest, and the largest stretch,
    by differences.
    """
    camera, rng = wide(BARREL), np.random.default_rng(0)
    points = rng.uniform([20, 20], [300, 220], (100, 2))
    normal = rng.normal(size=(100, 3)) * [0.4, 0.4, 0.1] - [0, 0, 1.0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = rng.uniform(2.0, 4.0, 100)

    def plane(at):
        """Distance and z-depth of the tangent planes at image points."""
        ray = np.concatenate([camera.slopes(torch.from_numpy(at)).numpy(), np.ones((100, 1))], 1)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        centre = camera.slopes(torch.from_numpy(points)).numpy()
        first = np.concatenate([centre, np.ones((100, 1))], 1)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        along = distance * np.sum(first * normal, 1) / np.sum(ray * normal, 1)
        return along, along * ray[:, 2], first

    h = np.array([[1e-3, 0.0], [0.0, 1e-3]])
    by_d, by_z = (
        np.stack([(plane(points + step)[k] - plane(points - step)[k]) / 2e-3 for step in h], 1)
        for k in (0, 1)
    )
    want = np.sum(by_d * by_z, 1) / np.linalg.norm(by_z, axis=1)
    assert np.abs(want).max() > 5e-3
    np.testing.assert_allclose(
        gaussian_cover.depth_slope(normal, distance, plane(points)[2], camera), want, atol=1e-7
    )
    corner = float(
        wide(PINCUSHION).slopes(torch.tensor([[0.5, 239.5]], dtype=torch.float64)).norm()
    )
    assert gaussian_cover.magnification(wide(PINCUSHION)) == pytest.approx(
        1 + 3 * 0.15 * corner**2 - 5 * 0.02 * corner**4
    )


def test_flow_is_between_places_on_the_sensor():
    """Of a body in front of a camera at rest, by both engines:
    the image of the carried point less the pixel.
    """
    scene = slider(lens=Lens(distortion=BARREL), frames=8)
    camera, sequence = scene.camera(), record(scene, engine="mesh", noise=False, flow=True).sequence
    hit = first_hit(scene.bodies, camera, 0.0)
    moved = hit.body == 1
    later, here = (scene.bodies[1].path.world_from_body(t) for t in (float(sequence.times[4]), 0.0))
    point = hit.point[moved] @ (later[:3, :3] @ here[:3, :3].T).T + later[:3, 3] - here[:3, 3]
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    lens = np.array([BARREL.k1, BARREL.k2, BARREL.p1, BARREL.p2, BARREL.k3])
    there = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
    y, x = np.nonzero(moved)
    want = there - np.stack([x, y], -1) - 0.5
    assert np.abs(want).max() > 0.5
    np.testing.assert_allclose(sequence.flow.forward[0][:, moved].T, want, atol=1e-3)
    np.testing.assert_allclose(
        record(scene, flow=True).sequence.flow.forward[0][:, moved].T, want, atol=1e-3
    )


def test_random_points_are_as_dense_everywhere_in_what_a_lens_sees():
    """Drawn on the sensor they would crowd where it magnifies:
    by 0.58 in the corners of this one.
    """
    camera = wide(BARREL)
    settings = replace(InitSettings(), count=40000, bounds=(1.0, 2.0))
    points = in_frusta([camera], settings, torch.Generator().manual_seed(0)).double()
    assert len(points) == 40000
    seen = camera.project(points)
    assert (seen >= -1e-3).all()
    assert (seen <= torch.tensor([320.001, 240.001])).all()
    radius = (points[:, :2] / points[:, 2:]).norm(dim=1)
    counts = [int((radius < r).sum()) for r in (0.25, 0.5)]
    assert counts[1] / counts[0] == pytest.approx(4.0, rel=4 / counts[0] ** 0.5)
    assert float(camera.area(points).min()) < 0.75


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A capture of a box in front of a wall through a strong lens, made by rays, with flow."""
    wall = Body(
        shape=Level(axis=2, value=3.0), texture=Texture(low=0.3, high=0.7, cell=0.4), path=Still()
    )
    box = replace(
        slider().bodies[1], path=Line(position=(-0.1, 0.0, 2.4), velocity=(4.0, 0.0, 0.0))
    )
    scene = slider(bodies=(wall, box), lens=Lens(distortion=BARREL))
    out, options = (
        tmp_path_factory.mktemp("lens") / "seq",
        {"engine": "mesh", "format": "capture", "flow": True},
    )
    return simulate(scene, out, size=(64, 48), noise=False, **options)


def test_a_capture_through_a_lens_is_checked_and_decoded(captured, tmp_path):
    """Check names the lens and warns of nothing; the closed form has the truth's distances;
    comparison takes it.
    """
    report = str(check(captured))
    assert "lens            k1 -0.25, k2 0.08, p1 0.002, p2 -0.003, k3 -0.01" in report
    assert "no warnings" in report
    run = reconstruct(captured, tmp_path / "ctof", "ctof")
    assert Run.open(tmp_path / "ctof").camera.distortion == BARREL
    truth = Sequence.open(captured).truth()
    error = (run.render(0.0).distance.numpy() - truth.distance[0])[truth.body[0] == 0]
    assert np.median(np.abs(error)) < 0.005
    assert compare(run, report=False)["frames"] == 8


def test_a_reconstruction_through_a_lens_is_the_scene(captured, tmp_path, caplog):
    """A pinhole at the same place sees it as the scene is; had the lens been left out,
    walls would bend.
    """
    settings = demo(images=200)
    sequence = Sequence.open(captured)
    pinhole = Camera.from_fov(64, 48, 60.0)
    want, bent = 3.0 / pinhole.directions()[..., 2].numpy(), sequence.truth().distance[0]
    corners = np.abs(want - bent) > 0.1
    assert 300 < corners.sum() < 1500
    corners[6:-6, 12:-12] = False  # the box is there
    errors = []
    with caplog.at_level(logging.INFO):
        for n, given in enumerate((sequence, changed(sequence, distortion=None))):
            run = reconstruct(given, tmp_path / f"run{n}", settings)
            seen = Run.open(run.path).render(0.0, pinhole)
            errors.append(float(np.median(np.abs(seen.distance.numpy() - want)[corners])))
    assert "no graphs" not in caplog.text
    assert errors[0] < 0.03
    assert errors[1] > 2.5 * errors[0]
    run = Run.open(tmp_path / "run0")
    assert run.camera.distortion == BARREL
    assert run.config["camera"]["distortion"]["k1"] == BARREL.k1
    assert "distortion" not in Run.open(tmp_path / "run1").config["camera"]
    again = run.renderer()(0.01, run.camera).distance
    torch.testing.assert_close(again, run.render(0.01).distance, rtol=1e-4, atol=1e-4)
    straight = run.renderer()
    straight(0.01, replace(run.camera, distortion=Distortion()))
    # two cameras, two views
    torch.testing.assert_close(straight(0.01, run.camera).distance, again, rtol=0, atol=0)


def test_layouts_without_a_lens_refuse_it(tmp_path):
    """Before anything is recorded; so is an image in which it folds at the size that is asked
    for.
    """
    for layout in ("ftorf", "torf"):
        with pytest.raises(UsageError, match="cannot express this lens") as caught:
            simulate("demo", tmp_path / "out", format=layout, overrides=["lens.distortion.k1=-0.1"])
        assert caught.value.where == "lens.distortion"
    edge = {"format": "capture", "frames": 4, "overrides": ["lens.distortion.k1=-0.27"]}
    with pytest.raises(UsageError, match="cannot be undone"):
        simulate("demo", tmp_path / "out", size=(16, 48), **edge)
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.iterdir())


def test_covers_reach_into_a_margin_where_the_lens_folds():
    """Three pixels of 24 beside the image: there the polynomial has an end,
    and the cover goes on.
    """
    scene = replace(SCENES["demo"], lens=Lens(distortion=Distortion(k1=-0.27)))
    camera = scene.camera((24, 18))
    with pytest.raises(ValueError, match="cannot be undone"):
        replace(camera, width=30, height=24, cx=camera.cx + 3, cy=camera.cy + 3)
    gaussian, mesh = (
        record(scene, frames=1, size=(24, 18), noise=False, engine=e) for e in ("gaussian", "mesh")
    )
    border = np.ones((18, 24), dtype=bool)
    border[1:-1, 1:-1] = False
    light = [recording.truth.amplitude[0][border].mean() for recording in (gaussian, mesh)]
    assert light[0] == pytest.approx(light[1], rel=0.05)


def test_zero_coefficients_are_a_pinhole():
    """Not another kernel, and not another bit."""
    zero = replace(BENT, distortion=Distortion(k1=0.0))
    assert not zero.distortion
    assert view_of(zero, RenderSettings()).radius == 0.0
    assert view_of(BENT, RenderSettings()).radius == pytest.approx(BENT.guard.radius)
