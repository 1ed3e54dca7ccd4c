"""Pixels that never change, and the Gaussians that only they see."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import HEIGHT, WIDTH, recording, seen
from small_runs import field

from gftorf_warp.constants import LOW_PASS
from gftorf_warp.render import reference
from gftorf_warp.render.buffers import RenderSettings
from gftorf_warp.scene import still
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.still import rests, still_pixels


def at_rest(*, frames=48, size=(60, 80), noise=1e-3, shot=0.0, seed=0):
    """A sequence in which nothing moves, of quads from dark to bright; its variance is noise^2 + shot |quad|."""
    draw = np.random.default_rng(seed)
    sequence = recording(frames=frames)[0]
    level = np.linspace(0.02, 1.0, size[1])[None] * np.linspace(0.5, 1.0, size[0])[:, None]
    shown = level * (np.cos(0.7 - sequence.shifts)[:, None, None] + 1.2)
    quads = shown + np.sqrt(noise**2 + shot * shown) * draw.standard_normal(shown.shape)
    return replace(sequence, quads=quads.astype(np.float32), forward_flow={}, backward_flow={})


def moved(frames):
    """Pixels that do not see the same matter at the same distance in all frames."""
    distances = np.stack([seen(n)[0] for n in range(frames)])
    return torch.tensor(np.ptp(distances, axis=0) > 1e-3)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (0, 2, 1, 3)])
@pytest.mark.parametrize("dc_offset", [0.0, 1.1])
def test_what_moves_changes_and_little_else(order, dc_offset):
    """A box slides: no pixel of it is still, and beyond window and margin none is missing."""
    sequence, _ = recording(frames=24, order=order, dc_offset=dc_offset)
    found, box = still_pixels(sequence, margin=0), moved(24)
    assert not (found & box).any()
    near = torch.nn.functional.max_pool2d(box.float()[None, None], 9, 1, 4)[0, 0] > 0
    assert (found | near).all()
    assert 0.5 < found.float().mean() < 0.95


def test_a_margin_is_counted_in_pixels():
    """In rows and columns, corners included."""
    sequence, _ = recording(frames=24)
    changed = ~still_pixels(sequence, margin=0)
    grown = torch.nn.functional.max_pool2d(changed.float()[None, None], 5, 1, 2)[0, 0] > 0
    assert torch.equal(~still_pixels(sequence, margin=2), grown)
    assert grown.sum() > changed.sum()


@pytest.mark.parametrize(("shot", "size"), [(0.0, (60, 80)), (2e-4, (60, 80)), (0.0, (12, 400))])
def test_noise_alone_wakes_nobody(shot, size):
    """A tenth of a pixel per sequence is expected, the border included: one or none of ten here."""
    lost = sum(int((~still_pixels(at_rest(shot=shot, size=size, seed=n), margin=0)).sum()) for n in range(10))
    assert lost <= 9 * still.FALSE_ALARMS * 10, "one false pixel is at most nine with its window"


@pytest.mark.parametrize("shot", [0.0, 2e-4])
def test_noise_is_known_where_it_depends_on_brightness(shot):
    """Of means over nine pixels; a class of brightness that moves does not decide."""
    sequence = at_rest(shot=shot)
    groups = [still._smooth(group) for group in still._by_shift(sequence)]
    want = [(1e-6 + shot * group.mean(dim=0)).clamp_min(1e-12).sqrt() / 3.0 for group in groups]
    for group in groups:
        group[::2, :, :5] *= 1.5
    for found, expected in zip(still.noise_of(groups), want, strict=True):
        ratio = (found / expected)[1:-1, 10:-1]
        assert (ratio.log().abs() < 0.15).float().mean() > 0.85
        assert 0.8 < ratio.min() <= ratio.max() < 1.7, "too much where it is dark is no false alarm"


def test_a_slow_change_is_seen_that_no_two_cycles_show():
    """Half a deviation of a single value from first to last cycle, in a patch; the mean of many cycles knows."""
    sequence = at_rest(frames=200, noise=1e-2)
    quads = sequence.quads.copy()
    quads[:, 20:40, 20:40] += (0.6e-2 * np.linspace(-1.0, 1.0, 200))[:, None, None].astype(np.float32)
    found = still_pixels(replace(sequence, quads=quads), margin=0)
    assert not found[22:38, 22:38].any()
    assert found[:15].all()


def test_missing_frames_and_single_cycles():
    """What was not measured is not looked at; one cycle knows nothing; without noise rounding is no change."""
    sequence, _ = recording(frames=24)
    measured = sequence.measured.copy()
    measured[5] = False
    quads = sequence.quads.copy()
    quads[5] = np.nan
    holes = still_pixels(replace(sequence, quads=quads, measured=measured), margin=0)
    assert holes.float().mean() > 0.5
    assert not (holes & moved(24)).any()
    assert not still_pixels(recording(frames=4)[0]).any()
    one = at_rest(noise=0.0)
    assert still_pixels(one).all()


CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=50.0, fy=50.0, cx=WIDTH / 2, cy=HEIGHT / 2, camera_from_world=np.eye(4))


def at(x, y, z=2.0):
    """The place that a pixel position sees at a depth."""
    return [(x - WIDTH / 2) * z / 50.0, (y - HEIGHT / 2) * z / 50.0, z]


def test_who_only_still_pixels_see_rests():
    """Footprints reach 2 px to either side; behind the camera and outside of the image nobody knows."""
    still_here = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    still_here[10:20, 10:20] = False
    cases = [
        (at(15, 15), False),
        (at(22.5, 15), True),
        (at(21.5, 15), False),
        (at(15, 7.5), True),
        (at(15, 8.5), False),
        (at(22.5, 22.5), True),
        (at(1, 1), True),  # what of its footprint lies outside does not matter
        (at(-1, 15), False),
        (at(WIDTH + 1, 15), False),
        (at(30, 30, z=-2.0), False),
    ]
    gaussians = sized(torch.tensor([place for place, _ in cases]), 2.0)
    assert rests(gaussians, still_here, CAMERA).tolist() == [rest for _, rest in cases]
    assert rests(sized(gaussians.mean, 60.0), still_here, CAMERA).tolist() == [False] * len(cases)


def sized(mean, reach):
    """Gaussians whose footprints reach so many pixels on the axis, at 2 m."""
    deviation = ((reach / still.SIGMAS) ** 2 - LOW_PASS) ** 0.5 * 2.0 / 50.0
    return replace(field(mean, None), log_scale=torch.full((len(mean), 3), deviation).log())


def test_footprints_are_those_of_the_oracle():
    """Any size, orientation, place and camera."""
    draw = torch.Generator().manual_seed(0)
    mean = torch.rand(50, 3, generator=draw) * torch.tensor([0.8, 0.6, 1.0]) + torch.tensor([0.8, -0.1, 2.0])
    gaussians = replace(
        field(mean, None),
        log_scale=torch.randn(50, 3, generator=draw) - 3.0,
        quaternion=torch.randn(50, 4, generator=draw),
    )
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]
    pose[:3, 3] = [0.1, -0.2, 1.0]
    camera = Camera(width=WIDTH, height=HEIGHT, fx=50.0, fy=60.0, cx=25.0, cy=17.0, camera_from_world=pose)
    splats = reference._project(gaussians, camera, RenderSettings(near=0.1, far=10.0))
    assert len(splats.index) > 40
    want = splats.covariance[:, [0, 2]].sqrt()
    torch.testing.assert_close(still._deviations(gaussians, camera)[splats.index], want, rtol=1e-4, atol=1e-4)


def test_nothing_is_nothing():
    """No Gaussian, no answer; not a number rests nowhere."""
    still_here = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert not len(rests(field(torch.zeros(0, 3), None), still_here, CAMERA))
    assert rests(field(torch.tensor([[float("nan")] * 3, at(5, 5)]), None), still_here, CAMERA).tolist() == [
        False,
        True,
    ]
