"""Planes without an end, and several shapes as one rigid body."""

import numpy as np
import pytest
import torch

from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.assembly import FACES, Assembly, Level, Part
from gftorf_warp.sim.bodies import chair
from gftorf_warp.sim.gaussian_cover import clearance, cover_moving, splats_of
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.record import still_interior
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.world import Body, Box, Plane, Sphere, Texture, first_hit

GREY = Texture(low=0.5, high=0.5)
CAMERA = Camera.from_fov(64, 48, 60.0)
TURN = (15.0, 40.0, -10.0)


def posed(shape, position=(0.1, 0.0, 2.2), turn=TURN, texture=GREY):
    """A body at rest."""
    return Body(shape=shape, texture=texture, path=Still(position=position, turn_deg=turn))


def test_a_wall_without_end_is_a_wall():
    """The same hits as a rectangle that fills the view; a floor is met below the horizon only,
    and from both sides.
    """
    wall = first_hit((posed(Level(axis=2, value=3.0), (0, 0, 0), (0, 0, 0)),), CAMERA, 0.0)
    want = first_hit((posed(Plane(size=(9.0, 9.0)), (0, 0, 3.0), (0, 0, 0)),), CAMERA, 0.0)
    np.testing.assert_allclose(wall.distance, want.distance, rtol=1e-12)
    np.testing.assert_array_equal(wall.normal, want.normal)
    np.testing.assert_allclose(wall.amplitude, want.amplitude, rtol=1e-12)
    down = CAMERA.rays(dtype=torch.float64).numpy()[..., 1]
    for value in (0.9, -0.7):
        level = first_hit((posed(Level(axis=1, value=value), (0, 0, 0), (0, 0, 0)),), CAMERA, 0.0)
        met = down * value > 0
        np.testing.assert_array_equal(np.isfinite(level.distance), met)
        np.testing.assert_allclose((level.distance * down)[met], value, rtol=1e-12)
        np.testing.assert_allclose(
            (level.normal * CAMERA.rays(dtype=torch.float64).numpy()).sum(-1)[met].max(),
            0,
            atol=0.02,
        )
        assert (level.normal[met][:, 1] == -np.sign(value)).all()


def test_texture_of_a_wall_is_that_of_the_world():
    """Reflectance where a ray meets the wall is the texture at that point of the world."""
    texture = Texture(low=0.1, high=0.9, cell=0.2)
    hit = first_hit((posed(Level(axis=2, value=3.3), (0, 0, 0), (0, 0, 0), texture),), CAMERA, 0.0)
    np.testing.assert_array_equal(hit.reflectance.ravel(), texture(hit.point.reshape(-1, 3)))
    assert np.ptp(hit.reflectance) > 0.5


def test_an_assembly_is_hit_where_its_parts_are():
    """Distance, normal and amplitude of parts as one body and as bodies of their own;
    each part keeps its faces.
    """
    parts = (
        Part(shape=Box(size=(0.5, 0.1, 0.3)), position=(0.0, 0.2, 0.0)),
        Part(shape=Box(size=(0.1, 0.6, 0.1)), position=(0.17, -0.1, 0.07)),  # no faces in one plane
        Part(shape=Sphere(radius=0.2), position=(-0.3, -0.2, 0.0)),
    )
    whole = first_hit((posed(Assembly(parts=parts)),), CAMERA, 0.0)
    pose = posed(parts[0].shape).path.world_from_body(0.0)
    alone = [posed(p.shape, tuple(pose[:3, :3] @ p.position + pose[:3, 3])) for p in parts]
    want = first_hit(tuple(alone), CAMERA, 0.0)
    np.testing.assert_allclose(whole.distance, want.distance, rtol=1e-12)
    np.testing.assert_allclose(whole.normal, want.normal, atol=1e-12)
    np.testing.assert_allclose(whole.amplitude, want.amplitude, rtol=1e-9)
    seen = whole.body == 0
    np.testing.assert_array_equal(whole.face[seen] // FACES, want.body[seen])
    np.testing.assert_array_equal(whole.face[seen] % FACES, want.face[seen])
    assert set(np.unique(want.body)) == {-1, 0, 1, 2}


def test_an_assembly_reaches_as_far_as_its_parts_and_is_as_near():
    """Every point of its grid is within reach, and none is nearer to the camera than the clearance
    says.
    """
    body = Body(
        shape=chair(),
        texture=GREY,
        path=Line(position=(0.3, 0.2, 1.4), velocity=(0, 0, -1.0), turn_deg=TURN),
    )
    grid = body.shape.grid(0.01, 0.0)
    assert len(grid.point) == len(grid.normal) == len(grid.other) > 1000
    assert np.linalg.norm(grid.point, axis=1).max() <= body.shape.reach
    times = np.array([0.0, 0.3])
    for time, near in zip(times, clearance(body, np.zeros(3), times), strict=True):
        pose = body.path.world_from_body(time)
        nearest = np.linalg.norm(grid.point @ pose[:3, :3].T + pose[:3, 3], axis=1).min()
        assert near <= nearest + 1e-12
        assert near > nearest - 0.02
        assert near > np.linalg.norm(pose[:3, 3]) - body.shape.reach
    ball = Body(
        shape=Assembly(parts=(Part(shape=Sphere(radius=0.2)),)), texture=GREY, path=body.path
    )
    assert clearance(ball, np.zeros(3), times[:1])[0] == pytest.approx(
        np.linalg.norm((0.3, 0.2, 1.4)) - 0.2
    )


@pytest.mark.parametrize("shape", [Plane(size=(6.0, 1.0)), Box(size=(6.0, 1.0, 0.02))])
def test_a_wide_plate_near_the_camera_is_covered(shape):
    """Its bounding sphere holds the camera, the plate does not."""
    times = np.array([0.0, 0.1])
    body = Body(shape=shape, texture=GREY, path=Line(position=(0, 0, 2.9), velocity=(0, 0, -0.5)))
    near = clearance(body, np.zeros(3), times)
    np.testing.assert_allclose(near, [2.9, 2.85], atol=0.011)
    field = cover_moving(body, CAMERA, times).facing(np.zeros(3), 0.0)
    opacity = rasterize(field, CAMERA, Sensor()).opacity
    assert opacity[20:28, 8:56].min() > 0.98


@pytest.mark.parametrize(
    "shape",
    [
        Plane(size=(0.7, 0.5)),
        Box(size=(0.3, 0.5, 0.1)),
        Sphere(radius=0.3),
        Assembly(parts=(Part(shape=Sphere(radius=0.2)), Part(shape=Box(size=(0.4, 0.3, 0.3))))),
    ],
    ids=["plane", "box", "sphere", "assembly"],
)
def test_the_number_of_splats_is_known_before_they_are_made(shape):
    """Which decides whether memory holds them."""
    times, camera = np.array([0.0, 0.1]), Camera.from_fov(320, 2, 60.0)
    body = Body(shape=shape, texture=GREY, path=Line(position=(0, 0, 2.3), velocity=(0, 0, -1)))
    made = len(cover_moving(body, camera, times))
    assert splats_of(body, camera, times, np.zeros((2, 3))) == pytest.approx(made, rel=0.05)


def test_the_clearance_in_a_room_is_that_of_its_walls():
    """A camera may stand in a room that moves, and not in its wall."""
    room = Box(size=(4.0, 2.0, 6.0), inside=True)
    points = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.0]])
    np.testing.assert_allclose(room.clearance(points), [1.0, 0.5, -0.5])


def test_a_cover_of_an_assembly_is_as_large_as_it_is():
    """Opacity sums up to the area of a table but for its outline, and is 1 inside it."""
    top, leg = Box(size=(0.9, 0.1, 0.5)), Box(size=(0.15, 0.6, 0.15))
    table = Assembly(
        parts=(Part(shape=top), *(Part(shape=leg, position=(x, 0.35, 0.1)) for x in (-0.35, 0.35)))
    )
    body = Body(
        shape=table, texture=GREY, path=Line(position=(0.0, -0.1, 2.3), velocity=(1.0, 0.0, 0.0))
    )
    camera = Camera.from_fov(96, 72, 60.0)
    field = cover_moving(body, camera, np.array([0.0, 0.1])).facing(camera.centre, 0.05)
    opacity = rasterize(field, camera, Sensor()).opacity.numpy()
    area = (
        (first_hit((body,), camera.resized(960, 720), 0.05).body >= 0)
        .reshape(72, 10, 96, 10)
        .mean((1, 3))
    )
    inner = np.ones_like(area, dtype=bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            inner &= np.roll(area, (dy, dx), (0, 1)) == 1.0
    assert inner.sum() > 50
    assert opacity[inner].min() > 0.9
    touched = (area > 0) & (area < 1)
    assert abs(opacity.sum() - area.sum()) < 0.4 * touched.sum()  # of a ray, as for single shapes


def test_interior_pixels_know_the_parts_of_an_assembly():
    """The front of the second part of one body and that of the next body have numbers of their
    own: no interior.
    """
    parts = tuple(
        Part(shape=Box(size=(0.4, 3.0, 0.4)), position=(x, 0.0, 0.0)) for x in (-0.4, 0.0)
    )
    posts = (
        posed(Assembly(parts=parts), (0.0, 0.0, 2.0), (0, 0, 0)),
        posed(Box(size=(0.4, 3.0, 0.4)), (0.4, 0, 2.0), (0, 0, 0)),
    )
    scene = Scene(
        name="posts", description="", motion="", bodies=posts, frames=1, width=64, height=48
    )
    hit = first_hit(posts, CAMERA, 0.0)
    inside = still_interior(scene, [hit])
    steps = np.flatnonzero(np.diff(hit.body[24] * 100 + hit.face[24]))
    front = steps[(hit.face[24][steps] % 8 == 4) & (hit.face[24][steps + 1] % 8 == 4)]
    assert len(front) == 2
    for column in front:
        assert not inside[:, column - 1 : column + 3].any()
    assert inside.sum() > 100


def test_what_cannot_be_is_refused():
    """Walls do not move, assemblies have parts, parts have an end, coordinates are three."""
    with pytest.raises(ValueError, match="cannot be covered while it moves"):
        Level(axis=2, value=1.0).grid(0.1, 0.0)
    with pytest.raises(ValueError, match="at least one part"):
        Assembly(parts=())
    with pytest.raises(ValueError, match="must be finite"):
        Part(shape=Level(axis=2, value=1.0))
    with pytest.raises(ValueError, match="single shape"):
        Part(shape=chair())
    with pytest.raises(ValueError, match="axis must be"):
        Level(axis=3, value=1.0)
