"""The start of preset best: a static background and moving points of every quartet."""

import cv2
import numpy as np
import pytest
import torch
from moving_box import FOCAL, STEP, as_phasors, recording, seen, turned
from sequences import changed

from gftorf_warp.errors import InputError
from gftorf_warp.scene.background import background
from gftorf_warp.scene.initialise import from_quartets
from gftorf_warp.scene.measured import camera_of, change_of
from gftorf_warp.scene.per_quartet import moving_points


def points_of(sequence):
    """Moving points, two pixels apart, by quartet."""
    change = change_of(sequence)
    found = moving_points(sequence, change, background(sequence, change), 2.0)
    return {points.quartet: points for points in found}


def test_the_background_is_the_wall_behind_the_box():
    """Also where the box hides it in some quartets, with less noise than one quartet has."""
    sequence = recording()[0]
    far = background(sequence, change_of(sequence))
    seen_at = [seen(n) for n in range(sequence.frames)]
    wall = np.max([distance for distance, _, _ in seen_at], axis=0)
    uncovered = ~np.all([box for _, _, box in seen_at], axis=0) & far.known.numpy()
    error = np.abs(far.distance.numpy() - wall)[uncovered]
    assert uncovered.mean() > 0.7
    assert np.median(error) < 0.005
    assert (error < 0.05).mean() > 0.9


def test_points_are_on_the_box_and_move_with_it():
    """In the middle of each quartet, although its raw frames see the box at four places."""
    points = points_of(recording()[0])
    assert sorted(points) == [0, 1, 2, 3]
    for quartet, found in points.items():
        middle = 4 * quartet + 1.5
        column, row = _pixels(found.mean)
        distance, _, box = seen(middle)
        on_box = box[row, column]
        near = cv2.dilate(box.astype(np.uint8), np.ones((5, 5))) > 0
        assert near[row, column].mean() > 0.8
        assert on_box.sum() > 0.7 * box.sum() / 4  # of a point per four pixels
        error = np.abs(found.distance.numpy() - distance[row, column])[on_box]
        assert np.median(error) < 0.02
        velocity = found.velocity[torch.as_tensor(on_box)].median(dim=0).values.numpy()
        assert velocity == pytest.approx(4 * STEP, abs=0.012)


def test_phasors_have_moving_points_too():
    """All raw frames of a phasor have one time, so no flow is better than rest within it."""
    points = points_of(as_phasors(recording(frames=24)[0]))
    assert len(points) == 6
    for found in points.values():
        assert len(found.mean) > 10
        assert torch.isfinite(found.mean).all()
        assert torch.isfinite(found.velocity).all()


def test_a_moving_camera_is_refused():
    """Pixels are compared over time."""
    poses = np.stack([turned(0.1 * n) for n in range(12)])
    sequence = changed(recording(frames=12)[0], camera_from_world=poses)
    with pytest.raises(InputError, match="the camera moves") as caught:
        from_quartets(sequence)
    assert "--preset best" in caught.value.fix


def _pixels(mean):
    """Column and row of positions in the world, clipped to the image."""
    camera = camera_of(recording(frames=4)[0], 0)
    x, y = camera.project(mean.double()).numpy().T
    assert camera.fx == FOCAL
    return x.astype(int).clip(0, camera.width - 1), y.astype(int).clip(0, camera.height - 1)
