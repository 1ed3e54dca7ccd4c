"""The start from measured phase, on recordings whose truth is known in closed form."""

import numpy as np
import pytest
import torch
from moving_box import FOCAL, FRAMES, HEIGHT, NOISE, STEP, WIDTH, flow, ray_slopes, recording, seen

from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.errors import InputError
from gftorf_warp.scene import measured
from gftorf_warp.scene.initialise import MOVING, STATIC, InitSettings, from_phase, from_random
from gftorf_warp.scene.tracks import follow, unproject

ORDERS = [(0, 1, 2, 3), (1, 2, 0, 3), (3, 0, 2, 1)]


def centres():
    """[P, 2] centres of all pixels [px]."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return torch.tensor(np.stack([x, y], axis=-1).reshape(-1, 2), dtype=torch.float32)


@pytest.mark.parametrize("order", ORDERS)
def test_the_far_layer_is_the_wall_wherever_it_was_ever_seen(order):
    """Whatever the time order of the shifts."""
    sequence, truth = recording(order=order, phase_offset=0.7)
    far = measured.far_layer(sequence, measured.change_of(sequence))
    error = (far.distance.numpy() - truth.distance.max(axis=0))[far.known.numpy()]
    assert far.known.float().mean() > 0.8
    assert np.sqrt((error**2).mean()) < 0.03


def test_what_rests_in_front_and_leaves_is_not_the_far_layer():
    """A box that stands still for two quartets, and is gone in the next two."""
    sequence, _ = recording(noise=0.0)
    box, wall = sequence.quads[:4], sequence.quads[8:12].copy()
    slope, shifts = 4.0 * np.pi / 15.0, sequence.shifts[:4, None, None]
    distance = 3.6 * np.sqrt(1.0 + sum(slope_of**2 for slope_of in ray_slopes()))
    wall[:] = 0.5 / distance**2 * np.cos(slope * distance - shifts)
    noise = NOISE * np.random.default_rng(6).standard_normal(sequence.quads.shape)
    quads = np.concatenate([box, box, wall, wall]) + noise
    left, _ = recording(quads=quads.astype(np.float32))
    far = measured.far_layer(left, measured.change_of(left))
    assert far.known.float().mean() > 0.99
    assert np.abs(far.distance.numpy() - distance).max() < 0.2


def test_noise_is_measured_and_most_of_the_wall_rests():
    """And the box, seen to be elsewhere, does not."""
    sequence, _ = recording()
    change = measured.change_of(sequence)
    assert change.noise == pytest.approx(NOISE, rel=0.25)
    noise = NOISE * np.random.default_rng(5).standard_normal(sequence.quads.shape)
    resting = measured.change_of(
        recording(quads=(sequence.quads[:1] + noise).astype(np.float32))[0]
    )
    assert resting.noise == pytest.approx(NOISE, rel=0.03)
    assert resting.changed.float().mean() < 0.001
    boxes = np.stack([seen(n)[2] for n in range(FRAMES)]).any(axis=0)
    assert change.changed.any(dim=0).numpy()[~boxes].mean() < 0.1
    inside = seen(8)[2] & seen(4)[2]
    assert change.changed[1].numpy()[inside].mean() > 0.7


@pytest.mark.parametrize("order", ORDERS)
def test_decoding_along_the_flow_has_no_motion_artefact(order):
    """Against the closed form, which takes the quads of a moving box as simultaneous."""
    sequence, _ = recording(order=order, noise=0.0)
    points = centres()
    ahead, behind = (measured.flow_at(sequence, 2, step, points) for step in (1, -1))
    distance, amplitude = measured.decode_along_flow(sequence, 2, points, ahead, behind)
    true, reflectivity, box = seen(8)
    interior = (
        box & np.roll(box, 2, 1) & np.roll(box, -2, 1) & np.roll(box, 2, 0) & np.roll(box, -2, 0)
    )
    error = np.abs(distance.numpy().reshape(HEIGHT, WIDTH) - true)[interior]
    naive = np.abs(closed_form_distance(sequence, 2) - true)[interior]
    assert naive.mean() > 0.01
    assert error.mean() < 0.25 * naive.mean()
    ratio = amplitude.numpy().reshape(HEIGHT, WIDTH) / (reflectivity / true**2)
    assert np.abs(ratio[interior] - 1).mean() < 0.05


def test_absent_flow_is_replaced_by_the_reversed_other_direction():
    """At the last quartet there is only backward flow."""
    sequence, _ = recording()
    points = torch.tensor([[24.5, 18.5], [2.5, 2.5]])
    last = max(sequence.flow.backward) // 4
    back = measured.flow_at(sequence, last, -1, points)
    assert back[0].norm() > 1
    torch.testing.assert_close(measured.flow_at(sequence, last, 1, points), -back)
    none, _ = recording(with_flow=False)
    assert measured.flow_at(none, 0, 1, points) is None


@pytest.mark.parametrize("order", ORDERS)
def test_two_layers_where_wall_and_box_are(order):
    """Positions, reflectivity and opacity against what the recording was made of."""
    sequence, _ = recording(order=order, phase_offset=-0.4)
    start = from_phase(sequence)
    frame = 4 * start.quartet
    true, reflectivity, box = seen(frame)
    camera = measured.camera_of(sequence, frame)
    static, moving = (
        start.field.map(lambda t, at=start.field.layer == label: t[at])
        for label in (STATIC, MOVING)
    )
    x, y = camera.project(moving.mean).long().unbind(dim=1)
    on_box = box[y.numpy(), x.numpy()]
    assert on_box.mean() > 0.9
    assert len(moving) > 0.8 * box.sum() / 1.2**2
    error = moving.mean.norm(dim=1).numpy() - true[y.numpy(), x.numpy()]
    assert np.abs(error[on_box]).mean() < 0.03
    got = (moving.reflectivity_sh[:, 0] * 0.28209479 + 0.5).numpy()[on_box]
    assert np.abs(got / reflectivity[y.numpy(), x.numpy()][on_box] - 1).mean() < 0.1
    wall = 3.6 * np.sqrt(1 + (static.mean[:, :2] / static.mean[:, 2:]).square().sum(dim=1).numpy())
    assert np.abs(static.mean.norm(dim=1).numpy() - wall).mean() < 0.05
    torch.testing.assert_close(start.field.opacity, torch.full((len(start.field),), 0.9))


def test_spacing_and_size_follow_the_settings():
    """Counts and footprints on the image."""
    sequence, _ = recording()
    fine, coarse = (from_phase(sequence, InitSettings(static_spacing=s)).field for s in (2.0, 4.0))
    counts = [int((f.layer == STATIC).sum()) for f in (fine, coarse)]
    assert counts == [WIDTH // 2 * HEIGHT // 2, WIDTH // 4 * HEIGHT // 4]
    scale = fine.scale[0, 0] * FOCAL / fine.mean[0].norm()  # [px] on a detector across the ray
    assert float(scale) == pytest.approx(InitSettings().footprint * 2.0, rel=1e-4)


def test_tracks_follow_the_box_at_every_key():
    """Against the motion the recording was made with, along the ray included."""
    sequence, _ = recording()
    start = from_phase(sequence)
    displacement = start.positions - start.positions[start.quartet]
    for key in range(len(start.positions)):
        want = torch.tensor(STEP * 4 * (key - start.quartet), dtype=torch.float32)
        error = (displacement[key].median(dim=0).values - want).norm()
        assert error < (0.02 if key < len(start.positions) - 1 else 0.06), f"key {key}"
    assert displacement.abs().max() > 0.2


def test_tracks_without_flow_rest_and_truncated_quartets_have_keys():
    """Fourteen frames have keys at 0, 4, 8, 12 and 16."""
    sequence, _ = recording(frames=14, with_flow=False)
    point, distance = torch.tensor([[20.0, 18.0]]), torch.tensor([2.4])
    positions = follow(sequence, 1, point, distance, fellows=4)
    assert positions.shape == (5, 1, 3)  # starts of four quartets, and one later
    torch.testing.assert_close(positions, positions[:1].expand(5, 1, 3))


def test_unproject_is_the_inverse_of_projection():
    """For a camera that is turned and moved."""
    camera = measured.camera_of(recording()[0], 0).at(
        np.array([[0, 1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
    )
    points = torch.rand(7, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [WIDTH, HEIGHT]
    )
    world = unproject(camera, points, torch.linspace(1, 4, 7))
    torch.testing.assert_close(camera.project(world), points, rtol=1e-4, atol=1e-3)
    apart = (world - torch.tensor(camera.centre, dtype=torch.float32)).norm(dim=1)
    torch.testing.assert_close(apart, torch.linspace(1, 4, 7))


def test_missing_frames_are_not_decoded():
    """A quartet with a hole is skipped; its zero row is never read."""
    sequence, _ = recording()
    measured_frames = np.ones(FRAMES, dtype=bool)
    measured_frames[9] = False
    quads = sequence.quads.copy()
    quads[9] = np.nan
    holed, truth = recording(measured=measured_frames, quads=quads)
    start = from_phase(holed)
    assert all(value.isfinite().all() for value in start.field.parameters().values())
    far = measured.far_layer(holed, measured.change_of(holed))
    error = (far.distance.numpy() - truth.distance.max(axis=0))[far.known.numpy()]
    assert np.sqrt((error**2).mean()) < 0.1


def test_fill_spreads_known_values_to_all_pixels():
    """Ring by ring; where nothing is known the result is zero."""
    image = torch.arange(30.0).view(1, 5, 6)
    known = torch.zeros(5, 6, dtype=torch.bool)
    known[1, 1] = known[4, 5] = True
    filled = measured.fill(image, known)
    assert filled[0, 1, 1] == 7
    assert filled[0, 0, 0] == 7
    assert filled[0, 4, 4] == 29
    assert 6.999 < filled.min()
    assert filled.max() < 29.001
    assert measured.fill(image, torch.zeros_like(known)).abs().max() == 0


def test_what_phase_cannot_start_is_refused():
    """Before anything is guessed."""
    holes = np.ones(FRAMES, dtype=bool)
    holes[::4] = False
    with pytest.raises(InputError, match="no complete quartet"):
        from_phase(recording(measured=holes)[0])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[5, 0, 3] = 0.1
    with pytest.raises(InputError, match="no complete quartet"):
        from_phase(recording(measured=holes, camera_from_world=poses)[0])


def test_random_gaussians_fill_what_the_camera_sees():
    """Evenly in volume, and the same for the same seed."""
    sequence, _ = recording()
    settings = InitSettings(count=500)
    start = from_random(sequence, settings, torch.Generator().manual_seed(3))
    uv, z = measured.camera_of(sequence, 0).project(start.field.mean), start.field.mean[:, 2]
    assert ((uv >= 0) & (uv <= torch.tensor([WIDTH, HEIGHT]))).all()
    near, far = settings.bounds
    assert z.min() >= near * 0.999
    assert z.max() <= far * 1.001
    # even in volume
    assert (z < 0.5 * (near**3 + far**3) ** (1 / 3)).float().mean() == pytest.approx(
        0.125, abs=0.05
    )
    assert start.positions is None
    assert (start.field.layer == MOVING).all()
    again = from_random(sequence, settings, torch.Generator().manual_seed(3))
    torch.testing.assert_close(again.field.mean, start.field.mean, rtol=0, atol=0)


def test_flow_of_the_recording_is_what_the_tests_assume():
    """The helper itself: following the flow keeps a point of the box on the box's texture."""
    _, r, box = seen(4)
    _, r_next, _ = seen(8)
    step = flow(4, 4)
    y, x = np.nonzero(box)
    u, v = x + 0.5 + step[0, y, x], y + 0.5 + step[1, y, x]
    got = measured.sample(
        torch.tensor(r_next, dtype=torch.float32)[None], torch.tensor(np.stack([u, v], 1)).float()
    )
    inner = (x > x.min() + 1) & (x < x.max() - 1) & (y > y.min() + 1) & (y < y.max() - 1)
    assert np.abs(got[0].numpy() - r[y, x])[inner].mean() < 0.05
