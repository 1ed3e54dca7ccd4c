"""Optical flow from quads: against the exact flow of the sample,
and against motion that the test makes.
"""

import dataclasses

import numpy as np
import pytest
from ftorf_folder import SAMPLE, scene

from gftorf_warp import Sequence
from gftorf_warp.data import flow as flow_module
from gftorf_warp.data.flow import compute_flow, warp_back
from gftorf_warp.errors import InputError

MOVING_PX = 0.5


@pytest.fixture(scope="module")
def sample():
    """The sample and the flow computed from its quads."""
    sequence = Sequence.open(SAMPLE)
    return sequence, compute_flow(sequence)


def texture(x, y):
    """A smooth signed pattern of three waves."""
    return (
        np.sin(0.5 * x + 0.3 * y)
        + np.sin(0.21 * x - 0.45 * y + 1.0)
        + np.sin(0.7 * y + 0.17 * x + 2.0)
    )


def moving(
    velocity, frames=12, height=48, width=64, times=None, noise=0.0, gains=(1.0, -0.6, 0.8, -1.1)
):
    """A sequence whose whole picture moves by ``velocity`` [px] per quartet;
    slots differ in contrast and sign.
    """
    times = np.arange(frames) / 120.0 if times is None else times
    quartets = times * 30.0
    y, x = np.indices((height, width))
    quads = [
        gains[n % 4] * texture(x - velocity[0] * quartets[n], y - velocity[1] * quartets[n])
        for n in range(frames)
    ]
    quads += noise * np.random.default_rng(0).normal(size=(frames, height, width))
    sequence, _ = scene(frames, height, width)
    return dataclasses.replace(sequence, quads=np.array(quads, dtype=np.float32), times=times)


def inner_error(flow, velocity, border=8):
    """Mean end-point error away from the border, over known pixels, and the share of known ones."""
    gap = np.hypot(flow[0] - velocity[0], flow[1] - velocity[1])[border:-border, border:-border]
    return np.nanmean(gap), np.isfinite(gap).mean()


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_flow_of_the_sample_is_close_to_the_exact_one(sample, direction):
    """A textured box that moves by 6 to 10 px in four frames, towards the camera too;
    the same frames as the file's.
    """
    sequence, computed = sample
    exact, got = getattr(sequence.flow, direction), getattr(computed, direction)
    assert got.keys() == exact.keys()
    gap = np.stack([np.hypot(*(got[n] - exact[n])) for n in exact])
    moves = np.stack([np.hypot(*flow) > MOVING_PX for flow in exact.values()])
    known = np.isfinite(gap)
    assert known[moves].mean() > 0.9
    assert known[~moves].mean() > 0.93
    assert gap[moves & known].mean() < 0.25
    assert np.quantile(gap[moves & known], 0.99) < 1.2
    assert gap[~moves & known].mean() < 0.13


def test_the_flow_explains_the_motion_of_the_sample(sample):
    """Bringing frame n + 4 back by the flow leaves a fraction of the difference to frame n."""
    sequence, computed = sample
    flow = np.nan_to_num(computed.forward[12])
    moves = np.hypot(*sequence.flow.forward[12]) > MOVING_PX
    before = np.abs(sequence.quads[16] - sequence.quads[12])[moves].mean()
    after = np.abs(warp_back(sequence.quads[16], flow) - sequence.quads[12])[moves].mean()
    assert after < 0.3 * before


@pytest.mark.parametrize("velocity", [(3.0, 0.0), (0.0, -2.0), (-1.5, 2.5)])
def test_direction_and_length_of_a_known_motion(velocity):
    """Channel 0 is x to the right, channel 1 is y downwards, forward and backward are opposite."""
    computed = compute_flow(moving(velocity))
    assert list(computed.forward) == [0, 4]
    assert list(computed.backward) == [4, 8]
    for flow, sign in ((computed.forward[4], 1), (computed.backward[4], -1)):
        assert flow.dtype == np.float32
        error, known = inner_error(flow, (sign * velocity[0], sign * velocity[1]))
        assert error < 0.1
        assert known > 0.95


def test_neighbouring_pairs_reduce_the_noise():
    """The first quartet has three pairs to vote, a lone pair only itself."""
    velocity = (2.0, 1.0)
    many = compute_flow(moving(velocity, frames=12, noise=0.3)).forward[4]
    one = compute_flow(
        dataclasses.replace(moving(velocity, frames=12, noise=0.3), measured=np.arange(12) % 4 == 0)
    )
    assert inner_error(many, velocity)[0] < 0.8 * inner_error(one.forward[4], velocity)[0]


def test_frames_of_one_instant_are_read_where_they_are():
    """In a synchronous recording the four pairs of a quartet saw the same motion at the same
    place.
    """
    times = np.repeat(np.arange(3), 4) / 30.0
    velocity = (2.5, -1.0)
    computed = compute_flow(moving(velocity, times=times))
    assert inner_error(computed.forward[4], velocity)[0] < 0.1
    still = compute_flow(moving(velocity, times=np.zeros(12)))
    assert inner_error(still.forward[4], (0.0, 0.0))[0] < 0.01


@pytest.mark.parametrize("step", [4, -4])
def test_pairs_vote_where_the_surface_was_at_their_time(step):
    """A window that moves by 2 px per frame over a still wall, with exact flow:
    all of it keeps its motion.
    """
    x = np.indices((8, 60))[1]
    sign = np.sign(step)
    exact = {}
    for n in range(4, 8):
        inside = abs(x - 20 - 2 * n) < 7
        exact[n] = np.stack([np.where(inside, 8.0 * sign, 0.0), np.zeros(x.shape)]).astype(
            np.float32
        )
    got = flow_module.median_flow(4, exact, exact, np.arange(12) / 120.0, step)
    window = exact[4][0] != 0
    assert window.any()
    np.testing.assert_array_equal(got[:, window], exact[4][:, window])


def test_accelerated_motion_is_not_taken_for_its_later_speed():
    """Pairs before and after n vote alike, so that their mean is the motion from n to n + 4."""
    quartets = np.arange(16) / 4.0
    shift = 3.0 * quartets + 0.5 * quartets**2
    y, x = np.indices((48, 64))
    quads = np.stack([texture(x - s, y) for s in shift]).astype(np.float32)
    sequence = dataclasses.replace(scene(16, 48, 64)[0], quads=quads)
    assert inner_error(compute_flow(sequence).forward[4], (shift[8] - shift[4], 0.0))[0] < 0.1


def test_missing_frames_leave_out_their_pairs():
    """A start or partner that was not measured has no flow;
    a missing neighbour only loses its vote.
    """
    measured = np.ones(16, dtype=bool)
    measured[[4, 9]] = False
    sequence = moving((2.0, 0.0), frames=16)
    sequence.quads[~measured] = 0.0
    computed = compute_flow(dataclasses.replace(sequence, measured=measured))
    assert list(computed.forward) == [8]
    assert list(computed.backward) == [12]
    assert inner_error(computed.forward[8], (2.0, 0.0))[0] < 0.1


def test_what_does_not_come_back_is_unknown():
    """Unrelated pictures have no flow; a still one has it everywhere."""
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(8, 48, 64)).astype(np.float32)
    computed = compute_flow(dataclasses.replace(scene(8, 48, 64)[0], quads=noise))
    assert np.isnan(computed.forward[0]).mean() > 0.2
    assert (np.isnan(computed.forward[0][0]) == np.isnan(computed.forward[0][1])).all()
    assert np.isfinite(compute_flow(moving((0.0, 0.0))).forward[0]).all()


def test_scale_offset_and_a_hot_pixel_do_not_matter():
    """Quads have arbitrary units and a constant part; one broken pixel must not darken all
    others.
    """
    sequence, velocity = moving((2.0, 1.0)), (2.0, 1.0)
    quads = 1e-4 * sequence.quads + 7.0
    quads[:, 20, 30] = 1000.0
    assert (
        inner_error(compute_flow(dataclasses.replace(sequence, quads=quads)).forward[4], velocity)[
            0
        ]
        < 0.2
    )


def test_dark_recordings_do_not_move():
    """No light, no division by zero: flow is zero."""
    computed = compute_flow(
        dataclasses.replace(scene(8, 48, 64)[0], quads=np.zeros((8, 48, 64), np.float32))
    )
    assert not computed.forward[0].any()


def test_deepflow_follows_small_motion():
    """The other method, on motion it was made for."""
    velocity = (1.5, -1.0)
    error, known = inner_error(
        compute_flow(moving(velocity), method="deepflow").forward[4], velocity
    )
    assert error < 0.3
    assert known > 0.95


def test_two_runs_give_the_same_bits(sample):
    """Reconstructions that resume compute it again."""
    sequence, computed = sample
    short = dataclasses.replace(
        sequence,
        quads=sequence.quads[:8],
        measured=sequence.measured[:8],
        times=sequence.times[:8],
    )
    first, second = compute_flow(short), compute_flow(short)
    assert first.forward[0].tobytes() == second.forward[0].tobytes()
    assert set(computed.forward) == set(range(0, 28, 4))


def test_small_images_and_unknown_methods_are_refused():
    """Too few pixels are the user's input, another name a programming mistake."""
    with pytest.raises(InputError, match="8x6") as caught:
        compute_flow(scene()[0])
    assert caught.value.exit_code == 3
    with pytest.raises(ValueError, match="raft"):
        compute_flow(moving((0.0, 0.0)), method="raft")
