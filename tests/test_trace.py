"""Rays through meshes: closed forms of distance, phase, amplitude, shadow, mixture and blur;
hits against the truth.
"""

import math

import numpy as np
import pytest
import torch
from comparison import DEVICES

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.render.trace import RigidBody, Tracer
from gftorf_warp.scene.camera import Camera
from gftorf_warp.sim.bodies import room
from gftorf_warp.sim.mesh_engine import MeshEngine, rigid_bodies, triangles_of
from gftorf_warp.sim.paths import Line, Still, inverse, rigid, rotation_matrix
from gftorf_warp.sim.scenes import SCENES, Scene
from gftorf_warp.sim.world import Body, Box, Plane, Sphere, Texture, first_hit

GREY = Texture(low=0.5, high=0.5)
CAMERA = Camera.from_fov(32, 24, 60.0)
AHEAD = Camera.from_fov(1, 1, 1.0)  # one ray, straight along +z
F_MOD_HZ = 2e7
RANGE = SPEED_OF_LIGHT / (2 * F_MOD_HZ)  # [m]
TURNED = rigid(rotation_matrix((3.0, -4.0, 5.0)), np.array([0.1, -0.05, 0.2]))


@pytest.fixture(params=DEVICES)
def device(request):
    """Every device there is: the images are those of the same kernels."""
    return request.param


def plane(z, size=(90.0, 90.0), x=0.0, y=0.0, turn=0.0, texture=GREY):
    """A rectangle that faces the camera, or is turned about y by ``turn`` [deg]."""
    return Body(
        shape=Plane(size=size),
        texture=texture,
        path=Still(position=(x, y, z), turn_deg=(0.0, turn, 0.0)),
    )


def scene_of(*bodies, subsamples=1, **more):
    """A scene for the tracer; its own camera is not asked."""
    size = {"frames": 4, "width": 32, "height": 24, "subsamples": subsamples}
    return Scene(name="test", description="a test", motion="none", bodies=bodies, **size, **more)


def light(
    *bodies, camera=CAMERA, device="cpu", f_mod_hz=F_MOD_HZ, times=(0.0,), harmonics=(1,), **more
):
    """Direct light of bodies at one camera."""
    traced = MeshEngine(
        scene_of(*bodies, **more), lambda _: camera, device=device, harmonics=harmonics
    )
    return traced.light(times, f_mod_hz)


def decoded(light, f_mod_hz=F_MOD_HZ):
    """Distance [m] in [0, c/2f) of the first harmonic."""
    return (
        np.angle(light.light[0].astype(np.complex128))
        % (2 * math.pi)
        * SPEED_OF_LIGHT
        / (4 * math.pi * f_mod_hz)
    )


def expected(bodies, camera, time=0.0, f_mod_hz=F_MOD_HZ, subsamples=1):
    """Mean light and amplitude from the analytic hits of every sub-sample, in float64."""
    fine = camera.resized(camera.width * subsamples, camera.height * subsamples)
    hit = first_hit(bodies, fine, time)
    phase = 4 * math.pi * f_mod_hz / SPEED_OF_LIGHT * np.nan_to_num(hit.distance)
    blocks = (camera.height, subsamples, camera.width, subsamples)
    return tuple(
        image.reshape(blocks).mean((1, 3))
        for image in (hit.amplitude * np.exp(1j * phase), np.asarray(hit.amplitude))
    )


# -- what is hit -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(SCENES))
def test_hits_are_the_analytic_ones(name, device):
    """Body, distance (2e-5 m), z-depth and normal of every named scene at two times,
    also of a camera that moves.
    """
    scene = SCENES[name]
    traced = MeshEngine(scene, lambda time: scene.camera((96, 72), time), device=device)
    for time in (0.0, 0.17):
        camera = scene.camera((96, 72), time)
        got, want = traced.first_hits(time), first_hit(scene.bodies, camera, time)
        same = got.body == want.body
        # two bodies whose faces lie in one plane
        level = ~same & (np.abs(got.distance - want.distance) < 2e-5)
        assert level.sum() <= 2
        assert (~same & ~level).sum() <= 1  # a ray that grazes an outline
        np.testing.assert_allclose(got.distance[same], want.distance[same], atol=2e-5)
        cosine = camera.resized(96, 72).at(np.eye(4)).rays(dtype=torch.float64).numpy()[..., 2]
        np.testing.assert_allclose(got.z_depth[same], (want.distance * cosine)[same], atol=2e-5)
        apart = np.abs(got.normal - want.normal)[same].max(-1)
        assert (apart > 2e-5).sum() <= 1  # a ray along an edge of a box


def test_reflectance_is_that_of_the_world(device):
    """Amplitudes of all named scenes equal rho cos / d^2 of the analytic hits;
    rays on a border of cells may not.
    """
    for scene in SCENES.values():
        camera = scene.camera((96, 72), 0.1)
        got = light(*scene.bodies, camera=camera, device=device, times=(0.1,)).amplitude
        off = np.abs(got / expected(scene.bodies, camera, 0.1)[1] - 1) > 1e-4
        assert off.mean() < 2e-3


def test_nothing_is_hit_and_surfaces_have_one_side(device):
    """A plane from behind, a room from outside, a ball from within and what is behind the camera
    are not there.
    """
    behind = plane(1.0, turn=180.0)
    around = Body(shape=Sphere(radius=9.0), texture=GREY, path=Still())
    away = Body(shape=Sphere(radius=0.5), texture=GREY, path=Still(position=(0.0, 0.0, -2.0)))
    outside = Body(
        shape=Box(size=(2.0, 2.0, 2.0), inside=True),
        texture=GREY,
        path=Still(position=(0.0, 0.0, 3.0)),
    )
    bodies = (behind, around, away, outside)
    got = MeshEngine(scene_of(*bodies), lambda _: CAMERA, device=device).first_hits(0.0)
    want = first_hit(bodies, CAMERA, 0.0)
    np.testing.assert_array_equal(got.body, want.body)
    assert set(np.unique(got.body)) == {-1, 3}
    assert got.distance[12, 16] == pytest.approx(want.distance[12, 16], abs=2e-5)
    assert want.distance[12, 16] > 3.9  # the far wall, seen through the near one
    nothing = got.body < 0
    assert np.isnan(got.distance[nothing]).all()
    assert np.isnan(got.z_depth[nothing]).all()
    assert np.isnan(got.normal[nothing]).all()
    empty = light(*bodies, device=device)
    assert (empty.amplitude[nothing] == 0).all()
    assert (empty.light[0][nothing] == 0).all()


@pytest.mark.parametrize("inside", [False, True])
def test_triangles_of_a_box_face_the_right_way(inside):
    """Twelve triangles, normals outwards or inwards, whose areas sum to the surface:
    closed and without gaps.
    """
    points, triangles = triangles_of(Box(size=(1.0, 2.0, 3.0), inside=inside))
    corner = points[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    assert len(triangles) == 12
    outwards = np.sum(normal * corner.mean(1), axis=1)
    assert ((outwards > 0) != inside).all()
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(2 * (2 + 3 + 6))
    np.testing.assert_allclose(normal.sum(0), 0, atol=1e-12)
    edges = {(int(a), int(b)) for t in triangles for a, b in zip(t, np.roll(t, -1), strict=True)}
    assert edges == {(b, a) for a, b in edges}  # every edge has two sides: the surface is closed


# -- what comes back, light at the camera ----------------------------------------------------------


def test_flat_wall(device):
    """T1: d = D / cos(theta), phase 4 pi f d / c within 2e-5 m,
    amplitude rho cos / d^2 within 1e-5.
    """
    got = light(plane(3.0), device=device)
    cosine = CAMERA.rays(dtype=torch.float64).numpy()[..., 2]
    np.testing.assert_allclose(decoded(got), 3.0 / cosine, atol=2e-5)
    np.testing.assert_allclose(got.amplitude, 0.5 * cosine / (3.0 / cosine) ** 2, rtol=1e-5)
    np.testing.assert_allclose(np.abs(got.light[0]), got.amplitude, rtol=1e-5)


def test_wrap(device):
    """T2: a wall k unambiguous ranges farther decodes to the same distance, k up to 3."""
    for turns in range(4):
        for part in (0.01, 0.3, 0.99):
            got = light(plane((turns + part) * RANGE), camera=AHEAD, device=device)
            assert decoded(got).item() == pytest.approx(part * RANGE, abs=2e-5)
    for turns in (1, 2, 3):  # on the wrap itself either end will do
        whole = decoded(light(plane(turns * RANGE), camera=AHEAD, device=device)).item()
        assert min(whole, RANGE - whole) < 2e-5


def test_falloff_and_tilt(device):
    """T3 and T4: amplitude falls with 1/d^2 (slope within 1e-4) and with the cosine of the
    incidence (1e-5).
    """

    def amplitude(z, turn):
        return light(plane(z, turn=turn), camera=AHEAD, device=device).amplitude.item()

    assert math.log(amplitude(4.0, 0.0) / amplitude(1.0, 0.0)) / math.log(4.0) == pytest.approx(
        -2.0, abs=1e-4
    )
    for turn in (10.0, 45.0, 80.0):
        assert amplitude(2.0, turn) / amplitude(2.0, 0.0) == pytest.approx(
            math.cos(math.radians(turn)), rel=1e-5
        )


def test_harmonics_turn_as_often(device):
    """One surface: light_h = amplitude exp(i h psi), also at a frequency that wraps thirty
    times.
    """
    got = light(plane(3.1), device=device, f_mod_hz=1e8, harmonics=(1, 2, 3, 15))
    distance = first_hit((plane(3.1),), CAMERA, 0.0).distance
    for h, image in zip((1, 2, 3, 15), got.light, strict=True):
        want = got.amplitude * np.exp(1j * h * 4 * math.pi * 1e8 / SPEED_OF_LIGHT * distance)
        assert np.abs(image / want - 1).max() < 2e-5 * h


def test_mixed_pixels_are_area_weighted_means(device):
    """An edge at 1/4, 1/2 and 3/4 of a pixel mixes two complex lights by area;
    every sum is that of its sub-samples.
    """
    camera = Camera(width=16, height=8, fx=200.0, fy=200.0, cx=8.0, cy=4.0)
    for quarters in (1, 2, 3):
        right = (5 + quarters / 4 - 8.0) / 200.0  # where the near plane ends at z = 1
        near, far = plane(1.0, size=(2.0, 2.0), x=right - 1.0), plane(2.5)
        got = light(near, far, camera=camera, device=device, subsamples=4)
        want, amplitude = expected((near, far), camera, subsamples=4)
        np.testing.assert_allclose(got.light[0], want, atol=2e-5)
        np.testing.assert_allclose(got.amplitude, amplitude, rtol=1e-5)
        front, back = (
            light(plane(z), camera=camera, device=device, subsamples=4).light[0] for z in (1.0, 2.5)
        )
        mixed = quarters / 4 * front + (1 - quarters / 4) * back
        # light varies a little in a pixel
        np.testing.assert_allclose(got.light[0][:, 5], mixed[:, 5], rtol=2e-3)
        # two phases: shorter than its parts
        assert (got.amplitude[:, 5] > 1.01 * np.abs(got.light[0][:, 5])).all()
        np.testing.assert_allclose(got.light[0][:, 6:], back[:, 6:], rtol=1e-5)


def test_scenes_are_the_sums_of_their_sub_samples(device):
    """Complex light of a textured scene with 3 x 3 rays against float64 sums of analytic hits,
    edges included.
    """
    scene, time = SCENES["demo"], 0.12
    camera = scene.camera((48, 36))
    got = light(*scene.bodies, camera=camera, device=device, times=(time,), subsamples=3)
    want, amplitude = expected(scene.bodies, camera, time, subsamples=3)
    off = np.abs(got.light[0] - want) > 1e-4 * amplitude.mean()
    assert off.mean() < 5e-3  # a sub-sample on a border of two cells


# -- light beside the camera -----------------------------------------------------------------------


def test_path_of_light_beside_the_camera(device):
    """T22: (d + d_e) / 2 is +0.3998 mm too long on axis and 9.694 mm too short at 30 deg towards
    the light, 1e-5 m.
    """
    beside = (0.04, 0.0, 0.0)
    for degrees, want in ((0.0, 0.3998e-3), (30.0, -9.694e-3)):
        ray = np.array([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])
        camera = AHEAD.at(inverse(rigid(rotation_matrix((0.0, degrees, 0.0)), np.zeros(3))))
        # the emitter turns with the camera, so its place is given in turned axes
        local = tuple(camera.camera_from_world[:3, :3] @ beside)
        ball = Body(
            shape=Sphere(radius=1e-3), texture=GREY, path=Still(position=tuple(ray * (1.0 + 1e-3)))
        )
        got = light(ball, camera=camera, device=device, emitter=local)
        assert decoded(got).item() - 1.0 == pytest.approx(want, abs=1e-5)


def test_amplitude_of_light_beside_the_camera(device):
    """On a wall: rho cos(i_e) / d_e^2 with angle and distance of the emitter, and d + d_e of path,
    per pixel.
    """
    emitter = np.array([0.3, -0.2, -0.1])
    camera = CAMERA.at(inverse(TURNED))  # a pose that is not the world's
    wall = plane(3.0)
    got = light(wall, camera=camera, device=device, emitter=tuple(emitter))
    hit = first_hit((wall,), camera, 0.0)
    towards = hit.point - (TURNED[:3, :3] @ emitter + TURNED[:3, 3])
    reach = np.linalg.norm(towards, axis=-1)
    np.testing.assert_allclose(got.amplitude, 0.5 * towards[..., 2] / reach**3, rtol=1e-5)
    np.testing.assert_allclose(decoded(got), (hit.distance + reach) / 2, atol=2e-5)


def test_shadow_of_light_beside_the_camera(device):
    """T23: light 40 mm to the left, a card at 1 m before a wall at 2 m, fx 230: 4.6 px of wall are
    dark to its right.

    The dark strip is b (z_b - z_f) / z_f wide on the wall; with the light at the camera nothing is
    dark.
    """
    camera = Camera(width=120, height=9, fx=230.0, fy=230.0, cx=60.0, cy=4.5)
    card, wall = plane(1.0, size=(0.1, 2.0)), plane(2.0)
    got = light(card, wall, camera=camera, device=device, emitter=(-0.04, 0.0, 0.0), subsamples=8)
    lit = light(card, wall, camera=camera, device=device, subsamples=8)
    row, bright = got.amplitude[4], lit.amplitude[4]
    right = camera.cx + 230.0 * 0.05 / 1.0  # image of the card's right edge
    dark = 1 - row / bright
    beyond = np.arange(120) >= round(right + 1)  # where only wall is seen
    whole = np.flatnonzero((row == 0) & beyond)
    assert len(whole) in (3, 4)
    edge = right + 230.0 * 0.04 * (1.0 / 1.0 - 1.0 / 2.0)
    assert whole[-1] + 1 + (1 - row[whole[-1] + 1] / row[whole[-1] + 3]) == pytest.approx(
        edge, abs=0.15
    )
    assert (row[: int(camera.cx)] > 0).all()  # no shadow on the side of the light
    assert np.abs(dark[whole[-1] + 3 :]).max() < 0.1
    assert (bright > 0).all()
    assert 230.0 * 0.04 * 0.5 == pytest.approx(4.6)


def test_surfaces_that_turn_from_the_light_are_dark(device):
    """A slab seen by the camera and lit from behind has no light;
    no surface casts a shadow on itself.
    """
    slab = Body(shape=Box(size=(4.0, 4.0, 0.1)), texture=GREY, path=Still(position=(0.0, 0.0, 2.0)))
    assert (light(slab, device=device, emitter=(0.0, 0.0, 5.0)).amplitude == 0).all()
    ball = Body(shape=Sphere(radius=0.6), texture=GREY, path=Still(position=(0.0, 0.0, 2.0)))
    nearly = light(ball, room(), device=device, emitter=(1e-4, 0.0, 0.0)).amplitude
    same = light(ball, room(), device=device).amplitude
    np.testing.assert_allclose(nearly, same, rtol=5e-3)


# -- exposure --------------------------------------------------------------------------------------


def test_blur_is_a_mean_of_instants_and_loses_length_only(device):
    """T16: 30 m/s along the axis shortens the light by sinc(Delta / 2 pi), as n^-2;
    its phase is that of the middle.
    """
    speed, exposure, f_mod_hz = 30.0, 5e-3, 1e8
    wall = Body(
        shape=Plane(size=(90.0, 90.0)),
        texture=GREY,
        path=Line(position=(0, 0, 3.0), velocity=(0, 0, speed)),
    )
    delta = 4 * math.pi * f_mod_hz * speed * exposure / SPEED_OF_LIGHT

    def length(n):
        times = ((np.arange(n) + 0.5) / n - 0.5) * exposure
        got = light(wall, camera=AHEAD, device=device, f_mod_hz=f_mod_hz, times=times)
        each = [
            light(wall, camera=AHEAD, device=device, f_mod_hz=f_mod_hz, times=(t,)) for t in times
        ]
        assert abs(got.light.item() / np.mean([one.light for one in each]) - 1) < 2e-6
        return abs(np.mean([one.light / one.amplitude for one in each])), got

    want = math.sin(delta / 2) / (delta / 2)
    errors = [abs(length(n)[0] - want) for n in (2, 4, 16)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[2] < 1e-4
    middle = light(wall, camera=AHEAD, device=device, f_mod_hz=f_mod_hz)
    turned = np.angle(length(16)[1].light.item() / middle.light.item())
    assert abs(turned) < 2e-2 * delta  # what falls with distance weighs the near half a little more


# -- the tracer ------------------------------------------------------------------------------------


def test_images_do_not_depend_on_threads_nor_on_what_was_traced_before():
    """One thread, three, and a second time: the same numbers."""
    scene = SCENES["arc"]
    bodies = [piece for body in scene.bodies for piece in rigid_bodies(body)]
    camera = scene.camera((40, 31))
    poses = np.stack([[b.path.world_from_body(t) for b in scene.bodies] for t in (0.1, 0.2)])
    one, three = (Tracer(bodies, 40, 31, threads=n) for n in (1, 3))
    first = one.light([camera, camera], poses, F_MOD_HZ, subsamples=2)
    kept = first.light.copy(), first.amplitude.copy()
    one.light([camera], poses[1:], F_MOD_HZ)
    # what was returned is not written to again
    np.testing.assert_array_equal(first.amplitude, kept[1])
    for other in (first, one.light([camera, camera], poses, F_MOD_HZ, subsamples=2)):
        np.testing.assert_array_equal(other.light, kept[0])
        np.testing.assert_array_equal(other.amplitude, kept[1])
    other = three.light([camera, camera], poses, F_MOD_HZ, subsamples=2)
    np.testing.assert_array_equal(other.light, kept[0])
    np.testing.assert_array_equal(
        three.first_hits(camera, poses[0]).body, one.first_hits(camera, poses[0]).body
    )


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({}, "at least one triangle"),
        ({"points": np.eye(3), "triangles": np.zeros((0, 3), int)}, "at least one triangle"),
        ({"points": np.eye(3) * np.nan, "triangles": np.array([[0, 1, 2]])}, "finite"),
        ({"points": np.eye(3), "triangles": np.array([[0, 1, 3]])}, "of 3"),
        ({"radius": 1.0, "points": np.eye(3)}, "not both"),
        ({"radius": 1.0, "normal": (0.0, 0.0, 1.0)}, "not both"),
        ({"normal": (0.0, 0.0, 2.0)}, "length 1"),
        ({"normal": (0.0, 0.0, 1.0), "height": np.inf}, "finite"),
    ],
)
def test_bodies_that_cannot_be(body, says):
    """Empty, unknown and doubly defined bodies are refused before a kernel sees them."""
    with pytest.raises(ValueError, match=says):
        RigidBody(low=0.5, high=0.5, cell=0.3, **body)


def test_arguments_that_do_not_fit():
    """Sizes, instants, rays and frequency are checked; the message names both values."""
    tracer = Tracer([RigidBody(radius=1.0, low=0.5, high=0.5, cell=0.3)], 32, 24)
    pose = np.eye(4)[None, None]
    with pytest.raises(ValueError, match="1x1 must be 32x24"):
        tracer.light([AHEAD], pose, F_MOD_HZ)
    with pytest.raises(ValueError, match=r"\(1, 1, 4, 4\) must be \(2, 1, 4, 4\)"):
        tracer.light([CAMERA, CAMERA], pose, F_MOD_HZ)
    for wrong in ({"f_mod_hz": 0.0}, {"f_mod_hz": F_MOD_HZ, "subsamples": 0}):
        with pytest.raises(ValueError, match="at least 1"):
            tracer.light([CAMERA], pose, **wrong)
    with pytest.raises(ValueError, match="Sphere has no triangles"):
        triangles_of(Sphere(radius=1.0))
