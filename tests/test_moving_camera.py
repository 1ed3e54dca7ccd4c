"""A camera that moves: a pose for every raw frame, a colour camera beside it,
and views that nobody took.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gftorf_warp import Sequence
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.errors import UsageError
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.measured import camera_of, colour_camera_of, sample
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.bodies import box, room
from gftorf_warp.sim.gaussian_engine import GaussianEngine
from gftorf_warp.sim.paths import (
    Line,
    Still,
    Sweep,
    Viewpoint,
    inverse,
    looking_at,
    rotation_matrix,
)
from gftorf_warp.sim.record import record, still_interior
from gftorf_warp.sim.scene import ColourCamera
from gftorf_warp.sim.scenes import SCENES, Scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Plane, Sphere, Texture, albedo, first_hit

SIZE = (48, 36)
TARGET = (0.0, 0.1, 2.7)
SWEEP = Sweep(middle=(0.0, 0.0, 0.0), target=TARGET, sweep_deg=12.0, period_s=0.4, rise=0.1)
COLOUR = ColourCamera(width=192, height=144, position=(0.06, -0.02, 0.01), turn_deg=(0.0, 2.0, 1.0))


def carried(**more):
    """A room with a box at rest, seen by a camera on an arc,
    without noise unless the sensor has some.
    """
    still = box((0.8, 0.8, 0.6), (0.1, 0.1, 2.6), Texture(low=0.4, high=0.9, cell=0.2, hue=0.1))
    settings = {
        "name": "carried",
        "description": "a camera is carried past a box",
        "motion": "arc",
        "bodies": (room(hue=0.55), still),
        "frames": 8,
        "width": 96,
        "height": 72,
        "sensor": Sensor(),
        "camera_path": SWEEP,
        "colour": COLOUR,
    }
    return Scene(**{**settings, **more})


def flat(scene, camera, time, pixels=2):
    """Pixels whose neighbourhood shows one face of one texture cell, and their first hits."""
    hit = first_hit(scene.bodies, camera, time)
    key = np.concatenate(
        [hit.body[..., None], hit.face[..., None], albedo(scene.bodies, hit, time)], axis=2
    )
    mask = np.zeros(hit.body.shape, dtype=bool)
    mask[pixels:-pixels, pixels:-pixels] = True
    for dy in range(-pixels, pixels + 1):
        for dx in range(-pixels, pixels + 1):
            mask &= (np.roll(key, (dy, dx), (0, 1)) == key).all(2)
    return mask, hit


@pytest.fixture(scope="module")
def recorded():
    """Two quartets of the scene, with colour."""
    return record(carried(), frames=8)


# -- poses -----------------------------------------------------------------------------------------


def test_looking_at_points_ahead_and_keeps_level():
    """Ahead is z, which goes to the target, x is level, y is down on the whole,
    and the pose is a rotation.
    """
    rng = np.random.default_rng(0)
    for position, target in rng.uniform(-2.0, 2.0, (20, 2, 3)):
        pose = looking_at(position, target)
        ahead = (target - position) / np.linalg.norm(target - position)
        np.testing.assert_allclose(pose[:3, 2], ahead, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], position)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert pose[1, 0] == pytest.approx(0.0, abs=1e-12)
        assert pose[1, 1] > 0
        np.testing.assert_allclose(inverse(pose) @ pose, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(looking_at(np.zeros(3), np.array([0.0, 0.0, 3.0])), np.eye(4))
    with pytest.raises(ValueError, match="straight up or down"):
        looking_at(np.zeros(3), np.array([0.0, -1.0, 0.0]))


def test_a_sweep_is_an_arc_about_its_target():
    """Level, it keeps its radius; it goes from end to end in half a period, from left to right,
    at rest at both.
    """
    path = Sweep(middle=(0.2, 0.1, 0.3), target=(0.1, 0.0, 2.5), sweep_deg=20.0, period_s=1.0)
    at = [path.world_from_body(t)[:3, 3] for t in np.linspace(0.0, 0.5, 11)]
    arm = np.subtract(at, path.target)[:, [0, 2]]
    np.testing.assert_allclose(np.linalg.norm(arm, axis=1), np.hypot(0.1, 2.2), rtol=1e-12)
    np.testing.assert_allclose(at[5], path.middle, atol=1e-12)
    np.testing.assert_allclose(
        np.ptp(np.degrees(np.arctan2(arm[:, 0], -arm[:, 1]))), 20.0, rtol=1e-9
    )
    assert (np.diff(np.array(at)[:, 0]) > 0).all()
    for end in (0.0, 0.5):
        pair = [path.world_from_body(end + s)[:3, 3] for s in (-1e-4, 1e-4)]
        assert np.linalg.norm(np.subtract(*pair)) < 1e-6
    high = dataclasses.replace(path, rise=0.2).world_from_body(0.25)
    np.testing.assert_allclose(high[:3, 3], np.add(path.middle, (0.0, -0.2, 0.0)), atol=1e-12)
    np.testing.assert_allclose(
        high[:3, 2], np.divide((-0.1, 0.1, 2.2), np.hypot(0.1, np.hypot(0.1, 2.2)))
    )


@pytest.mark.parametrize("sync", [False, True])
def test_every_raw_frame_has_the_pose_of_its_own_time(sync):
    """Rigid, smooth, all different; with ``sync`` the four of a quartet share one.
    The colour camera goes along.
    """
    scene = carried()
    sequence = record(scene, frames=8, size=(12, 9), sync=sync).sequence
    poses = sequence.camera_from_world
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].mT, np.tile(np.eye(3), (8, 1, 1)), atol=1e-12
    )
    for n, time in enumerate(sequence.times):
        np.testing.assert_allclose(
            poses[n] @ SWEEP.world_from_body(float(time)), np.eye(4), atol=1e-12
        )
        np.testing.assert_allclose(
            sequence.colour.camera_from_world[n], COLOUR.colour_from_tof @ poses[n], atol=1e-12
        )
    step = np.linalg.norm(
        np.diff([camera_of(sequence, n).centre for n in range(8)], axis=0), axis=1
    )
    assert ((step > 0) == ([False, False, False, True] * 2 if sync else [True] * 8)[:7]).all()
    if not sync:
        assert np.abs(np.diff(step)).max() < 4e-3 < step.max() < 0.1


def test_truth_is_seen_from_the_pose_of_its_frame(recorded):
    """Each frame's distance is that of its own camera, and no other frame's:
    the quads show the same.
    """
    scene, recording = carried(), recorded
    sensor = scene.sensor
    for n, time in enumerate(recording.sequence.times):
        mask, hit = flat(scene, camera_of(recording.sequence, n), float(time))
        np.testing.assert_allclose(recording.truth.distance[n], hit.distance, rtol=1e-6)
        want = hit.amplitude * np.cos(hit.distance * sensor.phase_slope - sensor.shifts[n % 4])
        assert mask.sum() > 100
        assert (np.abs(recording.sequence.quads[n] - want)[mask] / hit.amplitude[mask]).max() < 0.04
    assert np.abs(recording.truth.distance[7] - recording.truth.distance[0]).max() > 0.1


# -- what moves, moves the closed form -------------------------------------------------------------


def test_a_still_scene_decodes_from_a_moving_camera_only_if_a_quartet_is_taken_at_once(recorded):
    """With ``sync`` the closed form is right but for outlines; without,
    wrong where the camera's motion shows.
    """
    # 2.5 cm per raw frame, on a wall ahead
    axial = Line(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 3.0))
    wall = Body(
        shape=Plane(size=(9.0, 9.0)),
        texture=Texture(low=0.6, high=0.6),
        path=Still(position=(0, 0, 3.0)),
    )
    ahead = carried(camera_path=axial, bodies=(wall,), colour=None)
    still = carried(colour=None)
    at_once = [record(scene, frames=8, sync=True) for scene in (still, ahead)]
    in_turn = [recorded, record(ahead, frames=8)]
    for k, (scene, wrong) in enumerate(((still, 0.005), (ahead, 0.02))):
        errors = {}
        for sync, recording in ((True, at_once[k]), (False, in_turn[k])):
            mask, _ = flat(
                scene, camera_of(recording.sequence, 4), float(recording.sequence.times[4])
            )
            error = np.abs(
                closed_form_distance(recording.sequence, 1) - recording.truth.distance[4]
            )
            errors[sync] = error[mask]
        assert errors[True].max() < 0.02
        assert errors[True].mean() < 0.002
        assert errors[False].mean() > max(wrong, 5 * errors[True].mean())


def test_rendered_and_true_distance_agree_all_along_the_path():
    """The cover follows the camera: the card's bound holds at either end of the arc,
    near and far.
    """
    scene = carried(
        camera_path=dataclasses.replace(SWEEP, middle=(0.0, 0.0, 0.9), period_s=0.05), colour=None
    )
    recording = record(scene, frames=6)
    cameras = [camera_of(recording.sequence, n) for n in range(6)]
    hits = [first_hit(scene.bodies, camera, 0.0) for camera in cameras]
    interiors = [still_interior(scene, [hit]).sum() for hit in hits]
    assert (
        recording.gap.pixels == round(np.mean(interiors)) > still_interior(scene, hits).sum() + 100
    )
    assert recording.gap.max <= 0.01


def test_a_moving_body_is_covered_for_the_nearest_approach_of_the_camera():
    """A ball at rest in the world's eyes but not in the camera's stays opaque when the camera
    comes near it.
    """
    ball = Body(
        shape=Sphere(radius=0.4),
        texture=Texture(low=0.5, high=0.5),
        path=Line(position=(0.0, 0.0, 3.0), velocity=(0.01, 0.0, 0.0)),
    )
    scene = carried(
        bodies=(ball,),
        camera_path=Line(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 25.0)),
        colour=None,
        frames=9,
    )
    time = 8 / 120
    engine = GaussianEngine(scene, lambda t: scene.camera((96, 72), t), np.arange(9) / 120)
    opacity = rasterize(
        engine.field_at(time), scene.camera((96, 72), time), scene.sensor
    ).opacity.numpy()
    mask, hit = flat(scene, scene.camera((96, 72), time), time, pixels=4)
    inside = mask & (hit.body == 0)
    assert inside.sum() > 300
    assert opacity[inside].min() > 0.9


def test_a_moving_body_shows_the_faces_that_the_camera_faces_now():
    """Passing a box from left to right, the camera first sees its left and then its right face."""
    box = Body(
        shape=Box(size=(0.8, 0.8, 0.8)),
        texture=Texture(low=0.5, high=0.5),
        path=Line(position=(0.0, 0.0, 3.0), velocity=(0.01, 0.0, 0.0)),
    )
    path = Line(position=(-2.0, 0.0, 0.0), velocity=(4.0, 0.0, 0.0))
    scene = carried(bodies=(box,), camera_path=path, colour=None)
    engine = GaussianEngine(scene, lambda t: scene.camera(time=t), np.array([0.0, 0.5, 1.0]))
    for time, left, right in ((0.0, True, False), (1.0, False, True)):
        x = engine.field_at(time).mean[:, 0].numpy() - 0.01 * time
        # more than the rows along the edges
        shown = [(side * x > 0.39).mean() > 0.1 for side in (-1.0, 1.0)]
        assert shown == [left, right]


def test_flow_of_a_moving_camera_is_what_the_image_shows():
    """A texture seen at quartet start n is found again where the flow takes it, in the next image,
    and in the last.
    """
    scene = carried(colour=None)
    sequence = record(scene, frames=12, flow=True).sequence
    assert sorted(sequence.flow.forward) == [0, 4]
    for n, other, flow in ((4, 8, sequence.flow.forward[4]), (4, 0, sequence.flow.backward[4])):
        mask, hit = flat(scene, camera_of(sequence, n), float(sequence.times[n]))
        there, later = (
            camera_of(sequence, other),
            first_hit(scene.bodies, camera_of(sequence, other), 0.0),
        )
        y, x = np.nonzero(mask)
        landed = torch.from_numpy(np.stack([x + 0.5, y + 0.5], axis=1) + flow[:, y, x].T)
        distance = sample(torch.from_numpy(later.distance)[None], landed)[0].numpy()
        want = np.linalg.norm(hit.point[mask] - there.centre, axis=1)
        assert np.quantile(np.abs(distance - want), 0.9) < 0.005
        assert np.abs(flow[:, mask]).max() > 0.5


# -- colour ----------------------------------------------------------------------------------------


def test_a_colour_image_is_the_albedo_of_what_it_shows():
    """Linear RGB of the first hit on every pixel inside one texture cell,
    from the colour camera's own place.
    """
    ball = Body(
        shape=Sphere(radius=0.35),
        texture=Texture(low=0.6, high=0.6, cell=0.4, hue=0.9),
        path=Line(position=(-0.6, 0.0, 2.2), velocity=(3.0, 0.0, 0.0)),
    )
    scene = carried(bodies=(*carried().bodies, ball))
    sequence = record(scene, frames=6).sequence
    assert sorted(sequence.colour.images) == [0, 4]
    for n in (0, 4):
        camera = colour_camera_of(sequence, n)
        assert (camera.width, camera.height) == (192, 144)
        mask, hit = flat(scene, camera, float(sequence.times[n]))
        error = np.abs(
            sequence.colour.images[n] - albedo(scene.bodies, hit, float(sequence.times[n]))
        )
        assert set(np.unique(hit.body[mask])) == {0, 1, 2}
        assert error[mask & (hit.body < 2)].max() < 1e-6
        # through the grid of a moving body a little may be seen
        assert error[mask & (hit.body == 2)].max() < 0.02
        assert error.mean() < 0.03
    assert np.abs(sequence.colour.images[4] - sequence.colour.images[0]).max() > 0.1
    assert 0.02 < sequence.colour.images[0].min() < sequence.colour.images[0].max() < 1.0


def test_the_colour_camera_sits_where_it_is_put():
    """Its position and turn are in the axes of the ToF camera, wherever that looks."""
    scene = carried()
    tof, colour = scene.camera(time=0.1), scene.colour_camera(time=0.1)
    in_tof_axes = tof.camera_from_world @ [*colour.centre, 1.0]
    np.testing.assert_allclose(in_tof_axes[:3], COLOUR.position, atol=1e-12)
    axes = tof.camera_from_world[:3, :3] @ colour.camera_from_world[:3, :3].T
    np.testing.assert_allclose(axes, rotation_matrix(COLOUR.turn_deg), atol=1e-12)


def test_two_cameras_see_the_same_point(recorded):
    """The true point of a ToF pixel, projected into the colour image, has its albedo there;
    without baseline not.
    """
    scene, recording = carried(), recorded
    sequence = recording.sequence
    n, tof = 4, camera_of(recording.sequence, 4)
    mask, hit = flat(scene, tof, float(sequence.times[n]))
    point = (
        tof.centre + tof.rays(dtype=torch.float64).numpy() * recording.truth.distance[n][..., None]
    )
    want = albedo(scene.bodies, hit, float(sequence.times[n]))[mask]
    image = torch.from_numpy(sequence.colour.images[n]).permute(2, 0, 1).double()
    colour = colour_camera_of(sequence, n)
    errors = []
    for camera in (colour, colour.at(tof.camera_from_world)):
        found = sample(image, camera.project(torch.from_numpy(point[mask]))).T.numpy()
        errors.append(np.abs(found - want).max(axis=1))
    assert np.quantile(errors[0], 0.95) < 5e-3
    assert np.quantile(errors[1], 0.95) > 0.05


def test_colour_is_black_where_nothing_is_and_unshaded_where_something_is():
    """A tilted plain plane far and near: one albedo all over,
    and an outline no wider than a pixel.
    """
    plane = Body(
        shape=Plane(size=(1.0, 1.0)),
        texture=Texture(low=0.8, high=0.8, cell=50.0),
        path=Still(position=(0.0, 0.0, 2.0), turn_deg=(0.0, 50.0, 0.0)),
    )
    scene = carried(bodies=(plane,))
    engine = GaussianEngine(
        scene, lambda t: scene.colour_camera(None, t).resized(384, 288), np.zeros(1), colour=True
    )
    image = engine.albedo(0.0)
    hit = first_hit(scene.bodies, scene.colour_camera(), 0.0)
    want = albedo(scene.bodies, hit, 0.0)
    assert want.max() == pytest.approx(0.8)
    assert (image[hit.body < 0] == 0).mean() > 0.95
    inside, _ = flat(scene, scene.colour_camera(), 0.0, pixels=1)
    np.testing.assert_allclose(
        image[inside & (hit.body == 0)], want[inside & (hit.body == 0)], atol=1e-5
    )
    assert np.ptp(hit.amplitude[hit.body == 0]) > 0.1


def test_noise_of_colour_belongs_to_the_seed_and_the_frame():
    """Of the stated strength, another for each image, none without noise,
    and the quads do not change.
    """
    noisy = carried(colour=dataclasses.replace(COLOUR, noise=0.02))
    clean, first, same, other = (
        record(scene, frames=5, size=SIZE, seed=seed).sequence
        for scene, seed in ((carried(), 0), (noisy, 0), (noisy, 0), (noisy, 1))
    )
    np.testing.assert_array_equal(first.quads, clean.quads)
    noise = [first.colour.images[n] - clean.colour.images[n] for n in (0, 4)]
    assert noise[0].std() == pytest.approx(0.02, rel=0.03)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05
    np.testing.assert_array_equal(first.colour.images[4], same.colour.images[4])
    assert (first.colour.images[0] != other.colour.images[0]).mean() > 0.9
    np.testing.assert_array_equal(
        record(noisy, frames=1, size=SIZE, noise=False).sequence.colour.images[0],
        clean.colour.images[0],
    )
    with pytest.raises(ValueError, match="noise"):
        ColourCamera(width=4, height=4, noise=-0.1)


def test_hues_are_a_hash_and_stay_near_their_middle():
    """The brightest channel is the reflectance; cells of one hue differ little,
    those of all hues a lot.
    """
    point = np.random.default_rng(0).uniform(-3.0, 3.0, (400, 3))
    for hue, brightest in ((0.0, 0), (1 / 3, 1), (2 / 3, 2)):
        texture = Texture(low=0.2, high=0.8, hue=hue)
        colour = texture.albedo(point)
        np.testing.assert_allclose(colour.max(axis=1), texture(point), rtol=1e-12)
        assert (colour.argmax(axis=1) == brightest).all()
        assert (colour > 0.39 * texture(point)[:, None]).all()
    assert np.bincount(Texture(low=0.2, high=0.8).albedo(point).argmax(axis=1)).min() > 80


def test_a_camera_without_colour_has_none():
    """And asking for it says so."""
    scene = carried(colour=None)
    sequence = record(scene, frames=1).sequence
    assert sequence.colour.images == {}
    assert sequence.colour.camera_from_world is None
    assert colour_camera_of(sequence, 0) is None
    with pytest.raises(ValueError, match="no colour camera"):
        scene.colour_camera()


# -- the scene tour --------------------------------------------------------------------------------


def test_tour_is_what_it_says():
    """30 quartets on an arc of 30 to 50 cm about a desk; colour at twice the size;
    novel views off the path.
    """
    scene = SCENES["tour"]
    assert scene.frames == 120
    assert (scene.colour.width, scene.colour.height) == (2 * scene.width, 2 * scene.height)
    centres = np.array([scene.camera(time=n / 120).centre for n in range(120)])
    assert 0.3 < np.linalg.norm(np.diff(centres, axis=0), axis=1).sum() < 0.5
    sequence = record(scene, frames=1, size=SIZE).sequence
    assert sequence.colour.images[0].shape == (72, 96, 3)
    assert 4 <= len(sequence.novel_from_world) <= 8
    for pose in sequence.novel_from_world:
        centre = camera_of(sequence, 0).at(pose).centre
        assert np.linalg.norm(centres - centre, axis=1).min() > 0.1
        distance = first_hit(scene.bodies, scene.camera(SIZE).at(pose), 0.0).distance
        assert np.isfinite(distance).all()
        assert 0.8 < distance.min() < distance.max() < 0.8 * scene.sensor.unambiguous_range


@pytest.fixture(scope="module")
def tour():
    """Two quartets of it."""
    return record(SCENES["tour"], frames=8, size=SIZE, seed=2)


@pytest.mark.parametrize("layout", ["ftorf", "torf"])
def test_tour_is_read_back(tour, tmp_path, layout):
    """Quads or phasors, times, poses, truth and colour of the folder are those of the recording."""
    path = simulate("tour", tmp_path / "seq", frames=8, size=SIZE, seed=2, format=layout)
    want = tour
    got, truth = Sequence.open(path), Sequence.open(path).truth()
    frames = np.arange(8) if layout == "ftorf" else np.repeat([0, 4], 4)
    assert got.from_phasors == (layout == "torf")
    np.testing.assert_allclose(got.times, want.sequence.times[frames], atol=1e-9)
    np.testing.assert_allclose(
        got.camera_from_world, want.sequence.camera_from_world[frames], atol=1e-9
    )
    np.testing.assert_allclose(truth.distance, want.truth.distance[frames], rtol=1e-6)
    for i in range(2):
        np.testing.assert_allclose(
            closed_form_distance(got, i), closed_form_distance(want.sequence, i), atol=1e-4
        )
        np.testing.assert_allclose(
            got.colour.images[4 * i], want.sequence.colour.images[4 * i], atol=1e-6
        )
    camera, expected = colour_camera_of(got, 4), colour_camera_of(want.sequence, 4)
    np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-9)
    assert (camera.fx, camera.cx, camera.width) == pytest.approx(
        (expected.fx, expected.cx, expected.width)
    )
    np.testing.assert_allclose(got.novel_from_world, want.sequence.novel_from_world, atol=1e-9)
    card = (path / "README.md").read_text()
    assert "Sweep(" in card
    assert "96x72 pixels, 60 deg wide, at (40, 0, 0) mm" in card
    assert ("--format torf" in card) == (layout == "torf")


def test_a_layout_is_part_of_the_settings(tmp_path):
    """The same settings in the other layout are another sequence;
    in the same they are left alone.
    """
    calls = []

    def make(layout, **more):
        simulate(
            carried(),
            tmp_path / "seq",
            frames=4,
            size=SIZE,
            format=layout,
            progress=lambda *n: calls.append(n),
            **more,
        )

    make("torf")
    make("torf")
    assert len(calls) == 4
    with pytest.raises(UsageError, match="--fresh"):
        make("ftorf")
    make("ftorf", fresh=True)
    make("ftorf")
    assert len(calls) == 8
    assert (tmp_path / "seq-old-1" / "tof").is_dir()
    for folder, named in (("seq-old-1", True), ("seq", False)):
        assert ("format='torf'" in (tmp_path / folder / "README.md").read_text()) == named
    for options, word in (
        ({"frames": 3}, "at least 4"),
        ({"frames": 4, "flow": True}, "optical flow"),
    ):
        with pytest.raises(UsageError, match=word):
            simulate(carried(), tmp_path / "none", format="torf", **options)
    assert not (tmp_path / "none").exists()


def test_other_cameras_are_other_settings(tmp_path):
    """The card names the camera path, the colour camera and hues;
    a scene without them has none of these lines.
    """
    base = carried(colour=None, camera_path=Still(), frames=1)
    variants = [
        base,
        carried(colour=None, frames=1),
        dataclasses.replace(base, camera_path=Viewpoint(position=(0.0, 0.0, 0.0), target=TARGET)),
        dataclasses.replace(base, colour=COLOUR),
        dataclasses.replace(base, colour=COLOUR, bodies=(room(hue=0.1), base.bodies[1])),
        dataclasses.replace(
            base, novel_views=(Viewpoint(position=(0.0, 0.0, 0.1), target=TARGET),)
        ),
    ]
    cards = [
        (simulate(scene, tmp_path / str(k), size=(8, 6)) / "README.md")
        .read_text()
        .partition("\n\n| sensor")[0]
        for k, scene in enumerate(variants)
    ]
    assert len(set(cards)) == len(cards)
    text = (tmp_path / "0" / "README.md").read_text()
    assert "camera path" not in text
    assert "colour camera" not in text
