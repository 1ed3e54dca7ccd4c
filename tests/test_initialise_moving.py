"""The start from measured phase of a camera that moves,
on recordings whose truth is known in closed form.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sequences import sequence_of

from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.clouds import Cloud, follow_clouds, moving_layer
from gftorf_warp.scene.fusion import outlying, verdicts, views_of
from gftorf_warp.scene.initialise import MOVING, STATIC, InitSettings, from_phase
from gftorf_warp.scene.measured import camera_of, key_times, sensor_of
from gftorf_warp.sim.paths import inverse, looking_at

HEIGHT, WIDTH, FOCAL = 36, 48, 42.0  # [px]
# [m] wall; left, right, top, bottom, z-depth of a box's front
WALL_Z, BOX = 3.6, (-0.35, 0.25, -0.3, 0.3, 2.2)
TARGET = np.array([0.0, 0.0, 3.0])  # [m] what the camera looks at
PERIOD = 1.0 / 30.0  # [s] between phasors
STEP = np.array([0.09, 0.02, -0.03])  # [m] of the box from one phasor to the next
NOISE = 0.0004  # [quad units]


def poses(count, *, shift=0.6, turn=0.0):
    """World-to-camera poses of a camera carried from left to right that turns away from the target
    as it goes [m].
    """
    found = []
    for share in np.linspace(-0.5, 0.5, count):
        position = np.array([shift * share, -0.1 * share, 0.1 * share])
        found.append(inverse(looking_at(position, TARGET + turn * share * np.eye(3)[0])))
    return np.stack(found)


def seen(pose, shift):
    """[H, W] distance [m], reflectivity, and whether it is the front of the box,
    which moved by ``shift`` [m].
    """
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    local = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], axis=-1)
    ray = local / np.linalg.norm(local, axis=-1, keepdims=True) @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    left, right, top, bottom, front = BOX
    near = (front + shift[2] - centre[2]) / ray[..., 2]
    at = centre + near[..., None] * ray - shift
    box = (at[..., 0] > left) & (at[..., 0] < right) & (at[..., 1] > top) & (at[..., 1] < bottom)
    far = (WALL_Z - centre[2]) / ray[..., 2]
    on = centre + far[..., None] * ray
    wall = 0.5 + 0.15 * np.sin(3.0 * on[..., 0] + 1.0) * np.cos(3.0 * on[..., 1])
    return np.where(box, near, far), np.where(box, 0.6 + 0.2 * np.sin(6.0 * at[..., 0]), wall), box


def carried(*, quartets=12, step=STEP, noise=NOISE, at_once=True, **path):
    """Phasors, or raw quads that follow each other, of a wall and a box; true distance,
    and whether the box is seen.
    """
    frames = np.arange(4 * quartets)
    instant = frames - frames % 4 if at_once else frames
    pose = poses(4 * quartets, **path)[instant]
    images = [seen(p, step * (n / 4 - quartets // 2)) for p, n in zip(pose, instant, strict=True)]
    slope, shifts = 4.0 * np.pi / 15.0, np.tile(CANONICAL_SHIFTS, quartets)
    quads = np.stack(
        [r / d**2 * np.cos(slope * d - s) for (d, r, _), s in zip(images, shifts, strict=True)]
    )
    quads += noise * np.random.default_rng(0).standard_normal(quads.shape)
    sequence = sequence_of(
        quads=quads.astype(np.float32),
        measured=np.ones(4 * quartets, dtype=bool),
        shifts=shifts,
        times=instant / 4 * PERIOD,
        f_mod_hz=SPEED_OF_LIGHT / 15.0,
        fx=FOCAL,
        fy=FOCAL,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
        camera_from_world=pose,
        from_phasors=at_once,
    )
    return (
        sequence,
        np.stack([d for d, _, _ in images[::4]]),
        np.stack([box for _, _, box in images[::4]]),
    )


def of_layer(start, label):
    """The Gaussians of one layer."""
    return start.field.map(lambda value: value[start.field.layer == label])


def rendered(start, sequence, quartet):
    """[H, W] distance [m] divided by opacity, and opacity, at the start of a quartet."""
    field = start.field
    moved = field.mean.clone()
    moved[field.layer == MOVING] = start.positions[quartet]
    seen = rasterize(
        replace(field, mean=moved), camera_of(sequence, 4 * quartet), sensor_of(sequence)
    )
    return (seen.distance / seen.opacity).numpy(), seen.opacity.numpy()


def off(start, step=STEP):
    """[T, 3] mean and [T] largest difference [m] of the displacements of the moving layer to those
    of the box.
    """
    gap = start.positions - start.positions[start.quartet]
    gap = gap - torch.tensor(step).float() * (torch.arange(len(gap)) - start.quartet)[:, None, None]
    return gap.mean(dim=1), gap.norm(dim=2).amax(dim=1)


def apart(start, shift):
    """Distance [m] of every point of the moving layer to the front of the box,
    which moved by ``shift`` [m].
    """
    x, y, z = (of_layer(start, MOVING).mean - torch.tensor(shift).float()).unbind(dim=1)
    left, right, top, bottom, front = BOX
    return torch.stack([x - x.clamp(left, right), y - y.clamp(top, bottom), z - front]).norm(dim=0)


def test_a_static_room_looks_right_from_all_along_the_path():
    """Distance and opacity of the start, rendered from first to last; nothing moves,
    so nothing is labelled so.
    """
    sequence, truth, box = carried(step=np.zeros(3))
    start = from_phase(sequence)
    assert (start.field.layer == STATIC).all()
    assert start.positions.shape == (13, 0, 3)
    grid = round(WIDTH / 2.5) * round(HEIGHT / 2.5)
    assert grid <= len(start.field) < 1.3 * grid, (
        "a place that several views see has points of one of them"
    )
    for quartet in (0, 3, 6, 11):
        distance, opacity = rendered(start, sequence, quartet)
        error = np.abs(distance - truth[quartet])
        assert np.median(error) < 0.05
        assert error.mean() < 0.1
        assert opacity.mean() > 0.93
        assert np.abs(truth[quartet] - truth[quartet].mean()).mean() > 0.2, "a scene with structure"
    assert box.any(axis=(1, 2)).all()


def test_witnesses_take_the_noise_out():
    """Half a decimetre of noise in one view, a centimetre or two in twelve."""
    sequence, truth, _ = carried(step=np.zeros(3), noise=0.004)
    views = views_of(sequence, 0.1)
    verdict = list(verdicts(views))[6]
    interior = ~outlying(torch.tensor(truth[6]), torch.full((HEIGHT, WIDTH), 0.05))[
        2:-2, 4:-4
    ].numpy()
    alone, together = (
        np.abs(d.numpy() - truth[6])[2:-2, 4:-4][interior]
        for d in (views.distance[6], verdict.distance)
    )
    assert np.median(alone) > 0.04
    assert np.median(together) < 0.5 * np.median(alone)
    assert 0.02 < float(((views.margin - 0.1) / 4.0).median()) < 0.15, "the noise is measured"


def test_what_moves_gets_the_label_and_its_keys_follow_it():
    """A box that moves by 1.1 m, within 4 cm of the truth on the mean and 6 cm everywhere;
    nothing else moves.
    """
    sequence, truth, box = carried()
    start = from_phase(sequence)
    quartet = start.quartet
    assert quartet == 6
    moving = of_layer(start, MOVING)
    assert 0.7 * box[quartet].sum() / 1.2**2 < len(moving) < 1.1 * box[quartet].sum() / 1.2**2
    assert apart(start, STEP * 0).max() < 0.1
    assert apart(start, STEP * 0).mean() < 0.02
    mean, largest = off(start)
    assert mean.norm(dim=1).max() < 0.04
    assert largest.max() < 0.06
    torch.testing.assert_close(moving.mean, start.positions[quartet])
    static = of_layer(start, STATIC).mean[:, 2]
    assert (static - WALL_Z).abs().max() < 0.15, "the box leaves no ghost"
    distance, _ = rendered(start, sequence, 2)
    inner = (
        box[2]
        & np.roll(box[2], 3, 1)
        & np.roll(box[2], -3, 1)
        & np.roll(box[2], 3, 0)
        & np.roll(box[2], -3, 0)
    )
    assert inner.sum() > 10
    assert np.abs(distance - truth[2])[inner].mean() < 0.05


def test_raw_quads_of_a_moving_camera_start_as_well():
    """Taken one after the other from poses of their own; the closed form is only roughly right,
    and so is the start.
    """
    sequence, truth, _ = carried(at_once=False)
    start = from_phase(sequence)
    assert (start.field.layer == MOVING).sum() > 30
    mean, _ = off(start)
    assert mean.norm(dim=1).max() < 0.1
    distance, _ = rendered(start, sequence, 6)
    assert np.median(np.abs(distance - truth[6])) < 0.06


def test_what_only_one_view_sees_is_covered():
    """Three views that turn away from each other: where the others do not look,
    the start is as good.
    """
    sequence, truth, _ = carried(quartets=3, step=np.zeros(3), turn=3.0)
    start = from_phase(sequence)
    assert (start.field.layer == STATIC).all()
    cameras = [camera_of(sequence, 4 * quartet) for quartet in range(3)]
    for quartet, least in ((0, 0.2), (2, 0.2)):
        camera = cameras[quartet]
        points = (
            torch.tensor(camera.centre).float()
            + torch.tensor(truth[quartet]).float()[..., None] * camera.rays()
        )
        only = np.ones((HEIGHT, WIDTH), dtype=bool)
        for other in {0, 1, 2} - {quartet}:
            x, y = cameras[other].project(points).numpy().transpose(2, 0, 1)
            only &= ~((x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT))
        assert only.mean() > least
        distance, opacity = rendered(start, sequence, quartet)
        assert opacity[only].mean() > 0.93
        assert np.quantile(opacity[only], 0.05) > 0.8
        # round Gaussians on a wall seen at a slant
        assert np.median(np.abs(distance - truth[quartet])[only]) < 0.15


def test_a_quartet_with_a_hole_is_not_read_and_the_keys_stay_whole():
    """Its rows hold no number; the box goes on as before."""
    sequence, _, _ = carried()
    measured = sequence.measured.copy()
    quads = sequence.quads.copy()
    for frame in (14, 45):
        measured[frame], quads[frame] = False, np.nan
    start = from_phase(replace(sequence, measured=measured, quads=quads))
    assert all(value.isfinite().all() for value in start.field.parameters().values())
    assert len(start.positions) == len(key_times(sequence)) == 13
    mean, _ = off(start)
    assert mean.norm(dim=1).max() < 0.06


def followed(clouds, start):
    """Points of the clouds' objects in the view ``start``, object of each, their shifts by view [m]
    and by view [px].

    A cloud is a list of (first column, last column, distances [m]) in rows 8 to 17; the camera
    rests.
    """
    sequence, _, _ = carried(quartets=len(clouds), shift=0.1)
    views = views_of(sequence, 0.1)
    camera = views.cameras[start]
    views = replace(views, cameras=[camera] * len(clouds))
    found = []
    for patches in clouds:
        mask, distance = (
            torch.zeros(HEIGHT, WIDTH, dtype=torch.bool),
            torch.full((HEIGHT, WIDTH), 3.6),
        )
        for first, end, far in patches:
            mask[8:18, first:end], distance[8:18, first:end] = True, far
        found.append(Cloud(mask=mask, distance=distance))
    grid = torch.stack(
        torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy"), dim=-1
    )
    layer, objects = moving_layer(views, start, found[start], grid, 16)
    times = torch.tensor(views.times, dtype=torch.float64)
    positions = follow_clouds(views, found, start, layer.mean, objects, times, fellows=16)
    dropped, _ = moving_layer(views, start, found[start], grid, 1 + int(objects.bincount().max()))
    assert len(dropped.mean) == 0, "objects of fewer points than fellows are dropped"
    return (
        layer.mean,
        objects,
        positions - layer.mean,
        camera.project(positions) - camera.project(layer.mean),
    )


def test_two_objects_go_their_own_ways():
    """One to the right and one to the left, which are never taken for each other."""
    clouds = [[(10 + view, 18 + view, 2.0), (34 - view, 42 - view, 2.0)] for view in range(5)]
    _, objects, _, pixels = followed(clouds, 2)
    assert objects.bincount().tolist() == [80, 80]
    for view in range(5):
        assert pixels[view, :, 1].abs().max() < 0.3
        for number, direction in ((0, 1), (1, -1)):
            assert float(pixels[view, objects == number, 0].mean()) == pytest.approx(
                direction * (view - 2), abs=0.1
            )


def test_what_is_hidden_or_leaves_goes_on_as_before():
    """Out of sight in one view, half hidden in two, and leaving in the last:
    three pixels per view all the while.
    """
    first = [3 * view for view in range(15)]
    clouds = [[(at, min(at + 10, WIDTH), 2.0)] for at in first]
    clouds[6] = []
    clouds[8], clouds[9] = [(first[8], first[8] + 5, 2.0)], [(first[9], first[9] + 4, 2.0)]
    _, _, _, pixels = followed(clouds, 2)
    want = 3.0 * (torch.arange(15.0) - 2)
    assert (pixels[:, :, 0].mean(dim=1) - want).abs().max() < 0.6


def test_what_comes_back_is_known_again_where_it_was_going():
    """Out of sight for 20 pixels, and then it turns round:
    nothing but its speed tells where it will be.
    """
    first = [2, 7, 12, None, None, None, 32, 28, 24]
    clouds = [[] if at is None else [(at, at + 10, 2.0)] for at in first]
    _, _, _, pixels = followed(clouds, 0)
    for view, at in enumerate(first):
        want = 5 * view if at is None else at - first[0]
        assert float(pixels[view, :, 0].mean()) == pytest.approx(want, abs=1.0)


def test_what_turns_turns_its_surface():
    """A front whose left half comes nearer while its right half goes: each side follows its own."""
    slant = torch.linspace(-1.0, 1.0, 20)
    clouds = [[(14, 34, 2.0 + 0.03 * view * slant)] for view in range(5)]
    points, _, shifts, _ = followed(clouds, 0)
    left, right = (
        points[:, 0] < points[:, 0].quantile(0.25),
        points[:, 0] > points[:, 0].quantile(0.75),
    )
    for view in (2, 4):
        assert -0.03 * view < float(shifts[view, left, 2].mean()) < -0.4 * 0.03 * view
        assert 0.4 * 0.03 * view < float(shifts[view, right, 2].mean()) < 0.03 * view


def test_spacing_follows_the_settings():
    """Finer grids have more Gaussians, smaller by as much."""
    sequence, _, _ = carried(quartets=3, step=np.zeros(3))
    fine, coarse = (from_phase(sequence, InitSettings(static_spacing=s)).field for s in (2.0, 4.0))
    assert len(fine) > 3 * len(coarse)
    assert float(coarse.scale.median() / fine.scale.median()) == pytest.approx(2.0, rel=0.05)
