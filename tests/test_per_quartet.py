"""Points of moving surfaces, measured in every quartet by itself, and the Gaussians made of them:
a box that slides and comes nearer in front of a wall, with exact flow.
"""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from moving_box import HEIGHT, NOISE, STEP, WIDTH, flow, recording, seen, turned

from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT
from gftorf_warp.data.sequence import Flow
from gftorf_warp.errors import InputError
from gftorf_warp.scene import measured
from gftorf_warp.scene.along_flow import Slots
from gftorf_warp.scene.background import background
from gftorf_warp.scene.initialise import STATIC, Init, InitSettings, from_quartets
from gftorf_warp.scene.motion import MotionSettings, MotionStart
from gftorf_warp.scene.per_quartet import moving_points
from gftorf_warp.scene.windows import Windows

FRAMES = 48
OFFSET = 0.7  # [rad] of the phase
F = SPEED_OF_LIGHT / 15.0  # [Hz] distances modulo 7.5 m
KINDS = {  # shifts and frequencies of a cycle, constant part of the quads
    "four shifts": (CANONICAL_SHIFTS, (F,) * 4, 0.0),
    "constant part": (CANONICAL_SHIFTS, (F,) * 4, 0.4),
    "three shifts": ((0.0, 2.1, 4.2), (F,) * 3, 0.0),
    "five shifts": (tuple(2 * np.pi * k / 5 for k in (0, 2, 4, 1, 3)), (F,) * 5, 0.2),
    "two frequencies": ((0.0, 2.1, 4.2) * 2, (3 * F,) * 3 + (2 * F,) * 3, 0.0),
    "phasors": (CANONICAL_SHIFTS, (F,) * 4, 0.0),
    "one instant": (CANONICAL_SHIFTS, (F,) * 4, 0.0),
}
AT_ONCE = ("phasors", "one instant")  # a cycle has one time


@functools.cache
def recorded(kind="four shifts", *, frames=FRAMES, speed=1.0, noise=NOISE, seed=3):
    """The sliding box as another sensor records it; phasors are of one instant each."""
    shifts, frequencies, constant = KINDS[kind]
    cycle, moves = len(shifts), speed > 0.0
    count = frames // cycle * cycle
    quads = []
    instants = np.arange(count)
    if kind in AT_ONCE:
        instants = instants // cycle * cycle
    for n, instant in enumerate(instants):
        distance, reflectivity, _ = seen(speed * instant)
        slope = 4 * np.pi * frequencies[n % cycle] / SPEED_OF_LIGHT
        wave = np.cos(slope * distance + OFFSET - shifts[n % cycle]) + constant
        quads.append(reflectivity / distance**2 * wave)
    quads = np.stack(quads)
    quads += noise * np.random.default_rng(seed).standard_normal(quads.shape)
    starts = range(0, count, cycle)
    ahead = {n: flow(n, cycle) for n in starts if moves and n + cycle < count}
    back = {n: flow(n, -cycle) for n in starts if moves and n >= cycle}
    return recording(
        frames=count,
        quads=quads.astype(np.float32),
        times=instants / 120.0,
        from_phasors=kind == "phasors",
        shifts=np.tile(shifts, count // cycle),
        frequencies_hz=np.tile(frequencies, count // cycle),
        f_mod_hz=frequencies[0],
        phase_offset=OFFSET,
        dc_offset=constant,
        cycle_length=cycle,
        forward_flow=ahead,
        backward_flow=back,
    )[0]


@functools.cache
def points_of(sequence, spacing=1.0):
    """Points of every quartet."""
    change = measured.change_of(sequence)
    return list(moving_points(sequence, change, background(sequence, change), spacing))


def pixels(sequence, mean):
    """Columns and rows in which points are seen."""
    column, row = measured.camera_of(sequence, 0).project(mean).floor().long().unbind(dim=1)
    return column.clamp(0, WIDTH - 1).numpy(), row.clamp(0, HEIGHT - 1).numpy()


def grown(mask, by):
    """A mask, extended by some pixels along both axes, or with a negative number reduced."""
    kernel = np.ones((2 * abs(by) + 1,) * 2, np.uint8)
    change = cv2.dilate if by > 0 else cv2.erode
    return change(mask.astype(np.uint8), kernel) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_points_cover_the_box_at_its_distance_and_with_its_velocity(kind):
    """In the middle of every quartet, radially too; none on the wall. What comes nearer by 32 mm
    while its quads are taken keeps a motion artefact of up to 20 mm.
    """
    sequence = recorded(kind)
    cycle, found = sequence.cycle, points_of(sequence)
    assert [p.quartet for p in found] == list(range(sequence.frames // cycle))
    coverage, errors, ratios, offsets = [], [], [], []
    for points in found:
        distance, reflectivity, box = seen(cycle * (points.quartet + 0.5))
        column, row = pixels(sequence, points.mean)
        covered = np.zeros((HEIGHT, WIDTH), dtype=bool)
        covered[row, column] = True
        inner = grown(box, -2)
        inside = inner[row, column]
        coverage.append(covered[inner].mean())
        assert grown(box, 4)[row, column].all()
        errors.append(points.mean.norm(dim=1).numpy()[inside] - distance[row, column][inside])
        amplitude = reflectivity / distance**2
        ratios.append(points.amplitude.numpy()[inside] / amplitude[row, column][inside] - 1)
        offsets.append(np.median(points.velocity.numpy()[inside], axis=0) - cycle * STEP)
    assert min(coverage) > 0.8
    assert np.mean(coverage) > 0.95
    assert np.median(np.abs(np.concatenate(errors))) < 0.02
    assert np.median(np.abs(np.concatenate(ratios))) < 0.05
    np.testing.assert_allclose(np.median(offsets, axis=0), 0.0, atol=0.01)
    assert np.abs(offsets).max() < 0.03


@pytest.mark.parametrize("kind", KINDS)
def test_where_nothing_moves_there_are_no_points(kind):
    """Box and wall at rest; every quartet is there, empty."""
    found = points_of(recorded(kind, speed=0.0))
    assert len(found) == FRAMES // len(KINDS[kind][0])
    assert sum(len(p.mean) for p in found) <= 2


def test_a_surface_with_one_component_of_the_background_is_found():
    """A stick half the unambiguous range in front of a wall: the quads of two opposite shifts do
    not show it, and those of the others do.
    """
    wall, stick, column = 0.75 * 7.5, 0.25 * 7.5, np.arange(WIDTH) + 0.5
    places = [8.0 + 0.8 * n for n in range(FRAMES)]
    there = [np.abs(column - place) < 2.0 for place in places]
    shifts = np.tile(np.array(CANONICAL_SHIFTS)[[0, 2, 1, 3]], FRAMES // 4)
    slope = 4.0 * np.pi * F / SPEED_OF_LIGHT
    quads = np.stack(
        [
            np.where(here, 0.06, 0.01) * np.cos(slope * np.where(here, stick, wall) - shift)
            for here, shift in zip(there, shifts, strict=True)
        ]
    )
    quads = np.repeat(quads[:, None], HEIGHT, axis=1)
    quads += NOISE * np.random.default_rng(0).standard_normal(quads.shape)
    changes = {"quads": quads.astype(np.float32), "with_flow": False}
    sequence = recording(frames=FRAMES, order=(0, 2, 1, 3), **changes)[0]
    found = points_of(sequence)
    assert len(found) == FRAMES // 4
    for points in found[1:-1]:
        column_of, _ = pixels(sequence, points.mean)
        assert len(points.mean) > 2 * HEIGHT
        apart = np.abs(column_of + 0.5 - places[4 * points.quartet] - 1.6)
        assert (apart < 3.0).mean() > 0.8, "half of the stick, and the 5 pixels of a box"
        assert np.median(np.abs(points.distance.numpy() - stick)) < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_slots_that_may_be_those_of_the_background(kind):
    """One at least. Opposite shifts follow each other here, so that a surface that leaves or
    arrives would differ in the other two.
    """
    slots = Slots.of(recorded(kind), 0)
    np.testing.assert_array_equal(slots.differing, ~np.eye(recorded(kind).cycle, dtype=bool))
    every = torch.ones(1, len(slots.differing), 1, 1, dtype=torch.bool)
    assert bool(slots.moves(every))
    for k in range(len(slots.differing)):
        one = every.clone()
        one[:, k] = False
        assert bool(slots.moves(one))
        assert not bool(slots.moves(~one))


def test_opposite_slots_in_turns_may_both_be_those_of_the_background():
    """The second and the fourth, or the first and the third; not with a constant part, and not the
    first and the last, which leave two consecutive ones.
    """
    turns = {"order": (0, 2, 1, 3), "frames": 8}
    slots = Slots.of(recording(**turns)[0], 0)
    alike = np.array([[1, 0, 1, 0], [0, 1, 0, 1]] * 2, dtype=bool)
    np.testing.assert_array_equal(slots.differing, ~alike)
    for shown, moves in (((0, 2), True), ((1, 3), True), ((0, 1), False), ((2, 3), False)):
        differs = torch.zeros(1, 4, 1, 1, dtype=torch.bool)
        differs[:, list(shown)] = True
        assert bool(slots.moves(differs)) == moves
    nested = Slots.of(recording(order=(0, 2, 3, 1), frames=8)[0], 0).differing
    np.testing.assert_array_equal(nested[1:3], [[1, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(nested[::3], [[0, 1, 1, 1], [1, 1, 1, 0]])
    constant = Slots.of(recording(**turns, dc_offset=0.3)[0], 0)
    np.testing.assert_array_equal(constant.differing, ~np.eye(4, dtype=bool))


def test_a_recording_without_noise_has_its_points_on_the_box():
    """The estimated noise is that of rounding."""
    for points in points_of(recorded(noise=0.0)):
        _, _, box = seen(4 * (points.quartet + 0.5))
        column, row = pixels(recorded(), points.mean)
        assert len(points.mean) > 0.8 * box.sum()
        assert grown(box, 4)[row, column].all()


def test_without_optical_flow_translations_are_tried():
    """The best ones explain what moves by five pixels in a quartet, most of which they find."""
    sequence, step = replace(recorded(frames=24, speed=2.0), flow=Flow()), 2.0 * 4 * STEP
    shares = []
    for points in points_of(sequence):
        _, _, box = seen(2.0 * 4 * (points.quartet + 0.5))
        column, row = pixels(sequence, points.mean)
        velocity = points.velocity.numpy()[grown(box, -2)[row, column]]
        shares.append(np.median(velocity @ step) / (step @ step))
    assert 0.5 < np.median(shares) < 1.1


@pytest.mark.parametrize(
    ("kind", "late"), [("four shifts", 1 / 8), ("five shifts", 1 / 10), ("phasors", 1 / 2)]
)
def test_points_are_stated_for_the_middle_of_the_window_of_their_gaussians(kind, late):
    """They were measured at the centres of pixels at the mean time of the raw frames, which is
    before the middle between the starts of this quartet and of the next one.
    """
    sequence = recorded(kind)
    camera = measured.camera_of(sequence, 0)
    for points in points_of(sequence)[2:6]:
        place = camera.project(points.mean - late * points.velocity)
        assert (place - place.floor() - 0.5).abs().max() < 0.02
        there = camera.project(points.mean)
        assert (there - place).norm(dim=1).median() > 0.2


def test_gaussians_are_on_the_box_at_the_time_of_every_raw_frame():
    """Labelled by quartet, displaced by the windows that start from their velocity: at the distance
    of the box when a raw frame is taken, and none far behind or ahead of it.
    """
    sequence = recorded()
    start = from_quartets(sequence, InitSettings(kind=Init.QUARTETS, moving_spacing=1.0))
    initial = MotionStart(
        key_times=measured.key_times(sequence),
        field=start.field,
        tracks=None,
        velocity=start.velocity,
        duration=0.4,
        unambiguous_range=7.5,
        generator=torch.Generator(),
    )
    motion = Windows.start(MotionSettings(kind="windows", nodes=40), initial)
    assert start.positions is None
    assert len(start.velocity) == int((start.field.layer != STATIC).sum())
    layers, binding = start.field.layer, motion.bind(start.field)
    assert sorted(set(layers.tolist())) == list(range(13))
    for n in range(40):
        offset = motion.at(binding, float(sequence.times[n])).offset.detach()
        moved = (start.field.mean + offset)[layers == 1 + n // 4]
        distance, _, box = seen(n)
        column, row = pixels(sequence, moved)
        inside = grown(box, -2)[row, column]
        error = moved.norm(dim=1).numpy()[inside] - distance[row, column][inside]
        assert np.median(np.abs(error)) < 0.025
        assert grown(box, 2)[row, column].mean() > 0.9


def test_what_has_no_quartets_to_compare_is_refused():
    """No complete quartet, and a camera that moves; each by name."""
    holes = np.ones(16, dtype=bool)
    holes[::4] = False
    with pytest.raises(InputError, match="no complete quartet"):
        from_quartets(recording(measured=holes)[0])
    poses = np.stack([turned(0.1 * n) for n in range(16)])
    with pytest.raises(InputError, match="the camera moves") as caught:
        from_quartets(recording(camera_from_world=poses)[0])
    assert "--preset best" in caught.value.fix


def test_one_quartet_alone_is_a_static_layer():
    """Nothing can be seen to move in it, and its noise is unknown."""
    start = from_quartets(recording(frames=4, with_flow=False)[0])
    assert (start.field.layer == STATIC).all()
    assert start.velocity.shape == (0, 3)
    assert all(value.isfinite().all() for value in start.field.parameters().values())
    distance, _, _ = seen(1.5)
    sequence = recording(frames=4)[0]
    column, row = pixels(sequence, start.field.mean)
    error = start.field.mean.norm(dim=1).numpy() - distance[row, column]
    assert np.median(np.abs(error)) < 0.02


def test_a_missing_raw_frame_leaves_its_quartet_without_points():
    """The others have theirs, with labels of their own numbers; nothing reads the hole."""
    sequence = recorded()
    there = np.ones(sequence.frames, dtype=bool)
    there[9] = False
    quads = sequence.quads.copy()
    quads[9] = np.nan
    start = from_quartets(replace(sequence, measured=there, quads=quads))
    found = set(start.field.layer.tolist())
    assert 1 + 2 not in found
    assert {1, 2, 4, 5} <= found
    assert all(value.isfinite().all() for value in start.field.parameters().values())


def test_static_gaussians_are_finer_along_steps_of_the_distance():
    """A pixel apart at most two pixels from a step of 0.1 m within three pixels, further apart
    elsewhere; no pixel has two.
    """
    settings = InitSettings(kind=Init.QUARTETS)
    sequence = recorded(speed=0.0)
    start = from_quartets(sequence, settings)
    column, row = pixels(sequence, start.field.mean)
    count = np.zeros((HEIGHT, WIDTH), dtype=int)
    np.add.at(count, (row, column), 1)
    distance, _, box = seen(0)
    three = np.ones((3, 3), np.uint8)
    step = cv2.dilate(distance, three) - cv2.erode(distance, three)
    near = cv2.dilate((step > 0.15).astype(np.uint8), three) > 0
    away = cv2.dilate((step > 0.08).astype(np.uint8), three) == 0
    assert grown(box, 1)[near].mean() > 0.5
    assert (count[near] == 1).all()
    assert count[away].mean() == pytest.approx(1 / settings.static_spacing**2, rel=0.2)
    assert count.max() == 1
