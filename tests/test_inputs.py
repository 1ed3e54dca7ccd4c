"""What may be compared besides quads: phasors, colour from its own camera, closed-form distance;
and moving cameras.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import BASELINE, FOCAL, HEIGHT, WIDTH, as_phasors, recording, turned, with_colour
from sequences import changed
from small_runs import FLOW, OneStep, advance, demo, same, stored

from gftorf_warp.constants import SH_COEFFICIENTS
from gftorf_warp.data.sequence import Flow
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.recon import presets, renderings
from gftorf_warp.recon.observations import ImageStack, input_of, observe
from gftorf_warp.recon.settings import Input, Norm, Weights
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.terms import View
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.initialise import Init, InitSettings, from_random
from gftorf_warp.scene.measured import colour_camera_of, sensor_of


def test_auto_follows_the_camera():
    """And a choice is a choice."""
    sequence = recording(frames=8)[0]
    assert input_of(sequence, Input.AUTO) == Input.QUADS
    assert input_of(as_phasors(sequence), Input.AUTO) == Input.PHASOR
    assert input_of(as_phasors(sequence), Input.QUADS) == Input.QUADS
    assert input_of(sequence, Input.PHASOR) == Input.PHASOR


def test_a_phasor_is_compared_once_per_quartet_in_its_middle():
    """Rendered real and imaginary parts against the differences of opposite quads, of length 2a."""
    sequence = recording(frames=12)[0]
    settings = demo(input=Input.PHASOR, weights=Weights(ssim=0.0), background=0.0)
    observations = observe(sequence, settings, "cpu")
    assert observations.batches == [[0], [4], [8]]
    assert observations.time_at(4) == pytest.approx(5.5 / 120)
    q = observations.sequence.quads
    want = torch.tensor(np.stack([q[4] - q[5], q[6] - q[7]]))
    torch.testing.assert_close(observations.phasors[4], want, rtol=1e-4, atol=1e-5)
    state = begin(observations, settings, seed=0, device="cpu")
    one = OneStep(state, observations, settings, 4)
    phasor = one.images[0].renderings[View.TOF].phasor[:2].detach()
    assert one.terms["quads"] == pytest.approx(float((phasor - want).square().mean()), rel=1e-4)


def test_phasor_and_quad_input_agree_on_a_static_scene(tmp_path):
    """Within the noise: same start, as many images of each quartet."""
    one = recording(frames=12)[0]
    still = replace(one, quads=np.tile(one.quads[:4], (3, 1, 1)), flow=Flow())
    distances = []
    for kind, images in ((Input.QUADS, 160), (Input.PHASOR, 40)):
        run = reconstruct(still, tmp_path / kind, replace(demo(input=kind, images=images)))
        assert run.config["input"] == kind
        distances.append(run.render(5 / 120).distance)
    apart = (distances[0] - distances[1]).abs()
    assert apart.mean() < 0.03
    assert (distances[0] - distances[0].mean()).abs().mean() > 0.1, "a scene with structure"


def test_colour_is_compared_from_its_own_camera():
    """A Gaussian on the axis of the colour camera appears in the middle of its image,
    and only there.
    """
    sequence = with_colour(recording(frames=8)[0])
    camera = colour_camera_of(sequence, 4)
    assert (camera.width, camera.height) == (2 * WIDTH, 2 * HEIGHT)
    middle = camera.project(torch.tensor([[BASELINE, 0.0, 3.0]], dtype=torch.float64))[0].tolist()
    assert middle == pytest.approx([WIDTH, HEIGHT])
    settings = demo(weights=Weights(ssim=0.0, colour=2.0), background=0.0, warm_up=0)
    observations = observe(sequence, settings, "cpu")
    assert observations.colour_scale == pytest.approx(1 / 36.0)
    assert float(observations.colour.images.max()) == pytest.approx(1.0)
    state = begin(observations, settings, seed=0, device="cpu")
    field = state.optimiser.field
    moved = field.moved(*state.motion.at(state.binding, 4 / 120))
    want = rasterize(moved, camera, sensor_of(sequence), settings.render).colour.detach()
    squared = (want - observations.colour[4]).square().mean()
    assert OneStep(state, observations, settings, 4).terms["colour"] == pytest.approx(
        2.0 * float(squared), rel=1e-5
    )
    wrong = rasterize(
        moved, observations.cameras[4].resized(*want.shape[:0:-1]), sensor_of(sequence)
    )
    assert (wrong.colour - want).abs().max() > 0.05, "the other camera sees something else"
    absolute = replace(settings, weights=replace(settings.weights, colour_norm=Norm.L1))
    difference = 2.0 * float((want - observations.colour[4]).abs().mean())
    assert OneStep(state, observations, absolute, 4).terms["colour"] == pytest.approx(
        difference, rel=1e-5
    )
    assert "colour" not in OneStep(state, observations, settings, 5).terms, "no image there"


def test_colour_of_weight_zero_is_never_rendered(monkeypatch):
    """Neither tensors nor a pass; and a pass for colour makes no image that only the other camera
    is asked for.
    """
    sequence = with_colour(recording(frames=8)[0])
    calls, asked = [], []

    def noted(field, *arguments, images, **more):
        calls.append(field)
        asked.append(images if field.colour_sh is not None else {"opacity"})
        return rasterize(field, *arguments, images=images, **more)

    monkeypatch.setattr(renderings, "rasterize", noted)
    for weight, colours in ((0.0, 0), (1.0, 1)):
        settings = demo(weights=Weights(colour=weight), images=8)
        observations = observe(sequence, settings, "cpu")
        state = begin(observations, settings, seed=0, device="cpu")
        assert (
            bool(observations.colour)
            == (state.optimiser.field.colour_sh is not None)
            == bool(colours)
        )
        calls.clear()
        advance(state, observations, settings)
        assert len(calls) == 4 + colours
        assert sum(field.colour_sh is not None for field in calls) == colours
    assert all(images == {"opacity"} for images in asked)


def test_constant_and_other_harmonics_of_colour_have_rates_of_their_own():
    """Adam's first step is the rate."""
    settings = demo(weights=Weights(ssim=0.0, colour=1.0, distortion=0.0))
    observations = observe(with_colour(recording(frames=8)[0]), settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    before = state.optimiser.field.colour_sh.detach().clone()
    assert before.shape == (len(before), SH_COEFFICIENTS, 3)
    advance(state, observations, settings)
    change = (state.optimiser.field.colour_sh.detach() - before).abs().amax(dim=(0, 2))
    assert change[0] == pytest.approx(settings.rates.colour_constant, rel=1e-3)
    assert change[1:].max() == pytest.approx(settings.rates.colour_rest, rel=1e-3)


def test_a_run_with_colour_goes_on_where_it_stopped(tmp_path):
    """The split tensors come back as one and are split again, moments alike."""
    sequence = with_colour(recording(frames=8)[0])
    settings = demo(weights=Weights(colour=1.0), images=32)
    whole = reconstruct(sequence, tmp_path / "whole", settings)
    stopped = tmp_path / "stopped"

    def stop(images, *_, **__):
        if images >= 16:
            raise KeyboardInterrupt

    every = replace(
        settings, schedule=replace(settings.schedule, log_every=8, checkpoint_every_s=0.0)
    )
    with pytest.raises(KeyboardInterrupt):
        reconstruct(sequence, stopped, every, progress=stop)
    again = reconstruct(sequence, stopped, every)
    assert same(stored(again.path)["field"], stored(whole.path)["field"])
    assert same(stored(again.path)["adam"], stored(whole.path)["adam"])


def test_without_colour_a_colour_preset_says_so_and_others_go_on():
    """A preset that compares nothing else cannot, paper adds it where it is."""
    sequence = recording(frames=8)[0]
    with pytest.raises(InputError, match="no colour"):
        observe(sequence, presets.dgs(), "cpu")
    assert not observe(sequence, demo(weights=Weights(colour=1.0)), "cpu").colour
    black = with_colour(sequence)
    black = changed(black, colour={n: 0 * image for n, image in black.colour.images.items()})
    with pytest.raises(InputError, match="black"):
        observe(black, presets.dgs(), "cpu")


def test_dgs_compares_colour_and_closed_form_distance_and_no_quads():
    """One query per image; the second term is as wrong as the camera."""
    sequence = with_colour(recording(frames=8)[0])
    quarter = InitSettings(kind=Init.RANDOM, count=200, opacity=0.3, bounds=(1.0, 5.0))
    for made, names in ((presets.dgs(), {"colour"}), (presets.dgs_depth(), {"colour", "depth"})):
        settings = replace(made, init=quarter, motion=replace(made.motion, layers=2, width=8))
        observations = observe(sequence, settings, "cpu")
        assert observations.batches == [[0], [4]]
        state = begin(observations, settings, seed=0, device="cpu")
        one = OneStep(state, observations, settings, 4)
        assert one.terms.keys() == names
        assert (View.TOF in one.images[0].renderings) == (names != {"colour"})
        assert one.skipped == 0
    depth = replace(settings, weights=replace(settings.weights, ssim=0.0))
    one = OneStep(state, observations, depth, 4)
    decoded = observations.closed_form[1][0]
    difference = (one.images[0].renderings[View.TOF].distance.detach() - decoded).abs().mean()
    assert one.terms["depth"] == pytest.approx(depth.weights.depth * float(difference), rel=1e-5)


def test_every_raw_frame_is_rendered_from_its_own_pose():
    """A camera that turns; the flow loss knows that it does."""
    sequence = recording(frames=12)[0]
    poses = np.stack([turned(0.5 * n, (0.01 * n, 0.0, 0.0)) for n in range(12)])
    sequence = replace(sequence, camera_from_world=poses)
    settings = demo(init=InitSettings(kind=Init.RANDOM, count=400, opacity=0.5, bounds=(2.0, 5.0)))
    settings = replace(
        settings,
        weights=Weights(ssim=0.0, flow=1.0),
        motion=replace(settings.motion, from_tracks=False),
    )
    observations = observe(sequence, settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    field = state.optimiser.field
    for n in (1, 6):
        resting = replace(
            settings, background=0.0, schedule=replace(settings.schedule, warm_up=100)
        )
        seen = OneStep(state, observations, resting, n).images[0].renderings[View.TOF]
        want = rasterize(
            field, observations.cameras[n], observations.sensor_at(n), settings.render
        ).quads
        torch.testing.assert_close(seen.quads, want)
        other = rasterize(
            field, observations.cameras[0], observations.sensor_at(n), settings.render
        ).quads
        assert (other - want).abs().max() > 0.02 * want.abs().max()
    # nothing moves: the flow of the camera alone has no error, that of a camera at rest has
    assert not state.motion.offset.any()
    seen = rasterize(field, observations.cameras[4], observations.sensor_at(4), settings.render)
    ray = observations.cameras[4].rays()
    centre = torch.as_tensor(observations.cameras[4].centre, dtype=torch.float32)
    surface = (centre + ray * seen.distance[..., None]).detach()
    here, *there = (observations.cameras[n].project(surface).movedim(2, 0) for n in (4, 8, 0))
    flow = torch.stack([place - here for place in there]).numpy()
    settings = replace(settings, schedule=replace(settings.schedule, warm_up=0))
    right, wrong = (
        OneStep(
            state,
            replace(observations, flow=ImageStack.of({1: given}, "cpu")),
            settings,
            4,
            terms=(FLOW,),
        )
        for given in (flow, 0 * flow)
    )
    assert wrong.terms["flow"] > 0.1
    assert right.terms["flow"] < 1e-6 * wrong.terms["flow"]


def test_random_gaussians_fill_what_all_cameras_see_evenly():
    """Two frusta that overlap by half: as many points per volume in both as in one."""
    sequence = recording(frames=8)[0]
    poses = np.stack([turned(0.0)] * 4 + [turned(25.0)] * 4)
    sequence = replace(sequence, camera_from_world=poses)
    settings = InitSettings(kind=Init.RANDOM, count=6000, bounds=(1.0, 4.0))
    start = from_random(sequence, settings, torch.Generator().manual_seed(0))
    mean = start.field.mean
    assert len(mean) == 6000
    inside = []
    for pose in (poses[0], poses[4]):
        local = mean @ torch.tensor(pose[:3, :3].T, dtype=torch.float32)
        x, y, z = local.unbind(dim=1)
        u, v = FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2
        inside.append((z >= 1) & (z <= 4) & (u >= 0) & (u <= WIDTH) & (v >= 0) & (v <= HEIGHT))
    assert (inside[0] | inside[1]).float().mean() > 0.99
    both = inside[0] & inside[1]
    assert 0.2 < both.sum() / inside[0].sum() < 0.8
    assert inside[0].sum() == pytest.approx(int(inside[1].sum()), rel=0.08), (
        "both cameras see as many"
    )
    # drawn twice where frusta overlap, the density there would be double: compare a band inside
    # with one outside
    near = (mean[:, 2] > 2.5) & (mean[:, 2] < 3.0) & (mean[:, 1].abs() < 0.5)
    x = mean[near, 0]
    overlap, alone = ((x > 0.3) & (x < 0.9)).sum(), ((x > -1.2) & (x < -0.6)).sum()
    assert float(overlap) == pytest.approx(float(alone), rel=0.3)


def test_names_of_choices_are_checked(tmp_path):
    """Before anything is read or written."""
    sequence = recording(frames=8)[0]
    for option in ({"input": "raw"}, {"ablation": "h3"}, {"flow": "raft"}):
        with pytest.raises(UsageError, match=r"unknown|no ablations") as caught:
            reconstruct(sequence, tmp_path / "run", "paper", images=4, **option)
        assert next(iter(option)) in str(caught.value)
    assert not (tmp_path / "run").exists()
