"""What is compared with what: terms of the loss, order of the frames, preparation of a sequence."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording, with_colour
from sequences import changed
from small_runs import FLOW, OneStep, advance, demo, small, weights_at

from gftorf_warp.errors import InputError
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import ImageStack, data_hash, former_hash, observe, reduced
from gftorf_warp.recon.settings import Batch, Weights
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.stepper import draw
from gftorf_warp.recon.terms import View, flow_weight
from gftorf_warp.scene.gaussians import constant_sh


def test_flow_loss_is_small_for_the_true_motion_and_pulls_only_at_keys():
    """And its gradient is that of finite differences."""
    settings = demo(warm_up=0, motion_gradient_max=None)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")

    def step():
        return OneStep(state, observations, settings, 4, terms=(FLOW,))

    def loss():
        return step().terms["flow"]

    true = step()
    assert all(name == "motion" or not gradient.any() for name, gradient in true.gradients.items())
    with torch.no_grad():
        state.motion.offset[2] *= 0.0
    wrong = step()
    assert wrong.terms["flow"] > 3 * true.terms["flow"]
    gradient = wrong.gradients["motion"]
    assert gradient[:3].abs().amax(dim=(1, 2)).min() > 1e-4
    assert gradient[3].abs().max() == 0
    direction = gradient / gradient.norm()
    h = 1e-3
    with torch.no_grad():
        state.motion.offset += h * direction
        up = loss()
        state.motion.offset -= 2 * h * direction
        down = loss()
    assert (up - down) / (2 * h) == pytest.approx(float(gradient.norm()), rel=0.05)
    without = replace(observations, flow=ImageStack.of({}, "cpu"))
    assert "flow" not in OneStep(state, without, settings, 4, terms=(FLOW,)).terms


def test_terms_of_weight_zero_are_left_out_and_others_begin_when_the_schedule_says():
    """Flow at quartet starts only."""
    settings = demo(weights=Weights(distortion=2.0, flow=3.0, motion_size=4.0, ssim=0.2))
    schedule = replace(settings.schedule, images=1000, distortion_from=0.4, flow_from=200)
    settings = replace(settings, schedule=replace(schedule, warm_up=0))
    early, middle, late = (weights_at(settings, images) for images in (199, 200, 400))
    assert (early["flow"], middle["flow"]) == (0.0, 3.0)
    assert (middle["distortion"], late["distortion"]) == (0.0, 2.0)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    state.images = 400
    for frame, weights, names in (
        (8, settings.weights, {"quads", "distortion", "flow", "motion_size"}),
        (9, settings.weights, {"quads", "distortion", "motion_size"}),
        (9, Weights(), {"quads"}),
    ):
        terms = OneStep(state, observations, replace(settings, weights=weights), frame).terms
        assert terms.keys() == names
        assert all(value > 0 for value in terms.values())
    images = OneStep(state, observations, settings, 9).images
    assert images[0].renderings.keys() == {View.TOF}, "no flow, no colour"
    fixed = replace(settings, schedule=replace(settings.schedule, warm_up=1000))
    assert OneStep(state, observations, fixed, 8).terms.keys() == {"quads", "distortion"}, (
        "nothing moves"
    )


def test_the_measured_slot_is_compared_at_its_own_time_and_shift():
    """Frame n of a recording rendered from itself: only the right shift and time fit."""
    settings = demo(weights=Weights(ssim=0.0), background=0.0, warm_up=0)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    right = OneStep(state, observations, settings, 6).terms["quads"]
    shifted = replace(observations.sequence, shifts=np.roll(observations.sequence.shifts, 1))
    late = replace(observations.sequence, times=observations.sequence.times + 8 / 120)
    for sequence in (shifted, late):
        wrong = OneStep(state, replace(observations, sequence=sequence), settings, 6).terms["quads"]
        assert wrong > 1.5 * right


def test_every_measured_frame_has_its_turn_once_per_epoch():
    """Missing ones never."""
    measured = np.ones(12, dtype=bool)
    measured[[2, 7]] = False
    sequence = recording(frames=12, measured=measured)[0]
    for batch, size in ((Batch.FRAME, 1), (Batch.QUARTET, 4)):
        settings = demo(batch=batch, images=1000)
        observations = observe(sequence, settings, "cpu")
        state = begin(observations, settings, seed=0, device="cpu")
        epochs = []
        for _ in range(2):
            drawn = [draw(state, observations, settings) for _ in observations.batches]
            assert max(map(len, drawn)) == size
            epochs.append([n for batch_of in drawn for n in batch_of])
        assert sorted(epochs[0]) == sorted(epochs[1]) == [n for n in range(12) if n not in (2, 7)]
        assert epochs[0] != epochs[1]
    state.images = 998
    assert len(draw(state, observations, settings)) == 2, "a run of 1000 images ends at 1000"


def test_reduced_keeps_the_view():
    """Intrinsics and flow shrink with the image."""
    sequence = small()
    half = reduced(sequence, 24)
    assert (half.width, half.height) == (24, 18)
    assert (half.intrinsics.fx, half.intrinsics.cx, half.intrinsics.cy) == (21.0, 12.0, 9.0)
    want = sequence.quads[3].reshape(18, 2, 24, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half.quads[3], want, atol=1e-6)
    np.testing.assert_allclose(
        half.flow.forward[4].max(), 0.5 * sequence.flow.forward[4].max(), rtol=0.05
    )
    assert reduced(sequence, 48) is sequence
    assert reduced(sequence, None) is sequence


def test_the_hash_sees_what_is_read():
    """Quads, intrinsics and flow."""
    sequence = small()
    assert data_hash(sequence) == data_hash(small())
    quads = sequence.quads.copy()
    quads[3, 4, 5] += 1e-6
    others = [
        replace(sequence, quads=quads),
        changed(sequence, fx=43.0),
        changed(sequence, backward_flow={}),
    ]
    assert len({data_hash(other) for other in (sequence, *others)}) == 4


def test_the_hash_sees_the_lens_of_the_colour_camera():
    """Fits read it; none is another lens than any, and the former hash of all is one."""
    sequence = with_colour(small(), size=(12, 9))
    colour = sequence.colour
    bent = [
        replace(colour.intrinsics, distortion=lens)
        for lens in ((0.1, 0.0, 0.0, 0.0, 0.0), (0.2, 0.0, 0.0, 0.0, 0.0))
    ]
    others = [replace(sequence, colour=replace(colour, intrinsics=one)) for one in bent]
    found = {data_hash(other) for other in (sequence, *others)}
    former = {former_hash(other) for other in (sequence, *others)}
    assert len(found) == 3
    assert len(former) == 1
    assert not found & former
    assert former_hash(small()) is None


def test_an_empty_recording_is_refused():
    """Before anything is written."""
    with pytest.raises(InputError, match="nothing was measured"):
        observe(replace(small(), measured=np.zeros(12, dtype=bool)), demo(), "cpu")


def test_reflectivity_can_start_clamped_and_recover():
    """A Gaussian whose reflectivity is below zero everywhere has no gradient of its own;
    the run must not break.
    """
    settings = demo(images=8)
    observations = observe(small(), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    with torch.no_grad():
        state.optimiser.tensors["reflectivity_sh"][::2] = constant_sh(torch.tensor(-1.0))
    assert advance(state, observations, settings) == 0
    assert all(leaf.isfinite().all() for leaf in state.optimiser.leaves)


def test_flow_may_come_now_and_then():
    """In one of three quartets, and three times as heavy there."""
    settings = presets.released()
    settings = replace(settings, schedule=replace(settings.schedule, flow_every=3))
    flows = [flow_weight(settings, images) for images in range(1992, 2028)]
    assert flows[:8] == [0.0] * 8, "it has not begun"
    want = 3 * settings.weights.flow
    assert flows[8:] == [want if n // 4 % 3 == 0 else 0.0 for n in range(2000, 2028)]
    assert 0 < flows.count(want) < 20
