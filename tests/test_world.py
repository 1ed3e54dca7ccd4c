"""Paths, shapes and their exact first hits; the splats that cover them."""

import math

import numpy as np
import pytest
import torch

from gftorf_warp.constants import ALPHA_MAX, LOW_PASS
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor
from gftorf_warp.sim import gaussian_cover
from gftorf_warp.sim.bodies import room
from gftorf_warp.sim.paths import Arc, Line, Still, rotation_matrix
from gftorf_warp.sim.world import Body, Box, Plane, Sphere, Texture, first_hit

GREY = Texture(low=0.5, high=0.5)
CAMERA = Camera.from_fov(32, 24, 60.0)
AHEAD = Camera.from_fov(1, 1, 1.0)  # one ray, straight along +z
TURN = (20.0, -35.0, 50.0)


def signed_distance(shape, point):
    """Distance [m] of points in the shape's axes from its surface,
    positive on the side from which it is seen.
    """
    if isinstance(shape, Sphere):
        return np.linalg.norm(point, axis=1) - shape.radius
    outside = np.abs(point) - np.asarray(shape.size) / 2
    far = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(1), 0.0)
    return -far if shape.inside else far


def march(body, camera, time):
    """First hits by sphere tracing, an algorithm that shares nothing with closed forms;
    NaN after 30 m.
    """
    pose = np.linalg.inv(body.path.world_from_body(time))
    ray = camera.rays(dtype=torch.float64).numpy().reshape(-1, 3)
    distance = np.zeros(len(ray))
    for _ in range(4000):
        point = (camera.centre + ray * distance[:, None]) @ pose[:3, :3].T + pose[:3, 3]
        distance = np.minimum(distance + signed_distance(body.shape, point), 30.0)
    return np.where(distance < 29.0, distance, np.nan).reshape(camera.height, camera.width)


@pytest.mark.parametrize(
    "body",
    [
        Body(
            shape=Box(size=(1.2, 0.8, 0.9)),
            texture=GREY,
            path=Still(position=(0.2, -0.1, 2.5), turn_deg=TURN),
        ),
        Body(
            shape=Box(size=(4.0, 3.0, 6.0), inside=True),
            texture=GREY,
            path=Still(position=(0.1, 0.2, 1.0)),
        ),
        Body(shape=Sphere(radius=0.7), texture=GREY, path=Still(position=(-0.3, 0.2, 2.2))),
    ],
    ids=["box", "room", "sphere"],
)
def test_hits_agree_with_marching(body):
    """Closed forms against sphere tracing on the exact signed distance,
    from a camera that is turned and displaced.
    """
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix((3.0, -4.0, 5.0)), (0.1, -0.05, 0.2)
    camera = CAMERA.at(pose)
    got, want = first_hit((body,), camera, 0.0), march(body, camera, 0.0)
    both = np.isfinite(want) & np.isfinite(got.distance)
    assert both.sum() > 100
    assert (np.isfinite(want) != np.isfinite(got.distance)).sum() <= 2  # rays that graze an outline
    np.testing.assert_allclose(got.distance[both], want[both], atol=1e-6)
    point = camera.centre + camera.rays(dtype=torch.float64).numpy() * got.distance[..., None]
    np.testing.assert_allclose(got.point[both], point[both], atol=1e-12)
    step = 1e-6  # the normal is the gradient of the signed distance
    inverse = np.linalg.inv(body.path.world_from_body(0.0))
    for axis in range(3):
        ahead, behind = (
            signed_distance(
                body.shape,
                (got.point[both] + side * step * np.eye(3)[axis]) @ inverse[:3, :3].T
                + inverse[:3, 3],
            )
            for side in (1, -1)
        )
        error = np.abs((ahead - behind) / (2 * step) - got.normal[both][:, axis])
        assert np.quantile(error, 0.99) < 1e-5  # at an edge a difference sees two faces


def test_flat_wall_holds_distance_not_depth():
    """T1: d = D / cos(theta), and the phase follows d."""
    wall = Body(shape=Plane(size=(9.0, 9.0)), texture=GREY, path=Still(position=(0.0, 0.0, 3.0)))
    hit = first_hit((wall,), CAMERA, 0.0)
    cosine = CAMERA.rays(dtype=torch.float64).numpy()[..., 2]
    np.testing.assert_allclose(hit.distance, 3.0 / cosine, rtol=1e-12)
    np.testing.assert_allclose(hit.amplitude, 0.5 * cosine / (3.0 / cosine) ** 2, rtol=1e-12)


def test_wrap():
    """T2: a wall k unambiguous ranges farther decodes to the same distance."""
    sensor = Sensor()
    for turns in range(4):
        for part in (0.01, 0.3, 0.99):
            true = (turns + part) * sensor.unambiguous_range
            wall = Body(
                shape=Plane(size=(9.0, 9.0)), texture=GREY, path=Still(position=(0.0, 0.0, true))
            )
            phase = torch.from_numpy(first_hit((wall,), AHEAD, 0.0).distance) * sensor.phase_slope
            decoded = distance_from_phasor(phase.cos(), phase.sin(), sensor)
            assert float(decoded) == pytest.approx(part * sensor.unambiguous_range, abs=1e-9)


def test_falloff_and_tilt():
    """T3 and T4: amplitude falls with 1/d^2 and with the cosine of the incidence."""

    def amplitude(z, turn):
        wall = Body(
            shape=Plane(size=(9.0, 9.0)),
            texture=GREY,
            path=Still(position=(0, 0, z), turn_deg=(0, turn, 0)),
        )
        return first_hit((wall,), AHEAD, 0.0).amplitude.item()

    assert math.log(amplitude(4.0, 0.0) / amplitude(1.0, 0.0)) / math.log(4.0) == pytest.approx(
        -2.0, abs=1e-9
    )
    assert amplitude(2.0, 60.0) / amplitude(2.0, 0.0) == pytest.approx(0.5, rel=1e-9)


def test_the_nearest_body_wins_and_what_is_not_there_is_unknown():
    """A ball in front of a small wall; rays beside both hit nothing;
    a plane is not seen from behind.
    """
    ball = Body(shape=Sphere(radius=0.3), texture=GREY, path=Still(position=(0.0, 0.0, 2.0)))
    wall = Body(shape=Plane(size=(1.5, 1.5)), texture=GREY, path=Still(position=(0.0, 0.0, 3.0)))
    away = Body(
        shape=Plane(size=(9.0, 9.0)),
        texture=GREY,
        path=Still(position=(0, 0, 1.0), turn_deg=(0, 180, 0)),
    )
    behind = Body(shape=Sphere(radius=0.5), texture=GREY, path=Still(position=(0.0, 0.0, -2.0)))
    hit = first_hit((wall, away, ball, behind), CAMERA, 0.0)
    np.testing.assert_array_equal(
        hit.distance, first_hit((behind, ball, away, wall), CAMERA, 0.0).distance
    )
    assert hit.body[12, 16] == 2
    assert hit.distance[12, 16] == pytest.approx(1.7, abs=5e-3)
    assert hit.body[12, 21] == 0
    assert hit.body[0, 0] == -1
    assert np.isnan(hit.distance[0, 0])
    assert hit.amplitude[0, 0] == 0.0


def test_texture_is_the_documented_hash():
    """Section 4.1 of the sensor notes in unbounded integers; values spread over the range."""
    texture = Texture(low=0.2, high=0.8, cell=0.3)
    point = np.random.default_rng(0).uniform(-5.0, 5.0, (500, 3))
    want = []
    for p in point:
        x, y, z = (math.floor((c + 37.0001) / 0.3) for c in p)
        unit = ((((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) * 2654435761) & 0xFFFF) / 65535
        want.append(0.2 + 0.6 * unit)
    np.testing.assert_allclose(texture(point), want, rtol=1e-12)
    assert np.ptp(want) > 0.5


def test_a_line_passes_its_point_and_spins():
    """Position, velocity and spin, against the definition."""
    path = Line(
        position=(1.0, 2.0, 3.0),
        velocity=(0.5, 0.0, -2.0),
        passing_s=0.2,
        spin_deg_per_s=(0.0, 90.0, 0.0),
    )
    np.testing.assert_allclose(path.world_from_body(0.2)[:3, 3], (1.0, 2.0, 3.0))
    later = path.world_from_body(1.2)
    np.testing.assert_allclose(later[:3, 3], (1.5, 2.0, 1.0))
    # a quarter turn about y: z to x
    np.testing.assert_allclose(later[:3, :3] @ [0, 0, 1], (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(later[:3, :3] @ later[:3, :3].T, np.eye(3), atol=1e-12)


def test_an_arc_keeps_its_radius_and_faces_outwards():
    """The +x face points away from the centre; speed is radius times rate."""
    path = Arc(centre=(0.2, 0.1, 3.0), radius=0.8, start_deg=-30.0, rate_deg_per_s=200.0)
    for time in (0.0, 0.13, 0.9):
        pose = path.world_from_body(time)
        outwards = (pose[:3, 3] - (0.2, 0.1, 3.0)) / 0.8
        assert np.linalg.norm(outwards) == pytest.approx(1.0)
        np.testing.assert_allclose(pose[:3, :3] @ [1, 0, 0], outwards, atol=1e-12)
    step = path.world_from_body(1e-6)[:3, 3] - path.world_from_body(0.0)[:3, 3]
    assert np.linalg.norm(step) / 1e-6 == pytest.approx(0.8 * math.radians(200.0), rel=1e-6)


@pytest.mark.parametrize(
    "shape", [Box(size=(0.5, 0.3, 0.4)), Plane(size=(0.5, 0.3)), Sphere(radius=0.3)]
)
def test_grids_cover_their_surface(shape):
    """Every point of the grid is on the surface, and no hit on the surface is farther from the
    grid than a spacing.
    """
    grid = shape.grid(0.03, 0.01)
    if not isinstance(shape, Plane):
        np.testing.assert_allclose(signed_distance(shape, grid.point), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(grid.normal, axis=1), 1.0)
    body = Body(
        shape=shape, texture=GREY, path=Still(position=(0.0, 0.0, 1.2), turn_deg=(25.0, 30.0, 0.0))
    )
    hit = first_hit((body,), CAMERA, 0.0)
    seen = np.isfinite(hit.distance)
    pose = np.linalg.inv(body.path.world_from_body(0.0))
    local = hit.point[seen] @ pose[:3, :3].T + pose[:3, 3]
    gaps = np.linalg.norm(local[:, None] - grid.point, axis=2).min(1)
    assert seen.sum() > 50
    assert gaps.max() < 0.03


def test_edges_of_a_box_belong_to_two_faces():
    """Twelve rows with two perpendicular normals each;
    the faces stay ``inset`` away from the edges.
    """
    grid = Box(size=(0.6, 0.6, 0.6)).grid(0.1, 0.02)
    edge = np.abs((grid.normal * grid.other).sum(1)) < 0.5
    assert (np.isclose(np.abs(grid.point), 0.3).sum(1)[edge] == 2).all()
    assert edge.sum() == 12 * 6
    assert np.sort(np.abs(grid.point[~edge]), axis=1)[:, 1].max() <= 0.28


def test_overlap_and_spread_of_what_is_known():
    """A lone splat; one splat and its four neighbours by hand; a denser cover reaches farther."""
    share, lead = gaussian_cover.overlap(50.0, 0.34, True)
    assert share == pytest.approx(ALPHA_MAX)
    assert lead == 0.0
    # diagonal neighbours stay below 1/255
    beside, through = math.exp(-1 / 0.2), 1 - math.exp(-1 / 0.2)
    share, lead = gaussian_cover.overlap(1.0, 0.1, True)
    weights = [beside, beside * through, ALPHA_MAX * through**2]
    weights += [beside * through**2 * (1 - ALPHA_MAX), beside * through**3 * (1 - ALPHA_MAX)]
    shares = [beside, beside * through**2, ALPHA_MAX * through**4]
    shares += [
        beside * through**4 * (1 - ALPHA_MAX) ** 2,
        beside * through**6 * (1 - ALPHA_MAX) ** 2,
    ]
    assert share == pytest.approx(sum(shares), rel=1e-12)
    assert lead == pytest.approx((weights[0] - weights[4]) / sum(weights), rel=1e-12)
    assert gaussian_cover.spread(0.4, 0.34) > gaussian_cover.spread(0.8, 0.34) > 0.4


def test_quaternions_turn_like_their_matrices():
    """All four branches of the conversion: small turns, and half turns about each axis."""
    turns = [(1, 2, 3), (179, 3, 2), (2, 179, 3), (3, 2, 179), (100, -120, 60), (0, 0, 0)]
    matrices = np.stack([rotation_matrix(turn) for turn in turns])
    w, x, y, z = gaussian_cover.quaternions(matrices).T
    np.testing.assert_allclose(w**2 + x**2 + y**2 + z**2, 1.0)
    got = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        axis=1,
    )
    np.testing.assert_allclose(got, matrices, atol=1e-12)


def test_discs_lie_in_their_surface():
    """Turned by their quaternions, the thin axes are the normals of a turned box at that time,
    and face the camera.
    """
    path = Line(
        position=(0.1, 0.0, 2.3),
        velocity=(0.0, 0.0, -1.0),
        turn_deg=TURN,
        spin_deg_per_s=(0.0, 400.0, 0.0),
    )
    body = Body(shape=Box(size=(0.6, 0.6, 0.6)), texture=GREY, path=path)
    field = gaussian_cover.cover_moving(body, CAMERA, np.array([0.0, 0.1])).facing(
        CAMERA.centre, 0.07
    )
    w, x, y, z = field.quaternion.double().numpy().T
    thin = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert (field.log_scale.argmin(1) == 2).all()
    # rows: directions of the six faces, up to their sign
    faces = path.world_from_body(0.07)[:3, :3].T
    assert np.abs(thin @ faces.T).max(1).min() > 1 - 1e-6
    assert (np.sum(thin * (CAMERA.centre - field.mean.numpy()), axis=1) > 0).all()
    assert len(field) > 100


@pytest.mark.parametrize(
    ("shape", "turn", "bound"),
    [
        (Box(size=(0.6, 0.6, 0.6)), (0.0, 0.0, 0.0), 0.4),
        (Box(size=(0.6, 0.6, 0.6)), (20.0, 30.0, 0.0), 0.6),  # faces met at a glancing angle
        (Plane(size=(0.7, 0.5)), (20.0, 30.0, 0.0), 0.2),
        (Sphere(radius=0.4), (0.0, 0.0, 0.0), 0.4),
    ],
    ids=["box", "turned box", "plane", "sphere"],
)
def test_a_moving_cover_is_opaque_and_as_large_as_its_shape(shape, turn, bound):
    """Opacity is 1 inside, and its sum is the analytic area:
    the outline is off by less than ``bound`` rays.
    """
    camera = Camera.from_fov(96, 72, 60.0)
    path = Line(position=(0.1, 0.0, 2.3), velocity=(1.0, 0.0, -1.0), turn_deg=turn)
    body = Body(shape=shape, texture=GREY, path=path)
    field = gaussian_cover.cover_moving(body, camera, np.array([0.0, 0.1])).facing(
        camera.centre, 0.05
    )
    opacity = rasterize(field, camera, Sensor()).opacity.numpy()
    fine = first_hit((body,), camera.resized(960, 720), 0.05).body >= 0
    area = fine.reshape(72, 10, 96, 10).mean((1, 3))
    full, touched = np.ones_like(area, dtype=bool), (area > 0) & (area < 1)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            full &= np.roll(area, (dy, dx), (0, 1)) == 1.0
    assert full.sum() > 100
    assert opacity[full].min() > 0.9
    assert opacity[full].mean() > 0.995
    assert abs(opacity.sum() - area.sum()) < bound * touched.sum()


def test_a_cover_returns_the_light_of_its_surface():
    """Mean amplitude of a rendered still room is the analytic one:
    the overlap of splats is accounted for.
    """
    bodies, camera = (room(),), Camera.from_fov(96, 72, 60.0)
    field = gaussian_cover.cover_still(bodies, camera).facing(camera.centre, 0.0)
    rendered = rasterize(field, camera, Sensor()).phasor[2].numpy() / 2
    hit = first_hit(bodies, camera, 0.0)
    assert rendered.mean() == pytest.approx(hit.amplitude.mean(), rel=0.02)
    assert np.abs(rendered - hit.amplitude).mean() < 0.1 * hit.amplitude.mean()
    # what the constants of the cover were chosen for
    assert LOW_PASS + gaussian_cover.RADIUS**2 < 0.4
